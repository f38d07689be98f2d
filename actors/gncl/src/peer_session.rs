//! One session with a peer: the messages sent to it on the connections of a lane, and those received from it.

mod acks;
mod destination_queues;
mod processing_guard;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use sinew_runtime::{
    outcome::{Outcome, Rejection, Ticket},
    router::SubmitError,
    tid::NodeAddress,
    time::Time,
    wire::{HEADER_LEN, Kind, Message},
};
use sinew_session::{
    Ack, Arrival, BacklogLimits, ReceiveBacklog, ReceivePosition, Receiving, SendPosition, Window,
    counts::Account,
    outlet::{
        Gathering, LinkNumber, OutletAccount, OutletLimits, Session, SocketWriter, backlog_key,
        destination_of,
    },
};
use tokio::sync::Notify;

use super::{
    core::RefusalError,
    frame::frame,
    outstanding::OutstandingDestinations,
    receive_counters::{Disposition, ReceiveCounters},
    transport::Transport,
};
use acks::AckMarks;
pub(super) use acks::FramesBehind;
pub(super) use processing_guard::ProcessingGuard;
use sinew_model::{config::NodeConfig, periodic_checks::PeriodicChecks, refusals::Refusals};

/// Bytes of unacknowledged frames for one peer at which further messages wait.
const WINDOW_BYTES: usize = 4 << 20;
/// Maximum number of unacknowledged messages: half of the range of their 16-bit numbers.
const WINDOW_MESSAGES_MAX: usize = 1 << 15;
/// Minimum of the maximum number of unacknowledged messages: twice as many as are acknowledged at once, so
/// that no sender waits for an acknowledgement.
const WINDOW_MESSAGES_MIN: usize = 64;
/// Maximum number of this layer's own frames that wait for a socket: more than a peer's ACKs, PINGs and PONGs ever are.
const URGENT_FRAMES_MAX: usize = 32;

/// Maximum number of applications for which messages of one session wait because they accept nothing.
/// Messages for a further full application are refused at once. Each ACK names them all, in 9 bytes each: 2.4
/// KiB, less than the limit of this layer's own frames (4,096).
const QUEUES_MAX: usize = 256;
/// Maximum amount that may wait for applications, in windows.
const BACKLOG_WINDOWS: usize = 4;
/// Multiple of `gncl.queue_capacity`: confirmed messages of a peer, per connection, for which there is room
/// for outcomes. It is announced to the peer, because the peer's own capacity may differ.
const ANSWERS_OF_CAPACITY: usize = 8;
/// Minimum of that number: a node with a short queue refuses nothing of a peer with the defaults.
const ANSWERS_MIN: usize = 8_192;

/// Returns the number of confirmed messages of a peer, per connection, for which there is room for outcomes,
/// at this queue capacity. spec: GNCL-12
pub(super) const fn answers_max(queue_capacity: usize) -> usize {
    let answers = ANSWERS_OF_CAPACITY * queue_capacity;
    if answers > ANSWERS_MIN { answers } else { ANSWERS_MIN }
}

/// Returns the maximum number of outcomes that wait for a peer with this number of sessions. The outcomes of
/// all sessions wait in that of Control. The peer no longer counts messages that it has given up, long after
/// their time to live. The maximum is therefore twice the number of open messages on each connection with
/// confirmed messages, which is each but that of Stream. spec: GNCL-12
pub(super) const fn outcomes_max(sessions: usize, queue_capacity: usize) -> usize {
    let confirmable = if sessions > 1 { sessions - 1 } else { 1 };
    2 * confirmable * answers_max(queue_capacity)
}

/// How to handle a received message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Admission {
    /// The message is dropped: it arrives again on another connection.
    Drop,
    Deliver,
    /// The destination accepts nothing now: the message must wait in its queue. spec: CREDIT-1
    Enqueue(u64),
}

/// The result of offering waiting messages; of several the last one counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Offered {
    /// All messages were accepted.
    All,
    /// The remaining destinations signal when they accept more.
    Full,
    /// Other tasks run first, then it continues.
    Turn,
}

/// The receive state of a session, and the messages that wait for applications here.
struct Inbox {
    receiving: Receiving,
    backlog: ReceiveBacklog<u64, Message>,
    counters: ReceiveCounters,
    /// Number of acknowledgements created so far.
    acks_made: u64,
    /// Whether the peer's incarnation has ended: no further message of it is accepted.
    is_fenced: bool,
    /// Whether the waiting messages were given up: nothing may wait here any more.
    is_abandoned: bool,
}

