//! A small world around the routes of three applications. It has a node that forgets the order between
//! classes, refuses messages when it is full, and may restart; processes that end and return; and links. The
//! property for every order of events: each receiver gets each class of each sender in order and nothing
//! twice, and each confirmed message ends once.

mod faults;
mod node;
mod polls;

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::Duration,
};

use bytes::Bytes;
use sinew_client::{
    DirectLinks,
    routes::{
        HangUpAction, LinkNumber, MARKS_AFTER_END, MarkEffect, NodeDelivery, OutcomeEffect, Route, Routes,
        Unread,
    },
};
use sinew_runtime::{
    mailbox::ClassQueue,
    outcome::{Outcome, Rejection},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Class, Flags, Header, Kind, Message},
};

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

/// One end of a link: the messages sent by its holder, and whether the holder has sent its offer and is
/// alive.
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

/// A step of the setup of a link that takes a while.
enum Making {
    Offer { number: LinkNumber },
    Accept { peer: Tid, number: LinkNumber, confirm: Option<u64> },
    Connect { peer: Tid, number: LinkNumber, correlation: u64 },
}

pub(super) struct App {
    tid: Tid,
    incarnation: u64,
    alive: bool,
    direct_links: DirectLinks,
    pub(super) routes: Routes,
    sequence: u64,
    correlation: u64,
    /// Confirmed messages that have not ended: the link on which each went, if it did.
    pending: BTreeMap<u64, Option<LinkNumber>>,
    to_node: VecDeque<Message>,
    from_node: VecDeque<Message>,
    /// Messages of the node for which the ring of the application has no room.
    queue: ClassQueue,
    /// Messages that came through the node and were sent after the remaining messages in that link's ring.
    reordered: VecDeque<(LinkNumber, Message)>,
    /// Links for which another thread makes the memory.
    making: VecDeque<Making>,
    /// The incarnation and the number of the newest message taken, for each source and class.
    seen: BTreeMap<(Tid, Class), (u64, u64)>,
}

impl App {
    fn new(tid: Tid, incarnation: u64, direct_links: DirectLinks) -> Self {
        Self {
            tid,
            incarnation,
            alive: true,
            direct_links,
            routes: Routes::new(tid, direct_links),
            sequence: 0,
            correlation: 0,
            pending: BTreeMap::new(),
            to_node: VecDeque::new(),
            from_node: VecDeque::new(),
            queue: ClassQueue::new(QUEUE),
            reordered: VecDeque::new(),
            making: VecDeque::new(),
            seen: BTreeMap::new(),
        }
    }

    fn correlate(&mut self) -> u64 {
        self.correlation += 1;
        self.correlation
    }
}

/// Messages: the incarnation of the source, and the sequence or the correlation.
type MessageIds = BTreeSet<(u64, u64)>;

pub(super) struct World {
    now: Time,
    pub(super) apps: Vec<App>,
    links: BTreeMap<LinkNumber, Link>,
    incarnations: u64,
    numbers: u64,
    /// Introductions that the node has forwarded: the requester, its correlation, and the peer.
    introductions: BTreeMap<u64, (Tid, u64, Tid)>,
    /// The destinations of messages that were sent and never refused.
    sent: BTreeMap<(u64, u64), Tid>,
    taken: MessageIds,
    /// Confirmed messages that have ended.
    ended: MessageIds,
    superseded: MessageIds,
    nodes_restarted: bool,
    /// Dead applications, which need not have received the messages sent to them.
    deaths: BTreeSet<Tid>,
    pub(super) on_links: u64,
}

impl World {
    pub(super) fn new(direct_links: [DirectLinks; APPS]) -> Self {
        let apps = direct_links.into_iter().enumerate();
        let apps = apps.map(|(index, links)| App::new(tid(index), index as u64, links)).collect();
        Self {
            now: Time::ZERO,
            apps,
            links: BTreeMap::new(),
            incarnations: APPS as u64,
            numbers: 0,
            introductions: BTreeMap::new(),
            sent: BTreeMap::new(),
            taken: MessageIds::new(),
            ended: MessageIds::new(),
            superseded: MessageIds::new(),
            nodes_restarted: false,
            deaths: BTreeSet::new(),
            on_links: 0,
        }
    }

    /// Returns a world in which the first application has switched to its link with the second one, which has
    /// not polled since. Between request and switch the first one did the steps of `meanwhile`.
    pub(super) fn switching(meanwhile: &[Step]) -> Self {
        let mut world = Self::new([DirectLinks::Always; APPS]);
        let send = |class| Step::Send { from: 0, to: 1, class, confirm: false, times: 1 };
        let ask = [
            send(Class::Control),
            Step::NodeReads(0),
            Step::NodeReads(0),
            Step::Poll(1),
            Step::FinishMaking(1),
            Step::NodeReads(1),
        ];
        let switch = [Step::Poll(0), Step::FinishMaking(0), Step::NodeReads(0)];
        let direct = [send(Class::Control), send(Class::Bulk), send(Class::Stream)];
        for step in ask.iter().chain(meanwhile).chain(&switch).chain(&direct) {
            world.step(*step);
        }
        assert_eq!(world.on_links, 3, "the sender has switched");
        world
    }

