//! Protected payloads in: outputs that are safe unless good commands come.

use std::{
    ffi::{c_char, c_void},
    mem::MaybeUninit,
};

use sinew::{
    Tid,
    protection::{State, raw::Verdict},
};

use crate::{
    border::{call, present, write},
    message::{Endpoint, TidBits},
    protection::{
        Command, DataId, MakeSafe, OutputGuard, OutputState, ProtectedType, SealedFault, Tally, code_of,
        guards::{self, Found, Output},
    },
    registration::with,
    sealing::payload,
    status::{Fault, Status},
};

/// Has `output` moved by what `source` sends to this endpoint of a protected type, and made safe by `safe` when that is not as it has to be: at once, since
/// it is not armed, and whenever it is not live any more. From now on `sinew_receive_message` hands out of that type only messages of this sender's that are
/// good, and that come while the output is live, without their envelopes; others are refused and counted. Act on them in `sinew_apply` alone.
///
/// The sender is told what it has to quote while this endpoint is in `sinew_receive_message`: call that at least four times in `age_max_ns`. An endpoint
/// that came back to another address, or whose sender did, makes its guards anew. `output` may be NULL, and must be there until `sinew_release`
/// has let go of it; release it before the end of `main`, too. A process has 256 guards at most; its first one starts the thread `safe-output`,
/// which keeps the watchdogs with a real-time priority of 90, or the highest that is granted (`ulimit -r`). `SINEW_ERROR_SAFE_FAILS`: `safe` has failed at
/// once and is tried on; the guard is made all the same, and `*guard` set. The endpoint's thread.
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

/// The same for messages that come over something else than an endpoint: hand each to `sinew_check_sealed`, and send what `sinew_guard_echo` says to the
/// sender. The name of the data ID is the one that counts, not that of the type. Needs no node. `*guard` is set after `SINEW_ERROR_SAFE_FAILS`, too.
/// Any thread.
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

/// Has a guard take in a sealed message. `SINEW_OK`: it is good and the output is live; its payload begins at `SINEW_SEALED_HEAD` and is
/// `SINEW_SEALED_OVERHEAD` bytes shorter. `SINEW_NOTHING`: it is not to be used, since it is bad, or the output is safe. `*fault` is set in both
/// cases; `fault` may be NULL. Each message is taken once: the second time it is a repeated one. Any thread.
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

/// The time that the sender is to quote as `echo_ns` of its next messages, on the clock of `sinew_now_ns`. Say it to the sender four times in
/// `age_max_ns`: the last eight count. For `sinew_guard_alone`; an endpoint does so itself. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_guard_echo(guard: *mut OutputGuard, at_ns: Option<&mut MaybeUninit<u64>>) -> Status {
    call(|| {
        let at_ns = present(at_ns, "at_ns")?;
        Ok(write(at_ns, guards::echo(guard.addr())?.as_nanos()))
    })
}

/// Makes the output live: from now on commands pass. Somebody has seen that it is safe to; nothing does this by itself, and a live output that has become
/// safe stays so until this is called again. `SINEW_ERROR_NOT_GOOD` until `good_min` good messages in a row have come, the last one in time;
/// `SINEW_ERROR_SAFE_FAILS` if it could not be made safe. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_arm(guard: *mut OutputGuard) -> Status {
    call(|| guards::arm(guard.addr()).map(|()| Status::SinewOk))
}

/// Calls `command` with the output and `argument` if the output is live, and keeps what makes it safe from doing so meanwhile. `SINEW_NOTHING`: it is safe, and
/// `command` was not called. `SINEW_ERROR_SAFE_FAILS`: the same, and what makes it safe has failed until now. `*state` says since what in all three cases;
/// `state` may be NULL. Blocks while another thread has the output in hand. Any thread.
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
            // SAFETY: the header asks of the caller that this may be called with these two.
            unsafe { command(output, argument) };
        })?;
        if let Some(state) = state {
            state.write(code_of(found.state));
        }
        Ok(if found.check()? == State::Live { Status::SinewOk } else { Status::SinewNothing })
    })
}

/// Makes the output safe: at once or, while another thread has it in hand, as soon as that has not. Does not block, and may be called where a guard
/// calls the program, too. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_trip(guard: *mut OutputGuard) -> Status {
    call(|| guards::trip(guard.addr()).map(|()| Status::SinewOk))
}

/// Whether commands reach the output now and, if not, since what. `SINEW_ERROR_SAFE_FAILS`: they do not, but what makes it safe has failed until now, so
/// that it may move still; `*state` is set all the same. Any thread.
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

/// What the guard has counted since it was made. Any thread.
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

/// Makes the output safe and lets go of it: after `SINEW_OK` the library calls nothing of it any more, and `*guard` is NULL. After
/// `SINEW_ERROR_SAFE_FAILS` it goes on trying, and lets go as soon as the output is safe: the output must be there until then, which is when
/// another call says `SINEW_OK` or `SINEW_ERROR_NO_SUCH_GUARD`. What comes of its type to its endpoint goes on being refused. Blocks while another thread
/// has the output in hand. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_release(guard: *mut *mut OutputGuard) -> Status {
    call(|| let_go(guard, guards::release))
}

/// The same for where a guard calls the program, which may not wait: makes the output safe as `sinew_trip`, and lets go of it as soon as nobody has it in
/// hand any more and it is safe. `*guard` is NULL then, and no call knows it any more. Nobody says when the library calls nothing of it any more: `output`
/// and what makes it safe must be there until the end of the process. Does not block. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn sinew_release_later(guard: *mut *mut OutputGuard) -> Status {
    call(|| let_go(guard, guards::release_later))
}

/// A text for an output's state, one of `sinew_output_state`. Never NULL. Any thread.
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

/// Hands out a guard, whose output may not have become safe.
fn hand_out(
    guard: &mut MaybeUninit<*mut OutputGuard>,
    (handle, found): (usize, Found),
) -> Result<Status, Fault> {
    let status = write(guard, std::ptr::without_provenance_mut(handle));
    found.check()?;
    Ok(status)
}

/// Takes a guard out of a program's pointer to it, if that is how it ends.
fn let_go(
    guard: *mut *mut OutputGuard,
    release: impl FnOnce(usize) -> Result<(), Fault>,
) -> Result<Status, Fault> {
    if guard.is_null() {
        return Err(Fault::plain(Status::SinewErrorNoSuchGuard));
    }
    // SAFETY: not NULL; the header asks of the caller that there is one. It is not borrowed: what makes the output safe may look at it.
    let held = unsafe { guard.read() };
    release(held.addr())?;
    // SAFETY: as above.
    unsafe { guard.write(std::ptr::null_mut()) };
    Ok(Status::SinewOk)
}
