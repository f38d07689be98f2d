//! The runtime's guards, whose outputs are pointers here, and the handles by which C knows them.
//!
//! Whoever looks one up waits for nobody, as the thread that makes outputs safe does so, too: what it calls may trip another guard. So a place is
//! an atomic pointer, and a guard that was released lies in its place until another one needs it, which is where its memory is given back.

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
use sinew::{
    Tid, Time,
    protection::{
        ArmError, Cause, Guard, State, Tally,
        raw::{NotSafe, Protected, Reads, Released, Verdict},
    },
};

use super::{Ends, OutputState, code_of, watchdog};
use crate::status::{Fault, Status};

/// Guards of one process at most.
const GUARDS_MAX: usize = 256;

/// What makes an output safe; 0 if it has.
pub(crate) type Safe = unsafe extern "C" fn(output: *mut c_void, why: OutputState) -> i32;

/// An output of the program's.
#[derive(Clone, Copy)]
pub(crate) struct Output {
    /// For the program's functions alone.
    pub(crate) pointer: *mut c_void,
    pub(crate) safe: Safe,
}

/// How an output is found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Found {
    pub(crate) state: State,
    /// What makes it safe has failed until now: whether it is safe is not known.
    pub(crate) is_owed: bool,
}

/// The pointer to an output, which other threads may have.
type Pointer = AtomicPtr<c_void>;

struct Held {
    handle: usize,
    guard: Guard<Pointer>,
    reads: Reads,
    /// Somebody has let go of it who had an output in hand: no call knows it any more.
    is_to_go: AtomicBool,
}

static PLACES: [ArcSwapOption<Held>; GUARDS_MAX] = [const { ArcSwapOption::const_empty() }; GUARDS_MAX];
/// One guard is made at a time.
static MAKING: Mutex<()> = Mutex::new(());
static SERIALS: AtomicUsize = AtomicUsize::new(1);

thread_local! {
    /// This thread is in a function of the program's that has an output in hand.
    static IS_IN_CALLBACK: Cell<bool> = const { Cell::new(false) };
}

/// Makes a guard for messages that come over something else than an endpoint, whose output is made safe first; its handle, and how the output is found.
pub(crate) fn make_alone(
    ends: (Tid, Tid),
    protected: Protected,
    output: Output,
) -> Result<(usize, Found), Fault> {
    make(protected.reads, || Guard::of(ends, protected, Pointer::new(output.pointer), output.make_safe()))
}

/// The same for what comes to an endpoint.
pub(crate) fn make_held(
    held_by: &mut Ends,
    ends: (Tid, Tid),
    protected: Protected,
    output: Output,
) -> Result<(usize, Found), Fault> {
    make(protected.reads, || {
        held_by.hold(ends, protected, Time::now(), (Pointer::new(output.pointer), output.make_safe()))
    })
}

fn make(reads: Reads, guard: impl FnOnce() -> io::Result<Guard<Pointer>>) -> Result<(usize, Found), Fault> {
    check_callback()?;
    watchdog::begin()?;
    let _one_at_a_time = MAKING.lock().unwrap_or_else(PoisonError::into_inner);
    let is_free = |place: &ArcSwapOption<Held>| place.load_full().is_none_or(|held| held.guard.is_released());
    let at = PLACES.iter().position(is_free).ok_or_else(|| {
        let sentence = format!("this process has {GUARDS_MAX} guards already; release one");
        Fault::new(Status::SinewErrorTooMany, sentence)
    })?;
    let guard = guard().map_err(|error| refused(&error))?;
    let found = Found::of(&guard, State::Safe(Cause::NotArmed));
    let handle = next_serial() * GUARDS_MAX + at;
    // The lock keeps others from the place; what was there before is released.
    PLACES[at].store(Some(Arc::new(Held { handle, guard, reads, is_to_go: AtomicBool::new(false) })));
    Ok((handle, found))
}

/// Takes in a message that has come.
pub(crate) fn take(handle: usize, sealed: &[u8]) -> Result<Verdict<()>, Fault> {
    with(handle, |held| Ok(held.guard.check(sealed, held.reads)))
}

