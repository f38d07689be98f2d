//! Messages out: lent, filled, sent.

use std::{mem::MaybeUninit, time::Duration};

use sinew::{Kind, Tid};

use crate::{
    border::{call, present, write},
    message::{Endpoint, KindBits, Message, Received, TidBits},
    registration::with,
    status::{Fault, Status},
    text,
    words::{Outcome, code_of},
};

/// Lends `length` writable bytes, all zeros, for a payload of `kind` to `destination` (the paper's CreateMessage).
/// `message_class` is one of `sinew_message_class`. Up to 64 messages may be in the making. Does not block.
///
/// The bytes lie in the shared memory from which they are read, if there is room and no other message of this endpoint in
/// the making lies there already: then sending copies nothing. Until it is sent or discarded, sending anything else the same
/// way returns `SINEW_ERROR_LENT`, and what `sinew_settle_message` says waits: so write it at once. Else they are ordinary
/// memory. If the process is killed meanwhile, nobody notices more than its end.
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

/// Gives a message back that is not to be sent. `*message` is all zeros then. Does not block.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_discard_message(endpoint: *mut Endpoint, message: Option<&mut Message>) -> Status {
    call(|| {
        let message = present(message, "message")?;
        with(endpoint, |session| session.discard(message)).map(|()| Status::SinewOk)
    })
}

/// Sends a message (the paper's SendMessage). What becomes of it is not told. If it is this endpoint's it is gone when this
/// returns, sent or not: `*message` is all zeros then. Blocks for the `patience_ns` of the options at most.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_send_message(endpoint: *mut Endpoint, message: Option<&mut Message>) -> Status {
    call(|| {
        let message = present(message, "message")?;
        with(endpoint, |session| session.send(message)).map(|()| Status::SinewOk)
    })
}

/// Lends, copies and sends in one call. `bytes` may be NULL if `length` is 0. Blocks as `sinew_send_message`.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_send_bytes(
    endpoint: *mut Endpoint,
    destination: TidBits,
    kind: KindBits,
    message_class: i32,
    bytes: *const u8,
    length: usize,
) -> Status {
    call(|| {
        with(endpoint, |session| {
            // First, since it says whether so many bytes can be sent at all.
            let mut message =
                session.create(Tid::from_bits(destination), kind_of(kind)?, message_class, length)?;
            // SAFETY: the header asks of the caller that so many bytes are there while the call lasts; they fit a message.
            let Some(payload) = (unsafe { text::memory(bytes, length) }) else {
                session.discard(&mut message)?;
                return Err(Fault::argument("`bytes` is NULL, but has a length"));
            };
            session.fill(&message, payload);
            session.send(&mut message)
        })
        .map(|()| Status::SinewOk)
    })
}

/// Sends a message and waits for what becomes of it; `SINEW_UNKNOWN` when nobody has said so after `within_ns`. The message
/// expires where it waits when it is older. `*outcome` is set if this returns `SINEW_OK`. The message is gone as with
/// `sinew_send_message`. What comes meanwhile waits to be received.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_send_message_confirmed(
    endpoint: *mut Endpoint,
    message: Option<&mut Message>,
    within_ns: u64,
    outcome: Option<&mut MaybeUninit<Outcome>>,
) -> Status {
    call(|| {
        let message = present(message, "message")?;
        let outcome = present(outcome, "outcome")?;
        let within = Duration::from_nanos(within_ns);
        let ended = with(endpoint, |session| session.send_confirmed(message, within))?;
        Ok(write(outcome, code_of(ended)))
    })
}

/// Sends a message as a request, in class Control, and waits for the reply, `within_ns` at most. `*reply` is set if this
/// returns `SINEW_OK`; settle it when it has been read. If it returns `SINEW_ERROR_NOT_HANDLED` and `outcome` is not NULL,
/// `*outcome` says what became of the request. The message is gone as with `sinew_send_message`.
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
        let reply = present(reply, "reply")?;
        let within = Duration::from_nanos(within_ns);
        match with(endpoint, |session| session.ask(message, within))? {
            Ok(received) => Ok(write(reply, received)),
            Err((ended, fault)) => {
                if let Some(outcome) = outcome {
                    outcome.write(code_of(ended));
                }
                Err(fault)
            }
        }
    })
}

/// Sends a message as the reply to a request in hand; it goes to who asked, whatever destination it was created for. The
/// request is still to be settled. The message is gone as with `sinew_send_message`.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_reply(
    endpoint: *mut Endpoint,
    request: Option<&Received>,
    message: Option<&mut Message>,
) -> Status {
    call(|| {
        let request = present(request, "request")?;
        let message = present(message, "message")?;
        with(endpoint, |session| session.reply(request, message)).map(|()| Status::SinewOk)
    })
}

/// The kinds of Sinew's own layers are not for applications.
fn kind_of(bits: KindBits) -> Result<Kind, Fault> {
    let kind = Kind::from_bits(bits);
    if kind.is_user() {
        return Ok(kind);
    }
    Err(Fault::argument(format!("`kind` is {bits:#x}: take one from sinew_kind_named")))
}
