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

use super::guard::Verdict;
use crate::{
    outcome::Rejection,
    tid::{AppAddress, Tid},
    wire::{Header, Kind},
};

/// The payload of a protected message that is refused because of its type. It is no envelope, so the guard counts a bad
/// message, as for one that cannot be decoded. A refusal on the way would be silence for the guard.
pub(crate) const SPOILED: &[u8] = b"sinew: the sender declared this type differently";

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

/// The effect of an entry on the messages of its path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effect {
    /// They are delivered and counted.
    Counted,
    /// They are refused as `Malformed`.
    Refused,
    /// They reach the receiver without their value, so that its guard counts a bad message. For protected types.
    Spoiled,
}

/// The treatment of the messages of a path, and their number.
#[derive(Debug)]
pub struct Mismatch {
    effect: Effect,
    seen: AtomicU64,
    /// Whether the owner of the table was notified of a message and has not read the number since.
    is_notified: AtomicBool,
}

impl Mismatch {
    /// Creates an entry with this effect.
    #[must_use]
    pub fn new(effect: Effect) -> Arc<Self> {
        Arc::new(Self { effect, seen: AtomicU64::new(0), is_notified: AtomicBool::new(false) })
    }

    /// Returns the number of messages so far.
    #[must_use]
    pub fn seen(&self) -> u64 {
        // SYNC: Relaxed; no other data depends on it.
        self.seen.load(Ordering::Relaxed)
    }

    /// Returns whether there was a message since the last call of [`take_notified`](Self::take_notified).
    #[must_use]
    pub fn is_notified(&self) -> bool {
        // SYNC: Relaxed; no other data depends on it.
        self.is_notified.load(Ordering::Relaxed)
    }

    /// Returns whether there was a message since the last call. The next message notifies the owner again.
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

    /// Returns the table without the paths that are over. `None`: there are none of them.
    pub(super) fn without(&self, is_over: impl Fn(&TypedPath) -> bool) -> Option<Self> {
        if !self.paths.keys().any(&is_over) {
            return None;
        }
        let others = self.paths.iter().filter(|(path, _)| !is_over(path));
        let paths = others.map(|(path, mismatch)| (*path, mismatch.clone())).collect();
        Some(Self { paths, notify: self.notify.clone() })
    }

    /// Returns whether messages of some type from `source` to `target` are refused, or arrive without their value.
    pub(super) fn refuses_some(&self, source: Tid, target: AppAddress) -> bool {
        let is_of_pair = |path: &TypedPath| path.source == source && path.target == target;
        self.paths.iter().any(|(path, found)| is_of_pair(path) && found.effect != Effect::Counted)
    }

    /// Returns whether there is no path.
    pub(super) fn is_empty(&self) -> bool {
        self.paths.is_empty()
    }

    /// Notifies the owner of the table.
    pub(super) fn notify(&self) {
        (self.notify)();
    }

    /// Judges the message of this header for `target`, and counts it.
    fn judge(&self, target: AppAddress, header: &Header) -> Verdict {
        let path = TypedPath { source: header.source, target, kind: header.kind };
        let Some(found) = self.paths.get(&path) else { return Verdict::Allowed };
        // SYNC: Relaxed; no other data depends on these two.
        found.seen.fetch_add(1, Ordering::Relaxed);
        if !found.is_notified.load(Ordering::Relaxed) && !found.is_notified.swap(true, Ordering::Relaxed) {
            self.notify();
        }
        match found.effect {
            Effect::Counted => Verdict::Allowed,
            Effect::Refused => Verdict::Refused(Rejection::Malformed),
            Effect::Spoiled => Verdict::Spoiled,
        }
    }
}

