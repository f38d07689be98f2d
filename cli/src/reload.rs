//! `sinew reload`: has the node on this host read its access list again.

use serde_json::json;
use sinew::inspect::{AskReload, ReloadReport};

use crate::{
    Said,
    system::{Fault, System},
    table::clean,
};

/// Asks the node that lets us in.
pub(crate) fn show(system: &mut System) -> Result<Said, Fault> {
    let node = system.endpoint.tid().node;
    let answer = system.ask_these::<AskReload, ReloadReport>(vec![(node, String::new())]).pop();
    let said = answer.map_or_else(|| Err("no answer".to_owned()), |answer| answer.said);
    let said = said.map_err(|why| Fault::NoAnswer(system.path.clone(), why))?;
    let ReloadReport { rules, clients, ref refused } = said;
    let json = json!({ "rules": rules, "clients": clients, "refused": refused });
    let text = match refused {
        None => {
            format!("In force at {node}: {rules} rules for messages, {clients} for users of this host.\n")
        }
        // One fault a line.
        Some(why) => why.lines().map(|line| clean(line) + "\n").collect(),
    };
    Ok(Said { text, json, is_fine: refused.is_none() })
}
