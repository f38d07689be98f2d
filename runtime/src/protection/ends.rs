//! Both ends of protected messages for who has no context and no timers: an endpoint of NodeAPI, which says what came, and when.

use std::{collections::BTreeSet, io, sync::Arc};

use bytes::Bytes;

use super::{
    Cause, Echo, Fault, Flows, Guard, Guarded, Verdict,
    envelope::payload_of,
    raw::{NotSafe, Protected, Reads, or_panics},
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
    held: Vec<Held>,
    /// What has ever been guarded stays so: what is protected is not for who asks for anything.
    kinds: BTreeSet<Kind>,
}

struct Held {
    guard: Arc<dyn Guarded>,
    kind: Kind,
    /// Which payloads are values of that type. They are read here and once more by who receives them: he may not be able to, and then they must
    /// not count.
    reads: Reads,
    /// When its sender is to be told the next time to quote.
    echo_at: Time,
}

impl std::fmt::Debug for Held {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Held({:?})", self.guard.data_id())
    }
}

/// What a message that has come is.
#[derive(Debug)]
pub enum Came {
    /// It is for the receiver, as it came: nothing here guards its kind.
    Plain(Message),
    /// It is for the receiver, without its envelope: it is good, which includes that it can be read, and its output is live.
    Good(Message),
    /// It is refused, or was not for the receiver; its sender is told.
    Settled,
}

/// What is to be done with a message that has come, for who has its bytes.
#[derive(Clone, Copy, Debug)]
pub enum Judged<'message> {
    /// It is for the receiver, as it came: nothing here guards its kind.
    Plain,
    /// This of it is for the receiver: it is good, and its output is live.
    Good(&'message [u8]),
    /// It is not for the receiver; its sender is to be told this.
    Settled(Outcome),
}

/// Why a protected payload cannot be sent. The caller is at fault; nothing was sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SealError {
    /// It is for many: each receiver has an echo and a data ID of its own.
    #[error(
        "it is protected, and so for one application, not for a group or for all; send it to each by itself"
    )]
    ToMany,
    /// There are 1,024 flows of protected messages, of one type to one receiver each, and all of them go on.
    #[error(
        "this sender goes on with 1024 flows of protected messages, which is the most; register another endpoint"
    )]
    TooManyFlows,
}

impl Ends {
    /// Those of a life that began at `now`.
    #[must_use]
    pub const fn new(now: Time) -> Self {
        Self { flows: Flows::new(now), held: Vec::new(), kinds: BTreeSet::new() }
    }

    /// A message of the value, in its envelope if its type is protected, sent at `now`. `source` and `receiver` are absolute; `destination`
    /// is `receiver` as the caller has said it.
    ///
    /// # Errors
    /// Its type is protected, and it cannot be sealed. One that is sealed and not sent then uses up a number.
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

    /// The payload of such a message, for who knows its type at run time alone.
    ///
    /// # Errors
    /// Those of [`message`](Self::message).
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

