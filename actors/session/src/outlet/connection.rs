//! The current connection of an outlet: its socket, the frame that is being written, and the drain task.

use std::{
    io::{self, IoSlice},
    task::{Context, Poll, Waker},
};

use sinew_runtime::{
    outcome::Rejection,
    wire::{Checksum, Header, Message},
};

use super::{
    Account, LinkNumber, Socket, Taking,
    batch::SHORT,
    deferred::DeferredActions,
    partial::{FrameOrigin, Partial, Written},
    progress::is_for_the_program,
    unsent::Unsent,
};

enum Link<S> {
    Down,
    Up(S),
    /// A sender's write failed. The drain task reports the error to the layer.
    Failed(io::Error),
    Closed(Rejection),
}

/// The current one of an outlet's successive connections, or the reason why there is none.
pub(super) struct Connection<S> {
    link: Link<S>,
    number: u64,
    /// The frame that is being written.
    pub(super) partial: Option<Partial>,
    /// The waker of the drain task, until it is woken.
    drainer: Option<Waker>,
    /// The socket's count of written bytes at the last message for the program at the other end.
    due: u64,
    /// The peer's count of taken bytes when a write failed, if it is known.
    taken_at_last: u64,
}

impl<S: Socket> Connection<S> {
    pub(super) const fn new() -> Self {
        Self { link: Link::Down, number: 0, partial: None, drainer: None, due: 0, taken_at_last: u64::MAX }
    }

    /// Continues with the next connection, unless the outlet is closed. Returns whether it does.
    pub(super) fn open(&mut self, socket: S) -> bool {
        self.number += 1;
        let is_closed = self.why_closed().is_some();
        if !is_closed {
            self.link = Link::Up(socket);
            (self.due, self.taken_at_last) = (0, u64::MAX);
        }
        !is_closed
    }

    /// Drops the socket. Returns the frame that was being written.
    pub(super) fn shut(&mut self) -> Option<Partial> {
        self.link = Link::Down;
        self.partial.take()
    }

    /// Excludes further connections.
    pub(super) fn close(&mut self, why: Rejection) {
        self.link = Link::Closed(why);
    }

    /// Returns the number of the latest connection.
    pub(super) const fn number(&self) -> LinkNumber {
        LinkNumber(self.number)
    }

    /// Whether this is the latest connection.
    pub(super) const fn is_present(&self, link: LinkNumber) -> bool {
        link.0 == self.number
    }

    pub(super) const fn is_up(&self) -> bool {
        matches!(self.link, Link::Up(_))
    }

    /// Returns why there will be no further connection; `None` if there may be one.
    pub(super) const fn why_closed(&self) -> Option<Rejection> {
        if let Link::Closed(why) = self.link { Some(why) } else { None }
    }

