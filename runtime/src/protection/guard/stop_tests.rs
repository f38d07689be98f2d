//! Outputs and the stop of their node.

use std::{sync::Arc, time::Duration};

use super::*;
use crate::{
    protection::{Echo, Flows, Protection},
    tid::{AppAddress, NodeAddress},
};

/// No machine is too slow for it.
#[derive(serde::Serialize, serde::Deserialize)]
struct Torque;

impl Payload for Torque {
    const NAME: &'static str = "test.stop.torque";
    const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_secs(60)));
}

fn tid(app: u32) -> Tid {
    Tid::new(NodeAddress::new(8), AppAddress::new(app))
}

/// An output that obeys this latch, and the sender of its commands.
struct Bench {
    stop: Arc<StopLatch>,
    guard: Guard<()>,
    flows: Flows,
}

impl Bench {
    fn new(stop: &Arc<StopLatch>, safe: impl FnMut(&mut (), Cause) + Send + 'static) -> Self {
        let node = (&Clock::WALL, stop);
        let guard = Guard::new_on::<Torque>(node, (tid(1), tid(2)), (), safe).expect("there is the thread");
        let flows = Flows::new(Time::from_nanos(5));
        // An echo is for a flow that exists.
        let _ = flows.seal(tid(1), tid(2), &Torque, Time::from_nanos(5));
        Self { stop: stop.clone(), guard, flows }
    }

    fn send(&self) -> Verdict<bytes::Bytes> {
        self.flows.record_echo(tid(2), Echo::new(Torque::KIND, self.guard.guarded().echo()));
        let sealed = self.flows.seal(tid(1), tid(2), &Torque, Time::from_nanos(5)).expect("one flow");
        self.guard.guarded().take(&sealed, Some)
    }

    fn arm(&self) -> Result<(), ArmError> {
        (0..8).for_each(|_| drop(self.send()));
        self.guard.arm()
    }
}

fn live() -> Bench {
    let bench = Bench::new(&Arc::default(), |(), _| {});
    bench.arm().expect("good ones have come");
    assert_eq!(bench.stop.not_safe(), 1);
    bench
}

#[test]
fn press_makes_an_output_safe_without_a_message() {
    let (done, is_done) = std::sync::mpsc::sync_channel(4);
    let bench = Bench::new(&Arc::default(), move |(), cause| {
        let _ = done.try_send(cause);
    });
    bench.arm().expect("good ones have come");
    assert_eq!(is_done.recv_timeout(Duration::from_secs(60)), Ok(Cause::NotArmed));
    bench.stop.press();
    // The thread `safe-output` does it.
    assert_eq!(is_done.recv_timeout(Duration::from_secs(60)), Ok(Cause::Stopped));
    assert_eq!(bench.guard.state(), State::Safe(Cause::Stopped));
    assert_eq!(bench.stop.not_safe(), 0);
}

#[test]
fn released_output_stays_safe_until_it_is_acknowledged() {
    let bench = live();
    bench.stop.press();
    assert!(bench.guard.apply(|()| ()).is_err(), "not even before the thread has run");
    assert_eq!(bench.guard.acknowledge_stop(), Err(ArmError::Stopped));
    assert!(bench.stop.release(bench.stop.read()));
    bench.stop.hold(false);
    assert_eq!(bench.arm(), Err(ArmError::Stopped));
    assert!(bench.guard.is_stopped());
    assert_eq!(bench.guard.acknowledge_stop(), Ok(()));
    assert_eq!(bench.guard.state(), State::Safe(Cause::Stopped), "it moves nothing");
    assert!(matches!(bench.guard.arm(), Err(ArmError::NotGood { .. })), "those of the stop do not count");
    assert_eq!(bench.arm(), Ok(()));
}

#[test]
fn short_stop_makes_the_output_safe_too() {
    let bench = live();
    bench.stop.press();
    assert!(bench.stop.release(bench.stop.read()));
    bench.stop.hold(false);
    assert_eq!(bench.guard.apply(|()| ()), Err(Cause::Stopped));
    assert_eq!(bench.guard.state(), State::Safe(Cause::Stopped));
}

#[test]
fn output_made_during_a_stop_is_acknowledged_too() {
    let stop = Arc::<StopLatch>::default();
    stop.press();
    let bench = Bench::new(&stop, |(), _| {});
    assert!(bench.guard.is_stopped());
    assert!(stop.release(stop.read()));
    stop.hold(false);
    assert_eq!(bench.arm(), Err(ArmError::Stopped));
    assert_eq!(bench.guard.acknowledge_stop(), Ok(()));
    assert_eq!(bench.arm(), Ok(()));
}

#[test]
fn output_made_after_a_release_is_acknowledged_too() {
    let first = live();
    first.stop.press();
    assert!(first.stop.release(first.stop.read()));
    first.stop.hold(false);
    // The application is started anew before a person has started again
    let Bench { stop, guard, .. } = first;
    drop(guard);
    let second = Bench::new(&stop, |(), _| {});
    assert!(second.guard.is_stopped());
    assert_eq!(second.arm(), Err(ArmError::Stopped));
    assert_eq!(second.guard.acknowledge_stop(), Ok(()));
    assert_eq!(second.arm(), Ok(()));
    // And once more after that
    drop(second.guard);
    let third = Bench::new(&stop, |(), _| {});
    assert_eq!(third.arm(), Ok(()), "the application has acknowledged this stop");
    stop.press();
    assert_eq!(third.guard.state(), State::Safe(Cause::Stopped), "but not the next one");
}

#[test]
fn held_node_arms_nothing_and_leaves_live_outputs() {
    let bench = live();
    bench.stop.hold(true);
    assert_eq!(bench.guard.state(), State::Live);
    bench.guard.trip();
    assert_eq!(bench.arm(), Err(ArmError::Stopped));
    assert!(!bench.guard.is_stopped(), "nothing was pressed");
    bench.stop.hold(false);
    assert_eq!(bench.arm(), Ok(()));
}

#[test]
fn output_that_cannot_be_made_safe_is_counted() {
    let mut is_planted = true;
    let (allow, allowed) = std::sync::mpsc::sync_channel::<()>(1);
    let bench = Bench::new(&Arc::default(), move |(), cause| {
        if cause == Cause::Stopped && is_planted {
            is_planted = allowed.try_recv().is_err();
            assert!(!is_planted, "a planted panic");
        }
    });
    bench.arm().expect("good ones have come");
    bench.stop.press();
    let _ = bench.guard.state();
    assert_eq!(bench.stop.not_safe(), 1, "its safe function fails");
    allow.send(()).expect("there is room");
    let deadline = std::time::Instant::now() + Duration::from_secs(60);
    while bench.stop.not_safe() > 0 {
        assert!(std::time::Instant::now() < deadline, "it is tried until it succeeds");
        std::thread::yield_now();
    }
    drop(bench.guard);
    assert_eq!(bench.stop.not_safe(), 0);
}

/// The claim of a confirmation: after a press, a count of zero stays zero, also while a thread arms.
#[test]
fn no_output_becomes_live_behind_a_confirmation() {
    for _ in 0..300 {
        let bench = Bench::new(&Arc::default(), |(), _| {});
        (0..8).for_each(|_| drop(bench.send()));
        let begin = std::sync::Barrier::new(2);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                begin.wait();
                let _ = bench.guard.arm();
            });
            begin.wait();
            bench.stop.press();
            while bench.stop.not_safe() > 0 {
                std::thread::yield_now();
            }
            assert!(bench.guard.apply(|()| ()).is_err());
        });
        assert_ne!(bench.guard.state(), State::Live);
    }
}
