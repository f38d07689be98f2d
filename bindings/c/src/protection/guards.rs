//! The runtime's guards, with pointers as outputs, and their handles for C.
//!
//! A lookup never waits, since the thread that makes outputs safe does lookups, too: the function that it
//! calls may trip another guard. So a slot is an atomic pointer. A released guard stays in its slot until
//! another one needs the slot; its memory is freed then.

#[cfg(test)]
mod tests;

use std::{
    cell::Cell,
    ffi::c_void,
    io,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicPtr, AtomicUsize, Ordering},
    },
};

use arc_swap::ArcSwapOption;
use sinew_runtime::{
    protection::{
        ArmError, Cause, Guard, State, Tally,
        raw::{NotSafeError, Protected, Reads, Released, Verdict},
    },
    tid::Tid,
    time::Time,
};

use super::{Ends, OutputState, code_of, watchdog};
use crate::status::{CallError, Status};

/// Maximum number of guards of one process.
const GUARDS_MAX: usize = 256;

/// Makes an output safe; returns 0 on success.
pub(crate) type Safe = unsafe extern "C" fn(output: *mut c_void, why: OutputState) -> i32;

/// An output of the program.
#[derive(Clone, Copy)]
pub(crate) struct Output {
    /// Only the program's functions dereference it.
    pub(crate) pointer: *mut c_void,
    pub(crate) safe: Safe,
}

/// The state of an output as a call found it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Found {
    pub(crate) state: State,
    /// Making it safe has failed so far: whether it is safe is not known.
    pub(crate) has_failed: bool,
}

/// The pointer to an output, which other threads may have, too.
type Pointer = AtomicPtr<c_void>;

struct Held {
    handle: usize,
    guard: Guard<Pointer>,
    reads: Reads,
    /// A thread that was using an output has released this guard: all calls reject the handle.
    is_to_go: AtomicBool,
}

static SLOTS: [ArcSwapOption<Held>; GUARDS_MAX] = [const { ArcSwapOption::const_empty() }; GUARDS_MAX];
/// Serializes the creation of guards.
static MAKING: Mutex<()> = Mutex::new(());
static SERIALS: AtomicUsize = AtomicUsize::new(1);

thread_local! {
    /// Whether this thread is in a function of the program that uses an output.
    static IS_IN_CALLBACK: Cell<bool> = const { Cell::new(false) };
}

/// Creates a guard for messages from another transport than an endpoint, and makes its output safe first.
/// Returns the handle, and the state of the output.
pub(crate) fn make_alone(
    ends: (Tid, Tid),
    protected: Protected,
    output: Output,
) -> Result<(usize, Found), CallError> {
    make(protected.reads, || Guard::of(ends, protected, Pointer::new(output.pointer), output.make_safe()))
}

/// As [`make_alone`], for messages that arrive at an endpoint.
pub(crate) fn make_held(
    held_by: &mut Ends,
    ends: (Tid, Tid),
    protected: Protected,
    output: Output,
) -> Result<(usize, Found), CallError> {
    make(protected.reads, || {
        held_by.hold(ends, protected, Time::now(), (Pointer::new(output.pointer), output.make_safe()))
    })
}

fn make(
    reads: Reads,
    guard: impl FnOnce() -> io::Result<Guard<Pointer>>,
) -> Result<(usize, Found), CallError> {
    check_callback()?;
    watchdog::begin()?;
    let _one_at_a_time = MAKING.lock().unwrap_or_else(PoisonError::into_inner);
    let is_free = |slot: &ArcSwapOption<Held>| slot.load_full().is_none_or(|held| held.guard.is_released());
    let at = SLOTS.iter().position(is_free).ok_or_else(|| {
        let sentence = format!("this process has {GUARDS_MAX} guards already; release one");
        CallError::new(Status::SinewErrorTooMany, sentence)
    })?;
    let guard = guard().map_err(|error| refused(&error))?;
    let found = Found::of(&guard, State::Safe(Cause::NotArmed));
    let handle = next_serial() * GUARDS_MAX + at;
    // The lock keeps other threads from the slot; the guard that was there before is released.
    SLOTS[at].store(Some(Arc::new(Held { handle, guard, reads, is_to_go: AtomicBool::new(false) })));
    Ok((handle, found))
}

/// Checks a message that has arrived.
pub(crate) fn take(handle: usize, sealed: &[u8]) -> Result<Verdict<()>, CallError> {
    with(handle, |held| Ok(held.guard.check(sealed, held.reads)))
}

/// Returns the time that the sender has to quote.
pub(crate) fn echo(handle: usize) -> Result<Time, CallError> {
    with(handle, |held| Ok(held.guard.echo()))
}

/// Calls `command` if the output is live; returns the state in which it found the output.
pub(crate) fn apply(handle: usize, command: impl FnOnce(*mut c_void)) -> Result<Found, CallError> {
    with(handle, |held| {
        let moved = held.guard.apply(|pointer| {
            let output = *pointer.get_mut();
            in_callback(|| command(output));
        });
        Ok(Found::of(&held.guard, moved.map_or_else(State::Safe, |()| State::Live)))
    })
}

/// Makes the output live.
pub(crate) fn arm(handle: usize) -> Result<(), CallError> {
    with(handle, |held| Ok(held.guard.arm()?))
}

/// Makes the output safe: at once or, while a thread uses it, as soon as no thread does. Never waits for
/// that.
pub(crate) fn trip(handle: usize) -> Result<(), CallError> {
    held(handle)?.guard.trip();
    Ok(())
}

