//! The claim: no client can push the node out of its bounds or keep it from serving others, and the node
//! counts every refusal. The same holds for processes that accept direct links from clients.
//!
//! | file | content |
//! | --- | --- |
//! | `raw_connection` | a hand-written connection |
//! | `guest` | the roles of users that only the access list admits |
//! | `slow_close` | descriptors that block on close, and the process that keeps them open |
//! | `ring` | the hostile end of rings |
//! | `tricks` | the attacks of a hostile client |

mod guest;
mod raw_connection;
mod ring;
mod slow_close;
mod tricks;

use sinew_runtime::lock;
use sinew_testkit::NodeProcess;
use sinew_testkit::Resources;
use sinew_testkit::SetOnDrop;
use sinew_testkit::numbers;
use std::{
    fmt,
    path::Path,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use rustix::process::{Signal, getpid, kill_process};
use sinew::{NodeApi, Registration, message::Kind};

pub(super) use self::guest::{run as run_guest, run_visitor};
pub(crate) use self::{
    guest::{GRANTED, GUEST, VISITORS},
    slow_close::Keeper,
};
use self::{
    raw_connection::{Frame, RawConnection},
    tricks::{Attacker, Tally},
};
use super::{
    FixtureLimits, Kernel, NodeFixture, commands,
    host::HOSTS,
    print_line,
    steady::{ECHO, Window},
};
use sinew_testkit::{DEADLINE, random::SeededRandom, until};

/// Number of concurrent attackers.
const ATTACKERS: u64 = 2;
/// Lifetime of an attacker; some are killed earlier.
const LIFE: Duration = Duration::from_secs(2);
/// Maximum number of distinct error messages kept from newcomers.
const ERRORS_MAX: usize = 8;
/// Interval between samples of the node's memory.
const SAMPLE_INTERVAL: Duration = Duration::from_millis(50);
const LIMITS: FixtureLimits = FixtureLimits { mailbox_capacity: 32, payload_max: 16 * 1024, clients_max: 64 };

/// The parameters of a run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Duration.
    pub lasts: Duration,
    /// Seed of the attacks.
    pub seed: u64,
    /// The kernel of the node and the hosts.
    pub kernel: Kernel,
    /// Maximum round trip of other clients. A slow-closing descriptor blocks the process that closes it for
    /// up to 3 s. As requests follow each other at once, one of them is delayed for nearly that long.
    pub held_up_max: Duration,
}

/// The results.
#[derive(Debug)]
pub struct Report {
    seconds: f64,
    held_up_max: Duration,
    kernel: Kernel,
    tally: Tally,
    /// Refusals counted by the node.
    pub refused: u64,
    /// Peak memory of the node above its memory at the start.
    pub grown_kib: u64,
    held: (Resources, Resources),
    windows: [Window; 2],
    hosts: Vec<Host>,
    newcomers: Newcomers,
}

/// Observations of a process that accepts direct links from all clients.
#[derive(Debug)]
struct Host {
    name: &'static str,
    grown_kib: u64,
    held: (Resources, Resources),
    /// Round trips of an honest client on a direct link with it.
    windows: [Window; 2],
}

/// Honest clients that registered during the attack.
#[derive(Clone, Debug, Default)]
struct Newcomers {
    served: u64,
    /// The errors of those that received no address.
    turned_away: Vec<String>,
}

impl Report {
    /// Maximum memory of the node for all clients: full queues, pending outcomes, partial frames, and read
    /// buffers.
    #[must_use]
    pub const fn bound_kib() -> u64 {
        let FixtureLimits { mailbox_capacity, payload_max, clients_max } = LIMITS;
        let queues = 3 * mailbox_capacity * (payload_max + 512);
        let owed = 10 * mailbox_capacity * 512;
        let reading = 2 * (payload_max + 16 * 1024);
        // The node's own application counts as one more client.
        ((clients_max + 1) * (queues + owed + reading) / 1024) as u64
    }

    /// Maximum memory of a process with direct links: per link a ring of each side and a frame, plus the
    /// messages that wait to be received.
    #[must_use]
    pub const fn host_bound_kib() -> u64 {
        const LINKS: u64 = 64;
        LINKS * (1_024 + 64 + 64) + 16 * 1_024
    }

