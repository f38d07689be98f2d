//! What a hostile client does to a node, one trick after the other.

mod lingering;
mod links;
mod meetings;

use std::{
    fs::File,
    io,
    net::Shutdown,
    os::fd::OwnedFd,
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

use rustix::fs::{MemfdFlags, memfd_create};
use sinew::{
    AppAddress, Class, NodeAddress, Outcome, Payload as _, Tid,
    message::{Kind, Rejection},
    payload,
};
use sinew_runtime::wire::{Flags, Header, encode};

use super::{
    ring::{HostileRing, ask_for_rings},
    stranger::{Frame, Stranger},
};
use crate::{dice::Dice, puppet::Order};

payload!("hostile.registration" => struct Wishes {
    name: Option<String>,
    address: Option<u32>,
    requires: Vec<String>,
    events: Vec<u32>,
    kinds: Vec<String>,
});
payload!("hostile.membership" => struct Membership { group: u32, member: bool });
payload!("hostile.name" => struct Name { name: String });

/// What the attacks came to, as the attacker sees it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Tally {
    /// Tricks that were played.
    pub(super) tricks: u64,
    /// Connections that were made.
    pub(super) connections: u64,
    /// Bytes that the node took.
    pub(super) bytes: u64,
    /// Refusals that the node told.
    pub(super) refused: u64,
    /// Links with rings.
    pub(super) rings: u64,
    /// What was written into rings' memory that no honest client writes there.
    pub(super) lies: u64,
    /// Direct links with other processes.
    pub(super) links: u64,
    /// Descriptors that take for ever to close which were passed to somebody.
    pub(super) lingering: u64,
    /// Those of them that the system did not refuse.
    pub(super) lingering_came: u64,
}

impl Tally {
    /// Whether something of each sort was done: which, is left to chance, and how much, to the machine.
    pub(super) fn has_all_sorts(&self) -> bool {
        [self.refused, self.rings, self.lies, self.links, self.lingering].iter().all(|done| *done > 0)
    }
}

/// A hostile client of the node at a socket.
pub(super) struct Attacker {
    socket: PathBuf,
    dice: Dice,
    /// The port of the one who keeps the other ends of what does not close.
    keeper: u16,
    /// Connections that stay silent, in mid-frame or before the first one.
    silent: Vec<Stranger>,
    pub(super) tally: Tally,
}

type Trick = fn(&mut Attacker) -> io::Result<()>;

/// No trick goes on for longer; each of its calls has a bound of its own.
const TRICK: Duration = Duration::from_millis(500);
/// Connections that are kept in mid-frame.
const SILENT_MAX: usize = 16;

impl Attacker {
    pub(super) fn new(socket: &Path, dice: Dice, keeper: u16) -> Self {
        Self { socket: socket.to_owned(), dice, keeper, silent: Vec::new(), tally: Tally::default() }
    }

    /// Plays one trick. What the node answers to it, or that it closes, is no error.
    pub(super) fn play_one(&mut self) {
        const TRICKS: [Trick; 28] = [
            Attacker::garbage,
            Attacker::mutants,
            Attacker::forged_sources,
            Attacker::odd_descriptors,
            Attacker::deaf,
            Attacker::crowd,
            Attacker::half_a_frame,
            Attacker::wishes,
            Attacker::restless,
            Attacker::torrent,
            Attacker::too_early,
            Attacker::false_outcomes,
            Attacker::lying_ring,
            Attacker::deaf_ring,
            Attacker::odd_offers,
            Attacker::meetings,
            Attacker::lying_link,
            Attacker::deaf_link,
            Attacker::odd_link,
            Attacker::lure,
            Attacker::lingering_stranger,
            Attacker::lingering_frame,
            Attacker::lingering_bell,
            Attacker::lingering_link,
            Attacker::lingering_offer,
            Attacker::lingering_crowd,
            Attacker::lingering_in_vain,
            Attacker::lingering_meeting,
        ];
        self.tally.tricks += 1;
        let trick = TRICKS[self.dice.below(TRICKS.len() as u32) as usize];
        // The node may end the connection at any point of a trick, and has no place for one now and then.
        let _ = trick(self);
    }

    fn connect(&mut self) -> io::Result<Stranger> {
        self.tally.connections += 1;
        Stranger::connect(&self.socket)
    }

