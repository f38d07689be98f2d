//! Virtual time, one queue of events, and processes that each run a core.

mod happenings;
mod said;

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    hash::{DefaultHasher, Hash, Hasher},
    net::{Ipv4Addr, SocketAddr, SocketAddrV4},
    rc::Rc,
    time::{Duration, Instant},
};

use rustix::time::{ClockId, clock_gettime};
use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};

use super::{
    chance::Chance,
    judge::Judge,
    listeners::{Listeners, Truth},
    network::{Flying, Network, What},
    plan::{Clock, Finding, Happening, Plan},
    planted::{Fault, Patient},
};
use crate::{
    config::{NodeConfig, WatchGroup},
    gncl::LinkFact,
    lncl::AppFact,
    ndl::{
        MembershipFact, Part, Progress, Told, Trouble,
        core::{Core, Host, Input, Output, Place, Way},
        datagram::{Answer, Body, Datagram, encode},
    },
};

/// Later than any clock is behind.
const BEGIN: Time = Time::from_nanos(1_000_000_000_000);
const PORT: u16 = 7_400;
const GNCL_PORT: u16 = 5_000;
/// An address that each host has.
const SHARED: Ipv4Addr = Ipv4Addr::new(172, 17, 0, 1);
/// Datagrams that wait in a socket, at most: about what Linux keeps of this size by default.
const SOCKET_MAX: usize = 256;
/// Longest time until mDNS tells of a node, or a peer's host refuses a connection.
const WORD_MAX: Duration = Duration::from_millis(5);
/// The application of each process that listens, and one that has trouble now and then.
const LISTENER: AppAddress = AppAddress::new(0x1000);
const TROUBLED: AppAddress = AppAddress::new(0x2000);

/// What a run was like.
pub(super) struct Outcome {
    pub(super) violations: Vec<String>,
    pub(super) seen: Seen,
    /// Of all that was said, in order.
    pub(super) digest: u64,
}

/// What came up, so that a plan that tries nothing is noticed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Seen {
    pub(super) datagrams: u64,
    pub(super) dropped: u64,
    pub(super) found: u64,
    pub(super) crashed: u64,
    pub(super) hung: u64,
    pub(super) link_down: u64,
    pub(super) left: u64,
    pub(super) restarted: u64,
    pub(super) stalls: u64,
    pub(super) signs: u64,
    pub(super) restarts_told: u64,
    pub(super) stalls_told: u64,
    pub(super) unheard_told: u64,
}

impl Seen {
    pub(super) const fn add(&mut self, other: &Self) {
        self.datagrams += other.datagrams;
        self.dropped += other.dropped;
        self.found += other.found;
        self.crashed += other.crashed;
        self.hung += other.hung;
        self.link_down += other.link_down;
        self.left += other.left;
        self.restarted += other.restarted;
        self.stalls += other.stalls;
        self.signs += other.signs;
        self.restarts_told += other.restarts_told;
        self.stalls_told += other.stalls_told;
        self.unheard_told += other.unheard_told;
    }

    pub(super) fn must_cover_everything(&self, seeds: u64) {
        let Self {
            datagrams, dropped, found, crashed, hung, link_down, left, restarted, stalls, signs, ..
        } = *self;
        let Self { restarts_told, stalls_told, unheard_told, .. } = *self;
        let happened = [datagrams, dropped, found, crashed, hung, link_down, left, restarted, stalls, signs];
        // Datagrams alone are stopped for that long now and then only.
        let all = happened.into_iter().chain([restarts_told, stalls_told, unheard_told * 5]);
        assert!(all.min().is_some_and(|count| count >= seeds / 20), "something was hardly tried: {self:?}");
    }
}

enum Event {
    Land(Flying),
    Wake(usize),
    Resume(usize),
    Tell(usize, Box<Input>),
    /// What GNCL reads of the second process is a sign of it for the first.
    Sign(usize, usize),
    Happen(Happening),
}

