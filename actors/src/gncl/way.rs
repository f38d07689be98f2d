//! One session with a peer: what is sent to it on the connections of a lane, and what was taken of its messages there.

mod acks;
mod hand;
mod lines;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use sinew_runtime::{
    outcome::Rejection,
    tid::NodeAddress,
    time::Time,
    wire::{HEADER_LEN, Kind, Message},
};
use tokio::sync::Notify;

use super::{
    arrivals::{Arrivals, End},
    core::Decline,
    owed::Owed,
    peer::frame,
    ticks::Ticks,
    transport::Transport,
};
use crate::{
    config::NodeConfig,
    outlet::{
        Gathering, LinkNumber, OutletAccount, OutletLimits, Session, StreamOutlet, destination_of, line_of,
    },
    refusals::Refusals,
    session::{Ack, Arrival, Came, Receiving, Sent, Shelf, ShelfLimits, Window},
};
pub(super) use hand::Hand;

/// Bytes of frames for one peer that are kept unacknowledged, from which on further messages wait.
const WINDOW_BYTES: usize = 4 << 20;
/// Messages that are kept at most: half of what their numbers' 16 bits on the wire can tell apart.
const WINDOW_MESSAGES_MAX: usize = 1 << 15;
/// Messages that are kept at least: twice as many as are acknowledged at once, so that nobody waits for an acknowledgement.
const WINDOW_MESSAGES_MIN: usize = 64;
/// Frames of this layer itself that wait for a socket at most: more than a peer's ACKs, PINGs and PONGs ever are.
const WORDS_MAX: usize = 32;

/// Applications at most for which messages of one session wait because they take nothing. Of a further one that is full each message is
/// refused at once. Each ACK names them all, in 9 bytes each: 2.4 KiB, which is less than what this layer's own frames may have (4,096).
const LINES_MAX: usize = 256;
/// Windows that may wait for applications, all together.
const SHELF_WINDOWS: usize = 4;
/// Times `gncl.queue_capacity`: confirmed messages of a peer, of each connection, for whose outcomes there is room. It is told so, for how
/// many it may have open its own capacity does not say here.
const ANSWERS_OF_CAPACITY: usize = 8;
/// At least: a node whose queue is short refuses nothing of a peer that has the defaults.
const ANSWERS_MIN: usize = 8_192;

/// Confirmed messages of a peer, of each connection, for whose outcomes a node has room whose queues hold so many messages. spec: GNCL-12
pub(super) const fn answers_max(queue_capacity: usize) -> usize {
    let answers = ANSWERS_OF_CAPACITY * queue_capacity;
    if answers > ANSWERS_MIN { answers } else { ANSWERS_MIN }
}

/// Outcomes at most that wait for a peer to which there are so many sessions: those of all sessions wait in the one of Control. Those that the
/// peer has given up waiting for (their time to live was over long ago) it does not count any more: hence twice as many as may be open on
/// each connection whose messages are confirmed, which is each but that of Stream. spec: GNCL-12
pub(super) const fn outcomes_max(ways: usize, queue_capacity: usize) -> usize {
    let confirmable = if ways > 1 { ways - 1 } else { 1 };
    2 * confirmable * answers_max(queue_capacity)
}

/// What is to be done with a message that has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Taken {
    /// Nothing: it comes again elsewhere.
    No,
    Yes,
    /// Its destination takes nothing now: it belongs behind what waits there. spec: CREDIT-1
    InLine(u64),
}

/// How far what waits for applications here came; of several the last one counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Offered {
    /// All was taken.
    All,
    /// Whoever did not take all says when it takes more.
    Full,
    /// Others have their turn; then it goes on.
    Turn,
}

/// What was taken of a peer's messages, and those that wait for applications here.
struct Inbox {
    receiving: Receiving,
    shelf: Shelf<u64, Message>,
    arrivals: Arrivals,
    /// The peer is to be told what was taken, as soon as what came with it has been taken, too.
    ack_is_due: bool,
    /// Acknowledgements that were made so far.
    acks_made: u64,
    /// The peer's life is over: nothing more is taken of it.
    is_fenced: bool,
    /// What waited was given up: nothing more waits here.
    is_abandoned: bool,
}

