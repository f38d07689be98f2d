//! Outcomes: each confirmed send ends in exactly one [`Outcome`].
//!
//! A [`Receipt`] travels with a confirmed message and is settled where its outcome is decided. A receipt that
//! is dropped unsettled reports [`Outcome::Failed`]. So if an actor panics, its current message is dropped,
//! and the sender is notified without further code.

mod members;
mod observer;

use std::{fmt, sync::Arc};

use serde::{Deserialize, Serialize};

pub use self::{
    members::{MEMBERS_MAX, MemberOutcome, MemberReport, MemberState, MemberTable, REPORTS_MAX},
    observer::{OutcomeObserver, observe, show, show_members, stop_observing},
};
use crate::tid::{AppAddress, NodeAddress, Tid};

/// The outcome of a confirmed message.
///
/// # Examples
///
/// ```
/// use sinew::Outcome;
///
/// /// Whether a command may be sent again without the risk that it is carried out twice.
/// fn is_safe_to_repeat(outcome: Outcome) -> bool {
///     match outcome {
///         Outcome::Rejected(_) | Outcome::Expired | Outcome::PeerLost => true,
///         Outcome::Delivered | Outcome::Failed | Outcome::Unknown => false,
///     }
/// }
/// assert!(!is_safe_to_repeat(Outcome::Unknown));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Outcome {
    /// The destination's handler handled the message and returned.
    Delivered,
    /// The message was rejected and not handled.
    Rejected(Rejection),
    /// The time to live ended before the message was handled. For a request also: its sender stopped waiting
    /// before it was handled.
    Expired,
    /// The destination's handler panicked, or its application ended while it handled the message.
    Failed,
    /// The destination's node was lost before the message was sent: it was not handled.
    PeerLost,
    /// The message was sent, and whether it was handled is unknown: its node, its connection or its process
    /// was lost before the confirmation, or the deadline passed.
    Unknown,
}

/// The reason why a message was rejected.
///
/// # Examples
///
/// ```
/// use sinew::{Outcome, message::Rejection};
///
/// let outcome = Outcome::Rejected(Rejection::QueueFull);
/// if let Outcome::Rejected(why) = outcome {
///     assert!(why.to_string().contains("more slowly than they come"));
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Rejection {
    /// No application has this TID.
    NoSuchApplication,
    /// The node is unknown, or not connected yet.
    NoSuchNode,
    /// The destination does not handle this kind of payload.
    UnknownKind,
    /// The payload cannot be decoded as its kind.
    Malformed,
    /// The destination's queue is full.
    QueueFull,
    /// The payload is longer than the configured limit.
    TooLong,
    /// The destination's application has ended.
    Closed,
    /// The source TID does not belong to the sender.
    ForgedSource,
    /// The handler rejected the message.
    ByHandler,
    /// The request is not supported, for example a request to a group.
    Unsupported,
    /// The destination's application has ended, is not ready again, and its policy keeps no messages meanwhile.
    Down,
    /// The access list of the destination's node does not allow this message from this source.
    NotAllowed,
    /// A confirmed message to many exceeds a limit: of members on a node, of nodes, or of such messages that
    /// its source has in flight.
    TooManyMembers,
}

impl Rejection {
    /// All rejections, in the order in which they are declared.
    pub(crate) const ALL: [Self; 13] = [
        Self::NoSuchApplication,
        Self::NoSuchNode,
        Self::UnknownKind,
        Self::Malformed,
        Self::QueueFull,
        Self::TooLong,
        Self::Closed,
        Self::ForgedSource,
        Self::ByHandler,
        Self::Unsupported,
        Self::Down,
        Self::NotAllowed,
        Self::TooManyMembers,
    ];
}

impl std::error::Error for Rejection {}

impl fmt::Display for Rejection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NoSuchApplication => "no application has this TID; is it registered and spelled right?",
            Self::NoSuchNode => "the node is not known or not connected; see its NodeFound event",
            Self::UnknownKind => "the destination does not handle this kind of payload",
            Self::Malformed => "the payload is not what its kind says; do both sides use the same type?",
            Self::QueueFull => {
                "the destination's queue is full; it handles messages more slowly than they come"
            }
            Self::TooLong => "the payload is longer than `node.payload_max` of a node on its way; raise that on all nodes, or send it in parts",
            Self::Closed => "the destination's application has ended",
            Self::ForgedSource => "the source TID does not belong to the sender",
            Self::ByHandler => "the destination's handler refused it",
            Self::Unsupported => "this cannot be asked of this destination",
            Self::Down => "the destination's application is away: it ended and is not ready again",
            Self::NotAllowed => {
                "the access list of the destination's node does not allow it; `sinew why SENDER DESTINATION` names the rule"
            }
            Self::TooManyMembers => {
                "a confirmed message reaches at most 256 members of a group on one node, and 256 other nodes, and an application has 64 of them \
                 under way; send it to smaller groups, wait for some to end, or send it unconfirmed"
            }
        })
    }
}