pub(crate) fn state(handle: usize) -> Result<Found, CallError> {
    with(handle, |held| Ok(Found::of(&held.guard, held.guard.state())))
}

pub(crate) fn tally(handle: usize) -> Result<Tally, CallError> {
    with(handle, |held| Ok(held.guard.tally()))
}

/// Makes the output safe and releases the guard: then nothing here calls the program's function, or touches
/// the output. If making it safe fails, that is retried, and the guard is released as soon as the output is
/// safe.
pub(crate) fn release(handle: usize) -> Result<(), CallError> {
    with(handle, |held| match held.guard.release() {
        Released::Now => Ok(()),
        // Another thread has just released it.
        Released::Before => Err(no_such()),
        Released::NotSafe => Err(ArmError::SafeFails.into()),
    })
}

/// Trips and releases a guard for a thread that uses an output: all calls reject the handle from now on. The
/// guard is released as soon as no thread uses its output any more. Never waits.
pub(crate) fn release_later(handle: usize) -> Result<(), CallError> {
    let held = held(handle)?;
    if held.is_to_go.swap(true, Ordering::AcqRel) {
        // Another thread has just released it.
        return Err(no_such());
    }
    held.guard.release_later();
    Ok(())
}

impl Held {
    fn is_to_go(&self) -> bool {
        self.is_to_go.load(Ordering::Acquire)
    }

    /// For a thread that uses no output. If the guard was released in the function that returns here, this
    /// completes the release after that function.
    fn finish_release(&self) {
        if self.is_to_go() && !self.guard.is_released() {
            // If that fails it is retried, and the guard released as soon as the output is safe.
            let _ = self.guard.release();
        }
    }
}

impl Found {
    /// An output that was live when it was read has not failed, even if it has become safe since.
    fn of(guard: &Guard<Pointer>, state: State) -> Self {
        Self { state, has_failed: state != State::Live && guard.is_owed() }
    }

    /// Fails if it is not known whether the output is safe.
    pub(crate) fn check(self) -> Result<State, CallError> {
        if self.has_failed { Err(ArmError::SafeFails.into()) } else { Ok(self.state) }
    }
}

impl Output {
    /// Converts to the runtime's type.
    fn make_safe(self) -> impl FnMut(&mut Pointer, Cause) -> Result<(), NotSafeError> + Send + 'static {
        let safe = self.safe;
        move |pointer: &mut Pointer, cause: Cause| {
            let (output, why) = (*pointer.get_mut(), code_of(State::Safe(cause)));
            // SAFETY: the header requires that any thread may call this with this output until the guard is
            // released.
            let failed = in_callback(|| unsafe { safe(output, why) });
            if failed == 0 { Ok(()) } else { Err(NotSafeError) }
        }
    }
}

fn with<R>(handle: usize, body: impl FnOnce(&Held) -> Result<R, CallError>) -> Result<R, CallError> {
    let held = held(handle)?;
    check_callback()?;
    let result = body(&held);
    held.finish_release();
    result
}

fn held(handle: usize) -> Result<Arc<Held>, CallError> {
    let held = SLOTS[handle % GUARDS_MAX].load_full();
    let is_there = |held: &Arc<Held>| held.handle == handle && !held.is_to_go() && !held.guard.is_released();
    let held = held.filter(is_there).ok_or_else(no_such)?;
    watchdog::check_fork()?;
    Ok(held)
}

/// The lowest eight bits of a handle are the slot; the rest is this number, never zero: no handle is NULL.
fn next_serial() -> usize {
    const SERIALS_MAX: usize = usize::MAX / GUARDS_MAX - 1;
    SERIALS.fetch_add(1, Ordering::Relaxed) % SERIALS_MAX + 1
}

/// Runs a function of the program. It may only trip guards, and release them later: two functions that wait
/// for each other's outputs would deadlock, and so would one that waits for its own.
fn in_callback<R>(callback: impl FnOnce() -> R) -> R {
    let before = IS_IN_CALLBACK.replace(true);
    let result = callback();
    IS_IN_CALLBACK.set(before);
    result
}

/// Rejects a thread that uses an output: called before anything that could wait for one.
pub(crate) fn check_callback() -> Result<(), CallError> {
    if !IS_IN_CALLBACK.get() {
        return Ok(());
    }
    let sentence = "while it uses an output, a thread may call only sinew_trip and sinew_release_later; call \
                    others afterwards";
    Err(CallError::new(Status::SinewErrorBusy, sentence))
}

fn no_such() -> CallError {
    CallError::plain(Status::SinewErrorNoSuchGuard)
}

/// Avoidable errors are rejected before; the rest are errors of the system.
fn refused(error: &io::Error) -> CallError {
    let is_the_callers = matches!(error.kind(), io::ErrorKind::InvalidInput | io::ErrorKind::AlreadyExists);
    let status =
        if is_the_callers { Status::SinewErrorInvalidArgument } else { Status::SinewErrorNoWatchdog };
    CallError::new(status, error.to_string())
}

impl From<ArmError> for CallError {
    fn from(error: ArmError) -> Self {
        match error {
            // No guard of this library has a stop.
            ArmError::NotGood { .. } | ArmError::Stopped => {
                Self::new(Status::SinewErrorNotGood, error.to_string())
            }
            ArmError::SafeFails => Self::plain(Status::SinewErrorSafeFails),
        }
    }
}
