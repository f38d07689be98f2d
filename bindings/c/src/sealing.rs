//! Protected payloads, sending side: sealed, and sent.

use std::{ffi::c_void, mem::MaybeUninit, time::Duration};

use sinew_runtime::{
    protection,
    protection::{OVERHEAD, raw},
    tid::Tid,
    time::Time,
};

use crate::{
    ffi_boundary::{call, present, write},
    message::{Endpoint, TidBits},
    protection::{DataId, ProtectedType, Stamp, names},
    registration::with,
    status::{CallError, Status},
    text::{self, Text},
};

/// Gives a type of protected payloads, for a message each `period_ns`: two may be late or missing, one in 64
/// bad, and the output may be armed after eight good ones; a message is too old after eight periods. As
/// `Protection::of_period` in Rust. `length` is that of each payload in bytes, 0 for any; class Control.
/// `name` is kept as a pointer. Any thread.
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

/// Seals a payload and sends it to one application; no other receiver accepts it. The library adds the
/// counter, the incarnation and the echo. Echoes arrive while this endpoint is in `sinew_receive_message`, so
/// call that at least four times in `age_max_ns`, with 0 to only poll: without an echo the receiver rejects
/// each message as too old. The payload is at most `sinew_payload_max` less `SINEW_SEALED_OVERHEAD` bytes
/// long. An endpoint has at most 1,024 flows, each of one type to one receiver: one more is
/// `SINEW_ERROR_TOO_MANY`. Blocks as `sinew_send_message`. The endpoint's thread.
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

/// As `sinew_send_protected`, and waits for room as `sinew_room_within` says. A message that was not sent
/// counts as missing at the receiver. The endpoint's thread.
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

/// Seals a payload for a sender that uses another transport than an endpoint, and keeps the counter itself:
/// writes `length + SINEW_SEALED_OVERHEAD` bytes to `sealed`. Its `capacity` is at least that. The two must
/// not overlap. Any thread.
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
            return Err(CallError::argument("`sealed` is NULL"));
        }
        if u32::try_from(length).is_err() {
            return Err(CallError::argument(format!(
                "`length` is {length}: an envelope holds less than 4 GiB"
            )));
        }
        let needed = length.saturating_add(OVERHEAD);
        if capacity < needed {
            return Err(CallError::argument(format!("`capacity` is {capacity}: {needed} bytes are needed")));
        }
        let written = protection::seal(&data_id, stamp, payload((bytes, length))?);
        // SAFETY: not NULL; the header requires that `capacity` bytes are valid, and this is not longer.
        unsafe { std::ptr::copy_nonoverlapping(written.as_ptr(), sealed, written.len()) };
        Ok(Status::SinewOk)
    })
}

/// Checks that these bytes were sealed under this data ID, and gives the sender's stamp; the payload begins
/// at `SINEW_SEALED_HEAD` and is `SINEW_SEALED_OVERHEAD` bytes shorter than `length`. `SINEW_ERROR_MALFORMED`
/// if not. This alone detects only damage and wrong addresses: to act on a message pass it to a guard,
/// `sinew_check_sealed`. Any thread.
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
            let sentence = "it is damaged, or was sealed under another data ID";
            return Err(CallError::new(Status::SinewErrorMalformed, sentence));
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
) -> Result<Status, CallError> {
    let typed = present(payload_type, "payload_type")?.read()?;
    with(endpoint, |session| {
        // First, since it rejects lengths that cannot be sent: no more bytes than that are read.
        session.check_length(bytes.1)?;
        session.send_protected(Tid::from_bits(destination), &typed, payload(bytes)?, within)
    })
    .map(|()| Status::SinewOk)
}

/// Returns the caller's bytes.
pub(crate) fn payload<'call>((bytes, length): (*const c_void, usize)) -> Result<&'call [u8], CallError> {
    if isize::try_from(length).is_err() {
        return Err(CallError::argument(format!("`length` is {length}: no memory is so long")));
    }
    // SAFETY: the header requires that `length` bytes are valid during the call; the length was checked.
    unsafe { text::memory(bytes.cast::<u8>(), length) }
        .ok_or_else(|| CallError::argument("`bytes` is NULL, but has a length"))
}

impl DataId {
    /// Converts to the type of Rust's API: its name stays.
    pub(crate) fn read(&self) -> Result<protection::DataId, CallError> {
        let name = names::kept(self.name.read("data_id.name")?)?;
        let (source, destination) = (Tid::from_bits(self.source), Tid::from_bits(self.destination));
        if !destination.is_single() {
            return Err(CallError::argument(format!(
                "`data_id.destination` is {destination}: it is one application's"
            )));
        }
        Ok(protection::DataId { source, destination, name })
    }
}
