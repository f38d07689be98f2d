//! Who is meant: names, groups, kinds, addresses, and the clock.

use std::{ffi::c_char, mem::MaybeUninit, time::Duration};

use sinew::{Tid, Time, message::Kind};

use crate::{
    border::{call, present, value, write},
    message::{Endpoint, KindBits, TidBits},
    registration::with,
    status::{Fault, Status},
    text::Text,
};

/// Asks who has `name` now, on any node; waits `within_ns` at most. `SINEW_NOTHING` and a `*tid` of 0 if nobody has it.
/// The endpoint's thread.
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

/// Joins a group: what is sent to `sinew_group` of this name reaches this endpoint from now on. Waits 2 s at most. The
/// endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_join_group(endpoint: *mut Endpoint, name: Text) -> Status {
    call(|| {
        let name = name.read("name")?;
        with(endpoint, |session| Ok(session.endpoint().join(name)?)).map(|()| Status::SinewOk)
    })
}

/// Leaves a group. Waits 2 s at most. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_leave_group(endpoint: *mut Endpoint, name: Text) -> Status {
    call(|| {
        let name = name.read("name")?;
        with(endpoint, |session| Ok(session.endpoint().leave(name)?)).map(|()| Status::SinewOk)
    })
}

/// The members of the group called `name`, on every node; 0 if it is no text. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_group(name: Text) -> TidBits {
    value(0, || Ok(Tid::group(name.read("name")?).bits()))
}

/// The kind of the payload type called `name`, the same in every program and language; 0 if it is no text.
/// Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_kind_named(name: Text) -> KindBits {
    value(0, || Ok(Kind::named(name.read("name")?).bits()))
}

/// The TID that is written in `text`, as in `10.0.0.7/1001`. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_tid_parse(text: Text, tid: Option<&mut MaybeUninit<TidBits>>) -> Status {
    call(|| {
        let tid = present(tid, "tid")?;
        let parsed = text.read("text")?.parse::<Tid>().map_err(|error| Fault::argument(error.to_string()))?;
        Ok(write(tid, parsed.bits()))
    })
}

/// Writes a TID as text, ended by a zero, into `capacity` bytes; `SINEW_TID_TEXT` are always enough. Any
/// thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_tid_text(tid: TidBits, text: *mut c_char, capacity: usize) -> Status {
    call(|| {
        if text.is_null() {
            return Err(Fault::argument("`text` is NULL"));
        }
        let written = Tid::from_bits(tid).to_string();
        if written.len() >= capacity {
            let sentence = format!("`capacity` is {capacity}: '{written}' and its zero need more");
            return Err(Fault::argument(sentence));
        }
        // SAFETY: not NULL; the header asks of the caller that so many bytes are there, and this is shorter.
        unsafe { std::ptr::copy_nonoverlapping(written.as_ptr(), text.cast(), written.len()) };
        // SAFETY: as before; this is the byte after them, within the capacity.
        let end = unsafe { text.add(written.len()) };
        // SAFETY: as before.
        unsafe { end.write(0) };
        Ok(Status::SinewOk)
    })
}

/// Bytes that any TID's text needs, its zero included: `255.255.255.255/ffffffff`.
#[allow(dead_code, reason = "it is for C")]
pub const SINEW_TID_TEXT: usize = 32;

/// The present moment in nanoseconds of the host's monotonic clock: the clock of `sent_ns`. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_now_ns() -> u64 {
    Time::now().as_nanos()
}
