//! What a node says of its access list, and has done with it.

use std::{sync::Arc, time::Duration};

use sinew_runtime::{
    outcome::Rejection,
    tid::AppAddress,
    time::Time,
    wire::{Class, Message},
};

use super::reports::{AccessReport, AccessVerdict, AskAccess, ReloadReport};
use crate::{
    access::{Explanation, Question},
    lncl::Owner,
    node::NodeHandle,
    stores::{Stores, lock},
};

/// How often tools may have files read again, and how often at once.
const READ_PERIOD: Duration = Duration::from_secs(1);
const ASKED_AT_ONCE: u32 = 4;
/// Longest account of what is wrong with a list, in characters.
const FAULTS_MAX: usize = 16 * 1024;

/// What the list says of messages between the two that the question names.
pub(super) fn explained(stores: &Arc<Stores>, question: &Message) -> Result<AccessReport, Rejection> {
    let AskAccess { source, target } = question.decode().map_err(|_| Rejection::Malformed)?;
    let Some(access) = stores.access.get() else {
        return Ok(AccessReport { is_given: false, verdicts: Vec::new() });
    };
    if target.node != stores.node || !target.is_single() || target.app.is_layer() {
        return Err(Rejection::NoSuchApplication);
    }
    let verdict = |class| {
        let Explanation { is_allowed, why } = access.explain(Question { source, target, group: None, class });
        AccessVerdict { class, is_allowed, why }
    };
    Ok(AccessReport { is_given: true, verdicts: Class::ALL.map(verdict).to_vec() })
}

/// Whether the application at `app` is one of this process, or of another one of the same user or of root.
fn is_of_the_nodes_user(stores: &Stores, app: AppAddress) -> bool {
    match lock(&stores.registry).owner_of(app) {
        Some(Owner::Node) => true,
        // Where there is no list there is nobody else here, and nothing to read.
        Some(Owner::Client { .. }) => {
            stores.access.get().is_none_or(|access| access.is_of(app, rustix::process::geteuid().as_raw()))
        }
        None => false,
    }
}

/// How often files were read again of late on the word of tools.
#[derive(Debug, Default)]
pub(super) struct Readings {
    /// When they may be read [`ASKED_AT_ONCE`] times again.
    full: Time,
}

impl Readings {
    /// Whether they may be read at `now`: so often at once, and once a second.
    fn admit(&mut self, now: Time) -> bool {
        let next = self.full.max(now) + READ_PERIOD;
        let may = next.since(now) <= READ_PERIOD * ASKED_AT_ONCE;
        if may {
            self.full = next;
        }
        may
    }
}

/// Has the lists read again, if somebody of the node's own user on this host wants it. spec: INSPECT-7
#[expect(clippy::unnecessary_wraps, reason = "all answers have one form")]
pub(super) fn reloaded(
    stores: &Arc<Stores>,
    readings: &mut Readings,
    question: &Message,
) -> Result<ReloadReport, Rejection> {
    if question.header.source.node != stores.node {
        let why =
            "lists are read again for a program of their node's own host only: run `sinew reload` there";
        return Ok(report(stores, None, why));
    }
    if !is_of_the_nodes_user(stores, question.header.source.app) {
        let why = "lists are read again for programs of their node's own user and of root only: run `sinew reload` as that user";
        return Ok(report(stores, None, why));
    }
    if !readings.admit(Time::now()) {
        return Ok(report(stores, None, "the lists were read a moment ago: ask again in a second"));
    }
    let (node, mut faults) = (NodeHandle::of(stores.clone()), Vec::new());
    let is_secured = stores.secured.get().is_some();
    if stores.access.get().is_some() || !is_secured {
        faults.extend(node.reload_access().err().map(|why| why.to_string()));
    }
    let denied = is_secured.then(|| node.reload_deny_list());
    let denied = denied.and_then(|read| read.map_err(|why| faults.push(why.to_string())).ok());
    Ok(report(stores, denied, &faults.join("\n")))
}

/// What is in force, and what is wrong, if anything is.
fn report(stores: &Stores, denied: Option<usize>, faults: &str) -> ReloadReport {
    let now = stores.access.get().map(|access| access.summary());
    ReloadReport {
        rules: now.map_or(0, |now| now.rules as u64),
        clients: now.map_or(0, |now| now.clients as u64),
        has_list: now.is_some(),
        denied: denied.map(|count| count as u64),
        refused: (!faults.is_empty()).then(|| faults.chars().take(FAULTS_MAX).collect()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_are_read_again_a_few_times_at_once_and_then_once_a_second() {
        let (mut readings, begin) = (Readings::default(), Time::from_nanos(1));
        let mut may = |at| (0..9).filter(|_| readings.admit(at)).count();
        assert_eq!(may(begin), 4);
        assert_eq!(may(begin + Duration::from_secs(1)), 1);
        assert_eq!(may(begin + Duration::from_secs(60)), 4);
    }
}
