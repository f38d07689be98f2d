//! The attacks of a hostile client on a node, one trick after the other.

mod links;
mod meetings;
mod rings;
mod slow_close;

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

use super::raw_connection::{Frame, RawConnection};
use sinew_testkit::{random::SeededRandom, scripted::Order};

payload!("hostile.registration" => struct Wishes {
    name: Option<String>,
    address: Option<u32>,
    requires: Vec<String>,
    events: Vec<u32>,
    kinds: Vec<String>,
});
payload!("hostile.membership" => struct Membership { group: u32, member: bool });
payload!("hostile.name" => struct Name { name: String });

/// The counters of the attacks, from the attacker's view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Tally {
    /// Tricks played.
    pub(super) tricks: u64,
    /// Connections opened.
    pub(super) connections: u64,
    /// Bytes that the node accepted.
    pub(super) bytes: u64,
    /// Refusals reported by the node.
    pub(super) refused: u64,
    /// Links with rings.
    pub(super) rings: u64,
    /// Writes into ring memory that an honest client never makes.
    pub(super) lies: u64,
    /// Direct links with other processes.
    pub(super) links: u64,
    /// Descriptors that block on close, and were passed.
    pub(super) slow_closes: u64,
    /// Those of them that the system did not refuse.
    pub(super) slow_closes_sent: u64,
}

impl Tally {
    /// Returns whether something of each kind was done. The selection is random, and the amount depends on
    /// the machine.
    pub(super) fn has_all_sorts(&self) -> bool {
        [self.refused, self.rings, self.lies, self.links, self.slow_closes].iter().all(|done| *done > 0)
    }
}

/// A hostile client of the node at a socket.
pub(super) struct Attacker {
    socket: PathBuf,
    random: SeededRandom,
    /// The port of the keeper, which holds the other ends of descriptors that block on close.
    keeper: u16,
    /// Connections that stay silent, in mid-frame or before the first frame.
    silent: Vec<RawConnection>,
    pub(super) tally: Tally,
}

type Trick = fn(&mut Attacker) -> io::Result<()>;

/// Maximum duration of a trick; each of its calls has its own timeout.
const TRICK: Duration = Duration::from_millis(500);
/// Maximum number of connections kept in mid-frame.
const SILENT_MAX: usize = 16;

impl Attacker {
    pub(super) fn new(socket: &Path, random: SeededRandom, keeper: u16) -> Self {
        Self { socket: socket.to_owned(), random, keeper, silent: Vec::new(), tally: Tally::default() }
    }

