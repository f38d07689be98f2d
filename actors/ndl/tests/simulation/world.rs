//! Virtual time, the events of a run, and processes that each run a core.

mod events;
mod outputs;

use std::{
    collections::{BTreeMap, BTreeSet},
    hash::{DefaultHasher, Hash, Hasher},
    net::{Ipv4Addr, SocketAddr, SocketAddrV4},
    rc::Rc,
    time::{Duration, Instant},
};

use rustix::time::{ClockId, clock_gettime};
use sinew_model::{
    config::{NodeConfig, WatchGroup},
    facts::{AppFact, LinkFact, MembershipFact, Trouble},
    progress::{Part, Progress, TroubleCode},
};
use sinew_ndl::{
    core::{Cast, Host, Input, Output, Place, Source},
    datagram::{Answer, Body, Datagram, encode},
};
use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};
use sinew_sim::{Chance, Clock, Coverage, History, Queue, Stall};

use super::{
    faults::{Fault, TestedCore},
    judge::Judge,
    listeners::{Listeners, Truth},
    network::{Flight, Kind, Networks, node_address},
    plan::{Finding, Plan, Step},
};

/// Later than the largest lag of any clock.
pub(super) const BEGIN: Time = Time::from_nanos(1_000_000_000_000);
const PORT: u16 = 7_400;
const GNCL_PORT: u16 = 5_000;
/// An address that each host has.
const SHARED: Ipv4Addr = Ipv4Addr::new(172, 17, 0, 1);
/// Maximum number of datagrams in a socket: about Linux's default for this size.
const SOCKET_MAX: usize = 256;
/// Longest time until mDNS reports a node, or a peer's host refuses a connection.
const REPORT_DELAY_MAX: Duration = Duration::from_millis(5);
/// The subscribed application of each process, and the one that stalls now and then.
const LISTENER: AppAddress = AppAddress::new(0x1000);
const TROUBLED: AppAddress = AppAddress::new(0x2000);

/// The result of a run without violations.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Outcome {
    pub(super) coverage: Coverage,
    /// A digest of all facts, in order.
    digest: u64,
}

enum Event {
    Datagram(Flight),
    Wake(usize),
    Resume(usize),
    Input(usize, Box<Input>),
    /// GNCL of the first process reads data of the second one.
    Hint(usize, usize),
    Step(Step),
}

struct Process {
    node: usize,
    tested: TestedCore,
    /// One address in each network.
    addresses: Vec<SocketAddr>,
    clock: Clock,
    is_alive: bool,
    /// Its pauses, and the contents of its socket meanwhile.
    stall: Stall<Flight>,
    /// The beginning and the end of its last stall; zero without one.
    stalled: (Time, Time),
    /// The time at which it will check its timer. The kit's timer is never late.
    wake: Option<Time>,
    /// The time that this timer was set for, by its clock.
    wakes_for: Time,
    /// The addresses that mDNS need not report to it.
    met: BTreeSet<SocketAddr>,
    /// The addresses that it sent a leave to.
    leaves: BTreeSet<SocketAddr>,
    /// Its stalled applications, now and ever.
    troubles: Truth,
}

pub(super) struct World {
    plan: Plan,
    fault: Option<Fault>,
    history: History,
    chance: Chance,
    queue: Queue<Event>,
    networks: Networks,
    judge: Judge,
    listeners: Listeners,
    processes: Vec<Process>,
    /// The process of each node, and its number.
    current: BTreeMap<usize, usize>,
    at: BTreeMap<SocketAddr, usize>,
    /// Hosts that failed with their node: nothing answers there until it starts again.
    dead_hosts: BTreeSet<usize>,
    /// The last time that a process's GNCL read of another one, in that process's clock.
    hints: BTreeMap<(usize, usize), Time>,
    /// The last change between two nodes: of the path between them, or of the incarnation of either.
    changed: BTreeMap<(usize, usize), Time>,
    coverage: Coverage,
    digest: DefaultHasher,
    /// Whether the cores' time is measured: the measurement takes as long as handling a datagram.
    is_measured: bool,
    /// Host time used by the cores, including reading datagrams.
    pub(super) in_cores: Duration,
}

/// Returns the node with this address, if there is one.
fn node_at(address: NodeAddress) -> usize {
    (address.bits() - node_address(0).bits()) as usize
}

/// Returns the address of a node in a network.
fn ip(node: usize, network: usize) -> Ipv4Addr {
    Ipv4Addr::from(node_address(node).bits() + (u32::try_from(network).expect("few networks") << 16))
}

/// Returns the network of an address.
fn network_of(address: SocketAddr) -> usize {
    match address {
        SocketAddr::V4(address) => usize::from(address.ip().octets()[1]),
        SocketAddr::V6(_) => unreachable!("all are IPv4"),
    }
}

