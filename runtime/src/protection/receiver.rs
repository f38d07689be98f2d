//! The receiving end without clock and thread: the checks of a message, and when the output must be safe.

use std::time::Duration;

use bytes::Bytes;

use super::{ArmError, Cause, DataId, Protection, ProtectionError, Stamp, State, Tally, envelope::open};
use crate::time::Time;

/// Number of echoes that a sender may quote. One is sent each quarter of the maximum age, so the oldest is
/// twice too old.
const ECHOES: usize = 8;
/// Minimum increase of the host's sleep time that counts as a sleep: a smaller one may be an error of the measurement.
const SLEEP_MIN: Duration = Duration::from_millis(5);

/// The content of a message, as far as it can be checked without its receiver's state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Opened {
    /// The bytes were not sealed under this data ID.
    Corrupt,
    /// The message is intact, but no valid value of the receiver's type.
    Unreadable(Stamp),
    /// The message contains a value.
    Value(Stamp),
}

impl Opened {
    /// Opens an envelope and decodes its payload. Decoding is user code: it runs without a lock.
    pub(crate) fn of<T>(
        data_id: &DataId,
        bytes: &Bytes,
        read: impl FnOnce(Bytes) -> Option<T>,
    ) -> (Self, Option<T>) {
        Self::read(open(data_id, bytes), read)
    }

    /// Decodes the payload of an envelope, if it could be opened.
    pub(crate) fn read<B, T>(
        opened: Option<(Stamp, B)>,
        read: impl FnOnce(B) -> Option<T>,
    ) -> (Self, Option<T>) {
        let Some((stamp, payload)) = opened else { return (Self::Corrupt, None) };
        let value = read(payload);
        (if value.is_some() { Self::Value(stamp) } else { Self::Unreadable(stamp) }, value)
    }
}

/// The result of checking one message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict<T> {
    /// The message is good, and the output is live.
    Apply(T),
    /// The message is good, and the output is safe until it is armed again.
    Hold,
    /// The message must not be used.
    Refused(ProtectionError),
}

impl Verdict<()> {
    /// Replaces the content of the verdict by the message's value.
    pub(crate) fn of<T>(self, value: Option<T>) -> Verdict<T> {
        match self {
            // Only a value can be good.
            Self::Apply(()) => value.map_or(Verdict::Refused(ProtectionError::Unreadable), Verdict::Apply),
            Self::Hold => Verdict::Hold,
            Self::Refused(fault) => Verdict::Refused(fault),
        }
    }
}

/// The state of one flow of protected messages.
#[derive(Debug)]
pub(crate) struct Receiver {
    protection: Protection,
    state: State,
    /// Incarnation and counter of the last accepted message.
    last: Option<(u64, u64)>,
    /// When that message arrived.
    last_good: Time,
    /// Consecutive good messages: with no bad one among them, and no silence.
    good: u32,
    /// The last 64 messages, the newest at the lowest bit: 1 for a bad one.
    history: u64,
    echoes: [Time; ECHOES],
    /// Total time that the host has slept.
    asleep: Duration,
    tally: Tally,
}