/// Dispositions of the messages of a peer. `taken = forwarded + consumed + expired + refused + failed +
/// superseded + waiting`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Arrived {
    pub taken: u64,
    /// Messages that a mailbox or a client's queue of this node counts from here on.
    pub forwarded: u64,
    /// Messages for a layer, a group, or a waiter for an outcome or a reply.
    pub consumed: u64,
    pub expired: u64,
    pub refused: u64,
    pub failed: u64,
    /// Stream messages for which a newer value had arrived before.
    pub superseded: u64,
    /// Messages for applications that accept nothing now, or in process by a thread.
    pub waiting: u64,
}

impl From<&Arrived> for Account {
    /// Returns the account of one class from a node.
    fn from(arrived: &Arrived) -> Self {
        Self {
            taken: arrived.taken,
            delivered: arrived.forwarded + arrived.consumed,
            handed_on: arrived.forwarded,
            superseded: arrived.superseded,
            rejected: arrived.refused,
            expired: arrived.expired,
            failed: arrived.failed,
            waiting: arrived.waiting,
            ..Self::default()
        }
    }
}

/// Where every message of a session is, both directions.
#[derive(Clone, Copy, Debug)]
pub struct SessionAccount {
    pub sent: OutletAccount,
    pub arrived: Arrived,
    pub sending: Option<SendPosition>,
    pub receiving: ReceivePosition,
}

/// The two nodes of a session.
#[derive(Clone, Copy, Debug)]
pub(super) struct SessionParameters {
    pub(super) here: NodeAddress,
    pub(super) node: NodeAddress,
    /// The kind of a frame with several outcomes, if the peer accepts one.
    pub(super) outcomes_kind: Option<Kind>,
    /// Maximum number of this session's confirmed messages for which the peer has room for outcomes.
    pub(super) peer_answers_max: usize,
    /// Longest payload that the peer accepts.
    pub(super) peer_payload_max: usize,
    /// Number of sessions between the two nodes.
    pub(super) sessions: usize,
}

/// The notifications of a session.
#[derive(Clone, Default)]
pub(super) struct SessionNotifiers {
    pub(super) refusals: Arc<Refusals>,
    /// Received messages are not acknowledged yet.
    pub(super) acks: Arc<PeriodicChecks>,
    /// The peer's incarnation has ended, and fewer of its messages may still be delivered to an application.
    pub(super) fewer_outstanding: Arc<Notify>,
    /// Same as `fewer_outstanding`, for the task that keeps this peer while there are any.
    pub(super) queues_changed: Arc<Notify>,
}

/// A session with a peer.
pub struct PeerSession {
    pub outlet: SocketWriter<Gathering<Transport>>,
    /// Locked only briefly, never while another lock is held.
    inbox: Mutex<Inbox>,
    /// Whether an ACK must be sent, as soon as the frames read together have been processed.
    ack_marks: AckMarks,
    /// The window granted to the peer while applications accept messages.
    window: Window,
    /// Bytes of the longest frame.
    longest: usize,
    outcomes_max: usize,
    parameters: SessionParameters,
    notifiers: SessionNotifiers,
}

impl PeerSession {
    /// Creates a session. `now` identifies the receive state: a later session with the same incarnation of
    /// the peer has a larger number.
    pub(super) fn new(
        now: Time,
        parameters: SessionParameters,
        config: &NodeConfig,
        notifiers: &SessionNotifiers,
    ) -> Self {
        // A message longer than the peer's limit is not kept: it would be sent on each new connection again,
        // and refused.
        let payload_max = config.payload_max.min(parameters.peer_payload_max);
        let limits = OutletLimits {
            queue_capacity: config.gncl.queue_capacity,
            queue_bytes: config.gncl.queue_bytes,
            unconfirmed_max: config.gncl.queue_capacity,
            payload_max,
        };
        let messages = config.gncl.queue_capacity.clamp(WINDOW_MESSAGES_MIN, WINDOW_MESSAGES_MAX);
        let window = Window { messages, bytes: WINDOW_BYTES };
        let receiver_id = now.as_nanos();
        let header = |kind| frame(parameters.here, parameters.node, kind, Bytes::new()).header;
        let void = header(Kind::GNCL_VOID);
        let outcomes = parameters.outcomes_kind.map(header);
        let session =
            Session::new(receiver_id, window, void, outcomes).answered_up_to(parameters.peer_answers_max);
        let outlet = SocketWriter::with_session(limits, session);
        let longest = HEADER_LEN + config.payload_max;
        // A message may be acknowledged before it is known that its destination is full: one more than a window.
        let (queue_messages, queue_bytes) = (messages + 1, WINDOW_BYTES + longest);
        let backlog = ReceiveBacklog::new(BacklogLimits {
            queues: QUEUES_MAX,
            queue_messages,
            queue_bytes,
            // The peer may always start one message, and each may be for a further full destination.
            messages: BACKLOG_WINDOWS * queue_messages + QUEUES_MAX,
            bytes: BACKLOG_WINDOWS * queue_bytes,
        });
        let inbox = Mutex::new(Inbox {
            receiving: Receiving::new(receiver_id),
            backlog,
            counters: ReceiveCounters::default(),
            acks_made: 0,
            is_fenced: false,
            is_abandoned: false,
        });
        let outcomes_max = outcomes_max(parameters.sessions, config.gncl.queue_capacity);
        let (ack_marks, notifiers) = (AckMarks::default(), notifiers.clone());
        Self { outlet, inbox, ack_marks, window, longest, outcomes_max, parameters, notifiers }
    }