struct Process {
    node: usize,
    patient: Patient,
    /// One in each network.
    addresses: Vec<SocketAddr>,
    clock: Clock,
    is_alive: bool,
    stalled_until: Time,
    stalled_since: Time,
    /// What waits in its socket while it is stalled.
    socket: VecDeque<Flying>,
    /// When it will look at its timer.
    wake: Option<Time>,
    /// What was to be done then, by its clock.
    wakes_for: Time,
    /// Whom mDNS need not tell it of.
    met: BTreeSet<SocketAddr>,
    /// Whom it said goodbye to.
    goodbyes: BTreeSet<SocketAddr>,
    /// What of it does not get on, and did not.
    troubles: Truth,
}

pub(super) struct World {
    plan: Plan,
    fault: Option<Fault>,
    is_traced: bool,
    chance: Chance,
    pub(super) now: Time,
    events: BTreeMap<(Time, u64), Event>,
    sequence: u64,
    network: Network,
    judge: Judge,
    listeners: Listeners,
    processes: Vec<Process>,
    /// The process of each node, and its number.
    current: BTreeMap<usize, usize>,
    at: BTreeMap<SocketAddr, usize>,
    /// Hosts that went with their node: nobody answers there until it starts again.
    dead_hosts: BTreeSet<usize>,
    /// When a process's GNCL read of another one last, in that process's clock.
    signs: BTreeMap<(usize, usize), Time>,
    /// When what two nodes are to each other last changed: the way between them, and the life of either.
    changed: BTreeMap<(usize, usize), Time>,
    seen: Seen,
    digest: DefaultHasher,
    /// Whether the time is taken that cores take: to ask for it takes as long as to handle a datagram.
    is_measured: bool,
    /// Time of the host that cores have taken, reading of datagrams included.
    pub(super) in_cores: Duration,
}

pub(super) fn node_address(node: usize) -> NodeAddress {
    NodeAddress::new(0x0a00_0001 + u32::try_from(node).expect("few nodes"))
}

/// The node that has this address, if there is one.
fn node_at(address: NodeAddress) -> usize {
    (address.bits() - node_address(0).bits()) as usize
}

/// The address of a node in a network.
fn ip(node: usize, network: usize) -> Ipv4Addr {
    Ipv4Addr::from(node_address(node).bits() + (u32::try_from(network).expect("few networks") << 16))
}

/// The network that an address is in.
fn network_of(address: SocketAddr) -> usize {
    match address {
        SocketAddr::V4(address) => usize::from(address.ip().octets()[1]),
        SocketAddr::V6(_) => unreachable!("all are IPv4"),
    }
}

impl World {
    pub(super) fn new(plan: Plan, fault: Option<Fault>) -> Self {
        let mut world = Self {
            fault,
            is_traced: false,
            chance: Chance::new(!plan.seed),
            now: BEGIN,
            events: BTreeMap::new(),
            sequence: 0,
            network: Network::new(plan.quality, plan.networks),
            judge: Judge::new(&plan),
            listeners: Listeners::default(),
            processes: Vec::new(),
            current: BTreeMap::new(),
            at: BTreeMap::new(),
            dead_hosts: BTreeSet::new(),
            signs: BTreeMap::new(),
            changed: BTreeMap::new(),
            seen: Seen::default(),
            digest: DefaultHasher::new(),
            is_measured: false,
            in_cores: Duration::ZERO,
            plan,
        };
        for (at, what) in std::mem::take(&mut world.plan.happenings) {
            world.push(BEGIN + at, Event::Happen(what));
        }
        world
    }

    /// Tells on standard output all that happens, if that is asked for.
    pub(super) fn traced(mut self, is_traced: bool) -> Self {
        self.is_traced = is_traced;
        self.trace(|| format!("{:?}", self.plan));
        self
    }

    /// Takes the time that cores take.
    pub(super) const fn measured(mut self) -> Self {
        self.is_measured = true;
        self
    }

    fn trace(&self, words: impl FnOnce() -> String) {
        if self.is_traced {
            println!("{:>12.3} ms  {}", self.now.since(BEGIN).as_secs_f64() * 1e3, words());
        }
    }

    /// As [`World::run`], and tells on standard output after each period how far it is.
    pub(super) fn run_and_tell(mut self) -> Outcome {
        let (began, end, period) = (Instant::now(), BEGIN + self.plan.end, self.plan.period);
        while self.now < end && self.judge.violations.is_empty() {
            self.run_until(end.min(self.now + period));
            println!(
                "crowd {} of {}: {:.1} s of {:.1} s, {} datagrams, {} members found, {} events ahead, after {:.0} s",
                self.plan.seed,
                self.plan.nodes,
                self.now.since(BEGIN).as_secs_f64(),
                self.plan.end.as_secs_f64(),
                self.seen.datagrams,
                self.seen.found,
                self.events.len(),
                began.elapsed().as_secs_f64()
            );
        }
        self.run()
    }

