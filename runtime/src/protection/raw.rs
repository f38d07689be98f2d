//! Protection for who knows a type at run time alone, as a binding to another language does: bytes in, verdict out. The guards, the ends and
//! the watchdogs are those of Rust's types, which are one [`Protected`] each.
//!
//! What is here beside it, all of it on the types that everybody has: [`Guard::of`](super::Guard::of), [`check`](super::Guard::check),
//! [`echo`](super::Guard::echo), [`release`](super::Guard::release), [`is_released`](super::Guard::is_released) and [`is_owed`](super::Guard::is_owed);
//! [`Ends::hold`](super::Ends::hold), [`seal`](super::Ends::seal), [`judge`](super::Ends::judge), [`echo_payload`](super::Ends::echo_payload),
//! [`is_held`](super::Ends::is_held), [`are_idle`](super::Ends::are_idle) and [`trip`](super::Ends::trip).

use std::io;

use super::{Cause, Echo, Protection, keeper};
pub use super::{ends::Judged, envelope::look, receiver::Verdict};
use crate::wire::{Kind, Payload, decode};

/// The kind of the messages that tell a sender what to quote.
pub const ECHO: Kind = Echo::KIND;

/// A type of protected payloads.
#[derive(Clone, Copy, Debug)]
pub struct Protected {
    /// What data IDs call it.
    pub name: &'static str,
    /// What messages call it.
    pub kind: Kind,
    /// What a receiver bears. `good_min` is at least 1.
    pub protection: Protection,
    /// Which payloads are values of it.
    pub reads: Reads,
}

/// Which payloads are values of a type.
#[derive(Clone, Copy, Debug)]
pub enum Reads {
    /// All of them.
    Any,
    /// Those of so many bytes.
    OfLength(usize),
    /// Those of which this says so.
    By(fn(&[u8]) -> bool),
}

/// What makes an output safe says that it has failed. It is called again, as where it panics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotSafe;

/// What came of a release.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Released {
    /// The output is safe for good: what makes it safe is not called any more.
    Now,
    /// It was released before.
    Before,
    /// What makes the output safe has failed. That is tried on, and it is a guard until it is done; then it is released.
    NotSafe,
}

/// Starts the threads that keep the watchdogs of this process, if there are none, as the first guard does. They take the signals that the calling
/// thread takes then.
///
/// # Errors
/// Those of [`Guard::new`](super::Guard::new).
pub fn begin() -> io::Result<()> {
    keeper::begun()?;
    Ok(())
}

/// What makes an output safe and has no word for a failure but a panic.
pub(super) fn or_panics<O: 'static>(
    mut safe: impl FnMut(&mut O, Cause) + Send + 'static,
) -> impl FnMut(&mut O, Cause) -> Result<(), NotSafe> + Send + 'static {
    move |output: &mut O, cause: Cause| {
        safe(output, cause);
        Ok(())
    }
}

impl Protected {
    /// One of Rust's. It has a protection that can be kept, or the program is not compiled.
    pub(super) fn of<P: Payload>() -> Self {
        let protection = const {
            match P::PROTECTION {
                Some(protection) => {
                    assert!(
                        protection.good_min > 0,
                        "an output is armed by good messages: `good_min` is at least 1"
                    );
                    protection
                }
                None => panic!("a guard is for a payload whose PROTECTION says what is borne"),
            }
        };
        let reads = Reads::By(|payload| decode::<P>(payload).is_ok());
        Self { name: P::NAME, kind: P::KIND, protection, reads }
    }
}

