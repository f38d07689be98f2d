//! A small world around the routes of three applications: a node that forgets the order between classes, refuses when it is
//! full, and may be started anew; processes that end and come back; links. Whatever happens in whatever order: each receiver
//! sees each class of each sender in order and nothing twice, and each confirmed message ends once.

mod faults;
mod look;
mod node;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use bytes::Bytes;
use sinew_runtime::{
    mailbox::ClassQueue,
    tid::{AppAddress, NodeAddress},
    wire::{Flags, Header, Kind, Message},
};

use super::*;

const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
pub(super) const APPS: usize = 3;
/// Room of the rings and sockets between an application and its node, in messages.
const PIPE: usize = 6;
/// Room of the node's queue for an application, in messages of a class: more than a lane may be passed over.
const QUEUE: usize = 48;
/// Room of a direct ring, in messages.
const RING: usize = 8;

pub(super) fn tid(index: usize) -> Tid {
    Tid::new(NODE, AppAddress::new(0x1000 + u32::try_from(index).expect("a small number")))
}

fn index_of(tid: Tid) -> usize {
    (tid.app.bits() - 0x1000) as usize
}

fn number_of(message: &Message) -> LinkNumber {
    LinkNumber(u64::from_le_bytes(message.payload[..8].try_into().expect("eight bytes")))
}

fn layer(kind: Kind, source: Tid, destination: Tid, number: u64, correlation: u64) -> Message {
    let mut header = Header::new(kind, source, destination);
    header.correlation = correlation;
    Message::new(header, Bytes::copy_from_slice(&number.to_le_bytes()))
}

fn outcome_of(message: &Message) -> Outcome {
    Outcome::from_code(message.payload[0]).expect("an outcome")
}

fn outcome(about: Tid, to: Tid, correlation: u64, outcome: Outcome) -> Message {
    let mut header = Header::new(Kind::OUTCOME, about, to);
    header.correlation = correlation;
    Message::new(header, Bytes::copy_from_slice(&[outcome.code()]))
}

/// One end of a link: what its holder sends, and whether it has made its offer and is there.
#[derive(Default)]
struct End {
    offered: bool,
    connected: bool,
    here: bool,
    ring: VecDeque<Message>,
}

struct Link {
    ends: BTreeMap<Tid, End>,
}

pub(super) struct App {
    tid: Tid,
    life: u64,
    alive: bool,
    pub(super) routes: Routes,
    sequence: u64,
    correlation: u64,
    /// Confirmed messages that have not ended: the link on which each went, if it did.
    pending: BTreeMap<u64, Option<LinkNumber>>,
    to_node: VecDeque<Message>,
    from_node: VecDeque<Message>,
    /// What the node has for it and its ring does not take.
    queue: ClassQueue,
    /// What came through the node and was sent after what is left in that link's ring.
    early: VecDeque<(LinkNumber, Message)>,
    /// The life and the number of the newest of each source and class that it has taken.
    seen: BTreeMap<(Tid, Class), (u64, u64)>,
}

impl App {
    fn new(tid: Tid, life: u64) -> Self {
        Self {
            tid,
            life,
            alive: true,
            routes: Routes::new(tid, Directness::Allowed),
            sequence: 0,
            correlation: 0,
            pending: BTreeMap::new(),
            to_node: VecDeque::new(),
            from_node: VecDeque::new(),
            queue: ClassQueue::new(QUEUE),
            early: VecDeque::new(),
            seen: BTreeMap::new(),
        }
    }

    fn correlate(&mut self) -> u64 {
        self.correlation += 1;
        self.correlation
    }
}

/// Messages: the life of the source and the sequence, or the correlation.
type Told = BTreeSet<(u64, u64)>;

pub(super) struct World {
    now: Time,
    pub(super) apps: Vec<App>,
    links: BTreeMap<LinkNumber, Link>,
    lives: u64,
    numbers: u64,
    /// Introductions that the node has passed on: who asked, with which correlation, and whom.
    introductions: BTreeMap<u64, (Tid, u64, Tid)>,
    /// Sent and never refused, and to whom.
    sent: BTreeMap<(u64, u64), Tid>,
    taken: Told,
    /// Confirmed messages that have ended.
    ended: Told,
    superseded: Told,
    nodes_restarted: bool,
    /// Who has died, and so need not have taken what was sent to it.
    deaths: BTreeSet<Tid>,
    pub(super) on_links: u64,
}

