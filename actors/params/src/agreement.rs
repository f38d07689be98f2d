//! One participant's part in the agreement on a transaction. Pure: times are arguments.
//!
//! Each participant sends its acceptance to those before it in the list, which answer by their own, and repeats it to
//! all. One that has the acceptances of all in the first half of the lead knows that the transaction is agreed on, and
//! says so to all others; so does each one that learns it. In the second half the others ask for the result. No
//! coordinator is needed for that. A participant that does not know the result at the stated time applies nothing, and
//! asks for [`DOUBT_WITHIN`] more.
//! `docs/decisions/0053-parameter-transactions.md` has the failure cases.

use std::{
    collections::{BTreeMap, VecDeque},
    time::Duration,
};

use crate::{ParameterTransaction, ParameterVote, Participant, Stance, TransactionId};

/// Maximum number of applications in a transaction: each one sends to each other one.
pub const PARTICIPANTS_MAX: usize = 16;
/// The usual time from the begin of a transaction to its stated time. Half of it is many times the delay of a message
/// in a robot, also beside a loaded loop.
pub const LEAD: Duration = Duration::from_millis(250);
/// Minimum of that time: below, a late wake of one thread is enough for a failure.
pub const LEAD_MIN: Duration = Duration::from_millis(20);
/// Maximum of that time: as long, the parameters of the participants take no other set.
pub const LEAD_MAX: Duration = Duration::from_secs(2);
/// How long after the stated time a participant that does not know the result asks for it. It takes other sets
/// meanwhile; the first one ends its doubt.
pub const DOUBT_WITHIN: Duration = Duration::from_secs(10);
/// Time between two messages of the same content before the stated time: a lost one is replaced early enough.
const RESEND: Duration = Duration::from_millis(20);
/// The same after the stated time: a peer that is cut off returns in seconds.
const DOUBT_RESEND: Duration = Duration::from_millis(100);

/// The messages to send: the receiver's TID as bits, and the message.
pub(crate) type Outbox = VecDeque<(u64, ParameterVote)>;

/// The times of a transaction, on the participant's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Times {
    /// Until then acceptances count.
    pub(crate) decide_by: Duration,
    /// The stated time.
    pub(crate) apply_at: Duration,
}

/// The knowledge of one participant about a transaction.
#[derive(Debug)]
pub(crate) struct Agreement {
    id: TransactionId,
    times: Times,
    /// The other participants, by the bits of their TIDs.
    peers: BTreeMap<u64, Peer>,
    phase: Phase,
    next_send: Duration,
    /// Whether the stated time has passed without a known result.
    is_overdue: bool,
}

#[derive(Debug)]
struct Peer {
    app: String,
    has_accepted: bool,
    /// It has told after the stated time that it does not know of an agreement.
    has_nothing: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Acceptances count.
    Open,
    /// All have accepted.
    Committed,
    /// The result is not known.
    Doubtful,
    /// Nothing is applied.
    Ended,
}

impl Agreement {
    /// Creates the part of the participant `own`, which accepts. `participants` may have itself.
    pub(crate) fn new(
        ParameterTransaction { id, participants, .. }: &ParameterTransaction,
        own: u64,
        times: Times,
        now: Duration,
        outbox: &mut Outbox,
    ) -> Self {
        let peer = |one: &Participant| Peer { app: one.app.clone(), has_accepted: false, has_nothing: false };
        let others = participants.iter().filter(|one| one.tid != own);
        let peers = others.map(|one| (one.tid, peer(one))).collect();
        let next_send = now + RESEND;
        let mut agreement = Self { id: *id, times, peers, phase: Phase::Open, next_send, is_overdue: false };
        if agreement.peers.is_empty() {
            agreement.phase = Phase::Committed;
        }
        // The coordinator begins in the order of the list. Later ones answer when they have the transaction, too.
        for earlier in participants.iter().take_while(|one| one.tid != own) {
            agreement.send(earlier.tid, Stance::Accepts, outbox);
        }
        agreement
    }

    pub(crate) const fn id(&self) -> TransactionId {
        self.id
    }

    pub(crate) const fn times(&self) -> Times {
        self.times
    }

    /// Returns whether all have accepted.
    pub(crate) fn is_committed(&self) -> bool {
        self.phase == Phase::Committed
    }

