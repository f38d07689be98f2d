//! Both ends of protected messages for a NodeAPI endpoint. It has no context and no timers, so the endpoint
//! supplies messages and times.

use std::{collections::BTreeSet, io, sync::Arc};

use bytes::Bytes;

use super::{
    Cause, Echo, Flows, Guard, Guarded, ProtectionError, Verdict,
    envelope::payload_of,
    raw::{NotSafeError, Protected, Reads, or_panics},
};
use crate::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    time::Time,
    wire::{Header, Kind, Message, Payload, decode, encode},
};

/// The flows of protected messages that one endpoint sends, and the guards of those that it receives.
#[derive(Debug)]
pub struct Ends {
    flows: Flows,
    guards: Vec<GuardEntry>,
    /// The kinds that were ever guarded. They stay guarded, so a protected message is never delivered without
    /// its check.
    kinds: BTreeSet<Kind>,
}

struct GuardEntry {
    guard: Arc<dyn Guarded>,
    kind: Kind,
    /// The valid payloads of the type. A payload is decoded here, and again by the receiver: one that the
    /// receiver cannot decode must not count as good.
    reads: Reads,
    /// When the next echo to the sender is due.
    echo_at: Time,
}

impl std::fmt::Debug for GuardEntry {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "GuardEntry({:?})", self.guard.data_id())
    }
}

/// The result of checking a received message.
#[derive(Debug)]
pub enum Came {
    /// The message is for the receiver unchanged: its kind is not guarded here.
    Plain(Message),
    /// The message is for the receiver, without its envelope: it is good, so it can be decoded, and its output is live.
    Good(Message),
    /// The message was rejected, or was not for the receiver; its sender is notified.
    Settled,
}

/// The result of checking a received payload, for a caller that has only its bytes.
#[derive(Clone, Copy, Debug)]
pub enum Judged<'message> {
    /// The payload is for the receiver unchanged: its kind is not guarded here.
    Plain,
    /// This part of the payload is for the receiver: the message is good, and its output is live.
    Good(&'message [u8]),
    /// The message is not for the receiver; its sender must be notified of this outcome.
    Settled(Outcome),
}

/// The reason why a protected payload cannot be sent. This is an error of the caller; nothing was sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SealError {
    /// The destination is more than one application: each receiver has its own echo and data ID.
    #[error(
        "it is protected, and so for one application, not for a group or for all; send it to each by itself"
    )]
    ToMany,
    /// All 1,024 flows of protected messages, of one type to one receiver each, are in use.
    #[error("this sender uses 1024 flows of protected messages, the maximum; register another endpoint")]
    TooManyFlows,
}

impl Ends {
    /// Creates the ends of an incarnation that began at `now`.
    #[must_use]
    pub const fn new(now: Time) -> Self {
        Self { flows: Flows::new(now), guards: Vec::new(), kinds: BTreeSet::new() }
    }

    /// Builds a message of the value, in its envelope if its type is protected, sent at `now`. `source` and
    /// `receiver` are absolute; `destination` is `receiver` as the caller gave it.
    ///
    /// # Errors
    /// The type is protected, and the value cannot be sealed. A message that is sealed and not sent uses up a counter.
    pub fn message<P: Payload>(
        &self,
        (source, receiver): (Tid, Tid),
        destination: Tid,
        value: &P,
        now: Time,
    ) -> Result<Message, SealError> {
        if P::PROTECTION.is_none() {
            return Ok(Message::of_type::<P>(source, destination, encode(value)));
        }
        check_single(receiver)?;
        let payload = self.flows.seal(source, receiver, value, now).ok_or(SealError::TooManyFlows)?;
        Ok(Message::of_type::<P>(source, destination, payload))
    }

    /// Builds the payload of such a message, for a type that is known at run time only.
    ///
    /// # Errors
    /// The errors of [`message`](Self::message).
    #[doc(hidden)]
    pub fn seal(
        &self,
        (source, receiver): (Tid, Tid),
        protected: &Protected,
        payload: &[u8],
        now: Time,
    ) -> Result<Bytes, SealError> {
        check_single(receiver)?;
        let sealed = self.flows.seal_payload((source, receiver), protected, payload, now);
        sealed.ok_or(SealError::TooManyFlows)
    }

