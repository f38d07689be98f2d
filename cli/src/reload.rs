//! `sinew reload`: makes the node on this host read its access list and its deny list again.

use serde_json::json;
use sinew::{
    NodeAddress,
    inspect::{AskReload, ReloadReport},
};

use crate::{
    Report,
    system::{System, SystemError},
    table::clean,
};

/// Asks the node at the socket.
pub(crate) fn show(system: &mut System) -> Result<Report, SystemError> {
    let node = system.endpoint.tid().node;
    let answer = system.ask_these::<AskReload, ReloadReport>(vec![(node, String::new())]).pop();
    let report = answer.map_or_else(|| Err("no answer".to_owned()), |answer| answer.result);
    let report = report.map_err(|why| SystemError::NoAnswer(system.path.clone(), why))?;
    let ReloadReport { rules, clients, has_list, denied, readmitted, ref refused } = report;
    let json = json!({
        "rules": rules, "clients": clients, "has_list": has_list, "denied": denied, "readmitted": readmitted,
        "refused": refused
    });
    Ok(Report { text: text(node, &report), json, is_fine: refused.is_none() })
}

/// Returns the faults, one per line, and the lists that are in force in either case.
fn text(node: NodeAddress, report: &ReloadReport) -> String {
    let faults: String =
        report.refused.iter().flat_map(|why| why.lines()).map(|line| clean(line) + "\n").collect();
    let readmitted = match report.readmitted {
        0 => String::new(),
        count => format!(
            "Certificates that were revoked and are not on the deny list any more: {count}. They are valid again. If they were not taken out on purpose, the \
             file was read before all of it was there: copy it under another name, rename it, and reload.\n"
        ),
    };
    format!("{faults}In force at {node}: {}.\n{readmitted}", in_force(report))
}

fn in_force(report: &ReloadReport) -> String {
    let ReloadReport { rules, clients, has_list, denied, .. } = report;
    let access = format!("{rules} rules for messages, {clients} for users of this host");
    let access = if *has_list { access } else { "no access list".to_owned() };
    match denied {
        Some(1) => format!("{access}; 1 certificate is revoked"),
        Some(count) => format!("{access}; {count} certificates are revoked"),
        None => access,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(denied: u64, readmitted: u64, refused: Option<&str>) -> ReloadReport {
        let (denied, refused) = (Some(denied), refused.map(str::to_owned));
        ReloadReport { rules: 2, clients: 0, has_list: true, denied, readmitted, refused }
    }

    #[test]
    fn active_lists_are_shown_despite_faults() {
        let node = NodeAddress::new(0x0a00_0002);
        let good = text(node, &report(1, 0, None));
        assert_eq!(
            good,
            "In force at 10.0.0.2: 2 rules for messages, 0 for users of this host; 1 certificate is revoked.\n"
        );
        assert_eq!(text(node, &report(1, 0, Some("a fault\nanother"))), format!("a fault\nanother\n{good}"));
    }

    #[test]
    fn reinstated_certificates_are_reported() {
        let shown = text(NodeAddress::new(1), &report(0, 3, None));
        assert!(shown.contains("0 certificates are revoked") && shown.contains("any more: 3."), "{shown}");
        assert!(shown.contains("valid again") && shown.contains("rename"), "{shown}");
    }
}
