//! Each class of error in the table of IEC 61784-3, injected between a sender and a receiver that work: every
//! error is detected, none is applied. `--nocapture` shows a line for each class.

use proptest::{
    prelude::{Rng, RngExt},
    test_runner::{RngAlgorithm, TestRng},
};

use super::*;

/// Trials of each class of error; 100,000 in a release build.
const TRIALS: u32 = if cfg!(debug_assertions) { 10_000 } else { 100_000 };

/// The required state after an error.
#[derive(Clone, Copy)]
enum Consequence {
    /// It was tolerated: the next command is applied.
    Live,
    /// The output is safe for this cause. The next command is not applied; commands are applied after eight
    /// valid ones and a manual arm.
    Safe(Cause),
}

/// The figures of one class of errors.
#[derive(Debug, Default, PartialEq, Eq)]
struct Figures {
    /// Commands that were applied just before an error: so only the error prevented its application.
    good_before: u32,
    injected: u32,
    detected: u32,
    applied: u32,
    /// Trials that ended as their [`Consequence`] requires.
    good_after: u32,
}

/// One error, in a bench with a live output.
struct Trial<'a> {
    bench: Bench,
    figures: &'a mut Figures,
}

impl Trial<'_> {
    /// Injects the error on the path of all messages.
    fn inject(&mut self, bytes: &Bytes, expected: ProtectionError) {
        let before = self.bench.applied.len();
        let verdict = self.bench.take(bytes);
        let applied = self.bench.applied.len() - before;
        self.count(verdict == Verdict::Refused(expected), applied);
    }

    fn count(&mut self, is_detected: bool, applied: usize) {
        self.figures.injected += 1;
        self.figures.detected += u32::from(is_detected);
        self.figures.applied += u32::try_from(applied).expect("one message was taken");
    }

    fn ends_as(&mut self, consequence: Consequence) -> bool {
        let is_right = match consequence {
            Consequence::Live => self.bench.applies_the_next(),
            Consequence::Safe(cause) => {
                let is_safe = self.bench.receiver.state() == State::Safe(cause);
                let message = self.bench.next();
                let is_held = self.bench.take(&message) == Verdict::Hold;
                let is_shut = self.bench.receiver.arm(self.bench.now).is_err();
                is_safe && is_held && is_shut && {
                    self.bench.come_alive();
                    self.bench.applies_the_next()
                }
            }
        };
        // Applied messages equal the sent ones, once each, in order.
        is_right && self.bench.applied.windows(2).all(|two| two[0] < two[1])
    }
}

/// Runs all trials of a class.
fn inject(
    class: &str,
    protection: Protection,
    consequence: Consequence,
    error: impl Fn(&mut Trial<'_>, &mut TestRng),
) {
    let mut rng = TestRng::deterministic_rng(RngAlgorithm::ChaCha);
    let mut figures = Figures::default();
    for _ in 0..TRIALS {
        let mut trial = Trial { bench: Bench::live_of(protection), figures: &mut figures };
        let are_applied = (0..rng.random_range(1..=8)).all(|_| trial.bench.applies_the_next());
        trial.figures.good_before += u32::from(are_applied);
        error(&mut trial, &mut rng);
        let is_good = trial.ends_as(consequence);
        figures.good_after += u32::from(is_good);
    }
    let Figures { injected, detected, applied, .. } = figures;
    println!("{class}: {injected} injected, {detected} detected, {applied} applied");
    let all =
        Figures { good_before: TRIALS, injected: TRIALS, detected: TRIALS, applied: 0, good_after: TRIALS };
    assert_eq!(figures, all, "{class}");
}

/// `message` as another sender would have sealed it: valid except for the changes of `change`.
fn forged(message: &Bytes, change: impl FnOnce(&mut DataId, &mut Stamp)) -> Bytes {
    let (mut stamp, payload) = open(&data_id(), message).expect("it is the sender's own");
    let mut data_id = data_id();
    change(&mut data_id, &mut stamp);
    seal(&data_id, stamp, &payload)
}

fn any_tid(rng: &mut TestRng) -> Tid {
    Tid::new(NodeAddress::new(rng.random()), AppAddress::new(rng.random()))
}

/// Another TID than `tid`: a random one, or one that differs in one bit.
fn another(tid: Tid, rng: &mut TestRng) -> Tid {
    let other = match rng.random() {
        true => any_tid(rng),
        false => Tid::from_bits(tid.bits() ^ 1 << rng.random_range(0..64)),
    };
    if other == tid { another(tid, rng) } else { other }
}

fn damaged(whole: &Bytes, rng: &mut TestRng) -> Bytes {
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
        // Cut, or longer than before.
        _ if rng.random() => bytes.truncate(rng.random_range(0..bytes.len())),
        _ => bytes.extend([0; 8]),
    }
    // The same bit may have been flipped twice.
    if bytes == *whole { damaged(whole, rng) } else { bytes.into() }
}