impl World {
    pub(super) fn new(plan: Plan, fault: Option<Fault>, history: &History) -> Self {
        let mut world = Self {
            fault,
            history: history.clone(),
            chance: Chance::new(!plan.seed),
            queue: Queue::starting_at(BEGIN),
            networks: Networks::new(plan.quality, plan.networks),
            judge: Judge::new(&plan),
            listeners: Listeners::default(),
            processes: Vec::new(),
            current: BTreeMap::new(),
            at: BTreeMap::new(),
            dead_hosts: BTreeSet::new(),
            hints: BTreeMap::new(),
            changed: BTreeMap::new(),
            coverage: Coverage::default(),
            digest: DefaultHasher::new(),
            is_measured: false,
            in_cores: Duration::ZERO,
            plan,
        };
        for (at, step) in std::mem::take(&mut world.plan.steps) {
            world.queue.push(BEGIN + at, Event::Step(step));
        }
        world.note(|| format!("{:?}", world.plan));
        world
    }

    /// Enables the measurement of the cores' time.
    pub(super) const fn measured(mut self) -> Self {
        self.is_measured = true;
        self
    }

    fn note(&self, words: impl FnOnce() -> String) {
        let at = Time::from_nanos(self.now().as_nanos() - BEGIN.as_nanos());
        self.history.note(at, words);
    }

    /// Runs as [`World::run`] does, and prints the progress on standard output after each period.
    ///
    /// # Errors
    /// Returns the violations, one a line.
    pub(super) fn run_with_progress(mut self) -> Result<Outcome, String> {
        let (began, end, period) = (Instant::now(), BEGIN + self.plan.end, self.plan.period);
        while self.now() < end && self.judge.violations.is_empty() {
            self.run_until(end.min(self.now() + period));
            println!(
                "crowd {} of {}: {:.1} s of {:.1} s, {} datagrams, {} members found, {} events ahead, after {:.0} s",
                self.plan.seed,
                self.plan.nodes,
                self.now().since(BEGIN).as_secs_f64(),
                self.plan.end.as_secs_f64(),
                self.coverage.of("datagrams"),
                self.coverage.of("found"),
                self.queue.len(),
                began.elapsed().as_secs_f64()
            );
        }
        self.run()
    }

    /// Runs the plan. Returns the counted situations.
    ///
    /// # Errors
    /// Returns the violations, one a line.
    pub(super) fn run(mut self) -> Result<Outcome, String> {
        let end = BEGIN + self.plan.end;
        self.run_until(end);
        let views: Vec<_> = self.current.values().map(|process| (*process, self.view(*process))).collect();
        if self.judge.violations.is_empty() {
            self.judge.at_rest(self.now(), &views);
            self.judge_routes();
            self.judge_listeners();
        }
        let Self { judge, coverage, digest, .. } = self;
        if judge.violations.is_empty() {
            Ok(Outcome { coverage, digest: digest.finish() })
        } else {
            Err(judge.violations.join("\n"))
        }
    }

    pub(super) fn run_until(&mut self, end: Time) {
        while let Some(event) = self.queue.pop_until(end) {
            self.happen(event);
            if !self.judge.violations.is_empty() {
                return;
            }
        }
    }

    pub(super) const fn now(&self) -> Time {
        self.queue.now()
    }

    pub(super) fn view(&self, process: usize) -> BTreeSet<(NodeAddress, Incarnation)> {
        let now = self.local(process);
        let members = self.processes[process].tested.core.members(now);
        members.into_iter().map(|member| (member.node, member.incarnation)).collect()
    }

    /// Checks, after a long time without faults, that every node answers every other in each network.
    fn judge_routes(&mut self) {
        for process in self.current.values().copied() {
            for member in self.processes[process].tested.core.members(self.local(process)) {
                let routes = member.routes.iter().filter(|route| route.missed == 0);
                let networks: BTreeSet<_> = routes.map(|route| network_of(route.there)).collect();
                if networks.len() < self.plan.networks {
                    let words = format!(
                        "{:?}: at rest, {process} reaches {} in the networks {networks:?} of {}",
                        self.now(),
                        member.node,
                        self.plan.networks
                    );
                    self.judge.violations.push(words);
                }
            }
        }
    }

    /// Checks, after a long time without faults, that every application knows the present troubles.
    fn judge_listeners(&mut self) {
        for process in self.current.values().copied() {
            for other in self.current.values().copied().filter(|other| *other != process) {
                let Process { node, ref troubles, .. } = self.processes[other];
                if let Err(words) = self.listeners.at_rest(process, node_address(node), troubles) {
                    self.judge.violations.push(format!("{:?}: at rest, to {process}: {words}", self.now()));
                }
            }
        }
    }

    /// Returns the violations found.
    pub(super) fn violations(&self) -> &[String] {
        &self.judge.violations
    }

