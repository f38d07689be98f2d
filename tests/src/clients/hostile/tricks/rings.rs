//! The hostile end of a link with rings: lies in their memory, rings that are never read, and false offers.

use std::{
    io, thread,
    time::{Duration, Instant},
};

use super::{Attacker, TRICK};
use crate::clients::hostile::{
    raw_connection::Frame,
    ring::{HostileRing, ask_for_rings},
};

impl Attacker {
    pub(super) fn join_ring(&mut self) -> io::Result<HostileRing> {
        self.tally.connections += 1;
        let ring = HostileRing::join(&self.socket)?;
        self.tally.rings += 1;
        Ok(ring)
    }

    /// Sends frames through a ring, and corrupts the ring between them.
    pub(super) fn lying_ring(&mut self) -> io::Result<()> {
        let mut ring = self.join_ring()?;
        // One of this many steps is a lie; the other steps lead deeper into valid client behaviour.
        let truths = [1, 4, 32, 1_000][self.random.below(4) as usize];
        let end = Instant::now() + TRICK;
        for _ in (0..500).take_while(|_| Instant::now() < end) {
            if self.random.once_in(truths) {
                ring.lie(&mut self.random)?;
                self.tally.lies += 1;
                continue;
            }
            let me = ring.connection.tid;
            let source = if self.random.once_in(16) { self.any_address(me) } else { me };
            let to = self.any_address(me);
            let length = self.random.below(2_000) as usize;
            let frame = Frame::new(&self.header(source, to), self.random.bytes(length)).bytes();
            let cut = if self.random.once_in(16) { self.random.below(60) as usize } else { frame.len() };
            // In one piece, or in two.
            let taken =
                ring.publish(&frame[..cut])? && (cut == frame.len() || ring.publish(&frame[cut..])?);
            self.tally.bytes += if taken { frame.len() as u64 } else { 0 };
            if !taken {
                thread::sleep(Duration::from_millis(1));
            }
            if self.random.once_in(4) {
                ring.take()?;
            }
        }
        Ok(())
    }

    /// Sends requests through a ring, and reads no answer from the other one.
    pub(super) fn deaf_ring(&mut self) -> io::Result<()> {
        let mut ring = self.join_ring()?;
        let me = ring.connection.tid;
        let length = self.random.below(4_000) as usize;
        let to_me = Frame::new(&self.header(me, me), self.random.bytes(length)).bytes();
        let end = Instant::now() + TRICK;
        for _ in (0..500).take_while(|_| Instant::now() < end) {
            if ring.publish(&to_me)? {
                self.tally.bytes += to_me.len() as u64;
            } else {
                thread::sleep(Duration::from_micros(100));
            }
        }
        thread::sleep(self.random.time_below(Duration::from_millis(200)));
        Ok(())
    }

    /// An invalid offer in place of an offer, or none.
    pub(super) fn odd_offers(&mut self) -> io::Result<()> {
        self.tally.connections += 1;
        let (mut connection, theirs, _) = ask_for_rings(&self.socket)?;
        let mut bytes = theirs.to_bytes().to_vec();
        match self.random.below(4) {
            // The node's own memory, sent back.
            0 => return theirs.send(&connection.stream).map_err(io::Error::other),
            1 => {
                let at = self.random.below(24) as usize;
                bytes[at] = self.random.number() as u8;
            }
            2 => bytes.truncate(self.random.below(24) as usize + 1),
            _ => {}
        }
        let descriptors: io::Result<Vec<_>> =
            (0..1 + self.random.below(6)).map(|_| self.odd_descriptor(&connection)).collect();
        connection.pass(&bytes, &descriptors?)?;
        self.listen(&mut connection)
    }
}
