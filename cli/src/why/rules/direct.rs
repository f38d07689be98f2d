//! Shows the direct link of two applications of one node.

use super::{super::facts::TrafficEnd, Steps};

impl Steps {
    /// Adds what `from` has sent on a direct link to `to`, if there is one.
    pub(super) fn direct(&mut self, from: &TrafficEnd, to: &TrafficEnd) {
        let Some(receiver) = to.app_tid().filter(|_| from.node == to.node) else { return };
        let links = from.app.iter().flat_map(|app| &app.direct);
        for (_, account) in links.filter(|(peer, _)| *peer == receiver.app) {
            let mut detail = format!(
                "{} messages went past the node, {} of them are read",
                account.taken - account.superseded,
                account.delivered
            );
            if account.waiting > 0 {
                detail += &format!("; {} wait until {} receives", account.waiting, to.label());
            }
            self.fine(format!("{} has a direct link to {}", from.label(), to.label()), detail);
        }
    }
}
