//! The receiving end without clock and thread: what is believed, and when the output has to be safe.

use std::time::Duration;

use bytes::Bytes;

use super::{ArmError, Cause, DataId, Fault, Protection, Stamp, State, Tally, envelope::open};
use crate::time::Time;

/// Echoes that a sender may answer with. One is sent each quarter of the longest age, so that the oldest is twice too old.
const ECHOES: usize = 8;
/// So much more sleep of the host than was known is one: less may be due to how it is read.
const SLEEP_MIN: Duration = Duration::from_millis(5);

/// What is in a message, as far as that can be said without its receiver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Opened {
    /// Not what was sealed under this data_id.
    Corrupt,
    /// What was sealed, and no value of the type that the receiver has.
    Unreadable(Stamp),
    /// A value.
    Value(Stamp),
}

impl Opened {
    /// Takes a message out of its envelope, and reads it. How it is read is the user's code: nobody else waits for it.
    pub(crate) fn of<T>(
        data_id: &DataId,
        bytes: &Bytes,
        read: impl FnOnce(Bytes) -> Option<T>,
    ) -> (Self, Option<T>) {
        Self::read(open(data_id, bytes), read)
    }

    /// Reads what was in an envelope, if that was one.
    pub(crate) fn read<B, T>(
        opened: Option<(Stamp, B)>,
        read: impl FnOnce(B) -> Option<T>,
    ) -> (Self, Option<T>) {
        let Some((stamp, payload)) = opened else { return (Self::Corrupt, None) };
        let value = read(payload);
        (if value.is_some() { Self::Value(stamp) } else { Self::Unreadable(stamp) }, value)
    }
}

/// What comes of one message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict<T> {
    /// It is good, and the output is live.
    Apply(T),
    /// It is good, and the output is safe until it is armed again.
    Hold,
    /// It is not to be used.
    Refused(Fault),
}

impl Verdict<()> {
    /// The same of the message's value.
    pub(crate) fn of<T>(self, value: Option<T>) -> Verdict<T> {
        match self {
            // Only a value is ever good.
            Self::Apply(()) => value.map_or(Verdict::Refused(Fault::Unreadable), Verdict::Apply),
            Self::Hold => Verdict::Hold,
            Self::Refused(fault) => Verdict::Refused(fault),
        }
    }
}

/// What is known of one flow of protected messages.
#[derive(Debug)]
pub(crate) struct Receiver {
    protection: Protection,
    state: State,
    /// Incarnation and counter of the last message that was believed.
    last: Option<(u64, u64)>,
    /// When that came.
    heard: Time,
    /// Good messages in a row: none bad among them, and no silence.
    good: u32,
    /// The last 64 messages, the newest at the lowest bit: 1 for a bad one.
    history: u64,
    echoes: [Time; ECHOES],
    /// How long the host has slept in all.
    asleep: Duration,
    tally: Tally,
}

impl Receiver {
    pub(crate) fn new(protection: Protection) -> Self {
        Self {
            protection,
            state: State::Safe(Cause::NotArmed),
            last: None,
            heard: Time::ZERO,
            good: 0,
            history: 0,
            echoes: [Time::ZERO; ECHOES],
            asleep: Duration::ZERO,
            tally: Tally::default(),
        }
    }

    pub(crate) const fn state(&self) -> State {
        self.state
    }

    pub(crate) const fn tally(&self) -> Tally {
        self.tally
    }

    /// When [`expire`](Self::expire) has something to say; `None` while the output is safe.
    pub(crate) fn deadline(&self) -> Option<Time> {
        (self.state == State::Live).then(|| self.heard + self.protection.within)
    }

    /// The time that the sender is to send back, sent to it each [`Protection::echo_period`].
    pub(crate) fn echo(&mut self, now: Time) -> Time {
        self.echoes.rotate_right(1);
        self.echoes[0] = now;
        now
    }

    /// The last of them; zero before there was one.
    pub(crate) const fn last_echo(&self) -> Time {
        self.echoes[0]
    }

    pub(crate) const fn echo_period(&self) -> Duration {
        self.protection.echo_period()
    }

