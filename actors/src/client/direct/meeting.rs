//! How a link is made: LNCL's introductions, the offers of both sides, and the marks by which they switch to it.

use std::io;

use sinew_shm::{Descriptors, PassError, Received, set_descriptors};

use super::{
    foreign::{Foreign, Half, LinkEnd},
    *,
};

/// What a peer has passed for its half, of which nothing is judged.
struct Theirs {
    received: Received,
    copies: Foreign,
}

impl Theirs {
    /// Takes it. Nothing more may be passed over `socket` from then on, where the system knows that.
    fn take(socket: &Arc<UnixStream>) -> Result<Self, ExchangeError> {
        let mut received = Exchange::take(socket).map_err(|error| {
            let is_there = !matches!(
                &error,
                ExchangeError::Pass(PassError::System(cause)) if cause.kind() == io::ErrorKind::WouldBlock
            );
            if is_there { error } else { ExchangeError::Missing }
        })?;
        let _ = set_descriptors(socket, Descriptors::Refused);
        let copies = Foreign::of(&mut received, socket);
        let theirs = Self { received, copies };
        if descriptors::holds_something(socket) { Err(ExchangeError::Stray) } else { Ok(theirs) }
    }
}

impl Direct {
    /// Does what a frame of the node asks for. Hands it back if it is not about links.
    pub(in crate::client) fn heed(
        &mut self,
        message: Message,
        now: Time,
        node: &mut ToNode<'_>,
    ) -> Option<Message> {
        match message.header.kind {
            Kind::LNCL_INTRODUCTION => self.meet(&message, now, node),
            Kind::LNCL_INTRODUCED => self.go_on(&message, now, node),
            Kind::LNCL_SWITCH => self.mark(&message, now, node),
            Kind::LNCL_GONE => self.gone(&message),
            Kind::OUTCOME => return self.hear(message, now),
            // Not an enum of ours: an open set of numbers.
            _ => return Some(message),
        }
        None
    }

