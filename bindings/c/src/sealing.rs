//! Protected payloads out: sealed, and sent.

use std::{ffi::c_void, mem::MaybeUninit, time::Duration};

use sinew::{
    Tid, Time,
    protection::{self, OVERHEAD, raw},
};

use crate::{
    border::{call, present, write},
    message::{Endpoint, TidBits},
    protection::{DataId, ProtectedType, Stamp, names},
    registration::with,
    status::{Fault, Status},
    text::{self, Text},
};

/// A type of payloads that are protected, for a message each `period_ns`: two may be late or missing, one in 64 bad, and the output may be armed
/// after eight good ones; a message is too old after eight periods. As `Protection::of_period` in Rust. `length` is that of each payload in bytes,
/// 0 for any; class Control. `name` is kept as a pointer. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_protected_type_of(name: Text, length: usize, period_ns: u64) -> ProtectedType {
    ProtectedType {
        name,
        length,
        within_ns: period_ns.saturating_mul(3),
        age_max_ns: period_ns.saturating_mul(8),
        lost_max: 2,
        bad_max: 1,
        good_min: 8,
        message_class: 0,
        reserved: 0,
    }
}

/// Seals a payload and sends it, to one application: what it moves there moves for no other one. Counter, life and the echo are added by the
/// library; echoes come while this endpoint is in `sinew_receive_message`, so call that at least four times in `age_max_ns`, with 0 if nothing is to be
/// waited for: without an echo the receiver takes each message for too old. The payload is at most `sinew_payload_max` less `SINEW_SEALED_OVERHEAD` bytes
/// long. An endpoint goes on with 1,024 flows at most, of one type to one receiver each: one more is `SINEW_ERROR_TOO_MANY`. Blocks as
/// `sinew_send_message`. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_send_protected(
    endpoint: *mut Endpoint,
    destination: TidBits,
    payload_type: Option<&ProtectedType>,
    bytes: *const c_void,
    length: usize,
) -> Status {
    call(|| send(endpoint, destination, payload_type, (bytes, length), None))
}

/// The same, and waits for room as `sinew_room_within` says. What was not sent counts as missing at the receiver. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_send_protected_within(
    endpoint: *mut Endpoint,
    destination: TidBits,
    payload_type: Option<&ProtectedType>,
    bytes: *const c_void,
    length: usize,
    within_ns: u64,
) -> Status {
    let within = Some(Duration::from_nanos(within_ns));
    call(|| send(endpoint, destination, payload_type, (bytes, length), within))
}

/// Seals a payload for who sends over something else than an endpoint, and keeps the counter itself: writes
/// `length + SINEW_SEALED_OVERHEAD` bytes to `sealed`, whose `capacity` is at least that. The two must not overlap. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_seal(
    data_id: Option<&DataId>,
    stamp: Option<&Stamp>,
    bytes: *const c_void,
    length: usize,
    sealed: *mut u8,
    capacity: usize,
) -> Status {
    call(|| {
        let data_id = present(data_id, "data_id")?.read()?;
        let &Stamp { counter, incarnation, echo_ns } = present(stamp, "stamp")?;
        let stamp = protection::Stamp { counter, incarnation, echo: Time::from_nanos(echo_ns) };
        if sealed.is_null() {
            return Err(Fault::argument("`sealed` is NULL"));
        }
        if u32::try_from(length).is_err() {
            return Err(Fault::argument(format!("`length` is {length}: an envelope holds less than 4 GiB")));
        }
        let needed = length.saturating_add(OVERHEAD);
        if capacity < needed {
            return Err(Fault::argument(format!("`capacity` is {capacity}: {needed} bytes are needed")));
        }
        let written = protection::seal(&data_id, stamp, payload((bytes, length))?);
        // SAFETY: not NULL; the header asks of the caller that so many bytes are there, and this is not longer.
        unsafe { std::ptr::copy_nonoverlapping(written.as_ptr(), sealed, written.len()) };
        Ok(Status::SinewOk)
    })
}

/// Looks whether these bytes were sealed under this data ID, and what their sender says of them; the payload begins at `SINEW_SEALED_HEAD`
/// and is `SINEW_SEALED_OVERHEAD` bytes shorter than `length`. `SINEW_ERROR_MALFORMED` if not. This alone protects from nothing but damage and wrong addresses:
/// to act on a message let a guard take it, `sinew_check_sealed`. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_unseal(
    data_id: Option<&DataId>,
    sealed: *const c_void,
    length: usize,
    stamp: Option<&mut MaybeUninit<Stamp>>,
) -> Status {
    call(|| {
        let data_id = present(data_id, "data_id")?.read()?;
        let stamp = present(stamp, "stamp")?;
        let Some((found, _)) = raw::look(&data_id, payload((sealed, length))?) else {
            let sentence = "it is damaged, or was sealed by or for somebody else";
            return Err(Fault::new(Status::SinewErrorMalformed, sentence));
        };
        let protection::Stamp { counter, incarnation, echo } = found;
        Ok(write(stamp, Stamp { counter, incarnation, echo_ns: echo.as_nanos() }))
    })
}

fn send(
    endpoint: *mut Endpoint,
    destination: TidBits,
    payload_type: Option<&ProtectedType>,
    bytes: (*const c_void, usize),
    within: Option<Duration>,
) -> Result<Status, Fault> {
    let typed = present(payload_type, "payload_type")?.read()?;
    with(endpoint, |session| {
        // First, since it says whether so many bytes can be sent at all: only so many are looked at.
        session.check_length(bytes.1)?;
        session.send_protected(Tid::from_bits(destination), &typed, payload(bytes)?, within)
    })
    .map(|()| Status::SinewOk)
}

/// These bytes of the caller's.
pub(crate) fn payload<'call>((bytes, length): (*const c_void, usize)) -> Result<&'call [u8], Fault> {
    if isize::try_from(length).is_err() {
        return Err(Fault::argument(format!("`length` is {length}: no memory is so long")));
    }
    // SAFETY: the header asks of the caller that so many bytes are there while the call lasts; how many, was checked.
    unsafe { text::memory(bytes.cast::<u8>(), length) }
        .ok_or_else(|| Fault::argument("`bytes` is NULL, but has a length"))
}

impl DataId {
    /// As Rust says it: its name stays.
    pub(crate) fn read(&self) -> Result<protection::DataId, Fault> {
        let name = names::kept(self.name.read("data_id.name")?)?;
        let (source, destination) = (Tid::from_bits(self.source), Tid::from_bits(self.destination));
        if !destination.is_single() {
            return Err(Fault::argument(format!(
                "`data_id.destination` is {destination}: it is one application's"
            )));
        }
        Ok(protection::DataId { source, destination, name })
    }
}
