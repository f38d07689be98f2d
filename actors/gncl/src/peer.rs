//! Another node for the senders of this one: its sessions, which outlive connections and restarts of this layer.

mod incarnations;
mod store;

use std::{
    hash::{BuildHasher as _, RandomState},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    task::Waker,
};

use sinew_model::{periodic_checks::PeriodicChecks, undelivered::Report};
use sinew_runtime::{
    lock,
    outcome::{MemberReport, Outcome, ReceiptSink, Rejection, Ticket},
    router::{MessageSink, SubmitError},
    tid::{Incarnation, NodeAddress},
    time::Time,
    wire::{Class, Kind, Message},
};
use sinew_session::{
    counts::Account,
    outlet::{OutcomeRun, OutletAccount, OutletCounts},
};
use tokio::sync::Notify;

use super::{
    core::{Attach, Lane, write},
    datagrams::{Channel, Position},
    frame::frame,
    outstanding::OutstandingDestinations,
    peer_session::{PeerSession, SessionAccount, SessionNotifiers, SessionParameters},
};
use crate::State;
pub use store::Store;

/// One incarnation of another node, from its first link until it is forgotten.
pub struct Peer {
    pub node: NodeAddress,
    pub incarnation: Incarnation,
    /// The sessions: one per class, or one for all.
    sessions: Vec<PeerSession>,
    /// Whether the peer supports [`CANCEL`](Kind::CANCEL).
    takes_cancels: bool,
    /// Whether the peer accepts [reports](Kind::GNCL_UNDELIVERED).
    takes_reports: bool,
    /// Time of the last read from it, in nanoseconds of the local clock; 0: never.
    last_alive: AtomicU64,
    /// Time at which it announced its departure, in nanoseconds of the local clock; 0: it has not. Its
    /// messages are still accepted.
    has_left: AtomicU64,
    /// Whether it has ended: no further message of it is accepted.
    is_over: AtomicBool,
    /// The datagram channel, if both sides support it.
    channel: Option<Channel>,
    ended_accounts: Arc<Mutex<EndedAccounts>>,
    expiring: Arc<PeriodicChecks>,
    fewer_outstanding: Arc<Notify>,
}

/// Accounts of the messages to and from removed incarnations of peers, in total.
#[derive(Clone, Copy, Debug, Default)]
pub struct EndedAccounts {
    pub sent: Account,
    pub arrived: Account,
}

impl Drop for Peer {
    fn drop(&mut self) {
        let accounts = self.accounts();
        let mut ended_accounts = lock(&self.ended_accounts);
        for SessionAccount { sent, arrived, .. } in accounts {
            ended_accounts.sent = ended_accounts.sent + Account::from(&sent);
            // Messages that still waited for applications end with the peer, and their receipts are settled.
            ended_accounts.arrived = ended_accounts.arrived + Account::from(&arrived).over();
        }
        self.fewer_outstanding.notify_one();
    }
}

impl Peer {
    /// Creates a peer. `now` identifies its receive state: a later peer of the same incarnation has a larger number.
    fn new(now: Time, attach: &Attach, state: &State) -> Self {
        let sessions = if attach.by_class { Lane::ALL.len() } else { 1 };
        let parameters = SessionParameters {
            here: state.ctx.node,
            node: attach.node,
            outcomes_kind: outcomes_kind(attach),
            peer_answers_max: usize::try_from(attach.answers_max).unwrap_or(usize::MAX),
            peer_payload_max: usize::try_from(attach.payload_max).unwrap_or(usize::MAX),
            sessions,
        };
        let Store { refusals, acks, fewer_outstanding, queues_changed, .. } = &state.store;
        let notifiers = SessionNotifiers {
            refusals: refusals.clone(),
            acks: acks.clone(),
            fewer_outstanding: fewer_outstanding.clone(),
            queues_changed: queues_changed.clone(),
        };
        let sessions =
            (0..sessions).map(|_| PeerSession::new(now, parameters, &state.ctx.config, &notifiers)).collect();
        let channel = attach.takes_datagrams.then(|| {
            // The seed comes from the system, so the key cannot be guessed.
            let key = RandomState::new().hash_one(());
            let ends = (state.ctx.node, attach.node);
            let former = state.store.forwarded_numbers(attach.node, attach.incarnation);
            let Store { alarm, segments, refusals, .. } = &state.store;
            Channel::new(now, ends, key, former, (alarm.clone(), segments.clone(), refusals.clone()))
        });
        let (ended_accounts, expiring) = (state.store.ended_accounts.clone(), state.store.expiring.clone());
        let fewer_outstanding = fewer_outstanding.clone();
        let Attach { node, incarnation, takes_cancels, takes_reports, .. } = *attach;
        Self {
            node,
            incarnation,
            sessions,
            takes_cancels,
            takes_reports,
            channel,
            last_alive: AtomicU64::new(0),
            has_left: AtomicU64::new(0),
            is_over: AtomicBool::new(false),
            ended_accounts,
            expiring,
            fewer_outstanding,
        }
    }