    /// The longest round trip of the others under attack, through the node and with the hosts.
    fn longest(&self) -> Duration {
        let hosts = self.hosts.iter().map(|host| host.windows[1].max_us);
        Duration::from_micros(hosts.chain([self.windows[1].max_us]).max().unwrap_or_default())
    }

    /// Returns whether the node stayed within its bound, served the others, counted every refusal, and
    /// released everything.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.refused >= self.tally.refused
            && self.grown_kib <= Self::bound_kib()
            && is_given_back(&self.held)
            && self.windows.iter().all(|window| window.failed == 0)
            && self.longest() <= self.held_up_max
            && self.hosts.iter().all(Host::holds)
            && self.tally.has_all_sorts()
            && self.newcomers.served > 0
            && self.newcomers.turned_away.is_empty()
    }
}

/// Returns whether only the allocator's reserve remains after an attack, however long it lasted.
fn is_given_back((before, after): &(Resources, Resources)) -> bool {
    const KEPT_KIB: u64 = 16 << 10;
    after.is_back_at(before) && after.own_kib <= before.own_kib + KEPT_KIB
}

impl Host {
    fn holds(&self) -> bool {
        self.grown_kib <= Report::host_bound_kib()
            && is_given_back(&self.held)
            && self.windows.iter().all(|window| window.count > 0 && window.failed == 0)
    }
}

impl fmt::Display for Host {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, grown_kib, held, windows } = self;
        writeln!(
            f,
            "{name}: grown by {grown_kib} KiB at most; its bound is {} KiB",
            Report::host_bound_kib()
        )?;
        writeln!(f, "     before {}\n     after  {}", held.0, held.1)?;
        writeln!(f, "     asked, alone        {}\n     asked, under attack {}", windows[0], windows[1])
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { seconds, held_up_max, kernel, tally, refused, grown_kib, held, windows, hosts, newcomers } =
            self;
        let Tally {
            tricks,
            connections,
            bytes,
            refused: reported,
            rings,
            lies,
            links,
            slow_closes,
            slow_closes_sent,
        } = tally;
        writeln!(f, "{seconds:.1} s, {tricks} tricks on {connections} connections, {bytes} bytes taken")?;
        writeln!(f, "{rings} links with rings, {links} direct links, {lies} lies written into their memory")?;
        writeln!(
            f,
            "{slow_closes} descriptors that do not close were passed, on {kernel}: {slow_closes_sent} were sent, the others were refused by the system"
        )?;
        writeln!(f, "refusals: {reported} reported to the hostile clients, {refused} counted by the node")?;
        let Newcomers { served, turned_away } = newcomers;
        writeln!(f, "newcomers: {served} served, {} turned away {turned_away:?}", turned_away.len())?;
        writeln!(f, "node before {}\n     after  {}", held.0, held.1)?;
        writeln!(f, "node grown by {grown_kib} KiB at most; its bound is {} KiB", Self::bound_kib())?;
        writeln!(f, "others, alone        {}\nothers, under attack {}", windows[0], windows[1])?;
        hosts.iter().try_for_each(|host| write!(f, "{host}"))?;
        writeln!(
            f,
            "longest round trip of the others under attack: {:?}; at most {held_up_max:?}",
            self.longest()
        )?;
        write!(
            f,
            "expected: the node and the hosts live, within their bounds, all given back, no round trip failed or too long, newcomers served and none turned away, every refusal counted; seen: {}",
            if self.holds() { "so" } else { "NOT SO" }
        )
    }
}

/// The role of an attacker, `SOCKET SEED MILLISECONDS PORT`: prints its counters at its end.
pub(super) fn run_attacker(arguments: &[String]) {
    let number = |index: usize| arguments[index].parse::<u64>().expect("a number");
    let end = Instant::now() + Duration::from_millis(number(2));
    let mut attacker =
        Attacker::new(Path::new(&arguments[0]), SeededRandom::new(number(1)), number(3) as u16);
    while Instant::now() < end {
        attacker.play_one();
    }
    let Tally { tricks, connections, bytes, refused, rings, lies, links, slow_closes, slow_closes_sent } =
        attacker.tally;
    print_line(&format!(
        "{tricks} {connections} {bytes} {refused} {rings} {lies} {links} {slow_closes} {slow_closes_sent}"
    ));
}

