//! Waiting for room in the ring of a direct link, and the notification that there is room.

use std::{os::fd::BorrowedFd, time::Duration};

use sinew_runtime::{tid::Tid, time::Time, wire::Class};
use sinew_shm::Armed;

use super::{Direct, Writing, established::EstablishedLink};
use crate::routes::{LinkNumber, Unread};

/// The room that a sender waits for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Room {
    pub(crate) link: LinkNumber,
    /// Bytes of its frame. If the frame has begun, the link knows how many are left.
    pub(crate) length: usize,
    /// The class of the message. For a Stream, the waiting values are sent first.
    pub(crate) class: Class,
}

impl Direct {
    /// Records that a sender has reached its stall timeout on this link. No other sender waits until the peer
    /// reads something.
    pub(crate) fn mark_stalled(&mut self, number: LinkNumber) {
        if let Some(link) = self.established(number) {
            link.is_stalled = true;
        }
    }

    /// Returns whether a sender has reached its stall timeout on this link and the peer has read nothing
    /// since.
    pub(crate) fn is_stalled(&mut self, number: LinkNumber) -> bool {
        self.established(number).is_some_and(|link| link.is_stalled)
    }

    /// Returns the read counter of a link's peer.
    pub(crate) fn taken(&mut self, number: LinkNumber) -> u32 {
        self.established(number).map_or(0, EstablishedLink::taken)
    }

    /// Continues the partly written message of a link.
    pub(crate) fn write_on(&mut self, number: LinkNumber) -> Writing {
        let Some(link) = self.established(number) else {
            return self.cut.take().map_or(Writing::Whole, |message| Writing::Cut(message.into()));
        };
        match link.continue_writing() {
            Ok(true) => Writing::Whole,
            Ok(false) => Writing::Part,
            Err(_) => {
                let (peer, cut) = (link.peer, link.cut());
                self.on_closed(peer, Time::now());
                cut.map_or(Writing::Whole, |message| Writing::Cut(message.into()))
            }
        }
    }

    /// Withdraws the partly written message of a link: the peer receives nothing of it.
    pub(crate) fn withdraw(&mut self, number: LinkNumber) {
        if let Some(link) = self.established(number) {
            link.withdraw();
        }
    }

    /// Waits until a link has room for the start of a frame of this many bytes, until the link ends, or for
    /// `within` at most.
    pub(crate) fn await_room(&mut self, room: Room, within: Duration) {
        if let Some(link) = self.established(room.link) {
            link.await_room(room.length, room.class, within);
        }
    }

    /// Announces that a task waits for room: when the peer has read something, it wakes the task once.
    /// [`Armed::Ready`]: there is room, or the link has ended, which the next write shows.
    pub(crate) fn arm_room(&mut self, room: Room) -> Armed {
        self.established(room.link).map_or(Armed::Ready, |link| link.arm_room(room.length, room.class))
    }

    /// Records that the task is awake.
    pub(crate) fn disarm_room(&mut self, room: Room) {
        if let Some(link) = self.established(room.link) {
            link.disarm_room();
        }
    }

    /// Calls a function with the descriptor that signals room on a link.
    pub(crate) fn with_room_bell<T>(
        &mut self,
        link: LinkNumber,
        call: impl FnOnce(Option<BorrowedFd<'_>>) -> T,
    ) -> T {
        match self.established(link) {
            Some(link) => link.with_room_bell(call),
            None => call(None),
        }
    }

    /// Records that the link to a peer cannot be written any more. Its remaining messages are read before the
    /// link is dropped.
    pub(super) fn on_closed(&mut self, peer: Tid, now: Time) {
        let _ = self.routes.on_hang_up(peer, Unread::Some, now);
        self.next_check = now;
    }
}