    /// Another one asks for a link.
    fn meet(&mut self, message: &Message, now: Time, node: &ToNode<'_>) {
        let Ok(Introduction { peer, number, pid: _ }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        // Taken in any case: each that is left lies in the socket, which has room for few.
        let end = self.take_end(number);
        // A new life may ask before it was seen that the former one has ended.
        self.see_ends(now);
        let met = self.routes.introduction(peer).and_then(|()| self.offer(peer, number, end));
        let outcome = met.map_or_else(Outcome::Rejected, |()| Outcome::Delivered);
        node.answer(self.terms.own, message.header.source, message.header.correlation, outcome);
    }

    fn offer(&mut self, peer: Tid, number: LinkNumber, end: Option<LinkEnd>) -> Result<(), Rejection> {
        let socket = end.ok_or(Rejection::QueueFull)?;
        if !self.has_room() {
            return Err(Rejection::Unsupported);
        }
        let (half, share) = self.prepare(&socket).map_err(|why| {
            crate::log::here!(warn: %peer, %why, "a direct link was not made");
            Rejection::QueueFull
        })?;
        self.routes.offered(peer, number);
        self.offered.push(Offered { peer, number, socket, half, share });
        Ok(())
    }

    fn prepare(&self, socket: &UnixStream) -> Result<(Half, Share), ExchangeError> {
        let share = self.terms.budget.take(self.terms.ring_bytes).ok_or(ExchangeError::Budget)?;
        let [own, theirs] = [self.terms.ring_bytes, RING_BYTES_MAX].map(rings::capacity);
        let (exchange, offer) = Exchange::prepare_for(own, self.terms.options.bell.clone(), theirs)?;
        offer.send(socket)?;
        Ok((Half::new(exchange), share))
    }

    fn take_end(&self, number: LinkNumber) -> Option<LinkEnd> {
        descriptors::take(self.control.as_ref()?, number)
    }

    /// The other one has agreed to a link: it stands, and is switched to.
    fn go_on(&mut self, message: &Message, now: Time, node: &mut ToNode<'_>) {
        let Ok(Introduction { peer, number, pid: _ }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        // Taken in any case: what nobody holds hangs up.
        let socket = self.take_end(number);
        if !self.routes.introduced(peer, message.header.correlation) {
            return;
        }
        let connected = socket.ok_or(ExchangeError::Missing).and_then(|socket| {
            let theirs = Theirs::take(&socket)?;
            let (half, share) = self.prepare(&socket)?;
            self.connect(Offered { peer, number, socket, half, share }, theirs)
        });
        match connected {
            Ok(link) => {
                self.held.push(link);
                let said = node.ask(self.switch_to(peer, number));
                self.routes.connected(peer, number, said, now);
            }
            Err(why) => {
                crate::log::here!(warn: %peer, %why, "a direct link was not made");
                self.routes.ended(peer, now);
            }
        }
    }

    fn connect(&self, offered: Offered, theirs: Theirs) -> Result<Standing, ExchangeError> {
        // Dropped in the other order: the copies last.
        let Theirs { received, copies } = theirs;
        let Offered { peer, number, socket, half, share } = offered;
        let (producer, consumer) = half.join(received.into_offer()?)?;
        copies.are_good();
        let writer = ring::Writer::new(Arc::clone(&socket), producer, &self.terms.options);
        let pair = Pair { own: self.terms.own, peer, number, socket };
        Ok(Standing::new(pair, writer, consumer, share, self.terms.payload_max))
    }

    pub(super) fn switch_to(&self, peer: Tid, number: LinkNumber) -> Message {
        let switch = Switch { peer: peer.bits(), number: number.0 };
        payload::frame(Kind::LNCL_SWITCH, self.terms.own, payload::lncl_of(peer.node), &switch)
    }

    /// A mark of a peer's SWITCH has come.
    fn mark(&mut self, message: &Message, now: Time, node: &mut ToNode<'_>) {
        let Ok(Switch { peer, number }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        let header = &message.header;
        let confirm = header.flags.has(Flags::CONFIRM).then_some(header.correlation);
        let told = match self.routes.marked(peer, number, header.class, confirm) {
            Marked::Wait => None,
            Marked::Known => confirm.map(|correlation| (correlation, Outcome::Delivered)),
            Marked::Unknown => {
                confirm.map(|correlation| (correlation, Outcome::Rejected(Rejection::Unsupported)))
            }
            Marked::Open { confirm } => {
                let index = self.held.iter().position(|link| link.number == number);
                self.open.extend(index.map(|index| self.held.swap_remove(index)));
                confirm.map(|correlation| (correlation, Outcome::Delivered))
            }
            Marked::Connect { confirm } => {
                let connected = self.connect_offered(peer, number, now, node);
                let why = Outcome::Rejected(Rejection::Malformed);
                let outcome = if connected { Outcome::Delivered } else { why };
                confirm.map(|correlation| (correlation, outcome))
            }
        };
        if let Some((correlation, outcome)) = told {
            node.answer(self.terms.own, header.source, correlation, outcome);
        }
    }

    /// The peer has switched to the link that it had asked for: its offer is there.
    fn connect_offered(&mut self, peer: Tid, number: LinkNumber, now: Time, node: &mut ToNode<'_>) -> bool {
        let Some(index) = self.offered.iter().position(|link| link.number == number) else { return false };
        let offered = self.offered.swap_remove(index);
        let theirs = Theirs::take(&offered.socket);
        match theirs.and_then(|theirs| self.connect(offered, theirs)) {
            Ok(link) => {
                self.open.push(link);
                let said = node.ask(self.switch_to(peer, number));
                self.routes.connected(peer, number, said, now);
                true
            }
            Err(why) => {
                crate::log::here!(warn: %peer, %why, "a direct link was not made");
                self.routes.ended(peer, now);
                false
            }
        }
    }

    /// The peer's process has ended, and perhaps a child of its holds the link's other end: it is as if that hung up.
    fn gone(&mut self, message: &Message) {
        let Ok(Gone { peer, number }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        self.is_dead(peer, number);
        if self.routes.link(peer) != Some(number) {
            return;
        }
        let standing = self.open.iter().chain(&self.held).map(|link| (link.number, &link.socket));
        let offered = self.offered.iter().map(|link| (link.number, &link.socket));
        if let Some((_, socket)) = standing.chain(offered).find(|(found, _)| *found == number) {
            hang_up(socket);
            self.look_at = Time::ZERO;
        }
    }

    fn hear(&mut self, message: Message, now: Time) -> Option<Message> {
        let outcome = message.payload.first().and_then(|code| Outcome::from_code(*code));
        match self.routes.answered(message.header.correlation, outcome.unwrap_or(Outcome::Unknown), now) {
            Answered::NotOurs => return Some(message),
            Answered::Noted => {}
            Answered::End(peer, number) => self.end(peer, number, now),
        }
        None
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::{os::fd::AsFd, sync::mpsc::sync_channel};

    use rustix::io::Errno;
    use sinew_shm::{BellKind, OFFER_BYTES};

    use super::*;
    use crate::{
        lingering::{self, Lingering},
        lncl::testing::WATCHDOG,
    };

    #[test]
    fn what_a_peer_passes_in_place_of_its_offer_is_not_closed_by_who_takes_it() {
        // Given: a peer that passes what does not close, and keeps no copy.
        let (ours, theirs) = UnixStream::pair().unwrap();
        ours.set_nonblocking(true).unwrap();
        let mut lingering = Lingering::new();
        let passed = lingering.ours.take().expect("it is passed once");
        lingering::pass(&theirs, &[0; OFFER_BYTES], passed).unwrap();
        // When: it is taken and refused.
        let (say, said) = sync_channel(1);
        std::thread::spawn(move || {
            let ours = Arc::new(ours);
            let Theirs { received, copies } = Theirs::take(&ours).map_err(|why| why.to_string()).unwrap();
            let is_refused = received.into_offer().is_err();
            drop(copies);
            // The test has ended, where this comes too late.
            let _ = say.send(is_refused);
        });
        // Then:
        assert_eq!(said.recv_timeout(WATCHDOG), Ok(true));
        lingering.let_go();
    }

    /// The offer of a ring, with what else is passed beside it.
    fn offer_to(socket: &UnixStream) {
        let (_, offer) = Exchange::prepare(rings::capacity(4_096), BellKind::Futex).expect("a ring");
        offer.send(socket).expect("it comes");
    }

    fn pass(socket: &UnixStream, descriptor: impl AsFd) -> Result<usize, Errno> {
        lingering::pass(socket, &[1], descriptor)
    }

    // spec: LNCL-18
    #[test]
    fn behind_its_offer_a_peer_passes_nothing() {
        // Given: two that offer, of whom one passes more.
        let [(ours, theirs), (stray_ours, stray_theirs)] = [(); 2].map(|()| UnixStream::pair().unwrap());
        for socket in [&theirs, &stray_theirs] {
            offer_to(socket);
        }
        pass(&stray_theirs, &ours).unwrap();
        // Then: what is there already ends the meeting, and what comes later is refused where the system knows that.
        assert!(matches!(Theirs::take(&Arc::new(stray_ours)), Err(ExchangeError::Stray)));
        let knows = set_descriptors(&ours, Descriptors::Taken).is_ok();
        let ours = Arc::new(ours);
        Theirs::take(&ours).map_err(|why| why.to_string()).unwrap().copies.are_good();
        assert_eq!(pass(&theirs, &theirs).err(), knows.then_some(Errno::PERM));
    }
}
