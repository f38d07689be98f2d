//! Many frames in one write, where they come faster than one write each would let them go.
//!
//! A write costs about as much as carrying a thousand bytes does. Who sends now and then pays one for each message, and the
//! message is on its way when the call returns. Who has the next message ready as soon as the last one is written, again and again,
//! is not helped by that: from the fifth on what comes waits until it is much, and then the sender copies it into one
//! buffer and writes that. What is less, the drainer writes: of Bulk and of outcomes in a [moment](super::rouser), so that neither
//! has to switch to the other's thread for it, of the rest at once. A round trip is no flood, however quick: the answer takes longer than that.

use std::{
    io::{self, IoSlice},
    task::{Context, Poll},
    time::Duration,
};

use sinew_runtime::{
    time::Time,
    wire::{Checksum, Class, Flags, Kind, Message},
};

use super::{
    Account, Socket,
    half::{Half, Link},
    rouser::Rouser,
};

/// Messages right behind each other that are written at once, each by its sender.
const AT_ONCE: u64 = 4;
/// Who sends the next message sooner than this after the last one was written has not waited for anybody: half of what a write to
/// a socket takes, a quarter of the quickest answer over the loopback interface.
const RIGHT_BEHIND: Duration = Duration::from_micros(2);
/// Who has flooded and pauses may send one at once for each such time: whoever is interrupted floods on.
const PAUSE: Duration = Duration::from_micros(50);
/// Bytes that are gathered before they are written: what a sender [writes himself](super::draining), and one message more.
const GATHERED_MAX: usize = 40 << 10;

/// Bytes of a frame that is gathered with others rather than written alone.
pub(super) const SHORT: usize = 4 << 10;

/// How fast messages come.
#[derive(Debug)]
pub(super) struct Pace {
    /// When the last one was written, or came while others waited.
    last: Time,
    /// Messages that may be written at once.
    credit: u64,
    /// More came right behind each other than that.
    floods: bool,
}

impl Pace {
    pub(super) const fn new() -> Self {
        Self { last: Time::ZERO, credit: AT_ONCE, floods: false }
    }

    /// A message comes that was sent at `sent`. Returns whether it is one of a flood. One that is not patient goes at once after any pause.
    pub(super) fn is_flood(&mut self, sent: Time, is_patient: bool) -> bool {
        let pause = sent.since(self.last);
        if pause >= RIGHT_BEHIND {
            let of_a_flood = u64::from(!is_patient) + (pause.as_nanos() / PAUSE.as_nanos()) as u64;
            self.credit = if self.floods { AT_ONCE.min(of_a_flood) } else { AT_ONCE };
            self.floods = false;
        }
        self.last = self.last.max(sent);
        let is_flood = self.credit == 0;
        self.credit = self.credit.saturating_sub(1);
        self.floods |= is_flood;
        is_flood
    }

    /// Messages were written by their sender, who was done `now`.
    pub(super) const fn written(&mut self, now: Time) {
        self.last = now;
    }
}

impl<S: Socket> Half<S> {
    /// Whether messages come so fast that they had better be written many at once.
    pub(super) fn is_one_of_a_flood(&mut self, message: &Message) -> bool {
        let Link::Up(socket) = &self.link else { return false };
        // What the layers say carries no time.
        let now = || if message.header.sent == Time::ZERO { Time::now() } else { message.header.sent };
        socket.gathers() && self.pace.is_flood(now(), is_patient(message))
    }

    /// Its sender has just written a message; the clock is read only where that matters.
    pub(super) fn note_pace(&mut self) {
        if matches!(&self.link, Link::Up(socket) if socket.gathers()) {
            self.pace.written(Time::now());
        }
    }
}

/// Whether a message that has to wait may wait for the next one.
pub(super) fn is_patient(message: &Message) -> bool {
    let header = &message.header;
    message.size() <= SHORT && (header.class == Class::Bulk || header.flags.has(Flags::OUTCOME))
}

/// Whether who submits a message does not write it itself, though nothing waits before it: the thread that answers an audit is nicer than
/// those who need this lock, so that it has the lock for as long as a queue takes, and not while it computes a long checksum or writes.
pub(super) fn is_left_to_the_drainer(message: &Message) -> bool {
    message.header.kind == Kind::SYNC_AUDIT
}

/// A socket that gathers frames.
#[derive(Debug)]
pub(crate) struct Gathering<S> {
    socket: S,
    checksum: Checksum,
    /// What is gathered; the socket has taken all before `taken`.
    bytes: Vec<u8>,
    taken: usize,
    rouser: Rouser,
}