impl Outcome {
    /// Returns the byte of this outcome on the wire: `0` delivered, `1` expired, `2` failed, `3` peer lost,
    /// `4` unknown, `16 + n` rejected for the n-th reason in the order of [`Rejection`].
    #[must_use]
    pub fn code(self) -> u8 {
        match self {
            Self::Delivered => 0,
            Self::Expired => 1,
            Self::Failed => 2,
            Self::PeerLost => 3,
            Self::Unknown => 4,
            Self::Rejected(why) => 16 + Rejection::ALL.iter().position(|r| *r == why).map_or(0, |n| n as u8),
        }
    }

    /// Returns the outcome of a byte on the wire, or `None` for a byte that is not assigned.
    #[must_use]
    pub fn from_code(code: u8) -> Option<Self> {
        match code {
            0 => Some(Self::Delivered),
            1 => Some(Self::Expired),
            2 => Some(Self::Failed),
            3 => Some(Self::PeerLost),
            4 => Some(Self::Unknown),
            code => Rejection::ALL.get(usize::from(code.checked_sub(16)?)).map(|why| Self::Rejected(*why)),
        }
    }
}

/// Identifies the message of a receipt.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Ticket {
    /// The sender of the message.
    pub source: Tid,
    /// The destination of the message.
    pub destination: Tid,
    /// The number that identifies the message at its sender.
    pub correlation: u64,
}

/// Returns an outcome to the origin of a message.
pub trait ReceiptSink: Send + Sync {
    /// Accepts the outcome of the message of `ticket`. Called once for each receipt.
    fn settle(&self, ticket: Ticket, outcome: Outcome);

    /// Accepts the outcomes of several messages, as [`settle`](Self::settle) does for each, in this order. A message
    /// that is not taken from `outcomes` counts as not settled.
    fn settle_all(&self, outcomes: &mut dyn Iterator<Item = (Ticket, Outcome)>) {
        outcomes.for_each(|(ticket, outcome)| self.settle(ticket, outcome));
    }

    /// Accepts reports about the members of the message to many of `ticket`, before it is settled. spec: FRAME-7
    fn members(&self, ticket: Ticket, reports: &[MemberReport]) {
        let _ = (ticket, reports);
    }
}

/// The source of a settled receipt's ticket. No message has it: a source is an application of one node.
const SETTLED: Tid = Tid::new(NodeAddress::ALL, AppAddress::NONE);

/// The right and the duty to settle one confirmed message.
///
/// An `Option` of it is no longer than itself, because the pointer to the sink is never null.
#[must_use = "a dropped receipt says Failed"]
pub struct Receipt {
    sink: Arc<dyn ReceiptSink>,
    /// The message of this receipt; its source is [`SETTLED`] after the settlement.
    ticket: Ticket,
}

impl Receipt {
    /// Creates a receipt for the message of `ticket`, to be settled at `sink`.
    pub fn new(sink: Arc<dyn ReceiptSink>, ticket: Ticket) -> Self {
        debug_assert_ne!(ticket.source, SETTLED, "a message has an application of one node as its source");
        Self { sink, ticket }
    }

    /// Settles the message with its outcome.
    pub fn settle(mut self, outcome: Outcome) {
        self.settle_once(outcome);
    }

    /// Settles all messages in order, and empties `receipts`. The sink of several in a row gets these together.
    pub fn settle_all(receipts: &mut Vec<(Self, Outcome)>) {
        for same in receipts.chunk_by_mut(|(one, _), (next, _)| Arc::ptr_eq(&one.sink, &next.sink)) {
            match same {
                [(receipt, outcome)] => receipt.settle_once(*outcome),
                [(first, _), ..] => {
                    let sink = first.sink.clone();
                    let mut outcomes = same.iter_mut().filter_map(|(receipt, outcome)| {
                        receipt.begin_settlement().map(|ticket| (ticket, *outcome))
                    });
                    sink.settle_all(&mut outcomes);
                }
                // A chunk has at least one.
                [] => {}
            }
        }
        receipts.clear();
    }

    /// Settles the message, unless it is settled.
    fn settle_once(&mut self, outcome: Outcome) {
        if let Some(ticket) = self.begin_settlement() {
            self.sink.settle(ticket, outcome);
        }
    }

    /// Returns the ticket of a message that is not settled. It counts as settled before its sink is called, which may
    /// panic.
    fn begin_settlement(&mut self) -> Option<Ticket> {
        let ticket = self.ticket;
        self.ticket.source = SETTLED;
        (ticket.source != SETTLED).then_some(ticket)
    }

