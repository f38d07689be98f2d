//! Protected payloads, receiving side: outputs that stay safe unless good commands arrive.

use std::{
    ffi::{c_char, c_void},
    mem::MaybeUninit,
};

use sinew_runtime::{
    protection::{State, raw::Verdict},
    tid::Tid,
};

use crate::{
    ffi_boundary::{call, present, write},
    message::{Endpoint, TidBits},
    protection::{
        Command, DataId, MakeSafe, OutputGuard, OutputState, ProtectedType, SealedFault, Tally, code_of,
        guards::{self, Found, Output},
    },
    registration::with,
    sealing::payload,
    status::{CallError, Status},
};

/// Guards `output`: only messages of a protected type that `source` sends to this endpoint move it. `safe` is
/// called to make it safe: at once, since it is not armed, and each time it stops being live. From now on
/// `sinew_receive_message` delivers messages of that type, without their envelopes, only if they are good,
/// come from this sender, and arrive while the output is live. All others are rejected and counted. Act on
/// these messages in `sinew_apply` only.
///
/// The sender has to quote echoes, which are sent to it while this endpoint is in `sinew_receive_message`:
/// call that at least four times in `age_max_ns`. If this endpoint or its sender returns under another
/// address, create the guards anew. `output` may be NULL, and must stay valid until `sinew_release` has
/// released it. Release it before the end of `main`, too. A process has at most 256 guards. The first one
/// starts the thread `safe-output`, which runs the watchdogs with the real-time priority 90, or the highest
/// that is granted (`ulimit -r`). `SINEW_ERROR_SAFE_FAILS`: the first call of `safe` has failed and is
/// retried; the guard is created all the same, and `*guard` set. The endpoint's thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_guard_output(
    endpoint: *mut Endpoint,
    source: TidBits,
    payload_type: Option<&ProtectedType>,
    output: *mut c_void,
    safe: MakeSafe,
    guard: Option<&mut MaybeUninit<*mut OutputGuard>>,
) -> Status {
    call(|| {
        let guard = present(guard, "guard")?;
        let typed = present(payload_type, "payload_type")?.read()?;
        let output = Output { pointer: output, safe: present(safe, "safe")? };
        let made = with(endpoint, |session| session.guard(Tid::from_bits(source), &typed, output))?;
        hand_out(guard, made)
    })
}

/// As `sinew_guard_output`, for messages from another transport than an endpoint: pass each one to
/// `sinew_check_sealed`, and send the result of `sinew_guard_echo` to the sender. The name in the data ID
/// counts, not that of the type. Needs no node. `*guard` is set after `SINEW_ERROR_SAFE_FAILS`, too. Any
/// thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_guard_alone(
    data_id: Option<&DataId>,
    payload_type: Option<&ProtectedType>,
    output: *mut c_void,
    safe: MakeSafe,
    guard: Option<&mut MaybeUninit<*mut OutputGuard>>,
) -> Status {
    call(|| {
        let guard = present(guard, "guard")?;
        let data_id = present(data_id, "data_id")?.read()?;
        let typed = present(payload_type, "payload_type")?.read()?;
        let output = Output { pointer: output, safe: present(safe, "safe")? };
        let ends = (data_id.source, data_id.destination);
        hand_out(guard, guards::make_alone(ends, typed.protected(data_id.name), output)?)
    })
}

/// Checks a sealed message with a guard. `SINEW_OK`: it is good and the output is live; its payload begins at
/// `SINEW_SEALED_HEAD` and is `SINEW_SEALED_OVERHEAD` bytes shorter. `SINEW_NOTHING`: do not use it, since it
/// is bad, or the output is safe. `*fault` is set in both cases; `fault` may be NULL. Pass each message once:
/// the second time it counts as repeated. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_check_sealed(
    guard: *mut OutputGuard,
    sealed: *const c_void,
    length: usize,
    fault: Option<&mut MaybeUninit<SealedFault>>,
) -> Status {
    call(|| {
        let (status, found) = match guards::take(guard.addr(), payload((sealed, length))?)? {
            Verdict::Apply(()) => (Status::SinewOk, SealedFault::SinewFaultNone),
            Verdict::Hold => (Status::SinewNothing, SealedFault::SinewFaultNone),
            Verdict::Refused(wrong) => (Status::SinewNothing, wrong.into()),
        };
        if let Some(fault) = fault {
            fault.write(found);
        }
        Ok(status)
    })
}

/// Gives the time that the sender has to quote as `echo_ns` of its next messages, on the clock of
/// `sinew_now_ns`. Send it to the sender four times in `age_max_ns`: the last eight count. For
/// `sinew_guard_alone`; an endpoint sends its echoes itself. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_guard_echo(guard: *mut OutputGuard, at_ns: Option<&mut MaybeUninit<u64>>) -> Status {
    call(|| {
        let at_ns = present(at_ns, "at_ns")?;
        Ok(write(at_ns, guards::echo(guard.addr())?.as_nanos()))
    })
}

