//! Protection for types that are known at run time only, as in a binding to another language: the input is
//! bytes, the output a verdict. The guards, the ends and the watchdogs are those of Rust's types; each of
//! those types is one [`Protected`].
//!
//! The public types have these further functions for it: [`Guard::of`](super::Guard::of),
//! [`check`](super::Guard::check), [`echo`](super::Guard::echo), [`release`](super::Guard::release),
//! [`is_released`](super::Guard::is_released) and [`is_owed`](super::Guard::is_owed);
//! [`Ends::hold`](super::Ends::hold), [`seal`](super::Ends::seal), [`judge`](super::Ends::judge),
//! [`echo_payload`](super::Ends::echo_payload), [`is_held`](super::Ends::is_held),
//! [`are_idle`](super::Ends::are_idle) and [`trip`](super::Ends::trip).

use std::io;

use super::{Cause, Echo, Protection, safe_output};
pub use super::{ends::Judged, envelope::look, receiver::Verdict};
use crate::wire::{Kind, Payload, decode};

/// The kind of the messages that send a time to quote to a sender.
pub const ECHO: Kind = Echo::KIND;

/// A type of protected payloads.
#[derive(Clone, Copy, Debug)]
pub struct Protected {
    /// The name in data IDs.
    pub name: &'static str,
    /// The kind in messages.
    pub kind: Kind,
    /// The limits of a receiver. `good_min` is at least 1.
    pub protection: Protection,
    /// The valid payloads of the type.
    pub reads: Reads,
}

/// The valid payloads of a type.
#[derive(Clone, Copy, Debug)]
pub enum Reads {
    /// All payloads.
    Any,
    /// Payloads of this length in bytes.
    OfLength(usize),
    /// Payloads that this function accepts.
    By(fn(&[u8]) -> bool),
}

/// The error of a safe function. It is called again, as after a panic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotSafeError;

/// The result of a release.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Released {
    /// The output is safe permanently: its safe function is not called again.
    Now,
    /// The guard was released before.
    Before,
    /// The safe function failed. It is called again until it succeeds; until then the guard exists, and then
    /// it is released.
    NotSafe,
}

/// Starts the watchdog threads of this process, if there are none, as the first guard does. They accept the
/// signals that the calling thread accepts at that time.
///
/// # Errors
/// The errors of [`Guard::new`](super::Guard::new).
pub fn begin() -> io::Result<()> {
    safe_output::started()?;
    Ok(())
}

/// Wraps a safe function that can fail only by a panic.
pub(super) fn or_panics<O: 'static>(
    mut safe: impl FnMut(&mut O, Cause) + Send + 'static,
) -> impl FnMut(&mut O, Cause) -> Result<(), NotSafeError> + Send + 'static {
    move |output: &mut O, cause: Cause| {
        safe(output, cause);
        Ok(())
    }
}

impl Protected {
    /// Returns the description of a Rust type. A type with a protection that cannot be kept is rejected at
    /// compile time.
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
                None => panic!("a guard needs a payload type with a PROTECTION"),
            }
        };
        let reads = Reads::By(|payload| decode::<P>(payload).is_ok());
        Self { name: P::NAME, kind: P::KIND, protection, reads }
    }
}

impl Reads {
    /// Returns whether the payload is a valid value.
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
        protection::{ArmError, Ends, Guard, ProtectionError, State},
        tid::{AppAddress, NodeAddress, Tid},
        time::Time,
    };

    const NOW: Time = Time::from_nanos(1_000_000_000);

    fn tid(app: u32) -> Tid {
        Tid::new(NodeAddress::new(7), AppAddress::new(0x1000 + app))
    }

    /// No machine is too slow for this protection.
    fn angle() -> Protected {
        let protection = Protection::of_period(Duration::from_secs(60));
        let name = "test.raw.angle";
        Protected { name, kind: Kind::named(name), protection, reads: Reads::OfLength(8) }
    }

    /// Both ends, after the first echo, and a live output.
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
    fn payload_of_another_length_is_received_but_not_valid() {
        let (sender, mut receiver, guard) = live();
        let longer = seal(&sender, &[7; 9]);
        assert_eq!(guard.check(&longer, angle().reads), Verdict::Refused(ProtectionError::Unreadable));
        let next = seal(&sender, &[5; 8]);
        let judged = receiver.judge((tid(1), angle().kind), &next);
        assert!(
            matches!(judged, Judged::Good(payload) if payload == [5; 8]),
            "one is borne, and none is missing"
        );
        assert_eq!((guard.tally().unreadable, guard.tally().lost), (1, 0));
    }

    #[test]
    fn released_output_is_never_live_again() {
        let (sender, mut receiver, guard) = live();
        assert_eq!(guard.release(), Released::Now);
        assert_eq!((guard.release(), guard.is_released()), (Released::Before, true));
        // When: valid messages keep arriving for a holder that looked it up before the release.
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
    fn failed_release_is_retried_until_it_succeeds() {
        let (fails, (done, is_done)) = (Arc::new(AtomicBool::new(true)), sync_channel(1));
        let does_fail = fails.clone();
        let safe = move |(): &mut (), _: Cause| {
            if does_fail.load(Ordering::Acquire) {
                return Err(NotSafeError);
            }
            let _ = done.try_send(());
            Ok(())
        };
        let guard = Guard::of((tid(1), tid(3)), angle(), (), safe).expect("a thread");
        assert!(guard.is_owed(), "it has failed at once");
        assert_eq!((guard.release(), guard.is_released()), (Released::NotSafe, false));
        assert_eq!(guard.arm(), Err(ArmError::SafeFails));
        // When: it no longer fails.
        fails.store(false, Ordering::Release);
        is_done.recv_timeout(Duration::from_secs(60)).expect("it is tried until it is done");
        // Then: the successful call completes the release; this call waits for its end.
        assert_eq!((guard.release(), guard.is_owed()), (Released::Before, false));
        assert!(guard.is_released());
    }

    #[test]
    fn repeated_release_may_complete_a_failed_one() {
        let mut tries = 0;
        let safe = move |(): &mut (), _: Cause| {
            tries += 1;
            if tries == 1 { Err(NotSafeError) } else { Ok(()) }
        };
        let guard = Guard::of((tid(1), tid(6)), angle(), (), safe).expect("a thread");
        assert_eq!(guard.release(), Released::Now, "it is tried by then, or now");
        assert_eq!(guard.release(), Released::Before);
    }

    #[test]
    fn guard_that_no_message_would_arm_is_rejected() {
        let protection = Protection { good_min: 0, ..angle().protection };
        let refused = Guard::of((tid(1), tid(5)), Protected { protection, ..angle() }, (), |(), _| Ok(()));
        assert_eq!(refused.map(drop).expect_err("it takes one at least").kind(), io::ErrorKind::InvalidInput);
    }
}