    /// Returns why the connection `link` cannot be written to, or `None` if it can.
    pub(super) fn end_of(&mut self, link: LinkNumber) -> Option<io::Error> {
        if !self.is_present(link) {
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

    pub(super) fn checksum(&self) -> Checksum {
        match &self.link {
            Link::Up(socket) => socket.checksum(),
            // This frame is not written. A later write encodes it again.
            Link::Down | Link::Failed(_) | Link::Closed(_) => Checksum::Crc,
        }
    }

    /// Whether the socket gathers frames.
    pub(super) fn gathers(&self) -> bool {
        matches!(&self.link, Link::Up(socket) if socket.gathers())
    }

    /// Returns the bytes that were gathered and not written.
    pub(super) fn gathered(&self) -> usize {
        if let Link::Up(socket) = &self.link { socket.gathered() } else { 0 }
    }

    /// Whether a frame is being written, or gathered bytes are.
    pub(super) fn is_within_frame(&self) -> bool {
        self.partial.is_some() || self.gathered() > 0
    }

    /// Writes the next piece of `frame`.
    pub(super) fn write(&mut self, frame: &mut Partial) -> Written {
        let Link::Up(socket) = &mut self.link else { return Written::Broken };
        match frame.write_to(socket) {
            Ok(written) => written,
            Err(error) => self.note(error),
        }
    }

    /// Bytes of frames that the socket has room to gather.
    pub(super) fn gather_room(&self) -> usize {
        if let Link::Up(socket) = &self.link { socket.gather_room() } else { 0 }
    }

    /// Whether the gathered bytes leave no room for every short frame, so that they are written now: the frame that
    /// finds no room would be written alone.
    pub(super) fn is_gathered_full(&self) -> bool {
        self.gathered() > 0 && self.gather_room() < SHORT
    }

    /// Lets the socket gather the frame of a message, for which it has [room](Self::gather_room).
    pub(super) fn gather_message(&mut self, message: &Message) {
        if let Link::Up(socket) = &mut self.link {
            let head = socket.checksum().encode(&message.header, &message.payload);
            let is_gathered = socket.gather(&[IoSlice::new(&head), IoSlice::new(&message.payload)]);
            debug_assert!(is_gathered, "there was room");
        }
    }

    /// Lets the socket gather a frame that has not been started. Returns whether there was room for it.
    pub(super) fn gather(&mut self, frame: &Partial) -> bool {
        if let Link::Up(socket) = &mut self.link { frame.gather_in(socket) } else { false }
    }

    /// Writes the gathered bytes. Returns how many the socket has accepted.
    pub(super) fn write_gathered(&mut self) -> usize {
        let Link::Up(socket) = &mut self.link else { return 0 };
        if socket.gathered() == 0 {
            return 0;
        }
        socket.write_gathered().unwrap_or_else(|error| {
            self.note(error);
            0
        })
    }

    /// Processes a failed write, temporary or permanent.
    fn note(&mut self, error: io::Error) -> Written {
        if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) {
            return Written::InPart;
        }
        self.fail(error);
        Written::Broken
    }

    /// Marks the connection as not writable any more.
    pub(super) fn fail(&mut self, error: io::Error) {
        self.taken_at_last = self.taken();
        self.link = Link::Failed(error);
    }

    /// Polls whether the socket may accept bytes; `None` if there is no socket.
    pub(super) fn poll_writable(&mut self, cx: &mut Context<'_>) -> Option<Poll<io::Result<()>>> {
        if let Link::Up(socket) = &mut self.link { Some(socket.poll_writable(cx)) } else { None }
    }

    pub(super) fn poll_delayed_wake(&mut self, cx: &mut Context<'_>) {
        if let Link::Up(socket) = &mut self.link {
            socket.poll_delayed_wake(cx);
        }
    }

    /// Schedules a delayed wake of the drain task. Returns whether it is scheduled.
    pub(super) fn wake_later(&mut self) -> bool {
        if let Link::Up(socket) = &mut self.link { socket.wake_later() } else { false }
    }

    /// Counts a message that was added to a queued one, which may postpone the delayed wake.
    pub(super) fn joins_delayed(&mut self) {
        if let Link::Up(socket) = &mut self.link {
            socket.joins_delayed();
        }
    }

    /// Records that a sender has written the queued messages.
    pub(super) fn wrote_delayed(&mut self) {
        if let Link::Up(socket) = &mut self.link {
            socket.wrote_delayed();
        }
    }

    /// Keeps the waker of the drain task, if it has changed.
    pub(super) fn register_drainer(&mut self, waker: &Waker) {
        if !self.drainer.as_ref().is_some_and(|known| known.will_wake(waker)) {
            self.drainer = Some(waker.clone());
        }
    }

    /// Whether the drain task waits to be woken.
    #[cfg(test)]
    pub(super) const fn is_drainer_asleep(&self) -> bool {
        self.drainer.is_some()
    }

    /// Schedules a wake of the drain task. A second call in the same step keeps the waker.
    pub(super) fn wake_drainer(&mut self, deferred: &mut DeferredActions) {
        deferred.wake = deferred.wake.take().or_else(|| self.drainer.take());
    }

    /// Records that a frame with this header was written, if it is for the program at the other end.
    pub(super) fn note_sent(&mut self, header: &Header) {
        if let Link::Up(socket) = &self.link
            && is_for_the_program(header)
        {
            self.due = socket.written();
        }
    }

    /// Returns the socket's count of written bytes; 0 without a connection.
    pub(super) fn written(&mut self) -> u64 {
        if let Link::Up(socket) = &mut self.link { socket.account().written } else { 0 }
    }

    /// Returns the peer's count of taken bytes; that of the last connection, if it has failed.
    pub(super) fn taken(&mut self) -> u64 {
        if let Link::Up(socket) = &mut self.link { socket.account().taken } else { self.taken_at_last }
    }

    /// Returns the number of written bytes that the peer has not taken; `None` if the socket cannot report them, or
    /// without a connection.
    pub(super) fn unread(&mut self) -> Option<u64> {
        let Link::Up(socket) = &mut self.link else { return None };
        let Account { written, taken } = socket.account();
        written.checked_sub(taken)
    }

    /// Returns the peer's progress, or `None` without a connection. Reads only existing counters. `sent` is
    /// the number of written messages.
    pub(super) fn progress(&mut self, unsent: &Unsent, sent: u64) -> Option<Taking> {
        let Link::Up(socket) = &mut self.link else { return None };
        let Account { written, taken } = socket.account();
        let is_known = taken <= written;
        // A peer that has taken all sent bytes is not the cause of messages queued here.
        let leaves_some =
            is_known && taken < self.due || taken != written && self.holds_any_for_the_program(unsent);
        let begun = self.partial.as_ref().map_or(0, |partial| partial.written as u64);
        let mark = if is_known { (taken, 0) } else { (sent, begun) };
        Some(Taking { mark, leaves_some })
    }

    /// Whether an application's message is queued, or has been started.
    fn holds_any_for_the_program(&self, unsent: &Unsent) -> bool {
        let begun = self.partial.as_ref().filter(|partial| partial.origin != FrameOrigin::Link);
        let begun = begun.map(|partial| &partial.message);
        begun.into_iter().chain(unsent.iter()).any(|message| is_for_the_program(&message.header))
    }
}