    /// Plays one trick. Answers of the node, or a closed connection, are no errors.
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
            Attacker::slow_close_before_registration,
            Attacker::slow_close_beside_frame,
            Attacker::slow_close_on_bell,
            Attacker::slow_close_on_link,
            Attacker::slow_close_as_offer,
            Attacker::slow_close_in_copies,
            Attacker::slow_close_without_rings,
            Attacker::slow_close_while_meeting,
        ];
        self.tally.tricks += 1;
        let trick = TRICKS[self.random.below(TRICKS.len() as u32) as usize];
        // The node may close the connection at any point of a trick, and sometimes has no free slot.
        let _ = trick(self);
    }

    fn connect(&mut self) -> io::Result<RawConnection> {
        self.tally.connections += 1;
        RawConnection::connect(&self.socket)
    }

    fn register(&mut self) -> io::Result<RawConnection> {
        self.tally.connections += 1;
        let registered = RawConnection::register(&self.socket)?;
        if registered.is_none() {
            self.tally.refused += 1;
        }
        registered.ok_or_else(|| io::ErrorKind::ConnectionRefused.into())
    }

    fn write(&mut self, connection: &mut RawConnection, bytes: &[u8]) -> io::Result<()> {
        connection.write(bytes)?;
        self.tally.bytes += bytes.len() as u64;
        Ok(())
    }

    /// Reads everything from the node, and counts refusals: of the connection, and of messages.
    fn listen(&mut self, connection: &mut RawConnection) -> io::Result<()> {
        // After its last frame the node closes, too.
        connection.stream.shutdown(Shutdown::Write)?;
        let forged = Outcome::Rejected(Rejection::ForgedSource).code();
        while let Some(answer) = connection.read()? {
            let is_refused = answer.kind == Kind::LNCL_REFUSAL
                || answer.kind == Kind::OUTCOME && answer.payload == [forged] && answer.correlation == FORGED;
            self.tally.refused += u64::from(is_refused);
        }
        Ok(())
    }

    fn header(&mut self, source: Tid, destination: Tid) -> Header {
        let mut header = Header::new(Order::KIND, source, destination);
        header.class = [Class::Control, Class::Stream, Class::Bulk][self.random.below(3) as usize];
        header
    }

    /// Random bytes, before and after a registration.
    fn garbage(&mut self) -> io::Result<()> {
        let mut connection = if self.random.once_in(2) { self.connect()? } else { self.register()? };
        for _ in 0..1 + self.random.below(4) {
            let length = 1 + self.random.below(4_096) as usize;
            let bytes = self.random.bytes(length);
            self.write(&mut connection, &bytes)?;
        }
        self.listen(&mut connection)
    }

    /// Frames with some changed bytes; most have a valid checksum.
    fn mutants(&mut self) -> io::Result<()> {
        let mut connection = self.register()?;
        for _ in 0..1 + self.random.below(32) {
            let to = self.any_address(connection.tid);
            let header = self.header(connection.tid, to);
            let length = self.random.below(200) as usize;
            let mut frame = Frame::new(&header, self.random.bytes(length));
            for _ in 0..self.random.below(4) {
                // Magic and version mostly stay valid; otherwise the code behind them is not reached.
                let at =
                    if self.random.once_in(16) { self.random.below(60) } else { 4 + self.random.below(56) };
                frame.header[at as usize] = self.random.number() as u8;
            }
            if !self.random.once_in(4) {
                frame = frame.sealed();
            }
            self.write(&mut connection, &frame.bytes())?;
        }
        self.listen(&mut connection)
    }

    /// Messages with forged sources.
    fn forged_sources(&mut self) -> io::Result<()> {
        let mut connection = self.register()?;
        for _ in 0..1 + self.random.below(64) {
            let source = self.any_address(connection.tid);
            let destination = self.any_address(connection.tid);
            let mut header = self.header(source, destination);
            header.class = Class::Control;
            header.flags = Flags::CONFIRM;
            header.correlation = FORGED;
            let payload = encode(&Order { number: 666 }).to_vec();
            self.write(&mut connection, &Frame::new(&header, payload).bytes())?;
        }
        self.listen(&mut connection)
    }

    /// Unrequested descriptors, in places where the node might receive them and in others.
    fn odd_descriptors(&mut self) -> io::Result<()> {
        let mut connection = if self.random.once_in(3) { self.connect()? } else { self.register()? };
        for _ in 0..1 + self.random.below(6) {
            let descriptors: io::Result<Vec<_>> =
                (0..1 + self.random.below(6)).map(|_| self.odd_descriptor(&connection)).collect();
            let bytes = match self.random.below(3) {
                0 => [&b"SINEWSHM"[..], &self.random.bytes(16)].concat(),
                1 => Frame::of_lncl(Kind::LNCL_REGISTER, Tid::NONE, &Name { name: "x".to_owned() }).bytes(),
                _ => self.random.bytes(24),
            };
            connection.pass(&bytes, &descriptors?)?;
        }
        self.listen(&mut connection)
    }

    fn odd_descriptor(&mut self, connection: &RawConnection) -> io::Result<OwnedFd> {
        Ok(match self.random.below(6) {
            0 => File::open("/dev/zero")?.into(),
            1 => File::open("/")?.into(),
            // A socket passed over itself, which keeps itself alive.
            2 => connection.stream.try_clone()?.into(),
            3 => self.connect()?.stream.into(),
            4 => memfd_create("odd", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?,
            _ => {
                let memory = memfd_create("odd", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?;
                rustix::fs::ftruncate(&memory, u64::from(self.random.below(1 << 20)))?;
                memory
            }
        })
    }

    /// Sends requests and never reads an answer. Messages to itself return to it.
    fn deaf(&mut self) -> io::Result<()> {
        let mut connection = self.register()?;
        let witness = self.witness(&mut connection)?;
        let length = self.random.below(16_000) as usize;
        let for_me = Frame::new(&self.header(connection.tid, connection.tid), self.random.bytes(length));
        let end = Instant::now() + TRICK;
        for number in (0..2_000).take_while(|_| Instant::now() < end) {
            let mut header = Header::new(Order::KIND, connection.tid, witness);
            header.flags = Flags::ASK.with(Flags::CONFIRM);
            header.correlation = number;
            let payload = encode(&Order { number }).to_vec();
            self.write(&mut connection, &Frame::new(&header, payload).bytes())?;
            self.write(&mut connection, &for_me.bytes())?;
        }
        thread::sleep(self.random.time_below(Duration::from_millis(200)));
        Ok(())
    }

    /// More addresses than one process may have, and more connections than the node has slots.
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
        thread::sleep(self.random.time_below(Duration::from_millis(50)));
        for mut connection in crowd {
            // Connections with a slot receive nothing yet.
            connection.stream.set_nonblocking(true)?;
            let _ = self.listen(&mut connection);
        }
        Ok(())
    }

    /// Starts a frame, and sends nothing more for long.
    fn half_a_frame(&mut self) -> io::Result<()> {
        let mut connection = if self.random.once_in(2) { self.connect()? } else { self.register()? };
        let to = self.any_address(connection.tid);
        let whole = Frame::new(&self.header(connection.tid, to), self.random.bytes(1_000)).bytes();
        let some = &whole[..self.random.below(whole.len() as u32) as usize];
        self.write(&mut connection, some)?;
        if self.silent.len() >= SILENT_MAX {
            let at = self.random.below(SILENT_MAX as u32) as usize;
            self.silent.swap_remove(at);
        }
        self.silent.push(connection);
        Ok(())
    }

    /// Registrations that cannot be granted, and all other requests.
    fn wishes(&mut self) -> io::Result<()> {
        let mut connection = self.connect()?;
        let name = match self.random.below(5) {
            0 => None,
            1 => Some("echo".to_owned()),
            2 => Some("x".repeat(self.random.below(300) as usize)),
            3 => Some("\u{7}\n\u{0}".to_owned()),
            _ => Some(format!("wish {}", self.random.number())),
        };
        let wishes = Wishes {
            name,
            address: self.random.once_in(2).then(|| self.random.number() as u32),
            requires: (0..self.random.below(80) / 70 * 70).map(|number| number.to_string()).collect(),
            events: (0..self.random.below(100)).map(|_| self.random.number() as u32).collect(),
            kinds: (0..self.random.below(70)).map(|_| format!("kind {}", self.random.below(100))).collect(),
        };
        let frame = Frame::of_lncl(Kind::LNCL_REGISTER, Tid::NONE, &wishes);
        self.write(&mut connection, &frame.bytes())?;
        let Some(answer) = connection.read()? else { return Ok(()) };
        if answer.kind == Kind::LNCL_REFUSAL {
            self.tally.refused += 1;
            return Ok(());
        }
        let me = Tid::from_bits(answer.source);
        for _ in 0..self.random.below(400) {
            let group = if self.random.once_in(8) { 7 } else { 0xF000_0000 | self.random.number() as u32 };
            let membership = Membership { group, member: !self.random.once_in(4) };
            let frame = if self.random.once_in(2) {
                Frame::of_lncl(Kind::LNCL_GROUP, me, &membership)
            } else {
                Frame::of_lncl(Kind::LNCL_RESOLVE, me, &Name { name: "witness".repeat(3) })
            };
            self.write(&mut connection, &frame.bytes())?;
        }
        self.listen(&mut connection)
    }

    /// Joins and leaves groups as fast as it can write.
    fn restless(&mut self) -> io::Result<()> {
        let mut connection = self.register()?;
        let end = Instant::now() + TRICK;
        for step in (0..100_000_u32).take_while(|_| Instant::now() < end) {
            let membership = Membership { group: 0xF000_0000 | (step / 2 % 256), member: step % 2 == 0 };
            let frame = Frame::of_lncl(Kind::LNCL_GROUP, connection.tid, &membership);
            self.write(&mut connection, &frame.bytes())?;
        }
        self.listen(&mut connection)
    }

    /// Messages to an unused address as fast as the node accepts them, a thousand per call, without reading.
    fn torrent(&mut self) -> io::Result<()> {
        const CALL_BYTES: usize = 64 * 1024;
        let mut connection = self.register()?;
        let unused = Tid::new(connection.tid.node, UNUSED_ADDRESS);
        let frame = Frame::new(&self.header(connection.tid, unused), Vec::new()).bytes();
        let frames = frame.repeat(CALL_BYTES / frame.len());
        let end = Instant::now() + TRICK;
        while Instant::now() < end {
            self.write(&mut connection, &frames)?;
        }
        Ok(())
    }

    /// Messages before the barrier has opened; it waits for a party that never arrives.
    fn too_early(&mut self) -> io::Result<()> {
        let mut connection = self.connect()?;
        let wishes = Wishes {
            name: None,
            address: None,
            requires: vec!["absent".to_owned()],
            events: Vec::new(),
            kinds: Vec::new(),
        };
        let frame = Frame::of_lncl(Kind::LNCL_REGISTER, Tid::NONE, &wishes);
        self.write(&mut connection, &frame.bytes())?;
        let header = self.header(Tid::NONE, Tid::BROADCAST);
        self.write(&mut connection, &Frame::new(&header, Vec::new()).bytes())?;
        self.listen(&mut connection)
    }

    /// Reports outcomes of messages that it never received, or false ones.
    fn false_outcomes(&mut self) -> io::Result<()> {
        let mut connection = self.register()?;
        for _ in 0..1 + self.random.below(100) {
            let to = self.any_address(connection.tid);
            let mut header = Header::new(Kind::OUTCOME, connection.tid, to);
            header.flags = Flags::OUTCOME;
            header.correlation = u64::from(self.random.below(50));
            let code = if self.random.once_in(64) { 99 } else { self.random.below(5) as u8 };
            self.write(&mut connection, &Frame::new(&header, vec![code]).bytes())?;
        }
        self.listen(&mut connection)
    }

    /// The node's own application.
    fn witness(&mut self, connection: &mut RawConnection) -> io::Result<Tid> {
        self.resolve(connection, crate::clients::node::WITNESS)
    }

    fn resolve(&mut self, connection: &mut RawConnection, name: &str) -> io::Result<Tid> {
        let name = Name { name: name.to_owned() };
        let question = Frame::of_lncl(Kind::LNCL_RESOLVE, connection.tid, &name);
        self.write(connection, &question.bytes())?;
        let answer = connection.read()?.ok_or(io::ErrorKind::UnexpectedEof)?;
        // The map ends with the 64 bits.
        let bits = answer.payload.last_chunk().map_or(0, |bits| u64::from_be_bytes(*bits));
        Ok(Tid::from_bits(bits))
    }

    /// A random address: existing, former or never used; or a group, all applications, a layer, another node.
    fn any_address(&mut self, me: Tid) -> Tid {
        let node =
            if self.random.once_in(8) { NodeAddress::new(self.random.number() as u32) } else { me.node };
        let app = match self.random.below(6) {
            0 => AppAddress::new(self.random.number() as u32),
            1 => AppAddress::new(self.random.below(6)),
            2 => AppAddress::ALL,
            3 => AppAddress::group("clerks"),
            _ => AppAddress::dynamic(self.random.below(16)).unwrap_or(AppAddress::LNCL),
        };
        Tid::new(node, app)
    }
}

/// The correlation of a forged message: a refusal with it was caused by the source.
const FORGED: u64 = 0x0F0F_0666;
/// A fixed address that is never registered.
const UNUSED_ADDRESS: AppAddress = AppAddress::new(0x7FFF_FFFF);
