//! What became of the confirmed message whose answer is waited for, when the link on which it went has ended before that.
//!
//! That a link has ended says nothing of who was at its other end: he may have come back under another address, or this side has ended it
//! itself, and what lies in the ring is handled yet. Only the node knows that a process has ended.

use super::*;

/// Time that the node has to say that the peer's process has ended, once its link has. What it has not said by then nobody knows.
pub(in crate::client) const GONE_WITHIN: Duration = NAP;

/// A message that went on a link, and whose answer is waited for.
pub(in crate::client) struct Errand {
    peer: Tid,
    number: LinkNumber,
    writer: Arc<ring::Writer>,
    /// How much had been written before it; `None` where it was written in place.
    before: Option<u32>,
    /// The node has said that the peer's process has ended.
    is_dead: bool,
}

/// What is known of a message.
#[derive(Debug)]
pub(in crate::client) enum Fate {
    /// Its link stands: the answer may come.
    Open,
    /// Its link has ended.
    Unsaid,
    /// Its link has ended, and the peer's process.
    Known(Outcome),
}

impl Errand {
    // spec: LNCL-7, as the node says it of its own links.
    fn outcome(&self) -> Outcome {
        let (Some(before), Some(taken)) = (self.before, self.writer.taken_so_far()) else {
            return Outcome::Failed;
        };
        // The counts wrap, and a ring is far shorter than half of what they count.
        let is_taken = (1..1 << 31).contains(&taken.wrapping_sub(before));
        if is_taken { Outcome::Failed } else { Outcome::Rejected(Rejection::Closed) }
    }
}

impl Direct {
    /// The message that is about to be sent on this link.
    pub(in crate::client) fn errand(&mut self, number: LinkNumber) -> Option<Errand> {
        let link = self.standing(number)?;
        let (peer, writer) = (link.peer, link.writer.clone());
        let before = writer.published();
        Some(Errand { peer, number, writer, before, is_dead: false })
    }

    /// That message, whose answer is waited for from now on; `None`: none is.
    pub(in crate::client) fn awaits(&mut self, errand: Option<Errand>) {
        self.errand = errand;
    }

    /// What is known of the message that went on this link.
    pub(in crate::client) fn fate(&self, number: LinkNumber) -> Fate {
        if self.has(number) {
            return Fate::Open;
        }
        let errand = self.errand.as_ref().filter(|errand| errand.number == number && errand.is_dead);
        errand.map_or(Fate::Unsaid, |errand| Fate::Known(errand.outcome()))
    }

    /// The process at the other end of this link has ended.
    pub(super) fn is_dead(&mut self, peer: Tid, number: LinkNumber) {
        if let Some(errand) = &mut self.errand
            && (errand.peer, errand.number) == (peer, number)
        {
            errand.is_dead = true;
        }
    }
}