    // spec: E2E-9
    /// The host has slept for so long in all. Clocks stand meanwhile: what was under way has an age that nobody knows, so nothing counts that
    /// quotes an echo from before.
    pub(crate) fn has_slept(&mut self, asleep: Duration) {
        if asleep >= self.asleep + SLEEP_MIN {
            self.echoes = [Time::ZERO; ECHOES];
            self.trip(Cause::Slept);
        }
        self.asleep = self.asleep.max(asleep);
    }

    // spec: E2E-6
    /// The output is safe if the watchdog's time is over.
    pub(crate) fn expire(&mut self, now: Time) {
        if self.deadline().is_some_and(|deadline| now >= deadline) {
            self.trip(Cause::Silent);
        }
    }

    /// The output is safe from now on, until it is armed again. Why it is, is what happened first.
    pub(crate) const fn trip(&mut self, cause: Cause) {
        if matches!(self.state, State::Live) {
            self.tally.trips += 1;
            self.state = State::Safe(cause);
        }
        self.good = 0;
    }

    /// Takes one message in.
    pub(crate) fn take(&mut self, now: Time, opened: Opened) -> Verdict<()> {
        // However late the thread is that keeps the watchdog.
        self.expire(now);
        let verdict = match self.examine(now, opened) {
            Ok(()) => {
                self.history <<= 1;
                // A row ends with a silence that would have made a live output safe.
                let is_next = now.since(self.heard) < self.protection.within;
                self.good = if is_next { self.good.saturating_add(1) } else { 1 };
                self.tally.good += 1;
                self.heard = now;
                if self.state == State::Live { Verdict::Apply(()) } else { Verdict::Hold }
            }
            Err(fault) => {
                self.history = self.history << 1 | 1;
                self.good = 0;
                self.tally.count(fault);
                Verdict::Refused(fault)
            }
        };
        // spec: E2E-5
        if self.history.count_ones() > self.protection.bad_max {
            // What is remembered has had its effect: the way back begins with a clean sheet.
            self.history = 0;
            self.trip(Cause::TooManyBad);
        }
        verdict
    }

    fn examine(&mut self, now: Time, opened: Opened) -> Result<(), Fault> {
        match opened {
            // spec: E2E-1
            Opened::Corrupt => Err(Fault::Corrupt),
            Opened::Value(stamp) => self.follow(now, stamp),
            // spec: E2E-8
            // It has come: none is missing because of it, and it does not come again.
            Opened::Unreadable(stamp) => self.follow(now, stamp).and(Err(Fault::Unreadable)),
        }
    }

    /// Whether this is a young message, and the next one.
    fn follow(&mut self, now: Time, stamp: Stamp) -> Result<(), Fault> {
        // spec: E2E-2
        let is_ours = stamp.echo != Time::ZERO && self.echoes.contains(&stamp.echo);
        if !is_ours || now.since(stamp.echo) > self.protection.age_max {
            return Err(Fault::TooOld);
        }
        // spec: E2E-3
        let Some((incarnation, counter)) = self.last else {
            self.last = Some((stamp.incarnation, stamp.counter));
            return Ok(());
        };
        if stamp.incarnation != incarnation {
            self.last = Some((stamp.incarnation, stamp.counter));
            self.trip(Cause::Restarted);
            return Err(Fault::Restarted);
        }
        // spec: E2E-4
        if stamp.counter == counter {
            return Err(Fault::Repeated);
        }
        if stamp.counter < counter {
            return Err(Fault::Backwards);
        }
        self.last = Some((incarnation, stamp.counter));
        let lost = stamp.counter - counter - 1;
        // It comes from outside.
        self.tally.lost = self.tally.lost.saturating_add(lost);
        if lost > self.protection.lost_max {
            self.trip(Cause::TooMuchLost);
            return Err(Fault::Gap);
        }
        Ok(())
    }

    // spec: E2E-7
    /// Makes the output live.
    pub(crate) fn arm(&mut self, now: Time) -> Result<(), ArmError> {
        self.expire(now);
        let wanted = self.protection.good_min;
        if self.good < wanted || now.since(self.heard) >= self.protection.within {
            return Err(ArmError::NotGood {
                good: self.good.min(wanted),
                wanted,
                silent: now.since(self.heard),
            });
        }
        self.state = State::Live;
        Ok(())
    }
}
