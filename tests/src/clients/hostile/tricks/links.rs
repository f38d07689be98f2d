//! The hostile end of a direct link with an honest process. The link is requested by either side, and then
//! misused.

use std::{
    io::{self, IoSliceMut, Write},
    mem::MaybeUninit,
    net::Shutdown,
    os::{fd::OwnedFd, unix::net::UnixStream},
    thread,
    time::{Duration, Instant},
};

use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, recvmsg};
use sinew::{AppAddress, Outcome, Tid, message::Kind, payload};
use sinew_runtime::wire::{Flags, Header, encode};
use sinew_shm::{BellKind, Capacity, Offer, PassError, Region};

use super::{Attacker, TRICK};
use crate::clients::{
    host::HOSTS,
    hostile::{
        raw_connection::{Frame, pass},
        ring::{HostileRing, RingEnd},
    },
};

payload!("hostile.introduction" => struct Introduce { to: u64 });
payload!("hostile.switching" => struct Switch { peer: u64, number: u64 });

/// Timeout of the peer's offer.
const OFFER: Duration = Duration::from_millis(300);

/// A hostile client and a victim that has accepted a link.
pub(super) struct Met {
    node: HostileRing,
    /// The socket of the link and its number.
    pub(super) socket: UnixStream,
    number: u64,
    victim: Tid,
}

/// A link with the memory of both sides offered.
pub(super) struct Link {
    pub(super) met: Met,
    pub(super) end: RingEnd,
}

impl Met {
    fn me(&self) -> Tid {
        self.node.connection.tid
    }

    /// Waits for the victim's offer.
    pub(super) fn offer(&self) -> io::Result<Offer> {
        let end = Instant::now() + OFFER;
        loop {
            match Offer::receive(&self.socket) {
                Ok(offer) => return offer.map_err(io::Error::other),
                Err(PassError::System(cause))
                    if cause.kind() == io::ErrorKind::WouldBlock && Instant::now() < end =>
                {
                    thread::sleep(Duration::from_millis(1));
                }
                Err(error) => return Err(io::Error::other(error)),
            }
        }
    }

    pub(super) fn switch(&mut self) -> io::Result<bool> {
        let switch = Switch { peer: self.victim.bits(), number: self.number };
        self.send_to_node(Kind::LNCL_SWITCH, Flags::CONFIRM, encode(&switch).to_vec(), self.number)
    }

    fn send_to_node(
        &mut self,
        kind: Kind,
        flags: Flags,
        payload: Vec<u8>,
        correlation: u64,
    ) -> io::Result<bool> {
        send_to_node(&mut self.node, kind, flags, payload, correlation)
    }
}

/// Sends a frame to the node that an honest client may send.
fn send_to_node(
    node: &mut HostileRing,
    kind: Kind,
    flags: Flags,
    payload: Vec<u8>,
    correlation: u64,
) -> io::Result<bool> {
    let lncl = Tid::new(node.connection.tid.node, AppAddress::LNCL);
    let mut header = Header::new(kind, node.connection.tid, lncl);
    (header.flags, header.correlation) = (flags, correlation);
    let taken = node.publish(&Frame::new(&header, payload).bytes())?;
    node.take()?;
    Ok(taken)
}

/// Receives the number and the socket of a link, which arrive together. Waits as long as the socket's
/// timeout.
fn take_end(control: &UnixStream) -> io::Result<(u64, UnixStream)> {
    let mut number = [0; 8];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut ancillary = RecvAncillaryBuffer::new(&mut space);
    let mut parts = [IoSliceMut::new(&mut number)];
    recvmsg(control, &mut parts, &mut ancillary, RecvFlags::CMSG_CLOEXEC)?;
    let end: Option<OwnedFd> = ancillary.drain().find_map(|message| {
        if let RecvAncillaryMessage::ScmRights(mut ends) = message { ends.next() } else { None }
    });
    Ok((u64::from_le_bytes(number), end.ok_or(io::ErrorKind::UnexpectedEof)?.into()))
}

impl Attacker {
    /// One of the honest hosts that accept links from all clients.
    fn one_of_the_hosts(&mut self) -> io::Result<Tid> {
        let mut connection = self.register()?;
        let name = HOSTS[self.random.below(HOSTS.len() as u32) as usize].0;
        self.resolve(&mut connection, name)
    }

    /// Requests a link with an honest process.
    pub(super) fn meet(&mut self) -> io::Result<Met> {
        let victim = self.one_of_the_hosts()?;
        let mut node = self.join_ring()?;
        let introduce = encode(&Introduce { to: victim.bits() }).to_vec();
        send_to_node(&mut node, Kind::LNCL_INTRODUCE, Flags::CONFIRM, introduce, 1)?;
        let (number, socket) = take_end(&node.connection.stream)?;
        node.take()?;
        Ok(Met { node, socket, number, victim })
    }

    /// Makes an honest process request a link: sends to it, accepts the link that it requests, and offers
    /// first.
    fn be_asked(&mut self) -> io::Result<Link> {
        let victim = self.one_of_the_hosts()?;
        let mut node = self.join_ring()?;
        let bait = Frame::new(&self.header(node.connection.tid, victim), self.random.bytes(100)).bytes();
        node.publish(&bait)?;
        let (number, socket) = take_end(&node.connection.stream)?;
        let mut met = Met { node, socket, number, victim };
        // The victim's offer comes after ours, so its memory is not known yet; any other memory serves.
        let (capacity, bell) = self.odd_ring();
        let (region, offer) = Region::create(capacity, bell).map_err(io::Error::other)?;
        let key = offer.descriptors()[0].try_clone()?;
        offer.send(&met.socket).map_err(io::Error::other)?;
        met.send_to_node(Kind::OUTCOME, Flags::OUTCOME, vec![Outcome::Delivered.code()], number)?;
        let theirs = met.offer()?;
        let end = RingEnd::of(region, key, theirs, capacity)?;
        self.tally.links += 1;
        Ok(Link { met, end })
    }

