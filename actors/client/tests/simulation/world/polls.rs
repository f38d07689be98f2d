//! The polls of an application: of the node, of its links, and for ended peers.

use super::*;

impl World {
    /// An application polls the node's messages for it.
    pub(super) fn poll_node(&mut self, at: usize) {
        let Some(message) = self.apps[at].from_node.pop_front() else { return };
        let Header { kind, source, class, correlation, flags, .. } = message.header;
        match kind {
            Kind::OUTCOME => self.take_outcome(at, &message),
            Kind::LNCL_INTRODUCTION => self.take_introduction(at, source, number_of(&message)),
            Kind::LNCL_INTRODUCED => self.take_introduced(at, source, number_of(&message), correlation),
            Kind::LNCL_SWITCH => {
                let number = number_of(&message);
                let confirm = flags.has(Flags::CONFIRM).then_some(correlation);
                let answer = match self.apps[at].routes.on_mark(source, number, class, confirm) {
                    MarkEffect::Wait => None,
                    MarkEffect::Connect { confirm } => {
                        assert!(self.other_end(number, tid(at)).offered, "it is offered before the SWITCH");
                        self.apps[at].making.push_back(Making::Accept { peer: source, number, confirm });
                        None
                    }
                    MarkEffect::Open { confirm } => confirm.map(|number| (number, Outcome::Delivered)),
                    MarkEffect::Known => confirm.map(|number| (number, Outcome::Delivered)),
                    MarkEffect::Unknown => {
                        confirm.map(|number| (number, Outcome::Rejected(Rejection::Unsupported)))
                    }
                };
                if let Some((number, answer)) = answer {
                    self.settle_through_node(at, source, number, answer);
                }
            }
            _ => self.take_from_node(at, message),
        }
    }

    pub(super) fn settle_through_node(&mut self, at: usize, about: Tid, correlation: u64, answer: Outcome) {
        let own = self.apps[at].tid;
        self.apps[at].to_node.push_back(outcome(own, about, correlation, answer));
    }

    pub(super) fn take_outcome(&mut self, at: usize, message: &Message) {
        let (correlation, now) = (message.header.correlation, self.now);
        let app = &mut self.apps[at];
        if app.pending.remove(&correlation).is_some() {
            let is_new = self.ended.insert((app.incarnation, correlation));
            assert!(is_new, "a message has ended twice");
            return;
        }
        match app.routes.on_outcome(correlation, outcome_of(message), now) {
            OutcomeEffect::Noted | OutcomeEffect::NotOurs => {}
            OutcomeEffect::End(peer, number) => self.end_link(at, peer, number),
        }
    }

    pub(super) fn take_introduction(&mut self, at: usize, peer: Tid, number: LinkNumber) {
        self.poll_ends(at);
        let own = self.apps[at].tid;
        match self.apps[at].routes.on_introduction(peer) {
            Ok(()) => {
                self.apps[at].routes.offered(peer, number);
                self.apps[at].making.push_back(Making::Offer { number });
            }
            Err(why) => {
                self.links.get_mut(&number).expect("made before").close(own);
                self.answer_introduction(at, number, Outcome::Rejected(why));
            }
        }
    }

    fn answer_introduction(&mut self, at: usize, number: LinkNumber, answer: Outcome) {
        let lncl = Tid::new(NODE, AppAddress::LNCL);
        let answer = outcome(self.apps[at].tid, lncl, number.0, answer);
        self.apps[at].to_node.push_back(answer);
    }

    /// What was made for one link of an application is there.
    pub(super) fn finish_making(&mut self, at: usize) {
        let Some(made) = self.apps[at].making.pop_front() else { return };
        let own = self.apps[at].tid;
        match made {
            Making::Offer { number } => {
                // Unless the link has ended meanwhile.
                if self.end_mut(number, own).here {
                    self.end_mut(number, own).offered = true;
                    self.answer_introduction(at, number, Outcome::Delivered);
                }
            }
            Making::Accept { peer, number, confirm } if self.apps[at].routes.link(peer) == Some(number) => {
                self.end_mut(number, own).connected = true;
                self.connect(at, peer, number);
                if let Some(correlation) = confirm {
                    self.settle_through_node(at, peer, correlation, Outcome::Delivered);
                }
            }
            Making::Connect { peer, number, correlation }
                if self.apps[at].routes.introduced(peer, correlation) =>
            {
                self.end_mut(number, own).offered = true;
                self.end_mut(number, own).connected = true;
                self.connect(at, peer, number);
            }
            Making::Accept { number, .. } | Making::Connect { number, .. } => {
                self.links.get_mut(&number).expect("made before").close(own);
            }
        }
    }

    pub(super) fn take_introduced(&mut self, at: usize, peer: Tid, number: LinkNumber, correlation: u64) {
        let own = self.apps[at].tid;
        let is_wanted = self.apps[at].routes.introduced(peer, correlation);
        let is_offered = self.other_end(number, own).offered && self.other_end(number, own).here;
        if !is_wanted || !is_offered {
            self.links.get_mut(&number).expect("made before").close(own);
            if is_wanted {
                self.apps[at].routes.ended(peer, self.now);
            }
            return;
        }
        self.apps[at].making.push_back(Making::Connect { peer, number, correlation });
    }