/// What became of the messages of a peer. `taken = handed_on + told + expired + refused + failed + superseded + waiting`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Arrived {
    pub(crate) taken: u64,
    /// A mailbox or a client's queue of this node counts them from here on.
    pub(crate) handed_on: u64,
    /// For a layer, a group, or one who waited for an outcome or a reply.
    pub(crate) told: u64,
    pub(crate) expired: u64,
    pub(crate) refused: u64,
    pub(crate) failed: u64,
    /// A newer value of class Stream had come before.
    pub(crate) superseded: u64,
    /// For applications that take nothing now, or in the hand of a thread.
    pub(crate) waiting: u64,
}

/// Where every message of a session is, both ways.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WayAccount {
    pub(crate) sent: OutletAccount,
    pub(crate) arrived: Arrived,
    pub(crate) sending: Option<Sent>,
    pub(crate) receiving: Came,
}

/// The two nodes of a session.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ends {
    pub(super) here: NodeAddress,
    pub(super) node: NodeAddress,
    /// Whether the peer takes several outcomes in one frame.
    pub(super) takes_outcomes: bool,
    /// Confirmed messages of this session at most for whose outcomes the peer has room.
    pub(super) answers_there: usize,
    /// Longest payload that the peer takes.
    pub(super) payload_max_there: usize,
    /// How many sessions there are between the two.
    pub(super) ways: usize,
}

/// What a session tells others of.
#[derive(Clone, Default)]
pub(super) struct Told {
    pub(super) refusals: Arc<Refusals>,
    /// Something was taken that the peer does not know of.
    pub(super) acks: Arc<Ticks>,
    /// The peer's life is over, and fewer of its messages may still come to an application.
    pub(super) fewer_owed: Arc<Notify>,
    /// The same, for whoever keeps that peer as long as there are any.
    pub(super) held_up: Arc<Notify>,
}

/// A session with a peer.
pub(crate) struct Way {
    pub(crate) outlet: StreamOutlet<Gathering<Transport>>,
    /// Locked for a moment, never with another lock in hand.
    inbox: Mutex<Inbox>,
    /// What the peer may have on its way, where applications take what comes.
    window: Window,
    /// Bytes of the longest frame.
    longest: usize,
    outcomes_max: usize,
    ends: Ends,
    told: Told,
}

impl Way {
    /// `now` numbers what is remembered: a later session with the same life of the peer has a larger number.
    pub(super) fn new(now: Time, ends: Ends, config: &NodeConfig, told: &Told) -> Self {
        // What the peer does not take is not kept for a connection that is still to come: it would be sent on each one again, and refused.
        let payload_max = config.payload_max.min(ends.payload_max_there);
        let limits = OutletLimits {
            queue_capacity: config.gncl.queue_capacity,
            queue_bytes: config.gncl.queue_bytes,
            unconfirmed_max: config.gncl.queue_capacity,
            payload_max,
        };
        let messages = config.gncl.queue_capacity.clamp(WINDOW_MESSAGES_MIN, WINDOW_MESSAGES_MAX);
        let window = Window { messages, bytes: WINDOW_BYTES };
        let memory = now.as_nanos();
        let header = |kind| frame(ends.here, ends.node, kind, Bytes::new()).header;
        let void = header(Kind::GNCL_VOID);
        let outcomes = ends.takes_outcomes.then(|| header(Kind::GNCL_OUTCOMES));
        let session = Session::new(memory, window, void, outcomes).answered_up_to(ends.answers_there);
        let outlet = StreamOutlet::with_session(limits, session);
        let longest = HEADER_LEN + config.payload_max;
        // A message may be acknowledged before it is known that its destination is full: one more than a window.
        let (line_messages, line_bytes) = (messages + 1, WINDOW_BYTES + longest);
        let shelf = Shelf::new(ShelfLimits {
            lines: LINES_MAX,
            line_messages,
            line_bytes,
            // The peer may always begin one message, which may be for one more that is full.
            messages: SHELF_WINDOWS * line_messages + LINES_MAX,
            bytes: SHELF_WINDOWS * line_bytes,
        });
        let inbox = Mutex::new(Inbox {
            receiving: Receiving::new(memory),
            shelf,
            arrivals: Arrivals::default(),
            ack_is_due: false,
            acks_made: 0,
            is_fenced: false,
            is_abandoned: false,
        });
        let outcomes_max = outcomes_max(ends.ways, config.gncl.queue_capacity);
        Self { outlet, inbox, window, longest, outcomes_max, ends, told: told.clone() }
    }