/// The role of a process that stops in mid-frame, `SOCKET`: sends SIGSTOP to itself, and continues if it is
/// resumed.
pub(super) fn run_sleeper(arguments: &[String]) {
    let socket = Path::new(&arguments[0]);
    let frame = Frame::new(
        &sinew_runtime::wire::Header::new(Kind::named("x"), sinew::Tid::NONE, sinew::Tid::BROADCAST),
        vec![7; 5_000],
    );
    // The node may have no free slot at the moment.
    if let Ok(Some(mut connection)) = RawConnection::register(socket)
        && connection.write(&frame.bytes()[..3_000]).is_ok()
    {
        kill_process(getpid(), Signal::STOP).expect("a process may signal itself");
        let _ = connection.write(&frame.bytes()[3_000..]);
    }
    commands().for_each(drop);
}

struct Scenario {
    plan: Plan,
    fixture: NodeFixture,
    echo: NodeProcess,
    hosts: Vec<NodeProcess>,
    /// Of the echo, then of each host.
    pingers: Vec<NodeProcess>,
    tally: Arc<Mutex<Tally>>,
    keeper: Arc<Keeper>,
    random: SeededRandom,
}

impl Scenario {
    fn new(plan: Plan) -> Self {
        let fixture = NodeFixture::on(plan.kernel, LIMITS);
        let start = |role: &str, arguments: &[&str]| {
            let mut process = fixture.start(role, arguments);
            process.expect("up");
            process
        };
        let echo = start("taker", &[ECHO]);
        let names = HOSTS.map(|(name, _)| name);
        let hosts = names.iter().map(|name| start("host", &[name])).collect();
        let of_hosts = names.iter().map(|name| start("pinger", &[name]));
        let pingers = std::iter::once(start("pinger", &[])).chain(of_hosts).collect();
        let random = SeededRandom::new(plan.seed);
        Self {
            plan,
            fixture,
            echo,
            hosts,
            pingers,
            tally: Arc::default(),
            keeper: Arc::new(Keeper::new()),
            random,
        }
    }

    /// Measurements of each other client since the last call, with at least one round trip each.
    fn windows(&mut self) -> Vec<Window> {
        let window = |pinger: &mut NodeProcess| {
            until("a round trip ends", || {
                let window = Window::read(&pinger.ask("window"));
                (window.count + window.failed > 0).then_some(window)
            })
        };
        self.pingers.iter_mut().map(window).collect()
    }

    /// The resources of the node, then of each host.
    fn held(&self) -> Vec<Resources> {
        self.processes().into_iter().map(Resources::of).collect()
    }

    fn processes(&self) -> Vec<u32> {
        std::iter::once(self.fixture.node().id()).chain(self.hosts.iter().map(NodeProcess::id)).collect()
    }

    /// Ends all in order.
    fn end(self) {
        for one in self.pingers.into_iter().chain(self.hosts).chain([self.echo]) {
            let status = one.stop();
            assert!(status.success(), "one of the others ended with {status}");
        }
        self.fixture.end();
    }

    fn start_attacker(&mut self) -> NodeProcess {
        let tally = self.tally.clone();
        let keeper = self.keeper.port().to_string();
        let (seed, lasts) = (self.random.number().to_string(), LIFE.as_millis().to_string());
        self.fixture.start_with("attacker", &[&seed, &lasts, &keeper], move |line| {
            let numbers = numbers(line);
            let mut tally = lock(&tally);
            tally.tricks += numbers[0];
            tally.connections += numbers[1];
            tally.bytes += numbers[2];
            tally.refused += numbers[3];
            tally.rings += numbers[4];
            tally.lies += numbers[5];
            tally.links += numbers[6];
            tally.slow_closes += numbers[7];
            tally.slow_closes_sent += numbers[8];
            true
        })
    }

