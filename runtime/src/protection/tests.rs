//! A sender and a receiver without a channel between them, and guards that trip each other.
//!
//! | file | content |
//! | --- | --- |
//! | `black_channel` | each class of error, injected between the two |
//! | `bound` | the time after the last command within which an output is safe |
//! | `outside` | bytes from outside |

mod black_channel;
mod bound;
mod outside;

use std::{
    sync::{Arc, Mutex},
    time::Duration,
};

use bytes::Bytes;

use super::{
    receiver::{Opened, Receiver},
    sender::Flows,
    *,
};
use crate::{
    router::mismatches::SPOILED,
    tid::{AppAddress, NodeAddress, Tid},
};

const MS: Duration = Duration::from_millis(1);
const PROTECTION: Protection = Protection::of_period(MS);

#[derive(Debug, Serialize, Deserialize)]
struct Torque {
    nm: u64,
}

impl Payload for Torque {
    const NAME: &'static str = "test.torque";
    const PROTECTION: Option<Protection> = Some(PROTECTION);
}

fn tid(app: u32) -> Tid {
    Tid::new(NodeAddress::new(7), AppAddress::new(0x1000 + app))
}

const CENTRAL: u32 = 1;
const DRIVE: u32 = 2;
/// The incarnation of the sender.
const LIFE: Time = Time::from_nanos(5);

fn data_id() -> DataId {
    DataId::of::<Torque>(tid(CENTRAL), tid(DRIVE))
}

/// A sender and a receiver, with a message and an echo each millisecond.
struct Bench {
    now: Time,
    flows: Flows,
    receiver: Receiver,
    sent: u64,
    applied: Vec<u64>,
}

impl Bench {
    fn new() -> Self {
        Self::of(PROTECTION)
    }

    fn of(protection: Protection) -> Self {
        let now = Time::from_nanos(1_000_000_000);
        let receiver = Receiver::new(protection);
        let mut bench = Self { now, flows: Flows::new(LIFE), receiver, sent: 0, applied: Vec::new() };
        // The first message creates the flow of the echoes.
        bench.seal();
        bench
    }

    /// Creates one with a live output.
    fn live() -> Self {
        Self::live_of(PROTECTION)
    }

    fn live_of(protection: Protection) -> Self {
        let mut bench = Self::of(protection);
        bench.come_alive();
        bench
    }

    /// Passes valid messages until the output can be armed, and arms it.
    fn come_alive(&mut self) {
        for _ in 0..PROTECTION.good_min {
            let message = self.next();
            assert_eq!(self.take(&message), Verdict::Hold);
        }
        self.receiver.arm(self.now).expect("it has come often enough");
    }

    fn seal(&mut self) -> Bytes {
        self.sent += 1;
        self.flows.seal(tid(CENTRAL), tid(DRIVE), &Torque { nm: self.sent }, self.now).expect("one flow")
    }

    /// Advances by one period: returns the sender's next message, with a fresh echo.
    fn next(&mut self) -> Bytes {
        self.now = self.now + MS;
        let at = self.receiver.echo(self.now);
        self.flows.record_echo(tid(DRIVE), Echo::new(Torque::KIND, at));
        self.seal()
    }

    /// The only path to the output, for valid messages and bad ones.
    fn take(&mut self, bytes: &Bytes) -> Verdict<Bytes> {
        let (opened, payload) = Opened::of(&data_id(), bytes, Some);
        let verdict = self.receiver.take(self.now, opened).of(payload);
        if let Verdict::Apply(payload) = &verdict {
            self.applied.push(crate::wire::decode::<Torque>(payload).map_or(u64::MAX, |torque| torque.nm));
        }
        verdict
    }

    /// Whether the sender's next message is applied, as a valid one is in a working channel.
    fn applies_the_next(&mut self) -> bool {
        let message = self.next();
        let before = self.applied.len();
        matches!(self.take(&message), Verdict::Apply(_)) && self.applied[before..] == [self.sent]
    }
}

