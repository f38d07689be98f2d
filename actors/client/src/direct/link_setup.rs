//! The setup of a direct link: LNCL's introductions, the offers of both sides, and the marks by which they
//! switch to the link.

use std::io;

use sinew_shm::{Descriptors, PassError, Received, set_descriptors};

use super::{
    peer_fd::{LocalHalf, PeerSocket, ReceivedCopies},
    *,
};
use crate::routes::{MarkEffect, OutcomeEffect};

/// The unvalidated half of a link that a peer has passed.
struct PeerHalf {
    received: Received,
    copies: ReceivedCopies,
}

impl PeerHalf {
    /// Receives the half. The peer can pass nothing more over `socket` from then on, if the system supports
    /// that.
    fn take(socket: &Arc<UnixStream>) -> Result<Self, ExchangeError> {
        let mut received = Exchange::take(socket).map_err(|error| {
            let is_there = !matches!(
                &error,
                ExchangeError::Pass(PassError::System(cause)) if cause.kind() == io::ErrorKind::WouldBlock
            );
            if is_there { error } else { ExchangeError::Missing }
        })?;
        let _ = set_descriptors(socket, Descriptors::Refused);
        let copies = ReceivedCopies::of(&mut received, socket);
        let theirs = Self { received, copies };
        if descriptors::holds_data(socket) { Err(ExchangeError::Stray) } else { Ok(theirs) }
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
            Kind::LNCL_SWITCH => self.on_mark(&message, now, node),
            Kind::LNCL_GONE => self.on_gone(&message),
            Kind::OUTCOME => return self.on_outcome(message, now),
            // Not an enum of this crate: an open set of numbers.
            _ => return Some(message),
        }
        None
    }

    /// Handles the request of another endpoint for a link.
    fn on_introduction(&mut self, message: &Message, now: Time, node: &NodeWriter<'_>) {
        let Ok(Introduction { peer, number, pid: _ }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        // Taken in any case: each end that is left fills the socket, which has room for few.
        let end = self.take_end(number);
        // A new incarnation of the peer may request a link before the end of the former one was noticed.
        self.check_hang_ups(now);
        let offered = self.routes.on_introduction(peer).and_then(|()| self.offer(peer, number, end));
        let outcome = offered.map_or_else(Outcome::Rejected, |()| Outcome::Delivered);
        node.answer(self.terms.own, message.header.source, message.header.correlation, outcome);
    }

    fn offer(&mut self, peer: Tid, number: LinkNumber, end: Option<PeerSocket>) -> Result<(), Rejection> {
        let socket = end.ok_or(Rejection::QueueFull)?;
        if !self.has_room() {
            return Err(Rejection::Unsupported);
        }
        let (half, share) = self.prepare(&socket).map_err(|why| {
            sinew_runtime::log::here!(warn: %peer, %why, "a direct link was not made");
            Rejection::QueueFull
        })?;
        self.routes.offered(peer, number);
        self.offered.push(Offered { peer, number, socket, half, share });
        Ok(())
    }

    fn prepare(&self, socket: &UnixStream) -> Result<(LocalHalf, Share), ExchangeError> {
        let share = self.terms.budget.take(self.terms.ring_bytes).ok_or(ExchangeError::Budget)?;
        let [own, theirs] = [self.terms.ring_bytes, RING_BYTES_MAX].map(rings::capacity);
        let (exchange, offer) = Exchange::prepare_for(own, self.terms.options.bell.clone(), theirs)?;
        offer.send(socket)?;
        Ok((LocalHalf::new(exchange), share))
    }

    fn take_end(&self, number: LinkNumber) -> Option<PeerSocket> {
        descriptors::take(self.control.as_ref()?, number)
    }

    /// Handles the peer's agreement to a link: establishes the link and switches to it.
    fn on_introduced(&mut self, message: &Message, now: Time, node: &mut NodeWriter<'_>) {
        let Ok(Introduction { peer, number, pid: _ }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        // Taken in any case: dropping an end without another holder closes it.
        let socket = self.take_end(number);
        if !self.routes.introduced(peer, message.header.correlation) {
            return;
        }
        let connected = socket.ok_or(ExchangeError::Missing).and_then(|socket| {
            let theirs = PeerHalf::take(&socket)?;
            let (half, share) = self.prepare(&socket)?;
            self.connect(Offered { peer, number, socket, half, share }, theirs)
        });
        match connected {
            Ok(link) => {
                self.held.push(link);
                let sent = node.ask(self.switch_to(peer, number));
                self.routes.connected(peer, number, sent, now);
            }
            Err(why) => {
                sinew_runtime::log::here!(warn: %peer, %why, "a direct link was not made");
                self.routes.ended(peer, now);
            }
        }
    }

    fn connect(&self, offered: Offered, theirs: PeerHalf) -> Result<EstablishedLink, ExchangeError> {
        // Dropped in the other order: the copies last.
        let PeerHalf { received, copies } = theirs;
        let Offered { peer, number, socket, half, share } = offered;
        let (producer, consumer) = half.join(received.into_offer()?)?;
        copies.release();
        let writer = ring::Writer::new(Arc::clone(&socket), producer, &self.terms.options);
        let pair = Pair { own: self.terms.own, peer, number, socket };
        Ok(EstablishedLink::new(pair, writer, consumer, share, &self.terms))
    }

    pub(super) fn switch_to(&self, peer: Tid, number: LinkNumber) -> Message {
        let switch = Switch { peer: peer.bits(), number: number.0 };
        payload::frame(Kind::LNCL_SWITCH, self.terms.own, payload::lncl_of(peer.node), &switch)
    }

    /// Handles the mark of a peer's SWITCH.
    fn on_mark(&mut self, message: &Message, now: Time, node: &mut NodeWriter<'_>) {
        let Ok(Switch { peer, number }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        let header = &message.header;
        let confirm = header.flags.has(Flags::CONFIRM).then_some(header.correlation);
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
                let connected = self.connect_offered(peer, number, now, node);
                let why = Outcome::Rejected(Rejection::Malformed);
                let outcome = if connected { Outcome::Delivered } else { why };
                confirm.map(|correlation| (correlation, outcome))
            }
        };
        if let Some((correlation, outcome)) = answer {
            node.answer(self.terms.own, header.source, correlation, outcome);
        }
    }

    /// Establishes the link that the peer has requested, after the peer has switched to it: its offer is
    /// present.
    fn connect_offered(
        &mut self,
        peer: Tid,
        number: LinkNumber,
        now: Time,
        node: &mut NodeWriter<'_>,
    ) -> bool {
        let Some(index) = self.offered.iter().position(|link| link.number == number) else { return false };
        let offered = self.offered.swap_remove(index);
        let theirs = PeerHalf::take(&offered.socket);
        match theirs.and_then(|theirs| self.connect(offered, theirs)) {
            Ok(link) => {
                self.read_from(link);
                let sent = node.ask(self.switch_to(peer, number));
                self.routes.connected(peer, number, sent, now);
                true
            }
            Err(why) => {
                sinew_runtime::log::here!(warn: %peer, %why, "a direct link was not made");
                self.routes.ended(peer, now);
                false
            }
        }
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
        let offered = self.offered.iter().map(|link| (link.number, &link.socket));
        if let Some((_, socket)) = established.chain(offered).find(|(found, _)| *found == number) {
            hang_up(socket);
            self.next_check = Time::ZERO;
        }
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

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::{os::fd::AsFd, sync::mpsc::sync_channel};

    use rustix::io::Errno;
    use sinew_shm::{BellKind, OFFER_BYTES};

    use super::*;
    use sinew_lncl::{
        slow_close::{self, SlowClose},
        testing::WATCHDOG,
    };

    #[test]
    fn receiver_does_not_close_descriptor_passed_as_offer() {
        // Given: a peer that passes a descriptor with a blocking close, and keeps no copy.
        let (ours, theirs) = UnixStream::pair().unwrap();
        ours.set_nonblocking(true).unwrap();
        let mut slow = SlowClose::new();
        let passed = slow.ours.take().expect("it is passed once");
        slow_close::pass(&theirs, &[0; OFFER_BYTES], passed).unwrap();
        // When: it is taken and refused.
        let (report, reported) = sync_channel(1);
        std::thread::spawn(move || {
            let ours = Arc::new(ours);
            let PeerHalf { received, copies } = PeerHalf::take(&ours).map_err(|why| why.to_string()).unwrap();
            let is_refused = received.into_offer().is_err();
            drop(copies);
            // The test has ended if this comes too late.
            let _ = report.send(is_refused);
        });
        // Then:
        assert_eq!(reported.recv_timeout(WATCHDOG), Ok(true));
        slow.release();
    }

    /// Sends the offer of a ring, with its descriptors.
    fn offer_to(socket: &UnixStream) {
        let (_, offer) = Exchange::prepare(rings::capacity(4_096), BellKind::Futex).expect("a ring");
        offer.send(socket).expect("it comes");
    }

    fn pass(socket: &UnixStream, descriptor: impl AsFd) -> Result<usize, Errno> {
        slow_close::pass(socket, &[1], descriptor)
    }

    // spec: LNCL-18
    #[test]
    fn descriptor_after_offer_is_refused() {
        // Given: two peers with offers; one of them passes an additional descriptor.
        let [(ours, theirs), (stray_ours, stray_theirs)] = [(); 2].map(|()| UnixStream::pair().unwrap());
        for socket in [&theirs, &stray_theirs] {
            offer_to(socket);
        }
        pass(&stray_theirs, &ours).unwrap();
        // Then: a descriptor that is already there ends the meeting, and a later one is refused if the system
        // can do that.
        assert!(matches!(PeerHalf::take(&Arc::new(stray_ours)), Err(ExchangeError::Stray)));
        let is_supported = set_descriptors(&ours, Descriptors::Taken).is_ok();
        let ours = Arc::new(ours);
        PeerHalf::take(&ours).map_err(|why| why.to_string()).unwrap().copies.release();
        assert_eq!(pass(&theirs, &theirs).err(), is_supported.then_some(Errno::PERM));
    }
}
