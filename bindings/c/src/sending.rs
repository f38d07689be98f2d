//! Messages out: lent, filled, sent.

use std::{ffi::c_void, mem::MaybeUninit, time::Duration};

use sinew::{Tid, message::Kind};

use crate::{
    border::{call, present, write},
    message::{Endpoint, KindBits, MemberOutcome, Message, Received, TidBits},
    registration::with,
    session::Session,
    status::{Fault, Status},
    text,
    words::{Outcome, code_of},
};

/// Lends `length` writable bytes, all zeros, for a payload of `kind` to `destination` (the paper's CreateMessage).
/// `message_class` is one of `sinew_message_class`. Does not block. The endpoint's thread; the bytes, any.
///
/// An endpoint lends one message at a time, and until that is sent or discarded nothing else goes out of it: to create
/// another, to send, ask, reply, resolve, join and leave return `SINEW_ERROR_LOAN_ACTIVE`, whatever carries the messages; what
/// `sinew_settle_message` says may wait. So write it at once. The bytes lie in the shared memory from which they are read, if there
/// is room: then sending copies nothing. Else they are ordinary memory. If the process is killed meanwhile, nobody notices more
/// than its end.
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

/// Gives a message back that is not to be sent. `*message` is all zeros then. Does not block. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_discard_message(endpoint: *mut Endpoint, message: Option<&mut Message>) -> Status {
    call(|| {
        let message = present(message, "message")?;
        with(endpoint, |session| session.discard(message)).map(|()| Status::SinewOk)
    })
}

/// Has a message that is being made expire where it waits when it is older than `time_ns`, instead of its type's time to live. An unconfirmed message
/// without one waits for ever; a confirmed one and a request live no longer than they are waited for. At most 71 minutes and 35 s: more counts
/// as that. 0 is `SINEW_ERROR_INVALID_ARGUMENT`. Does not block. The endpoint's thread.
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

/// Has the sending of a message that is being made wait for room no longer than `within_ns`, in place of the `stall_timeout_ns` of the options; with 0 it
/// does not wait at all. For a control loop: `SINEW_ERROR_STALLED` says that there was no room in time and that nothing of the message is received.
/// One that is longer than the ring needs a time in which its receiver takes some of it (with `SINEW_SOCKET_ONLY` it is sent with its first byte,
/// and the rest follows with later calls). A node that has gone is not looked for while the message is sent (`SINEW_ERROR_DISCONNECTED`):
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

/// Sends a message (the paper's SendMessage). What becomes of it then is not told. The message is gone when this returns, sent
/// or not: see Messages at the top. Blocks while there is no room and nothing is taken, for the `stall_timeout_ns` of the
/// options, or as `sinew_room_within` says. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_send_message(endpoint: *mut Endpoint, message: Option<&mut Message>) -> Status {
    call(|| {
        let message = present(message, "message")?;
        with(endpoint, |session| session.send(message)).map(|()| Status::SinewOk)
    })
}

/// Lends, copies and sends in one call. `bytes` may be NULL if `length` is 0. Blocks as `sinew_send_message`. The endpoint's
/// thread.
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

/// Sends a message and waits for what becomes of it; `SINEW_UNKNOWN` when nobody has said so after `within_ns`. The message
/// expires where it waits when it is older. `*outcome` is set if this returns `SINEW_OK`. The message is gone as with
/// `sinew_send_message`. What comes meanwhile waits to be received. Blocks for `within_ns` at most, room included; a longer one
/// counts as the longest time to live of a message, 71 minutes and 35 s. With less than 20 ms a node that has gone is not looked
/// for here (`SINEW_ERROR_DISCONNECTED`): `sinew_receive_message` does. The endpoint's thread.
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
            // First: after any error behind this it is gone.
            let taken = session.take(message)?;
            let outcome = present(outcome, "outcome")?;
            Ok(write(outcome, code_of(session.send_confirmed(taken, within)?)))
        })
    })
}

/// Members of one message to many, at most, that are told what became of it.
pub const SINEW_MEMBERS_MAX: usize = 4_096;

