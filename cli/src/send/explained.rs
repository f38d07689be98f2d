//! Explains a message that was not handled, from the report of the receiver's node.
//!
//! The outcome of a message is only a code. The receiver's log names the field that does not fit, and its node's report
//! the types that it handles.

use std::collections::BTreeMap;

use sinew::{
    NodeAddress, Outcome, Tid,
    inspect::{AppReport, AppsReport, AskApps},
    message::Rejection,
};

use super::Order;
use crate::{
    system::{Answer, System},
    table::{clean, quoted, short},
    unknown::suggestion,
};

/// Maximum number of listed types.
const KINDS_SHOWN: usize = 8;

/// The prefix of the types that nodes themselves send to applications.
const OF_NODES: &str = "sinew.";

/// An application that receives messages.
#[derive(Clone, Debug)]
pub(super) struct Receiver {
    /// The name of its node.
    pub(super) node: String,
    pub(super) app: AppReport,
}

/// The applications of these nodes, as they report them.
pub(super) fn receivers(system: &mut System, nodes: Vec<NodeAddress>) -> BTreeMap<Tid, Receiver> {
    let nodes = nodes.into_iter().map(|node| (node, String::new())).collect();
    let answers = system.ask_these::<AskApps, AppsReport>(nodes);
    let reports = answers.into_iter().filter_map(|Answer { result, .. }| result.ok());
    let apps = reports.flat_map(|AppsReport { name, apps, .. }| {
        apps.into_iter().map(move |app| (app.tid, Receiver { node: name.clone(), app }))
    });
    apps.collect()
}

/// Returns whether an outcome means that the receiver could not use a message of this type.
pub(super) const fn is_about_types(outcome: Outcome) -> bool {
    matches!(outcome, Outcome::Rejected(Rejection::UnknownKind | Rejection::Malformed))
}

/// Returns the explanation for a message with a type or payload that its receiver refused.
pub(super) fn by_types(outcome: Outcome, receiver: &Receiver, order: &Order) -> Option<String> {
    let Outcome::Rejected(rejection) = outcome else { return None };
    if rejection == Rejection::Malformed {
        let (node, target) = (short(&receiver.node), quoted(&clean(&order.target)));
        return Some(format!(
            ". The log of node {node} names the field that does not fit. `sinew watch {target} --received` shows payloads that arrive"
        ));
    }
    (rejection == Rejection::UnknownKind).then(|| handled(&receiver.app, &order.kind))
}

/// Returns the types that it handles, and those with names similar to this one.
fn handled(app: &AppReport, kind: &str) -> String {
    let names = app.kinds.iter().map(|of| of.name.clone().unwrap_or_else(|| of.kind.to_string()));
    let names: Vec<_> = names.filter(|name| !name.starts_with(OF_NODES)).collect();
    if names.is_empty() && app.kinds_left_out == 0 {
        return "; it has declared no type that it handles".to_owned();
    }
    let shown: Vec<_> = names.iter().take(KINDS_SHOWN).map(|name| short(name)).collect();
    let more = (names.len() - shown.len()) as u64 + app.kinds_left_out;
    let more =
        if more > 0 { format!(" and {more} more (`sinew apps --json` lists them)") } else { String::new() };
    let near = suggestion(kind, names.iter().map(String::as_str));
    format!("; it handles {}{more}{near}", shown.join(", "))
}

#[cfg(test)]
pub(super) mod tests {
    use sinew::{AppAddress, inspect::KindReport, message::Kind};

    use super::*;

    /// The knee, which has waited for 2 s, and handles these types.
    pub(crate) fn app(kinds: &[&str]) -> AppReport {
        let kind = |name: &&str| KindReport { kind: Kind::named(name), name: Some((*name).to_owned()) };
        AppReport {
            tid: Tid::new(NodeAddress::new(2), AppAddress::new(0x1001)),
            name: Some("knee".to_owned()),
            ready: false,
            waits_us: Some(2_000_000),
            missing: Vec::new(),
            missing_left_out: 0,
            ended: None,
            kinds: kinds.iter().map(kind).collect(),
            kinds_left_out: 0,
        }
    }

    #[test]
    fn unhandled_type_is_reported_with_handled_and_nearest_ones() {
        let near = handled(&app(&["demo.stop", "sinew.node_event", "demo.angle"]), "demo.angel");
        assert_eq!(near, "; it handles demo.stop, demo.angle; nearest: demo.angle, demo.stop");
        assert_eq!(handled(&app(&[]), "demo.angel"), "; it has declared no type that it handles");
        let names: Vec<_> = (0..20).map(|at| format!("t{at}")).collect();
        let names: Vec<_> = names.iter().map(String::as_str).collect();
        let many = AppReport { kinds_left_out: 5, ..app(&names) };
        let text = handled(&many, "zzz");
        assert!(text.contains("t7 and 17 more (") && !text.contains("t8"), "{text}");
    }
}