    /// An application sends to another one, as far as the path has room.
    fn send(&mut self, from: usize, to: usize, class: Class, confirm: bool) {
        let destination = tid(to);
        let app = &mut self.apps[from];
        let route = app.routes.route(destination, self.now);
        let is_full = match route {
            Route::Direct(number) => self.links[&number].ends[&app.tid].ring.len() >= RING,
            Route::ViaNode | Route::RequestLink => app.to_node.len() + 2 > PIPE,
        };
        if from == to || !app.alive || is_full {
            return;
        }
        app.sequence += 1;
        let mut header = Header::new(Kind::named("data"), app.tid, destination);
        (header.class, header.sequence) = (class, app.sequence);
        // The payload carries the incarnation of the sender, which only this test checks.
        let payload = Bytes::copy_from_slice(&app.incarnation.to_le_bytes());
        let link = if let Route::Direct(number) = route { Some(number) } else { None };
        if confirm && class != Class::Stream {
            header.flags = Flags::CONFIRM;
            header.correlation = app.correlate();
            app.pending.insert(header.correlation, link);
        }
        self.sent.insert((app.incarnation, header.sequence), destination);
        let message = Message::new(header, payload);
        match route {
            Route::Direct(number) => {
                self.on_links += 1;
                self.end_mut(number, tid(from)).ring.push_back(message);
            }
            Route::ViaNode => {
                app.to_node.push_back(message);
                app.routes.sent_through_node(destination, self.now);
            }
            Route::RequestLink => {
                app.to_node.push_back(message);
                let correlation = app.correlate();
                app.routes.asked(destination, correlation, self.now);
                app.to_node.push_back(layer(Kind::LNCL_INTRODUCE, app.tid, destination, 0, correlation));
            }
        }
    }

    fn end_mut(&mut self, number: LinkNumber, of: Tid) -> &mut End {
        let link = self.links.get_mut(&number).expect("the link exists");
        link.ends.get_mut(&of).expect("both ends exist")
    }

    fn other_end(&mut self, number: LinkNumber, of: Tid) -> &mut End {
        let link = self.links.get_mut(&number).expect("the link exists");
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
            Step::Poll(at) if self.apps[at].alive => self.poll_node(at),
            Step::PollLink(at, peer) if self.apps[at].alive => {
                self.poll_link(at, tid(peer));
            }
            Step::PollEnds(at) if self.apps[at].alive => self.poll_ends(at),
            Step::FinishMaking(at) if self.apps[at].alive => self.finish_making(at),
            Step::Poll(_) | Step::PollLink(..) | Step::PollEnds(_) | Step::FinishMaking(_) => {}
            Step::Kill(at) => self.kill(at),
            Step::Revive(at) => self.revive(at),
            Step::RestartNode => self.restart_node(),
            Step::LoseNotification(at) => self.lose_notification(at),
        }
    }

    /// Runs all steps that are possible, and again after all timed waits have ended.
    pub(super) fn settle(&mut self) {
        for _ in 0..3 {
            let mut idle_rounds = 0;
            for _ in 0..2_000 {
                self.step_all();
                idle_rounds = if self.is_idle() { idle_rounds + 1 } else { 0 };
                if idle_rounds == 20 {
                    break;
                }
            }
            assert_eq!(idle_rounds, 20, "the world does not settle");
            self.now = self.now + MARKS_AFTER_END;
        }
    }

    fn step_all(&mut self) {
        for at in 0..APPS {
            self.step(Step::NodeReads(at));
            self.step(Step::NodeWrites(at));
            self.step(Step::Poll(at));
            self.step(Step::PollEnds(at));
            self.step(Step::FinishMaking(at));
            for peer in 0..APPS {
                self.step(Step::PollLink(at, peer));
            }
        }
    }

    fn is_idle(&self) -> bool {
        self.apps.iter().all(|app| {
            let is_idle = app.from_node.is_empty() && app.queue.is_empty() && app.making.is_empty();
            app.to_node.is_empty() && (!app.alive || is_idle)
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
        let has_arrived = |answer| self.taken.contains(answer) || self.superseded.contains(answer);
        let missing: Vec<_> = self
            .sent
            .iter()
            .filter(|(answer, to)| !self.deaths.contains(to) && !has_arrived(answer))
            .collect();
        assert!(missing.is_empty(), "these messages were sent and never received: {missing:?}");
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
    fn is_incarnation_of(&self, message: &Message) -> bool {
        // The payload of a mark is its link's number; a dead application receives nothing.
        self.alive && (!message.header.kind.is_user() || incarnation_of(message) == self.incarnation)
    }
}

fn incarnation_of(message: &Message) -> u64 {
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
    Poll(usize),
    PollLink(usize, usize),
    PollEnds(usize),
    /// The memory for one link of this application is there.
    FinishMaking(usize),
    Kill(usize),
    Revive(usize),
    RestartNode,
    /// The node's next notification to this application finds no room.
    LoseNotification(usize),
}