    /// Its messages come on `link` from now on, and are taken from no other.
    pub(super) fn attach(&self, link: LinkNumber) {
        self.inbox().receiving.attach(link.number());
        self.acknowledge();
    }

    /// A message came on `link`. Says whether it is to be taken, and where it belongs; one that is is in [hand](Self::hand) then.
    ///
    /// # Errors
    /// It is not the next one.
    pub(super) fn arrive(&self, link: LinkNumber, message: &Message) -> Result<Taken, Decline> {
        let number = message.header.number;
        let (arrival, line) = {
            let mut inbox = self.inbox();
            if inbox.is_fenced {
                return Ok(Taken::No);
            }
            let arrival = inbox.receiving.arrive(link.number(), number, message.size());
            if let Arrival::Take { ack_is_due } = arrival {
                inbox.arrivals.take();
                inbox.ack_is_due |= ack_is_due;
            }
            (arrival, inbox.line(message))
        };
        match arrival {
            Arrival::Take { .. } => {
                self.told.acks.want();
                Ok(line.map_or(Taken::Yes, Taken::InLine))
            }
            Arrival::Fenced => Ok(Taken::No),
            Arrival::OutOfStep { expected } => Err(Decline::Violation(format!(
                "message {number} came where {} is the next one",
                expected as u16
            ))),
        }
    }

    /// Whether what its messages come on is this connection, and not a later one.
    pub(super) fn comes_on(&self, link: LinkNumber) -> bool {
        let inbox = self.inbox();
        !inbox.is_fenced && inbox.receiving.is_present(link.number())
    }

    /// Takes nothing more: who has been told that this life of the peer is over gets no message of it afterwards.
    pub(super) fn fence(&self) {
        self.inbox().is_fenced = true;
    }

    /// To whom a message that was taken may still come.
    pub(super) fn owed(&self) -> Owed {
        let Inbox { shelf, arrivals, .. } = &*self.inbox();
        if arrivals.in_hand() > 0 {
            return Owed::Anyone;
        }
        Owed::These(shelf.held().into_iter().map(destination_of).collect())
    }

    /// Fewer messages may still come to applications here: whoever waits for that of a peer whose life is over looks.
    fn owes_less(&self) {
        let is_fenced = self.inbox().is_fenced;
        if is_fenced {
            self.told.fewer_owed.notify_one();
        }
    }

    /// A message that was in hand is there no more, in this way.
    fn leaves_the_hand(&self, how: impl FnOnce(&mut Arrivals)) {
        let is_fenced = {
            let mut inbox = self.inbox();
            how(&mut inbox.arrivals);
            inbox.is_fenced
        };
        if is_fenced {
            self.told.fewer_owed.notify_one();
            self.told.held_up.notify_one();
        }
    }

    /// A message that was in hand has ended so.
    fn end(&self, end: End) {
        self.leaves_the_hand(|arrivals| arrivals.end(end));
    }

    /// The peer says what it has taken.
    pub(super) fn heard(&self, link: LinkNumber, ack: &Ack, now: Time) {
        let counts = self.inbox().receiving.heard(link.number(), ack.epoch);
        if counts && self.outlet.heard(link, ack, now) {
            self.told.refusals.count(
                now,
                "session begun anew",
                &format!(
                    "node {} does not know what it took; what it was sent ends as Unknown",
                    self.ends.node
                ),
            );
            self.acknowledge();
        }
    }

