//! `sinew reload`: has the node on this host read its access list and its deny list again.

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
    let ReloadReport { rules, clients, has_list, denied, ref refused } = said;
    let json = json!({
        "rules": rules, "clients": clients, "has_list": has_list, "denied": denied, "refused": refused
    });
    let text = match refused {
        None => format!("In force at {node}: {}.\n", in_force(&said)),
        // One fault a line.
        Some(why) => why.lines().map(|line| clean(line) + "\n").collect(),
    };
    Ok(Said { text, json, is_fine: refused.is_none() })
}

fn in_force(said: &ReloadReport) -> String {
    let ReloadReport { rules, clients, has_list, denied, .. } = said;
    let access = format!("{rules} rules for messages, {clients} for users of this host");
    let access = if *has_list { access } else { "no access list".to_owned() };
    match denied {
        Some(1) => format!("{access}; 1 certificate is revoked"),
        Some(count) => format!("{access}; {count} certificates are revoked"),
        None => access,
    }
}