    pub(super) const fn coverage(&self) -> &Coverage {
        &self.coverage
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Datagram(flight) => self.datagram_arrives(flight),
            Event::Wake(process) => self.wake(process),
            Event::Resume(process) => self.resume(process),
            Event::Input(process, input) => self.input(process, *input),
            Event::Hint(process, of) => self.hint_arrives(process, of),
            Event::Step(step) => self.step(step),
        }
    }

    fn is_stalled(&self, process: usize) -> bool {
        self.processes[process].stall.is_paused(self.now())
    }

    fn wake(&mut self, process: usize) {
        let Process { is_alive, wake, .. } = self.processes[process];
        if is_alive && wake == Some(self.now()) && !self.is_stalled(process) {
            self.check_timer(process);
        }
    }

    fn check_timer(&mut self, process: usize) {
        self.processes[process].wake = None;
        let hints = self.hints_in_doubt(process);
        self.with(process, |tested, now| {
            hints.into_iter().for_each(|hint| tested.handle(now, hint));
            tested.time_passed(now);
        });
    }

    /// Resumes a process after a stall: its timer and its socket are ready, and either may be first.
    fn resume(&mut self, process: usize) {
        let (now, resumed) = (self.now(), &mut self.processes[process]);
        let (since, _) = resumed.stalled;
        let Some(held) = resumed.stall.resume(now).filter(|_| resumed.is_alive) else { return };
        self.note(|| format!("{process} resumes"));
        let is_timer_first = self.chance.happens(500);
        if is_timer_first {
            self.check_timer(process);
        }
        for flight in held {
            self.read(process, &flight);
        }
        self.check_timer(process);
        self.judge.stall_is_over(now, process, now.since(since));
    }

    fn input(&mut self, process: usize, input: Input) {
        if self.is_stalled(process) {
            let (_, until) = self.processes[process].stalled;
            self.queue.push(until, Event::Input(process, Box::new(input)));
        } else if self.processes[process].is_alive {
            self.note(|| format!("{process} gets {input:?}"));
            self.with(process, |tested, now| tested.handle(now, input));
        }
    }

    fn datagram_arrives(&mut self, flight: Flight) {
        let Some(process) = self.at.get(&flight.to).copied() else { return };
        let Flight { sender, from, kind, .. } = flight;
        let to_read = if self.is_stalled(process) {
            if self.processes[process].stall.hold(flight).is_err() {
                return self.coverage.count("datagrams lost");
            }
            None
        } else {
            Some(flight)
        };
        if let Kind::Answer(correlation) = kind {
            self.judge.answer_arrived(self.now(), process, (sender, from), correlation);
        }
        if let Some(flight) = to_read {
            self.read(process, &flight);
        }
    }

    fn read(&mut self, process: usize, flight: &Flight) {
        let now = self.now();
        if flight.kind != Kind::Leave {
            self.judge.datagram_read(now, process, flight.sender);
        }
        if let Kind::Answer(_) = flight.kind {
            self.judge.answer_read(now, process, flight.sender);
        }
        if flight.kind == Kind::Query && flight.cast == Cast::Unicast {
            self.judge.hint_read(now, process, flight.sender);
        }
        self.with(process, |tested, now| tested.receive(now, flight));
        if flight.kind == Kind::Leave {
            self.judge.leave_read(now, process, flight.sender);
        }
    }

    /// Returns the time of the process's own clock.
    fn local(&self, process: usize) -> Time {
        self.processes[process].clock.read(self.now())
    }

    fn with(&mut self, process: usize, act: impl FnOnce(&mut TestedCore, Time)) {
        let now = self.local(process);
        let began = self.is_measured.then(on_the_cpu);
        act(&mut self.processes[process].tested, now);
        self.in_cores += began.map_or(Duration::ZERO, |began| on_the_cpu().saturating_sub(began));
        while let Some(output) = self.processes[process].tested.poll() {
            self.execute(process, now, output);
        }
        if let Err(words) = self.listeners.all_delivered(process) {
            self.judge.violations.push(format!("{:?}: to {process}: {words}", self.now()));
        }
        self.set_timer(process);
    }

    fn set_timer(&mut self, process: usize) {
        let Some(due) = self.processes[process].tested.core.next_wake() else { return };
        let on_time = self.processes[process].clock.when(self.now(), due);
        let late = self.plan.always_late;
        let is_set = self.processes[process].wake.is_some_and(|wake| {
            let is_for_that = self.processes[process].wakes_for == due;
            let latest = on_time + late + self.plan.lateness + Duration::from_nanos(9);
            wake >= on_time && wake <= latest && (late.is_zero() || is_for_that)
        });
        if !is_set {
            let wake = on_time + late + self.chance.between(Duration::ZERO, self.plan.lateness);
            (self.processes[process].wake, self.processes[process].wakes_for) = (Some(wake), due);
            self.queue.push(wake, Event::Wake(process));
        }
    }
}

/// Returns the CPU time of this thread, as others may use the CPU, too.
pub(super) fn on_the_cpu() -> Duration {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}
