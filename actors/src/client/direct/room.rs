//! Room in the ring of a direct link: who waits for it, and how it is learned that there is some.

use std::{os::fd::BorrowedFd, time::Duration};

use sinew_runtime::{tid::Tid, time::Time, wire::Class};
use sinew_shm::Armed;

use super::{Direct, Writing, standing::Standing};
use crate::client::routes::{Left, LinkNumber};

/// What a sender waits for.
#[derive(Clone, Copy, Debug)]
pub(in crate::client) struct Room {
    pub(in crate::client) link: LinkNumber,
    /// Bytes of its frame. Of one that has begun the link knows what is left.
    pub(in crate::client) length: usize,
    /// Of a Stream what waits goes first.
    pub(in crate::client) class: Class,
}

impl Direct {
    /// A sender has lost its stall timeout there. Until the peer takes something no other one waits.
    pub(in crate::client) fn has_stalled(&mut self, number: LinkNumber) {
        if let Some(link) = self.standing(number) {
            link.is_stalled = true;
        }
    }

    /// Whether a sender has lost its stall timeout there, and the peer has taken nothing since.
    pub(in crate::client) fn is_stalled(&mut self, number: LinkNumber) -> bool {
        self.standing(number).is_some_and(|link| link.is_stalled)
    }

    /// A count of what the peer of a link takes.
    pub(in crate::client) fn taken(&mut self, number: LinkNumber) -> u32 {
        self.standing(number).map_or(0, Standing::taken)
    }

    /// Writes on with what was begun on a link.
    pub(in crate::client) fn write_on(&mut self, number: LinkNumber) -> Writing {
        let Some(link) = self.standing(number) else {
            return self.cut.take().map_or(Writing::Whole, |message| Writing::Cut(message.into()));
        };
        match link.go_on() {
            Ok(true) => Writing::Whole,
            Ok(false) => Writing::Part,
            Err(_) => {
                let (peer, cut) = (link.peer, link.cut());
                self.has_closed(peer, Time::now());
                cut.map_or(Writing::Whole, |message| Writing::Cut(message.into()))
            }
        }
    }

    /// Takes back what was begun on a link: the peer receives nothing of it.
    pub(in crate::client) fn withdraw(&mut self, number: LinkNumber) {
        if let Some(link) = self.standing(number) {
            link.withdraw();
        }
    }

    /// Waits until a link has room for the beginning of a frame of so many bytes, or ends, or `within` this time.
    pub(in crate::client) fn await_room(&mut self, room: Room, within: Duration) {
        if let Some(link) = self.standing(room.link) {
            link.await_room(room.length, room.class, within);
        }
    }

    /// Announces that a task waits for room: when the peer has taken something it rings, once. [`Armed::Ready`]: there is room, or
    /// the link is of no more use, which shows when it is written.
    pub(in crate::client) fn arm_room(&mut self, room: Room) -> Armed {
        self.standing(room.link).map_or(Armed::Ready, |link| link.arm_room(room.length, room.class))
    }

    /// Says that the task is awake.
    pub(in crate::client) fn disarm_room(&mut self, room: Room) {
        if let Some(link) = self.standing(room.link) {
            link.disarm_room();
        }
    }

    /// Does something with the descriptor of the bell for room on a link.
    pub(in crate::client) fn with_room_bell<T>(
        &mut self,
        link: LinkNumber,
        look: impl FnOnce(Option<BorrowedFd<'_>>) -> T,
    ) -> T {
        match self.standing(link) {
            Some(link) => link.with_room_bell(look),
            None => look(None),
        }
    }

    /// The way to a peer cannot be written any more. Its last words are read before it is forgotten.
    pub(super) fn has_closed(&mut self, peer: Tid, now: Time) {
        let _ = self.routes.hung_up(peer, Left::Something, now);
        self.look_at = now;
    }
}
