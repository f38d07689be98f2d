//! Which way a message to another application goes, and from where its messages may be taken. Pure.
//!
//! At first everything goes through the node. Who sends to another application of the node asks LNCL to be introduced, goes
//! on through the node meanwhile, and has a *direct link* when the other side agrees: a ring each way, beside the node.
//!
//! ```text
//!   A (asks)                  LNCL                       B (is asked)
//!   Asked  ── INTRODUCE ────► │ ── INTRODUCTION ───────► Offered: its offer lies in the link's socket
//!          ◄─ INTRODUCED ──── │ ◄─ taken ───────────────
//!   Direct: its offer lies in the socket, too; from now on A writes to its ring only, and leaves B's ring unread
//!          ── SWITCH ───────► │ ── three marks ────────► Direct: B reads A's ring, and writes to its own only
//!          ◄─ three marks ─── │ ◄─ SWITCH ──────────────
//!   Direct, open: A reads B's ring
//! ```
//!
//! **Nothing is seen out of order.** The node keeps the order of each class but not between them: a lane that was passed
//! over has its turn before others. So a SWITCH becomes one mark in each class, behind all that was sent through the node
//! before it, and a ring is read when all three have come. Nobody waits for that: who sends writes into the ring at once.

mod said;
#[cfg(test)]
mod simulation;
#[cfg(test)]
mod tests;

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    time::Time,
    wire::Class,
};

pub(super) use said::{Answered, Farewell, Left, Marked, Passed};

/// Direct links of one endpoint at most, those that are being made included. What is above goes through the node.
pub(super) const LINKS_MAX: usize = 64;
/// Remembered refusals at most; the one that ends first makes room.
const REFUSALS_MAX: usize = 256;
/// Time until an introduction that failed for now is asked for again.
const ASK_AGAIN: Duration = Duration::from_millis(100);
/// Time until one is asked for again that this destination will hardly ever allow.
const HARDLY_EVER: Duration = Duration::from_secs(10);
/// Time until an introduction is given up that nobody has answered: the peer answers within its own calls.
const ANSWER_WITHIN: Duration = Duration::from_secs(10);
/// Time until a SWITCH is said again for which there was no room.
const SWITCH_AGAIN: Duration = Duration::from_millis(10);
/// Time until a SWITCH is said again that was refused or that nobody has answered.
const SWITCH_UNHEARD: Duration = Duration::from_secs(1);
/// So long the ring of a peer that has gone waits for its marks. LNCL says them even after the peer's end, so they do not
/// come only if the peer died before its SWITCH, or LNCL with it.
const MARKS_AFTER_END: Duration = Duration::from_secs(10);

/// Which way a message goes now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Way {
    /// To the node.
    Through,
    /// To the node, and LNCL is asked for an introduction: [`Routes::asked`].
    ThroughAndAsk,
    /// Into the ring of this link.
    Direct(LinkNumber),
}

/// The number that LNCL gave a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct LinkNumber(pub(super) u64);

/// Classes whose mark has come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Marks {
    classes: [bool; 3],
    confirm: Option<u64>,
}

impl Marks {
    const fn has(&self, class: Class) -> bool {
        self.classes[class as usize]
    }

    /// Returns whether all have come.
    fn note(&mut self, class: Class, confirm: Option<u64>) -> bool {
        self.classes[class as usize] = true;
        self.confirm = self.confirm.or(confirm);
        self.classes == [true; 3]
    }
}

/// Whether the peer has taken our SWITCH.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Switch {
    /// Never said yet: messages go through the node. If this process ended now, nobody would read its ring.
    Unsaid {
        at: Time,
    },
    /// To be said `again` then if nobody answers.
    Said {
        correlation: u64,
        again: Time,
    },
    /// To be said again.
    ToSay {
        at: Time,
    },
    Taken,
}

impl Switch {
    /// When it is to be said, if nobody answers before.
    const fn due(&self) -> Option<Time> {
        match self {
            Self::Unsaid { at } | Self::ToSay { at } | Self::Said { again: at, .. } => Some(*at),
            Self::Taken => None,
        }
    }
}

/// Whether the peer's ring is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Theirs {
    Held(Marks),
    Open,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Peer {
    /// Through the node; asked for again from `until` on.
    Refused { until: Time },
    /// Through the node; LNCL has been asked.
    Asked { correlation: u64, until: Time },
    /// Through the node; the peer has asked, and our offer is in the link's socket.
    Offered { number: LinkNumber, marks: Marks, gone: Option<Time> },
    /// Into our ring, until the peer has gone.
    Direct { number: LinkNumber, switch: Switch, theirs: Theirs, gone: Option<Time> },
}