impl World {
    pub(super) fn new() -> Self {
        let apps = (0..APPS).map(|index| App::new(tid(index), index as u64)).collect();
        Self {
            now: Time::ZERO,
            apps,
            links: BTreeMap::new(),
            lives: APPS as u64,
            numbers: 0,
            introductions: BTreeMap::new(),
            sent: BTreeMap::new(),
            taken: Told::new(),
            ended: Told::new(),
            superseded: Told::new(),
            nodes_restarted: false,
            deaths: BTreeSet::new(),
            on_links: 0,
        }
    }

    /// The first application has switched to its link with the second one, which has not looked since. Between asking and
    /// switching it did what `meanwhile` says.
    pub(super) fn switching(meanwhile: &[Step]) -> Self {
        let mut world = Self::new();
        let send = |class| Step::Send { from: 0, to: 1, class, confirm: false, times: 1 };
        let ask =
            [send(Class::Control), Step::NodeReads(0), Step::NodeReads(0), Step::Look(1), Step::NodeReads(1)];
        let switch = [Step::Look(0), Step::NodeReads(0)];
        let direct = [send(Class::Control), send(Class::Bulk), send(Class::Stream)];
        for step in ask.iter().chain(meanwhile).chain(&switch).chain(&direct) {
            world.step(*step);
        }
        assert_eq!(world.on_links, 3, "the sender has switched");
        world
    }

    /// An application sends to another one, as far as the way has room.
    fn send(&mut self, from: usize, to: usize, class: Class, confirm: bool) {
        let destination = tid(to);
        let app = &mut self.apps[from];
        let way = app.routes.way(destination, self.now);
        let is_full = match way {
            Way::Direct(number) => self.links[&number].ends[&app.tid].ring.len() >= RING,
            Way::Through | Way::ThroughAndAsk => app.to_node.len() + 2 > PIPE,
        };
        if from == to || !app.alive || is_full {
            return;
        }
        app.sequence += 1;
        let mut header = Header::new(Kind::named("data"), app.tid, destination);
        (header.class, header.sequence) = (class, app.sequence);
        // Whose life it is from travels in the payload, to be looked at by the receiver of this test alone.
        let payload = Bytes::copy_from_slice(&app.life.to_le_bytes());
        let link = if let Way::Direct(number) = way { Some(number) } else { None };
        if confirm && class != Class::Stream {
            header.flags = Flags::CONFIRM;
            header.correlation = app.correlate();
            app.pending.insert(header.correlation, link);
        }
        self.sent.insert((app.life, header.sequence), destination);
        let message = Message::new(header, payload);
        match way {
            Way::Direct(number) => {
                self.on_links += 1;
                self.end_mut(number, tid(from)).ring.push_back(message);
            }
            Way::Through => app.to_node.push_back(message),
            Way::ThroughAndAsk => {
                app.to_node.push_back(message);
                let correlation = app.correlate();
                app.routes.asked(destination, correlation, self.now);
                app.to_node.push_back(layer(Kind::LNCL_INTRODUCE, app.tid, destination, 0, correlation));
            }
        }
    }

    fn end_mut(&mut self, number: LinkNumber, of: Tid) -> &mut End {
        let link = self.links.get_mut(&number).expect("a link that somebody has");
        link.ends.get_mut(&of).expect("an end of its own")
    }

    fn other_end(&mut self, number: LinkNumber, of: Tid) -> &mut End {
        let link = self.links.get_mut(&number).expect("a link that somebody has");
        link.ends.iter_mut().find(|(tid, _)| **tid != of).expect("a link has two ends").1
    }

