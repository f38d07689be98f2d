//! The answer of the root to NDL: the liveness of this node's layers, applications and clients.

use sinew_model::progress::{IdleClient, Progress};
use sinew_ndl::check_period;
use sinew_runtime::time::Time;
use sinew_session::book::ClientTaking;

use super::Root;
use crate::progress::{collect, millis_since};

impl Root {
    pub(super) fn progress(&mut self) -> Progress {
        let now = Time::now();
        let turns = self.threads.borrow().turns();
        let mut stalled = self.turns.check(now, turns);
        self.hosted.retain(|_, link| link.strong_count() > 0);
        let links = self.hosted.iter().filter_map(|(name, link)| Some((name, link.upgrade()?)));
        stalled.extend(links.filter_map(|(name, link)| Some((name.clone(), link.stalled_since()?))));
        let mut parts = Vec::new();
        for supervisor in [&self.layer_supervisor, &self.app_supervisor].into_iter().flatten() {
            collect(now, supervisor, supervisor.view(now), &stalled, &mut parts);
        }
        Progress::of(parts).with_clients(self.idle_clients(now))
    }

    /// Returns the clients that do not read their queued messages.
    fn idle_clients(&mut self, now: Time) -> Vec<IdleClient> {
        let (clients, every) = (self.state.lncl.book.takings(), check_period(&self.state.ctx.config.ndl));
        let idle = self.clients.check(now, every, clients.iter().map(|client| (client.id, client.taking)));
        let report = |ClientTaking { id, app, name, .. }: ClientTaking| {
            let since_ms = millis_since(now, *idle.get(&id)?);
            Some(IdleClient { app, name: name.to_string(), since_ms })
        };
        clients.into_iter().filter_map(report).collect()
    }
}
