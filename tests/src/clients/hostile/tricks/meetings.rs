//! Unwanted link requests: sent in large numbers, never answered or answered falsely, switched over before
//! they are established.

use std::{
    io, thread,
    time::{Duration, Instant},
};

use sinew::{AppAddress, NodeAddress, Outcome, Tid, message::Kind, payload};
use sinew_runtime::wire::{Flags, Header, encode};

use super::{Attacker, TRICK};
use crate::clients::hostile::{raw_connection::Frame, ring::HostileRing};

payload!("hostile.introduce" => struct Introduce { to: u64 });
payload!("hostile.switch" => struct Switch { peer: u64, number: u64 });

/// Number of peers that are requested.
const OTHERS: usize = 3;
/// Numbers of links and of requests are counted from 1: a guess below this is often right.
const NUMBERS: u32 = 200;

impl Attacker {
    /// Requests links with its own clients and with random addresses; the answers are random.
    pub(super) fn meetings(&mut self) -> io::Result<()> {
        let mut rings = (0..=OTHERS).map(|_| self.join_ring()).collect::<io::Result<Vec<_>>>()?;
        let end = Instant::now() + TRICK;
        for _ in (0..500).take_while(|_| Instant::now() < end) {
            let me = self.random.below(rings.len() as u32) as usize;
            let peer = rings[self.random.below(rings.len() as u32) as usize].connection.tid;
            let frame = self.one_of_a_meeting(rings[me].connection.tid, peer);
            if !rings[me].publish(&frame.bytes())? {
                thread::sleep(Duration::from_millis(1));
            }
            if self.random.once_in(4) {
                rings[me].take()?;
            }
        }
        // The requested clients get no answer: the requesters disconnect at once or after a while.
        thread::sleep(self.random.time_below(Duration::from_millis(200)));
        rings.drain(..).for_each(drop::<HostileRing>);
        Ok(())
    }

    fn one_of_a_meeting(&mut self, me: Tid, peer: Tid) -> Frame {
        let lncl = Tid::new(NodeAddress::HERE, AppAddress::LNCL);
        let to = if self.random.once_in(4) { self.any_address(me) } else { peer };
        let number = u64::from(self.random.below(NUMBERS));
        let (kind, payload) = match self.random.below(8) {
            0..4 => (Kind::LNCL_INTRODUCE, encode(&Introduce { to: to.bits() })),
            4 => (Kind::LNCL_SWITCH, encode(&Switch { peer: to.bits(), number })),
            // A frame that only the node sends.
            5 => (Kind::LNCL_INTRODUCED, encode(&Switch { peer: to.bits(), number })),
            6 => (Kind::LNCL_INTRODUCE, self.random.bytes(20).into()),
            _ => (Kind::OUTCOME, vec![Outcome::Delivered.code()].into()),
        };
        let mut header = Header::new(kind, me, lncl);
        header.correlation = number;
        header.flags = if kind == Kind::OUTCOME { Flags::OUTCOME } else { Flags::CONFIRM };
        Frame::new(&header, payload.to_vec())
    }
}
