//! Guards that are tripped and released, also by the functions that use their outputs.

use std::{
    sync::{
        atomic::AtomicI32,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread,
    time::Duration,
};

use sinew_runtime::protection::{DataId, Protection, Stamp, seal};

use super::*;

/// Time after which a test that waits fails.
const WATCHDOG: Duration = Duration::from_secs(30);
const ENDS: (Tid, Tid) = (Tid::from_bits(0x7_0000_1001), Tid::from_bits(0x7_0000_1002));

/// A protection with limits that no slow machine exceeds.
fn protected() -> Protected {
    let protection = Protection::of_period(Duration::from_secs(60));
    let (name, reads) = ("test.guards", Reads::OfLength(2));
    Protected { name, kind: sinew_runtime::wire::Kind::named(name), protection, reads }
}

/// A guard of an output that stays.
fn made_of<T>(output: &'static T, safe: Safe) -> (usize, Found) {
    let pointer = std::ptr::from_ref(output).cast_mut().cast();
    make_alone(ENDS, protected(), Output { pointer, safe }).expect("a thread")
}

/// Fails while the flag is set.
unsafe extern "C" fn unless(output: *mut c_void, _: OutputState) -> i32 {
    // SAFETY: the tests below make guards with this of flags that stay.
    let fails = unsafe { &*output.cast::<AtomicBool>() };
    i32::from(fails.load(Ordering::Acquire))
}

/// Stores the status of a call that is made while the output is in use.
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

/// Delivers good messages and arms the guard.
fn make_live(handle: usize) {
    (1..=8).for_each(|counter| assert_eq!(next(handle, counter), Verdict::Hold));
    arm(handle).expect("good messages have arrived");
}

fn next(handle: usize, counter: u64) -> Verdict<()> {
    let (source, destination) = ENDS;
    let data_id = DataId { source, destination, name: protected().name };
    let stamp = Stamp { counter, incarnation: 5, echo: echo(handle).expect("it is there") };
    take(handle, &seal(&data_id, stamp, &[7; 2])).expect("it is there")
}

fn status<T>(result: Result<T, CallError>) -> Option<Status> {
    result.err().map(|error| error.status)
}

#[test]
fn handle_is_never_reused() {
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
fn unsafe_output_is_reported_and_released_once_safe() {
    static FAILS: AtomicBool = AtomicBool::new(true);
    let (handle, found) = made_of(&FAILS, unless);
    let unsafe_output = Found { state: State::Safe(Cause::NotArmed), has_failed: true };
    assert_eq!((found, state(handle).ok()), (unsafe_output, Some(unsafe_output)));
    assert_eq!(status(found.check()), Some(Status::SinewErrorSafeFails));
    assert_eq!(apply(handle, |_| panic!("it is not live")).ok(), Some(unsafe_output));
    assert_eq!(status(release(handle)), Some(Status::SinewErrorSafeFails));
    assert_eq!(state(handle).ok(), Some(unsafe_output), "it is there until it is safe");
    // when
    FAILS.store(false, Ordering::Release);
    // then: the release completes without another call
    let begun = Time::now();
    while status(state(handle)) != Some(Status::SinewErrorNoSuchGuard) {
        assert!(Time::now().since(begun) < WATCHDOG, "it is still there");
        thread::yield_now();
    }
    assert_eq!(status(release(handle)), Some(Status::SinewErrorNoSuchGuard));
}

#[test]
fn callback_may_only_trip_guards() {
    static NOTED: AtomicI32 = AtomicI32::new(0);
    let handle = made(&NOTED);
    make_live(handle);
    let mut inside = None;
    let moved = apply(handle, |_| {
        // The first check for guards in a receiving endpoint.
        let receives = status(check_callback());
        inside = Some([status(arm(handle)), status(state(handle)), status(release(handle)), receives]);
        assert_eq!(status(trip(handle)), None);
    });
    assert_eq!(moved.ok(), Some(Found { state: State::Live, has_failed: false }));
    let busy = Status::SinewErrorBusy;
    assert_eq!(inside, Some([Some(busy); 4]));
    let tripped = Found { state: State::Safe(Cause::Tripped), has_failed: false };
    assert_eq!(state(handle).ok(), Some(tripped));
    assert_eq!(NOTED.load(Ordering::Acquire), busy as i32, "nor may the function that makes it safe");
    assert_eq!(status(check_callback()), None, "no function uses it any more");
    assert_eq!(status(release(handle)), None);
}

/// Whether the slot of a guard is free for another one, or has one already.
fn is_gone(handle: usize) -> bool {
    let held = SLOTS[handle % GUARDS_MAX].load_full();
    held.is_none_or(|held| held.handle != handle || held.guard.is_released())
}

#[test]
fn release_in_own_command_completes_when_it_returns() {
    // given
    static NOTED: AtomicI32 = AtomicI32::new(0);
    let handle = made(&NOTED);
    make_live(handle);
    // when
    let mut inside = None;
    let moved = apply(handle, |_| {
        let [let_go, again] = [(); 2].map(|()| status(release_later(handle)));
        inside = Some((let_go, again, status(trip(handle)), is_gone(handle)));
    });
    // then: all calls reject it at once, and it exists until no thread uses its output
    assert_eq!(moved.ok(), Some(Found { state: State::Live, has_failed: false }));
    let no_such = Some(Status::SinewErrorNoSuchGuard);
    assert_eq!(inside, Some((None, no_such, no_such, false)));
    assert!(is_gone(handle), "its slot is free");
    assert_eq!(NOTED.load(Ordering::Acquire), Status::SinewErrorBusy as i32, "it was made safe");
    assert_eq!((status(arm(handle)), status(release(handle))), (no_such, no_such));
}

/// Releases its own guard when that is tripped; the output holds the guard's handle.
unsafe extern "C" fn let_go(output: *mut c_void, why: OutputState) -> i32 {
    // SAFETY: the test below makes a guard with this of a number that stays.
    let handle = unsafe { &*output.cast::<AtomicUsize>() };
    let is_its_turn = why == OutputState::SinewSafeTripped;
    i32::from(is_its_turn && release_later(handle.load(Ordering::Acquire)).is_err())
}

#[test]
fn release_in_make_safe_completes_once_safe() {
    // given
    static HANDLE: AtomicUsize = AtomicUsize::new(0);
    let (handle, _) = made_of(&HANDLE, let_go);
    HANDLE.store(handle, Ordering::Release);
    make_live(handle);
    // when
    assert_eq!(status(trip(handle)), None);
    // then: the thread that makes the output safe, this one or the watchdog, completes the release
    let begun = Time::now();
    while !is_gone(handle) {
        assert!(Time::now().since(begun) < WATCHDOG, "its slot is not free");
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
fn release_waits_for_thread_making_output_safe() {
    let (begins, has_begun) = sync_channel(1);
    let (allow, may_end) = sync_channel(1);
    let (may_end, events) = (Mutex::new(may_end), Mutex::new(Vec::new()));
    let slow: &'static Slow = Box::leak(Box::new(Slow { begins, may_end, events }));
    let (handle, _) = made_of(slow, when_allowed);
    make_live(handle);
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