    pub(super) fn run(mut self) -> Outcome {
        let end = BEGIN + self.plan.end;
        self.run_until(end);
        let views: Vec<_> = self.current.values().map(|process| (*process, self.view(*process))).collect();
        if self.judge.violations.is_empty() {
            self.judge.at_rest(self.now, &views);
            self.judge_routes();
            self.judge_listeners();
        }
        let Self { judge, seen, digest, .. } = self;
        Outcome { violations: judge.violations, seen, digest: digest.finish() }
    }

    pub(super) fn run_until(&mut self, end: Time) {
        while let Some(entry) = self.events.first_entry().filter(|entry| entry.key().0 <= end) {
            let ((now, _), event) = entry.remove_entry();
            self.now = now;
            self.happen(event);
            if !self.judge.violations.is_empty() {
                return;
            }
        }
        self.now = end;
    }

    pub(super) fn view(&self, process: usize) -> BTreeSet<(NodeAddress, Incarnation)> {
        let now = self.local(process);
        let members = self.processes[process].patient.core.members(now);
        members.into_iter().map(|member| (member.node, member.incarnation)).collect()
    }

    /// All has been well for long: everybody answers everybody in each network.
    fn judge_routes(&mut self) {
        for process in self.current.values().copied() {
            for member in self.processes[process].patient.core.members(self.local(process)) {
                let routes = member.routes.iter().filter(|route| route.missed == 0);
                let networks: BTreeSet<_> = routes.map(|route| network_of(route.there)).collect();
                if networks.len() < self.plan.networks {
                    let words = format!(
                        "{:?}: at rest, {process} reaches {} in the networks {networks:?} of {}",
                        self.now, member.node, self.plan.networks
                    );
                    self.judge.violations.push(words);
                }
            }
        }
    }

    /// All has been well for long: everybody's application knows who has trouble.
    fn judge_listeners(&mut self) {
        for process in self.current.values().copied() {
            for other in self.current.values().copied().filter(|other| *other != process) {
                let Process { node, ref troubles, .. } = self.processes[other];
                if let Err(words) = self.listeners.at_rest(process, node_address(node), troubles) {
                    self.judge.violations.push(format!("{:?}: at rest, to {process}: {words}", self.now));
                }
            }
        }
    }

    /// What must not have happened, in words.
    pub(super) fn violations(&self) -> &[String] {
        &self.judge.violations
    }

    pub(super) const fn seen(&self) -> &Seen {
        &self.seen
    }

