//! Sending: messages are loaned, filled, sent.

use std::{ffi::c_void, mem::MaybeUninit, time::Duration};

use sinew_runtime::{tid::Tid, wire::Kind};

use crate::{
    ffi_boundary::{call, present, write},
    message::{Endpoint, KindBits, MemberOutcome, Message, Received, TidBits},
    outcome::{Outcome, code_of},
    registration::with,
    session::Session,
    status::{CallError, Status},
    text,
};

/// Loans `length` writable bytes, all zeros, for a payload of `kind` to `destination` (the paper's
/// CreateMessage). `message_class` is one of `sinew_message_class`. Does not block. The endpoint's thread;
/// the bytes, any.
///
/// An endpoint loans one message at a time, and until that is sent or discarded it sends nothing else. Calls
/// that create another message, send, ask, reply, resolve, join or leave return `SINEW_ERROR_LOAN_ACTIVE`,
/// over every transport; outcomes of `sinew_settle_message` may wait. So fill it at once. The bytes are in
/// the shared memory from which the receiver reads them, if there is room: then sending copies nothing. Else
/// they are ordinary memory. If the process is killed during a loan, other processes notice only its end.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_create_message(
    endpoint: *mut Endpoint,
    destination: TidBits,
    kind: KindBits,
    message_class: i32,
    length: usize,
    message: Option<&mut MaybeUninit<Message>>,
) -> Status {
    call(|| {
        let message = present(message, "message")?;
        let created = with(endpoint, |session| {
            session.create(Tid::from_bits(destination), kind_of(kind)?, message_class, length)
        })?;
        Ok(write(message, created))
    })
}

/// Discards a message instead of sending it. `*message` is all zeros then. Does not block. The endpoint's
/// thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_discard_message(endpoint: *mut Endpoint, message: Option<&mut Message>) -> Status {
    call(|| {
        let message = present(message, "message")?;
        with(endpoint, |session| session.discard(message)).map(|()| Status::SinewOk)
    })
}

/// Sets the time to live of a message under construction, in place of its type's: it expires in a queue when
/// it is older than `time_ns`. An unconfirmed message without one never expires; a confirmed one and a
/// request live only as long as their sender waits. At most 71 minutes and 35 s: more counts as that. 0 is
/// `SINEW_ERROR_INVALID_ARGUMENT`. Does not block. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_expires_after(
    endpoint: *mut Endpoint,
    message: Option<&Message>,
    time_ns: u64,
) -> Status {
    call(|| {
        let message = present(message, "message")?;
        with(endpoint, |session| session.set_expires_after(message, time_ns)).map(|()| Status::SinewOk)
    })
}

/// Sets the longest time that the sending of a message under construction waits for room, in place of the
/// `stall_timeout_ns` of the options; with 0 it does not wait at all. For a control loop:
/// `SINEW_ERROR_STALLED` says that there was no room in time and that nothing of the message is received. A
/// message that is longer than the ring needs a time in which its receiver reads a part of it. With
/// `SINEW_SOCKET_ONLY` such a message counts as sent with its first byte, and later calls send the rest. A
/// send with such a time does not look for a node that has gone (`SINEW_ERROR_DISCONNECTED`):
/// `sinew_receive_message`, or a send without such a time, does. Does not block. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_room_within(
    endpoint: *mut Endpoint,
    message: Option<&Message>,
    within_ns: u64,
) -> Status {
    call(|| {
        let message = present(message, "message")?;
        let within = Duration::from_nanos(within_ns);
        with(endpoint, |session| session.set_room_within(message, within)).map(|()| Status::SinewOk)
    })
}

/// Sends a message (the paper's SendMessage), without reporting its outcome. The message is gone when this
/// returns, sent or not: see Messages at the top. Blocks while there is no room and the receiver reads
/// nothing, for the `stall_timeout_ns` of the options, or as `sinew_room_within` says. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_send_message(endpoint: *mut Endpoint, message: Option<&mut Message>) -> Status {
    call(|| {
        let message = present(message, "message")?;
        with(endpoint, |session| session.send(message)).map(|()| Status::SinewOk)
    })
}

/// Loans, copies and sends in one call. `bytes` may be NULL if `length` is 0. Blocks as `sinew_send_message`.
/// The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_send_bytes(
    endpoint: *mut Endpoint,
    destination: TidBits,
    kind: KindBits,
    message_class: i32,
    bytes: *const c_void,
    length: usize,
) -> Status {
    call(|| {
        with(endpoint, |session| {
            let mut message = filled(session, destination, kind, message_class, (bytes, length))?;
            session.send(&mut message)
        })
        .map(|()| Status::SinewOk)
    })
}

/// Sends a message and waits for its outcome; `SINEW_UNKNOWN` if none arrived after `within_ns`. The message
/// expires in a queue when it is older. `*outcome` is set if this returns `SINEW_OK`. The message is gone as
/// with `sinew_send_message`. Messages that arrive meanwhile wait to be received. Blocks at most for
/// `within_ns`, the wait for room included; a longer one counts as the longest time to live of a message, 71
/// minutes and 35 s. With less than 20 ms this does not look for a node that has gone
/// (`SINEW_ERROR_DISCONNECTED`): `sinew_receive_message` does. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_send_message_confirmed(
    endpoint: *mut Endpoint,
    message: Option<&mut Message>,
    within_ns: u64,
    outcome: Option<&mut MaybeUninit<Outcome>>,
) -> Status {
    call(|| {
        let message = present(message, "message")?;
        let within = Duration::from_nanos(within_ns);
        with(endpoint, |session| {
            // First: after any later error it is gone.
            let draft = session.take(message)?;
            let outcome = present(outcome, "outcome")?;
            Ok(write(outcome, code_of(session.send_confirmed(draft, within)?)))
        })
    })
}