    /// Returns its sessions.
    pub fn sessions(&self) -> &[PeerSession] {
        &self.sessions
    }

    /// Returns the session with the messages for connections of this lane.
    pub(super) fn session(&self, lane: Lane) -> Option<&PeerSession> {
        self.sessions.get(lane as usize)
    }

    /// Returns the datagram channel.
    pub(super) const fn channel(&self) -> Option<&Channel> {
        self.channel.as_ref()
    }

    /// Stops sending datagrams: pending values are sent over the connection.
    pub(super) fn retire_datagrams(&self) {
        if let Some(channel) = &self.channel {
            channel.retire(self.session_for(Class::Stream));
        }
    }

    /// Repeats lost datagrams, and acknowledges received ones. Returns when to call this again.
    pub(super) fn tick(&self, now: Time) -> Option<Time> {
        self.channel.as_ref()?.tick(now, self.session_for(Class::Stream))
    }

    /// Closes all sessions: nothing reaches the peer any more, including queued messages.
    fn end(&self, why: Rejection) {
        self.channel.iter().for_each(Channel::end);
        self.sessions.iter().for_each(|session| session.outlet.close(why));
    }

    /// Returns the session of this class.
    fn session_for(&self, class: Class) -> &PeerSession {
        self.sessions.get(class as usize).unwrap_or(&self.sessions[0])
    }

    /// Records that something of this incarnation was read at `now`, so that NDL does not declare it lost for
    /// a while. Called once per batch.
    pub(super) fn mark_alive(&self, now: Time) {
        // SYNC: Relaxed; no other data is published with it, and NDL reads it much later.
        self.last_alive.store(now.as_nanos(), Ordering::Relaxed);
    }

    /// Stops accepting messages of this incarnation.
    fn fence(&self) {
        self.sessions.iter().for_each(PeerSession::fence);
        // SYNC: Release, with the Acquire in `outstanding`: a thread that sees the flag sees the fences.
        if !self.is_over.swap(true, Ordering::Release) {
            self.fewer_outstanding.notify_one();
        }
    }

    /// Returns the applications that may still receive a message of this incarnation, if it has left or ended.
    fn outstanding(&self) -> OutstandingDestinations {
        // SYNC: Acquire, see `fence`.
        if self.is_over.load(Ordering::Acquire) {
            return self
                .sessions
                .iter()
                .map(PeerSession::outstanding)
                .fold(OutstandingDestinations::NONE, OutstandingDestinations::union);
        }
        if self.has_left() { OutstandingDestinations::All } else { OutstandingDestinations::NONE }
    }

    /// Whether it has announced its departure.
    pub(super) fn has_left(&self) -> bool {
        // SYNC: Relaxed; an independent flag.
        self.has_left.load(Ordering::Relaxed) != 0
    }

    /// Requests expiry checks, because sent messages wait here again.
    pub(super) fn request_expiry_checks(&self) {
        self.expiring.request();
    }

    /// Reports messages of its applications that were refused here. Without a connection the report is
    /// dropped. spec: GNCL-20
    pub fn report_undelivered(&self, here: NodeAddress, report: &Report) {
        if self.takes_reports {
            let report = frame(here, self.node, Kind::GNCL_UNDELIVERED, write(report));
            self.session_for(Class::Control).send_urgent(report);
        }
    }

    /// Cuts every connection.
    pub(super) fn cut(&self) {
        self.sessions.iter().for_each(|session| session.outlet.cut());
    }

    /// Returns the number of messages for it that are not known to have arrived.
    pub(super) fn left(&self) -> usize {
        let by_datagram = self.channel.as_ref().map_or(0, Channel::left);
        by_datagram + self.sessions.iter().map(|session| session.outlet.left()).sum::<usize>()
    }

    /// Returns the number of application messages among [`left`](Self::left).
    pub(super) fn left_of_applications(&self) -> usize {
        let by_datagram = self.channel.as_ref().map_or(0, Channel::left);
        by_datagram + self.sessions.iter().map(|session| session.outlet.left_of_applications()).sum::<usize>()
    }

    /// Closes all sessions, because this node stops.
    pub(super) fn close(&self) {
        self.end(Rejection::Closed);
    }

    /// Processes the peer's outcomes of these messages. Runs with messages that are not pending stay in `outcomes`.
    pub(super) fn confirm(&self, outcomes: &mut Vec<OutcomeRun>) {
        // A ticket does not name the class.
        self.sessions.iter().for_each(|session| session.outlet.confirm_all(outcomes));
    }

