//! Writing on: the next frame, the next piece of a long one, and when others have their turn.

use std::{
    io,
    task::{Context, Poll},
};

use sinew_runtime::{
    time::Time,
    wire::{HEADER_LEN, Message},
};

use super::{
    LinkNumber, Socket,
    after::After,
    batch::SHORT,
    half::{Half, Link, Step},
    outstanding::owed_by,
    partial::{Partial, Written},
};

/// Frames, or pieces of them, that the drainer writes before other tasks of its thread have their turn.
const WRITES_PER_WAKE: usize = 64;
/// Bytes that it writes before.
const BYTES_PER_WAKE: usize = 64 << 10;

/// Bytes of short frames that wait before a sender writes them itself, all at once.
const HELP_AT_BYTES: usize = 32 << 10;
/// Messages that wait before, however short they are.
const HELP_AT: usize = 128;
/// The same of longer ones, which the drainer writes better as long as it keeps up: each takes about as long as waking it.
const HELP_AT_LONG: usize = 32;

/// Why the drainer does not write on.
pub(super) enum Drained {
    /// The connection cannot be written to any more.
    Over(io::Error),
    /// It has had its turn.
    Enough,
}

impl<S: Socket> Half<S> {
    pub(super) fn poll_drain(
        &mut self,
        link: LinkNumber,
        cx: &mut Context<'_>,
        after: &mut After,
    ) -> Poll<Drained> {
        if let Link::Up(socket) = &mut self.link {
            socket.poll_roused(cx);
        }
        let mut bytes = 0;
        for _ in 0..WRITES_PER_WAKE {
            if let Some(end) = self.end_of(link) {
                return Poll::Ready(Drained::Over(end));
            }
            if !self.drainer.as_ref().is_some_and(|waker| waker.will_wake(cx.waker())) {
                self.drainer = Some(cx.waker().clone());
            }
            if !self.has_frame() {
                return Poll::Pending;
            }
            let Link::Up(socket) = &mut self.link else { continue };
            match socket.poll_writable(cx) {
                Poll::Pending => return Poll::Pending,
                Poll::Ready(Err(error)) => self.fail(error),
                Poll::Ready(Ok(())) => bytes += self.gather_next(after),
            }
            if bytes >= BYTES_PER_WAKE {
                break;
            }
        }
        self.write_gathered();
        Poll::Ready(Drained::Enough)
    }

    /// Lets a sender write what waits, if that is much and the socket may take it: it pays for its flood itself.
    pub(super) fn help(&mut self, after: &mut After) {
        let Link::Up(socket) = &self.link else { return };
        let is_stuck = self.partial.is_some() || socket.gathered() > 0;
        if !socket.gathers() || is_stuck || !self.has_much() {
            return;
        }
        let mut bytes = 0;
        for _ in 0..HELP_AT {
            if bytes >= BYTES_PER_WAKE || !self.has_frame() {
                break;
            }
            bytes += self.gather_next(after);
        }
        self.write_gathered();
        self.pace.written(Time::now());
    }

    /// Whether so much waits that its sender had better write it.
    fn has_much(&self) -> bool {
        let messages = self.queue.len();
        let bytes = messages * HEADER_LEN + self.queue.bytes();
        if bytes <= messages * SHORT {
            bytes >= HELP_AT_BYTES || messages >= HELP_AT
        } else {
            messages >= HELP_AT_LONG
        }
    }

    /// Has the drainer write on what waits: in a moment if `is_patient`, for more of its sort is to be expected.
    pub(super) fn rouse(&mut self, is_patient: bool, after: &mut After) {
        let (has_frame, is_stuck) = (self.has_frame(), self.partial.is_some() || self.gathered() > 0);
        if let Link::Up(socket) = &mut self.link
            && (!has_frame || is_patient && !is_stuck && socket.rouse_later())
        {
            return;
        }
        self.wake_drainer(after);
    }

    /// Why the connection `link` cannot be written to, if it cannot.
    fn end_of(&mut self, link: LinkNumber) -> Option<io::Error> {
        if link.0 != self.number {
            return Some(io::ErrorKind::ConnectionAborted.into());
        }
        match std::mem::replace(&mut self.link, Link::Down) {
            Link::Failed(error) => Some(error),
            Link::Down => Some(io::ErrorKind::NotConnected.into()),
            link @ Link::Closed(_) => {
                self.link = link;
                Some(io::ErrorKind::NotConnected.into())
            }
            link @ Link::Up(_) => {
                self.link = link;
                None
            }
        }
    }

