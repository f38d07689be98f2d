//! The hostile end of rings, connected to the node or to another process. It writes arbitrary data into all
//! memory that it may write. The layout is in `docs/decisions/0010-shared-memory.md`.

use std::{
    io,
    ops::{Deref, DerefMut},
    os::{
        fd::{AsFd, OwnedFd},
        unix::net::UnixStream,
    },
    path::Path,
};

use rustix::{
    fs::{FallocateFlags, fallocate, ftruncate},
    io::{pread, pwrite},
    net::{SendFlags, send},
};
use sinew::{Tid, message::Kind, payload};
use sinew_runtime::wire::decode;
use sinew_shm::{BellKind, Capacity, Offer, Producer, Region, Terms};

use super::raw_connection::{Frame, RawConnection};
use sinew_testkit::random::SeededRandom;

payload!("hostile.ring" => struct WithRing { ring: bool, direct: bool });

/// The fields of the node's answer that are used.
#[derive(serde::Deserialize)]
struct Answer {
    #[serde(default)]
    ring: Option<u32>,
}

/// Word offsets in a region.
const TAIL: u32 = 128 / 4;
const HEAD: u32 = 256 / 4;
const SLEEPS: [u32; 2] = [384 / 4, 512 / 4];
const HEADER_BYTES: u32 = 4096;
const MESSAGE: u32 = 0xDA7A_0001;
const SKIP: [u32; 2] = [0, 0x5C1B_0002];

/// A link with a node that has offered its memory.
pub(super) struct HostileRing {
    pub(super) connection: RawConnection,
    end: RingEnd,
}

/// One end of a pair of rings. The peer has offered its memory.
pub(super) struct RingEnd {
    capacity: u32,
    region: Region,
    /// The memory and the bells offered by the peer.
    victim: Offer,
    /// Wakes a peer that sleeps on a futex.
    ringer: Option<Producer>,
    /// A second descriptor of the own memory, used for operations that the seals must forbid.
    key: OwnedFd,
    tail: u32,
}

/// Registers and requests rings. Returns the length of a ring.
pub(super) fn ask_for_rings(socket: &Path) -> io::Result<(RawConnection, Offer, Capacity)> {
    let mut connection = RawConnection::connect(socket)?;
    let wish = Frame::of_lncl(Kind::LNCL_REGISTER, Tid::NONE, &WithRing { ring: true, direct: true });
    connection.write(&wish.bytes())?;
    let frame = connection.read()?.ok_or(io::ErrorKind::UnexpectedEof)?;
    connection.tid = Tid::from_bits(frame.source);
    let answer: Answer = decode(&frame.payload).map_err(io::Error::other)?;
    // A refusal has no such field, and neither has the answer of a node without rings.
    let bytes = answer.ring.ok_or(io::ErrorKind::Unsupported)?;
    let capacity = Capacity::new(u64::from(bytes).next_power_of_two()).map_err(io::Error::other)?;
    let offer = Offer::receive(&connection.stream).map_err(io::Error::other)?.map_err(io::Error::other)?;
    Ok((connection, offer, capacity))
}

impl HostileRing {
    /// Sets up a link as an honest client does.
    pub(super) fn join(socket: &Path) -> io::Result<Self> {
        let (connection, victim, capacity) = ask_for_rings(socket)?;
        let end = RingEnd::offer(&connection.stream, victim, capacity, BellKind::Socket)?;
        Ok(Self { connection, end })
    }
}

impl Deref for HostileRing {
    type Target = RingEnd;

    fn deref(&self) -> &RingEnd {
        &self.end
    }
}

impl DerefMut for HostileRing {
    fn deref_mut(&mut self) -> &mut RingEnd {
        &mut self.end
    }
}

impl RingEnd {
    /// Offers own memory over `socket` to the peer that has offered `victim`.
    pub(super) fn offer(
        socket: impl AsFd,
        victim: Offer,
        capacity: Capacity,
        bell: BellKind,
    ) -> io::Result<Self> {
        let (region, offer) = Region::create(capacity, bell).map_err(io::Error::other)?;
        let key = offer.descriptors()[0].try_clone()?;
        offer.send(socket).map_err(io::Error::other)?;
        Self::of(region, key, victim, capacity)
    }

    /// The end with `region` as its own memory, which has been offered, and with a second descriptor of it.
    pub(super) fn of(region: Region, key: OwnedFd, victim: Offer, capacity: Capacity) -> io::Result<Self> {
        let ringer = ringer(&victim)?;
        Ok(Self { capacity: capacity.bytes(), region, victim, ringer, key, tail: 0 })
    }

    /// Maximum length of a record written by an honest side, in bytes.
    pub(super) const fn record_max(&self) -> usize {
        self.capacity as usize / 2 - 8
    }

    /// Reads a word of the peer's memory.
    fn read_word(&self, place: u32) -> io::Result<u32> {
        let mut word = [0; 4];
        pread(&self.victim.descriptors()[0], &mut word, u64::from(place * 4))?;
        Ok(u32::from_le_bytes(word))
    }

    fn put_mark(&mut self, position: u32, mark: [u32; 2]) {
        let place = (HEADER_BYTES + position % self.capacity) / 4;
        self.region.scribble(place, mark[0]);
        self.region.scribble(place + 1, mark[1]);
    }

