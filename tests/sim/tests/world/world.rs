//! Virtual time, the network, and the planned events.

use std::{
    collections::{BTreeMap, BTreeSet},
    net::{IpAddr, Ipv4Addr, SocketAddr},
    time::Duration,
};

use bytes::Bytes;
use sinew_gncl::core::{ConnectionId, Input as GnclInput};
use sinew_model::events::{GnclEvent, NdlEvent, SyncEvent};
use sinew_ndl::core::{Cast, Input as NdlInput};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};
use sinew_sim::{Chance, Coverage, History, Network, Quality, Queue};
use sinew_sync::Input as SyncInput;

use crate::{
    Fault,
    apps::App,
    judge::Judge,
    plan::{Layer, NODES, Plan, Step},
    process::Process,
    tcp::Tcp,
};

/// The start of virtual time: later than the largest lag of any clock.
pub(crate) const BEGIN: Time = Time::from_nanos(2_000_000_000_000);
/// Time between two checks of the state.
const LOOK_PERIOD: Duration = Duration::from_millis(50);
/// Time in which a leaving node sends its last frames.
const LINGER: Duration = Duration::from_millis(150);
const NDL_PORT: u16 = 7_400;
const GNCL_PORT: u16 = 5_000;

/// A datagram in flight.
#[derive(Clone, Debug)]
pub(crate) struct Flight {
    pub(crate) from: SocketAddr,
    pub(crate) to: SocketAddr,
    pub(crate) cast: Cast,
    pub(crate) bytes: Vec<u8>,
}

pub(crate) enum Event {
    Step(Step),
    Datagram(Flight),
    Probed { process: usize, input: Box<NdlInput> },
    Dialled { process: usize, instance: u64, connection: ConnectionId, address: SocketAddr },
    DialRefused { process: usize, instance: u64, connection: ConnectionId },
    Reached { tcp: usize },
    Segment { tcp: usize, side: usize },
    Posted { process: usize, layer: Layer },
    Wake { process: usize, layer: Layer },
    Starts { process: usize, slot: usize, incarnation: u64 },
    Arrives { process: usize },
    Gone { process: usize },
    Look,
}

pub(crate) struct World {
    pub(crate) plan: Plan,
    pub(crate) fault: Option<Fault>,
    history: History,
    pub(crate) chance: Chance,
    pub(crate) queue: Queue<Event>,
    pub(crate) network: Network<usize>,
    /// Pairs of nodes: datagrams of the first to the second are lost.
    pub(crate) muffled: BTreeSet<(usize, usize)>,
    /// Pairs of nodes: the first cannot connect to the second.
    pub(crate) firewalls: BTreeSet<(usize, usize)>,
    /// Nodes with slow segments of connections.
    pub(crate) slow: BTreeSet<usize>,
    /// Hosts that failed with their node.
    pub(crate) dead_hosts: BTreeSet<usize>,
    pub(crate) tcps: Vec<Tcp>,
    pub(crate) processes: Vec<Process>,
    /// The process of each node that runs.
    current: BTreeMap<usize, usize>,
    /// The last list from a process to a node.
    pub(crate) last_lists: BTreeMap<(usize, NodeAddress), Bytes>,
    pub(crate) judge: Judge,
    pub(crate) coverage: Coverage,
}

pub(crate) fn node_address(node: usize) -> NodeAddress {
    NodeAddress::new(0x0a00_0001 + u32::try_from(node).expect("few nodes"))
}

/// Returns the number of a node.
pub(crate) fn number_of(address: NodeAddress) -> usize {
    (address.bits() - node_address(0).bits()) as usize
}

fn ip(node: usize) -> Ipv4Addr {
    Ipv4Addr::from(node_address(node).bits())
}

pub(crate) fn udp_address(node: usize) -> SocketAddr {
    (ip(node), NDL_PORT).into()
}

pub(crate) fn gncl_address(node: usize) -> SocketAddr {
    (ip(node), GNCL_PORT).into()
}

