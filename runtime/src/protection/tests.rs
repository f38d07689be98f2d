//! Each class of error, injected between a sender and a receiver: none may be used, and the output has to be safe when it must.

use std::{
    sync::{Arc, Mutex},
    time::Duration,
};

use bytes::Bytes;
use proptest::{prelude::*, test_runner::TestRng};

use super::{receiver::Receiver, sender::Flows, *};
use crate::tid::{AppAddress, NodeAddress, Tid};

const MS: Duration = Duration::from_millis(1);
const PROTECTION: Protection = Protection::of_period(MS);
/// Trials of each class of error; 100,000 in a release build.
const TRIALS: u32 = if cfg!(debug_assertions) { 10_000 } else { 100_000 };

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

/// A sender and a receiver, a message each millisecond, an echo each second one.
struct Bench {
    now: Time,
    flows: Flows,
    receiver: Receiver,
    sent: u64,
    applied: Vec<u64>,
}

impl Bench {
    fn new() -> Self {
        let now = Time::from_nanos(1_000_000_000);
        let receiver = Receiver::new(Codename::of::<Torque>(tid(CENTRAL), tid(DRIVE)), PROTECTION);
        let mut bench =
            Self { now, flows: Flows::new(Time::from_nanos(5)), receiver, sent: 0, applied: Vec::new() };
        // The first message makes the flow that an echo is for.
        bench.seal();
        bench
    }

    /// A live one.
    fn live() -> Self {
        let mut bench = Self::new();
        for _ in 0..PROTECTION.good_min {
            let message = bench.next();
            assert_eq!(bench.take(&message), Verdict::Hold);
        }
        bench.receiver.arm(bench.now).expect("it has come often enough");
        bench
    }

    fn seal(&mut self) -> Bytes {
        self.sent += 1;
        self.flows.seal(tid(CENTRAL), tid(DRIVE), &Torque { nm: self.sent }).expect("one flow")
    }

    /// One period later: the sender's next message, with a fresh echo.
    fn next(&mut self) -> Bytes {
        self.now = self.now + MS;
        let at = self.receiver.echo(self.now);
        self.flows.heard(tid(DRIVE), Echo::new(Torque::KIND, at));
        self.seal()
    }

    fn take(&mut self, bytes: &Bytes) -> Verdict {
        let verdict = self.receiver.take(self.now, bytes);
        if let Verdict::Apply(payload) = &verdict {
            self.applied.push(crate::wire::decode::<Torque>(payload).expect("it was sealed").nm);
        }
        verdict
    }

    /// What is applied is what was sent, once, in order.
    fn check(&self) {
        assert!(self.applied.windows(2).all(|two| two[0] < two[1]), "{:?}", self.applied);
        assert!(self.applied.last().is_none_or(|last| *last <= self.sent));
    }
}

fn rng() -> TestRng {
    TestRng::deterministic_rng(prop::test_runner::RngAlgorithm::ChaCha)
}

#[test]
fn what_is_sealed_is_applied_once_armed_and_not_before() {
    let mut bench = Bench::new();
    for _ in 1..PROTECTION.good_min {
        let message = bench.next();
        assert_eq!(bench.take(&message), Verdict::Hold);
    }
    let (good, wanted) = (PROTECTION.good_min - 1, PROTECTION.good_min);
    assert_eq!(
        bench.receiver.arm(bench.now),
        Err(ArmError::NotGood { good, wanted, silent: Duration::ZERO })
    );
    let message = bench.next();
    assert_eq!(bench.take(&message), Verdict::Hold);
    bench.receiver.arm(bench.now).unwrap();
    let message = bench.next();
    assert!(matches!(bench.take(&message), Verdict::Apply(_)));
    assert_eq!(bench.applied, [bench.sent]);
}

#[test]
fn a_damaged_message_is_found_whatever_is_damaged() {
    let mut rng = rng();
    let mut bench = Bench::live();
    for _ in 0..TRIALS {
        let whole = bench.next();
        let mut bytes = whole.to_vec();
        match rng.random_range(0..4) {
            // One to eight bits, anywhere.
            0 | 1 => {
                for _ in 0..rng.random_range(1..=8) {
                    let at = rng.random_range(0..bytes.len());
                    bytes[at] ^= 1 << rng.random_range(0..8);
                }
            }
            // A burst.
            2 => {
                let from = rng.random_range(0..bytes.len());
                let to = (from + rng.random_range(1..=64)).min(bytes.len());
                rng.fill_bytes(&mut bytes[from..to]);
            }
            // Cut, or longer than it was.
            _ if rng.random() => bytes.truncate(rng.random_range(0..bytes.len())),
            _ => bytes.extend([0; 8]),
        }
        let is_damaged = bytes != whole;
        let verdict = bench.receiver.take(bench.now, &Bytes::from(bytes));
        if is_damaged {
            assert_eq!(verdict, Verdict::Refused(Fault::Corrupt));
        }
    }
    bench.check();
    assert!(matches!(bench.receiver.state(), State::Safe(_)), "so many bad ones are not borne");
}