    /// Guards `output`: values of type `P` from `source` to `receiver` control it; see [`Guard::new`]. From
    /// `now` on, [echoes](Self::echo) to their sender are due.
    ///
    /// # Errors
    /// The thread `safe-output` cannot be started or does not have a higher priority than the calling thread,
    /// or this flow is guarded already. Also if [`age_max`](super::Protection::age_max) of the type is below 4
    /// ns, so that no echo could be quoted in time.
    pub fn guard<P: Payload, O: Send + 'static>(
        &mut self,
        (source, receiver): (Tid, Tid),
        now: Time,
        output: O,
        safe: impl FnMut(&mut O, Cause) + Send + 'static,
    ) -> io::Result<Guard<O>> {
        self.hold((source, receiver), Protected::of::<P>(), now, (output, or_panics(safe)))
    }

    /// Same as [`guard`](Self::guard), for a type that is known at run time only; see [`Guard::of`].
    ///
    /// # Errors
    /// The errors of [`guard`](Self::guard) and of [`Guard::of`].
    #[doc(hidden)]
    pub fn hold<O: Send + 'static>(
        &mut self,
        (source, receiver): (Tid, Tid),
        protected: Protected,
        now: Time,
        (output, safe): (O, impl FnMut(&mut O, Cause) -> Result<(), NotSafeError> + Send + 'static),
    ) -> io::Result<Guard<O>> {
        let Protected { name, kind, protection, reads } = protected;
        if protection.echo_period().is_zero() {
            let words = format!(
                "each '{name}' is too old: the age_max of its Payload::PROTECTION is below 4 ns; take that of a period above zero"
            );
            return Err(io::Error::new(io::ErrorKind::InvalidInput, words));
        }
        self.forget_orphans();
        if self.is_held(source, kind) {
            let words =
                format!("what {source} sends of '{name}' is guarded already: keep that guard, or clone it");
            return Err(io::Error::new(io::ErrorKind::AlreadyExists, words));
        }
        let guard = Guard::of((source, receiver), protected, output, safe)?;
        self.kinds.insert(kind);
        self.guards.push(GuardEntry { guard: guard.guarded(), kind, reads, echo_at: now });
        Ok(guard)
    }

    /// Returns whether messages of this type from `source` are guarded.
    #[doc(hidden)]
    #[must_use]
    pub fn is_held(&self, source: Tid, kind: Kind) -> bool {
        self.active().any(|entry| entry.kind == kind && entry.guard.data_id().source == source)
    }

    /// Returns whether no protected message was ever sent or guarded here.
    #[doc(hidden)]
    #[must_use]
    pub fn are_idle(&self) -> bool {
        self.kinds.is_empty() && self.flows.is_empty()
    }

    /// Makes all outputs safe, as [`Guard::trip`] does.
    #[doc(hidden)]
    pub fn trip(&self) {
        self.guards.iter().for_each(|entry| entry.guard.trip());
    }

    /// Returns whether there are guards, of which echoes may be due.
    #[must_use]
    #[inline]
    pub const fn is_guarding(&self) -> bool {
        !self.guards.is_empty()
    }

    /// Checks a received message.
    #[inline]
    pub fn take(&mut self, mut message: Message) -> Came {
        let Header { source, kind, .. } = message.header;
        match self.judge((source, kind), &message.payload) {
            Judged::Plain => Came::Plain(message),
            Judged::Good(payload) => {
                let payload = message.payload.slice_ref(payload);
                message.payload = payload;
                Came::Good(message)
            }
            Judged::Settled(outcome) => {
                message.settle(outcome);
                Came::Settled
            }
        }
    }

    /// Same as [`take`](Self::take), for a caller that has the payload and the source of a message.
    #[doc(hidden)]
    #[inline]
    pub fn judge<'message>(
        &mut self,
        (source, kind): (Tid, Kind),
        payload: &'message [u8],
    ) -> Judged<'message> {
        if kind == Echo::KIND && self.flows.has_flow_to(source) {
            return Judged::Settled(match decode::<Echo>(payload) {
                Ok(echo) => {
                    self.flows.record_echo(source, echo);
                    Outcome::Delivered
                }
                Err(_) => Outcome::Rejected(Rejection::Malformed),
            });
        }
        if !self.kinds.contains(&kind) {
            return Judged::Plain;
        }
        self.forget_orphans();
        let is_of_it = |entry: &&GuardEntry| entry.kind == kind && entry.guard.data_id().source == source;
        let verdict = self.guards.iter().find(is_of_it).map(|entry| entry.guard.check(payload, entry.reads));
        Judged::Settled(Outcome::Rejected(match verdict {
            Some(Verdict::Apply(())) => return Judged::Good(payload_of(payload)),
            Some(Verdict::Refused(ProtectionError::Corrupt | ProtectionError::Unreadable)) => {
                Rejection::Malformed
            }
            Some(Verdict::Hold | Verdict::Refused(_)) => Rejection::ByHandler,
            None => Rejection::Unsupported,
        }))
    }

    /// Returns when the next [`echo`](Self::echo) is due.
    #[must_use]
    pub fn echo_due(&self) -> Option<Time> {
        self.active().map(|entry| entry.echo_at).min()
    }

    /// Removes guards without an owner: a sender that returns has a new TID each time.
    fn forget_orphans(&mut self) {
        self.guards.retain(|entry| !entry.guard.is_orphan());
    }

    /// Returns the next due echo, from `own`. Send it to its destination as soon as possible.
    pub fn echo(&mut self, own: Tid, now: Time) -> Option<Message> {
        self.next_echo(now).map(|(source, echo)| Message::typed(own, source, &echo))
    }

    /// Returns the payload of the next due echo, and its destination.
    #[doc(hidden)]
    pub fn echo_payload(&mut self, now: Time) -> Option<(Tid, Bytes)> {
        self.next_echo(now).map(|(source, echo)| (source, encode(&echo)))
    }

    fn next_echo(&mut self, now: Time) -> Option<(Tid, Echo)> {
        let entry = self.guards.iter_mut().filter(|entry| !entry.guard.is_orphan());
        let entry = entry.min_by_key(|entry| entry.echo_at).filter(|entry| entry.echo_at <= now)?;
        // Not on a grid: a late caller sends one echo, not several.
        entry.echo_at = now + entry.guard.echo_period();
        let (source, kind, at) = (entry.guard.data_id().source, entry.kind, entry.guard.echo());
        let others =
            self.active().filter(|entry| entry.kind != kind && entry.guard.data_id().source == source);
        let others = others.map(|entry| (entry.kind, entry.guard.last_echo().as_nanos())).collect();
        Some((source, Echo { others, ..Echo::new(kind, at) }))
    }

    fn active(&self) -> impl Iterator<Item = &GuardEntry> {
        self.guards.iter().filter(|entry| !entry.guard.is_orphan())
    }
}

