//! Messages of types that their sender and their receiver declared differently.
//!
//! The node compares the declarations, and sets the table of the pairs that differ. The table is stored in the routing
//! table itself, which every sender reads anyway. While no types differ, a message costs one load of a pointer and a
//! branch. With a table, a message costs a search in a sorted map of at most [`MISMATCHES_MAX`] entries.

use std::{
    collections::BTreeMap,
    fmt,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
};

use crate::{
    tid::{AppAddress, Tid},
    wire::{Header, Kind},
};

/// Maximum number of entries. The node leaves further ones out: then the decoder decides on their messages.
pub const MISMATCHES_MAX: usize = 256;

/// The messages of one type from one application to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct TypedPath {
    /// The sender.
    pub source: Tid,
    /// The receiver, an application of this node.
    pub target: AppAddress,
    /// The type.
    pub kind: Kind,
}

/// The treatment of the messages of a path, and their number.
#[derive(Debug)]
pub struct Mismatch {
    is_refused: bool,
    seen: AtomicU64,
    /// Whether the owner of the table was notified of a message and has not read the number since.
    is_notified: AtomicBool,
}

impl Mismatch {
    /// Creates an entry for messages that are refused, or that are only counted.
    #[must_use]
    pub fn new(is_refused: bool) -> Arc<Self> {
        Arc::new(Self { is_refused, seen: AtomicU64::new(0), is_notified: AtomicBool::new(false) })
    }

    /// Returns whether the messages are refused.
    #[must_use]
    pub const fn is_refused(&self) -> bool {
        self.is_refused
    }

    /// Returns the number of messages so far.
    #[must_use]
    pub fn seen(&self) -> u64 {
        // SYNC: Relaxed; no other data depends on it.
        self.seen.load(Ordering::Relaxed)
    }

    /// Returns whether there was a message since the last call. The next message notifies the owner again.
    #[must_use]
    pub fn take_notified(&self) -> bool {
        // SYNC: Relaxed; no other data depends on it.
        self.is_notified.swap(false, Ordering::Relaxed)
    }
}

/// The paths with types that differ.
pub struct Mismatches {
    paths: BTreeMap<TypedPath, Arc<Mismatch>>,
    /// Called on the sending thread at the first message of a path after [`Mismatch::take_notified`].
    notify: Arc<dyn Fn() + Send + Sync>,
}

impl fmt::Debug for Mismatches {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Mismatches").field(&self.paths).finish()
    }
}

impl Mismatches {
    /// Creates the table of the first [`MISMATCHES_MAX`] paths. `notify` must not block.
    #[must_use]
    pub fn new(
        paths: impl IntoIterator<Item = (TypedPath, Arc<Mismatch>)>,
        notify: Arc<dyn Fn() + Send + Sync>,
    ) -> Self {
        Self { paths: paths.into_iter().take(MISMATCHES_MAX).collect(), notify }
    }

    /// Returns whether the message of this header is refused at `target`, and counts it.
    fn refuses(&self, target: AppAddress, header: &Header) -> bool {
        let path = TypedPath { source: header.source, target, kind: header.kind };
        let Some(found) = self.paths.get(&path) else { return false };
        // SYNC: Relaxed; no other data depends on these two.
        found.seen.fetch_add(1, Ordering::Relaxed);
        if !found.is_notified.load(Ordering::Relaxed) && !found.is_notified.swap(true, Ordering::Relaxed) {
            (self.notify)();
        }
        found.is_refused
    }
}