    fn register(&mut self) -> io::Result<Stranger> {
        self.tally.connections += 1;
        let registered = Stranger::register(&self.socket)?;
        if registered.is_none() {
            self.tally.refused += 1;
        }
        registered.ok_or_else(|| io::ErrorKind::ConnectionRefused.into())
    }

    fn write(&mut self, stranger: &mut Stranger, bytes: &[u8]) -> io::Result<()> {
        stranger.write(bytes)?;
        self.tally.bytes += bytes.len() as u64;
        Ok(())
    }

    /// Reads what the node has to say, and counts refusals: of the connection, and of messages.
    fn listen(&mut self, stranger: &mut Stranger) -> io::Result<()> {
        // The node closes, too, when it has said all that it has to say.
        stranger.stream.shutdown(Shutdown::Write)?;
        let forged = Outcome::Rejected(Rejection::ForgedSource).code();
        while let Some(said) = stranger.read()? {
            let is_refused = said.kind == Kind::LNCL_REFUSAL
                || said.kind == Kind::OUTCOME && said.payload == [forged] && said.correlation == FORGED;
            self.tally.refused += u64::from(is_refused);
        }
        Ok(())
    }

    fn header(&mut self, source: Tid, destination: Tid) -> Header {
        let mut header = Header::new(Order::KIND, source, destination);
        header.class = [Class::Control, Class::Stream, Class::Bulk][self.dice.below(3) as usize];
        header
    }

    /// Bytes that mean nothing, before and after a registration.
    fn garbage(&mut self) -> io::Result<()> {
        let mut stranger = if self.dice.once_in(2) { self.connect()? } else { self.register()? };
        for _ in 0..1 + self.dice.below(4) {
            let length = 1 + self.dice.below(4_096) as usize;
            let bytes = self.dice.bytes(length);
            self.write(&mut stranger, &bytes)?;
        }
        self.listen(&mut stranger)
    }

    /// Frames of which some bytes are others than they should be; the checksum is right for most.
    fn mutants(&mut self) -> io::Result<()> {
        let mut stranger = self.register()?;
        for _ in 0..1 + self.dice.below(32) {
            let to = self.anybody(stranger.tid);
            let header = self.header(stranger.tid, to);
            let length = self.dice.below(200) as usize;
            let mut frame = Frame::new(&header, self.dice.bytes(length));
            for _ in 0..self.dice.below(4) {
                // The magic and the version mostly stay: else nothing behind them is reached.
                let at = if self.dice.once_in(16) { self.dice.below(60) } else { 4 + self.dice.below(56) };
                frame.header[at as usize] = self.dice.roll() as u8;
            }
            if !self.dice.once_in(4) {
                frame = frame.sealed();
            }
            self.write(&mut stranger, &frame.bytes())?;
        }
        self.listen(&mut stranger)
    }

    /// Messages in the name of others.
    fn forged_sources(&mut self) -> io::Result<()> {
        let mut stranger = self.register()?;
        for _ in 0..1 + self.dice.below(64) {
            let source = self.anybody(stranger.tid);
            let destination = self.anybody(stranger.tid);
            let mut header = self.header(source, destination);
            header.class = Class::Control;
            header.flags = Flags::CONFIRM;
            header.correlation = FORGED;
            let payload = encode(&Order { number: 666 }).to_vec();
            self.write(&mut stranger, &Frame::new(&header, payload).bytes())?;
        }
        self.listen(&mut stranger)
    }

    /// Descriptors that nobody asked for, where one might look for them and where not.
    fn odd_descriptors(&mut self) -> io::Result<()> {
        let mut stranger = if self.dice.once_in(3) { self.connect()? } else { self.register()? };
        for _ in 0..1 + self.dice.below(6) {
            let descriptors: io::Result<Vec<_>> =
                (0..1 + self.dice.below(6)).map(|_| self.odd_descriptor(&stranger)).collect();
            let bytes = match self.dice.below(3) {
                0 => [&b"SINEWSHM"[..], &self.dice.bytes(16)].concat(),
                1 => Frame::of_lncl(Kind::LNCL_REGISTER, Tid::NONE, &Name { name: "x".to_owned() }).bytes(),
                _ => self.dice.bytes(24),
            };
            stranger.pass(&bytes, &descriptors?)?;
        }
        self.listen(&mut stranger)
    }

