//! A script of protected messages and echoes between the incarnations of a sender and a live receiver.
//! Messages are valid, lost, delayed, repeated, out of order, corrupted or forged. A model in the simplest
//! form gives the expected result of each.

use std::collections::VecDeque;

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use super::{
    Cause, DataId, Echo, Protection, ProtectionError, Stamp, State,
    envelope::seal,
    receiver::{Opened, Receiver, Verdict},
    sender::Flows,
};
use crate::{
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Payload, decode, encode},
};

/// A script that moves a live output and has each kind of error.
pub const SOME_MESSAGES: &[u8] = &[
    15, 0, 1, 0, 2, 1, 1, 0, 2, 0, 2, 1, 15, 3, 1, 5, 9, 4, 1, 3, 4, 1, 60, 15, 5, 200, 0, 15, 7, 6, 0, 8, 9,
    1, 0, 15, 10, 1, 0, 2, 10, 0, 1, 3, 0, 11, 7, 12, 3, 1, 2, 3, 13, 4, 1, 2, 3, 4, 14, 15, 1, 1, 1, 1, 0,
    15, 0,
];

const PROTECTION: Protection = Protection::of_period(std::time::Duration::from_millis(1));
/// Maximum number of messages that can be repeated.
const KEPT: usize = 64;
/// Number of valid echoes; see the receiver.
const ECHOES: usize = 8;
/// Number of recorded messages.
const WINDOW: usize = 64;

#[derive(Debug, Serialize, Deserialize)]
struct Torque {
    number: u64,
}

impl Payload for Torque {
    const NAME: &'static str = "fuzz.torque";
    const PROTECTION: Option<Protection> = Some(PROTECTION);
}

/// A message sealed under the right data ID, by any sender.
struct Sealed {
    bytes: Bytes,
    stamp: Stamp,
    payload: Bytes,
}

/// The required state of a receiver, implemented a second time.
struct Model {
    state: State,
    last: Option<(u64, u64)>,
    last_good: Time,
    good: u32,
    /// The newest first; `true` for a bad message.
    window: VecDeque<bool>,
    /// The newest first.
    echoes: VecDeque<Time>,
}

struct Play {
    now: Time,
    flows: Flows,
    /// The stamp of the sender's next message.
    next: Stamp,
    receiver: Receiver,
    model: Model,
    kept: VecDeque<Sealed>,
    applied: usize,
}

/// Plays a script. Returns whether any message was applied.
#[must_use]
pub fn protected(mut script: &[u8]) -> bool {
    let mut play = Play::new();
    while !script.is_empty() {
        play.step(&mut script);
        assert_eq!(play.receiver.state(), play.model.state);
        let deadline = (play.model.state == State::Live).then(|| play.model.last_good + PROTECTION.within);
        assert_eq!(play.receiver.deadline(), deadline);
    }
    play.applied > 0
}

fn tid(app: u32) -> Tid {
    Tid::new(NodeAddress::new(7), AppAddress::new(0x1000 + app))
}

fn data_id() -> DataId {
    DataId::of::<Torque>(tid(1), tid(2))
}

fn byte(script: &mut &[u8]) -> u8 {
    script.split_off_first().copied().unwrap_or(0)
}

fn bytes<'a>(script: &mut &'a [u8], count: u8) -> &'a [u8] {
    let count = usize::from(count).min(script.len());
    script.split_off(..count).unwrap_or_default()
}

/// Returns a number near to `word`, or far from it.
fn around(word: u64, off: u8) -> u64 {
    match off.cast_signed() {
        i8::MIN => 0,
        i8::MAX => u64::MAX,
        near => word.wrapping_add_signed(near.into()),
    }
}

impl Play {
    fn new() -> Self {
        let model = Model {
            state: State::Safe(Cause::NotArmed),
            last: None,
            last_good: Time::ZERO,
            good: 0,
            window: VecDeque::new(),
            echoes: VecDeque::new(),
        };
        let mut play = Self {
            now: Time::from_nanos(1_000_000_000),
            flows: Flows::new(Time::from_nanos(100)),
            next: Stamp { counter: 0, incarnation: 100, echo: Time::ZERO },
            receiver: Receiver::new(PROTECTION),
            model,
            kept: VecDeque::new(),
            applied: 0,
        };
        // The first message creates the flow that the echoes are for.
        play.send();
        play
    }

