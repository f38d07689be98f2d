//! Receiving: messages are delivered, and settled.

use std::{mem::MaybeUninit, time::Duration};

use sinew_runtime::time::Time;

use crate::{
    ffi_boundary::{call, present, value, write},
    message::{Endpoint, Received, Undelivered, nanos},
    outcome::outcome_of,
    registration::with,
    status::{CallError, Status},
};

/// Waits for a message, at most for `within_ns`; `SINEW_NOTHING` if none arrived (the paper's
/// ReceiveMessage). The order is Control, then Stream (only the newest value of each source and kind), then
/// Bulk. `*received` is set if this returns `SINEW_OK`; settle it when it has been handled. Up to 1024 may be
/// unsettled; one more is `SINEW_ERROR_TOO_MANY`, and stays in its queue. With 0 it only polls.
/// `SINEW_ERROR_BUSY` in a function that a guard calls, if this endpoint sends or guards protected payloads.
/// The endpoint's thread.
///
/// Signals do not end the wait: a loop that has to end at a signal uses a short `within_ns` and checks each
/// time.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_receive_message(
    endpoint: *mut Endpoint,
    within_ns: u64,
    received: Option<&mut MaybeUninit<Received>>,
) -> Status {
    call(|| {
        let received = present(received, "received")?;
        match with(endpoint, |session| session.receive(Duration::from_nanos(within_ns)))? {
            Some(message) => Ok(write(received, message)),
            None => Ok(Status::SinewNothing),
        }
    })
}

/// Gives the next report of unconfirmed messages that were not delivered, by this node or another: one for
/// each destination, type and reason, with the number of messages; `SINEW_NOTHING` if there is nothing new.
/// Does not block. The first rejection is reported at once, later ones every 100 ms together. `*undelivered`
/// is set if this returns `SINEW_OK`. This endpoint itself rejects messages if more arrive during a wait for
/// an answer than it keeps then (16,384 messages of each class, 4 MiB and one message). Those are counted
/// with its own TID as the destination. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_next_undelivered(
    endpoint: *mut Endpoint,
    undelivered: Option<&mut MaybeUninit<Undelivered>>,
) -> Status {
    call(|| {
        let undelivered = present(undelivered, "undelivered")?;
        match with(endpoint, |session| Ok(session.endpoint().take_undelivered()))? {
            Some(next) => Ok(write(undelivered, Undelivered::of(&next))),
            None => Ok(Status::SinewNothing),
        }
    })
}

/// Gives the time since a message was sent, with an error of up to its `sent_error_ns`. Returns whether that
/// is known, and leaves `*age_ns` unchanged if not: the clock of the sender's host is not measured yet, or
/// may be wrong by more than 32 s. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_age(received: Option<&Received>, age_ns: Option<&mut MaybeUninit<u64>>) -> bool {
    value(false, || Ok(give_age(present(received, "received")?.age(Time::now()), present(age_ns, "age_ns")?)))
}

/// Gives the maximum age of a message: its age plus the error. Returns whether that is known, and leaves
/// `*age_ns` unchanged if not. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_age_at_most(
    received: Option<&Received>,
    age_ns: Option<&mut MaybeUninit<u64>>,
) -> bool {
    value(false, || {
        let age = present(received, "received")?.age_at_most(Time::now());
        Ok(give_age(age, present(age_ns, "age_ns")?))
    })
}

/// Whether a message may be older than `limit_ns`: for a program that may use fresh values only. An unknown
/// age counts as too old, and so does NULL. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_is_older_than(received: Option<&Received>, limit_ns: u64) -> bool {
    value(true, || {
        let age = present(received, "received")?.age_at_most(Time::now());
        Ok(age.is_none_or(|age| age > Duration::from_nanos(limit_ns)))
    })
}

fn give_age(age: Option<Duration>, age_ns: &mut MaybeUninit<u64>) -> bool {
    age.map(|age| age_ns.write(nanos(age))).is_some()
}

/// Settles a received message: reports its outcome to the sender, if that requested it, and frees its memory.
/// `outcome` is `SINEW_DELIVERED` if it was handled, `SINEW_FAILED`, or one of the rejections. `*received` is
/// all zeros then; after an error it is still unsettled. The endpoint's thread. Does not block.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_settle_message(
    endpoint: *mut Endpoint,
    received: Option<&mut Received>,
    outcome: i32,
) -> Status {
    call(|| {
        let received = present(received, "received")?;
        let outcome = outcome_of(outcome).ok_or_else(|| {
            CallError::argument(format!("`outcome` is {outcome}: take one of sinew_outcome"))
        })?;
        with(endpoint, |session| session.settle(received, outcome)).map(|()| Status::SinewOk)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ages(received: &Received) -> (Option<u64>, Option<u64>) {
        let of = |how: extern "C" fn(Option<&Received>, Option<&mut MaybeUninit<u64>>) -> bool| {
            let mut age_ns = MaybeUninit::new(7);
            let is_known = how(Some(received), Some(&mut age_ns));
            // SAFETY: it was initialized with a value.
            let age_ns = unsafe { age_ns.assume_init() };
            assert!(is_known || age_ns == 7, "it is left as it was");
            is_known.then_some(age_ns)
        };
        (of(sinew_age), of(sinew_age_at_most))
    }

    #[test]
    fn unknown_age_counts_as_too_old() {
        assert_eq!(ages(&Received::GONE), (None, None));
        assert!(sinew_is_older_than(Some(&Received::GONE), u64::MAX));
        assert!(sinew_is_older_than(None, u64::MAX));
        assert!(!sinew_age(None, None) && !sinew_age_at_most(Some(&Received::GONE), None));
    }

    #[test]
    fn age_is_known_with_its_error() {
        let sent_ns = Time::now().as_nanos();
        let received =
            Received { sent_ns, sent_error_ns: 1_000_000_000, is_sent_known: true, ..Received::GONE };
        let (age, at_most) = ages(&received);
        assert!(age.is_some() && at_most >= Some(1_000_000_000));
        assert!(sinew_is_older_than(Some(&received), 999_999_999));
        assert!(!sinew_is_older_than(Some(&received), u64::MAX));
    }
}
