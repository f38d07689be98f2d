//! `sinew why`: what stands in the way between two nodes or applications, looked at from both ends.

mod collect;
mod facts;
mod resolve;
mod rules;

use std::{collections::BTreeSet, path::PathBuf};

use clap::Args;
use serde_json::{Value, json};

use crate::{
    Report,
    system::{Fault, System},
    table::{Table, clean},
};
use collect::Gathered;
use facts::Facts;
pub(crate) use rules::lost_in_words;
use rules::{State, Step};

/// Between whom.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// A node's name or address, an application's name or TID
    from: String,
    /// Another one, or a group's name or TID (*/f0000007): then each member is looked at
    to: String,
    /// The socket of a node on this host that is at none of the usual places nor beside the one of --socket, or is another user's: so a node
    /// is asked that the others do not know. May be given several times
    #[arg(long, value_name = "PATH")]
    other_socket: Vec<PathBuf>,
}

/// Asks every node that can be reached, and judges.
pub(crate) fn show(system: &mut System, order: &Order, is_wide: bool) -> Result<Report, Fault> {
    let (others, shut) = System::beside(system, &order.other_socket);
    let mut gathered = Gathered::from(system, others)?;
    let facts = Facts { shut, ..gathered.facts([&order.from, &order.to]) };
    gathered.leave();
    let steps = rules::judge(&facts);
    let is_free = steps.iter().all(|step| step.state != State::Blocked);
    let json = json!({
        "from": order.from, "to": order.to, "free": is_free, "steps": steps.iter().map(step_json).collect::<Vec<_>>(),
    });
    Ok(Report { text: text(&steps, is_free, is_wide), json, is_fine: is_free })
}

fn text(steps: &[Step], is_free: bool, is_wide: bool) -> String {
    let mut table = Table::new(["STEP", "STATUS", "DETAIL"]).wide(is_wide);
    for step in steps {
        table.row([step.what.clone(), word(step.state).to_owned(), step.seen.clone()]);
    }
    let mends = steps.iter().filter_map(|step| Some((step, step.mend.as_ref()?)));
    let mut said = BTreeSet::new();
    let mends = mends.filter(|(_, mend)| said.insert(*mend));
    let mends: String =
        mends.map(|(step, mend)| format!("{}: {}\n", clean(&step.what), clean(mend))).collect();
    let verdict = if is_free { "The way is free." } else { "The way is blocked." };
    match (is_free, mends.is_empty()) {
        (_, true) => format!("{}\n{verdict}\n", table.text()),
        (true, false) => format!("{}\n{verdict} Suggested fix\n{mends}", table.text()),
        (false, false) => format!("{}\n{verdict} Suggested fix\n{mends}", table.text()),
    }
}

const fn word(state: State) -> &'static str {
    match state {
        State::Fine => "fine",
        State::Note => "note",
        State::Blocked => "BLOCKED",
    }
}

fn step_json(step: &Step) -> Value {
    json!({ "step": step.what, "state": word(step.state).to_lowercase(), "seen": step.seen, "mend": step.mend })
}