impl Peer {
    const fn link(&self) -> Option<LinkNumber> {
        match self {
            Self::Refused { .. } | Self::Asked { .. } => None,
            Self::Offered { number, .. } | Self::Direct { number, .. } => Some(*number),
        }
    }

    const fn correlation(&self) -> Option<u64> {
        match self {
            Self::Asked { correlation, .. }
            | Self::Direct { switch: Switch::Said { correlation, .. }, .. } => Some(*correlation),
            Self::Refused { .. } | Self::Offered { .. } | Self::Direct { .. } => None,
        }
    }
}

/// Whether an endpoint has direct links at all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Directness {
    /// As many as it may.
    Allowed,
    /// Everything goes through the node.
    Off,
}

/// The ways to all whom one endpoint sends to.
#[derive(Debug)]
pub(super) struct Routes {
    own: Tid,
    directness: Directness,
    peers: BTreeMap<Tid, Peer>,
    /// Links, and what may become one.
    links: usize,
}

impl Routes {
    pub(super) const fn new(own: Tid, directness: Directness) -> Self {
        Self { own, directness, peers: BTreeMap::new(), links: 0 }
    }

    /// The way to `destination`, which is absolute.
    pub(super) fn way(&self, destination: Tid, now: Time) -> Way {
        match self.peers.get(&destination) {
            Some(Peer::Direct { switch: Switch::Unsaid { .. }, .. } | Peer::Offered { .. }) => Way::Through,
            Some(Peer::Direct { number, gone: None, .. }) => Way::Direct(*number),
            Some(Peer::Direct { .. }) => Way::Through,
            Some(Peer::Refused { until } | Peer::Asked { until, .. }) if now < *until => Way::Through,
            // Nobody has answered.
            Some(Peer::Asked { .. }) => Way::ThroughAndAsk,
            Some(Peer::Refused { .. }) | None if self.may_ask(destination) => Way::ThroughAndAsk,
            Some(Peer::Refused { .. }) | None => Way::Through,
        }
    }

    /// LNCL has been asked for an introduction to `peer`.
    pub(super) fn asked(&mut self, peer: Tid, correlation: u64, now: Time) {
        self.set(peer, Peer::Asked { correlation, until: now + ANSWER_WITHIN });
    }

    /// LNCL could not be asked.
    pub(super) fn not_asked(&mut self, peer: Tid, now: Time) {
        self.refuse(peer, now + ASK_AGAIN);
    }

    /// This process has no memory for one more link, or cannot close any more what peers pass wrongly.
    pub(super) fn no_room(&mut self, peer: Tid, now: Time) {
        self.refuse(peer, now + HARDLY_EVER);
    }

    /// LNCL says that `peer` has agreed to a link. Whether it is still wanted: else its descriptor is closed.
    pub(super) fn introduced(&self, peer: Tid, correlation: u64) -> bool {
        matches!(self.peers.get(&peer), Some(Peer::Asked { correlation: asked, .. }) if *asked == correlation)
    }

    /// LNCL says that `peer` asks for a link.
    ///
    /// # Errors
    /// Why there will be none; it may ask again.
    pub(super) fn introduction(&self, peer: Tid) -> Result<(), Rejection> {
        if self.directness == Directness::Off || peer == self.own {
            return Err(Rejection::Unsupported);
        }
        match self.peers.get(&peer) {
            // Both ask at once: the smaller one's link is made.
            Some(Peer::Asked { .. }) if self.own < peer => Err(Rejection::QueueFull),
            Some(Peer::Asked { .. }) => Ok(()),
            Some(Peer::Offered { .. } | Peer::Direct { .. }) => Err(Rejection::QueueFull),
            Some(Peer::Refused { .. }) | None if self.links < LINKS_MAX => Ok(()),
            Some(Peer::Refused { .. }) | None => Err(Rejection::QueueFull),
        }
    }

    /// Our offer is in the socket of the link that `peer` has asked for.
    pub(super) fn offered(&mut self, peer: Tid, number: LinkNumber) {
        self.set(peer, Peer::Offered { number, marks: Marks::default(), gone: None });
    }

    /// The link stands, and our SWITCH is said, behind all that went through the node so far; where there was no room for
    /// it now, it is later. The peer's ring is open if its SWITCH was what made the link.
    pub(super) fn connected(&mut self, peer: Tid, number: LinkNumber, said: Option<u64>, now: Time) {
        let (theirs, gone) = match self.peers.get(&peer) {
            Some(Peer::Offered { gone, .. }) => (Theirs::Open, *gone),
            Some(Peer::Refused { .. } | Peer::Asked { .. } | Peer::Direct { .. }) | None => {
                (Theirs::Held(Marks::default()), None)
            }
        };
        let later = Switch::Unsaid { at: now + SWITCH_AGAIN };
        let switch =
            said.map_or(later, |correlation| Switch::Said { correlation, again: now + SWITCH_UNHEARD });
        self.set(peer, Peer::Direct { number, switch, theirs, gone });
    }

