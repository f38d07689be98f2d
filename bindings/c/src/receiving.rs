//! Messages in: handed out, and settled.

use std::{mem::MaybeUninit, time::Duration};

use crate::{
    border::{call, present, write},
    message::{Endpoint, Received, Undelivered},
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
