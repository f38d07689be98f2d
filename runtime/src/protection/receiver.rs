//! The receiving end without clock and thread: what is believed, and when the output has to be safe.

use bytes::Bytes;

use super::{ArmError, Cause, Fault, Protection, State, Tally, envelope};
use crate::{protection::Codename, time::Time};

/// Echoes that a sender may answer with. One is sent each quarter of the longest age, so that the oldest is twice too old.
const ECHOES: usize = 8;

/// What comes of one message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// It is good, and the output is live.
    Apply(Bytes),
    /// It is good, and the output is safe until it is armed again.
    Hold,
    /// It is not to be used.
    Refused(Fault),
}

/// What is known of one flow of protected messages.
#[derive(Debug)]
pub(crate) struct Receiver {
    codename: Codename,
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
    tally: Tally,
}

impl Receiver {
    pub(crate) fn new(codename: Codename, protection: Protection) -> Self {
        Self {
            codename,
            protection,
            state: State::Safe(Cause::NotArmed),
            last: None,
            heard: Time::ZERO,
            good: 0,
            history: 0,
            echoes: [Time::ZERO; ECHOES],
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

    pub(crate) const fn echo_period(&self) -> std::time::Duration {
        self.protection.echo_period()
    }

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
    pub(crate) fn take(&mut self, now: Time, bytes: &Bytes) -> Verdict {
        // However late the thread is that keeps the watchdog.
        self.expire(now);
        let verdict = match self.examine(now, bytes) {
            Ok(payload) => {
                self.history <<= 1;
                // A row ends with a silence that would have made a live output safe.
                let is_next = now.since(self.heard) < self.protection.within;
                self.good = if is_next { self.good.saturating_add(1) } else { 1 };
                self.tally.good += 1;
                self.heard = now;
                if self.state == State::Live { Verdict::Apply(payload) } else { Verdict::Hold }
            }
            Err(fault) => {
                self.history = self.history << 1 | 1;
                self.good = 0;
                self.tally.count(fault);
                Verdict::Refused(fault)
            }
        };
        if self.history.count_ones() > self.protection.bad_max {
            // What is remembered has had its effect: the way back begins with a clean sheet.
            self.history = 0;
            self.trip(Cause::TooManyBad);
        }
        verdict
    }

    fn examine(&mut self, now: Time, bytes: &Bytes) -> Result<Bytes, Fault> {
        let (stamp, payload) = envelope::open(&self.codename, bytes).ok_or(Fault::Corrupt)?;
        let is_ours = stamp.echo != Time::ZERO && self.echoes.contains(&stamp.echo);
        if !is_ours || now.since(stamp.echo) > self.protection.age_max {
            return Err(Fault::TooOld);
        }
        let Some((incarnation, counter)) = self.last else {
            self.last = Some((stamp.incarnation, stamp.counter));
            return Ok(payload);
        };
        if stamp.incarnation != incarnation {
            self.last = Some((stamp.incarnation, stamp.counter));
            self.trip(Cause::Restarted);
            return Err(Fault::Restarted);
        }
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
        Ok(payload)
    }

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