    fn odd_ring(&mut self) -> (Capacity, BellKind) {
        let bytes = 4096 << self.random.below(7);
        let bell = if self.random.once_in(2) { BellKind::Futex } else { BellKind::Socket };
        (Capacity::new(bytes).expect("a power of two within the limits"), bell)
    }

    /// Sets up a link as an honest client does.
    pub(super) fn join_link(&mut self) -> io::Result<Link> {
        let mut met = self.meet()?;
        let theirs = met.offer()?;
        let (capacity, bell) = self.odd_ring();
        let end = RingEnd::offer(&met.socket, theirs, capacity, bell)?;
        met.switch()?;
        self.tally.links += 1;
        Ok(Link { met, end })
    }

    /// Sends frames through a direct link, and corrupts its rings between them.
    pub(super) fn lying_link(&mut self) -> io::Result<()> {
        let link = self.join_link()?;
        self.lie_on(link)
    }

    /// The same on a link that the honest process has requested.
    pub(super) fn lure(&mut self) -> io::Result<()> {
        let mut link = self.be_asked()?;
        link.met.switch()?;
        self.lie_on(link)
    }

    fn lie_on(&mut self, mut link: Link) -> io::Result<()> {
        // One of this many steps is a lie; the other steps lead deeper into valid peer behaviour.
        let truths = [1, 4, 32, 1_000][self.random.below(4) as usize];
        let ends = self.random.once_in(2).then(|| self.random.below(500));
        let end = Instant::now() + TRICK;
        for step in (0..500).take_while(|_| Instant::now() < end) {
            if ends == Some(step) {
                self.end_half(&link.met)?;
            }
            if self.random.once_in(truths) {
                link.end.lie(&mut self.random)?;
                self.tally.lies += 1;
            } else if !self.send_on(&mut link)? {
                thread::sleep(Duration::from_millis(1));
            }
            if self.random.once_in(4) {
                link.end.take()?;
                link.met.node.take()?;
            }
        }
        Ok(())
    }

    /// Sends a frame to the victim or to a random address, with its own source or a forged one, in one piece
    /// or two. Returns whether there was room.
    fn send_on(&mut self, link: &mut Link) -> io::Result<bool> {
        let (me, victim) = (link.met.me(), link.met.victim);
        let source = if self.random.once_in(16) { self.any_address(me) } else { me };
        let to = if self.random.once_in(16) { self.any_address(me) } else { victim };
        let mut header = self.header(source, to);
        if self.random.once_in(16) {
            header.kind = Kind::from_bits(self.random.below(0x60));
        }
        if self.random.once_in(2) {
            header.flags =
                if self.random.once_in(2) { Flags::ASK.with(Flags::CONFIRM) } else { Flags::CONFIRM };
        }
        header.correlation = self.random.number();
        let length = self.random.below(2_000) as usize;
        let frame = Frame::new(&header, self.random.bytes(length)).bytes();
        let cut = if self.random.once_in(16) { self.random.below(60) as usize } else { frame.len() };
        let fits = frame.len() + 8 <= link.end.record_max();
        let taken = fits
            && link.end.publish(&frame[..cut])?
            && (cut == frame.len() || link.end.publish(&frame[cut..])?);
        self.tally.bytes += if taken { frame.len() as u64 } else { 0 };
        Ok(taken)
    }

    /// Closes one or both directions of the link's socket, or sends unexpected bytes there.
    fn end_half(&mut self, met: &Met) -> io::Result<()> {
        let how = [Shutdown::Read, Shutdown::Write, Shutdown::Both];
        match self.random.below(4) {
            3 => (&met.socket).write_all(&self.random.bytes(100)),
            which => met.socket.shutdown(how[which as usize]),
        }
    }

    /// Sends requests on a direct link, and reads no answer.
    pub(super) fn deaf_link(&mut self) -> io::Result<()> {
        let mut link = self.join_link()?;
        let end = Instant::now() + TRICK;
        for _ in (0..500).take_while(|_| Instant::now() < end) {
            if !self.send_on(&mut link)? {
                thread::sleep(Duration::from_micros(100));
            }
        }
        thread::sleep(self.random.time_below(Duration::from_millis(200)));
        Ok(())
    }

    /// Sends an invalid offer or none on the socket of a link, and continues as if it had been valid.
    pub(super) fn odd_link(&mut self) -> io::Result<()> {
        let mut met = self.meet()?;
        let theirs = met.offer()?;
        let mut bytes = theirs.to_bytes().to_vec();
        match self.random.below(6) {
            // The victim's own memory, sent back.
            0 => theirs.send(&met.socket).map_err(io::Error::other)?,
            1 => self.end_half(&met)?,
            2 => {}
            other => {
                match other {
                    3 => bytes[self.random.below(24) as usize] = self.random.number() as u8,
                    4 => bytes.truncate(self.random.below(24) as usize + 1),
                    _ => {}
                }
                let descriptors: io::Result<Vec<_>> = (0..1 + self.random.below(6))
                    .map(|_| self.odd_descriptor(&met.node.connection))
                    .collect();
                pass(&met.socket, &bytes, &descriptors?)?;
            }
        }
        met.switch()?;
        thread::sleep(self.random.time_below(Duration::from_millis(50)));
        Ok(())
    }
}