    pub(super) fn step(&mut self, step: Step) {
        self.now = self.now + Duration::from_millis(1);
        match step {
            Step::Send { from, to, class, confirm, times } => {
                for _ in 0..times {
                    self.send(from, to, class, confirm);
                }
            }
            Step::Burst { from, to, class } => {
                for _ in 0..40 {
                    self.send(from, to, class, false);
                    self.node_reads(from);
                }
            }
            Step::NodeReads(from) => self.node_reads(from),
            Step::NodeWrites(to) => self.node_writes(to),
            Step::Look(at) if self.apps[at].alive => self.look_at_node(at),
            Step::LookAtLink(at, peer) if self.apps[at].alive => {
                self.look_at_link(at, tid(peer));
            }
            Step::LookAtEnds(at) if self.apps[at].alive => self.look_at_ends(at),
            Step::Look(_) | Step::LookAtLink(..) | Step::LookAtEnds(_) => {}
            Step::Kill(at) => self.kill(at),
            Step::Revive(at) => self.revive(at),
            Step::RestartNode => self.restart_node(),
            Step::LoseWord(at) => self.lose_word(at),
        }
    }

    /// Everybody does all there is to do, and again when all that waits for a time has waited.
    pub(super) fn settle(&mut self) {
        for _ in 0..3 {
            let mut idle_rounds = 0;
            for _ in 0..2_000 {
                self.do_a_round();
                idle_rounds = if self.is_idle() { idle_rounds + 1 } else { 0 };
                if idle_rounds == 20 {
                    break;
                }
            }
            assert_eq!(idle_rounds, 20, "it does not come to rest");
            self.now = self.now + MARKS_AFTER_END;
        }
    }

    fn do_a_round(&mut self) {
        for at in 0..APPS {
            self.step(Step::NodeReads(at));
            self.step(Step::NodeWrites(at));
            self.step(Step::Look(at));
            self.step(Step::LookAtEnds(at));
            for peer in 0..APPS {
                self.step(Step::LookAtLink(at, peer));
            }
        }
    }

    fn is_idle(&self) -> bool {
        self.apps.iter().all(|app| {
            app.to_node.is_empty() && (!app.alive || app.from_node.is_empty() && app.queue.is_empty())
        })
    }

    pub(super) fn check(&self) {
        for app in self.apps.iter().filter(|app| app.alive) {
            assert!(app.pending.is_empty(), "{} waits for the outcomes of {:?}", app.tid, app.pending);
        }
        self.check_links();
        if self.nodes_restarted {
            return;
        }
        let has_come = |told| self.taken.contains(told) || self.superseded.contains(told);
        let missing: Vec<_> =
            self.sent.iter().filter(|(told, to)| !self.deaths.contains(to) && !has_come(told)).collect();
        assert!(missing.is_empty(), "these were taken from their senders and never came: {missing:?}");
    }
}

impl World {
    /// No ring is unread for good.
    fn check_links(&self) {
        let alive = || self.apps.iter().filter(|app| app.alive);
        for (app, peer) in alive().flat_map(|app| alive().map(move |peer| (app, peer))) {
            let link = app.routes.link(peer.tid);
            assert!(link.is_none() || app.routes.is_open(peer.tid), "{} does not read {}", app.tid, peer.tid);
            assert_eq!(link, peer.routes.link(app.tid), "{} and {} see another link", app.tid, peer.tid);
        }
    }
}

impl Link {
    fn close(&mut self, of: Tid) {
        if let Some(end) = self.ends.get_mut(&of) {
            end.here = false;
        }
    }
}

impl App {
    fn life_is(&self, message: &Message) -> bool {
        // A mark's payload is its link's number; whoever is dead is told nothing.
        self.alive && (!message.header.kind.is_user() || life_of(message) == self.life)
    }
}

fn life_of(message: &Message) -> u64 {
    number_of(message).0
}

trait CloneForTest {
    fn clone_for_test(&self) -> Message;
}

impl CloneForTest for Message {
    fn clone_for_test(&self) -> Message {
        Self::new(self.header, self.payload.clone())
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) enum Step {
    Send {
        from: usize,
        to: usize,
        class: Class,
        confirm: bool,
        times: usize,
    },
    Burst {
        from: usize,
        to: usize,
        class: Class,
    },
    NodeReads(usize),
    NodeWrites(usize),
    Look(usize),
    LookAtLink(usize, usize),
    LookAtEnds(usize),
    Kill(usize),
    Revive(usize),
    RestartNode,
    /// What the node tells this one next finds no room.
    LoseWord(usize),
}
