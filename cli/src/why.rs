//! `sinew why`: finds the obstacles between two nodes or applications, as seen from both ends.

mod collect;
mod facts;
mod resolve;
mod rules;

use std::{collections::BTreeSet, path::PathBuf};

use clap::Args;
use serde_json::{Value, json};

use crate::{
    Report,
    system::{System, SystemError},
    table::{Table, clean, clean_lines},
};
use collect::Collected;
use facts::Facts;
pub(crate) use rules::lost_in_words;
use rules::{State, Step};

/// The two ends.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// A node's name or address, an application's name or TID
    from: String,
    /// Another one, or a group's name or TID (*/f0000007): then each member is checked
    to: String,
    /// The socket of a node on this host that is at none of the usual places nor beside the one of --socket,
    /// or is another user's: so a node is asked that the others do not know. May be given several times
    #[arg(long, value_name = "PATH")]
    other_socket: Vec<PathBuf>,
}

/// Asks every node that can be reached, and judges.
pub(crate) fn show(system: &mut System, order: &Order, is_wide: bool) -> Result<Report, SystemError> {
    let (others, shut) = System::beside(system, &order.other_socket);
    let mut collected = Collected::from(system, others)?;
    let facts = Facts { shut, ..collected.facts([&order.from, &order.to]) };
    collected.leave();
    let steps = rules::judge(&facts);
    let is_free = steps.iter().all(|step| step.state != State::Blocked);
    let json = json!({
        "from": order.from, "to": order.to, "free": is_free, "steps": steps.iter().map(step_json).collect::<Vec<_>>(),
    });
    Ok(Report { text: text(&steps, is_free, is_wide), json, is_fine: is_free })
}

fn table(steps: &[Step], is_wide: bool) -> String {
    let mut table = Table::new(["STEP", "STATUS", "DETAIL"]).whole(&["STATUS"]).wide(is_wide);
    for step in steps {
        table.row([step.what.clone(), word(step.state).to_owned(), step.detail.clone()]);
    }
    table.text()
}

fn text(steps: &[Step], is_free: bool, is_wide: bool) -> String {
    let mut shown = BTreeSet::new();
    let mut fixes_of = |is_blocked: bool| -> String {
        let steps = steps.iter().filter(|step| (step.state == State::Blocked) == is_blocked);
        let fixes = steps.filter_map(|step| Some((step, step.fix.as_ref()?)));
        let fixes = fixes.filter(|(_, fix)| shown.insert(*fix));
        fixes.map(|(step, fix)| format!("{}: {}\n", clean(&step.what), clean_lines(fix))).collect()
    };
    let (fixes, notes) = (fixes_of(true), fixes_of(false));
    let verdict = if is_free { "The way is free." } else { "The way is blocked." };
    let heading = if fixes.is_empty() { "" } else { " Suggested fix" };
    // A note blocks nothing, so it is no fix of the way.
    let notes = if notes.is_empty() { notes } else { format!("\nNoticed besides:\n{notes}") };
    format!("{}\n{verdict}{heading}\n{fixes}{notes}", table(steps, is_wide))
}

const fn word(state: State) -> &'static str {
    match state {
        State::Fine => "fine",
        State::Note => "note",
        State::Blocked => "BLOCKED",
    }
}

fn step_json(step: &Step) -> Value {
    json!({ "step": step.what, "status": word(step.state).to_lowercase(), "detail": step.detail, "suggested_fix": step.fix })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::{
        WIDTH,
        tests::{long_name, widest},
    };

    #[test]
    fn fixes_of_notes_are_separate_from_those_of_blocks() {
        let step = |state, fix: &str| Step {
            what: "hip knows knee".to_owned(),
            state,
            detail: String::new(),
            fix: Some(fix.to_owned()),
        };
        let note = step(State::Note, "give it a CPU");
        let free = text(std::slice::from_ref(&note), true, false);
        let end = "\nThe way is free.\n\nNoticed besides:\nhip knows knee: give it a CPU\n";
        assert!(free.ends_with(end) && !free.contains("Suggested fix"), "{free}");
        // The same fix is shown once, as that of the blocking step.
        let blocked = step(State::Blocked, "start it again");
        let steps = [note, step(State::Note, "start it again"), blocked];
        let shown = text(&steps, false, false);
        let end = "\nThe way is blocked. Suggested fix\nhip knows knee: start it again\n\nNoticed besides:\nhip knows knee: give it a CPU\n";
        assert!(shown.ends_with(end), "{shown}");
    }

    #[test]
    fn table_fits_a_terminal_for_any_names() {
        let name = long_name();
        let step = Step {
            what: format!("a message goes from {name} to {name}"),
            state: State::Blocked,
            detail: format!("its node {name} cannot be asked: {}", "no answer ".repeat(40)),
            fix: None,
        };
        let steps = [step];
        assert!(widest(&table(&steps, false)) <= WIDTH, "{}", table(&steps, false));
        assert_eq!(table(&steps, true).lines().count(), 2);
    }
}