    /// Reports members of the message, which must be one to many.
    pub fn report(&self, reports: &[MemberReport]) {
        if !reports.is_empty() {
            self.sink.members(self.ticket, reports);
        }
    }

    /// Returns the message that this receipt is for.
    #[must_use]
    pub const fn ticket(&self) -> Ticket {
        self.ticket
    }
}

impl Drop for Receipt {
    fn drop(&mut self) {
        self.settle_once(Outcome::Failed);
    }
}

impl fmt::Debug for Receipt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Receipt({:?})", self.ticket)
    }
}

#[cfg(test)]
mod tests {
    use std::{
        panic::{AssertUnwindSafe, catch_unwind},
        sync::{Mutex, PoisonError},
    };

    use super::*;

    #[derive(Default)]
    struct Ledger(Mutex<Vec<Outcome>>);

    impl ReceiptSink for Ledger {
        fn settle(&self, _: Ticket, outcome: Outcome) {
            self.0.lock().unwrap().push(outcome);
        }
    }

    const TICKET: Ticket = Ticket { source: Tid::NONE, destination: Tid::NONE, correlation: 1 };

    #[test]
    fn every_receipt_is_settled_exactly_once() {
        let ledger = Arc::new(Ledger::default());
        Receipt::new(ledger.clone(), TICKET).settle(Outcome::Delivered);
        drop(Receipt::new(ledger.clone(), TICKET));
        assert_eq!(*ledger.0.lock().unwrap(), [Outcome::Delivered, Outcome::Failed]);
    }

    #[test]
    fn receipt_is_settled_once_by_a_sink_that_panics() {
        struct Panics(Mutex<usize>);

        impl ReceiptSink for Panics {
            fn settle(&self, _: Ticket, _: Outcome) {
                *self.0.lock().unwrap() += 1;
                panic!("a fault of the sink's");
            }
        }

        let sink = Arc::new(Panics(Mutex::new(0)));
        let receipt = Receipt::new(sink.clone(), TICKET);
        assert!(catch_unwind(AssertUnwindSafe(|| receipt.settle(Outcome::Delivered))).is_err());
        assert_eq!(*sink.0.lock().unwrap_or_else(PoisonError::into_inner), 1);
    }

    #[test]
    fn receipts_settle_together_in_order_and_once() {
        let ledgers = [Arc::<Ledger>::default(), Arc::default()];
        let all =
            [(0, Outcome::Delivered), (0, Outcome::Expired), (1, Outcome::Failed), (0, Outcome::Unknown)];
        let mut receipts: Vec<_> =
            all.iter().map(|(to, outcome)| (Receipt::new(ledgers[*to].clone(), TICKET), *outcome)).collect();
        Receipt::settle_all(&mut receipts);
        assert!(receipts.is_empty());
        let expected = [vec![Outcome::Delivered, Outcome::Expired, Outcome::Unknown], vec![Outcome::Failed]];
        assert_eq!(ledgers.map(|ledger| ledger.0.lock().unwrap().clone()), expected);
    }

    #[test]
    fn receipts_left_by_a_sink_say_failed() {
        #[derive(Default)]
        struct TakesOne {
            panics: bool,
            seen: Mutex<Vec<(u64, Outcome)>>,
        }

        impl ReceiptSink for TakesOne {
            fn settle(&self, ticket: Ticket, outcome: Outcome) {
                self.seen.lock().unwrap().push((ticket.correlation, outcome));
            }

            fn settle_all(&self, outcomes: &mut dyn Iterator<Item = (Ticket, Outcome)>) {
                let (ticket, outcome) = outcomes.next().expect("there are several");
                self.settle(ticket, outcome);
                assert!(!self.panics, "a fault of the sink's");
            }
        }

        for panics in [false, true] {
            let sink = Arc::new(TakesOne { panics, ..TakesOne::default() });
            let receipt = |correlation| Receipt::new(sink.clone(), Ticket { correlation, ..TICKET });
            let mut receipts: Vec<_> = (1..=3).map(|n| (receipt(n), Outcome::Delivered)).collect();
            let settled = catch_unwind(AssertUnwindSafe(move || Receipt::settle_all(&mut receipts)));
            assert_eq!(settled.is_err(), panics);
            let expected = [(1, Outcome::Delivered), (2, Outcome::Failed), (3, Outcome::Failed)];
            assert_eq!(*sink.seen.lock().unwrap(), expected);
        }
    }

    #[test]
    fn every_code_means_one_outcome() {
        let meant: Vec<_> =
            (0..=u8::MAX).filter_map(|code| Outcome::from_code(code).map(|o| (code, o))).collect();
        assert_eq!(meant.len(), 5 + Rejection::ALL.len());
        assert!(meant.iter().all(|(code, outcome)| outcome.code() == *code));
    }
}