impl World {
    pub(crate) fn new(plan: Plan, fault: Option<Fault>, history: History) -> Self {
        let mut queue = Queue::starting_at(BEGIN);
        for (at, step) in plan.steps.clone() {
            queue.push(BEGIN + at, Event::Step(step));
        }
        queue.push_after(LOOK_PERIOD, Event::Look);
        Self {
            fault,
            history,
            chance: Chance::new(!plan.seed),
            queue,
            network: Network::new(plan.quality),
            muffled: BTreeSet::new(),
            firewalls: BTreeSet::new(),
            slow: BTreeSet::new(),
            dead_hosts: BTreeSet::new(),
            tcps: Vec::new(),
            processes: Vec::new(),
            current: BTreeMap::new(),
            last_lists: BTreeMap::new(),
            judge: Judge::default(),
            coverage: Coverage::default(),
            plan,
        }
    }

    /// Runs the plan. Returns the counted situations.
    ///
    /// # Errors
    /// Returns the first violation.
    pub(crate) fn run(mut self) -> Result<Coverage, String> {
        let end = BEGIN + self.plan.end;
        while let Some(event) = self.queue.pop_until(end) {
            self.happen(event);
            self.verdict()?;
        }
        self.judge_rest();
        self.verdict()?;
        Ok(self.coverage)
    }

    fn verdict(&self) -> Result<(), String> {
        let at = self.queue.now().since(BEGIN);
        let scenario = self.plan.scenario;
        self.judge.violations.first().map_or(Ok(()), |words| Err(format!("{scenario:?}, at {at:?}: {words}")))
    }

    pub(crate) fn note(&self, process: usize, words: impl FnOnce() -> String) {
        let at = Time::from_nanos(self.queue.now().as_nanos() - BEGIN.as_nanos());
        self.history.note(at, || format!("node {} ({process}): {}", self.node_of(process), words()));
    }

    /// Returns the present reading of a process's clock.
    pub(crate) fn local(&self, process: usize) -> Time {
        self.processes[process].clock.read(self.queue.now())
    }

    pub(crate) fn nodes(&self) -> std::ops::Range<usize> {
        0..NODES
    }

    /// Returns the process of a node, if it runs.
    pub(crate) fn current(&self, node: usize) -> Option<usize> {
        self.current.get(&node).copied()
    }

    /// Returns the processes that run.
    pub(crate) fn running(&self) -> Vec<usize> {
        self.current.values().copied().collect()
    }

    /// Returns the node with this IP address.
    pub(crate) fn node_at(&self, address: SocketAddr) -> Option<usize> {
        self.nodes().find(|node| IpAddr::V4(ip(*node)) == address.ip())
    }

