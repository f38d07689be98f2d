//! A network of cores in virtual time: datagrams take 100 us, and arrive as bytes.

use std::{
    cell::RefCell,
    collections::{BTreeMap, BTreeSet},
    net::{Ipv4Addr, SocketAddr, SocketAddrV4},
    time::Duration,
};

use sinew_model::{
    clocks::ClockOffset,
    config::{NodeConfig, WatchGroup},
    facts::{AppFact, LinkFact, LossReason, MembershipFact, NodeEvent},
};
use sinew_runtime::{
    outcome::Rejection,
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};
use sinew_sim::Chance;

use crate::{
    core::{Cast, Core, Input, Output, Place, address_conflict::Claimant},
    datagram::{Answer, Body, Datagram, encode},
    node_events::{self, NodeEvents},
};

/// The application of each process that is notified of changes.
const APP: AppAddress = AppAddress::new(0x1000);

pub(super) const PERIOD: Duration = Duration::from_millis(500);
const FLIGHT: Duration = Duration::from_micros(100);

pub(super) const fn ms(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

/// The UDP address of the `index`-th process.
pub(super) fn udp(index: u16) -> SocketAddr {
    SocketAddr::from(([10, 0, 0, 1], 1_000 + index))
}

/// Returns the place at which the `index`-th process meets the one at `there`.
pub(super) fn place(index: u16, there: SocketAddr) -> Place {
    Place { there, here: udp(index) }
}

pub(super) fn node(address: u32) -> NodeAddress {
    NodeAddress::new(address)
}

/// The `index`-th process, as one that has this node address.
pub(super) fn claimant(address: u32, index: u16) -> Claimant {
    Claimant { name: format!("node-{address}"), at: udp(index) }
}

/// The properties of a process.
#[derive(Clone, Debug)]
pub(super) struct Spec {
    pub(super) node: u32,
    pub(super) incarnation: u64,
    pub(super) project: &'static str,
    pub(super) seeds: Vec<SocketAddr>,
    pub(super) multicast: bool,
    pub(super) nodes_max: usize,
    /// Its clock minus the world's.
    pub(super) clock_ns: i64,
    /// The nodes that it watches at another pace.
    pub(super) watch: Vec<WatchGroup>,
    /// Further addresses of its GNCL.
    pub(super) further: Vec<SocketAddrV4>,
    /// Its connections authenticate the other end.
    pub(super) has_keys: bool,
}

impl Spec {
    pub(super) fn of(node: u32) -> Self {
        Self {
            node,
            incarnation: 1,
            project: "p",
            seeds: Vec::new(),
            multicast: true,
            nodes_max: 64,
            clock_ns: 0,
            watch: Vec::new(),
            further: Vec::new(),
            has_keys: false,
        }
    }

    pub(super) fn core(&self, boot_nonce: u64) -> Core {
        let mut config = NodeConfig::new(format!("node-{}", self.node));
        config.project = self.project.to_owned();
        config.ndl.seeds = self.seeds.iter().copied().map(Into::into).collect();
        config.ndl.nodes_max = self.nodes_max;
        config.ndl.period = PERIOD;
        config.ndl.watch.clone_from(&self.watch);
        if !self.multicast {
            config.ndl.multicast = None;
        }
        config.security.keys = self.has_keys.then(|| "keys".into());
        let secret = u128::from(boot_nonce) << 3;
        Core::new(&config, node(self.node), Incarnation(self.incarnation), boot_nonce, secret)
    }
}

/// One process.
pub(super) struct Process {
    pub(super) core: Core,
    further: Vec<SocketAddrV4>,
    clock_ns: i64,
    is_alive: bool,
    /// The delay of its timer, each time.
    pub(super) late: Duration,
    /// The time until which it gets no CPU time.
    stalled_until: Time,
    pub(super) facts: Vec<MembershipFact>,
    pub(super) events: Vec<NodeEvent>,
    pub(super) others: Vec<Output>,
    pub(super) clocks: BTreeMap<NodeAddress, ClockOffset>,
    pub(super) datagrams_sent: usize,
    /// Its application has no room.
    pub(super) is_busy: bool,
    pending_events: NodeEvents,
    /// The nodes with hosts to be tried.
    pub(super) probes: Vec<(NodeAddress, Incarnation)>,
}

struct Flying {
    from: SocketAddr,
    to: SocketAddr,
    cast: Cast,
    bytes: Vec<u8>,
}

/// All processes and the datagrams in flight between them.
pub(super) struct World {
    pub(super) now: Time,
    pub(super) processes: BTreeMap<SocketAddr, Process>,
    flying: BTreeMap<(Time, u64), Flying>,
    sequence: u64,
    cut: BTreeSet<(SocketAddr, SocketAddr)>,
    /// Datagrams from one to the other so far.
    sent: BTreeMap<(SocketAddr, SocketAddr), u64>,
    /// Each n-th of those is lost.
    pub(super) loses_each: Option<u64>,
    /// Random loss, per thousand.
    pub(super) loses_per_mille: u64,
    chance: Chance,
    /// Connections deliver: minimum and maximum time of a liveness hint after a request.
    pub(super) hints_after: Option<(Duration, Duration)>,
    /// The time of each requested hint, and of the last one given.
    hints: BTreeMap<(SocketAddr, NodeAddress, Incarnation), (Time, Option<Time>)>,
    /// No leave arrives.
    pub(super) loses_leaves: bool,
    /// Time of a datagram in flight.
    pub(super) flight: Duration,
}

impl World {
    pub(super) fn new() -> Self {
        Self {
            // Later than the largest lag of any clock.
            now: Time::from_nanos(1_000_000_000_000),
            processes: BTreeMap::new(),
            flying: BTreeMap::new(),
            sequence: 0,
            cut: BTreeSet::new(),
            sent: BTreeMap::new(),
            loses_each: None,
            loses_per_mille: 0,
            chance: Chance::new(0),
            hints_after: None,
            hints: BTreeMap::new(),
            loses_leaves: false,
            flight: FLIGHT,
        }
    }

    /// A world in which the nodes 1 to `count`, at `udp` of their numbers, know each other.
    pub(super) fn of_members(count: u16) -> Self {
        let mut world = Self::new();
        (1..=count).for_each(|index| world.start(index, &Spec::of(index.into())));
        world.run(ms(100));
        (1..=count).for_each(|index| assert_eq!(world.at(index).core.members.len(), usize::from(count) - 1));
        world.forget_the_past();
        world
    }

    pub(super) fn forget_the_past(&mut self) {
        for process in self.processes.values_mut() {
            process.facts.clear();
            process.events.clear();
            process.others.clear();
            process.datagrams_sent = 0;
        }
    }

    pub(super) fn start(&mut self, index: u16, spec: &Spec) {
        let nonce = u64::from(index) << 32 | u64::from(spec.node) << 8 | spec.incarnation;
        let core = spec.core(nonce);
        let process = Process {
            core,
            further: spec.further.clone(),
            clock_ns: spec.clock_ns,
            is_alive: true,
            late: Duration::ZERO,
            stalled_until: Time::ZERO,
            facts: Vec::new(),
            events: Vec::new(),
            others: Vec::new(),
            clocks: BTreeMap::new(),
            datagrams_sent: 0,
            is_busy: false,
            pending_events: node_events::new(spec.nodes_max),
            probes: Vec::new(),
        };
        self.processes.insert(udp(index), process);
        self.restart_shell(index);
        self.with(udp(index), |core, now| core.handle(now, Input::AppChanged(AppFact::Ready { app: APP })));
    }

    pub(super) fn restart_shell(&mut self, index: u16) {
        let gncl = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 5_000 + index);
        let further = self.process(index).further.clone();
        self.with(udp(index), |core, now| {
            core.announce_gncl((std::iter::once(gncl).chain(further).collect(), None));
            core.start(now, &[udp(index)]);
        });
    }

    /// Sets the seed of all random choices.
    pub(super) fn seeded(mut self, seed: u64) -> Self {
        self.chance = Chance::new(seed);
        self
    }

    pub(super) fn kill(&mut self, index: u16) {
        let process = self.process(index);
        process.is_alive = false;
        let me = process.core.announcement();
        let killed = (me.node, me.incarnation);
        let now = self.now;
        for ((_, node, incarnation), (next, last)) in &mut self.hints {
            if (*node, *incarnation) == killed && *next > now {
                // Datagrams in flight never arrive.
                *next = last.unwrap_or(Time::MAX);
            }
        }
    }

    pub(super) fn is_alive(&self, index: u16) -> bool {
        self.at(index).is_alive
    }

    pub(super) fn stall(&mut self, index: u16, duration: Duration) {
        let until = self.now + duration;
        self.process(index).stalled_until = until;
    }

    /// Datagrams from one to the other are lost.
    pub(super) fn cut(&mut self, from: u16, to: u16) {
        self.cut.insert((udp(from), udp(to)));
    }

    pub(super) fn mend(&mut self) {
        self.cut.clear();
    }

    pub(super) fn link(&mut self, index: u16, fact: LinkFact) {
        self.input(index, Input::Link(fact));
    }

    pub(super) fn input(&mut self, index: u16, input: Input) {
        self.with(udp(index), |core, now| core.handle(now, input));
    }

    /// Sends a handwritten datagram with any source address.
    pub(super) fn forge(&mut self, from: SocketAddr, to: u16, bytes: &[u8]) {
        self.with(udp(to), |core, now| core.receive(now, place(to, from), Cast::Unicast, bytes));
    }

    pub(super) fn at(&self, index: u16) -> &Process {
        &self.processes[&udp(index)]
    }

    pub(super) fn process(&mut self, index: u16) -> &mut Process {
        self.processes.get_mut(&udp(index)).unwrap()
    }

    pub(super) fn has_member(&self, index: u16, address: u32) -> bool {
        self.at(index).core.members.contains_key(&node(address))
    }

    /// Returns whether `index` found that its node address is another's.
    pub(super) fn gave_up(&self, index: u16) -> bool {
        self.at(index).others.iter().any(|output| matches!(output, Output::AddressTaken { .. }))
    }

    /// Returns the reasons for which `index` lost nodes, in order.
    pub(super) fn losses(&self, index: u16) -> Vec<(u32, LossReason)> {
        let facts = self.at(index).facts.iter().filter_map(|fact| match fact {
            MembershipFact::NodeLost { node, why, .. } => Some((node.bits(), why.clone())),
            MembershipFact::NodeFound { .. } => None,
        });
        facts.collect()
    }

    /// Runs until `condition` holds, for at most `limit`. Returns the time that it took.
    pub(super) fn run_until(&mut self, limit: Duration, condition: impl Fn(&Self) -> bool) -> Duration {
        let start = self.now;
        while !condition(self) {
            assert!(self.now < start + limit, "did not happen within {limit:?}");
            self.step(start + limit);
        }
        self.now.since(start)
    }

    pub(super) fn run(&mut self, duration: Duration) {
        let end = self.now + duration;
        while self.now < end {
            self.step(end);
        }
    }

    /// Runs to the next event, or to `end` if there is none before it.
    fn step(&mut self, end: Time) {
        let arrival = self.flying.keys().next().map(|(time, _)| *time);
        let wakes = self.processes.iter().filter(|(_, process)| process.is_alive);
        let wake = wakes
            .filter_map(|(address, process)| Some((process.wake()?, *address)))
            .min_by_key(|(time, address)| (*time, *address));
        let wake_time = wake.map_or(Time::MAX, |(time, _)| time);
        let next = arrival.unwrap_or(Time::MAX).min(wake_time).max(self.now);
        if next > end {
            self.now = end;
            return;
        }
        self.now = next;
        // A timer fires before a datagram of the same moment: the harder order.
        match wake {
            Some((time, address)) if time <= next => {
                self.give_hints(address);
                self.with(address, |core, now| core.handle(now, Input::TimePassed));
            }
            Some(_) | None => self.land(),
        }
    }

    /// Requests a liveness hint from the other GNCL on their connection.
    fn request_liveness(&mut self, from: SocketAddr, node: NodeAddress, incarnation: Incarnation) {
        let Some((least, most)) = self.hints_after else { return };
        let is_it = |process: &&Process| {
            let me = process.core.announcement();
            (me.node, me.incarnation) == (node, incarnation) && process.is_alive
        };
        if self.processes.values().find(is_it).is_some_and(|process| process.stalled_until <= self.now) {
            let at = self.now + self.chance.between(least, most);
            let (next, last) = self.hints.entry((from, node, incarnation)).or_insert((at, None));
            // A hint in flight comes first.
            if *next <= self.now {
                (*next, *last) = (at, Some(*next));
            }
        }
    }

    /// Reports GNCL's liveness hints of members in doubt, as the shell does before it reports that time passed, and
    /// only then.
    fn give_hints(&mut self, address: SocketAddr) {
        for (node, incarnation) in self.processes[&address].core.in_doubt() {
            let hint = self.hints.get(&(address, node, incarnation)).copied();
            let read = hint.and_then(|(next, last)| if next <= self.now { Some(next) } else { last });
            if let Some(at) = read {
                self.with(address, |core, now| {
                    core.handle(now, Input::HintReceived { node, incarnation, at });
                });
            }
        }
    }

    fn land(&mut self) {
        let Some((_, flying)) = self.flying.pop_first() else { return };
        let Some(process) = self.processes.get(&flying.to).filter(|process| process.is_alive) else { return };
        if process.stalled_until > self.now {
            // It waits in the socket.
            self.sequence += 1;
            self.flying.insert((process.stalled_until, self.sequence), flying);
            return;
        }
        let place = Place { there: flying.from, here: flying.to };
        self.with(flying.to, |core, now| core.receive(now, place, flying.cast, &flying.bytes));
    }

    pub(super) fn with(&mut self, address: SocketAddr, act: impl FnOnce(&mut Core, Time)) {
        let process = self.processes.get_mut(&address).unwrap();
        let now = self.now.shifted(process.clock_ns);
        act(&mut process.core, now);
        while let Some(output) = self.processes.get_mut(&address).unwrap().core.poll() {
            self.execute(address, now, output);
        }
    }

    fn execute(&mut self, from: SocketAddr, now: Time, output: Output) {
        let process = self.processes.get_mut(&from).unwrap();
        let me = process.core.announcement().clone();
        match output {
            Output::SendQuery { to, correlation } => {
                self.send(from, to.there, Datagram { correlation, sent: now, body: Body::Query(me) });
            }
            Output::SendMulticastQuery { correlation, .. } => {
                let bytes =
                    encode(&Datagram { correlation, sent: now, body: Body::Query(me) }, NodeAddress::ALL);
                let all: Vec<SocketAddr> = self.processes.keys().copied().collect();
                all.into_iter().for_each(|to| self.fly(from, to, Cast::Multicast, &bytes));
            }
            Output::SendAnswer { to, correlation, query_sent, query_received, .. } => {
                let (query_sent_ns, query_received_ns) = (query_sent.as_nanos(), query_received.as_nanos());
                let progress = self.processes[&from].core.progress().clone();
                let answer = Answer { announcement: me, query_sent_ns, query_received_ns, progress };
                self.send(from, to.there, Datagram { correlation, sent: now, body: Body::Answer(answer) });
            }
            Output::SendLeave { .. } if self.loses_leaves => {}
            Output::SendLeave { to, .. } => {
                self.send(
                    from,
                    to.there,
                    Datagram { correlation: 0, sent: now, body: Body::Leave(me.into()) },
                );
            }
            Output::Probe { node, incarnation, .. } => {
                process.probes.push((node, incarnation));
                self.request_liveness(from, node, incarnation);
            }
            Output::RequestLiveness { node, incarnation } => self.request_liveness(from, node, incarnation),
            Output::Fact(fact) => process.facts.push(fact),
            Output::Event { to, event } => {
                let Process { pending_events, events, is_busy, .. } = process;
                let _ = pending_events.notify(to, event, |event| {
                    if *is_busy {
                        return Err(Rejection::QueueFull);
                    }
                    events.push(event.clone());
                    Ok(())
                });
            }
            Output::ClockMeasured { node, offset, .. } => drop(process.clocks.insert(node, offset)),
            other @ (Output::Moved { .. }
            | Output::Forgotten { .. }
            | Output::Collision { .. }
            | Output::AddressTaken { .. }
            | Output::Stalled { .. }) => {
                process.others.push(other);
            }
        }
    }

    /// The application of a process has room again.
    pub(super) fn application_has_room(&mut self, index: u16) {
        let process = self.process(index);
        process.is_busy = false;
        let received = RefCell::new(Vec::new());
        process.pending_events.offer(|_, event| {
            received.borrow_mut().push(event.clone());
            Ok(())
        });
        process.events.extend(received.into_inner());
    }

    fn send(&mut self, from: SocketAddr, to: SocketAddr, datagram: Datagram) {
        self.fly(from, to, Cast::Unicast, &encode(&datagram, NodeAddress::ALL));
    }

    fn fly(&mut self, from: SocketAddr, to: SocketAddr, cast: Cast, bytes: &[u8]) {
        self.processes.get_mut(&from).unwrap().datagrams_sent += 1;
        let sent = self.sent.entry((from, to)).or_default();
        *sent += 1;
        let is_lost = self.loses_each.is_some_and(|each| sent.is_multiple_of(each))
            || self.loses_per_mille > 0 && self.chance.happens(self.loses_per_mille);
        if !is_lost && !self.cut.contains(&(from, to)) {
            self.sequence += 1;
            let flying = Flying { from, to, cast, bytes: bytes.to_vec() };
            self.flying.insert((self.now + self.flight, self.sequence), flying);
        }
    }
}

impl Process {
    /// Returns the time of its next timer, in the world's time.
    fn wake(&self) -> Option<Time> {
        Some((self.core.next_wake()?.shifted(-self.clock_ns) + self.late).max(self.stalled_until))
    }
}