    /// Runs attackers, and one stopped process, repeatedly: for the plan's time, and on a slow machine until
    /// every kind of trick was played.
    fn attack(&mut self) {
        let end = Instant::now() + self.plan.lasts;
        let tally = self.tally.clone();
        let has_tried_all = || lock(&tally).has_all_sorts();
        let goes_on = |now: Instant| now < end || !has_tried_all() && now < end + DEADLINE;
        while goes_on(Instant::now()) {
            let sleeper = self.fixture.start("sleeper", &[]);
            let attackers: Vec<_> = (0..ATTACKERS).map(|_| self.start_attacker()).collect();
            thread::sleep(LIFE.mul_f64(0.5));
            sleeper.signal(Signal::CONT);
            for mut attacker in attackers {
                if self.random.once_in(4) {
                    // The attacker may have exited already.
                    let _ = attacker.kill();
                } else {
                    let status = attacker.stop();
                    assert!(status.success(), "an attacker ended with {status}");
                }
            }
            sleeper.signal(Signal::CONT);
            drop(sleeper);
        }
    }
}

/// Samples the memory of these processes until `over`. Returns the peak of each.
fn watch(processes: &[u32], over: &AtomicBool) -> Vec<u64> {
    let mut most = vec![0; processes.len()];
    while !over.load(Ordering::Relaxed) {
        for (most, process) in most.iter_mut().zip(processes) {
            *most = Resources::of(*process).own_kib.max(*most);
        }
        thread::sleep(SAMPLE_INTERVAL);
    }
    most
}

/// Registers repeatedly until `over`, as newly started programs do.
fn register_repeatedly(socket: &Path, over: &AtomicBool) -> Newcomers {
    let mut newcomers = Newcomers::default();
    while !over.load(Ordering::Relaxed) {
        let api = NodeApi::connect(socket).expect("the node accepts clients");
        match api.register_transport_address(Registration::new()) {
            Ok(_) => newcomers.served += 1,
            Err(error) if newcomers.turned_away.len() < ERRORS_MAX => {
                newcomers.turned_away.push(error.to_string())
            }
            Err(_) => {}
        }
        thread::sleep(SAMPLE_INTERVAL);
    }
    newcomers
}

/// Runs hostile clients, and reports the effect on the node and the hosts.
///
/// # Panics
/// If the node or one of the others exits.
#[must_use]
pub fn run(plan: Plan) -> Report {
    let (kernel, held_up_max) = (plan.kernel, plan.held_up_max);
    let mut scenario = Scenario::new(plan);
    scenario.windows();
    thread::sleep(scenario.plan.lasts / 8);
    let alone = scenario.windows();
    let (before, over, began) = (scenario.held(), AtomicBool::new(false), Instant::now());
    let (socket, processes, keeper) =
        (scenario.fixture.socket(), scenario.processes(), scenario.keeper.clone());
    let (most, newcomers) = thread::scope(|scope| {
        let watching = scope.spawn(|| watch(&processes, &over));
        let coming = scope.spawn(|| register_repeatedly(&socket, &over));
        scope.spawn(|| keeper.keep(&over));
        let ends = SetOnDrop(&over);
        scenario.attack();
        drop(ends);
        (
            watching.join().expect("it only looks"),
            coming.join().expect("the node accepts clients all the time"),
        )
    });
    let attacked = scenario.windows();
    let end = Instant::now() + DEADLINE;
    let is_back = |now: &[Resources]| now.iter().zip(&before).all(|(now, before)| now.is_back_at(before));
    while !is_back(&scenario.held()) && Instant::now() < end {
        thread::sleep(SAMPLE_INTERVAL);
    }
    let (seconds, refused, after) =
        (began.elapsed().as_secs_f64(), scenario.fixture.refused(), scenario.held());
    let seen = |at: usize| Host {
        name: at.checked_sub(1).map_or("node", |host| HOSTS[host].0),
        grown_kib: most[at].max(after[at].own_kib).saturating_sub(before[at].own_kib),
        held: (before[at], after[at]),
        windows: [alone[at], attacked[at]],
    };
    let Host { grown_kib, held, windows, .. } = seen(0);
    let hosts = (1..=HOSTS.len()).map(seen).collect();
    let tally = *lock(&scenario.tally);
    scenario.end();
    Report { seconds, held_up_max, kernel, tally, refused, grown_kib, held, windows, hosts, newcomers }
}
