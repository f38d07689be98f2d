//! The dry run of an output: how long it takes from the last command to a safe output, measured before it is armed.

use std::{sync::atomic::Ordering, time::Duration};

use super::{Cause, Guard, Inner, Shared, State, wake};
use crate::time::Time;

/// A dry run: a silence that begins with a command that never came.
#[derive(Clone, Copy)]
pub(super) struct DryRun {
    began: Time,
    within: Duration,
}

impl DryRun {
    /// Returns when the silence is over the limit.
    pub(super) fn ends(self) -> Time {
        self.began + self.within
    }
}

impl<O: Send + 'static> Guard<O> {
    /// Injects a silence into an output that was not armed: after `within` the thread `safe-output` calls the safe
    /// function, and the time until that has returned is kept. An output that is armed or dropped before that is not
    /// measured, and the dry run does not call its safe function. On a virtual clock nothing is measured.
    pub(crate) fn begin_dry_run(&self) {
        let shared = self.shared();
        if shared.wake_up.is_some() {
            return;
        }
        shared.with(|inner| {
            if inner.receiver.state() != State::Live {
                let within = shared.watch.protection.within;
                inner.dry_run = Some(DryRun { began: shared.clock.now(), within });
                shared.set_deadline(inner.deadline());
            }
        });
        wake();
    }
}

impl<O> Shared<O> {
    /// Makes the output safe once more if its dry run is over, and keeps the time that it took.
    pub(super) fn end_dry_run(&self, inner: &mut Inner<O>) {
        let now = self.clock.now();
        let Some(run) = inner.dry_run.take_if(|run| run.ends() <= now) else { return };
        inner.make_safe(Cause::Silent, now);
        if inner.retry.is_none() {
            // No output was live, so nothing happened that the log is about.
            inner.log_entry = None;
            let took = self.clock.now().since(run.began).as_nanos();
            self.watch.measured_ns.store(u64::try_from(took).unwrap_or(u64::MAX).max(1), Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
        mpsc::sync_channel,
    };

    use super::*;
    use crate::{
        protection::{ArmError, Echo, Flows, Protection, outputs},
        tid::{AppAddress, NodeAddress, Tid},
        wire::Payload,
    };

    const WITHIN: Duration = Duration::from_millis(30);
    /// No machine is too slow for it.
    const PATIENCE: Duration = Duration::from_secs(60);

    #[derive(serde::Serialize, serde::Deserialize)]
    struct Torque;

    impl Payload for Torque {
        const NAME: &'static str = "test.dry_run.torque";
        const PROTECTION: Option<Protection> =
            Some(Protection { within: WITHIN, ..Protection::of_period(Duration::from_millis(10)) });
    }

    /// Its dry run does not end during a test.
    #[derive(serde::Serialize, serde::Deserialize)]
    struct Level;

    impl Payload for Level {
        const NAME: &'static str = "test.dry_run.level";
        const PROTECTION: Option<Protection> =
            Some(Protection { good_min: 1, ..Protection::of_period(Duration::from_secs(3_600)) });
    }

    fn measured(receiver: Tid) -> Option<Duration> {
        outputs().iter().find(|output| output.data_id.destination == receiver)?.measured
    }

    #[test]
    fn dry_run_calls_the_safe_function_by_silence() {
        let tid = |app| Tid::new(NodeAddress::new(71), AppAddress::new(app));
        let (put, causes) = sync_channel(8);
        let guard = Guard::new::<Torque>(tid(1), tid(2), (), move |(), cause| {
            // The test may have ended.
            let _ = put.try_send(cause);
        })
        .expect("there is the thread");
        assert_eq!(causes.recv_timeout(PATIENCE), Ok(Cause::NotArmed));
        assert_eq!(measured(tid(2)), None);
        guard.begin_dry_run();
        assert_eq!(causes.recv_timeout(PATIENCE), Ok(Cause::Silent));
        // The state is locked until the time is kept.
        assert_eq!(guard.state(), State::Safe(Cause::NotArmed), "it was not armed by that");
        assert!(measured(tid(2)).is_some_and(|time| time >= WITHIN), "{:?}", measured(tid(2)));
        assert_eq!(guard.tally().trips, 0);
        assert!(matches!(guard.arm(), Err(ArmError::NotGood { good: 0, .. })));
    }

    #[test]
    fn failing_safe_function_is_not_measured() {
        let tid = |app| Tid::new(NodeAddress::new(72), AppAddress::new(app));
        let (put, calls) = sync_channel(8);
        let count = Arc::new(AtomicU32::new(0));
        let guard = Guard::new::<Torque>(tid(1), tid(2), (), move |(), _| {
            let call = count.fetch_add(1, Ordering::SeqCst);
            // The test may have ended.
            let _ = put.try_send(call);
            assert_ne!(call, 1, "the dry run fails");
        })
        .expect("there is the thread");
        guard.begin_dry_run();
        // The first call is that of a new guard, the second one the dry run, the third one its repetition.
        for call in 0..3 {
            assert_eq!(calls.recv_timeout(PATIENCE), Ok(call));
        }
        assert_eq!(guard.state(), State::Safe(Cause::NotArmed));
        assert_eq!(measured(tid(2)), None);
    }

    #[test]
    fn arming_ends_the_dry_run() {
        // Given
        let tid = |app| Tid::new(NodeAddress::new(73), AppAddress::new(app));
        let guard = Guard::new::<Level>(tid(1), tid(2), (), |(), _| {}).expect("there is the thread");
        guard.begin_dry_run();
        assert!(matches!(guard.arm(), Err(ArmError::NotGood { .. })));
        assert!(guard.shared().lock().dry_run.is_some(), "an attempt to arm it changes nothing");
        let now = Time::from_nanos(5);
        let flows = Flows::new(now);
        // An echo is for a flow that exists.
        let _ = flows.seal(tid(1), tid(2), &Level, now);
        flows.record_echo(tid(2), Echo::new(Level::KIND, guard.guarded().echo()));
        let sealed = flows.seal(tid(1), tid(2), &Level, now).expect("one flow");
        let _ = guard.guarded().take(&sealed, Some);
        // When
        guard.arm().expect("one good command is enough");
        // Then
        assert!(guard.shared().lock().dry_run.is_none());
        assert_eq!((guard.state(), measured(tid(2))), (State::Live, None));
        guard.trip();
        assert_eq!(guard.state(), State::Safe(Cause::Tripped));
        assert_eq!(guard.shared().lock().deadline(), u64::MAX, "it does not begin again");
    }

    #[test]
    fn dropping_the_guard_ends_its_dry_run() {
        let tid = |app| Tid::new(NodeAddress::new(74), AppAddress::new(app));
        let guard = Guard::new::<Level>(tid(1), tid(2), (), |(), _| {}).expect("there is the thread");
        guard.begin_dry_run();
        // An application's context keeps such a part of a dropped guard.
        let kept = guard.shared().clone();
        assert!(kept.lock().deadline() < u64::MAX);
        drop(guard);
        assert!(kept.lock().dry_run.is_none());
        assert_eq!(kept.watch.deadline.load(Ordering::Acquire), u64::MAX);
    }
}