    /// Returns where every message to it and from it is, per session.
    pub fn accounts(&self) -> Vec<SessionAccount> {
        let mut accounts: Vec<_> = self.sessions.iter().map(PeerSession::account).collect();
        if let Some(channel) = &self.channel
            && let Some(account) = accounts.get_mut(Class::Stream as usize)
        {
            account.sent = with_datagrams(account.sent, &channel.position());
        }
        accounts
    }

    /// Returns the counters of the messages to it.
    pub fn counts(&self) -> OutletCounts {
        let by_datagram = self.channel.as_ref().map(|channel| channel.position().counts);
        let by_datagram = by_datagram.map(|counts| OutletCounts {
            sent: counts.sent,
            superseded: counts.superseded,
            expired: counts.expired,
            lost: counts.lost,
            refused: 0,
        });
        let first = by_datagram.unwrap_or_default();
        self.sessions.iter().fold(first, |sum, session| sum + session.outlet.counts())
    }

    /// Returns the number of messages that wait to be sent to it.
    pub fn waiting(&self) -> usize {
        let by_datagram = self.channel.as_ref().map_or(0, |channel| channel.position().waiting as usize);
        by_datagram + self.sessions.iter().map(|session| session.outlet.waiting()).sum::<usize>()
    }

    /// Returns the number of confirmed messages to it without a known outcome.
    pub fn unconfirmed(&self) -> usize {
        self.sessions.iter().map(|session| session.outlet.unconfirmed()).sum()
    }
}

impl MessageSink for Peer {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        // A sender that was notified of the loss must not have a message accepted without any report of its
        // fate. GNCL is notified at the same time, and may act later. SYNC: Acquire, see `fence`.
        if self.is_over.load(Ordering::Acquire) {
            return Err(SubmitError::new(message, Rejection::NoSuchNode));
        }
        let has_a_time = message.header.time_to_live_us != 0 || message.receipt.is_some();
        let session = self.session_for(message.header.class);
        match &self.channel {
            Some(channel) if message.header.class == Class::Stream => channel.submit(message, session)?,
            Some(_) | None => session.outlet.submit(message)?,
        }
        if has_a_time {
            self.expiring.request();
        }
        Ok(())
    }

    /// A value of class Stream waits for no room: a newer one takes its place.
    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), SubmitError> {
        if message.header.class == Class::Stream {
            return self.submit(message);
        }
        // SYNC: as in `submit`.
        if self.is_over.load(Ordering::Acquire) {
            return Err(SubmitError::new(message, Rejection::NoSuchNode));
        }
        let has_a_time = message.header.time_to_live_us != 0 || message.receipt.is_some();
        self.session_for(message.header.class).outlet.offer(message, room)?;
        if has_a_time {
            self.expiring.request();
        }
        Ok(())
    }

    /// Cancels a request. Requests are of class Control, and so is CANCEL, which therefore follows them. spec: GNCL-15
    fn cancel(&self, ticket: Ticket) -> bool {
        let outlet = &self.session_for(Class::Control).outlet;
        if outlet.cancel(ticket) {
            return true;
        }
        let mut cancel = Message::cancel(ticket);
        cancel.header.sent = Time::now();
        // If the queue is full, the request expires by its time to live.
        self.takes_cancels && outlet.submit(cancel).is_ok()
    }
}

/// Sends the outcome of a message from this peer back to it. spec: GNCL-12
impl ReceiptSink for Peer {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        self.session_for(Class::Control).report_outcome(ticket, outcome);
    }

    /// Sends reports about members of this node back to it. spec: FRAME-7
    fn members(&self, ticket: Ticket, reports: &[MemberReport]) {
        let session = self.session_for(Class::Control);
        for mut frame in Message::members(ticket, reports, session.payload_max()) {
            frame.header.sent = Time::now();
            session.send_reports(frame);
        }
    }
}

/// Returns the kind of a frame with several outcomes that the peer accepts; of two the shorter one. spec: GNCL-17
const fn outcomes_kind(attach: &Attach) -> Option<Kind> {
    if attach.takes_outcome_runs {
        Some(Kind::GNCL_OUTCOME_RUNS)
    } else if attach.takes_outcomes {
        Some(Kind::GNCL_OUTCOMES)
    } else {
        None
    }
}

/// Returns the account of a session, including the values sent by datagram.
fn with_datagrams(session: OutletAccount, datagrams: &Position) -> OutletAccount {
    OutletAccount {
        taken: session.taken + datagrams.taken(),
        arrived: session.arrived + datagrams.arrived,
        superseded: session.superseded + datagrams.superseded(),
        expired: session.expired + datagrams.expired(),
        lost: session.lost + datagrams.counts.lost,
        unknown: session.unknown + datagrams.unknown(),
        waiting: session.waiting + datagrams.waiting,
        unacknowledged: session.unacknowledged + datagrams.unacknowledged,
        ..session
    }
}