/// Makes the output live: from now on commands pass. Call it when a person has checked that it is safe to
/// move. Nothing does this automatically, and a live output that has become safe stays so until this is
/// called again. `SINEW_ERROR_NOT_GOOD` until `good_min` good messages in a row have arrived, the last one in
/// time; `SINEW_ERROR_SAFE_FAILS` if the output could not be made safe. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_arm(guard: *mut OutputGuard) -> Status {
    call(|| guards::arm(guard.addr()).map(|()| Status::SinewOk))
}

/// Calls `command` with the output and `argument` if the output is live; `safe` of the guard does not run
/// meanwhile. `SINEW_NOTHING`: the output is safe, and `command` was not called. `SINEW_ERROR_SAFE_FAILS`:
/// the same, but making it safe has failed so far. `*state` gives the state and its cause in all three cases;
/// `state` may be NULL. Blocks while another thread uses the output. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_apply(
    guard: *mut OutputGuard,
    command: Command,
    argument: *mut c_void,
    state: Option<&mut MaybeUninit<OutputState>>,
) -> Status {
    call(|| {
        let command = present(command, "command")?;
        let found = guards::apply(guard.addr(), |output| {
            // SAFETY: the header requires of the caller that this may be called with these two arguments.
            unsafe { command(output, argument) };
        })?;
        if let Some(state) = state {
            state.write(code_of(found.state));
        }
        Ok(if found.check()? == State::Live { Status::SinewOk } else { Status::SinewNothing })
    })
}

/// Makes the output safe: at once or, while another thread uses it, as soon as that ends. Does not block, and
/// may be called from the functions that a guard calls. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_trip(guard: *mut OutputGuard) -> Status {
    call(|| guards::trip(guard.addr()).map(|()| Status::SinewOk))
}

/// Gives whether commands reach the output now and, if not, the cause. `SINEW_ERROR_SAFE_FAILS`: they do not,
/// but making it safe has failed so far, so that it may still move; `*state` is set all the same. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_guard_state(
    guard: *mut OutputGuard,
    state: Option<&mut MaybeUninit<OutputState>>,
) -> Status {
    call(|| {
        let state = present(state, "state")?;
        let found = guards::state(guard.addr())?;
        let status = write(state, code_of(found.state));
        found.check()?;
        Ok(status)
    })
}

/// Gives the counts of a guard since it was created. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_guard_tally(
    guard: *mut OutputGuard,
    tally: Option<&mut MaybeUninit<Tally>>,
) -> Status {
    call(|| {
        let tally = present(tally, "tally")?;
        Ok(write(tally, guards::tally(guard.addr())?.into()))
    })
}

/// Makes the output safe and releases the guard: after `SINEW_OK` the library calls no function of it any
/// more, and `*guard` is NULL. After `SINEW_ERROR_SAFE_FAILS` the library keeps trying, and releases it as
/// soon as the output is safe. The output must stay valid until then, which is when another call returns
/// `SINEW_OK` or `SINEW_ERROR_NO_SUCH_GUARD`. Messages of its type to its endpoint are still rejected. Blocks
/// while another thread uses the output. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_release(guard: *mut *mut OutputGuard) -> Status {
    call(|| let_go(guard, guards::release))
}

/// As `sinew_release`, for the functions that a guard calls, which must not wait. Makes the output safe as
/// `sinew_trip` does, and releases the guard as soon as no thread uses the output any more and it is safe.
/// `*guard` is NULL then, and all calls reject it. There is no notice of the library's last call of its
/// functions: `output` and `safe` of the guard must stay valid until the end of the process. Does not block.
/// Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_release_later(guard: *mut *mut OutputGuard) -> Status {
    call(|| let_go(guard, guards::release_later))
}

/// Gives a text for an output's state, one of `sinew_output_state`. Never NULL. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_output_state_text(state: i32) -> *const c_char {
    let texts = [
        c"live: commands reach the output",
        c"safe: it was not armed yet",
        c"safe: no good message came in time",
        c"safe: too many messages in a row are missing",
        c"safe: too many bad messages came",
        c"safe: the sender was restarted",
        c"safe: the host has slept",
        c"safe: it was tripped, or its endpoint unregistered",
        c"safe: its guard is released",
    ];
    let text = usize::try_from(state).ok().and_then(|state| texts.get(state));
    text.map_or(c"no state of an output".as_ptr(), |text| text.as_ptr())
}

/// Returns the handle of a new guard, or an error if its output has not become safe. Sets it in both cases.
fn hand_out(
    guard: &mut MaybeUninit<*mut OutputGuard>,
    (handle, found): (usize, Found),
) -> Result<Status, CallError> {
    let status = write(guard, std::ptr::without_provenance_mut(handle));
    found.check()?;
    Ok(status)
}

/// Calls `release` with a guard and, on success, sets the program's pointer to it to NULL.
fn let_go(
    guard: *mut *mut OutputGuard,
    release: impl FnOnce(usize) -> Result<(), CallError>,
) -> Result<Status, CallError> {
    if guard.is_null() {
        return Err(CallError::plain(Status::SinewErrorNoSuchGuard));
    }
    // SAFETY: not NULL; the header requires that the pointer is valid. No borrow is held: `safe` of the guard
    // may read it, too.
    let held = unsafe { guard.read() };
    release(held.addr())?;
    // SAFETY: as above.
    unsafe { guard.write(std::ptr::null_mut()) };
    Ok(Status::SinewOk)
}
