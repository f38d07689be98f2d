//! Descriptors that block on close, passed in each place where a process might receive them.

use std::{io, os::unix::net::UnixStream};

use sinew_shm::{BellKind, Offer, Region};

use super::{Attacker, RawConnection};
use crate::clients::hostile::{
    raw_connection::{DESCRIPTORS_MAX, Frame, pass},
    ring::ask_for_rings,
    slow_close::{Passed, offer_with_full_bells, pass_copies, pass_slow_close, pass_urgent},
};

/// The peer's own memory, with the same descriptor in place of the bells.
fn offer_no_rings(socket: &UnixStream, theirs: &Offer) -> io::Result<()> {
    let memory = || theirs.descriptors()[0].try_clone();
    let descriptors: io::Result<Vec<_>> = theirs.descriptors().iter().map(|_| memory()).collect();
    pass(socket, &theirs.to_bytes(), &descriptors?)
}

impl Attacker {
    fn attach_slow_close(&mut self, socket: &UnixStream, bytes: &[u8]) -> io::Result<()> {
        let pass = if self.random.once_in(3) { pass_urgent } else { pass_slow_close };
        let passed = pass(self.keeper, socket, bytes)?;
        self.tally.slow_closes += 1;
        self.tally.slow_closes_sent += u64::from(passed == Passed::Sent);
        Ok(())
    }

    /// Before the registration, with one byte.
    pub(super) fn slow_close_before_registration(&mut self) -> io::Result<()> {
        let connection = self.connect()?;
        self.attach_slow_close(&connection.stream, b"S")?;
        self.wait_or_go(connection)
    }

    /// Beside a frame, or its first byte.
    pub(super) fn slow_close_beside_frame(&mut self) -> io::Result<()> {
        let connection = self.register()?;
        let to = self.any_address(connection.tid);
        let frame = Frame::new(&self.header(connection.tid, to), self.random.bytes(100)).bytes();
        let some = if self.random.once_in(2) { &frame[..] } else { &frame[..1] };
        self.attach_slow_close(&connection.stream, some)?;
        self.wait_or_go(connection)
    }

    /// Reads the reason of the refusal, or disconnects first.
    fn wait_or_go(&mut self, mut connection: RawConnection) -> io::Result<()> {
        if self.random.once_in(2) { self.listen(&mut connection) } else { Ok(()) }
    }

    /// On a bell of the node, or on the socket of the rings.
    pub(super) fn slow_close_on_bell(&mut self) -> io::Result<()> {
        let mut ring = self.join_ring()?;
        let place = self.random.below(3) as usize;
        let socket = match place {
            0 => ring.connection.stream.try_clone()?,
            bell => ring.bell(bell)?,
        };
        self.attach_slow_close(&socket, &[1])?;
        ring.take()
    }

    /// On a bell of a host, if that is a socket, or on the socket of the link.
    pub(super) fn slow_close_on_link(&mut self) -> io::Result<()> {
        let mut link = self.join_link()?;
        let is_bell = link.end.has_bells() && self.random.once_in(2);
        let bell = 1 + self.random.below(2) as usize;
        let socket = if is_bell { link.end.bell(bell)? } else { link.met.socket.try_clone()? };
        self.attach_slow_close(&socket, &[1])?;
        link.end.take()
    }

    /// On a bell of the node as soon as it is offered; then offers no rings, or invalid ones.
    pub(super) fn slow_close_without_rings(&mut self) -> io::Result<()> {
        self.tally.connections += 1;
        let (connection, theirs, _) = ask_for_rings(&self.socket)?;
        self.attach_to_bell_of(&theirs)?;
        if self.random.once_in(2) {
            offer_no_rings(&connection.stream, &theirs)?;
        }
        self.wait_or_go(connection)
    }

    /// The same with a host that has accepted a link.
    pub(super) fn slow_close_while_meeting(&mut self) -> io::Result<()> {
        let mut met = self.meet()?;
        let theirs = met.offer()?;
        if theirs.bell() == BellKind::Socket {
            self.attach_to_bell_of(&theirs)?;
        }
        if self.random.once_in(2) {
            offer_no_rings(&met.socket, &theirs)?;
            met.switch()?;
        }
        Ok(())
    }

    fn attach_to_bell_of(&mut self, theirs: &Offer) -> io::Result<()> {
        let bell = 1 + self.random.below(2) as usize;
        self.attach_slow_close(&theirs.descriptors()[bell].try_clone()?.into(), &[1])
    }

    /// In place of an offer: in as many copies as one message can carry.
    pub(super) fn slow_close_in_copies(&mut self) -> io::Result<()> {
        self.tally.connections += 1;
        let (connection, theirs, _) = ask_for_rings(&self.socket)?;
        let passed = pass_copies(self.keeper, &connection.stream, &theirs.to_bytes(), DESCRIPTORS_MAX)?;
        self.tally.slow_closes += 1;
        self.tally.slow_closes_sent += u64::from(passed == Passed::Sent);
        self.wait_or_go(connection)
    }

    /// In place of an offer: instead of it, or in its bell.
    pub(super) fn slow_close_as_offer(&mut self) -> io::Result<()> {
        self.tally.connections += 1;
        let (connection, theirs, capacity) = ask_for_rings(&self.socket)?;
        if self.random.once_in(2) {
            self.attach_slow_close(&connection.stream, &theirs.to_bytes())?;
        } else {
            let (_region, model) = Region::create(capacity, BellKind::Socket).map_err(io::Error::other)?;
            let (offer, _ears) = offer_with_full_bells(self.keeper, &model)?;
            offer.send(&connection.stream).map_err(io::Error::other)?;
            self.tally.slow_closes += 1;
            self.tally.slow_closes_sent += 1;
        }
        self.wait_or_go(connection)
    }
}
