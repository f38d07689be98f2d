//! Required names that nobody has: what similar names there are. A misspelt requirement waits for ever, and looks like one that is late.

use std::time::Duration;

use sinew_runtime::{
    app::{Requirement, is_pattern},
    time::Time,
};

use super::{Core, Output, Reason, apps::State, respite::Moment};
use crate::{
    nearest::{COMPARED_MAX, nearest},
    sync::list::Name,
};

/// Time for which nobody may have a required name before that is logged: at a normal start of a robot its nodes have found each other by then.
pub(super) const FIRST_AFTER: Duration = Duration::from_secs(2);
/// Time until the same requirement is logged again.
const AGAIN_AFTER: Duration = Duration::from_secs(300);

impl Core {
    /// Reports requirements whose names nobody has, while their applications wait.
    pub(super) fn report_misspelt(&mut self, Moment { now, judged }: Moment) {
        let mut due = Vec::new();
        for (address, app) in self.apps.iter_mut() {
            let State::Waiting(_) = app.state else {
                app.misspelt.clear();
                continue;
            };
            let absent = &app.absent;
            app.misspelt.retain(|text, _| absent.contains_key(text));
            for (text, since) in absent {
                let at = app.misspelt.entry(text.clone()).or_insert(*since + FIRST_AFTER);
                if *at <= judged {
                    *at = now + AGAIN_AFTER;
                    due.push((address, text.clone()));
                }
            }
        }
        let mut reports = Vec::new();
        for (address, text) in due {
            let Some(app) = self.apps.get(address) else { continue };
            let Some(requirement) = app.requires.iter().find(|one| one.as_str() == text) else { continue };
            for name in self.unknown_names(requirement) {
                let application = app.title(address);
                let nearest = self.nearest(name, app.name.as_deref());
                reports.push(Output::Misspelt { application, name: name.to_owned(), nearest });
            }
        }
        self.outputs.extend(reports);
    }

    /// When a requirement is to be looked at for that.
    pub(super) fn next_misspelt(&self) -> Option<Time> {
        self.apps.waiting().flat_map(|(_, app, _)| app.misspelt.values().copied()).min()
    }

    /// The names in `requirement`, if nobody has any of them, nor had as long as somebody required them. One alternative that is known is
    /// enough: the others may be left out on purpose.
    fn unknown_names<'a>(&'a self, requirement: &'a Requirement) -> Vec<&'a str> {
        let names: Vec<_> = requirement.alternatives().iter().map(String::as_str).collect();
        let is_unknown = |name: &&str| !is_pattern(name) && self.why_not(name) == Some(Reason::NotThere);
        if names.iter().all(is_unknown) { names } else { Vec::new() }
    }

    /// Names of applications, on this node and on all that are known and not lost, as many as are compared.
    pub(crate) fn names(&self) -> Vec<Name> {
        let here = self.apps.iter().filter_map(|(_, app)| app.name.as_ref());
        here.chain(self.peers.directory().map(|(name, ..)| name)).take(COMPARED_MAX).cloned().collect()
    }

    /// The names of other applications that are similar to `name`, with their states, the most similar first.
    pub(super) fn nearest(&self, name: &str, own: Option<&str>) -> Vec<String> {
        let here =
            self.apps.iter().filter_map(|(_, app)| Some((app.name.as_ref()?, app.state == State::Ready)));
        let there = self.peers.directory().map(|(name, _, is_ready, _)| (name, is_ready));
        let others = here.chain(there).filter(|(other, _)| Some(&***other) != own);
        nearest(name, others, |(other, _)| other)
            .into_iter()
            .map(|(other, is_ready)| format!("{other} ({})", if is_ready { "ready" } else { "starting" }))
            .collect()
    }
}
