//! Notifies systemd: the node is ready, makes progress, or stops.
//!
//! The watchdog of systemd is for a node that hangs as a whole, so the root feeds it, and only while all layers make
//! progress. The node supervises its applications itself: one that hangs does not end the others.

use actix::{AsyncContext as _, Context};
use sinew_runtime::time::Time;

use super::Root;
use crate::{progress::collect, systemd::Notifier};

impl Root {
    /// Reports that the node is ready, and begins to feed the watchdog, if systemd has started this process.
    pub(super) fn begin_notifications(&mut self, context: &mut Context<Self>) {
        let notifier = self.notifier.get_or_insert_with(Notifier::of_this_process);
        notifier.notify("READY=1");
        if let Some(period) = notifier.period() {
            context.run_interval(period, |root, _| root.feed_watchdog());
        }
    }

    pub(super) fn notify_stop(&mut self) {
        if let Some(notifier) = &mut self.notifier {
            notifier.notify("STOPPING=1");
        }
    }

    fn feed_watchdog(&mut self) {
        let now = Time::now();
        let turns = self.threads.borrow().turns();
        let stalled = self.turns.check(now, turns);
        let mut parts = Vec::new();
        if let Some(layers) = &self.layer_supervisor {
            collect(now, layers, layers.view(now), &stalled, &mut parts);
        }
        if let (true, Some(notifier)) = (parts.is_empty(), &mut self.notifier) {
            notifier.notify("WATCHDOG=1");
        }
    }
}