    fn push(&mut self, at: Time, event: Event) {
        self.sequence += 1;
        self.events.insert((at, self.sequence), event);
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Land(flying) => self.land(flying),
            Event::Wake(process) => self.wake(process),
            Event::Resume(process) => self.resume(process),
            Event::Tell(process, input) => self.tell(process, *input),
            Event::Sign(process, of) => self.read_a_sign(process, of),
            Event::Happen(what) => self.strike(what),
        }
    }

    fn is_stalled(&self, process: usize) -> bool {
        self.processes[process].stalled_until > self.now
    }

    fn wake(&mut self, process: usize) {
        let Process { is_alive, wake, .. } = self.processes[process];
        if is_alive && wake == Some(self.now) && !self.is_stalled(process) {
            self.look_at_timer(process);
        }
    }

    fn look_at_timer(&mut self, process: usize) {
        self.processes[process].wake = None;
        let signs = self.signs_in_doubt(process);
        self.with(process, |patient, now| {
            signs.into_iter().for_each(|sign| patient.told(now, sign));
            patient.time_passed(now);
        });
    }

    /// A process goes on after a stall: its timer and its socket are ready, and either may be first.
    fn resume(&mut self, process: usize) {
        if !self.processes[process].is_alive {
            return;
        }
        self.trace(|| format!("{process} goes on"));
        let is_timer_first = self.chance.happens(500);
        if is_timer_first {
            self.look_at_timer(process);
        }
        for flying in std::mem::take(&mut self.processes[process].socket) {
            self.read(process, &flying);
        }
        self.look_at_timer(process);
        let lasted = self.now.since(self.processes[process].stalled_since);
        self.judge.stall_is_over(self.now, process, lasted);
    }

    fn tell(&mut self, process: usize, input: Input) {
        if self.is_stalled(process) {
            let until = self.processes[process].stalled_until;
            self.push(until, Event::Tell(process, Box::new(input)));
        } else if self.processes[process].is_alive {
            self.trace(|| format!("{process} is told {input:?}"));
            self.with(process, |patient, now| patient.told(now, input));
        }
    }

    fn land(&mut self, flying: Flying) {
        let Some(process) = self.at.get(&flying.to).copied() else { return };
        let is_stalled = self.is_stalled(process);
        if is_stalled && self.processes[process].socket.len() >= SOCKET_MAX {
            self.seen.dropped += 1;
            return;
        }
        if let What::Answer(correlation) = flying.what {
            self.judge.answered(self.now, process, (flying.sender, flying.from), correlation);
        }
        if is_stalled {
            self.processes[process].socket.push_back(flying);
        } else {
            self.read(process, &flying);
        }
    }

    fn read(&mut self, process: usize, flying: &Flying) {
        if flying.what != What::Leave {
            self.judge.heard(self.now, process, flying.sender);
        }
        if let What::Answer(_) = flying.what {
            self.judge.read(self.now, process, flying.sender);
        }
        if flying.what == What::Query && flying.way == Way::Unicast {
            self.judge.read_a_sign(self.now, process, flying.sender);
        }
        self.with(process, |patient, now| patient.receive(now, flying));
        if flying.what == What::Leave {
            self.judge.heard_goodbye(self.now, process, flying.sender);
        }
    }

    /// The process's own clock.
    fn local(&self, process: usize) -> Time {
        let Clock { ahead_ns, fast_ppm } = self.processes[process].clock;
        let elapsed = self.now.since(BEGIN).as_nanos().cast_signed();
        let drift = elapsed * i128::from(fast_ppm) / 1_000_000;
        self.now.shifted(ahead_ns + i64::try_from(drift).expect("a short run"))
    }

    /// After how long the process's clock shows `then`, never too early.
    fn until(&self, process: usize, then: Time) -> Duration {
        let wait = then.since(self.local(process));
        let fast_ppm = self.processes[process].clock.fast_ppm;
        let nanos = wait.as_nanos() * 1_000_000 / u128::from((1_000_000 + fast_ppm).unsigned_abs()) + 2;
        if wait.is_zero() { wait } else { Duration::from_nanos(u64::try_from(nanos).expect("a short wait")) }
    }

    fn with(&mut self, process: usize, act: impl FnOnce(&mut Patient, Time)) {
        let now = self.local(process);
        let began = self.is_measured.then(on_the_cpu);
        act(&mut self.processes[process].patient, now);
        self.in_cores += began.map_or(Duration::ZERO, |began| on_the_cpu().saturating_sub(began));
        while let Some(output) = self.processes[process].patient.poll() {
            self.obey(process, now, output);
        }
        if let Err(words) = self.listeners.all_is_told(process) {
            self.judge.violations.push(format!("{:?}: to {process}: {words}", self.now));
        }
        self.set_timer(process);
    }

    fn set_timer(&mut self, process: usize) {
        let Some(due) = self.processes[process].patient.core.next_wake() else { return };
        let wait = self.until(process, due);
        let on_time = self.now + wait;
        let late = self.plan.always_late;
        let is_set = self.processes[process].wake.is_some_and(|wake| {
            let is_for_that = self.processes[process].wakes_for == due;
            let latest = on_time + late + self.plan.lateness + Duration::from_nanos(9);
            wake >= on_time && wake <= latest && (late.is_zero() || is_for_that)
        });
        if !is_set {
            let wake = on_time + late + self.chance.between(Duration::ZERO, self.plan.lateness);
            (self.processes[process].wake, self.processes[process].wakes_for) = (Some(wake), due);
            self.push(wake, Event::Wake(process));
        }
    }
}

/// What this thread has had of a CPU: others may want it, too.
pub(super) fn on_the_cpu() -> Duration {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}