impl Receiver {
    pub(crate) fn new(protection: Protection) -> Self {
        Self {
            protection,
            state: State::Safe(Cause::NotArmed),
            last: None,
            last_good: Time::ZERO,
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

    /// Returns when [`expire`](Self::expire) is due; `None` while the output is safe.
    pub(crate) fn deadline(&self) -> Option<Time> {
        (self.state == State::Live).then(|| self.last_good + self.protection.within)
    }

    /// Returns the time that the sender must quote, sent to it each [`Protection::echo_period`].
    pub(crate) fn echo(&mut self, now: Time) -> Time {
        self.echoes.rotate_right(1);
        self.echoes[0] = now;
        now
    }

    /// Returns the last echo; zero before the first one.
    pub(crate) const fn last_echo(&self) -> Time {
        self.echoes[0]
    }

    pub(crate) const fn echo_period(&self) -> Duration {
        self.protection.echo_period()
    }

    // spec: E2E-9
    /// Records the total time that the host has slept. Clocks stop during a sleep, so the age of messages in
    /// flight is unknown. Messages that quote an earlier echo no longer count.
    pub(crate) fn has_slept(&mut self, asleep: Duration) {
        if asleep >= self.asleep + SLEEP_MIN {
            self.echoes = [Time::ZERO; ECHOES];
            self.trip(Cause::Slept);
        }
        self.asleep = self.asleep.max(asleep);
    }

    // spec: E2E-6
    /// Makes the output safe if the watchdog's deadline has passed.
    pub(crate) fn expire(&mut self, now: Time) {
        if self.deadline().is_some_and(|deadline| now >= deadline) {
            self.trip(Cause::Silent);
        }
    }

    /// Makes the output safe until it is armed again. The first cause is kept.
    pub(crate) const fn trip(&mut self, cause: Cause) {
        if matches!(self.state, State::Live) {
            self.tally.trips += 1;
            self.state = State::Safe(cause);
        }
        self.good = 0;
    }

    /// Checks one message.
    pub(crate) fn take(&mut self, now: Time, opened: Opened) -> Verdict<()> {
        // Independent of how late the thread `safe-output` is.
        self.expire(now);
        let verdict = match self.examine(now, opened) {
            Ok(()) => {
                self.history <<= 1;
                // A run of good messages ends with a silence that would have made a live output safe.
                let is_next = now.since(self.last_good) < self.protection.within;
                self.good = if is_next { self.good.saturating_add(1) } else { 1 };
                self.tally.good += 1;
                self.last_good = now;
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
            // The recorded faults have had their effect: recovery starts with an empty history.
            self.history = 0;
            self.trip(Cause::TooManyBad);
        }
        verdict
    }

    fn examine(&mut self, now: Time, opened: Opened) -> Result<(), ProtectionError> {
        match opened {
            // spec: E2E-1
            Opened::Corrupt => Err(ProtectionError::Corrupt),
            Opened::Value(stamp) => self.follow(now, stamp),
            // spec: E2E-8
            // The message has arrived: it causes no gap, and is not accepted again.
            Opened::Unreadable(stamp) => self.follow(now, stamp).and(Err(ProtectionError::Unreadable)),
        }
    }

    /// Checks that this message is young, and the next one of the flow.
    fn follow(&mut self, now: Time, stamp: Stamp) -> Result<(), ProtectionError> {
        // spec: E2E-2
        let is_ours = stamp.echo != Time::ZERO && self.echoes.contains(&stamp.echo);
        if !is_ours || now.since(stamp.echo) > self.protection.age_max {
            return Err(ProtectionError::TooOld);
        }
        // spec: E2E-3
        let Some((incarnation, counter)) = self.last else {
            self.last = Some((stamp.incarnation, stamp.counter));
            return Ok(());
        };
        if stamp.incarnation != incarnation {
            self.last = Some((stamp.incarnation, stamp.counter));
            self.trip(Cause::Restarted);
            return Err(ProtectionError::Restarted);
        }
        // spec: E2E-4
        if stamp.counter == counter {
            return Err(ProtectionError::Repeated);
        }
        if stamp.counter < counter {
            return Err(ProtectionError::Backwards);
        }
        self.last = Some((incarnation, stamp.counter));
        let lost = stamp.counter - counter - 1;
        // The counter is untrusted input.
        self.tally.lost = self.tally.lost.saturating_add(lost);
        if lost > self.protection.lost_max {
            self.trip(Cause::TooMuchLost);
            return Err(ProtectionError::Gap);
        }
        Ok(())
    }

    // spec: E2E-7
    /// Arms the output.
    pub(crate) fn arm(&mut self, now: Time) -> Result<(), ArmError> {
        self.expire(now);
        let wanted = self.protection.good_min;
        if self.good < wanted || now.since(self.last_good) >= self.protection.within {
            return Err(ArmError::NotGood {
                good: self.good.min(wanted),
                wanted,
                silent: (self.good > 0).then(|| now.since(self.last_good)),
            });
        }
        self.state = State::Live;
        Ok(())
    }
}