#[test]
fn what_was_sealed_by_or_for_another_or_as_another_type_is_found() {
    #[derive(Debug, Serialize, Deserialize)]
    struct Speed {
        nm: u64,
    }
    impl Payload for Speed {
        // As long as the other name.
        const NAME: &'static str = "test.torquo";
        const PROTECTION: Option<Protection> = Some(PROTECTION);
    }
    let mut rng = rng();
    let mut bench = Bench::live();
    let flows = Flows::new(Time::from_nanos(5));
    for _ in 0..TRIALS {
        bench.next();
        let (source, destination): (u32, u32) = (rng.random_range(0..64), rng.random_range(0..64));
        let is_meant = (source, destination) == (CENTRAL, DRIVE);
        let bytes = if rng.random() {
            flows.seal(tid(source), tid(destination), &Speed { nm: 1 })
        } else if is_meant {
            continue;
        } else {
            flows.seal(tid(source), tid(destination), &Torque { nm: 1 })
        };
        let bytes = bytes.expect("few flows");
        assert_eq!(bench.receiver.take(bench.now, &bytes), Verdict::Refused(Fault::Corrupt));
    }
    bench.check();
}

#[test]
fn a_message_that_comes_again_or_too_early_in_the_order_is_not_applied() {
    let mut rng = rng();
    let mut bench = Bench::live();
    let mut earlier: Vec<Bytes> = Vec::new();
    let (mut repeated, mut backwards) = (0, 0);
    while repeated + backwards < 2 * TRIALS {
        let message = bench.next();
        bench.take(&message);
        earlier.push(message.clone());
        let (old, expected) = if rng.random() || earlier.len() < 2 {
            repeated += 1;
            (message, Fault::Repeated)
        } else {
            backwards += 1;
            (earlier[rng.random_range(0..earlier.len() - 1)].clone(), Fault::Backwards)
        };
        // Both can be too old as well, which is found first.
        let verdict = bench.take(&old);
        assert!(
            [expected, Fault::TooOld].map(Verdict::Refused).contains(&verdict),
            "{verdict:?} where {expected:?} was injected"
        );
        earlier.drain(..earlier.len().saturating_sub(8));
        if !matches!(bench.receiver.state(), State::Live) {
            while bench.receiver.arm(bench.now).is_err() {
                let message = bench.next();
                bench.take(&message);
            }
        }
    }
    bench.check();
}

#[test]
fn a_loss_is_borne_up_to_its_limit_and_makes_the_output_safe_above_it() {
    let mut rng = rng();
    for _ in 0..TRIALS / 10 {
        let mut bench = Bench::live();
        for _ in 0..10 {
            let lost = rng.random_range(0..=2 * PROTECTION.lost_max);
            // In the same moment, so that no watchdog says anything.
            for _ in 0..lost {
                bench.seal();
            }
            let message = bench.next();
            let verdict = bench.take(&message);
            if lost <= PROTECTION.lost_max {
                assert!(matches!(verdict, Verdict::Apply(_)), "{verdict:?} after {lost}");
            } else {
                assert_eq!(verdict, Verdict::Refused(Fault::Gap));
                assert_eq!(bench.receiver.state(), State::Safe(Cause::TooMuchLost));
                break;
            }
        }
        bench.check();
    }
}

#[test]
fn a_silence_makes_the_output_safe_at_its_limit_even_if_nobody_looked() {
    let mut rng = rng();
    for _ in 0..TRIALS {
        let mut bench = Bench::live();
        let deadline = bench.receiver.deadline().expect("it is live");
        assert_eq!(deadline, bench.now + PROTECTION.within);
        bench.receiver.expire(Time::from_nanos(deadline.as_nanos() - 1));
        assert_eq!(bench.receiver.state(), State::Live);
        if rng.random() {
            bench.receiver.expire(deadline);
            assert_eq!(bench.receiver.state(), State::Safe(Cause::Silent), "at the limit itself");
        }
        bench.now = deadline + Duration::from_nanos(rng.random_range(0..5_000_000));
        let message = bench.next();
        if rng.random() {
            bench.receiver.expire(bench.now);
        }
        assert!(!matches!(bench.take(&message), Verdict::Apply(_)), "it came too late to be applied");
        assert_eq!(bench.receiver.state(), State::Safe(Cause::Silent));
    }
}

#[test]
fn a_message_that_was_held_up_is_too_old_although_it_is_the_next_one() {
    let mut rng = rng();
    let mut bench = Bench::live();
    for _ in 0..TRIALS {
        let held_up = bench.next();
        let age = PROTECTION.age_max + Duration::from_nanos(rng.random_range(1..1_000_000_000));
        let sealed = bench.now;
        // The receiver goes on sending echoes; the black channel hands this one over later.
        while bench.now.since(sealed) < age {
            bench.now = bench.now + age / 3 + Duration::from_nanos(1);
            bench.receiver.echo(bench.now);
        }
        assert_eq!(bench.take(&held_up), Verdict::Refused(Fault::TooOld));
    }
    assert!(bench.applied.is_empty());
}