    /// As [`send_switch`](Self::send_switch) for a link that is established from now on; sometimes there is
    /// no room for it yet.
    pub(super) fn connect(&mut self, at: usize, peer: Tid, number: LinkNumber) {
        let is_full = self.apps[at].to_node.len() >= PIPE;
        let sent = (!is_full).then(|| self.send_switch(at, peer, number));
        let now = self.now;
        self.apps[at].routes.connected(peer, number, sent, now);
    }

    pub(super) fn send_switch(&mut self, at: usize, peer: Tid, number: LinkNumber) -> u64 {
        let app = &mut self.apps[at];
        let correlation = app.correlate();
        app.to_node.push_back(layer(Kind::LNCL_SWITCH, app.tid, peer, number.0, correlation));
        correlation
    }

    /// An application polls its links: for ended peers, and for messages to repeat.
    pub(super) fn poll_ends(&mut self, at: usize) {
        let own = self.apps[at].tid;
        let now = self.now;
        for peer in (0..APPS).map(tid) {
            let Some(number) = self.apps[at].routes.link(peer) else { continue };
            let is_over = self.apps[at].reordered.iter().any(|(link, _)| *link == number);
            if self.other_end(number, own).here && !is_over {
                continue;
            }
            let is_connected = self.end_mut(number, own).connected;
            let end = self.other_end(number, own);
            let is_something = if is_connected { !end.ring.is_empty() } else { end.offered };
            let unread = if is_something { Unread::Some } else { Unread::None };
            match self.apps[at].routes.on_hang_up(peer, unread, now) {
                HangUpAction::Drain => {
                    while self.poll_link(at, peer) {}
                    self.end_link(at, peer, number);
                }
                HangUpAction::Keep => {}
                HangUpAction::Drop => self.end_link(at, peer, number),
            }
        }
        while let Some((peer, number)) = self.apps[at].routes.switch_due(now) {
            let correlation = self.send_switch(at, peer, number);
            self.apps[at].routes.switched(peer, correlation, now);
        }
    }

    pub(super) fn end_link(&mut self, at: usize, peer: Tid, number: LinkNumber) {
        let app = &mut self.apps[at];
        app.routes.ended(peer, self.now);
        let lost: Vec<_> = app.pending.iter().filter(|(_, link)| **link == Some(number)).collect();
        let lost: Vec<u64> = lost.into_iter().map(|(correlation, _)| *correlation).collect();
        for correlation in lost {
            app.pending.remove(&correlation);
            assert!(self.ended.insert((app.incarnation, correlation)), "a message has ended twice");
        }
        let own = app.tid;
        self.links.get_mut(&number).expect("it was ours").close(own);
        self.take_reordered(at, number);
    }

    /// An application takes one message from a link that it reads; returns whether there was one.
    pub(super) fn poll_link(&mut self, at: usize, peer: Tid) -> bool {
        let app = &self.apps[at];
        let Some(number) = app.routes.link(peer).filter(|_| app.routes.is_open(peer)) else { return false };
        let own = app.tid;
        let Some(message) = self.other_end(number, own).ring.pop_front() else { return false };
        if message.header.kind == Kind::OUTCOME {
            self.take_outcome(at, &message);
        } else {
            self.take(at, &message, Some(number));
        }
        true
    }

    pub(super) fn take_from_node(&mut self, at: usize, message: Message) {
        let Header { source, class, .. } = message.header;
        let now = self.now;
        match self.apps[at].routes.on_node_message(source, class, now) {
            NodeDelivery::Take => self.take(at, &message, None),
            NodeDelivery::AfterLink(number) => self.apps[at].reordered.push_back((number, message)),
        }
    }

    /// An application takes the messages that waited for the end of a link.
    pub(super) fn take_reordered(&mut self, at: usize, ended: LinkNumber) {
        let reordered = std::mem::take(&mut self.apps[at].reordered);
        for (number, message) in reordered {
            if number == ended {
                self.take(at, &message, None);
            } else {
                self.apps[at].reordered.push_back((number, message));
            }
        }
    }

    pub(super) fn take(&mut self, at: usize, message: &Message, link: Option<LinkNumber>) {
        let Header { class, sequence, source, correlation, flags, .. } = message.header;
        let incarnation = incarnation_of(message);
        assert!(
            self.taken.insert((incarnation, sequence)),
            "message {sequence} of incarnation {incarnation} came twice"
        );
        let seen = self.apps[at].seen.entry((source, class)).or_default();
        assert!(
            *seen < (incarnation, sequence),
            "{class:?} {sequence} of incarnation {incarnation} came after {seen:?} of {source}"
        );
        *seen = (incarnation, sequence);
        if !flags.has(Flags::CONFIRM) {
            return;
        }
        let own = self.apps[at].tid;
        let answer = outcome(own, source, correlation, Outcome::Delivered);
        match link {
            Some(number) if self.links[&number].ends[&own].here => {
                self.end_mut(number, own).ring.push_back(answer);
            }
            Some(_) => {}
            None => self.apps[at].to_node.push_back(answer),
        }
    }
}