#[test]
fn sealed_message_is_applied_only_once_armed() {
    let mut bench = Bench::new();
    for _ in 1..PROTECTION.good_min {
        let message = bench.next();
        assert_eq!(bench.take(&message), Verdict::Hold);
    }
    let (good, wanted) = (PROTECTION.good_min - 1, PROTECTION.good_min);
    assert_eq!(
        bench.receiver.arm(bench.now),
        Err(ArmError::NotGood { good, wanted, silent: Some(Duration::ZERO) })
    );
    let message = bench.next();
    assert_eq!(bench.take(&message), Verdict::Hold);
    bench.receiver.arm(bench.now).unwrap();
    let message = bench.next();
    assert!(matches!(bench.take(&message), Verdict::Apply(_)));
    assert_eq!(bench.applied, [bench.sent]);
}

#[test]
fn silence_ends_a_run_of_valid_messages() {
    let mut bench = Bench::new();
    for _ in 1..PROTECTION.good_min {
        let message = bench.next();
        assert_eq!(bench.take(&message), Verdict::Hold);
    }
    // When: no message arrives for exactly as long as a live output permits.
    bench.now = bench.now + PROTECTION.within - MS;
    let message = bench.next();
    assert_eq!(bench.take(&message), Verdict::Hold);
    // Then: the last message was the first one of a new run.
    let wanted = PROTECTION.good_min;
    assert_eq!(
        bench.receiver.arm(bench.now),
        Err(ArmError::NotGood { good: 1, wanted, silent: Some(Duration::ZERO) })
    );
    for good in 2..=wanted {
        assert!(bench.receiver.arm(bench.now).is_err(), "{good}");
        let message = bench.next();
        assert_eq!(bench.take(&message), Verdict::Hold);
    }
    bench.receiver.arm(bench.now).expect("a row without a silence");
}

#[test]
fn undecodable_messages_neither_keep_live_nor_arm() {
    // Given: an output that tolerates bad messages, from a sender of a later version.
    let mut bench = Bench::live_of(Protection { bad_max: 64, ..PROTECTION });
    let of_later_version = |bench: &mut Bench| {
        let message = bench.next();
        let (opened, value) = Opened::of(&data_id(), &message, |_| None::<Bytes>);
        bench.receiver.take(bench.now, opened).of(value)
    };
    let deadline = bench.receiver.deadline();
    for _ in 1..3 {
        assert_eq!(of_later_version(&mut bench), Verdict::Refused(ProtectionError::Unreadable));
        assert_eq!(bench.receiver.deadline(), deadline, "it is none that was waited for");
    }
    // And: they arrived, so none is missing.
    assert_eq!(bench.receiver.tally().lost, 0);
    assert_eq!(of_later_version(&mut bench), Verdict::Refused(ProtectionError::Unreadable));
    assert_eq!(bench.receiver.state(), State::Safe(Cause::Silent));
    for _ in 0..2 * PROTECTION.good_min {
        assert_eq!(of_later_version(&mut bench), Verdict::Refused(ProtectionError::Unreadable));
        assert!(bench.receiver.arm(bench.now).is_err());
    }
    let tally = bench.receiver.tally();
    assert_eq!((tally.unreadable, tally.good), (3 + 2 * 8, 8));

    let mut bench = Bench::live();
    for _ in 0..=PROTECTION.bad_max {
        of_later_version(&mut bench);
    }
    assert_eq!(bench.receiver.state(), State::Safe(Cause::TooManyBad), "they are bad ones like others");
}

#[test]
fn sender_without_echoes_is_not_trusted() {
    let mut bench = Bench::new();
    for _ in 0..100 {
        bench.now = bench.now + MS;
        bench.receiver.echo(bench.now);
        let message = bench.seal();
        assert_eq!(bench.take(&message), Verdict::Refused(ProtectionError::TooOld));
    }
    assert!(bench.receiver.arm(bench.now).is_err());
}

