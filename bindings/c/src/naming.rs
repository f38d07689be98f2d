//! Names, groups, kinds, addresses, and the clock.

use std::{ffi::c_char, mem::MaybeUninit, time::Duration};

use sinew_runtime::{tid::Tid, time::Time, wire::Kind};

use crate::{
    ffi_boundary::{call, present, value, write},
    message::{Endpoint, KindBits, TidBits},
    registration::with,
    status::{CallError, Status},
    text::Text,
};

/// Resolves `name` to the application that has it now, on any node; waits at most for `within_ns`.
/// `SINEW_NOTHING` and a `*tid` of 0 if no application has it. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_resolve(
    endpoint: *mut Endpoint,
    name: Text,
    within_ns: u64,
    tid: Option<&mut MaybeUninit<TidBits>>,
) -> Status {
    call(|| {
        let tid = present(tid, "tid")?;
        let name = name.read("name")?;
        let within = Duration::from_nanos(within_ns);
        let found = with(endpoint, |session| Ok(session.endpoint().resolve(name, within)?))?;
        let status = if found.is_some() { Status::SinewOk } else { Status::SinewNothing };
        write(tid, found.unwrap_or(Tid::NONE).bits());
        Ok(status)
    })
}

/// Joins a group: messages to `sinew_group` of this name reach this endpoint from now on. Waits at most 2 s.
/// The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_join_group(endpoint: *mut Endpoint, name: Text) -> Status {
    call(|| {
        let name = name.read("name")?;
        with(endpoint, |session| Ok(session.endpoint().join(name)?)).map(|()| Status::SinewOk)
    })
}

/// Leaves a group. Waits at most 2 s. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_leave_group(endpoint: *mut Endpoint, name: Text) -> Status {
    call(|| {
        let name = name.read("name")?;
        with(endpoint, |session| Ok(session.endpoint().leave(name)?)).map(|()| Status::SinewOk)
    })
}

/// The address of the group called `name`, for its members on every node; 0 if `name` is no text. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_group(name: Text) -> TidBits {
    value(0, || Ok(Tid::group(name.read("name")?).bits()))
}

/// The kind of the payload type called `name`, the same in every program and language; 0, which no type has,
/// if `name` is no text. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_kind_named(name: Text) -> KindBits {
    value(0, || Ok(Kind::named(name.read("name")?).bits()))
}

/// Parses a TID from `text`, as in `10.0.0.7/1001`. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_tid_parse(text: Text, tid: Option<&mut MaybeUninit<TidBits>>) -> Status {
    call(|| {
        let tid = present(tid, "tid")?;
        let parsed =
            text.read("text")?.parse::<Tid>().map_err(|error| CallError::argument(error.to_string()))?;
        Ok(write(tid, parsed.bits()))
    })
}

/// Writes a TID as text, terminated by a zero, into `capacity` bytes; `SINEW_TID_TEXT` are always enough. Any
/// thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_tid_text(tid: TidBits, text: *mut c_char, capacity: usize) -> Status {
    call(|| {
        if text.is_null() {
            return Err(CallError::argument("`text` is NULL"));
        }
        let written = Tid::from_bits(tid).to_string();
        if written.len() >= capacity {
            let sentence = format!("`capacity` is {capacity}: '{written}' and its zero need more");
            return Err(CallError::argument(sentence));
        }
        // SAFETY: not NULL; the header requires that `capacity` bytes are valid, and the text is shorter.
        unsafe { std::ptr::copy_nonoverlapping(written.as_ptr(), text.cast(), written.len()) };
        // SAFETY: as before; this is the byte after the text, within the capacity.
        let end = unsafe { text.add(written.len()) };
        // SAFETY: as before.
        unsafe { end.write(0) };
        Ok(Status::SinewOk)
    })
}

/// Bytes that the text of any TID needs, its zero included: `255.255.255.255/ffffffff`.
#[allow(dead_code, reason = "it is for C")]
pub const SINEW_TID_TEXT: usize = 32;

/// The current time in nanoseconds of the host's monotonic clock: the clock of `sent_ns`. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_now_ns() -> u64 {
    Time::now().as_nanos()
}
