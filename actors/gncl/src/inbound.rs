//! Checks of a peer's frame before it becomes a message of this node. spec: GNCL-11

use std::{
    cell::{Cell, RefCell},
    sync::Arc,
};

use sinew_model::{clocks::ClockConversion, undelivered::Report};
use sinew_runtime::{
    outcome::{MemberReport, Outcome, Receipt, Rejection, Ticket},
    router::SubmitError,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wakes,
    wire::{Checksum, Class, Flags, Header, Kind, Message},
};
use sinew_session::{
    Ack,
    outlet::{LinkNumber, OUTCOMES_MAX, OutcomeRun, backlog_key, read_outcomes},
};

use super::{
    core::{Lane, RefusalError, read},
    datagrams::{Announcement, Freshness},
    peer::Peer,
    peer_session::{Admission, FramesBehind, PeerSession, ProcessingGuard},
    receive_counters::Disposition,
    spin::Spin,
};
use crate::State;

/// Maximum number of outcomes that are settled together, not counting those of one frame.
const OUTCOMES_BATCH_MAX: usize = 1_024;

/// The receive path for the frames of one peer.
pub(super) struct Inbound {
    pub(super) state: Arc<State>,
    pub(super) peer: Arc<Peer>,
    pub(super) spin: Arc<Spin>,
    /// The lane of the connection.
    pub(super) lane: Lane,
    /// The connection on which the frames arrive.
    pub(super) link: LinkNumber,
    /// The checksum of the frames.
    pub(super) checksum: Checksum,
    /// Outcomes that the peer reported in this [`Batch`] and that are not settled yet: at most
    /// [`OUTCOMES_BATCH_MAX`] and those of one frame.
    pub(super) outcomes: RefCell<PendingOutcomes>,
    /// The conversion of the peer's times, once a message of this [`Batch`] has needed it.
    pub(super) conversion: Cell<Option<Conversion>>,
    /// The disposition of the last message of this [`Batch`], recorded with the next message or at the end.
    pub(super) former: Cell<Option<Disposition>>,
}

/// Outcomes that are settled together.
#[derive(Default)]
pub(super) struct PendingOutcomes {
    runs: Vec<OutcomeRun>,
    /// The number of their messages.
    messages: usize,
}

impl PendingOutcomes {
    /// Adds outcomes, to those right before them if they can be one run.
    fn add(&mut self, run: OutcomeRun) {
        self.messages += run.len();
        if !self.runs.last_mut().is_some_and(|last| last.extend(&run)) {
            self.runs.push(run);
        }
    }
}

/// A conversion of the peer's times, for messages that are received at this time. `None` if the peer's clock is not
/// measured.
pub(super) type Conversion = (Time, Option<ClockConversion>);

/// Frames that were read together. At its end, or at a panic, the received outcomes are settled and an ACK is
/// sent if that is due. Then the receivers of messages are woken.
pub(super) struct Batch<'a> {
    inbound: &'a Inbound,
    /// The frames behind it.
    pub(super) behind: FramesBehind,
    _wakes: wakes::Batch,
}

impl Drop for Batch<'_> {
    fn drop(&mut self) {
        self.inbound.settle_outcomes();
        if let Some(session) = self.inbound.peer.session(self.inbound.lane) {
            if let Some(disposition) = self.inbound.former.take() {
                session.finish(disposition);
            }
            session.acknowledge_if_due(self.behind);
        }
    }
}

