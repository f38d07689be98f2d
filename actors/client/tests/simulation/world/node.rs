//! The node of the small world: its queues, its LNCL, and its notifications.

use super::*;

impl World {
    /// The node reads one frame of an application.
    pub(super) fn node_reads(&mut self, from: usize) {
        let Some(message) = self.apps[from].to_node.pop_front() else { return };
        let Header { kind, source, destination, correlation, .. } = message.header;
        match kind {
            Kind::LNCL_INTRODUCE => self.introduce(source, destination, correlation),
            Kind::LNCL_SWITCH => {
                for class in [Class::Control, Class::Stream, Class::Bulk] {
                    let mut mark = layer(kind, source, destination, number_of(&message).0, correlation);
                    mark.header.class = class;
                    if class == Class::Bulk {
                        mark.header.flags = Flags::CONFIRM;
                    }
                    self.node_forwards(mark);
                }
            }
            Kind::OUTCOME => self.node_settles(&message),
            _ => self.node_forwards(message),
        }
    }

    /// The node puts a message into its queue for the destination, or refuses it.
    pub(super) fn node_forwards(&mut self, message: Message) {
        let destination = index_of(message.header.destination);
        if !self.apps[destination].alive {
            return self.refuse(message, Rejection::NoSuchApplication);
        }
        let queue = &mut self.apps[destination].queue;
        if message.header.kind == Kind::LNCL_SWITCH {
            return queue.push_beyond(message);
        }
        match queue.push(message) {
            Ok(None) => {}
            Ok(Some(older)) => self.note_superseded(&older),
            Err(refused) => self.refuse(refused.message, refused.why),
        }
    }

    pub(super) fn note_superseded(&mut self, older: &Message) {
        if older.header.kind.is_user() {
            self.superseded.insert((incarnation_of(older), older.header.sequence));
        }
    }

    pub(super) fn refuse(&mut self, message: Message, why: Rejection) {
        let Header { kind, source, destination, correlation, flags, .. } = message.header;
        if kind.is_user() {
            self.sent.remove(&(incarnation_of(&message), message.header.sequence));
        }
        if flags.has(Flags::CONFIRM) && self.apps[index_of(source)].is_incarnation_of(&message) {
            self.node_notifies(outcome(destination, source, correlation, Outcome::Rejected(why)));
        }
    }

    /// Outcomes and the like go ahead of the bounded queue, so that this test need not lose them.
    pub(super) fn node_notifies(&mut self, message: Message) {
        let to = index_of(message.header.destination);
        self.apps[to].from_node.push_back(message);
    }

    pub(super) fn introduce(&mut self, source: Tid, destination: Tid, correlation: u64) {
        if !self.apps[index_of(destination)].alive {
            let absent = Outcome::Rejected(Rejection::NoSuchApplication);
            return self.node_notifies(outcome(destination, source, correlation, absent));
        }
        self.numbers += 1;
        let number = self.numbers;
        let ends =
            BTreeMap::from([source, destination].map(|tid| (tid, End { here: true, ..End::default() })));
        self.links.insert(LinkNumber(number), Link { ends });
        self.introductions.insert(number, (source, correlation, destination));
        self.node_notifies(layer(Kind::LNCL_INTRODUCTION, source, destination, number, number));
    }

    pub(super) fn node_settles(&mut self, message: &Message) {
        let Header { source, destination, correlation, .. } = message.header;
        if destination.app != AppAddress::LNCL {
            return self.node_notifies(message.clone_for_test());
        }
        let Some((requester, requested_as, peer)) = self.introductions.remove(&correlation) else { return };
        assert_eq!(peer, source);
        let answer = outcome_of(message);
        if answer == Outcome::Delivered {
            return self.node_notifies(layer(
                Kind::LNCL_INTRODUCED,
                peer,
                requester,
                correlation,
                requested_as,
            ));
        }
        self.links.get_mut(&LinkNumber(correlation)).expect("made before").close(requester);
        self.node_notifies(outcome(peer, requester, requested_as, answer));
    }

    /// The node writes one message into an application's ring.
    pub(super) fn node_writes(&mut self, to: usize) {
        let app = &mut self.apps[to];
        if app.from_node.len() < PIPE
            && let Some(message) = app.queue.pop()
        {
            app.from_node.push_back(message);
        }
    }
}
