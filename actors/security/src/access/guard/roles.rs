//! Roles: which applications may set and read parameters, beside the rules, and release the stop.

use std::fmt;

use sinew_model::refusals::BY_LIST;
use sinew_runtime::{
    lock,
    parameters::{AskParameters, ParameterVote, SetParameters},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Header, Payload},
};

use super::{Access, Index, Label};
use crate::access::selector::Selector;

impl Access {
    /// Decides about a message that sets or reads parameters of the application at `app`. `None`: the rules decide.
    ///
    /// The participants of a transaction, which an operator has named to each of them, agree without a rule, and no
    /// others by any rule. Guests take no part.
    ///
    /// Only an operator may set them. Operators and observers may read them without a rule; others need one, as for any
    /// message.
    pub(super) fn decide_by_role(&self, header: &Header, app: AppAddress) -> Option<bool> {
        if header.kind == ParameterVote::KIND {
            // One that comes before its transaction is refused without a log line: it is sent again.
            return Some(self.participants.has(Time::now(), header, app) && !self.is_foreign(header.source));
        }
        let is_set = header.kind == SetParameters::KIND;
        if !is_set && header.kind != AskParameters::KIND {
            return None;
        }
        let index = self.index.load();
        let has = |role: &[Selector]| {
            let name = index.name_of(header.source);
            role.iter().any(|selector| selector.covers(self.here, header.source, name))
        };
        let roles = &index.list.roles;
        if self.is_operator(header.source) {
            return Some(true);
        }
        if !is_set {
            return has(&roles.observers).then_some(true);
        }
        let (source, target) = (header.source, Tid::new(self.here, app));
        self.refusals.count(Time::now(), BY_LIST, &NoOperator(&index, source, target));
        Some(false)
    }

    /// Returns whether the application at `source` is an operator: it may set parameters of this node's applications,
    /// and release the stop.
    pub fn is_operator(&self, source: Tid) -> bool {
        let index = self.index.load();
        let name = index.name_of(source);
        let is_named = |selector: &Selector| selector.covers(self.here, source, name);
        index.list.roles.operators.iter().any(is_named) && !self.is_foreign(source)
    }

    /// Returns whether the application at `source` is or was one of a guest of this node. Guests have no part in the
    /// robot's settings, even if a text of `operators` covers their addresses.
    fn is_foreign(&self, source: Tid) -> bool {
        if source.node != self.here {
            return false;
        }
        let own = rustix::process::geteuid().as_raw();
        let is_held = lock(&self.holders)
            .iter()
            .any(|holder| holder.app == source.app && ![own, 0].contains(&holder.uid));
        is_held || lock(&self.memberships).is_guest(source.app)
    }
}

/// A refused set of parameters that is formatted only when it is logged.
struct NoOperator<'a>(&'a Index, Tid, Tid);

impl fmt::Display for NoOperator<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(index, source, target) = self;
        let label = |tid: Tid| Label(tid, index.name_of(tid).map(str::to_owned));
        let (source, target) = (label(*source), label(*target));
        write!(
            f,
            "{source} is no operator, and may not set parameters of {target}; `operators` in [roles] names them"
        )
    }
}