/// Sends a message to a group, to every application or to an address on all nodes, and waits for what becomes of it at each member that is
/// known when the message arrives at its node, without this endpoint. Returns as soon as the last one is settled, and after `within_ns` at
/// the latest: `SINEW_UNKNOWN` of a member without an outcome by then. The first `capacity` of them, in the order of their TIDs, are written
/// to `members`, which may be NULL where that is 0; `*count` is the number of all, `SINEW_MEMBERS_MAX` at most, and 0 for a group without
/// members. Both are set if this returns `SINEW_OK`. `SINEW_ERROR_NOT_HANDLED`: no member has a copy. All else is as with
/// `sinew_send_message_confirmed`. The endpoint's thread.
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
            // First: after any error behind this it is gone.
            let taken = session.take(message)?;
            let count = present(count, "count")?;
            let capacity = capacity.min(SINEW_MEMBERS_MAX);
            // SAFETY: the header asks of the caller that `capacity` members are there, for this call alone; any bytes are a `MaybeUninit`.
            let room = unsafe { text::memory_mut(members.cast::<MaybeUninit<MemberOutcome>>(), capacity) };
            let room =
                room.ok_or_else(|| Fault::argument("`members` is NULL, but has a capacity".to_owned()))?;
            let outcomes = session.send_confirmed_by_each(taken, within)?;
            for (place, member) in room.iter_mut().zip(&outcomes) {
                place.write(MemberOutcome::of(member));
            }
            Ok(write(count, outcomes.len()))
        })
    })
}

/// Sends a message as a request, in class Control, and waits for the reply, `within_ns` at most, room included. `*reply` is
/// set if this returns `SINEW_OK`; settle it when it has been read. If it returns `SINEW_ERROR_NOT_HANDLED` and `outcome` is not
/// NULL, `*outcome` says what became of the request. With 1024 received messages in hand there is no place for a reply:
/// `SINEW_ERROR_TOO_MANY`, and nothing was sent. The message is gone as with `sinew_send_message`. A longer `within_ns` counts as
/// the longest time to live of a message, 71 minutes and 35 s; with less than 20 ms a node that has gone is not looked for here, as with
/// `sinew_send_message_confirmed`. The endpoint's thread.
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
            let taken = session.take(message)?;
            let reply = present(reply, "reply")?;
            match session.ask(taken, within)? {
                Ok(received) => Ok(write(reply, received)),
                Err((ended, fault)) => {
                    if let Some(outcome) = outcome {
                        outcome.write(code_of(ended));
                    }
                    Err(fault)
                }
            }
        })
    })
}

/// Sends a message as the reply to a request in hand; it goes to who asked, whatever destination it was created for. The
/// request is still to be settled. The message is gone as with `sinew_send_message`, as which it blocks. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_reply(
    endpoint: *mut Endpoint,
    request: Option<&Received>,
    message: Option<&mut Message>,
) -> Status {
    call(|| {
        let message = present(message, "message")?;
        with(endpoint, |session| {
            let taken = session.take(message)?;
            session.reply(present(request, "request")?, taken)
        })
        .map(|()| Status::SinewOk)
    })
}

/// A message with these bytes of the caller's.
fn filled(
    session: &mut Session,
    destination: TidBits,
    kind: KindBits,
    message_class: i32,
    (bytes, length): (*const c_void, usize),
) -> Result<Message, Fault> {
    // First, since it says whether so many bytes can be sent at all.
    let mut message = session.create(Tid::from_bits(destination), kind_of(kind)?, message_class, length)?;
    // SAFETY: the header asks of the caller that so many bytes are there while the call lasts; they fit a message.
    let Some(payload) = (unsafe { text::memory(bytes.cast::<u8>(), length) }) else {
        session.discard(&mut message)?;
        return Err(Fault::argument("`bytes` is NULL, but has a length"));
    };
    session.fill(&message, payload);
    Ok(message)
}

/// The kinds of Sinew's own layers are not for applications.
fn kind_of(bits: KindBits) -> Result<Kind, Fault> {
    let kind = Kind::from_bits(bits);
    if kind.is_user() {
        return Ok(kind);
    }
    Err(Fault::argument(format!("`kind` is {bits:#x}: take one from sinew_kind_named")))
}