/// The time that the sender is to quote.
pub(crate) fn echo(handle: usize) -> Result<Time, Fault> {
    with(handle, |held| Ok(held.guard.echo()))
}

/// Moves the output if it is live; how it was found.
pub(crate) fn apply(handle: usize, command: impl FnOnce(*mut c_void)) -> Result<Found, Fault> {
    with(handle, |held| {
        let moved = held.guard.apply(|pointer| {
            let output = *pointer.get_mut();
            in_callback(|| command(output));
        });
        Ok(Found::of(&held.guard, moved.map_or_else(State::Safe, |()| State::Live)))
    })
}

/// Makes the output live.
pub(crate) fn arm(handle: usize) -> Result<(), Fault> {
    with(handle, |held| Ok(held.guard.arm()?))
}

/// Makes the output safe: at once or, while somebody has it in hand, as soon as nobody has. Never waits for that.
pub(crate) fn trip(handle: usize) -> Result<(), Fault> {
    held(handle)?.guard.trip();
    Ok(())
}

pub(crate) fn state(handle: usize) -> Result<Found, Fault> {
    with(handle, |held| Ok(Found::of(&held.guard, held.guard.state())))
}

pub(crate) fn tally(handle: usize) -> Result<Tally, Fault> {
    with(handle, |held| Ok(held.guard.tally()))
}

/// Makes the output safe and lets go of it: then nothing here calls what makes it safe, or touches it. Where that fails, it is tried on, and let go of
/// as soon as it is safe.
pub(crate) fn release(handle: usize) -> Result<(), Fault> {
    with(handle, |held| match held.guard.release() {
        Released::Now => Ok(()),
        // By another thread, just now.
        Released::Before => Err(no_such()),
        Released::NotSafe => Err(ArmError::SafeFails.into()),
    })
}

/// Trips it and lets go of it, for who has an output in hand: no call knows it any more, and it is released as soon as nobody has its output in hand.
/// Never waits.
pub(crate) fn release_later(handle: usize) -> Result<(), Fault> {
    let held = held(handle)?;
    if held.is_to_go.swap(true, Ordering::AcqRel) {
        // By another thread, just now.
        return Err(no_such());
    }
    held.guard.release_later();
    Ok(())
}

impl Held {
    fn is_to_go(&self) -> bool {
        self.is_to_go.load(Ordering::Acquire)
    }

    /// For a thread that has no output in hand: where it was let go of in the function that returns here, it is released when that has returned.
    fn finish_release(&self) {
        if self.is_to_go() && !self.guard.is_released() {
            // Where that fails it is tried on, and released as soon as the output is safe.
            let _ = self.guard.release();
        }
    }
}

impl Found {
    /// What was live when it was looked at is not owed, whatever has become of it since.
    fn of(guard: &Guard<Pointer>, state: State) -> Self {
        Self { state, is_owed: state != State::Live && guard.is_owed() }
    }

    /// Refuses to call an output safe that is not known to be.
    pub(crate) fn check(self) -> Result<State, Fault> {
        if self.is_owed { Err(ArmError::SafeFails.into()) } else { Ok(self.state) }
    }
}

impl Output {
    /// As the runtime has it.
    fn make_safe(self) -> impl FnMut(&mut Pointer, Cause) -> Result<(), NotSafe> + Send + 'static {
        let safe = self.safe;
        move |pointer: &mut Pointer, cause: Cause| {
            let (output, why) = (*pointer.get_mut(), code_of(State::Safe(cause)));
            // SAFETY: the header asks of the caller that this may be called on any thread with this output until the guard is released.
            let failed = in_callback(|| unsafe { safe(output, why) });
            if failed == 0 { Ok(()) } else { Err(NotSafe) }
        }
    }
}

fn with<R>(handle: usize, body: impl FnOnce(&Held) -> Result<R, Fault>) -> Result<R, Fault> {
    let held = held(handle)?;
    check_callback()?;
    let result = body(&held);
    held.finish_release();
    result
}