    fn step(&mut self, script: &mut &[u8]) {
        match byte(script) % 16 {
            0 => {
                self.send();
                self.comes_again(0);
            }
            1 => self.send(),
            2 => self.comes_again(byte(script)),
            3 => self.changed(script, |bytes, script| {
                let at = usize::from(byte(script)) % bytes.len();
                bytes[at] ^= byte(script);
            }),
            4 => self.changed(script, |bytes, script| match byte(script) % 2 {
                0 => bytes.push(byte(script)),
                _ => bytes.truncate(bytes.len() - 1 - usize::from(byte(script)) % bytes.len()),
            }),
            5 => self.pass(u64::from(byte(script)) * 100_000),
            6 => {
                let echo = self.echo();
                self.hears(Echo::new(Torque::KIND, echo));
            }
            7 => drop(self.echo()),
            8 => self.arm(),
            9 => {
                let life = around(self.next.incarnation, byte(script));
                self.flows = Flows::new(Time::from_nanos(life));
                self.next = Stamp { counter: 0, incarnation: life, echo: Time::ZERO };
            }
            10 => {
                let newest = self.model.echoes.front().copied().unwrap_or(Time::ZERO).as_nanos();
                let stamp = Stamp {
                    counter: around(self.next.counter, byte(script)),
                    incarnation: around(self.next.incarnation, byte(script)),
                    echo: Time::from_nanos(around(newest, byte(script))),
                };
                let count = byte(script) % 32;
                self.keep(stamp, Bytes::copy_from_slice(bytes(script, count)));
                self.comes_again(0);
            }
            11 => {
                let bit = byte(script) % 64;
                let other = DataId { source: Tid::from_bits(tid(1).bits() ^ 1 << bit), ..data_id() };
                let stamp = Stamp { counter: self.next.counter + 1, ..self.next };
                self.comes(&seal(&other, stamp, b"forged"));
            }
            12 => {
                let count = byte(script);
                self.comes(&Bytes::copy_from_slice(bytes(script, count)));
            }
            13 => {
                let count = byte(script);
                if let Ok(echo) = decode::<Echo>(bytes(script, count)) {
                    self.hears(echo);
                }
            }
            14 => {
                self.receiver.trip(Cause::Tripped);
                self.model.trip(Cause::Tripped);
            }
            _ => self.come_alive(),
        }
    }

    /// Runs an ordered channel until the output is live.
    fn come_alive(&mut self) {
        for _ in 0..=PROTECTION.good_min {
            self.pass(1_000_000);
            let echo = self.echo();
            self.hears(Echo::new(Torque::KIND, echo));
            self.send();
            self.comes_again(0);
        }
        self.arm();
    }

    fn pass(&mut self, nanos: u64) {
        self.now = self.now + std::time::Duration::from_nanos(nanos);
        self.receiver.expire(self.now);
        self.model.expire(self.now);
    }

    fn echo(&mut self) -> Time {
        self.model.echoes.push_front(self.now);
        self.model.echoes.truncate(ECHOES);
        self.receiver.echo(self.now)
    }

    /// Passes an echo, which may claim to be the receiver's, to the sender.
    fn hears(&mut self, echo: Echo) {
        let times = std::iter::once((echo.kind, echo.at_ns)).chain(echo.others.iter().copied());
        let newest = times.take(super::sender::FLOWS_MAX).filter(|(kind, _)| *kind == Torque::KIND).last();
        if let Some((_, at_ns)) = newest.filter(|_| self.next.counter > 0) {
            self.next.echo = Time::from_nanos(at_ns);
        }
        self.flows.record_echo(tid(2), echo);
    }

    /// Sends the sender's next message: the newest of those that can be repeated.
    fn send(&mut self) {
        self.next.counter += 1;
        let torque = Torque { number: self.next.counter };
        let bytes = self.flows.seal(tid(1), tid(2), &torque, self.now).expect("one flow");
        self.keep(self.next, encode(&torque));
        assert_eq!(self.kept.front().map(|sealed| &sealed.bytes), Some(&bytes), "the sender's own stamp");
    }

    fn keep(&mut self, stamp: Stamp, payload: Bytes) {
        let bytes = seal(&data_id(), stamp, &payload);
        self.kept.push_front(Sealed { bytes, stamp, payload });
        self.kept.truncate(KEPT);
    }

    fn comes_again(&mut self, ago: u8) {
        let bytes = self.kept[usize::from(ago) % self.kept.len()].bytes.clone();
        self.comes(&bytes);
    }