#[test]
fn messages_in_flight_during_host_sleep_move_nothing() {
    let mut bench = Bench::live();
    bench.receiver.has_slept(Duration::from_secs(7));
    assert_eq!(bench.receiver.state(), State::Safe(Cause::Slept), "however long it had slept before");
    bench.come_alive();
    // Given: commands that wait, and an hour of sleep in which the clock stands.
    let waiting: Vec<Bytes> = (0..=PROTECTION.good_min).map(|_| bench.seal()).collect();
    bench.receiver.has_slept(Duration::from_secs(7) + MS);
    assert_eq!(bench.receiver.state(), State::Live, "two clocks are never read at once");
    bench.receiver.has_slept(Duration::from_secs(3_607));
    assert_eq!(bench.receiver.state(), State::Safe(Cause::Slept));
    for message in &waiting {
        assert_eq!(bench.take(message), Verdict::Refused(ProtectionError::TooOld));
        assert!(bench.receiver.arm(bench.now).is_err());
    }
    // And: messages sent after an echo are valid, after the missing ones; and a known sleep is not counted
    // twice.
    bench.receiver.has_slept(Duration::from_secs(3_600));
    let message = bench.next();
    assert_eq!(bench.take(&message), Verdict::Refused(ProtectionError::Gap));
    bench.receiver.has_slept(Duration::from_secs(3_607));
    bench.come_alive();
    assert!(bench.applies_the_next());
}

#[test]
fn one_of_64_bad_messages_is_tolerated() {
    let mut bench = Bench::live();
    let bad = Bytes::from_static(b"noise");
    assert_eq!(bench.take(&bad), Verdict::Refused(ProtectionError::Corrupt));
    assert_eq!(bench.receiver.state(), State::Live);
    for _ in 0..62 {
        let message = bench.next();
        assert!(matches!(bench.take(&message), Verdict::Apply(_)));
    }
    // Also one that the node has refused for its type.
    let spoiled = Bytes::from_static(SPOILED);
    assert_eq!(bench.take(&spoiled), Verdict::Refused(ProtectionError::Corrupt));
    assert_eq!(bench.receiver.state(), State::Safe(Cause::TooManyBad));

    let mut bench = Bench::live();
    bench.take(&bad);
    for _ in 0..63 {
        let message = bench.next();
        bench.take(&message);
    }
    bench.take(&bad);
    assert_eq!(bench.receiver.state(), State::Live, "the first one is forgotten by then");
}

#[test]
fn bytes_match_the_documentation() {
    let stamp = Stamp { counter: 3, incarnation: 5, echo: Time::from_nanos(7) };
    let sealed = seal(&DataId { source: tid(1), destination: tid(2), name: "a.b" }, stamp, b"xyz");
    let mut head = vec![1, 0, 0, 0, 3, 0, 0, 0];
    for word in [3_u64, 5, 7] {
        head.extend(word.to_le_bytes());
    }
    head.extend(b"xyz");
    assert_eq!(sealed[..head.len()], head);
    // CRC-64/XZ of "123456789" is its published check value.
    let mut digest = crc64fast::Digest::new();
    digest.write(b"123456789");
    assert_eq!(digest.sum64(), 0x995d_c9bb_df19_39fa);
}

#[test]
fn ended_flow_frees_its_slot_and_counts_on() {
    let mut bench = Bench::live();
    let said = bench.sent;
    // Given: the maximum number of receivers, one after the other.
    let to =
        |bench: &Bench, app| bench.flows.seal(tid(CENTRAL), tid(DRIVE + app), &Torque { nm: 0 }, bench.now);
    for app in 1..1_024 {
        assert!(to(&bench, app).is_some(), "{app}");
    }
    // Then: active flows are kept; ended ones are removed, the oldest first.
    let lasts = PROTECTION.within + PROTECTION.age_max;
    bench.now = bench.now + lasts;
    assert!(to(&bench, 1_024).is_none(), "all go on");
    bench.now = bench.now + MS;
    assert!(to(&bench, 1).is_some(), "it goes on");
    for app in 1_024..=2_000 {
        assert!(to(&bench, app).is_some(), "{app}: its place is that of one that is over");
    }
    // When: the first one returns.
    let echo = bench.receiver.echo(bench.now);
    let message = bench.seal();
    let (stamp, _) = open(&data_id(), &message).expect("it is its own");
    assert!(stamp.counter > said && stamp.incarnation == LIFE.as_nanos());
    assert_eq!(stamp.echo, Time::ZERO, "what it had heard is forgotten");
    assert_eq!(bench.take(&message), Verdict::Refused(ProtectionError::TooOld));
    assert_eq!(bench.receiver.state(), State::Safe(Cause::Silent), "since long ago");
    // And: a receiver without a known sender starts at this point.
    bench.flows.record_echo(tid(DRIVE), Echo::new(Torque::KIND, echo));
    bench.come_alive();
    assert!(bench.applies_the_next());
}

