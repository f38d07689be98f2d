//! What takes for ever to close, passed in each place where somebody might take it.

use std::{io, os::unix::net::UnixStream};

use sinew_shm::{BellKind, Offer, Region};

use super::{Attacker, Stranger, ask_for_rings};
use crate::clients::hostile::{
    lingering::{Passed, offer_with_full_bells, pass_copies, pass_lingering, pass_urgent},
    stranger::{DESCRIPTORS_MAX, Frame, pass},
};

/// The other's own memory, and in place of bells that once more.
fn offer_no_rings(socket: &UnixStream, theirs: &Offer) -> io::Result<()> {
    let memory = || theirs.descriptors()[0].try_clone();
    let descriptors: io::Result<Vec<_>> = theirs.descriptors().iter().map(|_| memory()).collect();
    pass(socket, &theirs.to_bytes(), &descriptors?)
}

impl Attacker {
    fn linger_on(&mut self, socket: &UnixStream, bytes: &[u8]) -> io::Result<()> {
        let pass = if self.dice.once_in(3) { pass_urgent } else { pass_lingering };
        let passed = pass(self.keeper, socket, bytes)?;
        self.tally.lingering += 1;
        self.tally.lingering_came += u64::from(passed == Passed::Came);
        Ok(())
    }

    /// Before it has said who it is, with one byte.
    pub(super) fn lingering_stranger(&mut self) -> io::Result<()> {
        let stranger = self.connect()?;
        self.linger_on(&stranger.stream, b"S")?;
        self.wait_or_go(stranger)
    }

    /// Beside a frame, or the first byte of it.
    pub(super) fn lingering_frame(&mut self) -> io::Result<()> {
        let stranger = self.register()?;
        let to = self.anybody(stranger.tid);
        let frame = Frame::new(&self.header(stranger.tid, to), self.dice.bytes(100)).bytes();
        let some = if self.dice.once_in(2) { &frame[..] } else { &frame[..1] };
        self.linger_on(&stranger.stream, some)?;
        self.wait_or_go(stranger)
    }

    /// Hears why it is refused, or goes before that.
    fn wait_or_go(&mut self, mut stranger: Stranger) -> io::Result<()> {
        if self.dice.once_in(2) { self.listen(&mut stranger) } else { Ok(()) }
    }

    /// On a bell of the node's, or on the socket beside the rings.
    pub(super) fn lingering_bell(&mut self) -> io::Result<()> {
        let mut ring = self.join_ring()?;
        let place = self.dice.below(3) as usize;
        let socket = match place {
            0 => ring.stranger.stream.try_clone()?,
            bell => ring.bell(bell)?,
        };
        self.linger_on(&socket, &[1])?;
        ring.take()
    }

    /// On a bell of a host's, where that is a socket, or on the socket of the link.
    pub(super) fn lingering_link(&mut self) -> io::Result<()> {
        let mut link = self.join_link()?;
        let is_bell = link.end.has_bells() && self.dice.once_in(2);
        let bell = 1 + self.dice.below(2) as usize;
        let socket = if is_bell { link.end.bell(bell)? } else { link.met.socket.try_clone()? };
        self.linger_on(&socket, &[1])?;
        link.end.take()
    }

    /// On a bell of the node's as soon as it is offered; and then no rings, or what are none.
    pub(super) fn lingering_in_vain(&mut self) -> io::Result<()> {
        self.tally.connections += 1;
        let (stranger, theirs, _) = ask_for_rings(&self.socket)?;
        self.linger_on_bell_of(&theirs)?;
        if self.dice.once_in(2) {
            offer_no_rings(&stranger.stream, &theirs)?;
        }
        self.wait_or_go(stranger)
    }

    /// The same with a host, which has agreed to a link.
    pub(super) fn lingering_meeting(&mut self) -> io::Result<()> {
        let mut met = self.meet()?;
        let theirs = met.offer()?;
        if theirs.bell() == BellKind::Socket {
            self.linger_on_bell_of(&theirs)?;
        }
        if self.dice.once_in(2) {
            offer_no_rings(&met.socket, &theirs)?;
            met.switch()?;
        }
        Ok(())
    }

    fn linger_on_bell_of(&mut self, theirs: &Offer) -> io::Result<()> {
        let bell = 1 + self.dice.below(2) as usize;
        self.linger_on(&theirs.descriptors()[bell].try_clone()?.into(), &[1])
    }

    /// Where an offer is due: in as many copies as one message can carry.
    pub(super) fn lingering_crowd(&mut self) -> io::Result<()> {
        self.tally.connections += 1;
        let (stranger, theirs, _) = ask_for_rings(&self.socket)?;
        let passed = pass_copies(self.keeper, &stranger.stream, &theirs.to_bytes(), DESCRIPTORS_MAX)?;
        self.tally.lingering += 1;
        self.tally.lingering_came += u64::from(passed == Passed::Came);
        self.wait_or_go(stranger)
    }

    /// Where an offer is due: in place of it, or in its bell.
    pub(super) fn lingering_offer(&mut self) -> io::Result<()> {
        self.tally.connections += 1;
        let (stranger, theirs, capacity) = ask_for_rings(&self.socket)?;
        if self.dice.once_in(2) {
            self.linger_on(&stranger.stream, &theirs.to_bytes())?;
        } else {
            let (_region, model) = Region::create(capacity, BellKind::Socket).map_err(io::Error::other)?;
            let (offer, _ears) = offer_with_full_bells(self.keeper, &model)?;
            offer.send(&stranger.stream).map_err(io::Error::other)?;
            self.tally.lingering += 1;
            self.tally.lingering_came += 1;
        }
        self.wait_or_go(stranger)
    }
}