    /// A mark of `peer`'s SWITCH has come.
    pub(super) fn marked(
        &mut self,
        peer: Tid,
        number: LinkNumber,
        class: Class,
        confirm: Option<u64>,
    ) -> Marked {
        match self.peers.get_mut(&peer) {
            // It was said again, and the first one is answered when all have come.
            Some(
                Peer::Offered { number: ours, marks, .. }
                | Peer::Direct { number: ours, theirs: Theirs::Held(marks), .. },
            ) if *ours == number && marks.confirm.is_some() && confirm.is_some() => Marked::Known,
            Some(Peer::Offered { number: ours, marks, .. }) if *ours == number => {
                if !marks.note(class, confirm) {
                    return Marked::Wait;
                }
                Marked::Connect { confirm: marks.confirm }
            }
            Some(Peer::Direct { number: ours, theirs, .. }) if *ours == number => {
                let Theirs::Held(marks) = theirs else { return Marked::Known };
                if !marks.note(class, confirm) {
                    return Marked::Wait;
                }
                let confirm = marks.confirm;
                *theirs = Theirs::Open;
                Marked::Open { confirm }
            }
            Some(Peer::Refused { .. } | Peer::Asked { .. } | Peer::Offered { .. } | Peer::Direct { .. })
            | None => Marked::Unknown,
        }
    }

    /// An OUTCOME came for `correlation`.
    pub(super) fn answered(&mut self, correlation: u64, outcome: Outcome, now: Time) -> Answered {
        let ours = self.peers.iter().find(|(_, peer)| peer.correlation() == Some(correlation));
        let Some((tid, peer)) = ours.map(|(tid, peer)| (*tid, *peer)) else { return Answered::NotOurs };
        let Peer::Direct { number, .. } = peer else {
            self.refuse(tid, now + pause(outcome));
            return Answered::Noted;
        };
        match outcome {
            Outcome::Delivered => self.set_switch(tid, Switch::Taken),
            // The peer says so: it has no such link. Its hang-up may be on its way.
            Outcome::Rejected(Rejection::Unsupported | Rejection::Malformed) => {
                return Answered::End(tid, number);
            }
            // What stands between has failed, or there is no room: the link's end would show by itself.
            Outcome::Rejected(_)
            | Outcome::Expired
            | Outcome::Failed
            | Outcome::PeerLost
            | Outcome::Unknown => self.set_switch(tid, Switch::ToSay { at: now + SWITCH_UNHEARD }),
        }
        Answered::Noted
    }

    /// A peer whose SWITCH is to be said again by `now`: [`switched`](Self::switched), or
    /// [`not_switched`](Self::not_switched).
    pub(super) fn switch_due(&self, now: Time) -> Option<(Tid, LinkNumber)> {
        self.peers.iter().find_map(|(tid, peer)| match peer {
            Peer::Direct { number, switch, gone: None, .. } if switch.due().is_some_and(|at| at <= now) => {
                Some((*tid, *number))
            }
            Peer::Refused { .. } | Peer::Asked { .. } | Peer::Offered { .. } | Peer::Direct { .. } => None,
        })
    }

    /// The SWITCH was said again.
    pub(super) fn switched(&mut self, peer: Tid, correlation: u64, now: Time) {
        self.set_switch(peer, Switch::Said { correlation, again: now + SWITCH_UNHEARD });
    }

    /// The SWITCH could not be said; later.
    pub(super) fn not_switched(&mut self, peer: Tid, now: Time) {
        if let Some(Peer::Direct { switch, .. }) = self.peers.get_mut(&peer) {
            let at = now + SWITCH_AGAIN;
            *switch = match switch {
                Switch::Unsaid { .. } => Switch::Unsaid { at },
                Switch::Said { .. } | Switch::ToSay { .. } | Switch::Taken => Switch::ToSay { at },
            };
        }
    }

    /// A message to this application alone has come from `source` through the node.
    pub(super) fn passed(&mut self, source: Tid, class: Class, now: Time) -> Passed {
        match self.peers.get_mut(&source) {
            Some(Peer::Direct { number, theirs: Theirs::Open, gone, .. }) => {
                gone.get_or_insert(now);
                Passed::AfterLink(*number)
            }
            Some(
                Peer::Direct { number, theirs: Theirs::Held(marks), gone, .. }
                | Peer::Offered { number, marks, gone },
            ) if marks.has(class) => {
                gone.get_or_insert(now);
                Passed::AfterLink(*number)
            }
            Some(Peer::Refused { .. } | Peer::Asked { .. } | Peer::Offered { .. } | Peer::Direct { .. })
            | None => Passed::Take,
        }
    }

