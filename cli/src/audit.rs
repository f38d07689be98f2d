//! `sinew audit`: where every message is.

use std::collections::BTreeSet;

use sinew::{
    audit::{Audit, NodeAudit},
    inspect::{AskAudit, AuditReport},
};

use crate::{
    Report,
    system::{Answer, System, SystemError},
    table::clean,
};

/// Reads every node twice, and compares the readings.
pub(crate) fn show(system: &mut System, is_wide: bool) -> Result<Report, SystemError> {
    let here = system.here()?;
    let before = system.ask_all::<AskAudit, AuditReport>(&here);
    let after = system.ask_all::<AskAudit, AuditReport>(&here);
    let asked: BTreeSet<_> = after.iter().map(|answer| answer.node).collect();
    let faults: String = after.iter().filter_map(fault).collect();
    let audit = Audit::of_readings(here.node, &asked, &readings(before), readings(after));
    let json = serde_json::to_value(&audit).expect("every key of an audit is a text");
    let is_fine = audit.missing() == 0 && audit.silent.is_empty();
    let table = if is_wide { format!("{audit:#}") } else { audit.to_string() };
    Ok(Report { text: format!("{table}\n{faults}"), json, is_fine })
}

fn readings(answers: Vec<Answer<AuditReport>>) -> Vec<NodeAudit> {
    answers.into_iter().filter_map(|answer| Some(answer.result.ok()?.audit)).collect()
}

fn fault(answer: &Answer<AuditReport>) -> Option<String> {
    let why = answer.result.as_ref().err()?;
    Some(format!("{} {}: {}\n", answer.node, clean(&answer.name), clean(why)))
}