    /// Gathers the next frame, or writes what is gathered if there is none or no room for it, and then the next piece of it;
    /// returns how many bytes the socket has taken.
    fn gather_next(&mut self, after: &mut After) -> usize {
        let Some(frame) = self.next_frame(after) else { return self.write_gathered() };
        let Err(frame) = self.gather(frame) else { return 0 };
        let taken = self.write_gathered();
        if self.gathered() > 0 {
            self.partial = Some(frame);
            return taken;
        }
        // With those behind it, if it is not as long as many.
        match self.gather(frame) {
            Ok(()) => taken,
            Err(frame) => taken + self.write_frame(frame),
        }
    }

    /// Gathers a frame that has not been begun, if there is room.
    fn gather(&mut self, frame: Partial) -> Result<(), Partial> {
        if let Link::Up(socket) = &mut self.link
            && frame.gather_in(socket)
        {
            self.sent(frame);
            return Ok(());
        }
        Err(frame)
    }

    fn write_gathered(&mut self) -> usize {
        let Link::Up(socket) = &mut self.link else { return 0 };
        if socket.gathered() == 0 {
            return 0;
        }
        socket.write_gathered().unwrap_or_else(|error| {
            self.note(error);
            0
        })
    }

    /// Bytes that were gathered and not written.
    pub(super) fn gathered(&self) -> usize {
        if let Link::Up(socket) = &self.link { socket.gathered() } else { 0 }
    }

    /// Writes the next frame, or the next piece of it; returns how many bytes the socket has taken.
    pub(super) fn write_next(&mut self, after: &mut After) -> usize {
        self.next_frame(after).map_or(0, |frame| self.write_frame(frame))
    }

    fn write_frame(&mut self, mut frame: Partial) -> usize {
        let before = frame.written;
        let result = self.write(&mut frame);
        let taken = frame.written - before;
        match result {
            Written::Whole => self.sent(frame),
            Written::Piece | Written::InPart | Written::Broken => self.partial = Some(frame),
        }
        taken
    }

    fn next_frame(&mut self, after: &mut After) -> Option<Partial> {
        if let Some(partial) = self.partial.take() {
            return Some(partial);
        }
        if let Some(urgent) = self.urgent.pop_front() {
            return Some(self.frill(urgent));
        }
        if let Some(again) = self.frame_again() {
            return Some(again);
        }
        if self.queue.is_empty() && self.interrupted.is_none() {
            return if self.is_last_due() { self.say_last() } else { None };
        }
        if !self.session_has_room() {
            return None;
        }
        let message = self.interrupted.take().or_else(|| self.queue.pop())?;
        after.room.extend(self.queue.room_made());
        if message.header.time_to_live_us != 0 && message.header.is_expired(Time::now()) {
            self.receipts.waits_no_more(owed_by(&message));
            self.expired(message, after);
            return None;
        }
        let message = self.with_outcomes_behind(message);
        Some(self.frame(message))
    }

    /// Writes the next piece of the frame that has been begun.
    pub(super) fn write_on(&mut self, after: &mut After) -> Step {
        let Some(mut frame) = self.partial.take() else { return Step::Done };
        match self.write(&mut frame) {
            Written::Whole => self.sent(frame),
            Written::Piece => {
                self.partial = Some(frame);
                return Step::More;
            }
            Written::InPart | Written::Broken => self.partial = Some(frame),
        }
        self.hand_to_drainer(after);
        Step::Done
    }

    /// The drainer is woken, and whoever calls this twice wakes it still.
    pub(super) fn wake_drainer(&mut self, after: &mut After) {
        after.wake = after.wake.take().or_else(|| self.drainer.take());
    }

    /// The drainer writes on, if there is anything to write.
    pub(super) fn hand_to_drainer(&mut self, after: &mut After) {
        if self.waiting() > 0 {
            self.wake_drainer(after);
        }
    }

    /// Whether there is something that may be written now.
    pub(super) fn has_frame(&self) -> bool {
        let waits = self.interrupted.is_some() || !self.queue.is_empty();
        self.partial.is_some()
            || self.gathered() > 0
            || !self.urgent.is_empty()
            || self.behind() > 0
            || waits && self.session_has_room()
            || !waits && self.is_last_due()
    }

    /// Whether the last frame goes behind all that the session still has, here or in what the peer asks for again.
    fn is_last_due(&self) -> bool {
        self.has_last_to_say() && self.in_lines() == 0 && self.session_is_through()
    }

    /// The last frame, once on each connection: it ends with one that breaks.
    fn say_last(&mut self) -> Option<Partial> {
        self.has_said_last = true;
        let last = self.last.as_ref()?;
        Some(self.frill(Message::new(last.header, last.payload.clone())))
    }
}