impl Reads {
    /// Whether this is a value.
    #[must_use]
    pub fn is_value(self, payload: &[u8]) -> bool {
        match self {
            Self::Any => true,
            Self::OfLength(length) => payload.len() == length,
            Self::By(reads) => reads(payload),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::{
            Arc,
            atomic::{AtomicBool, Ordering},
            mpsc::sync_channel,
        },
        time::Duration,
    };

    use super::*;
    use crate::{
        outcome::Outcome,
        protection::{ArmError, Ends, Fault, Guard, State},
        tid::{AppAddress, NodeAddress, Tid},
        time::Time,
    };

    const NOW: Time = Time::from_nanos(1_000_000_000);

    fn tid(app: u32) -> Tid {
        Tid::new(NodeAddress::new(7), AppAddress::new(0x1000 + app))
    }

    /// For whom no machine is too slow.
    fn angle() -> Protected {
        let protection = Protection::of_period(Duration::from_secs(60));
        let name = "test.raw.angle";
        Protected { name, kind: Kind::named(name), protection, reads: Reads::OfLength(8) }
    }

    /// Both ends, of which the one has heard of the other, and an output that is live.
    fn live() -> (Ends, Ends, Guard<()>) {
        let (mut sender, mut receiver) = (Ends::new(NOW), Ends::new(NOW));
        let guard =
            receiver.hold((tid(1), tid(2)), angle(), NOW, ((), |(): &mut (), _| Ok(()))).expect("a thread");
        seal(&sender, &[7; 8]);
        let (to, echo) = receiver.echo_payload(NOW).expect("at once");
        assert_eq!(to, tid(1));
        let heard = sender.judge((tid(2), ECHO), &echo);
        assert!(matches!(heard, Judged::Settled(Outcome::Delivered)));
        for _ in 0..8 {
            let sealed = seal(&sender, &[7; 8]);
            assert!(matches!(receiver.judge((tid(1), angle().kind), &sealed), Judged::Settled(_)));
        }
        guard.arm().expect("good ones have come");
        (sender, receiver, guard)
    }

    fn seal(sender: &Ends, payload: &[u8]) -> bytes::Bytes {
        sender.seal((tid(1), tid(2)), &angle(), payload, NOW).expect("it is for one")
    }

    #[test]
    fn a_payload_of_another_length_has_come_and_is_not_good() {
        let (sender, mut receiver, guard) = live();
        let longer = seal(&sender, &[7; 9]);
        assert_eq!(guard.check(&longer, angle().reads), Verdict::Refused(Fault::Unreadable));
        let next = seal(&sender, &[5; 8]);
        let judged = receiver.judge((tid(1), angle().kind), &next);
        assert!(
            matches!(judged, Judged::Good(payload) if payload == [5; 8]),
            "one is borne, and none is missing"
        );
        assert_eq!((guard.tally().unreadable, guard.tally().lost), (1, 0));
    }

    #[test]
    fn what_is_released_is_never_live_again_and_nobody_hears_of_it() {
        let (sender, mut receiver, guard) = live();
        assert_eq!(guard.release(), Released::Now);
        assert_eq!((guard.release(), guard.is_released()), (Released::Before, true));
        // When: good ones go on coming for somebody who has looked it up before that.
        for _ in 0..16 {
            assert_eq!(guard.check(&seal(&sender, &[7; 8]), angle().reads), Verdict::Hold);
        }
        assert!(guard.arm().is_err() && guard.state() != State::Live);
        assert_eq!(receiver.echo_due(), None);
        let sealed = seal(&sender, &[7; 8]);
        let judged = receiver.judge((tid(1), angle().kind), &sealed);
        assert!(matches!(judged, Judged::Settled(_)), "it is still not for everybody");
    }

    #[test]
    fn an_output_of_which_it_is_said_that_it_is_not_safe_is_tried_again_and_released_when_it_is() {
        let (fails, (done, is_done)) = (Arc::new(AtomicBool::new(true)), sync_channel(1));
        let does_fail = fails.clone();
        let safe = move |(): &mut (), _: Cause| {
            if does_fail.load(Ordering::Acquire) {
                return Err(NotSafe);
            }
            let _ = done.try_send(());
            Ok(())
        };
        let guard = Guard::of((tid(1), tid(3)), angle(), (), safe).expect("a thread");
        assert!(guard.is_owed(), "it has failed at once");
        assert_eq!((guard.release(), guard.is_released()), (Released::NotSafe, false));
        assert_eq!(guard.arm(), Err(ArmError::SafeFails));
        // When: it does not fail any more.
        fails.store(false, Ordering::Release);
        is_done.recv_timeout(Duration::from_secs(60)).expect("it is tried until it is done");
        // Then: who does that finishes the release; this waits until it is done with that.
        assert_eq!((guard.release(), guard.is_owed()), (Released::Before, false));
        assert!(guard.is_released());
    }

    #[test]
    fn who_asks_again_for_a_release_that_has_failed_may_be_the_one_that_does_it() {
        let mut tries = 0;
        let safe = move |(): &mut (), _: Cause| {
            tries += 1;
            if tries == 1 { Err(NotSafe) } else { Ok(()) }
        };
        let guard = Guard::of((tid(1), tid(6)), angle(), (), safe).expect("a thread");
        assert_eq!(guard.release(), Released::Now, "it is tried by then, or now");
        assert_eq!(guard.release(), Released::Before);
    }

    #[test]
    fn a_guard_that_no_message_would_have_to_arm_is_refused() {
        let protection = Protection { good_min: 0, ..angle().protection };
        let refused = Guard::of((tid(1), tid(5)), Protected { protection, ..angle() }, (), |(), _| Ok(()));
        assert_eq!(refused.map(drop).expect_err("it takes one at least").kind(), io::ErrorKind::InvalidInput);
    }
}