fn held(handle: usize) -> Result<Arc<Held>, Fault> {
    let held = PLACES[handle % GUARDS_MAX].load_full();
    let is_there = |held: &Arc<Held>| held.handle == handle && !held.is_to_go() && !held.guard.is_released();
    let held = held.filter(is_there).ok_or_else(no_such)?;
    watchdog::check_fork()?;
    Ok(held)
}

/// Of a handle's bits the lowest eight are the place; the rest is this, never zero: no handle is NULL.
fn next_serial() -> usize {
    const SERIALS_MAX: usize = usize::MAX / GUARDS_MAX - 1;
    SERIALS.fetch_add(1, Ordering::Relaxed) % SERIALS_MAX + 1
}

/// Runs a function of the program's, in which it may only trip guards, and let go of them for later: two that wait for each other's outputs would
/// wait for ever, and so would one that waits for its own.
fn in_callback<R>(callback: impl FnOnce() -> R) -> R {
    let before = IS_IN_CALLBACK.replace(true);
    let result = callback();
    IS_IN_CALLBACK.set(before);
    result
}

/// Refuses a thread that has an output in hand: before anything that could wait for one.
pub(crate) fn check_callback() -> Result<(), Fault> {
    if !IS_IN_CALLBACK.get() {
        return Ok(());
    }
    let sentence =
        "with an output in hand only sinew_trip and sinew_release_later may be called; do the rest behind it";
    Err(Fault::new(Status::SinewErrorBusy, sentence))
}

fn no_such() -> Fault {
    Fault::plain(Status::SinewErrorNoSuchGuard)
}

/// What the caller could do better is refused before; what is left is the system's.
fn refused(error: &io::Error) -> Fault {
    let is_the_callers = matches!(error.kind(), io::ErrorKind::InvalidInput | io::ErrorKind::AlreadyExists);
    let status =
        if is_the_callers { Status::SinewErrorInvalidArgument } else { Status::SinewErrorNoWatchdog };
    Fault::new(status, error.to_string())
}

