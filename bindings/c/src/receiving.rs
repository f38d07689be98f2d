//! Messages in: handed out, and settled.

use std::{mem::MaybeUninit, time::Duration};

use sinew::Time;

use crate::{
    border::{call, present, value, write},
    message::{Endpoint, Received, Undelivered, nanos},
    registration::with,
    status::{Fault, Status},
    words::outcome_of,
};

/// Waits for a message, `within_ns` at most; `SINEW_NOTHING` if none came (the paper's ReceiveMessage). Control comes first,
/// then Stream, of which only the newest value of each source and kind, then Bulk. `*received` is set if this returns
/// `SINEW_OK`; settle it when it has been handled. Up to 1024 may be in hand; one more is `SINEW_ERROR_TOO_MANY`, and stays
/// where it waits. With 0 it only looks. `SINEW_ERROR_BUSY` where a guard calls the program, if anything protected was sent or guarded here. The endpoint's
/// thread.
///
/// Signals do not end the wait: a loop that is to end at one takes a short `within_ns` and looks each time.
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

/// Gives the next report of unconfirmed messages that were not delivered, by this node or another: one for each destination, type and
/// reason, with the number of messages; `SINEW_NOTHING` if there is nothing new. Does not block. The first refusal is reported at once,
/// later ones every 100 ms together. `*undelivered` is set if this returns `SINEW_OK`. What
/// this endpoint itself has refused, since it came while an answer was waited for and was more than is kept then (16,384 messages
/// of each class, 4 MiB and one message), is counted with its own TID as the destination. The endpoint's thread.
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

/// Gives the time since a message was sent, as wrong as its `sent_error_ns` says. Returns whether that is known, and leaves `*age_ns` as it is where
/// it is not: the clock of the sender's host is not measured yet, or may be wrong by more than 32 s. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_age(received: Option<&Received>, age_ns: Option<&mut MaybeUninit<u64>>) -> bool {
    value(false, || Ok(give_age(present(received, "received")?.age(Time::now()), present(age_ns, "age_ns")?)))
}

/// Gives the greatest age that a message can have: its age and the error of that. Returns whether that is known, and leaves `*age_ns` as it is
/// where it is not. Any thread.
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

/// Whether a message may be older than `limit_ns`: for a program that may use fresh values only. An unknown age counts as too old, and so does
/// NULL. Any thread.
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

/// Says what became of a message in hand, which its sender is told if it asked, and gives its memory back. `outcome` is
/// `SINEW_DELIVERED` if it was handled, `SINEW_FAILED`, or one of the rejections. `*received` is all zeros then; after
/// an error it is still in hand. The endpoint's thread. Does not block.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_settle_message(
    endpoint: *mut Endpoint,
    received: Option<&mut Received>,
    outcome: i32,
) -> Status {
    call(|| {
        let received = present(received, "received")?;
        let outcome = outcome_of(outcome)
            .ok_or_else(|| Fault::argument(format!("`outcome` is {outcome}: take one of sinew_outcome")))?;
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
            // SAFETY: it was made with a value.
            let age_ns = unsafe { age_ns.assume_init() };
            assert!(is_known || age_ns == 7, "it is left as it was");
            is_known.then_some(age_ns)
        };
        (of(sinew_age), of(sinew_age_at_most))
    }

    #[test]
    fn an_age_that_is_not_known_is_no_number_and_counts_as_too_old() {
        assert_eq!(ages(&Received::GONE), (None, None));
        assert!(sinew_is_older_than(Some(&Received::GONE), u64::MAX));
        assert!(sinew_is_older_than(None, u64::MAX));
        assert!(!sinew_age(None, None) && !sinew_age_at_most(Some(&Received::GONE), None));
    }

    #[test]
    fn an_age_is_known_with_its_error() {
        let sent_ns = Time::now().as_nanos();
        let received =
            Received { sent_ns, sent_error_ns: 1_000_000_000, is_sent_known: true, ..Received::GONE };
        let (age, at_most) = ages(&received);
        assert!(age.is_some() && at_most >= Some(1_000_000_000));
        assert!(sinew_is_older_than(Some(&received), 999_999_999));
        assert!(!sinew_is_older_than(Some(&received), u64::MAX));
    }
}
