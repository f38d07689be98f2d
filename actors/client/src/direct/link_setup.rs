//! The setup of a direct link: LNCL's introductions, the offers of both sides, and the marks by which they
//! switch to the link.

use super::{
    link_maker::{Made, Task},
    peer_fd::{LocalHalf, PeerSocket, UnusedRings},
    *,
};
use crate::{
    direct::budget::Share,
    routes::{MarkEffect, OutcomeEffect},
};

/// A link that is being set up.
pub(super) struct LinkSetup {
    pub(super) peer: Tid,
    pub(super) number: LinkNumber,
    pub(super) socket: PeerSocket,
    stage: Stage,
}

/// How far the setup is.
enum Stage {
    /// The peer has asked. This side's half is being made; then LNCL gets its answer.
    Preparing { introduction: Answer },
    /// The peer has this side's half.
    Offered(Box<(LocalHalf, Share)>),
    /// The peer has switched to the link. Its half is being joined with this side's; then its SWITCH is answered.
    Accepting { switch: Option<Answer> },
    /// This side has asked, and the peer has offered its half. Both are being joined.
    Connecting { correlation: u64 },
}

/// The application and the number that an answer is for.
#[derive(Clone, Copy)]
struct Answer {
    to: Tid,
    correlation: u64,
}

impl LinkSetup {
    /// Returns whether the peer has left something to read, should it have ended.
    pub(super) fn has_unread(&self) -> bool {
        match self.stage {
            // Its offer was taken out of the socket, and its ring may hold messages.
            Stage::Accepting { .. } => true,
            Stage::Preparing { .. } | Stage::Offered(_) | Stage::Connecting { .. } => {
                descriptors::holds_data(&self.socket)
            }
        }
    }
}

impl Direct {
    /// Handles a frame of the node about links. Returns the message if it is not about links.
    pub(crate) fn handle_frame(
        &mut self,
        message: Message,
        now: Time,
        node: &mut NodeWriter<'_>,
    ) -> Option<Message> {
        match message.header.kind {
            Kind::LNCL_INTRODUCTION => self.on_introduction(&message, now, node),
            Kind::LNCL_INTRODUCED => self.on_introduced(&message, now, node),
            Kind::LNCL_SWITCH => self.on_mark(&message, node),
            Kind::LNCL_GONE => self.on_gone(&message),
            Kind::LNCL_OBSERVE => self.on_observe(&message),
            Kind::OUTCOME => return self.on_outcome(message, now),
            // Not an enum of this crate: an open set of numbers.
            _ => return Some(message),
        }
        None
    }

    /// From now on no link is made automatically.
    pub(crate) fn keep_to_node(&mut self) {
        self.routes.keep_to_node();
    }

