//! What goes wrong in the small world: ends of processes, the node's restart, lost words.

use super::*;

impl World {
    /// The process of an application ends. What it had written still counts.
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
        // What the node had for it ends; the receipts of those who asked come back to them.
        let app = &mut self.apps[at];
        let waiting: Vec<_> = app.from_node.drain(..).chain(app.queue.drain_all()).collect();
        app.pending.clear();
        for message in waiting {
            self.lost_with_its_receiver(message);
        }
        self.fail_introductions(own);
    }

    pub(super) fn lost_with_its_receiver(&mut self, message: Message) {
        let Header { kind, source, destination, correlation, flags, .. } = message.header;
        let is_confirmed = flags.has(Flags::CONFIRM) && (kind.is_user() || kind == Kind::LNCL_SWITCH);
        if is_confirmed && self.apps[index_of(source)].life_is(&message) {
            self.node_tells(outcome(destination, source, correlation, Outcome::Failed));
        }
    }

    /// A word about a route is lost: the application's queue was full, and it is told by nobody.
    pub(super) fn lose_word(&mut self, at: usize) {
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

    pub(super) fn fail_introductions(&mut self, gone: Tid) {
        let failed: Vec<_> =
            self.introductions.iter().filter(|(_, (_, _, peer))| *peer == gone).map(|(n, _)| *n).collect();
        for number in failed {
            let (asker, correlation, peer) = self.introductions.remove(&number).expect("just found");
            self.links.get_mut(&LinkNumber(number)).expect("made before").close(asker);
            self.node_tells(outcome(peer, asker, correlation, Outcome::Failed));
        }
    }

    pub(super) fn revive(&mut self, at: usize) {
        if !self.apps[at].alive {
            // What the node had given to the life before was closed with it.
            self.links.values_mut().for_each(|link| link.close(tid(at)));
            self.lives += 1;
            self.apps[at] = App::new(tid(at), self.lives);
        }
    }

    /// The node's LNCL ends and comes back. Everybody reads what it had written, and connects again.
    pub(super) fn restart_node(&mut self) {
        self.nodes_restarted = true;
        for (number, (asker, _, _)) in std::mem::take(&mut self.introductions) {
            self.links.get_mut(&LinkNumber(number)).expect("made before").close(asker);
        }
        let now = self.now;
        for at in 0..APPS {
            self.apps[at].queue = ClassQueue::new(QUEUE);
            while !self.apps[at].from_node.is_empty() {
                self.look_at_node(at);
            }
        }
        for app in &mut self.apps {
            app.to_node.clear();
            app.routes.node_has_ended(now);
            // What went through the node has no outcome any more.
            let through: Vec<_> =
                app.pending.iter().filter(|(_, link)| link.is_none()).map(|(n, _)| *n).collect();
            for correlation in through {
                app.pending.remove(&correlation);
                assert!(self.ended.insert((app.life, correlation)), "a message has ended twice");
            }
        }
    }
}