#[test]
fn corruption_is_detected() {
    inject("corruption", PROTECTION, Consequence::Live, |trial, rng| {
        let whole = trial.bench.next();
        trial.inject(&damaged(&whole, rng), ProtectionError::Corrupt);
    });
}

#[test]
fn unintended_repetition_is_detected() {
    inject("unintended repetition", PROTECTION, Consequence::Live, |trial, rng| {
        // All of them are young enough: only their numbers show that they arrived before.
        let sent: Vec<Bytes> = (0..8)
            .map(|_| {
                let message = trial.bench.next();
                trial.bench.take(&message);
                message
            })
            .collect();
        let at = rng.random_range(0..sent.len());
        let expected =
            if at + 1 == sent.len() { ProtectionError::Repeated } else { ProtectionError::Backwards };
        trial.inject(&sent[at], expected);
    });
}

#[test]
fn incorrect_sequence_is_detected() {
    inject("incorrect sequence", PROTECTION, Consequence::Live, |trial, rng| {
        // No more than may be missing, so that the one that overtakes them is applied.
        let mut overtaken = vec![trial.bench.next()];
        if rng.random() {
            overtaken.push(trial.bench.seal());
        }
        assert!(trial.bench.applies_the_next(), "the one that comes too early is a good one");
        trial.inject(&overtaken[rng.random_range(0..overtaken.len())], ProtectionError::Backwards);
    });
}

#[test]
fn loss_beyond_the_limit_is_detected() {
    inject("loss", PROTECTION, Consequence::Safe(Cause::TooMuchLost), |trial, rng| {
        let lost = rng.random_range(PROTECTION.lost_max + 1..=10);
        // At the same time, so that no watchdog trips.
        for _ in 0..lost {
            trial.bench.seal();
        }
        let message = trial.bench.next();
        trial.inject(&message, ProtectionError::Gap);
    });
}

#[test]
fn loss_within_the_limit_is_counted() {
    inject("loss that is borne", PROTECTION, Consequence::Live, |trial, rng| {
        let before = trial.bench.receiver.tally().lost;
        let lost = rng.random_range(1..=PROTECTION.lost_max);
        for _ in 0..lost {
            trial.bench.seal();
        }
        assert!(trial.bench.applies_the_next(), "so many may be missing: {lost}");
        let is_counted = trial.bench.receiver.tally().lost == before + lost;
        trial.count(is_counted, 0);
    });
}

#[test]
fn loss_of_all_is_detected_at_the_time_limit() {
    inject("loss of all", PROTECTION, Consequence::Safe(Cause::Silent), |trial, rng| {
        let bench = &mut trial.bench;
        let deadline = bench.receiver.deadline().expect("it is live");
        assert_eq!(deadline, bench.now + PROTECTION.within);
        bench.receiver.expire(Time::from_nanos(deadline.as_nanos() - 1));
        assert_eq!(bench.receiver.state(), State::Live);
        // The watchdog acts on time; or late; or never, and a message arrives too late.
        let is_kept = rng.random();
        bench.now = deadline;
        if is_kept {
            let late = if rng.random() { 0 } else { rng.random_range(1..5_000_000) };
            bench.now = bench.now + Duration::from_nanos(late);
            bench.receiver.expire(bench.now);
        }
        let is_noticed = bench.receiver.state() == State::Safe(Cause::Silent);
        let before = bench.applied.len();
        let late = bench.next();
        bench.take(&late);
        let applied = bench.applied.len() - before;
        let is_safe = bench.receiver.state() == State::Safe(Cause::Silent);
        trial.count(is_noticed == is_kept && is_safe, applied);
    });
}

