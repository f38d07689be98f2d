//! Introductions that nobody wants: asked for in crowds, never answered or answered falsely, switched over before they were made.

use std::{
    io, thread,
    time::{Duration, Instant},
};

use sinew::{AppAddress, NodeAddress, Outcome, Tid, message::Kind, payload};
use sinew_runtime::wire::{Flags, Header, encode};

use super::{Attacker, TRICK};
use crate::clients::hostile::{ring::HostileRing, stranger::Frame};

payload!("hostile.introduce" => struct Introduce { to: u64 });
payload!("hostile.switch" => struct Switch { peer: u64, number: u64 });

/// Others that are asked for.
const OTHERS: usize = 3;
/// Numbers of links and of questions are counted from 1: a guess below this is often right.
const NUMBERS: u32 = 200;

impl Attacker {
    /// Has itself introduced to others of its own, and to anybody; what they answer is chance.
    pub(super) fn meetings(&mut self) -> io::Result<()> {
        let mut rings = (0..=OTHERS).map(|_| self.join_ring()).collect::<io::Result<Vec<_>>>()?;
        let end = Instant::now() + TRICK;
        for _ in (0..500).take_while(|_| Instant::now() < end) {
            let me = self.dice.below(rings.len() as u32) as usize;
            let peer = rings[self.dice.below(rings.len() as u32) as usize].stranger.tid;
            let said = self.one_of_a_meeting(rings[me].stranger.tid, peer);
            if !rings[me].publish(&said.bytes())? {
                thread::sleep(Duration::from_millis(1));
            }
            if self.dice.once_in(4) {
                rings[me].take()?;
            }
        }
        // Whoever was asked goes without an answer, all at once or after a while.
        thread::sleep(self.dice.time_below(Duration::from_millis(200)));
        rings.drain(..).for_each(drop::<HostileRing>);
        Ok(())
    }

    fn one_of_a_meeting(&mut self, me: Tid, peer: Tid) -> Frame {
        let lncl = Tid::new(NodeAddress::HERE, AppAddress::LNCL);
        let to = if self.dice.once_in(4) { self.anybody(me) } else { peer };
        let number = u64::from(self.dice.below(NUMBERS));
        let (kind, payload) = match self.dice.below(8) {
            0..4 => (Kind::LNCL_INTRODUCE, encode(&Introduce { to: to.bits() })),
            4 => (Kind::LNCL_SWITCH, encode(&Switch { peer: to.bits(), number })),
            // What only the node says.
            5 => (Kind::LNCL_INTRODUCED, encode(&Switch { peer: to.bits(), number })),
            6 => (Kind::LNCL_INTRODUCE, self.dice.bytes(20).into()),
            _ => (Kind::OUTCOME, vec![Outcome::Delivered.code()].into()),
        };
        let mut header = Header::new(kind, me, lncl);
        header.correlation = number;
        header.flags = if kind == Kind::OUTCOME { Flags::OUTCOME } else { Flags::CONFIRM };
        Frame::new(&header, payload.to_vec())
    }
}