impl Inbound {
    /// Starts a batch: frames that were read together at `now` are [received](Self::receive) while it exists.
    pub(super) fn batch(&self, now: Time, behind: FramesBehind) -> Batch<'_> {
        self.peer.mark_alive(now);
        self.conversion.set(None);
        Batch { inbound: self, behind, _wakes: wakes::Batch::begin() }
    }

    /// Processes a frame of a [`Batch`] received at `now`, if it has the next number: delivers it, settles it, or
    /// refuses and counts it.
    ///
    /// # Errors
    /// The peer violates the protocol: the frame does not have the next number, or is an invalid acknowledgement.
    pub(super) fn receive(&self, now: Time, message: Message) -> Result<(), RefusalError> {
        let Some(session) = self.peer.session(self.lane) else { return Ok(()) };
        if let Some(channel) = self.peer.channel() {
            channel.on_frame(now);
        }
        if is_for_the_link(&message, Kind::GNCL_ACK) {
            let ack: Ack = read(&message.payload)?;
            session.on_ack(self.link, &ack, now);
            if !ack.held.is_empty() {
                self.peer.request_expiry_checks();
            }
            return Ok(());
        }
        if is_for_the_link(&message, Kind::GNCL_DATAGRAMS) {
            return self.datagrams_announced(now, &message, session);
        }
        if is_for_the_link(&message, Kind::GNCL_UNDELIVERED) {
            // spec: GNCL-20
            let report: Report = read(&message.payload)?;
            let refusals = &self.state.store.refusals;
            let mut refuse = |detail: &dyn std::fmt::Display| {
                refusals.count(now, "report of another node's messages", detail);
            };
            if let Some(applications) = self.state.ctx.ports.applications() {
                applications.undelivered_elsewhere(self.peer.node, report, &mut refuse);
            }
            return Ok(());
        }
        // The message is counted first: if its handling panics, it must not arrive again.
        let admission = session.on_message(self.link, &message, self.former.take())?;
        self.spin.on_message(now);
        if admission == Admission::Drop {
            return Ok(());
        }
        let guard = session.processing_guard();
        let disposition = if is_for_the_link(&message, Kind::GNCL_VOID) {
            Some(Disposition::Void)
        } else if is_for_the_link(&message, Kind::GNCL_OUTCOMES)
            || is_for_the_link(&message, Kind::GNCL_OUTCOME_RUNS)
        {
            self.on_outcomes(now, &message)?;
            Some(Disposition::Consumed)
        } else {
            self.process(now, message, session, admission)
        };
        if disposition.is_some() {
            self.former.set(disposition);
            guard.defer();
        } else {
            guard.release();
        }
        Ok(())
    }

    /// Processes the peer's datagram address. An announcement on a replaced connection is outdated, and about
    /// another address. spec: DATAGRAM-2
    fn datagrams_announced(
        &self,
        now: Time,
        message: &Message,
        session: &PeerSession,
    ) -> Result<(), RefusalError> {
        if self.lane != Lane::Stream {
            return Err(RefusalError::Violation("DATAGRAMS came where none belongs".to_owned()));
        }
        let announcement: Announcement = read(&message.payload)?;
        if let Some(channel) = self.peer.channel()
            && session.is_current_link(self.link)
        {
            channel.announced(now, announcement, session);
        }
        Ok(())
    }

    /// Processes a value received by datagram at `now`. It is newer than all earlier values of its flow, and
    /// is counted in `guard`.
    pub(super) fn receive_datagram(
        &self,
        now: Time,
        message: Message,
        session: &PeerSession,
        guard: ProcessingGuard<'_>,
    ) {
        self.spin.on_message(now);
        self.conversion.set(None);
        match self.process(now, message, session, Admission::Deliver) {
            Some(disposition) => guard.finish(disposition),
            None => guard.release(),
        }
    }

    /// Sends the ACK that is due, as nothing more has arrived.
    pub(super) fn acknowledge_if_due(&self) {
        if let Some(session) = self.peer.session(self.lane) {
            session.acknowledge_if_due(FramesBehind::None);
        }
    }

    /// Sends an ACK, if received messages are not acknowledged yet.
    pub(super) fn acknowledge(&self) {
        if let Some(session) = self.peer.session(self.lane) {
            session.acknowledge_pending();
        }
    }

    /// Processes a message. Returns its disposition; `None`: it waits for its application.
    fn process(
        &self,
        now: Time,
        mut message: Message,
        session: &PeerSession,
        admission: Admission,
    ) -> Option<Disposition> {
        let header = message.header;
        if header.source.node != self.peer.node {
            // No outcome is sent, because the named source has not sent the message.
            self.count(now, "forged source", &message);
            return Some(Disposition::Refused);
        }
        if header.class == Class::Stream
            && let Some(channel) = self.peer.channel()
            && channel.on_connection_value(&mut message.header) == Freshness::Old
        {
            return Some(Disposition::Superseded);
        }
        if header.flags.has(Flags::OUTCOME) && header.kind == Kind::MEMBERS {
            self.members(now, &message);
            return Some(Disposition::Consumed);
        }
        if header.flags.has(Flags::OUTCOME) {
            self.outcome(now, &message);
            return Some(Disposition::Consumed);
        }
        if header.kind == Kind::CANCEL {
            self.cancel(session, message.ticket());
            return Some(Disposition::Consumed);
        }
        self.attach_receipt(&mut message);
        if !header.kind.is_user() && !header.destination.app.is_layer() {
            // An application would take this message for one of its own node's layers.
            self.count(now, "a layer's words for an application", &message);
            message.reject(Rejection::Unsupported);
            return Some(Disposition::Refused);
        }
        if header.destination.node != self.state.ctx.node && header.destination.node != NodeAddress::ALL {
            self.count(now, "not for this node", &message);
            message.reject(Rejection::NoSuchNode);
            return Some(Disposition::Refused);
        }
        if message.receipt.is_some() && header.class == Class::Stream {
            self.count(now, "unconfirmable", &message);
            message.reject(Rejection::Unsupported);
            return Some(Disposition::Refused);
        }
        self.convert_to_local_clock(now, &mut message.header);
        if message.header.is_expired(now) {
            message.settle(Outcome::Expired);
            return Some(Disposition::Expired);
        }
        match (admission, backlog_key(&message.header)) {
            (Admission::Enqueue(queue), _) => self.enqueue(session, queue, message),
            (_, Some(queue)) if self.state.store.has_earlier_messages(&self.peer, queue) => {
                self.enqueue(session, queue, message)
            }
            (_, Some(queue)) => self.offer(session, queue, message),
            (_, None) => Some(self.deliver(message)),
        }
    }

    /// Delivers a message that never waits in a queue.
    fn deliver(&self, message: Message) -> Disposition {
        let header = message.header;
        let is_consumed_here = !header.destination.is_single()
            || header.destination.app.is_layer()
            || header.flags.has(Flags::REPLY);
        match self.state.ctx.router.deliver(message) {
            Ok(()) if is_consumed_here => Disposition::Consumed,
            Ok(()) => Disposition::Forwarded,
            // The router counts and settles a message that has no receiver.
            Err(_) => Disposition::Refused,
        }
    }

    fn offer(&self, session: &PeerSession, queue: u64, message: Message) -> Option<Disposition> {
        match self.state.ctx.router.offer(message, None) {
            Ok(()) => Some(Disposition::Forwarded),
            Err(SubmitError { message, why: Rejection::QueueFull }) => self.enqueue(session, queue, message),
            Err(refused) => {
                self.state.ctx.router.refuse_arrived(refused);
                Some(Disposition::Refused)
            }
        }
    }

    fn enqueue(&self, session: &PeerSession, queue: u64, message: Message) -> Option<Disposition> {
        match session.enqueue(queue, message) {
            Ok(is_news) => {
                if is_news {
                    // Only destinations that were held before announce that they accept more.
                    self.state.store.queues_changed.notify_one();
                }
                None
            }
            Err(message) => {
                self.state.ctx.router.refuse_arrived(SubmitError::new(message, Rejection::QueueFull));
                Some(Disposition::Refused)
            }
        }
    }

    /// Converts the send time to the local clock, never later than `now`, and sets its error. The error grows
    /// while NDL receives nothing from the peer.
    ///
    /// The clock of this incarnation of the peer may not have been measured, or may have changed since. Then
    /// the time to live counts from `now`, and the receiver is notified that the age is unknown. The clock of
    /// another incarnation is not used, because it may have been on another host.
    fn convert_to_local_clock(&self, now: Time, header: &mut Header) {
        let times = self.conversion_at(now).and_then(|clock| clock.in_our_clock(header.sent));
        header.sent = times.map_or(now, |(sent, _)| sent);
        header.set_sent_error(times.map(|(_, error)| error));
    }

    /// Returns the conversion of the peer's times, looked up once for all messages of a batch.
    fn conversion_at(&self, now: Time) -> Option<ClockConversion> {
        if let Some((at, conversion)) = self.conversion.get()
            && at == now
        {
            return conversion;
        }
        let measured = self.state.ctx.clocks.get(self.peer.node, self.peer.incarnation);
        let conversion = measured.map(|clock| clock.conversion_at(now));
        self.conversion.set(Some((now, conversion)));
        conversion
    }

    /// Attaches a receipt. The outcome of a message to all nodes is reported as from this node. spec: GNCL-12
    fn attach_receipt(&self, message: &mut Message) {
        if message.header.flags.has(Flags::CONFIRM) {
            let mut ticket = message.ticket();
            if ticket.destination.node == NodeAddress::ALL {
                ticket.destination = Tid::new(self.state.ctx.node, ticket.destination.app);
            }
            message.receipt = Some(Receipt::new(self.peer.clone(), ticket));
        }
    }

    /// Cancels a waiting request after its sender has stopped waiting. spec: GNCL-15
    fn cancel(&self, session: &PeerSession, ticket: Ticket) {
        let queue = (Class::Control as u64) << 32 | u64::from(ticket.destination.app.bits());
        if let Some(mut request) = session.cancel_queued(queue, ticket) {
            request.settle(Outcome::Expired);
        } else if ticket.destination.node == self.state.ctx.node {
            self.state.ctx.router.cancel(ticket);
        }
    }

    /// Processes the peer's report about its group members that have copies of a local message. spec: FRAME-7.3
    fn members(&self, now: Time, message: &Message) {
        match MemberReport::decode(&message.payload) {
            Some(reports) => {
                self.state.ctx.router.members_reported(self.peer.node, about(&message.header), &reports);
            }
            None => self.count(now, "no reports about members", message),
        }
    }

    fn outcome(&self, now: Time, message: &Message) {
        let outcome = match message.payload[..] {
            [code] => Outcome::from_code(code),
            _ => None,
        };
        match outcome {
            // An outcome that is not pending any more was settled as Unknown when an earlier connection ended.
            Some(outcome) => {
                self.outcomes.borrow_mut().add(OutcomeRun::new(about(&message.header), 1, outcome));
            }
            None => self.count(now, "no such outcome", message),
        }
    }

    /// Processes several outcomes in one frame; an unknown code affects only its own entry. spec: GNCL-17
    fn on_outcomes(&self, now: Time, message: &Message) -> Result<(), RefusalError> {
        let Header { kind, .. } = message.header;
        let Some(all) = read_outcomes(kind, &message.payload) else {
            let length = message.payload.len();
            return Err(RefusalError::Violation(format!(
                "{length} bytes in a frame of kind {kind} are not outcomes of 1 to {OUTCOMES_MAX} messages"
            )));
        };
        for reported in all {
            match reported.run(self.state.ctx.node, self.peer.node) {
                Some(run) => self.outcomes.borrow_mut().add(run),
                None => self.count(now, "no such outcome", message),
            }
        }
        if self.outcomes.borrow().messages >= OUTCOMES_BATCH_MAX {
            self.settle_outcomes();
        }
        Ok(())
    }

    /// Settles the received outcomes. The notified code finds nothing borrowed here.
    fn settle_outcomes(&self) {
        if self.outcomes.borrow().messages == 0 {
            return;
        }
        let mut runs = self.outcomes.take().runs;
        self.peer.confirm(&mut runs);
        runs.clear();
        self.outcomes.replace(PendingOutcomes { runs, messages: 0 });
    }

    fn count(&self, now: Time, cause: &'static str, message: &Message) {
        let (header, peer) = (&message.header, self.peer.node);
        let detail = format!("node {peer} sent a frame from {} to {}", header.source, header.destination);
        self.state.store.refusals.count(now, cause, &detail);
    }
}

/// Returns the ticket of the local message that an answer is about.
const fn about(answer: &Header) -> Ticket {
    Ticket { source: answer.destination, destination: answer.source, correlation: answer.correlation }
}

/// Whether this message has this kind and is about the connection itself.
fn is_for_the_link(message: &Message, kind: Kind) -> bool {
    message.header.destination.app == AppAddress::GNCL && message.header.kind == kind
}