#[test]
fn delay_is_detected_without_a_watchdog() {
    let patient = Protection { within: Duration::from_secs(10), ..PROTECTION };
    inject("unacceptable delay", patient, Consequence::Live, |trial, rng| {
        let held_up = trial.bench.next();
        let until =
            trial.bench.now + patient.age_max + Duration::from_nanos(rng.random_range(1..100_000_000));
        // The receiver continues to send echoes; or its own thread was held up as well.
        while rng.random() && trial.bench.now + patient.echo_period() < until {
            trial.bench.now = trial.bench.now + patient.echo_period();
            trial.bench.receiver.echo(trial.bench.now);
        }
        trial.bench.now = until;
        trial.inject(&held_up, ProtectionError::TooOld);
    });
}

#[test]
fn unmeasured_age_is_detected_however_young_it_looks() {
    inject("echo that was never sent", PROTECTION, Consequence::Live, |trial, rng| {
        let message = trial.bench.next();
        // Echoes are sent at whole milliseconds.
        let ago = Duration::from_nanos(rng.random_range(0..8) * 1_000_000 + rng.random_range(1..1_000_000));
        let at = Time::from_nanos(trial.bench.now.as_nanos() + 1_000_000 - ago.as_nanos() as u64);
        trial.inject(&forged(&message, |_, stamp| stamp.echo = at), ProtectionError::TooOld);
    });
}

#[test]
fn insertion_from_another_sender_is_detected() {
    inject("insertion", PROTECTION, Consequence::Live, |trial, rng| {
        let message = trial.bench.next();
        let forged = forged(&message, |data_id, _| data_id.source = another(data_id.source, rng));
        trial.inject(&forged, ProtectionError::Corrupt);
    });
}

#[test]
fn masquerade_of_an_unprotected_message_is_detected() {
    inject("masquerade", PROTECTION, Consequence::Live, |trial, rng| {
        let message = trial.bench.next();
        let (_, payload) = open(&data_id(), &message).expect("it is the sender's own");
        let forged = match rng.random_range(0..3) {
            // From the right sender to the right receiver, of another type.
            0 => forged(&message, |data_id, _| {
                data_id.name = ["test.torquo", "test.torqu", ""][rng.random_range(0..3)]
            }),
            // The value without protection.
            1 => payload,
            // All but the data ID, from a sender that knows the format.
            _ => {
                let mut digest = crc64fast::Digest::new();
                let sealed = &message[..message.len() - 8];
                digest.write(sealed);
                [sealed, &digest.sum64().to_le_bytes()].concat().into()
            }
        };
        trial.inject(&forged, ProtectionError::Corrupt);
    });
}

#[test]
fn wrong_addressing_is_detected() {
    inject("addressing", PROTECTION, Consequence::Live, |trial, rng| {
        let message = trial.bench.next();
        let forged = forged(&message, |data_id, _| {
            if rng.random_range(0..8) == 0 {
                // A message of the receiver itself is sent back to it.
                std::mem::swap(&mut data_id.source, &mut data_id.destination);
            } else {
                data_id.destination = another(data_id.destination, rng);
            }
        });
        trial.inject(&forged, ProtectionError::Corrupt);
    });
}

#[test]
fn sender_restart_is_detected_for_any_first_counter() {
    inject("restart of the sender", PROTECTION, Consequence::Safe(Cause::Restarted), |trial, rng| {
        let life = loop {
            let life = Time::from_nanos(rng.random());
            if life != LIFE {
                break life;
            }
        };
        let count = trial.bench.sent;
        trial.bench.flows = Flows::new(life);
        // Half of them have exactly the next number of the former incarnation.
        for _ in 0..if rng.random() { count } else { rng.random_range(1..=2 * count) } {
            let Bench { flows, now, .. } = &trial.bench;
            flows.seal(tid(CENTRAL), tid(DRIVE), &Torque { nm: 0 }, *now).expect("one flow");
        }
        let message = trial.bench.next();
        trial.inject(&message, ProtectionError::Restarted);
    });
}

#[test]
fn receiver_restart_is_detected_by_messages_in_flight() {
    inject("restart of the receiver", PROTECTION, Consequence::Safe(Cause::NotArmed), |trial, rng| {
        let under_way = trial.bench.next();
        trial.bench.receiver = Receiver::new(PROTECTION);
        for _ in 0..rng.random_range(0..4) {
            trial.bench.now = trial.bench.now + MS;
            trial.bench.receiver.echo(trial.bench.now);
        }
        trial.inject(&under_way, ProtectionError::TooOld);
    });
}
