//! Asks a node of this host for its applications, through its client socket.

use std::{path::Path, time::Duration};

use sinew::inspect::{AppsReport, AskApps, AskTree, TreeReport};

use super::protocol::AppSeen;
use crate::{
    apps,
    system::{System, ask},
};

/// Time limit for the answer of the node.
const ANSWERED_WITHIN: Duration = Duration::from_secs(2);

/// Returns the named applications of the node at this socket, or why it gives no answer.
pub(super) fn inspect(socket: &Path) -> Result<Vec<AppSeen>, String> {
    // The first line has the cause. The others are for a user that has named the socket.
    let short = |why: String| why.lines().next().unwrap_or_default().to_owned();
    let mut system =
        System::enter(Some(socket), ANSWERED_WITHIN).map_err(|error| short(error.to_string()))?;
    let node = system.endpoint.tid().node;
    // In this order: what the tree has is registered, so it is missing in the list only for a moment.
    let tree = ask::<AskTree, TreeReport>(&mut system.endpoint, node, ANSWERED_WITHIN);
    let report = ask::<AskApps, AppsReport>(&mut system.endpoint, node, ANSWERED_WITHIN);
    system.leave();
    let (tree, report) = (tree?, report?);
    if report.left_out > 0 {
        let left_out = report.left_out;
        return Err(format!(
            "{left_out} further applications had no room in its answer; name those that count by `ready`"
        ));
    }
    let seen = report.apps.iter().filter_map(|app| {
        let is_ready = app.ready && app.missing.is_empty();
        Some(AppSeen { name: app.name.clone()?, is_ready, why: apps::why(app) })
    });
    Ok(seen.chain(unregistered(&tree, &report)).collect())
}

/// Returns the applications that a node has not registered yet, or the node itself while its layers start: it opens its
/// socket before.
fn unregistered(tree: &TreeReport, report: &AppsReport) -> Vec<AppSeen> {
    let unready =
        |name: &str, why: &str| AppSeen { name: name.to_owned(), is_ready: false, why: why.to_owned() };
    // The tops of the tree are the supervisors of the layers and, when all layers are ready, of the applications.
    if tree.lines.iter().filter(|line| line.depth == 0).count() < 2 {
        return vec![unready(&tree.name, "the node's layers are starting")];
    }
    let is_listed = |tid| report.apps.iter().any(|app| app.tid == tid);
    let missing = tree.lines.iter().filter(|line| line.tid.is_some_and(|tid| !is_listed(tid)));
    missing.map(|line| unready(&line.name, "the node is registering it")).collect()
}

#[cfg(test)]
mod tests {
    use sinew::{
        AppAddress, NodeAddress, Tid,
        inspect::{AppReport, TreeLine},
    };

    use super::*;

    fn tid(app: u32) -> Tid {
        Tid::new(NodeAddress::new(7), AppAddress::new(app))
    }

    fn line(depth: u32, name: &str, tid: Option<Tid>) -> TreeLine {
        TreeLine {
            depth,
            name: name.to_owned(),
            tid,
            state: "ready".to_owned(),
            since_us: 0,
            life: 1,
            restarts: 0,
            last_reason: None,
            place: None,
            waiting: None,
            waiting_most: None,
            oldest_us: None,
            ages: None,
            strategy: None,
        }
    }

    fn apps(tids: &[Tid]) -> AppsReport {
        let app = |tid: &Tid| AppReport {
            tid: *tid,
            name: Some("drive".to_owned()),
            ready: true,
            waits_us: None,
            missing: Vec::new(),
            missing_left_out: 0,
            ended: None,
            kinds: Vec::new(),
            kinds_left_out: 0,
        };
        AppsReport {
            name: "knee".to_owned(),
            apps: tids.iter().map(app).collect(),
            left_out: 0,
            barriers: Vec::new(),
            barriers_left_out: 0,
            groups: Vec::new(),
            groups_left_out: 0,
        }
    }

    #[test]
    fn node_that_starts_is_not_ready() {
        let layers = vec![line(0, "layers", None), line(1, "lncl", None)];
        let drive = [line(0, "knee", None), line(1, "drive", Some(tid(1)))];
        let mut tree = TreeReport { name: "knee".to_owned(), lines: layers, left_out: 0 };
        let named =
            |seen: Vec<AppSeen>| seen.into_iter().map(|app| (app.name, app.is_ready)).collect::<Vec<_>>();
        assert_eq!(named(unregistered(&tree, &apps(&[]))), [("knee".to_owned(), false)]);
        tree.lines.extend(drive);
        assert_eq!(named(unregistered(&tree, &apps(&[]))), [("drive".to_owned(), false)]);
        assert_eq!(named(unregistered(&tree, &apps(&[tid(1)]))), []);
    }
}