    /// Where every message of this session is, both ways.
    pub(crate) fn account(&self) -> WayAccount {
        let (sent, sending) = self.outlet.account();
        let (lines, arrivals, receiving) = {
            let inbox = self.inbox();
            (inbox.shelf.messages() as u64, inbox.arrivals, inbox.receiving.position())
        };
        let ended = |end| arrivals.ended(end);
        let arrived = Arrived {
            taken: arrivals.taken(),
            handed_on: ended(End::HandedOn),
            told: ended(End::Told),
            expired: ended(End::Expired),
            refused: ended(End::Refused),
            failed: ended(End::Failed),
            superseded: ended(End::Superseded),
            waiting: lines + arrivals.in_hand(),
        };
        WayAccount { sent, arrived, sending, receiving }
    }

    /// The message that has just been taken.
    pub(super) const fn hand(&self) -> Hand<'_> {
        Hand::of(self)
    }

    /// A value comes by datagram, and is in hand; `None` if nothing more is taken.
    pub(super) fn take_datagram(&self) -> Option<Hand<'_>> {
        let inbox = &mut *self.inbox();
        if inbox.is_fenced {
            return None;
        }
        inbox.arrivals.take();
        Some(self.hand())
    }

    /// Whether messages wait for the application of this line.
    pub(super) fn has_line(&self, line: u64) -> bool {
        self.inbox().shelf.holds(line)
    }

    /// Whether a message that was taken may still come to an application here: one waits, or is in the hand of a thread, which may put it
    /// into a line.
    pub(super) fn owes(&self) -> bool {
        let Inbox { shelf, arrivals, .. } = &*self.inbox();
        arrivals.in_hand() > 0 || !shelf.is_empty()
    }

    /// Whoever offered what waits has ended.
    pub(super) fn forget_offers(&self) {
        self.inbox().shelf.forget_offers();
    }

    fn inbox(&self) -> MutexGuard<'_, Inbox> {
        self.inbox.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Says something on the present connection, ahead of all that waits. Without one nobody needs it.
    pub(super) fn say(&self, message: Message) {
        if let Err(refused) = self.outlet.submit_urgent(message, WORDS_MAX)
            && refused.why == Rejection::QueueFull
        {
            let detail =
                format!("a frame of kind {} for node {}", refused.message.header.kind, self.ends.node);
            self.told.refusals.count(Time::now(), "own frame not sent", &detail);
        }
    }

    /// Longest payload that both sides take.
    pub(super) fn payload_max(&self) -> usize {
        self.ends.payload_max_there.min(self.longest - HEADER_LEN)
    }

    /// Sends an outcome, or reports about members: more of them than other messages may wait, for one that is lost leaves its sender waiting. The peer has no more
    /// messages open than it was told that there is room for; of one that has, the rest is counted and dropped.
    pub(super) fn send_outcome(&self, message: Message) {
        if let Err(refused) = self.outlet.submit_outcome(message, self.outcomes_max) {
            let kind = refused.message.header.kind;
            let detail = format!("a frame of kind {kind} for node {}: {}", self.ends.node, refused.why);
            self.told.refusals.count(Time::now(), "own frame not sent", &detail);
        }
    }
}

impl Inbox {
    /// Takes the first message of a line into the hand.
    fn offer(&mut self, key: u64) -> Option<(Message, usize)> {
        let offered = self.shelf.offer(key)?;
        self.arrivals.take_again();
        Some(offered)
    }

    /// Puts what was in hand back. Hands it over where nothing waits any more.
    fn put_back(&mut self, key: u64, message: Message, bytes: usize) -> Option<Message> {
        if self.is_abandoned {
            self.shelf.taken(key);
            return Some(message);
        }
        self.shelf.put_back(key, message, bytes);
        self.arrivals.put_away();
        None
    }

    /// The line of a message whose destination is held.
    fn line(&self, message: &Message) -> Option<u64> {
        if self.shelf.is_empty() {
            return None;
        }
        line_of(&message.header).filter(|key| self.shelf.holds(*key))
    }
}