/// Returns whether the message of this header must not reach `target`, because their types differ.
#[inline]
pub(super) fn refuses(table: Option<&Arc<Mismatches>>, target: AppAddress, header: &Header) -> bool {
    table.is_some_and(|table| table.refuses(target, header))
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use bytes::Bytes;

    use super::*;
    use crate::{
        lock,
        outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
        router::{LocalRoute, MessageSink, Router, SubmitError},
        tid::NodeAddress,
        wire::Message,
    };

    const HERE: NodeAddress = NodeAddress::new(1);
    const SOURCE: Tid = Tid::new(NodeAddress::new(2), AppAddress::new(0x1000));
    const TARGET: AppAddress = AppAddress::new(0x1001);
    const OTHER: AppAddress = AppAddress::new(0x1002);
    const KIND: Kind = Kind::named("test.gains");

    #[derive(Default)]
    struct Taken(Mutex<Vec<Kind>>);

    impl MessageSink for Taken {
        fn submit(&self, message: Message) -> Result<(), SubmitError> {
            lock(&self.0).push(message.header.kind);
            Ok(())
        }
    }

    #[derive(Default)]
    struct Ledger(Mutex<Vec<Outcome>>);

    impl ReceiptSink for Ledger {
        fn settle(&self, _: Ticket, outcome: Outcome) {
            lock(&self.0).push(outcome);
        }
    }

    fn router(targets: &[AppAddress]) -> (Router, Arc<Taken>) {
        let (router, taken) = (Router::new(HERE), Arc::new(Taken::default()));
        for app in targets {
            router.set_local(*app, LocalRoute { sink: taken.clone(), events: Arc::new([]) });
        }
        (router, taken)
    }

    fn message(kind: Kind, target: AppAddress) -> Message {
        Message::new(Header::new(kind, SOURCE, Tid::new(HERE, target)), Bytes::new())
    }

    fn set(router: &Router, is_refused: bool) -> (Arc<Mismatch>, Arc<AtomicU64>) {
        let (mismatch, notified) = (Mismatch::new(is_refused), Arc::new(AtomicU64::new(0)));
        let path = TypedPath { source: SOURCE, target: TARGET, kind: KIND };
        let count = notified.clone();
        let notify = Arc::new(move || _ = count.fetch_add(1, Ordering::Relaxed));
        router.set_mismatches(Some(Mismatches::new([(path, mismatch.clone())], notify)));
        (mismatch, notified)
    }

    #[test]
    fn only_the_differing_type_of_the_pair_is_refused() {
        let (router, taken) = router(&[TARGET, OTHER]);
        let (mismatch, _) = set(&router, true);
        assert_eq!(router.deliver(message(KIND, TARGET)), Err(Rejection::Malformed));
        assert_eq!(router.deliver(message(KIND, OTHER)), Ok(()));
        let of_other_type = Kind::named("test.other");
        assert_eq!(router.deliver(message(of_other_type, TARGET)), Ok(()));
        let offered = router.offer(message(KIND, TARGET), None).map_err(|refused| refused.why);
        assert_eq!(offered, Err(Rejection::Malformed));
        assert_eq!(mismatch.seen(), 2);
        assert_eq!(*lock(&taken.0), [KIND, of_other_type]);
        router.set_mismatches(None);
        assert_eq!(router.deliver(message(KIND, TARGET)), Ok(()));
    }

    #[test]
    fn refused_confirmed_message_has_its_outcome() {
        let ((router, _), ledger) = (router(&[TARGET]), Arc::new(Ledger::default()));
        let _ = set(&router, true);
        let mut confirmed = message(KIND, TARGET);
        confirmed.receipt = Some(Receipt::new(ledger.clone(), confirmed.ticket()));
        assert_eq!(router.deliver(confirmed), Err(Rejection::Malformed));
        assert_eq!(*lock(&ledger.0), [Outcome::Rejected(Rejection::Malformed)]);
    }

    #[test]
    fn group_reaches_the_members_with_the_same_type() {
        let (router, taken) = router(&[TARGET, OTHER]);
        let (mismatch, _) = set(&router, true);
        let group = AppAddress::group("drives");
        for app in [TARGET, OTHER] {
            assert!(router.set_member(group, app, true));
        }
        let to_group = Header::new(KIND, SOURCE, Tid::new(NodeAddress::ALL, group));
        assert_eq!(router.deliver(Message::new(to_group, Bytes::new())), Ok(()));
        assert_eq!((mismatch.seen(), lock(&taken.0).len()), (1, 1));
    }

    #[test]
    fn owner_is_notified_once_until_it_reads() {
        let (router, taken) = router(&[TARGET]);
        let (mismatch, notified) = set(&router, false);
        for _ in 0..3 {
            assert_eq!(router.deliver(message(KIND, TARGET)), Ok(()));
        }
        assert_eq!((mismatch.seen(), notified.load(Ordering::Relaxed)), (3, 1));
        assert!(mismatch.take_notified() && !mismatch.take_notified());
        assert_eq!(router.deliver(message(KIND, TARGET)), Ok(()));
        assert_eq!((notified.load(Ordering::Relaxed), lock(&taken.0).len()), (2, 4));
    }
}
