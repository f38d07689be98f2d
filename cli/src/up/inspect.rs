//! Asks a node of this host for its applications, through its client socket.

use std::{path::Path, time::Duration};

use sinew::inspect::{AppsReport, AskApps};

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
    let report = ask::<AskApps, AppsReport>(&mut system.endpoint, node, ANSWERED_WITHIN);
    system.leave();
    let report = report?;
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
    Ok(seen.collect())
}