impl<S> Gathering<S> {
    pub(crate) fn new(socket: S, checksum: Checksum) -> Self {
        Self { socket, checksum, bytes: Vec::new(), taken: 0, rouser: Rouser::default() }
    }
}

impl<S: Socket> Socket for Gathering<S> {
    fn checksum(&self) -> Checksum {
        self.checksum
    }

    fn piece_max(&self) -> usize {
        self.socket.piece_max()
    }

    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        debug_assert_eq!(self.gathered(), 0, "what is gathered goes first");
        self.socket.try_write_vectored(parts)
    }

    fn account(&mut self) -> Account {
        self.socket.account()
    }

    fn poll_writable(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.socket.poll_writable(cx)
    }

    fn rouse_later(&mut self) -> bool {
        self.rouser.rouse_later()
    }

    fn poll_roused(&mut self, cx: &mut Context<'_>) {
        self.rouser.poll(cx);
    }

    fn gathers(&self) -> bool {
        true
    }

    fn gather(&mut self, parts: &[IoSlice<'_>]) -> bool {
        let length: usize = parts.iter().map(|part| part.len()).sum();
        let has_room = self.bytes.len() + length <= GATHERED_MAX;
        if has_room {
            parts.iter().for_each(|part| self.bytes.extend_from_slice(part));
        }
        has_room
    }

    fn gathered(&self) -> usize {
        self.bytes.len() - self.taken
    }

    fn write_gathered(&mut self) -> io::Result<usize> {
        let count = self.socket.try_write_vectored(&[IoSlice::new(&self.bytes[self.taken..])])?;
        self.taken += count;
        if self.taken == self.bytes.len() {
            self.bytes.clear();
            self.taken = 0;
        }
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whether a message is one of a flood that is sent `gap` nanoseconds after the last one, whose write took `write`.
    fn floods(count: usize, gap: u64, write: u64) -> Vec<bool> {
        let (mut pace, mut now) = (Pace::new(), 1_000_000);
        let submit = |_| {
            now += gap;
            let is_flood = pace.is_flood(Time::from_nanos(now), false);
            if !is_flood {
                now += write;
                pace.written(Time::from_nanos(now));
            }
            is_flood
        };
        (0..count).map(submit).collect()
    }

    #[test]
    fn who_sends_right_behind_each_write_floods_from_the_fifth_message_on() {
        assert_eq!(floods(8, 500, 4_000), [false, false, false, false, true, true, true, true]);
    }

    #[test]
    fn the_quickest_round_trips_are_no_flood() {
        assert!(!floods(1_000, 3_000, 1_500).contains(&true));
    }

    #[test]
    fn nor_are_those_with_several_messages_each() {
        let mut pace = Pace::new();
        let times = (0..1_000).flat_map(|round| (0..4).map(move |n| 1_000_000 + round * 5_000 + n * 100));
        assert!(!times.into_iter().any(|nanos| pace.is_flood(Time::from_nanos(nanos), false)));
    }

    /// Of six messages right behind each other: which are of a flood, in one that begins, after 10 us, and after a millisecond.
    fn interrupted(is_patient: bool) -> [Vec<bool>; 3] {
        let mut pace = Pace::new();
        [0, 10_000, 1_000_000].map(|begins| {
            let times = (0..6).map(|n| Time::from_nanos(1_000_000 + begins + n * 100));
            times.map(|sent| pace.is_flood(sent, is_patient)).collect()
        })
    }

    #[test]
    fn who_is_interrupted_in_a_flood_floods_on_but_for_one_that_is_not_patient() {
        let begins = vec![false, false, false, false, true, true];
        let goes_on = vec![false, true, true, true, true, true];
        assert_eq!(interrupted(false), [begins.clone(), goes_on, begins.clone()]);
        assert_eq!(interrupted(true), [begins.clone(), vec![true; 6], begins]);
    }

    #[test]
    fn what_comes_after_a_pause_is_written_at_once_again() {
        let mut pace = Pace::new();
        let at = |nanos: u64| Time::from_nanos(1_000_000 + nanos);
        let floods: Vec<bool> = (0..9).map(|n| pace.is_flood(at(n * 100), false)).collect();
        assert_eq!(floods[8..], [true]);
        assert!(!pace.is_flood(at(3_000), false));
    }
}
