//! The hostile end of a direct link with an honest process: introduced to it, or asked for by it, and then anything but honest.

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
        ring::{HostileRing, RingEnd},
        stranger::{Frame, pass},
    },
};

payload!("hostile.introduction" => struct Introduce { to: u64 });
payload!("hostile.switching" => struct Switch { peer: u64, number: u64 });

/// Longest time for the other's offer.
const OFFER: Duration = Duration::from_millis(300);

/// A hostile client whose victim has agreed to a link.
pub(super) struct Met {
    node: HostileRing,
    /// The end of the link's socket, and its number.
    pub(super) socket: UnixStream,
    number: u64,
    victim: Tid,
}

/// A link whose both sides have offered their memory.
pub(super) struct Link {
    pub(super) met: Met,
    pub(super) end: RingEnd,
}

impl Met {
    fn me(&self) -> Tid {
        self.node.stranger.tid
    }

    /// Waits for what the victim offers.
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
        self.tell_node(Kind::LNCL_SWITCH, Flags::CONFIRM, encode(&switch).to_vec(), self.number)
    }

    fn tell_node(
        &mut self,
        kind: Kind,
        flags: Flags,
        payload: Vec<u8>,
        correlation: u64,
    ) -> io::Result<bool> {
        tell_node(&mut self.node, kind, flags, payload, correlation)
    }
}

/// Says a frame to the node that an honest client may say.
fn tell_node(
    node: &mut HostileRing,
    kind: Kind,
    flags: Flags,
    payload: Vec<u8>,
    correlation: u64,
) -> io::Result<bool> {
    let lncl = Tid::new(node.stranger.tid.node, AppAddress::LNCL);
    let mut header = Header::new(kind, node.stranger.tid, lncl);
    (header.flags, header.correlation) = (flags, correlation);
    let taken = node.publish(&Frame::new(&header, payload).bytes())?;
    node.take()?;
    Ok(taken)
}

