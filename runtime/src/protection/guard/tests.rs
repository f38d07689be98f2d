//! The retries of safe functions, and outputs that become safe while locks of others are held.

use std::{
    sync::{
        atomic::AtomicBool,
        mpsc::{Receiver as Receives, sync_channel},
    },
    thread,
};

use super::*;
use crate::{
    protection::Protection,
    tid::{AppAddress, NodeAddress},
};

/// Time after which a waiting test fails.
const WATCHDOG: Duration = Duration::from_secs(30);

#[derive(serde::Serialize, serde::Deserialize)]
struct Torque;

impl Payload for Torque {
    const NAME: &'static str = "test.guard.torque";
    const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(20)));
}

#[test]
fn messages_do_not_delay_the_retry_after_a_panic() {
    let tid = |app| Tid::new(NodeAddress::new(7), AppAddress::new(app));
    let data_id = DataId { source: tid(1), destination: tid(2), name: "test.torque" };
    let receiver = Receiver::new(Protection::of_period(SAFE_RETRY));
    let safe = Box::new(|(): &mut (), _| panic!("a planted panic"));
    let mut inner =
        Inner { data_id, receiver, output: (), safe, retry: None, dry_run: None, log_entry: None };
    let started = Time::from_nanos(1_000_000_000);
    inner.make_safe(Cause::Tripped, started);
    let due = (started + SAFE_RETRY).as_nanos();
    for tenth in 0..20 {
        let now = started + SAFE_RETRY / 10 * tenth;
        inner.let_decide(now, |receiver| receiver.take(now, Opened::Corrupt));
        assert_eq!(inner.deadline(), due);
    }
}

fn output(app: u32, safe: impl FnMut(&mut (), Cause) + Send + 'static) -> Guard<()> {
    let tid = |app| Tid::new(NodeAddress::new(7), AppAddress::new(app));
    Guard::new::<Torque>(tid(1), tid(app), (), safe).expect("there is the thread")
}

/// An output that is due all the time, and becomes safe as soon as permitted; it reports that.
fn due(app: u32) -> (Guard<()>, Arc<AtomicBool>, Receives<()>) {
    let (is_allowed, (done, is_done)) = (Arc::new(AtomicBool::new(false)), sync_channel(1));
    let (may, (tries, tried)) = (is_allowed.clone(), sync_channel(1));
    let guard = output(app, move |(), _| {
        let _ = tries.try_send(thread::current().name().map(str::to_owned));
        assert!(may.load(Ordering::Acquire), "a planted panic");
        let _ = done.try_send(());
    });
    // The thread has taken it over from here on.
    while tried.recv_timeout(WATCHDOG).expect("it is tried").as_deref() != Some("safe-output") {}
    (guard, is_allowed, is_done)
}

#[test]
fn output_becomes_safe_while_a_guard_is_being_made() {
    // given: an ordinary thread that was interrupted while it hands its guard to the thread
    let (_guard, is_allowed, is_done) = due(11);
    let interrupted = safe_output::started().expect("there is a guard").lock();
    // when
    is_allowed.store(true, Ordering::Release);
    // then
    is_done.recv_timeout(WATCHDOG).expect("it waits for no ordinary thread");
    drop(interrupted);
}

#[test]
fn output_becomes_safe_while_an_orphaned_one_is_locked() {
    // given: an output without an owner that is not safe, and for which its application checks a message
    let (_guard, is_allowed, is_done) = due(12);
    let is_paid = Arc::new(AtomicBool::new(false));
    let may = is_paid.clone();
    let orphan = output(13, move |(), _| assert!(may.load(Ordering::Acquire), "a planted panic"));
    let shared = orphan.shared().clone();
    drop(orphan);
    let interrupted = shared.lock();
    // when
    is_allowed.store(true, Ordering::Release);
    // then
    is_done.recv_timeout(WATCHDOG).expect("it waits for no ordinary thread");
    is_paid.store(true, Ordering::Release);
    drop(interrupted);
}