    /// Returns whether nothing is applied, and nothing is asked any more.
    pub(crate) fn is_ended(&self) -> bool {
        self.phase == Phase::Ended
    }

    /// Returns the names of the participants without a known acceptance.
    pub(crate) fn missing(&self) -> Vec<String> {
        self.peers.values().filter(|peer| !peer.has_accepted).map(|peer| peer.app.clone()).collect()
    }

    /// Handles a message of another participant. Others are ignored.
    pub(crate) fn on_vote(&mut self, now: Duration, from: u64, stance: Stance, outbox: &mut Outbox) {
        self.on_time(now, outbox);
        let Some(peer) = self.peers.get_mut(&from) else { return };
        match (self.phase, stance) {
            (Phase::Open, Stance::Accepts) => {
                let is_first = !std::mem::replace(&mut peer.has_accepted, true);
                if self.peers.values().all(|peer| peer.has_accepted) {
                    self.commit(outbox);
                } else if is_first {
                    // It may not have had this transaction yet when the acceptance was sent to all.
                    self.send(from, Stance::Accepts, outbox);
                }
            }
            (Phase::Open | Phase::Doubtful, Stance::Commits) => self.commit(outbox),
            (Phase::Committed, Stance::Accepts | Stance::Doubts) => self.send(from, Stance::Commits, outbox),
            (Phase::Doubtful, Stance::Doubts | Stance::Refuses) => {
                // Before the stated time a message that tells it of an agreement may be on its way.
                peer.has_nothing |= self.is_overdue;
                self.on_time(now, outbox);
            }
            // An incarnation that refuses may follow one that has accepted, and others may know that acceptance.
            (Phase::Open, Stance::Doubts | Stance::Refuses)
            // Too late to count.
            | (Phase::Doubtful, Stance::Accepts)
            | (Phase::Committed, Stance::Commits | Stance::Refuses)
            | (Phase::Ended, _) => {}
        }
    }

    /// Handles the passing of time: see [`next_wake`](Self::next_wake).
    pub(crate) fn on_time(&mut self, now: Duration, outbox: &mut Outbox) {
        if self.phase == Phase::Open && now >= self.times.decide_by {
            self.phase = Phase::Doubtful;
            self.next_send = now;
        }
        if self.phase == Phase::Doubtful {
            if !self.is_overdue && now >= self.times.apply_at {
                self.is_overdue = true;
                self.next_send = now;
            }
            let has_all_answers = self.is_overdue && self.peers.values().all(|peer| peer.has_nothing);
            if has_all_answers || now >= self.times.apply_at + DOUBT_WITHIN {
                self.phase = Phase::Ended;
            }
        }
        if now < self.next_send {
            return;
        }
        match self.phase {
            Phase::Open => self.send_to_all(Stance::Accepts, outbox),
            Phase::Doubtful => self.send_to_all(Stance::Doubts, outbox),
            Phase::Committed | Phase::Ended => return,
        }
        self.next_send = now + if self.is_overdue { DOUBT_RESEND } else { RESEND };
    }

    /// Returns when [`on_time`](Self::on_time) has something to do next, if no message comes.
    pub(crate) fn next_wake(&self) -> Option<Duration> {
        let Times { decide_by, apply_at } = self.times;
        match self.phase {
            Phase::Open => Some(self.next_send.min(decide_by)),
            Phase::Doubtful if self.is_overdue => Some(self.next_send.min(apply_at + DOUBT_WITHIN)),
            Phase::Doubtful => Some(self.next_send.min(apply_at)),
            Phase::Committed | Phase::Ended => None,
        }
    }

    fn commit(&mut self, outbox: &mut Outbox) {
        self.phase = Phase::Committed;
        // Also by those that learned it from another one: the first that knew it may have been killed meanwhile.
        self.send_to_all(Stance::Commits, outbox);
    }

    fn send_to_all(&self, stance: Stance, outbox: &mut Outbox) {
        self.peers.keys().for_each(|to| self.send(*to, stance, outbox));
    }

    fn send(&self, to: u64, stance: Stance, outbox: &mut Outbox) {
        outbox.push_back((to, ParameterVote { transaction: self.id, stance }));
    }
}