/// Maximum number of members of one message to many that have an outcome.
pub const SINEW_MEMBERS_MAX: usize = 4_096;

/// Sends a message to a group, to every application or to an address on all nodes, and waits for its outcome
/// at each member except this endpoint. Members are those that are known when the message arrives at their
/// node. Returns as soon as the last one is settled, and at the latest after `within_ns`: a member without an
/// outcome by then has `SINEW_UNKNOWN`. The first `capacity` outcomes, in the order of the TIDs, are written
/// to `members`, which may be NULL if that is 0. `*count` is the number of all, at most `SINEW_MEMBERS_MAX`,
/// and 0 for a group without members. Both are set if this returns `SINEW_OK`. `SINEW_ERROR_NOT_HANDLED`: no
/// member has a copy. All else is as with `sinew_send_message_confirmed`. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_send_message_confirmed_by_each(
    endpoint: *mut Endpoint,
    message: Option<&mut Message>,
    within_ns: u64,
    members: *mut MemberOutcome,
    capacity: usize,
    count: Option<&mut MaybeUninit<usize>>,
) -> Status {
    call(|| {
        let message = present(message, "message")?;
        let within = Duration::from_nanos(within_ns);
        with(endpoint, |session| {
            // First: after any later error it is gone.
            let draft = session.take(message)?;
            let count = present(count, "count")?;
            let capacity = capacity.min(SINEW_MEMBERS_MAX);
            // SAFETY: the header requires that `capacity` members are valid, for this call only; any bytes
            // are a `MaybeUninit`.
            let room = unsafe { text::memory_mut(members.cast::<MaybeUninit<MemberOutcome>>(), capacity) };
            let room =
                room.ok_or_else(|| CallError::argument("`members` is NULL, but has a capacity".to_owned()))?;
            let outcomes = session.send_confirmed_by_each(draft, within)?;
            for (slot, member) in room.iter_mut().zip(&outcomes) {
                slot.write(MemberOutcome::of(member));
            }
            Ok(write(count, outcomes.len()))
        })
    })
}

/// Sends a message as a request, in class Control, and waits for the reply, at most for `within_ns`, the wait
/// for room included. `*reply` is set if this returns `SINEW_OK`; settle it when it has been read. If it
/// returns `SINEW_ERROR_NOT_HANDLED` and `outcome` is not NULL, `*outcome` is the outcome of the request.
/// With 1024 unsettled messages there is no room for a reply: `SINEW_ERROR_TOO_MANY`, and nothing was sent.
/// The message is gone as with `sinew_send_message`. A longer `within_ns` counts as the longest time to live
/// of a message, 71 minutes and 35 s; with less than 20 ms this does not look for a node that has gone, as
/// with `sinew_send_message_confirmed`. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_ask(
    endpoint: *mut Endpoint,
    message: Option<&mut Message>,
    within_ns: u64,
    reply: Option<&mut MaybeUninit<Received>>,
    outcome: Option<&mut MaybeUninit<Outcome>>,
) -> Status {
    call(|| {
        let message = present(message, "message")?;
        let within = Duration::from_nanos(within_ns);
        with(endpoint, |session| {
            let draft = session.take(message)?;
            let reply = present(reply, "reply")?;
            match session.ask(draft, within)? {
                Ok(received) => Ok(write(reply, received)),
                Err((ended, error)) => {
                    if let Some(outcome) = outcome {
                        outcome.write(code_of(ended));
                    }
                    Err(error)
                }
            }
        })
    })
}

/// Sends a message as the reply to an unsettled request; it goes to the requester, even if it was created for
/// another destination. The request still has to be settled. The message is gone as with
/// `sinew_send_message`, and this blocks as that does. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_reply(
    endpoint: *mut Endpoint,
    request: Option<&Received>,
    message: Option<&mut Message>,
) -> Status {
    call(|| {
        let message = present(message, "message")?;
        with(endpoint, |session| {
            let draft = session.take(message)?;
            session.reply(present(request, "request")?, draft)
        })
        .map(|()| Status::SinewOk)
    })
}

/// Creates a message with the caller's bytes.
fn filled(
    session: &mut Session,
    destination: TidBits,
    kind: KindBits,
    message_class: i32,
    (bytes, length): (*const c_void, usize),
) -> Result<Message, CallError> {
    // First, since it rejects lengths that cannot be sent.
    let mut message = session.create(Tid::from_bits(destination), kind_of(kind)?, message_class, length)?;
    // SAFETY: the header requires that `length` bytes are valid during the call; the length fits a message.
    let Some(payload) = (unsafe { text::memory(bytes.cast::<u8>(), length) }) else {
        session.discard(&mut message)?;
        return Err(CallError::argument("`bytes` is NULL, but has a length"));
    };
    session.fill(&message, payload);
    Ok(message)
}

/// Rejects the kinds of Sinew's own layers, which are not for applications.
fn kind_of(bits: KindBits) -> Result<Kind, CallError> {
    let kind = Kind::from_bits(bits);
    if kind.is_user() {
        return Ok(kind);
    }
    Err(CallError::argument(format!("`kind` is {bits:#x}: take one from sinew_kind_named")))
}