    /// Returns whether packets of a connection from one node reach the host of another.
    pub(crate) fn may_connect(&self, from: usize, to: usize) -> bool {
        !self.network.is_apart(from, to)
            && !self.firewalls.contains(&(from, to))
            && !self.dead_hosts.contains(&to)
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Step(step) => self.step(step),
            Event::Datagram(flight) => self.datagram_arrives(&flight),
            Event::Reached { tcp } => self.reached(tcp),
            Event::Segment { tcp, side } => self.segments_arrive(tcp, side),
            Event::Look => {
                self.look();
                self.queue.push_after(LOOK_PERIOD, Event::Look);
            }
            Event::Probed { process, .. }
            | Event::Dialled { process, .. }
            | Event::DialRefused { process, .. }
            | Event::Posted { process, .. }
            | Event::Wake { process, .. }
            | Event::Starts { process, .. }
            | Event::Arrives { process }
            | Event::Gone { process }
                if !self.processes[process].is_alive => {}
            Event::Probed { process, input } => self.ndl_input(process, *input),
            Event::Dialled { process, instance, connection, address } => {
                self.dialled(process, instance, connection, address);
            }
            Event::DialRefused { process, instance, connection } => {
                self.dial_refused(process, instance, connection);
            }
            Event::Posted { process, layer } => self.read_posts(process, layer),
            Event::Wake { process, layer } => self.wake(process, layer),
            Event::Starts { process, slot, incarnation } => self.app_starts(process, slot, incarnation),
            Event::Arrives { process } => self.member_arrives(process),
            Event::Gone { process } => self.end(process, false),
        }
    }

    fn read_posts(&mut self, process: usize, layer: Layer) {
        let now = self.queue.now();
        match layer {
            Layer::Ndl => {
                while let Some(event) = self.processes[process].event_queues.ndl.receive(now) {
                    self.take_ndl_event(process, event);
                }
            }
            Layer::Gncl => {
                while let Some(event) = self.processes[process].event_queues.gncl.receive(now) {
                    self.take_gncl_event(process, event);
                }
            }
            Layer::Sync => {
                while let Some(event) = self.processes[process].event_queues.sync.receive(now) {
                    self.take_sync_event(process, event);
                }
            }
        }
    }

    fn read_at(&mut self) -> Time {
        self.queue.now() + self.chance.between(Duration::from_micros(10), self.plan.read_max)
    }

    pub(crate) fn post_ndl(&mut self, process: usize, event: NdlEvent) {
        let at = self.read_at();
        let at = self.processes[process].event_queues.ndl.send(at, event);
        self.queue.push(at, Event::Posted { process, layer: Layer::Ndl });
    }

    pub(crate) fn post_gncl(&mut self, process: usize, event: GnclEvent) {
        let at = self.read_at();
        let at = self.processes[process].event_queues.gncl.send(at, event);
        self.queue.push(at, Event::Posted { process, layer: Layer::Gncl });
    }

    pub(crate) fn post_sync(&mut self, process: usize, event: SyncEvent) {
        let at = self.read_at();
        let at = self.processes[process].event_queues.sync.send(at, event);
        self.queue.push(at, Event::Posted { process, layer: Layer::Sync });
    }

    fn next_wake(&self, process: usize, layer: Layer) -> Option<Time> {
        let process = &self.processes[process];
        match layer {
            Layer::Ndl => process.ndl.next_wake(),
            Layer::Gncl => process.gncl.next_wake(),
            Layer::Sync => process.sync.next_wake(),
        }
    }

    pub(crate) fn set_timer(&mut self, process: usize, layer: Layer) {
        let Some(then) = self.next_wake(process, layer) else { return };
        let now = self.queue.now();
        let at = self.processes[process].clock.when(now, then).max(now + Duration::from_micros(1));
        if self.processes[process].timers[layer as usize].set(at) {
            self.queue.push(at, Event::Wake { process, layer });
        }
    }

    fn wake(&mut self, process: usize, layer: Layer) {
        let now = self.queue.now();
        if !self.processes[process].timers[layer as usize].expires(now) {
            return;
        }
        let local = self.local(process);
        if self.next_wake(process, layer).is_none_or(|then| then > local) {
            return self.set_timer(process, layer);
        }
        match layer {
            Layer::Ndl => self.ndl_time_passed(process),
            Layer::Gncl => self.gncl(process, GnclInput::TimePassed),
            Layer::Sync => self.sync(process, SyncInput::TimePassed),
        }
    }

    fn step(&mut self, step: Step) {
        let at = Time::from_nanos(self.queue.now().as_nanos() - BEGIN.as_nanos());
        self.history.note(at, || format!("{step:?}"));
        match step {
            Step::Start { node } => self.start(node),
            Step::Kill { node, host_dies } => {
                if let Some(process) = self.current(node) {
                    self.coverage.count("kills");
                    self.end(process, host_dies);
                }
            }
            Step::Leave { node } => self.leave(node),
            Step::Cut { from, to } => {
                self.network.cut(from, to);
                self.judge.troubled(from, to);
            }
            Step::Part { these } => self.part(&these),
            Step::Muffle { from, to } => _ = self.muffled.insert((from, to)),
            Step::Slow { node } => _ = self.slow.insert(node),
            Step::Reset { one, other } => self.reset_all(one, other),
            Step::Firewall { from, to } => _ = self.firewalls.insert((from, to)),
            Step::Move { node } => {
                if let Some(process) = self.current(node) {
                    self.move_gncl(process);
                }
            }
            Step::RestartLayer { node, layer } => self.restart_layer(node, layer),
            Step::Fail { node, app } => {
                if let Some(process) = self.current(node) {
                    self.app_fails(process, app);
                }
            }
            Step::Heal => self.heal(),
            Step::Meet => self.running().into_iter().for_each(|process| self.member_arrives(process)),
        }
    }

    fn start(&mut self, node: usize) {
        if let Some(process) = self.current(node) {
            if self.processes[process].is_leaving {
                // The address is still used.
                self.queue.push_after(LINGER, Event::Step(Step::Start { node }));
            }
            return;
        }
        self.dead_hosts.remove(&node);
        self.slow.remove(&node);
        let process = self.processes.len();
        let incarnation = Incarnation(1_000_000 + process as u64);
        let apps = App::all_of(&self.plan, node);
        let clock = self.plan.clocks[node];
        self.processes.push(Process::new(node, incarnation, clock, self.plan.seed, apps));
        self.current.insert(node, process);
        self.judge.started(process, node_address(node), incarnation);
        self.register_apps(process);
        self.start_ndl(process);
        self.ndl_input(process, NdlInput::PeersRemembered(Vec::new()));
    }

    /// Ends a process.
    fn end(&mut self, process: usize, host_dies: bool) {
        let node = self.node_of(process);
        self.processes[process].is_alive = false;
        self.current.remove(&node);
        let now = self.queue.now();
        for app in self.processes[process].apps.clone() {
            self.judge.app_ended(now, process, &app);
        }
        self.judge.ended(process);
        if !host_dies {
            return self.shut_all_of(process);
        }
        self.dead_hosts.insert(node);
        for tcp in &mut self.tcps {
            for side in 0..2 {
                if tcp.ends[side].process == process {
                    tcp.ends[side].is_open = false;
                    tcp.pipes[side].cut(&mut self.chance);
                }
            }
        }
    }

    fn leave(&mut self, node: usize) {
        let Some(process) = self.current(node) else { return };
        self.coverage.count("leaves");
        self.processes[process].is_leaving = true;
        self.judge.left(process);
        // The root stops the applications, then the layers, of which the sync manager is the first.
        self.stop_apps(process);
        self.ndl_input(process, NdlInput::Stopping);
        let peers = self.processes[process].store.0.iter();
        let undelivered_to = peers.filter(|(_, peer)| peer.left() > 0).map(|(node, _)| *node).collect();
        self.gncl(process, GnclInput::LeaveRequested { undelivered_to });
        self.queue.push_after(LINGER, Event::Gone { process });
    }

    fn part(&mut self, these: &[usize]) {
        self.coverage.count("partitions");
        let others: Vec<usize> = self.nodes().filter(|node| !these.contains(node)).collect();
        self.network.part(these, &others);
        for (one, other) in these.iter().flat_map(|one| others.iter().map(move |other| (*one, *other))) {
            self.judge.troubled(one, other);
        }
    }

    fn reset_all(&mut self, one: usize, other: usize) {
        let now = self.queue.now();
        self.judge.troubled(one, other);
        self.judge.mended(now, one, other);
        for tcp in 0..self.tcps.len() {
            let ends = self.tcps[tcp].ends;
            let nodes = ends.map(|end| self.node_of(end.process));
            let is_between = nodes == [one, other] || nodes == [other, one];
            if is_between && ends.iter().all(|end| end.is_open) {
                self.coverage.count("connections cut");
                self.reset(tcp);
            }
        }
    }

    fn restart_layer(&mut self, node: usize, layer: Layer) {
        let Some(process) = self.current(node).filter(|process| !self.processes[*process].is_leaving) else {
            return;
        };
        self.coverage.count("restarts of layers");
        self.note(process, || format!("{layer:?} is restarted"));
        match layer {
            Layer::Ndl => self.start_ndl(process),
            Layer::Gncl => {
                for other in self.nodes().filter(|other| *other != node) {
                    let now = self.queue.now();
                    self.judge.troubled(node, other);
                    self.judge.mended(now, node, other);
                }
                self.restart_gncl(process);
            }
            Layer::Sync => self.restart_sync(process),
        }
    }

    fn heal(&mut self) {
        self.plan.quality = Quality::GOOD;
        self.network.heal(Quality::GOOD);
        self.muffled.clear();
        self.slow.clear();
        self.judge.all_mended(self.queue.now());
    }
}