/// Judges the message of this header by the types that its sender and `target` declared.
#[inline]
pub(super) fn judge(table: Option<&Arc<Mismatches>>, target: AppAddress, header: &Header) -> Verdict {
    table.map_or(Verdict::Allowed, |table| table.judge(target, header))
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use bytes::Bytes;

    use super::*;
    use crate::{
        lock,
        outcome::{Outcome, Receipt, ReceiptSink, Ticket},
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

    /// Keeps the payloads.
    #[derive(Default)]
    struct Payloads(Mutex<Vec<Bytes>>);

    impl MessageSink for Payloads {
        fn submit(&self, message: Message) -> Result<(), SubmitError> {
            lock(&self.0).push(message.payload);
            Ok(())
        }
    }

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

    fn set(router: &Router, effect: Effect) -> (Arc<Mismatch>, Arc<AtomicU64>) {
        let (mismatch, notified) = (Mismatch::new(effect), Arc::new(AtomicU64::new(0)));
        let path = TypedPath { source: SOURCE, target: TARGET, kind: KIND };
        let count = notified.clone();
        let notify = Arc::new(move || _ = count.fetch_add(1, Ordering::Relaxed));
        let table = Mismatches::new([(path, mismatch.clone())], notify);
        assert!(router.set_mismatches(Some(table), router.route_changes()));
        (mismatch, notified)
    }

    #[test]
    fn only_the_differing_type_of_the_pair_is_refused() {
        let (router, taken) = router(&[TARGET, OTHER]);
        let (mismatch, _) = set(&router, Effect::Refused);
        assert_eq!(router.deliver(message(KIND, TARGET)), Err(Rejection::Malformed));
        assert_eq!(router.deliver(message(KIND, OTHER)), Ok(()));
        let of_other_type = Kind::named("test.other");
        assert_eq!(router.deliver(message(of_other_type, TARGET)), Ok(()));
        let offered = router.offer(message(KIND, TARGET), None).map_err(|refused| refused.why);
        assert_eq!(offered, Err(Rejection::Malformed));
        assert_eq!(mismatch.seen(), 2);
        assert_eq!(*lock(&taken.0), [KIND, of_other_type]);
        assert!(router.set_mismatches(None, router.route_changes()));
        assert_eq!(router.deliver(message(KIND, TARGET)), Ok(()));
    }

    #[test]
    fn refused_confirmed_message_has_its_outcome() {
        let ((router, _), ledger) = (router(&[TARGET]), Arc::new(Ledger::default()));
        let _ = set(&router, Effect::Refused);
        let mut confirmed = message(KIND, TARGET);
        confirmed.receipt = Some(Receipt::new(ledger.clone(), confirmed.ticket()));
        assert_eq!(router.deliver(confirmed), Err(Rejection::Malformed));
        assert_eq!(*lock(&ledger.0), [Outcome::Rejected(Rejection::Malformed)]);
    }

    #[test]
    fn group_reaches_the_members_with_the_same_type() {
        let (router, taken) = router(&[TARGET, OTHER]);
        let (mismatch, _) = set(&router, Effect::Refused);
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
        let (mismatch, notified) = set(&router, Effect::Counted);
        for _ in 0..3 {
            assert_eq!(router.deliver(message(KIND, TARGET)), Ok(()));
        }
        assert_eq!((mismatch.seen(), notified.load(Ordering::Relaxed)), (3, 1));
        assert!(mismatch.take_notified() && !mismatch.take_notified());
        assert_eq!(router.deliver(message(KIND, TARGET)), Ok(()));
        assert_eq!((notified.load(Ordering::Relaxed), lock(&taken.0).len()), (2, 4));
    }

    #[test]
    fn protected_message_arrives_without_its_value() {
        let (router, payloads) = (Router::new(HERE), Arc::new(Payloads::default()));
        router.set_local(TARGET, LocalRoute { sink: payloads.clone(), events: Arc::new([]) });
        let (mismatch, _) = set(&router, Effect::Spoiled);
        let sealed = || Message::new(message(KIND, TARGET).header, Bytes::from_static(b"sealed"));
        assert_eq!(router.deliver(sealed()), Ok(()));
        assert!(router.offer(sealed(), None).is_ok());
        assert_eq!(
            (mismatch.seen(), lock(&payloads.0).as_slice()),
            (2, &[SPOILED, SPOILED].map(Bytes::from_static)[..])
        );
        // Nothing guarded is sent to a group.
        let group = AppAddress::group("drives");
        assert!(router.set_member(group, TARGET, true));
        let to_group = Header::new(KIND, SOURCE, Tid::new(NodeAddress::ALL, group));
        assert_eq!(router.deliver(Message::new(to_group, Bytes::new())), Ok(()));
        assert_eq!((mismatch.seen(), lock(&payloads.0).len()), (3, 2));
    }

    #[test]
    fn will_of_a_lost_node_is_not_compared() {
        let (router, taken) = router(&[TARGET]);
        let _ = set(&router, Effect::Refused);
        assert_eq!(router.deliver_will(message(KIND, TARGET), None), Ok(()));
        assert_eq!(*lock(&taken.0), [KIND]);
    }

    #[test]
    fn next_incarnation_of_a_node_is_not_refused() {
        let (router, taken) = router(&[TARGET]);
        let peer = |sink: &Arc<Taken>| router.set_peer(SOURCE.node, sink.clone());
        peer(&taken);
        let (_, notified) = set(&router, Effect::Refused);
        // A further connection of the same incarnation has the same sink.
        peer(&taken);
        assert_eq!(router.deliver(message(KIND, TARGET)), Err(Rejection::Malformed));
        let before = notified.load(Ordering::Relaxed);
        let changes = router.route_changes();
        peer(&Arc::default());
        assert_eq!(router.deliver(message(KIND, TARGET)), Ok(()));
        assert_eq!(notified.load(Ordering::Relaxed), before + 1, "the owner of the table is to compare anew");
        // A table from before the change is not set.
        let path = TypedPath { source: SOURCE, target: TARGET, kind: KIND };
        let stale = || Mismatches::new([(path, Mismatch::new(Effect::Refused))], Arc::new(|| {}));
        assert!(!router.set_mismatches(Some(stale()), changes));
        assert_eq!(router.deliver(message(KIND, TARGET)), Ok(()));
        assert!(router.set_mismatches(Some(stale()), router.route_changes()));
        router.remove_peer(SOURCE.node);
        assert_eq!(router.deliver(message(KIND, TARGET)), Ok(()));
    }

    #[test]
    fn change_of_a_node_keeps_the_paths_of_others() {
        let (router, taken) = router(&[TARGET]);
        let _ = set(&router, Effect::Refused);
        router.set_peer(NodeAddress::new(3), taken);
        assert_eq!(router.deliver(message(KIND, TARGET)), Err(Rejection::Malformed));
    }

    #[test]
    fn refused_type_is_known_for_both_directions() {
        let (router, _) = router(&[TARGET, OTHER]);
        let (target, other) = (Tid::new(HERE, TARGET), Tid::new(HERE, OTHER));
        let path = TypedPath { source: other, target: TARGET, kind: KIND };
        assert!(!router.refuses_types_between(other, target));
        for (effect, is_refused) in
            [(Effect::Counted, false), (Effect::Refused, true), (Effect::Spoiled, true)]
        {
            let table = Mismatches::new([(path, Mismatch::new(effect))], Arc::new(|| {}));
            assert!(router.set_mismatches(Some(table), router.route_changes()));
            assert_eq!(router.refuses_types_between(other, target), is_refused, "{effect:?}");
            assert_eq!(router.refuses_types_between(target, other), is_refused, "{effect:?}");
        }
        assert!(!router.refuses_types_between(target, SOURCE));
    }

    #[test]
    fn next_owner_of_an_address_is_not_refused() {
        for is_sender in [true, false] {
            let (router, taken) = router(&[TARGET, OTHER]);
            let source = Tid::new(HERE, OTHER);
            let path = TypedPath { source, target: TARGET, kind: KIND };
            let table = || Mismatches::new([(path, Mismatch::new(Effect::Refused))], Arc::new(|| {}));
            assert!(router.set_mismatches(Some(table()), router.route_changes()));
            let send = || {
                let header = Header::new(KIND, source, Tid::new(HERE, TARGET));
                router.send(Message::new(header, Bytes::new()))
            };
            assert_eq!(send(), Err(Rejection::Malformed));
            let (ended, changes) = (if is_sender { OTHER } else { TARGET }, router.route_changes());
            router.remove_local(ended);
            router.set_local(ended, LocalRoute { sink: taken.clone(), events: Arc::new([]) });
            assert_eq!(send(), Ok(()));
            assert!(!router.set_mismatches(Some(table()), changes), "it is of the former owner");
        }
    }
}