/// The number and the end of a link, which come beside each other. Waits as long as the socket does.
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
    /// One of the honest ones who let everybody have a link with them.
    fn one_of_the_hosts(&mut self) -> io::Result<Tid> {
        let mut stranger = self.register()?;
        let name = HOSTS[self.dice.below(HOSTS.len() as u32) as usize].0;
        self.resolve(&mut stranger, name)
    }

    /// Has itself introduced to an honest one.
    pub(super) fn meet(&mut self) -> io::Result<Met> {
        let victim = self.one_of_the_hosts()?;
        let mut node = self.join_ring()?;
        let introduce = encode(&Introduce { to: victim.bits() }).to_vec();
        tell_node(&mut node, Kind::LNCL_INTRODUCE, Flags::CONFIRM, introduce, 1)?;
        let (number, socket) = take_end(&node.stranger.stream)?;
        node.take()?;
        Ok(Met { node, socket, number, victim })
    }

    /// Is looked up by an honest one: sends to it, agrees to the link that it asks for, and offers first.
    fn be_asked(&mut self) -> io::Result<Link> {
        let victim = self.one_of_the_hosts()?;
        let mut node = self.join_ring()?;
        let bait = Frame::new(&self.header(node.stranger.tid, victim), self.dice.bytes(100)).bytes();
        node.publish(&bait)?;
        let (number, socket) = take_end(&node.stranger.stream)?;
        let mut met = Met { node, socket, number, victim };
        // What the victim has offers comes after ours: its memory is not there yet, any other will do.
        let (capacity, bell) = self.odd_ring();
        let (region, offer) = Region::create(capacity, bell).map_err(io::Error::other)?;
        let key = offer.descriptors()[0].try_clone()?;
        offer.send(&met.socket).map_err(io::Error::other)?;
        met.tell_node(Kind::OUTCOME, Flags::OUTCOME, vec![Outcome::Delivered.code()], number)?;
        let theirs = met.offer()?;
        let end = RingEnd::of(region, key, theirs, capacity)?;
        self.tally.links += 1;
        Ok(Link { met, end })
    }

    fn odd_ring(&mut self) -> (Capacity, BellKind) {
        let bytes = 4096 << self.dice.below(7);
        let bell = if self.dice.once_in(2) { BellKind::Futex } else { BellKind::Socket };
        (Capacity::new(bytes).expect("a power of two within the limits"), bell)
    }

    /// A link as an honest client makes it.
    pub(super) fn join_link(&mut self) -> io::Result<Link> {
        let mut met = self.meet()?;
        let theirs = met.offer()?;
        let (capacity, bell) = self.odd_ring();
        let end = RingEnd::offer(&met.socket, theirs, capacity, bell)?;
        met.switch()?;
        self.tally.links += 1;
        Ok(Link { met, end })
    }

    /// Frames through a direct link, and lies about its rings between them.
    pub(super) fn lying_link(&mut self) -> io::Result<()> {
        let link = self.join_link()?;
        self.lie_on(link)
    }

    /// The same on a link that the honest one has asked for.
    pub(super) fn lure(&mut self) -> io::Result<()> {
        let mut link = self.be_asked()?;
        link.met.switch()?;
        self.lie_on(link)
    }

    fn lie_on(&mut self, mut link: Link) -> io::Result<()> {
        // Of so many steps one is a lie; the others lead deeper into what an honest peer may do.
        let truths = [1, 4, 32, 1_000][self.dice.below(4) as usize];
        let ends = self.dice.once_in(2).then(|| self.dice.below(500));
        let end = Instant::now() + TRICK;
        for step in (0..500).take_while(|_| Instant::now() < end) {
            if ends == Some(step) {
                self.end_half(&link.met)?;
            }
            if self.dice.once_in(truths) {
                link.end.lie(&mut self.dice)?;
                self.tally.lies += 1;
            } else if !self.say_on(&mut link)? {
                thread::sleep(Duration::from_millis(1));
            }
            if self.dice.once_in(4) {
                link.end.take()?;
                link.met.node.take()?;
            }
        }
        Ok(())
    }

    /// A frame for the victim, or for anybody, in own name or another's, in one piece or two; whether there was room.
    fn say_on(&mut self, link: &mut Link) -> io::Result<bool> {
        let (me, victim) = (link.met.me(), link.met.victim);
        let source = if self.dice.once_in(16) { self.anybody(me) } else { me };
        let to = if self.dice.once_in(16) { self.anybody(me) } else { victim };
        let mut header = self.header(source, to);
        if self.dice.once_in(16) {
            header.kind = Kind::from_bits(self.dice.below(0x60));
        }
        if self.dice.once_in(2) {
            header.flags =
                if self.dice.once_in(2) { Flags::ASK.with(Flags::CONFIRM) } else { Flags::CONFIRM };
        }
        header.correlation = self.dice.roll();
        let length = self.dice.below(2_000) as usize;
        let frame = Frame::new(&header, self.dice.bytes(length)).bytes();
        let cut = if self.dice.once_in(16) { self.dice.below(60) as usize } else { frame.len() };
        let fits = frame.len() + 8 <= link.end.record_max();
        let taken = fits
            && link.end.publish(&frame[..cut])?
            && (cut == frame.len() || link.end.publish(&frame[cut..])?);
        self.tally.bytes += if taken { frame.len() as u64 } else { 0 };
        Ok(taken)
    }

    /// Closes one direction of the link's socket, or both, or says there what nobody says.
    fn end_half(&mut self, met: &Met) -> io::Result<()> {
        let how = [Shutdown::Read, Shutdown::Write, Shutdown::Both];
        match self.dice.below(4) {
            3 => (&met.socket).write_all(&self.dice.bytes(100)),
            which => met.socket.shutdown(how[which as usize]),
        }
    }

    /// Asks on a direct link, and takes no answer.
    pub(super) fn deaf_link(&mut self) -> io::Result<()> {
        let mut link = self.join_link()?;
        let end = Instant::now() + TRICK;
        for _ in (0..500).take_while(|_| Instant::now() < end) {
            if !self.say_on(&mut link)? {
                thread::sleep(Duration::from_micros(100));
            }
        }
        thread::sleep(self.dice.time_below(Duration::from_millis(200)));
        Ok(())
    }

    /// What is no offer, on the socket of a link; or none; and then goes on as if it had been one.
    pub(super) fn odd_link(&mut self) -> io::Result<()> {
        let mut met = self.meet()?;
        let theirs = met.offer()?;
        let mut bytes = theirs.to_bytes().to_vec();
        match self.dice.below(6) {
            // Its own memory, back.
            0 => theirs.send(&met.socket).map_err(io::Error::other)?,
            1 => self.end_half(&met)?,
            2 => {}
            other => {
                match other {
                    3 => bytes[self.dice.below(24) as usize] = self.dice.roll() as u8,
                    4 => bytes.truncate(self.dice.below(24) as usize + 1),
                    _ => {}
                }
                let descriptors: io::Result<Vec<_>> =
                    (0..1 + self.dice.below(6)).map(|_| self.odd_descriptor(&met.node.stranger)).collect();
                pass(&met.socket, &bytes, &descriptors?)?;
            }
        }
        met.switch()?;
        thread::sleep(self.dice.time_below(Duration::from_millis(50)));
        Ok(())
    }
}