/// A live output; its `safe` trips the guard in its slot.
fn live_guard(slot: &Arc<Mutex<Option<Guard<()>>>>) -> Guard<()> {
    let peer = slot.clone();
    let safe = move |(): &mut (), _| {
        if let Some(peer) = peer.lock().expect("nobody panics with it").as_ref() {
            peer.trip();
        }
    };
    live_with(safe)
}

/// A live output with this safe function.
fn live_with(safe: impl FnMut(&mut (), Cause) + Send + 'static) -> Guard<()> {
    let guard = Guard::new::<Patient>(tid(CENTRAL), tid(DRIVE), (), safe).expect("a thread");
    let (flows, guarded) = (Flows::new(Time::from_nanos(5)), guard.guarded());
    let seal = || flows.seal(tid(CENTRAL), tid(DRIVE), &Patient, LIFE).expect("one flow");
    seal();
    for _ in 0..8 {
        flows.record_echo(tid(DRIVE), Echo::new(Patient::KIND, guarded.echo()));
        assert_eq!(guarded.take(&seal(), Some), Verdict::Hold);
    }
    guard.arm().expect("good ones have come");
    guard
}

/// No machine is too slow for this protection.
#[derive(Serialize, Deserialize)]
struct Patient;

impl Payload for Patient {
    const NAME: &'static str = "test.patient";
    const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_secs(60)));
}

#[test]
fn guards_that_trip_each_other_do_not_deadlock() {
    let (done, is_done) = std::sync::mpsc::sync_channel(1);
    std::thread::spawn(move || {
        for _ in 0..200 {
            let slots: [Arc<Mutex<Option<Guard<()>>>>; 2] = Default::default();
            let guards = [live_guard(&slots[0]), live_guard(&slots[1])];
            *slots[0].lock().expect("it is new") = Some(guards[1].clone());
            *slots[1].lock().expect("it is new") = Some(guards[0].clone());
            std::thread::scope(|scope| guards.iter().for_each(|guard| drop(scope.spawn(|| guard.trip()))));
            // A guard that the other one had locked is tripped by the thread of the watchdogs.
            while guards.iter().any(|guard| guard.state() == State::Live) {
                std::thread::yield_now();
            }
            slots.iter().for_each(|slot| drop(slot.lock().expect("nobody panics with it").take()));
        }
        done.send(()).expect("the test waits");
    });
    is_done.recv_timeout(Duration::from_secs(60)).expect("nobody waits for somebody who waits for him");
}

#[test]
fn safe_function_that_panics_at_drop_is_retried() {
    let (safe, made_safe) = std::sync::mpsc::sync_channel(1);
    let mut fails = true;
    drop(live_with(move |(), cause| {
        if cause == Cause::Dropped {
            assert!(!std::mem::take(&mut fails), "a planted panic");
            safe.send(()).expect("the test waits");
        }
    }));
    made_safe.recv_timeout(Duration::from_secs(60)).expect("it is tried until it is done");
}

/// In a process of its own: in this one other tests wake the thread. Without them it would sleep for minutes.
#[test]
fn safe_function_that_panics_at_trip_is_retried() {
    let tests = std::env::current_exe().expect("it runs");
    let alone = ["--exact", "--ignored", "protection::tests::a_tripped_output_alone_is_tried_again_at_once"];
    let run = std::process::Command::new(tests).args(alone).output().expect("it can be run");
    let said = String::from_utf8_lossy(&run.stdout);
    assert!(run.status.success() && said.contains("1 passed"), "{said}");
}

#[test]
#[ignore = "the test above runs it alone"]
fn a_tripped_output_alone_is_tried_again_at_once() {
    let (safe, made_safe) = std::sync::mpsc::sync_channel(1);
    let mut fails = true;
    let guard = live_with(move |(), cause| {
        if cause == Cause::Tripped {
            assert!(!std::mem::take(&mut fails), "a planted panic");
            safe.send(()).expect("the test waits");
        }
    });
    guard.trip();
    made_safe.recv_timeout(Duration::from_secs(60)).expect("it is tried until it is done");
}