impl From<ArmError> for Fault {
    fn from(error: ArmError) -> Self {
        match error {
            ArmError::NotGood { .. } => Self::new(Status::SinewErrorNotGood, error.to_string()),
            ArmError::SafeFails => Self::plain(Status::SinewErrorSafeFails),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::{
            atomic::AtomicI32,
            mpsc::{Receiver, SyncSender, sync_channel},
        },
        thread,
        time::Duration,
    };

    use sinew::protection::{DataId, Protection, Stamp, seal};

    use super::*;

    /// Time after which a test that waits fails.
    const WATCHDOG: Duration = Duration::from_secs(30);
    const ENDS: (Tid, Tid) = (Tid::from_bits(0x7_0000_1001), Tid::from_bits(0x7_0000_1002));

    /// For whom no machine is too slow.
    fn protected() -> Protected {
        let protection = Protection::of_period(Duration::from_secs(60));
        let (name, reads) = ("test.guards", Reads::OfLength(2));
        Protected { name, kind: sinew::message::Kind::named(name), protection, reads }
    }

    /// A guard of an output that stays.
    fn made_of<T>(output: &'static T, safe: Safe) -> (usize, Found) {
        let pointer = std::ptr::from_ref(output).cast_mut().cast();
        make_alone(ENDS, protected(), Output { pointer, safe }).expect("a thread")
    }

    /// Fails while it is asked to.
    unsafe extern "C" fn unless(output: *mut c_void, _: OutputState) -> i32 {
        // SAFETY: the tests below make guards with this of flags that stay.
        let fails = unsafe { &*output.cast::<AtomicBool>() };
        i32::from(fails.load(Ordering::Acquire))
    }

    /// Notes what came of a call while it has the output in hand.
    unsafe extern "C" fn note(output: *mut c_void, why: OutputState) -> i32 {
        // SAFETY: the tests below make guards with this of numbers that stay.
        let noted = unsafe { &*output.cast::<AtomicI32>() };
        if why == OutputState::SinewSafeTripped {
            noted.store(status(check_callback()).map_or(0, |status| status as i32), Ordering::Release);
        }
        0
    }

    fn made(output: &'static AtomicI32) -> usize {
        made_of(output, note).0
    }

    /// Good ones come, and it is armed.
    fn come_alive(handle: usize) {
        (1..=8).for_each(|counter| assert_eq!(next(handle, counter), Verdict::Hold));
        arm(handle).expect("good ones have come");
    }

    fn next(handle: usize, counter: u64) -> Verdict<()> {
        let (source, destination) = ENDS;
        let data_id = DataId { source, destination, name: protected().name };
        let stamp = Stamp { counter, incarnation: 5, echo: echo(handle).expect("it is there") };
        take(handle, &seal(&data_id, stamp, &[7; 2])).expect("it is there")
    }

    fn status<T>(result: Result<T, Fault>) -> Option<Status> {
        result.err().map(|fault| fault.status)
    }

    #[test]
    fn a_handle_is_one_guards_for_ever() {
        static OUTPUTS: [AtomicI32; 2] = [const { AtomicI32::new(0) }; 2];
        let first = made(&OUTPUTS[0]);
        assert_eq!(status(release(first)), None);
        let second = made(&OUTPUTS[1]);
        assert_ne!(first, second);
        for gone in [0, first, GUARDS_MAX, usize::MAX] {
            assert_eq!(status(state(gone)), Some(Status::SinewErrorNoSuchGuard), "{gone}");
            assert_eq!(status(trip(gone)), Some(Status::SinewErrorNoSuchGuard), "{gone}");
            assert_eq!(status(release(gone)), Some(Status::SinewErrorNoSuchGuard), "{gone}");
        }
        assert_eq!(status(release(second)), None);
    }

    #[test]
    fn an_output_that_does_not_become_safe_is_not_called_safe_and_is_released_when_it_is() {
        static FAILS: AtomicBool = AtomicBool::new(true);
        let (handle, found) = made_of(&FAILS, unless);
        let owed = Found { state: State::Safe(Cause::NotArmed), is_owed: true };
        assert_eq!((found, state(handle).ok()), (owed, Some(owed)));
        assert_eq!(status(found.check()), Some(Status::SinewErrorSafeFails));
        assert_eq!(apply(handle, |_| panic!("it is not live")).ok(), Some(owed));
        assert_eq!(status(release(handle)), Some(Status::SinewErrorSafeFails));
        assert_eq!(state(handle).ok(), Some(owed), "it is there until it is safe");
        // When
        FAILS.store(false, Ordering::Release);
        // Then: nobody has to ask for that again.
        let begun = Time::now();
        while status(state(handle)) != Some(Status::SinewErrorNoSuchGuard) {
            assert!(Time::now().since(begun) < WATCHDOG, "it is still there");
            thread::yield_now();
        }
        assert_eq!(status(release(handle)), Some(Status::SinewErrorNoSuchGuard));
    }

    #[test]
    fn who_has_an_output_in_hand_may_trip_and_nothing_else() {
        static NOTED: AtomicI32 = AtomicI32::new(0);
        let handle = made(&NOTED);
        come_alive(handle);
        let mut inside = None;
        let moved = apply(handle, |_| {
            // What an endpoint does first that has to do with guards.
            let receives = status(check_callback());
            inside = Some([status(arm(handle)), status(state(handle)), status(release(handle)), receives]);
            assert_eq!(status(trip(handle)), None);
        });
        assert_eq!(moved.ok(), Some(Found { state: State::Live, is_owed: false }));
        let busy = Status::SinewErrorBusy;
        assert_eq!(inside, Some([Some(busy); 4]));
        let tripped = Found { state: State::Safe(Cause::Tripped), is_owed: false };
        assert_eq!(state(handle).ok(), Some(tripped));
        assert_eq!(NOTED.load(Ordering::Acquire), busy as i32, "nor may what makes it safe");
        assert_eq!(status(check_callback()), None, "nobody has it in hand any more");
        assert_eq!(status(release(handle)), None);
    }

    /// Whether the place of a guard is another one's, or may be.
    fn is_gone(handle: usize) -> bool {
        let held = PLACES[handle % GUARDS_MAX].load_full();
        held.is_none_or(|held| held.handle != handle || held.guard.is_released())
    }

    #[test]
    fn a_guard_that_is_let_go_of_in_its_own_command_is_released_when_that_returns() {
        // given
        static NOTED: AtomicI32 = AtomicI32::new(0);
        let handle = made(&NOTED);
        come_alive(handle);
        // when
        let mut inside = None;
        let moved = apply(handle, |_| {
            let [let_go, again] = [(); 2].map(|()| status(release_later(handle)));
            inside = Some((let_go, again, status(trip(handle)), is_gone(handle)));
        });
        // then: from then on nobody finds it, and it is there until nobody has it in hand
        assert_eq!(moved.ok(), Some(Found { state: State::Live, is_owed: false }));
        let no_such = Some(Status::SinewErrorNoSuchGuard);
        assert_eq!(inside, Some((None, no_such, no_such, false)));
        assert!(is_gone(handle), "its place is free");
        assert_eq!(NOTED.load(Ordering::Acquire), Status::SinewErrorBusy as i32, "it was made safe");
        assert_eq!((status(arm(handle)), status(release(handle))), (no_such, no_such));
    }

    /// Lets go of its own guard, whose handle is there, when that is tripped.
    unsafe extern "C" fn let_go(output: *mut c_void, why: OutputState) -> i32 {
        // SAFETY: the test below makes a guard with this of a number that stays.
        let handle = unsafe { &*output.cast::<AtomicUsize>() };
        let is_its_turn = why == OutputState::SinewSafeTripped;
        i32::from(is_its_turn && release_later(handle.load(Ordering::Acquire)).is_err())
    }

    #[test]
    fn a_guard_that_is_let_go_of_where_it_is_made_safe_is_released_as_soon_as_it_is_safe() {
        // given
        static HANDLE: AtomicUsize = AtomicUsize::new(0);
        let (handle, _) = made_of(&HANDLE, let_go);
        HANDLE.store(handle, Ordering::Release);
        come_alive(handle);
        // when
        assert_eq!(status(trip(handle)), None);
        // then: whoever makes it safe, here or the thread that does so, has it go
        let begun = Time::now();
        while !is_gone(handle) {
            assert!(Time::now().since(begun) < WATCHDOG, "its place is not free");
            thread::yield_now();
        }
        assert_eq!(status(release(handle)), Some(Status::SinewErrorNoSuchGuard));
    }

    /// An output that becomes safe when it is allowed to.
    struct Slow {
        begins: SyncSender<()>,
        may_end: Mutex<Receiver<()>>,
        events: Mutex<Vec<&'static str>>,
    }

    unsafe extern "C" fn when_allowed(output: *mut c_void, why: OutputState) -> i32 {
        if why == OutputState::SinewSafeNotArmed {
            return 0;
        }
        // SAFETY: the test below makes a guard with this of one that stays.
        let slow = unsafe { &*output.cast::<Slow>() };
        slow.begins.send(()).unwrap();
        slow.may_end.lock().unwrap().recv_timeout(WATCHDOG).unwrap();
        slow.events.lock().unwrap().push("safe");
        0
    }

    #[test]
    fn a_release_waits_for_another_thread_that_makes_the_output_safe() {
        let (begins, has_begun) = sync_channel(1);
        let (allow, may_end) = sync_channel(1);
        let (may_end, events) = (Mutex::new(may_end), Mutex::new(Vec::new()));
        let slow: &'static Slow = Box::leak(Box::new(Slow { begins, may_end, events }));
        let (handle, _) = made_of(slow, when_allowed);
        come_alive(handle);
        thread::scope(|scope| {
            scope.spawn(|| assert_eq!(status(trip(handle)), None));
            has_begun.recv_timeout(WATCHDOG).expect("it is made safe");
            let (calls, is_calling) = sync_channel(0);
            let releasing = scope.spawn(move || {
                calls.send(()).unwrap();
                let released = status(release(handle));
                slow.events.lock().unwrap().push("released");
                released
            });
            is_calling.recv_timeout(WATCHDOG).expect("it is about to");
            allow.send(()).unwrap();
            assert_eq!(releasing.join().unwrap(), None);
        });
        assert_eq!(*slow.events.lock().unwrap(), ["safe", "released"]);
    }
}
