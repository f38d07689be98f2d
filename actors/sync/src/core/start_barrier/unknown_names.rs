//! Required names that no application has, and similar names. A misspelt requirement waits forever, like one
//! that is late.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::{
    app::{Requirement, is_pattern},
    tid::AppAddress,
    time::Time,
};

use crate::core::{
    Output, Reason,
    grace_period::Moment,
    outputs::Outputs,
    readiness::{FIRST_AFTER, Readiness},
};

/// Time until the same requirement is logged again.
const AGAIN_AFTER: Duration = Duration::from_secs(300);

/// The absent requirements of each waiting application, and the time of the next report about each.
#[derive(Debug, Default)]
pub(super) struct UnknownNames(BTreeMap<AppAddress, BTreeMap<String, Time>>);

impl UnknownNames {
    /// Forgets an application, after it was registered anew or unregistered.
    pub(super) fn forget(&mut self, app: AppAddress) {
        self.0.remove(&app);
    }

    /// Reports required names that no application has, while their applications wait.
    pub(super) fn report(
        &mut self,
        Moment { now, judged }: Moment,
        readiness: Readiness<'_>,
        outputs: &mut Outputs,
    ) {
        let apps = readiness.directory.apps;
        self.0.retain(|app, _| apps.get(*app).is_some_and(|app| app.wait().is_some()));
        for (address, app, _) in apps.waiting() {
            let reports = self.0.entry(address).or_default();
            reports.retain(|text, _| app.absent.contains_key(text));
            for (text, since) in &app.absent {
                let at = reports.entry(text.clone()).or_insert(*since + FIRST_AFTER);
                if *at > judged {
                    continue;
                }
                *at = now + AGAIN_AFTER;
                let requirement = app.requires.iter().find(|one| one.as_str() == text);
                for name in requirement.into_iter().flat_map(|one| unknown_names(one, readiness)) {
                    let application = app.title(address);
                    let nearest = readiness.directory.nearest(name, app.name.as_deref());
                    outputs.push(Output::Misspelt { application, name: name.to_owned(), nearest });
                }
            }
        }
    }

    /// Returns the time of the next report.
    pub(super) fn next_wake(&self) -> Option<Time> {
        self.0.values().flat_map(BTreeMap::values).copied().min()
    }
}

/// Returns the names in `requirement` if none of them is known, or was known while an application
/// required it. One known alternative is enough to return none: the others may be absent on purpose.
fn unknown_names<'text>(requirement: &'text Requirement, readiness: Readiness<'_>) -> Vec<&'text str> {
    let names: Vec<_> = requirement.alternatives().iter().map(String::as_str).collect();
    let is_unknown = |name: &&str| !is_pattern(name) && readiness.why_not(name) == Some(Reason::NotThere);
    if names.iter().all(is_unknown) { names } else { Vec::new() }
}