#[test]
fn a_sender_that_counts_anew_makes_the_output_safe_until_it_is_armed() {
    for life in 6..1_006 {
        let mut bench = Bench::live();
        bench.flows = Flows::new(Time::from_nanos(life));
        bench.seal();
        let message = bench.next();
        assert_eq!(bench.take(&message), Verdict::Refused(Fault::Restarted));
        assert_eq!(bench.receiver.state(), State::Safe(Cause::Restarted));
        let message = bench.next();
        assert_eq!(bench.take(&message), Verdict::Hold, "it is good, and nobody has armed the output");
        assert!(bench.receiver.arm(bench.now).is_err());
    }
}

#[test]
fn a_sender_that_hears_no_echo_is_not_believed() {
    let mut bench = Bench::new();
    for _ in 0..100 {
        bench.now = bench.now + MS;
        bench.receiver.echo(bench.now);
        let message = bench.seal();
        assert_eq!(bench.take(&message), Verdict::Refused(Fault::TooOld));
    }
    assert!(bench.receiver.arm(bench.now).is_err());
}

#[test]
fn a_time_that_was_never_sent_is_no_echo_however_young_it_looks() {
    let mut rng = rng();
    let mut bench = Bench::live();
    for _ in 0..TRIALS {
        bench.next();
        let near = bench.now.as_nanos() - 5_000_000 + rng.random_range(0..10_000_000);
        if !near.is_multiple_of(1_000_000) {
            bench.flows.heard(tid(DRIVE), Echo::new(Torque::KIND, Time::from_nanos(near)));
            let message = bench.seal();
            assert_eq!(bench.receiver.take(bench.now, &message), Verdict::Refused(Fault::TooOld));
        }
    }
}

#[test]
fn one_bad_message_is_borne_and_the_second_of_64_is_not() {
    let mut bench = Bench::live();
    let bad = Bytes::from_static(b"noise");
    assert_eq!(bench.take(&bad), Verdict::Refused(Fault::Corrupt));
    assert_eq!(bench.receiver.state(), State::Live);
    for _ in 0..62 {
        let message = bench.next();
        assert!(matches!(bench.take(&message), Verdict::Apply(_)));
    }
    assert_eq!(bench.take(&bad), Verdict::Refused(Fault::Corrupt));
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
fn the_bytes_are_those_of_the_page() {
    let stamp = Stamp { counter: 3, incarnation: 5, echo: Time::from_nanos(7) };
    let sealed = seal(&Codename { source: tid(1), destination: tid(2), name: "a.b" }, stamp, b"xyz");
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

/// A live output, and whose `safe` is called with what is in its slot.
fn live_guard(slot: &Arc<Mutex<Option<Guard<()>>>>) -> Guard<()> {
    let peer = slot.clone();
    let safe = move |(): &mut (), _| {
        if let Some(peer) = peer.lock().expect("nobody panics with it").as_ref() {
            peer.trip();
        }
    };
    let guard = Guard::new::<Patient>(tid(CENTRAL), tid(DRIVE), (), safe).expect("a thread");
    let (flows, guarded) = (Flows::new(Time::from_nanos(5)), guard.guarded());
    let seal = || flows.seal(tid(CENTRAL), tid(DRIVE), &Patient).expect("one flow");
    seal();
    for _ in 0..8 {
        flows.heard(tid(DRIVE), Echo::new(Patient::KIND, guarded.echo()));
        assert_eq!(guarded.take(&seal()), Verdict::Hold);
    }
    guard.arm().expect("good ones have come");
    guard
}

/// For whom no machine is too slow.
#[derive(Serialize, Deserialize)]
struct Patient;

impl Payload for Patient {
    const NAME: &'static str = "test.patient";
    const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_secs(60)));
}

#[test]
fn guards_that_trip_each_other_are_both_safe_and_wait_for_nobody() {
    let (done, is_done) = std::sync::mpsc::sync_channel(1);
    std::thread::spawn(move || {
        for _ in 0..200 {
            let slots: [Arc<Mutex<Option<Guard<()>>>>; 2] = Default::default();
            let guards = [live_guard(&slots[0]), live_guard(&slots[1])];
            *slots[0].lock().expect("it is new") = Some(guards[1].clone());
            *slots[1].lock().expect("it is new") = Some(guards[0].clone());
            std::thread::scope(|scope| guards.iter().for_each(|guard| drop(scope.spawn(|| guard.trip()))));
            // Whom the other one had in hand the thread of the watchdogs trips.
            while guards.iter().any(|guard| guard.state() == State::Live) {
                std::thread::yield_now();
            }
            slots.iter().for_each(|slot| drop(slot.lock().expect("nobody panics with it").take()));
        }
        done.send(()).expect("the test waits");
    });
    is_done.recv_timeout(Duration::from_secs(60)).expect("nobody waits for somebody who waits for him");
}

proptest! {
    #[test]
    fn bytes_from_outside_are_refused_and_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..128)) {
        let mut receiver = Receiver::new(Codename::of::<Torque>(tid(1), tid(2)), PROTECTION);
        prop_assert_eq!(receiver.take(Time::from_nanos(1), &bytes.into()), Verdict::Refused(Fault::Corrupt));
    }
}