    /// The peer has closed the link, or its process has ended, with so much `left` unread. Asked again and again while its
    /// ring is kept.
    pub(super) fn hung_up(&mut self, peer: Tid, left: Left, now: Time) -> Farewell {
        match self.peers.get_mut(&peer) {
            Some(Peer::Direct { theirs: Theirs::Open, gone, .. }) => {
                gone.get_or_insert(now);
                Farewell::Read
            }
            // It said its SWITCH before it wrote anything.
            Some(Peer::Direct { .. } | Peer::Offered { .. }) if left == Left::Nothing => Farewell::Drop,
            Some(Peer::Direct { theirs: Theirs::Held(_), gone, .. } | Peer::Offered { gone, .. }) => {
                if now < *gone.get_or_insert(now) + MARKS_AFTER_END { Farewell::Keep } else { Farewell::Drop }
            }
            Some(Peer::Refused { .. } | Peer::Asked { .. }) | None => Farewell::Drop,
        }
    }

    /// The link with `peer` is no more. A later one may be asked for.
    pub(super) fn ended(&mut self, peer: Tid, now: Time) {
        self.refuse(peer, now + ASK_AGAIN);
    }

    /// The connection to the node has ended. What was asked there is forgotten, and what was said and not answered is said
    /// again when there is another one.
    pub(super) fn node_has_ended(&mut self, now: Time) {
        for peer in self.peers.values_mut() {
            match peer {
                Peer::Asked { .. } => {
                    *peer = Peer::Refused { until: now };
                    self.links -= 1;
                }
                Peer::Direct { switch: switch @ Switch::Said { .. }, .. } => {
                    *switch = Switch::ToSay { at: now };
                }
                Peer::Direct { .. } | Peer::Offered { .. } | Peer::Refused { .. } => {}
            }
        }
    }

    /// Whether LNCL has been asked and has not answered.
    pub(super) fn is_asking(&self) -> bool {
        self.peers.values().any(|peer| matches!(peer, Peer::Asked { .. }))
    }

    /// Whether the ring of `peer` is read.
    #[cfg(test)]
    pub(super) fn is_open(&self, peer: Tid) -> bool {
        matches!(self.peers.get(&peer), Some(Peer::Direct { theirs: Theirs::Open, .. }))
    }

    /// The link with `peer`, if there is one or will be.
    pub(super) fn link(&self, peer: Tid) -> Option<LinkNumber> {
        self.peers.get(&peer).and_then(Peer::link)
    }

    fn may_ask(&self, destination: Tid) -> bool {
        self.directness == Directness::Allowed
            && self.links < LINKS_MAX
            && destination != self.own
            && destination.node == self.own.node
            && destination.is_single()
            && !destination.app.is_layer()
    }

    fn set_switch(&mut self, peer: Tid, to: Switch) {
        if let Some(Peer::Direct { switch, .. }) = self.peers.get_mut(&peer) {
            *switch = to;
        }
    }

    fn refuse(&mut self, peer: Tid, until: Time) {
        self.set(peer, Peer::Refused { until });
        if self.peers.len() - self.links > REFUSALS_MAX {
            let refusals = self.peers.iter().filter_map(|(tid, peer)| match peer {
                Peer::Refused { until } => Some((*until, *tid)),
                Peer::Asked { .. } | Peer::Offered { .. } | Peer::Direct { .. } => None,
            });
            if let Some((_, first)) = refusals.min() {
                self.peers.remove(&first);
            }
        }
    }

    fn set(&mut self, tid: Tid, peer: Peer) {
        let is_link = |peer: &Peer| !matches!(peer, Peer::Refused { .. });
        self.links += usize::from(is_link(&peer));
        if let Some(former) = self.peers.insert(tid, peer) {
            self.links -= usize::from(is_link(&former));
        }
    }
}

/// How long an introduction that ended so is not asked for again.
const fn pause(outcome: Outcome) -> Duration {
    match outcome {
        // In the node's own process, in another node, a client that speaks through its socket, or wants no links.
        Outcome::Rejected(Rejection::Unsupported) => HARDLY_EVER,
        Outcome::Delivered
        | Outcome::Rejected(_)
        | Outcome::Expired
        | Outcome::Failed
        | Outcome::PeerLost
        | Outcome::Unknown => ASK_AGAIN,
    }
}
