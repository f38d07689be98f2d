//! Faults in the small world: ends of processes, the node's restart, lost notifications.

use super::*;

impl World {
    /// The process of an application ends. Its written messages still count.
    pub(super) fn kill(&mut self, at: usize) {
        let own = self.apps[at].tid;
        if !self.apps[at].alive {
            return;
        }
        self.apps[at].alive = false;
        self.deaths.insert(own);
        for link in self.links.values_mut() {
            link.close(own);
        }
        while !self.apps[at].to_node.is_empty() {
            self.node_reads(at);
        }
        // The node's messages for it end; the receipts return to their senders.
        let app = &mut self.apps[at];
        let waiting: Vec<_> = app.from_node.drain(..).chain(app.queue.drain_all()).collect();
        app.pending.clear();
        for message in waiting {
            self.fail_with_receiver(message);
        }
        self.fail_introductions(own);
    }

    pub(super) fn fail_with_receiver(&mut self, message: Message) {
        let Header { kind, source, destination, correlation, flags, .. } = message.header;
        let is_confirmed = flags.has(Flags::CONFIRM) && (kind.is_user() || kind == Kind::LNCL_SWITCH);
        if is_confirmed && self.apps[index_of(source)].is_incarnation_of(&message) {
            self.node_notifies(outcome(destination, source, correlation, Outcome::Failed));
        }
    }

    /// Loses a notification about a route: the application's queue was full, and it is not notified again.
    pub(super) fn lose_notification(&mut self, at: usize) {
        let app = &mut self.apps[at];
        let is_about_a_route = |message: &Message| match message.header.kind {
            Kind::OUTCOME => !app.pending.contains_key(&message.header.correlation),
            _ => message.header.kind == Kind::LNCL_INTRODUCED,
        };
        let Some(index) = app.from_node.iter().position(is_about_a_route) else { return };
        let lost = app.from_node.remove(index).expect("just found");
        let own = app.tid;
        if lost.header.kind == Kind::LNCL_INTRODUCED {
            self.links.get_mut(&number_of(&lost)).expect("made before").close(own);
        }
    }

    pub(super) fn fail_introductions(&mut self, ended: Tid) {
        let failed: Vec<_> =
            self.introductions.iter().filter(|(_, (_, _, peer))| *peer == ended).map(|(n, _)| *n).collect();
        for number in failed {
            let (requester, correlation, peer) = self.introductions.remove(&number).expect("just found");
            self.links.get_mut(&LinkNumber(number)).expect("made before").close(requester);
            self.node_notifies(outcome(peer, requester, correlation, Outcome::Failed));
        }
    }

    pub(super) fn revive(&mut self, at: usize) {
        if !self.apps[at].alive {
            // Link ends that the node had given to the former incarnation were closed with it.
            self.links.values_mut().for_each(|link| link.close(tid(at)));
            self.incarnations += 1;
            self.apps[at] = App::new(tid(at), self.incarnations, self.apps[at].direct_links);
        }
    }

    /// The node's LNCL ends and returns. Every application reads the messages that it had written, and
    /// reconnects.
    pub(super) fn restart_node(&mut self) {
        self.nodes_restarted = true;
        for (number, (requester, _, _)) in std::mem::take(&mut self.introductions) {
            self.links.get_mut(&LinkNumber(number)).expect("made before").close(requester);
        }
        let now = self.now;
        for at in 0..APPS {
            self.apps[at].queue = ClassQueue::new(QUEUE);
            while !self.apps[at].from_node.is_empty() {
                self.poll_node(at);
            }
        }
        for app in &mut self.apps {
            app.to_node.clear();
            app.routes.on_node_end(now);
            // Messages through the node have no outcome any more.
            let through: Vec<_> =
                app.pending.iter().filter(|(_, link)| link.is_none()).map(|(n, _)| *n).collect();
            for correlation in through {
                app.pending.remove(&correlation);
                assert!(self.ended.insert((app.incarnation, correlation)), "a message has ended twice");
            }
        }
    }
}