    fn changed(&mut self, script: &mut &[u8], change: impl FnOnce(&mut Vec<u8>, &mut &[u8])) {
        let at = usize::from(byte(script)) % self.kept.len();
        let mut bytes = self.kept[at].bytes.to_vec();
        change(&mut bytes, script);
        self.comes(&bytes.into());
    }

    fn comes(&mut self, bytes: &Bytes) {
        let sealed = self.kept.iter().find(|sealed| sealed.bytes == *bytes);
        let expected = self.model.take(self.now, sealed);
        let read = |payload: Bytes| decode::<Torque>(&payload).is_ok().then_some(payload);
        let (opened, payload) = Opened::of(&data_id(), bytes, read);
        let verdict = self.receiver.take(self.now, opened).of(payload);
        assert_eq!(verdict, expected, "{:?}", sealed.map(|sealed| sealed.stamp));
        self.applied += usize::from(matches!(verdict, Verdict::Apply(_)));
    }

    fn arm(&mut self) {
        self.model.expire(self.now);
        let may = self.model.good >= PROTECTION.good_min
            && self.now.since(self.model.last_good) < PROTECTION.within;
        assert_eq!(self.receiver.arm(self.now).is_ok(), may);
        if may {
            self.model.state = State::Live;
        }
    }
}

impl Model {
    fn expire(&mut self, now: Time) {
        if self.state == State::Live && now >= self.last_good + PROTECTION.within {
            self.trip(Cause::Silent);
        }
    }

    fn trip(&mut self, cause: Cause) {
        if self.state == State::Live {
            self.state = State::Safe(cause);
        }
        self.good = 0;
    }

    /// Returns the expected result of a message; `None`: not sealed by any sender in this form.
    fn take(&mut self, now: Time, sealed: Option<&Sealed>) -> Verdict<Bytes> {
        self.expire(now);
        let fault = sealed.map_or(Some(ProtectionError::Corrupt), |sealed| {
            let is_unreadable = decode::<Torque>(&sealed.payload).is_err();
            self.fault(now, sealed.stamp).or_else(|| is_unreadable.then_some(ProtectionError::Unreadable))
        });
        self.window.push_front(fault.is_some());
        self.window.truncate(WINDOW);
        if fault.is_some() {
            self.good = 0;
        } else {
            let is_silent = now >= self.last_good + PROTECTION.within;
            self.good = if is_silent { 1 } else { self.good + 1 };
            self.last_good = now;
        }
        let verdict = match (fault, self.state, sealed) {
            (None, State::Live, Some(sealed)) => Verdict::Apply(sealed.payload.clone()),
            (None, _, _) => Verdict::Hold,
            (Some(fault), _, _) => Verdict::Refused(fault),
        };
        if self.window.iter().filter(|is_bad| **is_bad).count() > PROTECTION.bad_max as usize {
            self.window.clear();
            self.trip(Cause::TooManyBad);
        }
        verdict
    }

    fn fault(&mut self, now: Time, stamp: Stamp) -> Option<ProtectionError> {
        let is_young = now.since(stamp.echo) <= PROTECTION.age_max;
        if stamp.echo == Time::ZERO || !self.echoes.contains(&stamp.echo) || !is_young {
            return Some(ProtectionError::TooOld);
        }
        let before = self.last.replace((stamp.incarnation, stamp.counter));
        let (incarnation, counter) = before?;
        if incarnation != stamp.incarnation {
            self.trip(Cause::Restarted);
            return Some(ProtectionError::Restarted);
        }
        let missing = i128::from(stamp.counter) - i128::from(counter) - 1;
        if missing < 0 {
            self.last = before;
            return Some(if missing == -1 { ProtectionError::Repeated } else { ProtectionError::Backwards });
        }
        if missing > i128::from(PROTECTION.lost_max) {
            self.trip(Cause::TooMuchLost);
            return Some(ProtectionError::Gap);
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn initial_script_moves_the_output() {
        assert!(protected(SOME_MESSAGES));
    }

    proptest::proptest! {
        #[test]
        fn receiver_agrees_with_the_model_for_any_script(
            script in proptest::collection::vec((0_u8..16, 0_u8..=255, 0_u8..=255), 0..200)
        ) {
            let script: Vec<u8> = script.into_iter().flat_map(|(step, a, b)| [step, a, b]).collect();
            let _ = protected(&script);
        }
    }
}