    /// Has `output` moved by what `source` sends to `receiver` of type `P`; see [`Guard::new`]. From `now` on its sender is to be told
    /// [echoes](Self::echo).
    ///
    /// # Errors
    /// The thread that keeps the watchdogs cannot be started or is not more urgent than this one, this is guarded already, or [`age_max`](super::Protection::age_max) of the
    /// type is below 4 ns, so that no echo could be quoted in time.
    pub fn guard<P: Payload, O: Send + 'static>(
        &mut self,
        (source, receiver): (Tid, Tid),
        now: Time,
        output: O,
        safe: impl FnMut(&mut O, Cause) + Send + 'static,
    ) -> io::Result<Guard<O>> {
        self.hold((source, receiver), Protected::of::<P>(), now, (output, or_panics(safe)))
    }

    /// The same for who knows the type at run time alone; see [`Guard::of`].
    ///
    /// # Errors
    /// Those of [`guard`](Self::guard) and of [`Guard::of`].
    #[doc(hidden)]
    pub fn hold<O: Send + 'static>(
        &mut self,
        (source, receiver): (Tid, Tid),
        protected: Protected,
        now: Time,
        (output, safe): (O, impl FnMut(&mut O, Cause) -> Result<(), NotSafe> + Send + 'static),
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
        self.held.push(Held { guard: guard.guarded(), kind, reads, echo_at: now });
        Ok(guard)
    }

    /// Whether what `source` sends of this type is guarded.
    #[doc(hidden)]
    #[must_use]
    pub fn is_held(&self, source: Tid, kind: Kind) -> bool {
        self.live().any(|held| held.kind == kind && held.guard.data_id().source == source)
    }

    /// Whether nothing protected was ever sent or guarded here.
    #[doc(hidden)]
    #[must_use]
    pub fn are_idle(&self) -> bool {
        self.kinds.is_empty() && self.flows.are_none()
    }

    /// Makes all outputs safe, as [`Guard::trip`] does.
    #[doc(hidden)]
    pub fn trip(&self) {
        self.held.iter().for_each(|held| held.guard.trip());
    }

    /// Takes a message in that has come.
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

    /// The same for who has the bytes of a message, and who sent it.
    #[doc(hidden)]
    pub fn judge<'message>(
        &mut self,
        (source, kind): (Tid, Kind),
        payload: &'message [u8],
    ) -> Judged<'message> {
        if kind == Echo::KIND && self.flows.are_to(source) {
            return Judged::Settled(match decode::<Echo>(payload) {
                Ok(echo) => {
                    self.flows.heard(source, echo);
                    Outcome::Delivered
                }
                Err(_) => Outcome::Rejected(Rejection::Malformed),
            });
        }
        if !self.kinds.contains(&kind) {
            return Judged::Plain;
        }
        self.forget_orphans();
        let is_of_it = |held: &&Held| held.kind == kind && held.guard.data_id().source == source;
        let verdict = self.held.iter().find(is_of_it).map(|held| held.guard.check(payload, held.reads));
        Judged::Settled(Outcome::Rejected(match verdict {
            Some(Verdict::Apply(())) => return Judged::Good(payload_of(payload)),
            Some(Verdict::Refused(Fault::Corrupt | Fault::Unreadable)) => Rejection::Malformed,
            Some(Verdict::Hold | Verdict::Refused(_)) => Rejection::ByHandler,
            None => Rejection::Unsupported,
        }))
    }

    /// When [`echo`](Self::echo) has something to say next.
    #[must_use]
    pub fn echo_due(&self) -> Option<Time> {
        self.live().map(|held| held.echo_at).min()
    }

    /// Lets go of the outputs of guards that nobody has any more: a sender that comes back has a TID of its own each time.
    fn forget_orphans(&mut self) {
        self.held.retain(|held| !held.guard.is_orphan());
    }

    /// The next echo that is due, from `own`; its sender is told it whenever it can be.
    pub fn echo(&mut self, own: Tid, now: Time) -> Option<Message> {
        self.next_echo(now).map(|(source, echo)| Message::typed(own, source, &echo))
    }

    /// Its payload, and whom it is for.
    #[doc(hidden)]
    pub fn echo_payload(&mut self, now: Time) -> Option<(Tid, Bytes)> {
        self.next_echo(now).map(|(source, echo)| (source, encode(&echo)))
    }

    fn next_echo(&mut self, now: Time) -> Option<(Tid, Echo)> {
        let held = self.held.iter_mut().filter(|held| !held.guard.is_orphan());
        let held = held.min_by_key(|held| held.echo_at).filter(|held| held.echo_at <= now)?;
        // Not on a grid: who looks late says one and not many.
        held.echo_at = now + held.guard.echo_period();
        let (source, kind, at) = (held.guard.data_id().source, held.kind, held.guard.echo());
        let others = self.live().filter(|held| held.kind != kind && held.guard.data_id().source == source);
        let others = others.map(|held| (held.kind, held.guard.last_echo().as_nanos())).collect();
        Some((source, Echo { others, ..Echo::new(kind, at) }))
    }

    fn live(&self) -> impl Iterator<Item = &Held> {
        self.held.iter().filter(|held| !held.guard.is_orphan())
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
    fn what_a_guard_was_made_for_is_for_nobody_without_it() {
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
    fn an_output_goes_with_its_guard_whatever_its_sender_is_called_later() {
        let (mut ends, output) = (Ends::new(NOW), Arc::new(()));
        for app in 1..=3 {
            let moved = output.clone();
            let guard = ends.guard::<Torque, _>((tid(app), tid(9)), NOW, moved, |_, _| {});
            drop(guard.expect("a thread"));
            assert_eq!((ends.held.len(), Arc::strong_count(&output)), (1, 2), "{app}");
        }
        // And: the next message of the kind is enough, which is for nobody
        assert!(matches!(ends.take(from(3, Torque::KIND)), Came::Settled));
        assert_eq!((ends.held.len(), Arc::strong_count(&output)), (0, 1));
        assert!(matches!(ends.take(from(4, Torque::KIND)), Came::Settled));
    }

    /// For whom no machine is too slow.
    #[derive(Serialize, Deserialize)]
    struct Angle {
        radians: f32,
    }

    impl Payload for Angle {
        const NAME: &'static str = "test.angle_of_an_endpoint";
        const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_secs(60)));
    }

    /// The sender's next version of it.
    #[derive(Serialize, Deserialize)]
    struct LaterAngle {
        degrees: f32,
    }

    impl Payload for LaterAngle {
        const NAME: &'static str = Angle::NAME;
        const PROTECTION: Option<Protection> = Angle::PROTECTION;
    }

    #[test]
    fn what_cannot_be_read_is_not_received_and_counts_as_bad() {
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
    fn a_guard_that_would_have_to_be_told_echoes_all_the_time_is_refused() {
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
    fn echoes_are_said_when_they_are_due_and_heard_by_who_sends() {
        let (mut sender, mut receiver) = (Ends::new(NOW), Ends::new(NOW));
        let _guard = guard(&mut receiver).expect("a thread");
        let mut echo = || receiver.echo(tid(9), NOW);
        let (first, none) = (echo().expect("at once"), echo());
        assert!(none.is_none() && first.header.destination == tid(1));
        assert_eq!(receiver.echo_due(), Some(NOW + PROTECTION.echo_period()));
        // Who sends it nothing that is protected has no use for it, and does not know it.
        assert!(matches!(sender.take(first), Came::Plain(_)));
        sender.message((tid(1), tid(9)), tid(9), &Torque(1.0), NOW).expect("it is for one");
        let second = receiver.echo(tid(9), NOW + PROTECTION.echo_period()).expect("it is due");
        assert!(matches!(sender.take(second), Came::Settled));
        let group = Tid::group("test.all");
        assert_eq!(sender.message((tid(1), group), group, &Torque(1.0), NOW).err(), Some(SealError::ToMany));
    }
}