    /// Handles the request of another endpoint for a link.
    fn on_introduction(&mut self, message: &Message, now: Time, node: &NodeWriter<'_>) {
        let Ok(Introduction { peer, number, pid: _ }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        let introduction = Answer { to: message.header.source, correlation: message.header.correlation };
        // Taken in any case: each end that is left fills the socket, which has room for few.
        let end = self.take_end(number);
        // A new incarnation of the peer may request a link before the end of the former one was noticed.
        self.check_hang_ups(now);
        let prepared = self.routes.on_introduction(peer).and_then(|()| {
            let socket = end.ok_or(Rejection::QueueFull)?;
            if !self.has_room() {
                return Err(Rejection::Unsupported);
            }
            let task = Task::Offer(Arc::clone(&socket));
            let submitted = self.tasks.submit(number, task, &self.terms, node.writer);
            submitted.map_err(|_| Rejection::QueueFull)?;
            self.routes.offered(peer, number);
            self.setups.push(LinkSetup { peer, number, socket, stage: Stage::Preparing { introduction } });
            Ok(())
        });
        if let Err(why) = prepared {
            self.answer(introduction, Outcome::Rejected(why), node);
        }
    }

    fn answer(&self, Answer { to, correlation }: Answer, outcome: Outcome, node: &NodeWriter<'_>) {
        node.answer(self.terms.own, to, correlation, outcome);
    }

    fn take_end(&self, number: LinkNumber) -> Option<PeerSocket> {
        descriptors::take(self.control.as_ref()?, number)
    }

    /// Handles the peer's agreement to a link.
    fn on_introduced(&mut self, message: &Message, now: Time, node: &NodeWriter<'_>) {
        let Ok(Introduction { peer, number, pid: _ }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        // Taken in any case: dropping an end without another holder closes it.
        let socket = self.take_end(number);
        let correlation = message.header.correlation;
        if !self.routes.introduced(peer, correlation) {
            return;
        }
        let Some(socket) = socket else {
            self.give_up(peer, &ExchangeError::Missing, now);
            return;
        };
        let task = Task::Connect(Arc::clone(&socket));
        match self.tasks.submit(number, task, &self.terms, node.writer) {
            Ok(()) => {
                self.setups.push(LinkSetup {
                    peer,
                    number,
                    socket,
                    stage: Stage::Connecting { correlation },
                });
            }
            Err(_) => self.give_up(peer, &ExchangeError::Fault, now),
        }
    }

    fn give_up(&mut self, peer: Tid, why: &ExchangeError, now: Time) {
        sinew_runtime::log::here!(warn: %peer, %why, "a direct link was not made");
        self.routes.ended(peer, now);
    }

    /// Continues the setup of links with what was made for them.
    pub(super) fn continue_setups(&mut self, now: Time, node: &mut NodeWriter<'_>) {
        while let Some((number, made)) = self.tasks.next() {
            // Without one the link has ended meanwhile.
            if let Some(index) = self.setups.iter().position(|setup| setup.number == number) {
                let setup = self.setups.swap_remove(index);
                self.continue_setup(setup, made, now, node);
            }
        }
    }

    fn continue_setup(
        &mut self,
        setup: LinkSetup,
        made: Result<Made, ExchangeError>,
        now: Time,
        node: &mut NodeWriter<'_>,
    ) {
        let LinkSetup { peer, number, socket, stage } = setup;
        match (stage, made) {
            (Stage::Preparing { introduction }, Ok(Made::Half(half, share))) => {
                let stage = Stage::Offered(Box::new((half, share)));
                self.setups.push(LinkSetup { peer, number, socket, stage });
                self.answer(introduction, Outcome::Delivered, node);
            }
            (Stage::Preparing { introduction }, Err(why)) => {
                self.give_up(peer, &why, now);
                self.answer(introduction, Outcome::Rejected(Rejection::QueueFull), node);
            }
            (Stage::Accepting { switch }, Ok(Made::Rings(rings, share))) => {
                let link = self.establish(Pair { own: self.terms.own, peer, number, socket }, rings, share);
                self.read_from(link);
                let sent = node.ask(self.switch_to(peer, number));
                self.routes.connected(peer, number, sent, now);
                switch.into_iter().for_each(|switch| self.answer(switch, Outcome::Delivered, node));
            }
            (Stage::Accepting { switch }, Err(why)) => {
                self.give_up(peer, &why, now);
                let outcome = Outcome::Rejected(Rejection::Malformed);
                switch.into_iter().for_each(|switch| self.answer(switch, outcome, node));
            }
            (Stage::Connecting { correlation }, made) if self.routes.introduced(peer, correlation) => {
                match made {
                    Ok(Made::Rings(rings, share)) => {
                        let link =
                            self.establish(Pair { own: self.terms.own, peer, number, socket }, rings, share);
                        self.held.push(link);
                        let sent = node.ask(self.switch_to(peer, number));
                        self.routes.connected(peer, number, sent, now);
                    }
                    Ok(Made::Half(..)) => unreachable!("a link is connected with both rings"),
                    Err(why) => self.give_up(peer, &why, now),
                }
            }
            // Abandoned meanwhile: the peer observes that the socket closes.
            (Stage::Connecting { .. }, _) => {}
            (Stage::Preparing { .. }, Ok(Made::Rings(..)))
            | (Stage::Accepting { .. }, Ok(Made::Half(..)))
            | (Stage::Offered(_), _) => unreachable!("each stage has its own task"),
        }
    }

    fn establish(&mut self, pair: Pair, rings: UnusedRings, share: Share) -> EstablishedLink {
        let (producer, consumer) = rings.take();
        let writer = ring::Writer::new(Arc::clone(&pair.socket), producer, &self.terms.options);
        let account = self.accounts.as_mut().map(|accounts| accounts.begin(pair.peer)).unwrap_or_default();
        let mut link = EstablishedLink::new(pair, writer, consumer, share, &self.terms);
        link.account = account;
        link
    }

    pub(super) fn switch_to(&self, peer: Tid, number: LinkNumber) -> Message {
        let switch = Switch { peer: peer.bits(), number: number.0 };
        payload::frame(Kind::LNCL_SWITCH, self.terms.own, payload::lncl_of(peer.node), &switch)
    }

    /// Handles the mark of a peer's SWITCH.
    fn on_mark(&mut self, message: &Message, node: &NodeWriter<'_>) {
        let Ok(Switch { peer, number }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        let header = &message.header;
        let confirm = header.flags.has(Flags::CONFIRM).then_some(header.correlation);
        let answer_to = |correlation| Answer { to: header.source, correlation };
        let answer = match self.routes.on_mark(peer, number, header.class, confirm) {
            MarkEffect::Wait => None,
            MarkEffect::Known => confirm.map(|correlation| (correlation, Outcome::Delivered)),
            MarkEffect::Unknown => {
                confirm.map(|correlation| (correlation, Outcome::Rejected(Rejection::Unsupported)))
            }
            MarkEffect::Open { confirm } => {
                if let Some(index) = self.held.iter().position(|link| link.number == number) {
                    let link = self.held.swap_remove(index);
                    self.read_from(link);
                }
                confirm.map(|correlation| (correlation, Outcome::Delivered))
            }
            MarkEffect::Connect { confirm } => {
                let is_accepting = self.accept(number, confirm.map(answer_to), node);
                let refused =
                    confirm.map(|correlation| (correlation, Outcome::Rejected(Rejection::Malformed)));
                refused.filter(|_| !is_accepting)
            }
        };
        if let Some((correlation, outcome)) = answer {
            self.answer(answer_to(correlation), outcome, node);
        }
    }

    /// Begins to join both halves of a link to which the peer has switched: its offer is present. Returns whether there
    /// is such a link.
    fn accept(&mut self, number: LinkNumber, switch: Option<Answer>, node: &NodeWriter<'_>) -> bool {
        let Some(setup) = self.setups.iter_mut().find(|setup| setup.number == number) else { return false };
        let before = std::mem::replace(&mut setup.stage, Stage::Accepting { switch });
        let Stage::Offered(half) = before else {
            setup.stage = before;
            return false;
        };
        let task = Task::Accept(Arc::clone(&setup.socket), half);
        // The peer uses the link already, so that it must be joined even if the thread has too much to do.
        if let Err(task) = self.tasks.submit(number, task, &self.terms, node.writer) {
            self.tasks.run_here(number, task, &self.terms);
        }
        true
    }

    /// Handles the end of the peer's process as the close of its link. A child process of the peer may still
    /// hold the link's other end.
    fn on_gone(&mut self, message: &Message) {
        let Ok(Gone { peer, number }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        self.record_peer_end(peer, number);
        if self.routes.link(peer) != Some(number) {
            return;
        }
        let established = self.open.iter().chain(&self.held).map(|link| (link.number, &link.socket));
        let setups = self.setups.iter().map(|link| (link.number, &link.socket));
        if let Some((_, socket)) = established.chain(setups).find(|(found, _)| *found == number) {
            hang_up(socket);
            self.next_check = Time::ZERO;
        }
    }

    fn on_observe(&mut self, message: &Message) {
        let Ok(Observe { on }) = payload::read(&message.payload) else { return };
        self.observer = on.then(|| Observer::new(self.terms.own));
    }

    fn on_outcome(&mut self, message: Message, now: Time) -> Option<Message> {
        let outcome = message.payload.first().and_then(|code| Outcome::from_code(*code));
        match self.routes.on_outcome(message.header.correlation, outcome.unwrap_or(Outcome::Unknown), now) {
            OutcomeEffect::NotOurs => return Some(message),
            OutcomeEffect::Noted => {}
            OutcomeEffect::End(peer, number) => self.end(peer, number, now),
        }
        None
    }
}
