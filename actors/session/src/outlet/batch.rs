//! Batches many frames into one write, if they arrive faster than single writes can send them.
//!
//! A write costs about as much as copying a thousand bytes. An occasional sender pays one write per message,
//! and the message is sent when the call returns. This does not help a sender that repeatedly has the next
//! message ready when the last write returns. From its fifth such message on, messages are gathered until
//! there are many. The sender then copies them into one buffer and writes that. The drain task writes smaller
//! amounts. It writes Bulk and outcomes after a [short delay](super::delayed_wake), longer while many more
//! come, so that neither side has to switch threads for each, and all else at once. A round trip never counts
//! as a burst, because the answer takes longer than that.

use std::{
    io::{self, IoSlice},
    task::{Context, Poll},
    time::Duration,
};

use sinew_runtime::{
    time::Time,
    wire::{Checksum, Class, Flags, Kind, Message},
};

use super::{Account, Socket, delayed_wake::DelayedWake};

/// Consecutive messages that their sender writes at once.
const AT_ONCE: u64 = 4;
/// Maximum pause between a write and the next message of a sender that did not wait for an answer. It is half
/// the time of a socket write, and a quarter of the quickest answer over the loopback interface.
const RIGHT_BEHIND: Duration = Duration::from_micros(2);
/// Pause after which a bursting sender may write one message at once: an interrupted burst continues.
const PAUSE: Duration = Duration::from_micros(50);
/// Bytes that are gathered before they are written: the amount that a sender [writes
/// itself](super::draining), plus one message. It is a [piece](Socket::piece_max) of a long frame between nodes, so
/// that a write holds the outlet's lock no longer than that of a piece.
const GATHERED_MAX: usize = 64 << 10;

/// Longest frame, in bytes, that is gathered with others rather than written alone.
pub(super) const SHORT: usize = 4 << 10;

/// The rate at which messages arrive.
#[derive(Debug)]
pub(super) struct BurstDetector {
    /// Time of the last write, or of the last message that was queued behind others.
    last: Time,
    /// Messages that may be written at once.
    credit: u64,
    /// Whether more messages arrived in a row than the credit allows.
    is_in_burst: bool,
}

impl BurstDetector {
    pub(super) const fn new() -> Self {
        Self { last: Time::ZERO, credit: AT_ONCE, is_in_burst: false }
    }

    /// Records a message. Returns whether it is part of a burst, so that batched writes are better.
    #[inline]
    pub(super) fn is_burst(&mut self, message: &Message) -> bool {
        // Messages of the layers carry no time.
        let sent = if message.header.sent == Time::ZERO { Time::now() } else { message.header.sent };
        self.note(sent, is_delayable(message))
    }

    /// Records a message sent at `sent`. Returns whether it is part of a burst. A message that is not
    /// delayable is sent at once after any pause.
    fn note(&mut self, sent: Time, is_delayable: bool) -> bool {
        let pause = sent.since(self.last);
        if pause >= RIGHT_BEHIND {
            let of_a_burst = u64::from(!is_delayable) + (pause.as_nanos() / PAUSE.as_nanos()) as u64;
            self.credit = if self.is_in_burst { AT_ONCE.min(of_a_burst) } else { AT_ONCE };
            self.is_in_burst = false;
        }
        self.last = self.last.max(sent);
        let is_burst = self.credit == 0;
        self.credit = self.credit.saturating_sub(1);
        self.is_in_burst |= is_burst;
        is_burst
    }

    /// Records that a sender finished writing messages at `now`.
    pub(super) const fn written(&mut self, now: Time) {
        self.last = now;
    }
}

/// Whether a queued message may be delayed to join the next one.
pub(super) fn is_delayable(message: &Message) -> bool {
    let header = &message.header;
    message.size() <= SHORT && (header.class == Class::Bulk || header.flags.has(Flags::OUTCOME))
}

/// Whether the drain task must write a message even if the queue is empty. The thread that answers an audit
/// has a lower priority than the other users of this lock. It holds the lock only to queue the message, not
/// to compute a long checksum or to write.
pub(super) fn is_for_drainer(message: &Message) -> bool {
    message.header.kind == Kind::SYNC_AUDIT
}