    /// Publishes a record as an honest client does; `false` if the peer has not consumed enough yet.
    pub(super) fn publish(&mut self, bytes: &[u8]) -> io::Result<bool> {
        let length = u32::try_from(bytes.len()).map_err(io::Error::other)?;
        let record = 8 + length.next_multiple_of(8);
        let rest = self.capacity - self.tail % self.capacity;
        let skip = if record > rest { rest } else { 0 };
        let untaken = self.tail.wrapping_sub(self.read_word(HEAD)?);
        if untaken.saturating_add(skip + record) > self.capacity {
            return Ok(false);
        }
        if skip > 0 {
            self.put_mark(self.tail, SKIP);
        }
        let start = self.tail.wrapping_add(skip);
        for (word, chunk) in (0..).zip(bytes.chunks(4)) {
            let place = (HEADER_BYTES + start % self.capacity) / 4 + 2 + word;
            let value = chunk.iter().rev().fold(0, |value, byte| value << 8 | u32::from(*byte));
            self.region.scribble(place, value);
        }
        self.put_mark(start, [length, MESSAGE]);
        self.tail = start.wrapping_add(record);
        // Without memory ordering: earlier writes may become visible later. A hostile client does not care.
        self.region.scribble(TAIL, self.tail);
        self.press(1)?;
        Ok(true)
    }

    /// Consumes everything that the peer has published, without reading it.
    pub(super) fn take(&mut self) -> io::Result<()> {
        let head = self.read_word(TAIL)?;
        self.region.scribble(HEAD, head);
        self.press(2)
    }

    /// Returns whether the peer's bells are sockets.
    pub(super) fn has_bells(&self) -> bool {
        self.victim.bell() == BellKind::Socket
    }

    /// The socket of the peer's bell with number `bell`, from 1 on.
    pub(super) fn bell(&self, bell: usize) -> io::Result<UnixStream> {
        Ok(self.victim.descriptors()[bell].try_clone()?.into())
    }

    /// Rings one of the peer's bells.
    fn press(&self, bell: usize) -> io::Result<()> {
        if let Some(ringer) = &self.ringer {
            ringer.ring();
            return Ok(());
        }
        let Some(button) = self.victim.descriptors().get(bell) else { return Ok(()) };
        match send(button, &[1], SendFlags::DONTWAIT | SendFlags::NOSIGNAL) {
            // The bell has been rung often enough.
            Ok(_) | Err(rustix::io::Errno::AGAIN) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Does one thing that an honest client never does.
    pub(super) fn lie(&mut self, random: &mut SeededRandom) -> io::Result<()> {
        let (value, small) = (random.number() as u32, random.below(600));
        match random.below(11) {
            0 => self.region.scribble(TAIL, value),
            1 => self.region.scribble(HEAD, value),
            2 => self.region.scribble(TAIL, self.tail.wrapping_add(small)),
            3 => self.put_mark(self.tail, [value, MESSAGE]),
            4 => self.put_mark(self.read_word(HEAD)?, [small, MESSAGE]),
            5 => self.put_mark(self.read_word(HEAD)?, SKIP),
            6 => self.region.scribble(SLEEPS[small as usize % 2], value),
            7 => (0..small).try_for_each(|_| self.press(1 + small as usize % 2))?,
            8 => self.try_the_keys(value),
            9 => self.forge_bells(value, small)?,
            // Any place: bytes of some message, possibly while they are read.
            _ => self.region.scribble(value, random.number() as u32),
        }
        self.press(1 + small as usize % 2)
    }

    /// Changes counters on the page of a futex without ringing.
    fn forge_bells(&self, value: u32, small: u32) -> io::Result<()> {
        if self.ringer.is_some() {
            let (page, word) = (&self.victim.descriptors()[1], small % 64);
            pwrite(page, &value.to_le_bytes(), u64::from(4 * word))?;
        }
        Ok(())
    }

    /// Tries operations that the seals must forbid.
    fn try_the_keys(&self, value: u32) {
        for key in [&self.key, &self.victim.descriptors()[0]] {
            let hole = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
            let refused = [
                ftruncate(key, u64::from(value % 8192)).is_err(),
                fallocate(key, hole, 0, 4096).is_err(),
                pwrite(key, &value.to_ne_bytes(), u64::from(value % 4096)).is_err(),
            ];
            assert_eq!(refused, [true; 3], "a sealed memory lets nothing through");
        }
    }
}

/// Wakes the process that has made this offer if it sleeps on a futex. This requires a mapping of its page.
fn ringer(victim: &Offer) -> io::Result<Option<Producer>> {
    if victim.bell() != BellKind::Futex {
        return Ok(None);
    }
    let descriptors: io::Result<Vec<_>> = victim.descriptors().iter().map(OwnedFd::try_clone).collect();
    let copy = Offer::from_parts(&victim.to_bytes(), descriptors?).map_err(io::Error::other)?;
    let (spare, _) = Region::create(Capacity::MIN, BellKind::Futex).map_err(io::Error::other)?;
    let (producer, _) = spare.connect(copy, &Terms::default()).map_err(io::Error::other)?;
    Ok(Some(producer))
}