    /// Accepts messages on `link` from now on, and on no other connection.
    pub(super) fn attach(&self, link: LinkNumber) {
        self.inbox().receiving.attach(link.number());
        self.acknowledge();
    }

    /// Processes a message received on `link`. Returns whether to accept it, and its queue. An accepted
    /// message is in process: the caller creates its [guard](Self::processing_guard). `former` is the disposition of
    /// the message before it, if the caller has one that is not recorded: one lock serves both.
    ///
    /// # Errors
    /// The message does not have the next number.
    pub(super) fn on_message(
        &self,
        link: LinkNumber,
        message: &Message,
        former: Option<Disposition>,
    ) -> Result<Admission, RefusalError> {
        let number = message.header.number;
        let (arrival, queue) = {
            let mut inbox = self.inbox();
            if let Some(disposition) = former {
                inbox.counters.finish(disposition);
            }
            if inbox.is_fenced {
                drop(inbox);
                if former.is_some() {
                    self.notify_counted_of_ended();
                }
                return Ok(Admission::Drop);
            }
            let arrival = inbox.receiving.arrive(link.number(), number, message.size());
            if let Arrival::Take { ack_is_due } = arrival {
                inbox.counters.start();
                if ack_is_due {
                    self.ack_marks.set_due(&inbox.receiving);
                }
            }
            (arrival, inbox.queue_for(message))
        };
        match arrival {
            Arrival::Take { .. } => {
                self.notifiers.acks.request();
                Ok(queue.map_or(Admission::Deliver, Admission::Enqueue))
            }
            Arrival::Fenced => Ok(Admission::Drop),
            Arrival::OutOfStep { expected } => Err(RefusalError::Violation(format!(
                "message {number} came where {} is the next one",
                expected as u16
            ))),
        }
    }

    /// Whether this connection is the present one of the session.
    pub(super) fn is_current_link(&self, link: LinkNumber) -> bool {
        let inbox = self.inbox();
        !inbox.is_fenced && inbox.receiving.is_present(link.number())
    }

    /// Stops accepting messages: after the end of this incarnation is reported, no message of it is delivered.
    pub(super) fn fence(&self) {
        self.inbox().is_fenced = true;
    }

    /// Returns the applications that may still receive an accepted message.
    pub(super) fn outstanding(&self) -> OutstandingDestinations {
        let Inbox { backlog, counters, .. } = &*self.inbox();
        if counters.in_process() > 0 {
            return OutstandingDestinations::All;
        }
        OutstandingDestinations::Some(backlog.held().into_iter().map(destination_of).collect())
    }

    /// Notifies the waiter for the messages of an ended incarnation that fewer may still be delivered.
    fn notify_fewer_outstanding(&self) {
        let is_fenced = self.inbox().is_fenced;
        if is_fenced {
            self.notifiers.fewer_outstanding.notify_one();
        }
    }

    /// Records that a message is no longer in process, as `how` says.
    fn update_counters(&self, how: impl FnOnce(&mut ReceiveCounters)) {
        let is_fenced = {
            let mut inbox = self.inbox();
            how(&mut inbox.counters);
            inbox.is_fenced
        };
        if is_fenced {
            self.notify_counted_of_ended();
        }
    }

    /// Notifies the waiters for the messages of an ended incarnation that one is no longer in process.
    fn notify_counted_of_ended(&self) {
        self.notifiers.fewer_outstanding.notify_one();
        self.notifiers.queues_changed.notify_one();
    }

    /// Records the disposition of a message in process.
    pub(super) fn finish(&self, disposition: Disposition) {
        self.update_counters(|counters| counters.finish(disposition));
    }

    /// Processes the peer's ACK.
    pub(super) fn on_ack(&self, link: LinkNumber, ack: &Ack, now: Time) {
        let counts = self.inbox().receiving.on_epoch(link.number(), ack.epoch);
        if counts && self.outlet.on_ack(link, ack, now) {
            self.notifiers.refusals.count(
                now,
                "session begun anew",
                &format!(
                    "node {} does not know what it took; what it was sent ends as Unknown",
                    self.parameters.node
                ),
            );
            self.acknowledge();
        }
    }