/// A socket that gathers frames.
#[derive(Debug)]
pub struct Gathering<S> {
    socket: S,
    checksum: Checksum,
    /// Gathered bytes. The socket has accepted all bytes before `taken`.
    bytes: Vec<u8>,
    taken: usize,
    delayed_wake: DelayedWake,
}

impl<S> Gathering<S> {
    /// Returns a writer to `socket` of frames with this checksum.
    pub fn new(socket: S, checksum: Checksum) -> Self {
        Self { socket, checksum, bytes: Vec::new(), taken: 0, delayed_wake: DelayedWake::default() }
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

    fn wake_later(&mut self) -> bool {
        self.delayed_wake.wake_later()
    }

    fn joins_delayed(&mut self) {
        self.delayed_wake.joined();
    }

    fn wrote_delayed(&mut self) {
        self.delayed_wake.written();
    }

    fn poll_delayed_wake(&mut self, cx: &mut Context<'_>) {
        self.delayed_wake.poll(cx);
    }

    fn gathers(&self) -> bool {
        true
    }

    fn gather_room(&self) -> usize {
        GATHERED_MAX.saturating_sub(self.bytes.len())
    }

    fn gather(&mut self, parts: &[IoSlice<'_>]) -> bool {
        let length: usize = parts.iter().map(|part| part.len()).sum();
        let has_room = length <= self.gather_room();
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

    /// Returns for each message whether it counts as part of a burst, if it is sent `gap` nanoseconds after
    /// the previous one, with a write of `write`.
    fn bursts(count: usize, gap: u64, write: u64) -> Vec<bool> {
        let (mut detector, mut now) = (BurstDetector::new(), 1_000_000);
        let submit = |_| {
            now += gap;
            let is_burst = detector.note(Time::from_nanos(now), false);
            if !is_burst {
                now += write;
                detector.written(Time::from_nanos(now));
            }
            is_burst
        };
        (0..count).map(submit).collect()
    }

    #[test]
    fn burst_starts_at_fifth_consecutive_message() {
        assert_eq!(bursts(8, 500, 4_000), [false, false, false, false, true, true, true, true]);
    }

    #[test]
    fn fastest_round_trips_are_no_burst() {
        assert!(!bursts(1_000, 3_000, 1_500).contains(&true));
    }

    #[test]
    fn round_trips_of_several_messages_are_no_burst() {
        let mut detector = BurstDetector::new();
        let times = (0..1_000).flat_map(|round| (0..4).map(move |n| 1_000_000 + round * 5_000 + n * 100));
        assert!(!times.into_iter().any(|nanos| detector.note(Time::from_nanos(nanos), false)));
    }

    /// Returns the messages of a burst among six consecutive ones: at its start, after 10 us, and after a
    /// millisecond.
    fn interrupted(is_delayable: bool) -> [Vec<bool>; 3] {
        let mut detector = BurstDetector::new();
        [0, 10_000, 1_000_000].map(|begins| {
            let times = (0..6).map(|n| Time::from_nanos(1_000_000 + begins + n * 100));
            times.map(|sent| detector.note(sent, is_delayable)).collect()
        })
    }

    #[test]
    fn interrupted_burst_continues_except_for_urgent_messages() {
        let begins = vec![false, false, false, false, true, true];
        let continued = vec![false, true, true, true, true, true];
        assert_eq!(interrupted(false), [begins.clone(), continued, begins.clone()]);
        assert_eq!(interrupted(true), [begins.clone(), vec![true; 6], begins]);
    }

    #[test]
    fn message_after_pause_is_written_at_once() {
        let mut detector = BurstDetector::new();
        let at = |nanos: u64| Time::from_nanos(1_000_000 + nanos);
        let bursts: Vec<bool> = (0..9).map(|n| detector.note(at(n * 100), false)).collect();
        assert_eq!(bursts[8..], [true]);
        assert!(!detector.note(at(3_000), false));
    }
}