const fn check_single(receiver: Tid) -> Result<(), SealError> {
    if receiver.is_single() { Ok(()) } else { Err(SealError::ToMany) }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use serde::{Deserialize, Serialize};

    use super::*;
    use crate::{
        protection::Protection,
        tid::{AppAddress, NodeAddress},
        wire::Header,
    };

    const NOW: Time = Time::from_nanos(1_000_000_000);
    const PROTECTION: Protection = Protection::of_period(Duration::from_millis(1));

    #[derive(Serialize, Deserialize)]
    struct Torque(f32);

    impl Payload for Torque {
        const NAME: &'static str = "test.torque_of_an_endpoint";
        const PROTECTION: Option<Protection> = Some(PROTECTION);
    }

    fn tid(app: u32) -> Tid {
        Tid::new(NodeAddress::from([127, 0, 0, 1]), AppAddress::fixed(app).expect("a fixed one"))
    }

    fn from(app: u32, kind: Kind) -> Message {
        Message::new(Header::new(kind, tid(app), tid(9)), encode(&Torque(1.0)))
    }

    fn guard(ends: &mut Ends) -> io::Result<Guard<()>> {
        ends.guard::<Torque, _>((tid(1), tid(9)), NOW, (), |_, _| {})
    }

    #[test]
    fn guarded_kind_is_received_only_with_a_guard() {
        let mut ends = Ends::new(NOW);
        assert!(matches!(ends.take(from(1, Torque::KIND)), Came::Plain(_)), "nothing is guarded yet");
        let first = guard(&mut ends).expect("a thread");
        assert_eq!(guard(&mut ends).expect_err("it is guarded").kind(), io::ErrorKind::AlreadyExists);
        for app in [1, 2] {
            assert!(matches!(ends.take(from(app, Torque::KIND)), Came::Settled), "not sealed, from {app}");
        }
        assert!(matches!(ends.take(from(1, Kind::named("test.other"))), Came::Plain(_)));
        drop(first);
        assert!(matches!(ends.take(from(1, Torque::KIND)), Came::Settled), "it is still not sealed");
        assert_eq!(ends.echo_due(), None, "nobody is told to go on");
        let _second = guard(&mut ends).expect("the first one is gone");
    }

    #[test]
    fn output_is_dropped_with_its_guard() {
        let (mut ends, output) = (Ends::new(NOW), Arc::new(()));
        for app in 1..=3 {
            let moved = output.clone();
            let guard = ends.guard::<Torque, _>((tid(app), tid(9)), NOW, moved, |_, _| {});
            drop(guard.expect("a thread"));
            assert_eq!((ends.guards.len(), Arc::strong_count(&output)), (1, 2), "{app}");
        }
        // And: the next message of the kind is sufficient; no guard receives it
        assert!(matches!(ends.take(from(3, Torque::KIND)), Came::Settled));
        assert_eq!((ends.guards.len(), Arc::strong_count(&output)), (0, 1));
        assert!(matches!(ends.take(from(4, Torque::KIND)), Came::Settled));
    }

    /// No machine is too slow for this protection.
    #[derive(Serialize, Deserialize)]
    struct Angle {
        radians: f32,
    }

    impl Payload for Angle {
        const NAME: &'static str = "test.angle_of_an_endpoint";
        const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_secs(60)));
    }

    /// The next version of the type in the sender.
    #[derive(Serialize, Deserialize)]
    struct LaterAngle {
        degrees: f32,
    }

    impl Payload for LaterAngle {
        const NAME: &'static str = Angle::NAME;
        const PROTECTION: Option<Protection> = Angle::PROTECTION;
    }

    #[test]
    fn undecodable_message_is_not_received_and_counts_as_bad() {
        let (mut sender, mut receiver) = (Ends::new(NOW), Ends::new(NOW));
        let guard = receiver.guard::<Angle, _>((tid(1), tid(9)), NOW, (), |(), _| {}).expect("a thread");
        let angle = Angle { radians: 1.0 };
        let good =
            |sender: &Ends| sender.message((tid(1), tid(9)), tid(9), &angle, NOW).expect("it is for one");
        good(&sender);
        assert!(matches!(sender.take(receiver.echo(tid(9), NOW).expect("at once")), Came::Settled));
        for _ in 0..8 {
            assert!(matches!(receiver.take(good(&sender)), Came::Settled), "it is not armed");
        }
        guard.arm().expect("good ones have come");
        assert!(matches!(receiver.take(good(&sender)), Came::Good(_)));
        let later = sender.message((tid(1), tid(9)), tid(9), &LaterAngle { degrees: 57.0 }, NOW);
        assert!(matches!(receiver.take(later.expect("it is for one")), Came::Settled));
        assert_eq!((guard.tally().good, guard.tally().unreadable), (9, 1));
        assert!(matches!(receiver.take(good(&sender)), Came::Good(_)), "one is borne, and none is missing");
    }

    #[test]
    fn guard_that_needs_endless_echoes_is_rejected() {
        #[derive(Serialize, Deserialize)]
        struct Instant;

        impl Payload for Instant {
            const NAME: &'static str = "test.instant";
            const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::ZERO));
        }

        let mut ends = Ends::new(NOW);
        let refused = ends.guard::<Instant, _>((tid(1), tid(9)), NOW, (), |_, _| {}).map(drop);
        assert_eq!(refused.expect_err("no age is small enough").kind(), io::ErrorKind::InvalidInput);
        assert!(ends.echo(tid(9), NOW).is_none());
    }

    #[test]
    fn echoes_are_sent_when_due_and_reach_the_sender() {
        let (mut sender, mut receiver) = (Ends::new(NOW), Ends::new(NOW));
        let _guard = guard(&mut receiver).expect("a thread");
        let mut echo = || receiver.echo(tid(9), NOW);
        let (first, none) = (echo().expect("at once"), echo());
        assert!(none.is_none() && first.header.destination == tid(1));
        assert_eq!(receiver.echo_due(), Some(NOW + PROTECTION.echo_period()));
        // A sender that has sent no protected message does not use the echo, and receives it as an ordinary
        // message.
        assert!(matches!(sender.take(first), Came::Plain(_)));
        sender.message((tid(1), tid(9)), tid(9), &Torque(1.0), NOW).expect("it is for one");
        let second = receiver.echo(tid(9), NOW + PROTECTION.echo_period()).expect("it is due");
        assert!(matches!(sender.take(second), Came::Settled));
        let group = Tid::group("test.all");
        assert_eq!(sender.message((tid(1), group), group, &Torque(1.0), NOW).err(), Some(SealError::ToMany));
    }
}
