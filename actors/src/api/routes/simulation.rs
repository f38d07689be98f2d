//! A small world around the routes of three applications: a node that forgets the order between classes, refuses when it is
//! full, and may be started anew; processes that end and come back; links. Whatever happens in whatever order: each receiver
//! sees each class of each sender in order and nothing twice, and each confirmed message ends once.

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

    /// The node reads one frame of an application.
    fn node_reads(&mut self, from: usize) {
        let Some(message) = self.apps[from].to_node.pop_front() else { return };
        let Header { kind, source, destination, correlation, .. } = message.header;
        match kind {
            Kind::LNCL_INTRODUCE => self.introduce(source, destination, correlation),
            Kind::LNCL_SWITCH => {
                for class in [Class::Control, Class::Stream, Class::Bulk] {
                    let mut mark = layer(kind, source, destination, number_of(&message).0, correlation);
                    mark.header.class = class;
                    if class == Class::Bulk {
                        mark.header.flags = Flags::CONFIRM;
                    }
                    self.node_passes(mark);
                }
            }
            Kind::OUTCOME => self.node_settles(&message),
            _ => self.node_passes(message),
        }
    }

    /// The node puts a message into its queue for the destination, or refuses it.
    fn node_passes(&mut self, message: Message) {
        let destination = index_of(message.header.destination);
        if !self.apps[destination].alive {
            return self.refuse(message, Rejection::NoSuchApplication);
        }
        let queue = &mut self.apps[destination].queue;
        if message.header.kind == Kind::LNCL_SWITCH {
            return queue.push_beyond(message);
        }
        match queue.push(message) {
            Ok(None) => {}
            Ok(Some(older)) => self.note_superseded(&older),
            Err(refused) => self.refuse(refused.message, refused.why),
        }
    }

    fn note_superseded(&mut self, older: &Message) {
        if older.header.kind.is_user() {
            self.superseded.insert((life_of(older), older.header.sequence));
        }
    }

    fn refuse(&mut self, message: Message, why: Rejection) {
        let Header { kind, source, destination, correlation, flags, .. } = message.header;
        if kind.is_user() {
            self.sent.remove(&(life_of(&message), message.header.sequence));
        }
        if flags.has(Flags::CONFIRM) && self.apps[index_of(source)].life_is(&message) {
            self.node_tells(outcome(destination, source, correlation, Outcome::Rejected(why)));
        }
    }

    /// Outcomes and the like go ahead of the bounded queue, so that this test need not lose them.
    fn node_tells(&mut self, message: Message) {
        let to = index_of(message.header.destination);
        self.apps[to].from_node.push_back(message);
    }

    fn introduce(&mut self, source: Tid, destination: Tid, correlation: u64) {
        if !self.apps[index_of(destination)].alive {
            let nobody = Outcome::Rejected(Rejection::NoSuchApplication);
            return self.node_tells(outcome(destination, source, correlation, nobody));
        }
        self.numbers += 1;
        let number = self.numbers;
        let ends =
            BTreeMap::from([source, destination].map(|tid| (tid, End { here: true, ..End::default() })));
        self.links.insert(LinkNumber(number), Link { ends });
        self.introductions.insert(number, (source, correlation, destination));
        self.node_tells(layer(Kind::LNCL_INTRODUCTION, source, destination, number, number));
    }

    fn node_settles(&mut self, message: &Message) {
        let Header { source, destination, correlation, .. } = message.header;
        if destination.app != AppAddress::LNCL {
            return self.node_tells(message.clone_for_test());
        }
        let Some((asker, asked_as, peer)) = self.introductions.remove(&correlation) else { return };
        assert_eq!(peer, source);
        let told = outcome_of(message);
        if told == Outcome::Delivered {
            return self.node_tells(layer(Kind::LNCL_INTRODUCED, peer, asker, correlation, asked_as));
        }
        self.links.get_mut(&LinkNumber(correlation)).expect("made before").close(asker);
        self.node_tells(outcome(peer, asker, asked_as, told));
    }

    /// The node writes one message into an application's ring.
    fn node_writes(&mut self, to: usize) {
        let app = &mut self.apps[to];
        if app.from_node.len() < PIPE
            && let Some(message) = app.queue.pop()
        {
            app.from_node.push_back(message);
        }
    }

    /// An application looks at what the node has for it.
    fn look_at_node(&mut self, at: usize) {
        let Some(message) = self.apps[at].from_node.pop_front() else { return };
        let Header { kind, source, class, correlation, flags, .. } = message.header;
        match kind {
            Kind::OUTCOME => self.take_outcome(at, &message),
            Kind::LNCL_INTRODUCTION => self.take_introduction(at, source, number_of(&message)),
            Kind::LNCL_INTRODUCED => self.take_introduced(at, source, number_of(&message), correlation),
            Kind::LNCL_SWITCH => {
                let number = number_of(&message);
                let confirm = flags.has(Flags::CONFIRM).then_some(correlation);
                let told = match self.apps[at].routes.marked(source, number, class, confirm) {
                    Marked::Wait => None,
                    Marked::Connect { confirm } => {
                        assert!(self.other_end(number, tid(at)).offered, "it is offered before the SWITCH");
                        self.end_mut(number, tid(at)).connected = true;
                        self.connect(at, source, number);
                        confirm.map(|number| (number, Outcome::Delivered))
                    }
                    Marked::Open { confirm } => confirm.map(|number| (number, Outcome::Delivered)),
                    Marked::Known => confirm.map(|number| (number, Outcome::Delivered)),
                    Marked::Unknown => {
                        confirm.map(|number| (number, Outcome::Rejected(Rejection::Unsupported)))
                    }
                };
                if let Some((number, told)) = told {
                    self.tell_through(at, source, number, told);
                }
            }
            _ => self.take_passed(at, message),
        }
    }

    fn tell_through(&mut self, at: usize, about: Tid, correlation: u64, told: Outcome) {
        let own = self.apps[at].tid;
        self.apps[at].to_node.push_back(outcome(own, about, correlation, told));
    }

    fn take_outcome(&mut self, at: usize, message: &Message) {
        let (correlation, now) = (message.header.correlation, self.now);
        let app = &mut self.apps[at];
        if app.pending.remove(&correlation).is_some() {
            let is_new = self.ended.insert((app.life, correlation));
            assert!(is_new, "a message has ended twice");
            return;
        }
        match app.routes.answered(correlation, outcome_of(message), now) {
            Answered::Noted | Answered::NotOurs => {}
            Answered::End(peer, number) => self.end_link(at, peer, number),
        }
    }

    fn take_introduction(&mut self, at: usize, peer: Tid, number: LinkNumber) {
        self.look_at_ends(at);
        let own = self.apps[at].tid;
        let told = match self.apps[at].routes.introduction(peer) {
            Ok(()) => {
                self.end_mut(number, own).offered = true;
                self.apps[at].routes.offered(peer, number);
                Outcome::Delivered
            }
            Err(why) => {
                self.links.get_mut(&number).expect("made before").close(own);
                Outcome::Rejected(why)
            }
        };
        let lncl = Tid::new(NODE, AppAddress::LNCL);
        self.apps[at].to_node.push_back(outcome(own, lncl, number.0, told));
    }

    fn take_introduced(&mut self, at: usize, peer: Tid, number: LinkNumber, correlation: u64) {
        let own = self.apps[at].tid;
        let is_wanted = self.apps[at].routes.introduced(peer, correlation);
        let is_offered = self.other_end(number, own).offered && self.other_end(number, own).here;
        if !is_wanted || !is_offered {
            self.links.get_mut(&number).expect("made before").close(own);
            if is_wanted {
                self.apps[at].routes.ended(peer, self.now);
            }
            return;
        }
        self.end_mut(number, own).offered = true;
        self.end_mut(number, own).connected = true;
        self.connect(at, peer, number);
    }

    /// As [`say_switch`](Self::say_switch) for a link that stands from now on; sometimes there is no room for it yet.
    fn connect(&mut self, at: usize, peer: Tid, number: LinkNumber) {
        let is_full = self.apps[at].to_node.len() >= PIPE;
        let said = (!is_full).then(|| self.say_switch(at, peer, number));
        let now = self.now;
        self.apps[at].routes.connected(peer, number, said, now);
    }

    fn say_switch(&mut self, at: usize, peer: Tid, number: LinkNumber) -> u64 {
        let app = &mut self.apps[at];
        let correlation = app.correlate();
        app.to_node.push_back(layer(Kind::LNCL_SWITCH, app.tid, peer, number.0, correlation));
        correlation
    }

    /// An application looks at its links: who has gone, what is to be said again.
    fn look_at_ends(&mut self, at: usize) {
        let own = self.apps[at].tid;
        let now = self.now;
        for peer in (0..APPS).map(tid) {
            let Some(number) = self.apps[at].routes.link(peer) else { continue };
            let is_over = self.apps[at].early.iter().any(|(link, _)| *link == number);
            if self.other_end(number, own).here && !is_over {
                continue;
            }
            let is_connected = self.end_mut(number, own).connected;
            let end = self.other_end(number, own);
            let is_something = if is_connected { !end.ring.is_empty() } else { end.offered };
            let left = if is_something { Left::Something } else { Left::Nothing };
            match self.apps[at].routes.hung_up(peer, left, now) {
                Farewell::Read => {
                    while self.look_at_link(at, peer) {}
                    self.end_link(at, peer, number);
                }
                Farewell::Keep => {}
                Farewell::Drop => self.end_link(at, peer, number),
            }
        }
        while let Some((peer, number)) = self.apps[at].routes.switch_due(now) {
            let correlation = self.say_switch(at, peer, number);
            self.apps[at].routes.switched(peer, correlation, now);
        }
    }

    fn end_link(&mut self, at: usize, peer: Tid, number: LinkNumber) {
        let app = &mut self.apps[at];
        app.routes.ended(peer, self.now);
        let lost: Vec<_> = app.pending.iter().filter(|(_, link)| **link == Some(number)).collect();
        let lost: Vec<u64> = lost.into_iter().map(|(correlation, _)| *correlation).collect();
        for correlation in lost {
            app.pending.remove(&correlation);
            assert!(self.ended.insert((app.life, correlation)), "a message has ended twice");
        }
        let own = app.tid;
        self.links.get_mut(&number).expect("it was ours").close(own);
        self.take_early(at, number);
    }

    /// An application takes one message from a link whose ring it reads; whether there was one.
    fn look_at_link(&mut self, at: usize, peer: Tid) -> bool {
        let app = &self.apps[at];
        let Some(number) = app.routes.link(peer).filter(|_| app.routes.is_open(peer)) else { return false };
        let own = app.tid;
        let Some(message) = self.other_end(number, own).ring.pop_front() else { return false };
        if message.header.kind == Kind::OUTCOME {
            self.take_outcome(at, &message);
        } else {
            self.take(at, &message, Some(number));
        }
        true
    }

    fn take_passed(&mut self, at: usize, message: Message) {
        let Header { source, class, .. } = message.header;
        let now = self.now;
        match self.apps[at].routes.passed(source, class, now) {
            Passed::Take => self.take(at, &message, None),
            Passed::AfterLink(number) => self.apps[at].early.push_back((number, message)),
        }
    }

    /// An application takes what waited for the end of a link.
    fn take_early(&mut self, at: usize, ended: LinkNumber) {
        let early = std::mem::take(&mut self.apps[at].early);
        for (number, message) in early {
            if number == ended {
                self.take(at, &message, None);
            } else {
                self.apps[at].early.push_back((number, message));
            }
        }
    }

    fn take(&mut self, at: usize, message: &Message, link: Option<LinkNumber>) {
        let Header { class, sequence, source, correlation, flags, .. } = message.header;
        let life = life_of(message);
        assert!(self.taken.insert((life, sequence)), "message {sequence} of life {life} came twice");
        let seen = self.apps[at].seen.entry((source, class)).or_default();
        assert!(
            *seen < (life, sequence),
            "{class:?} {sequence} of life {life} came after {seen:?} of {source}"
        );
        *seen = (life, sequence);
        if !flags.has(Flags::CONFIRM) {
            return;
        }
        let own = self.apps[at].tid;
        let told = outcome(own, source, correlation, Outcome::Delivered);
        match link {
            Some(number) if self.links[&number].ends[&own].here => {
                self.end_mut(number, own).ring.push_back(told);
            }
            Some(_) => {}
            None => self.apps[at].to_node.push_back(told),
        }
    }

    /// The process of an application ends. What it had written still counts.
    fn kill(&mut self, at: usize) {
        let own = self.apps[at].tid;
        if !self.apps[at].alive {
            return;
        }
        self.apps[at].alive = false;
        self.deaths.insert(own);
        for link in self.links.values_mut() {
            link.close(own);
        }
        while !self.apps[at].to_node.is_empty() {
            self.node_reads(at);
        }
        // What the node had for it ends; the receipts of those who asked come back to them.
        let app = &mut self.apps[at];
        let waiting: Vec<_> = app.from_node.drain(..).chain(app.queue.drain_all()).collect();
        app.pending.clear();
        for message in waiting {
            self.lost_with_its_receiver(message);
        }
        self.fail_introductions(own);
    }

    fn lost_with_its_receiver(&mut self, message: Message) {
        let Header { kind, source, destination, correlation, flags, .. } = message.header;
        let is_confirmed = flags.has(Flags::CONFIRM) && (kind.is_user() || kind == Kind::LNCL_SWITCH);
        if is_confirmed && self.apps[index_of(source)].life_is(&message) {
            self.node_tells(outcome(destination, source, correlation, Outcome::Failed));
        }
    }

    /// A word about a route is lost: the application's queue was full, and it is told by nobody.
    fn lose_word(&mut self, at: usize) {
        let app = &mut self.apps[at];
        let is_about_a_route = |message: &Message| match message.header.kind {
            Kind::OUTCOME => !app.pending.contains_key(&message.header.correlation),
            _ => message.header.kind == Kind::LNCL_INTRODUCED,
        };
        let Some(index) = app.from_node.iter().position(is_about_a_route) else { return };
        let lost = app.from_node.remove(index).expect("just found");
        let own = app.tid;
        if lost.header.kind == Kind::LNCL_INTRODUCED {
            self.links.get_mut(&number_of(&lost)).expect("made before").close(own);
        }
    }

    fn fail_introductions(&mut self, gone: Tid) {
        let failed: Vec<_> =
            self.introductions.iter().filter(|(_, (_, _, peer))| *peer == gone).map(|(n, _)| *n).collect();
        for number in failed {
            let (asker, correlation, peer) = self.introductions.remove(&number).expect("just found");
            self.links.get_mut(&LinkNumber(number)).expect("made before").close(asker);
            self.node_tells(outcome(peer, asker, correlation, Outcome::Failed));
        }
    }

    fn revive(&mut self, at: usize) {
        if !self.apps[at].alive {
            // What the node had given to the life before was closed with it.
            self.links.values_mut().for_each(|link| link.close(tid(at)));
            self.lives += 1;
            self.apps[at] = App::new(tid(at), self.lives);
        }
    }

    /// The node's LNCL ends and comes back. Everybody reads what it had written, and connects again.
    fn restart_node(&mut self) {
        self.nodes_restarted = true;
        for (number, (asker, _, _)) in std::mem::take(&mut self.introductions) {
            self.links.get_mut(&LinkNumber(number)).expect("made before").close(asker);
        }
        let now = self.now;
        for at in 0..APPS {
            self.apps[at].queue = ClassQueue::new(QUEUE);
            while !self.apps[at].from_node.is_empty() {
                self.look_at_node(at);
            }
        }
        for app in &mut self.apps {
            app.to_node.clear();
            app.routes.node_has_ended(now);
            // What went through the node has no outcome any more.
            let through: Vec<_> =
                app.pending.iter().filter(|(_, link)| link.is_none()).map(|(n, _)| *n).collect();
            for correlation in through {
                app.pending.remove(&correlation);
                assert!(self.ended.insert((app.life, correlation)), "a message has ended twice");
            }
        }
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