    fn odd_descriptor(&mut self, stranger: &Stranger) -> io::Result<OwnedFd> {
        Ok(match self.dice.below(6) {
            0 => File::open("/dev/zero")?.into(),
            1 => File::open("/")?.into(),
            // A socket that keeps itself alive.
            2 => stranger.stream.try_clone()?.into(),
            3 => self.connect()?.stream.into(),
            4 => memfd_create("odd", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?,
            _ => {
                let memory = memfd_create("odd", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?;
                rustix::fs::ftruncate(&memory, u64::from(self.dice.below(1 << 20)))?;
                memory
            }
        })
    }

    /// Asks and asks, and never reads an answer. What it writes to itself comes back to it.
    fn deaf(&mut self) -> io::Result<()> {
        let mut stranger = self.register()?;
        let witness = self.witness(&mut stranger)?;
        let length = self.dice.below(16_000) as usize;
        let for_me = Frame::new(&self.header(stranger.tid, stranger.tid), self.dice.bytes(length));
        let end = Instant::now() + TRICK;
        for number in (0..2_000).take_while(|_| Instant::now() < end) {
            let mut header = Header::new(Order::KIND, stranger.tid, witness);
            header.flags = Flags::ASK.with(Flags::CONFIRM);
            header.correlation = number;
            let payload = encode(&Order { number }).to_vec();
            self.write(&mut stranger, &Frame::new(&header, payload).bytes())?;
            self.write(&mut stranger, &for_me.bytes())?;
        }
        thread::sleep(self.dice.time_below(Duration::from_millis(200)));
        Ok(())
    }

    /// More addresses than one process may have, and more connections than the node has places.
    fn crowd(&mut self) -> io::Result<()> {
        let mut crowd = Vec::new();
        let end = Instant::now() + TRICK;
        let mut addresses = Vec::new();
        while addresses.len() < 200
            && Instant::now() < end
            && let Ok(one) = self.register()
        {
            addresses.push(one);
        }
        for _ in (0..200).take_while(|_| Instant::now() < end) {
            crowd.push(self.connect()?);
        }
        thread::sleep(self.dice.time_below(Duration::from_millis(50)));
        for mut stranger in crowd {
            // Those that have a place are told nothing.
            stranger.stream.set_nonblocking(true)?;
            let _ = self.listen(&mut stranger);
        }
        Ok(())
    }

    /// Begins a frame, and says no more for long.
    fn half_a_frame(&mut self) -> io::Result<()> {
        let mut stranger = if self.dice.once_in(2) { self.connect()? } else { self.register()? };
        let to = self.anybody(stranger.tid);
        let whole = Frame::new(&self.header(stranger.tid, to), self.dice.bytes(1_000)).bytes();
        let some = &whole[..self.dice.below(whole.len() as u32) as usize];
        self.write(&mut stranger, some)?;
        if self.silent.len() >= SILENT_MAX {
            let at = self.dice.below(SILENT_MAX as u32) as usize;
            self.silent.swap_remove(at);
        }
        self.silent.push(stranger);
        Ok(())
    }

    /// Registrations that nobody can grant, and all that one can ask for besides.
    fn wishes(&mut self) -> io::Result<()> {
        let mut stranger = self.connect()?;
        let name = match self.dice.below(5) {
            0 => None,
            1 => Some("echo".to_owned()),
            2 => Some("x".repeat(self.dice.below(300) as usize)),
            3 => Some("\u{7}\n\u{0}".to_owned()),
            _ => Some(format!("wish {}", self.dice.roll())),
        };
        let wishes = Wishes {
            name,
            address: self.dice.once_in(2).then(|| self.dice.roll() as u32),
            requires: (0..self.dice.below(80) / 70 * 70).map(|number| number.to_string()).collect(),
            events: (0..self.dice.below(100)).map(|_| self.dice.roll() as u32).collect(),
            kinds: (0..self.dice.below(70)).map(|_| format!("kind {}", self.dice.below(100))).collect(),
        };
        let frame = Frame::of_lncl(Kind::LNCL_REGISTER, Tid::NONE, &wishes);
        self.write(&mut stranger, &frame.bytes())?;
        let Some(said) = stranger.read()? else { return Ok(()) };
        if said.kind == Kind::LNCL_REFUSAL {
            self.tally.refused += 1;
            return Ok(());
        }
        let me = Tid::from_bits(said.source);
        for _ in 0..self.dice.below(400) {
            let group = if self.dice.once_in(8) { 7 } else { 0xF000_0000 | self.dice.roll() as u32 };
            let membership = Membership { group, member: !self.dice.once_in(4) };
            let frame = if self.dice.once_in(2) {
                Frame::of_lncl(Kind::LNCL_GROUP, me, &membership)
            } else {
                Frame::of_lncl(Kind::LNCL_RESOLVE, me, &Name { name: "witness".repeat(3) })
            };
            self.write(&mut stranger, &frame.bytes())?;
        }
        self.listen(&mut stranger)
    }

    /// Joins groups and leaves them again, as fast as it can write.
    fn restless(&mut self) -> io::Result<()> {
        let mut stranger = self.register()?;
        let end = Instant::now() + TRICK;
        for step in (0..100_000_u32).take_while(|_| Instant::now() < end) {
            let membership = Membership { group: 0xF000_0000 | (step / 2 % 256), member: step % 2 == 0 };
            let frame = Frame::of_lncl(Kind::LNCL_GROUP, stranger.tid, &membership);
            self.write(&mut stranger, &frame.bytes())?;
        }
        self.listen(&mut stranger)
    }

    /// Messages for nobody as fast as the node takes them, a thousand with each call; reads nothing.
    fn torrent(&mut self) -> io::Result<()> {
        const CALL_BYTES: usize = 64 * 1024;
        let mut stranger = self.register()?;
        let nobody = Tid::new(stranger.tid.node, NOBODY);
        let frame = Frame::new(&self.header(stranger.tid, nobody), Vec::new()).bytes();
        let frames = frame.repeat(CALL_BYTES / frame.len());
        let end = Instant::now() + TRICK;
        while Instant::now() < end {
            self.write(&mut stranger, &frames)?;
        }
        Ok(())
    }

    /// Messages before the barrier has opened; it waits for one who never comes.
    fn too_early(&mut self) -> io::Result<()> {
        let mut stranger = self.connect()?;
        let wishes = Wishes {
            name: None,
            address: None,
            requires: vec!["nobody".to_owned()],
            events: Vec::new(),
            kinds: Vec::new(),
        };
        let frame = Frame::of_lncl(Kind::LNCL_REGISTER, Tid::NONE, &wishes);
        self.write(&mut stranger, &frame.bytes())?;
        let header = self.header(Tid::NONE, Tid::BROADCAST);
        self.write(&mut stranger, &Frame::new(&header, Vec::new()).bytes())?;
        self.listen(&mut stranger)
    }

    /// Says what became of messages that it never had, or not like this.
    fn false_outcomes(&mut self) -> io::Result<()> {
        let mut stranger = self.register()?;
        for _ in 0..1 + self.dice.below(100) {
            let to = self.anybody(stranger.tid);
            let mut header = Header::new(Kind::OUTCOME, stranger.tid, to);
            header.flags = Flags::OUTCOME;
            header.correlation = u64::from(self.dice.below(50));
            let code = if self.dice.once_in(64) { 99 } else { self.dice.below(5) as u8 };
            self.write(&mut stranger, &Frame::new(&header, vec![code]).bytes())?;
        }
        self.listen(&mut stranger)
    }

    fn join_ring(&mut self) -> io::Result<HostileRing> {
        self.tally.connections += 1;
        let ring = HostileRing::join(&self.socket)?;
        self.tally.rings += 1;
        Ok(ring)
    }

    /// Frames through a ring, and lies about the ring between them.
    fn lying_ring(&mut self) -> io::Result<()> {
        let mut ring = self.join_ring()?;
        // Of so many steps one is a lie; the others lead deeper into what an honest client may do.
        let truths = [1, 4, 32, 1_000][self.dice.below(4) as usize];
        let end = Instant::now() + TRICK;
        for _ in (0..500).take_while(|_| Instant::now() < end) {
            if self.dice.once_in(truths) {
                ring.lie(&mut self.dice)?;
                self.tally.lies += 1;
                continue;
            }
            let me = ring.stranger.tid;
            let source = if self.dice.once_in(16) { self.anybody(me) } else { me };
            let to = self.anybody(me);
            let length = self.dice.below(2_000) as usize;
            let frame = Frame::new(&self.header(source, to), self.dice.bytes(length)).bytes();
            let cut = if self.dice.once_in(16) { self.dice.below(60) as usize } else { frame.len() };
            // In one piece, or in two.
            let taken =
                ring.publish(&frame[..cut])? && (cut == frame.len() || ring.publish(&frame[cut..])?);
            self.tally.bytes += if taken { frame.len() as u64 } else { 0 };
            if !taken {
                thread::sleep(Duration::from_millis(1));
            }
            if self.dice.once_in(4) {
                ring.take()?;
            }
        }
        Ok(())
    }

    /// Asks through a ring, and takes no answer from the other one.
    fn deaf_ring(&mut self) -> io::Result<()> {
        let mut ring = self.join_ring()?;
        let me = ring.stranger.tid;
        let length = self.dice.below(4_000) as usize;
        let to_me = Frame::new(&self.header(me, me), self.dice.bytes(length)).bytes();
        let end = Instant::now() + TRICK;
        for _ in (0..500).take_while(|_| Instant::now() < end) {
            if ring.publish(&to_me)? {
                self.tally.bytes += to_me.len() as u64;
            } else {
                thread::sleep(Duration::from_micros(100));
            }
        }
        thread::sleep(self.dice.time_below(Duration::from_millis(200)));
        Ok(())
    }

    /// What is no offer, where an offer is expected; or none.
    fn odd_offers(&mut self) -> io::Result<()> {
        self.tally.connections += 1;
        let (mut stranger, theirs, _) = ask_for_rings(&self.socket)?;
        let mut bytes = theirs.to_bytes().to_vec();
        match self.dice.below(4) {
            // Its own memory, back.
            0 => return theirs.send(&stranger.stream).map_err(io::Error::other),
            1 => {
                let at = self.dice.below(24) as usize;
                bytes[at] = self.dice.roll() as u8;
            }
            2 => bytes.truncate(self.dice.below(24) as usize + 1),
            _ => {}
        }
        let descriptors: io::Result<Vec<_>> =
            (0..1 + self.dice.below(6)).map(|_| self.odd_descriptor(&stranger)).collect();
        stranger.pass(&bytes, &descriptors?)?;
        self.listen(&mut stranger)
    }

    /// The node's own application.
    fn witness(&mut self, stranger: &mut Stranger) -> io::Result<Tid> {
        self.resolve(stranger, crate::clients::door::WITNESS)
    }

    fn resolve(&mut self, stranger: &mut Stranger, name: &str) -> io::Result<Tid> {
        let name = Name { name: name.to_owned() };
        let question = Frame::of_lncl(Kind::LNCL_RESOLVE, stranger.tid, &name);
        self.write(stranger, &question.bytes())?;
        let said = stranger.read()?.ok_or(io::ErrorKind::UnexpectedEof)?;
        // The map ends with the 64 bits.
        let bits = said.payload.last_chunk().map_or(0, |bits| u64::from_be_bytes(*bits));
        Ok(Tid::from_bits(bits))
    }

    /// Somebody who is there, or was, or never will be; a group, everybody, a layer, another node.
    fn anybody(&mut self, me: Tid) -> Tid {
        let node = if self.dice.once_in(8) { NodeAddress::new(self.dice.roll() as u32) } else { me.node };
        let app = match self.dice.below(6) {
            0 => AppAddress::new(self.dice.roll() as u32),
            1 => AppAddress::new(self.dice.below(6)),
            2 => AppAddress::ALL,
            3 => AppAddress::group("clerks"),
            _ => AppAddress::dynamic(self.dice.below(16)).unwrap_or(AppAddress::LNCL),
        };
        Tid::new(node, app)
    }
}

/// The correlation of a forged message: what is refused with it was refused because of its source.
const FORGED: u64 = 0x0F0F_0666;
/// A fixed address that nobody asks for.
const NOBODY: AppAddress = AppAddress::new(0x7FFF_FFFF);