    /// Returns where every message of this session is, both directions.
    pub fn account(&self) -> SessionAccount {
        let (sent, sending) = self.outlet.account();
        let (queued, counters, receiving) = {
            let inbox = self.inbox();
            (inbox.backlog.messages() as u64, inbox.counters, inbox.receiving.position())
        };
        let ended = |disposition| counters.count(disposition);
        let arrived = Arrived {
            taken: counters.received(),
            forwarded: ended(Disposition::Forwarded),
            consumed: ended(Disposition::Consumed),
            expired: ended(Disposition::Expired),
            refused: ended(Disposition::Refused),
            failed: ended(Disposition::Failed),
            superseded: ended(Disposition::Superseded),
            waiting: queued + counters.in_process(),
        };
        SessionAccount { sent, arrived, sending, receiving }
    }

    /// Returns the guard of the message that was just accepted.
    pub(super) const fn processing_guard(&self) -> ProcessingGuard<'_> {
        ProcessingGuard::new(self)
    }

    /// Counts a value received by datagram as in process; `None` if no message is accepted any more.
    pub(super) fn on_datagram(&self) -> Option<ProcessingGuard<'_>> {
        let inbox = &mut *self.inbox();
        if inbox.is_fenced {
            return None;
        }
        inbox.counters.start();
        Some(self.processing_guard())
    }

    /// Whether messages wait for the application of this queue.
    pub(super) fn has_queue(&self, queue: u64) -> bool {
        self.inbox().backlog.holds(queue)
    }

    /// Whether an accepted message may still be delivered to an application here. It may wait in a queue, or
    /// be in process by a thread that may put it into one.
    pub(super) fn has_undelivered(&self) -> bool {
        let Inbox { backlog, counters, .. } = &*self.inbox();
        counters.in_process() > 0 || !backlog.is_empty()
    }

    /// Resets the offers of an ended task.
    pub(super) fn forget_offers(&self) {
        self.inbox().backlog.forget_offers();
    }

    fn inbox(&self) -> MutexGuard<'_, Inbox> {
        self.inbox.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sends a frame of this layer on the present connection, ahead of all queued messages. Without a
    /// connection it is dropped.
    pub(super) fn send_urgent(&self, message: Message) {
        if let Err(refused) = self.outlet.submit_urgent(message, URGENT_FRAMES_MAX)
            && refused.why == Rejection::QueueFull
        {
            let detail =
                format!("a frame of kind {} for node {}", refused.message.header.kind, self.parameters.node);
            self.notifiers.refusals.count(Time::now(), "own frame not sent", &detail);
        }
    }

    /// Returns the longest payload that both sides accept.
    pub(super) fn payload_max(&self) -> usize {
        self.parameters.peer_payload_max.min(self.longest - HEADER_LEN)
    }

    /// Sends the outcome of a message of the peer. More of these may wait than other messages, because a lost
    /// one leaves its sender waiting. The peer has no more messages open than the announced room allows; if
    /// it has, further outcomes are counted and dropped.
    pub(super) fn report_outcome(&self, ticket: Ticket, outcome: Outcome) {
        self.count_unsent(self.outlet.report_outcome(ticket, outcome, self.outcomes_max));
    }

    /// Sends reports about members, with the same bound.
    pub(super) fn send_reports(&self, reports: Message) {
        self.count_unsent(self.outlet.submit_outcome(reports, self.outcomes_max));
    }

    fn count_unsent(&self, submitted: Result<(), SubmitError>) {
        if let Err(refused) = submitted {
            let kind = refused.message.header.kind;
            let detail = format!("a frame of kind {kind} for node {}: {}", self.parameters.node, refused.why);
            self.notifiers.refusals.count(Time::now(), "own frame not sent", &detail);
        }
    }
}

impl Inbox {
    /// Takes the first message of a queue for an offer, and counts it as in process.
    fn offer(&mut self, key: u64) -> Option<(Message, usize)> {
        let offered = self.backlog.offer(key)?;
        self.counters.resume();
        Some(offered)
    }

    /// Puts a message in process back into its queue. Returns it if the queues were abandoned.
    fn put_back(&mut self, key: u64, message: Message, bytes: usize) -> Option<Message> {
        if self.is_abandoned {
            self.backlog.taken(key);
            return Some(message);
        }
        self.backlog.put_back(key, message, bytes);
        self.counters.suspend();
        None
    }

    /// Returns the queue of a message to a held destination.
    fn queue_for(&self, message: &Message) -> Option<u64> {
        if self.backlog.is_empty() {
            return None;
        }
        backlog_key(&message.header).filter(|key| self.backlog.holds(*key))
    }
}
