//! The claim: whatever a client does, the node lives within its bounds, serves the others, and counts what it refuses; and so do those
//! who let it have a direct link with them.
//!
//! | file | what it is |
//! | --- | --- |
//! | `stranger` | a connection by hand |
//! | `guest` | the roles of those whom only the access list lets in |
//! | `lingering` | what takes for ever to close, and who keeps it from closing |
//! | `ring` | the hostile end of rings |
//! | `tricks` | what a hostile client does |

mod guest;
mod lingering;
mod ring;
mod stranger;
mod tricks;

use std::{
    fmt,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, sync_channel},
    },
    thread,
    time::{Duration, Instant},
};

use rustix::process::{Signal, getpid, kill_process};
use sinew::{NodeApi, Registration, message::Kind};

pub(super) use self::guest::{play as play_guest, play_visitor};
pub(crate) use self::{
    guest::{GRANTED, GUEST, VISITORS},
    lingering::Keeper,
};
use self::{
    stranger::{Frame, Stranger},
    tricks::{Attacker, Tally},
};
use super::{
    Kernel, Performer, Stage, StageLimits,
    held::Held,
    host::HOSTS,
    say,
    steady::{ECHO, Window},
    told,
};
use crate::{DEADLINE, dice::Dice, until};

/// Attackers at a time.
const ATTACKERS: u64 = 2;
/// How long an attacker lives; some are killed before.
const LIFE: Duration = Duration::from_secs(2);
/// Sentences that are kept of those that newcomers are told.
const TOLD_MAX: usize = 8;
/// How often the node's memory is looked at.
const LOOK: Duration = Duration::from_millis(50);
const LIMITS: StageLimits = StageLimits { mailbox_capacity: 32, payload_max: 16 * 1024, clients_max: 64 };

/// What is to be done.
#[derive(Clone, Debug)]
pub struct Plan {
    /// A program whose `main` calls [`play`](super::play) first.
    pub program: PathBuf,
    /// How long.
    pub lasts: Duration,
    /// Decides what is tried.
    pub seed: u64,
    /// What the node and the hosts run on.
    pub kernel: Kernel,
    /// Nobody else's round trip takes longer. What does not close holds up whoever waits for it until it is closed, 3 s: as questions
    /// follow each other at once, one of them for nearly all of that.
    pub held_up_max: Duration,
}

/// What was seen.
#[derive(Debug)]
pub struct Report {
    seconds: f64,
    held_up_max: Duration,
    kernel: Kernel,
    tally: Tally,
    /// What the node refused.
    pub refused: u64,
    /// The most of the node's memory at any look, above the start.
    pub grown_kib: u64,
    held: (Held, Held),
    windows: [Window; 2],
    hosts: Vec<Host>,
    newcomers: Newcomers,
}

/// What was seen of one that lets everybody have a direct link with it.
#[derive(Debug)]
struct Host {
    name: &'static str,
    grown_kib: u64,
    held: (Held, Held),
    /// Round trips of an honest one on a direct link with it.
    windows: [Window; 2],
}

/// Honest ones that asked for an address during the attack.
#[derive(Clone, Debug, Default)]
struct Newcomers {
    served: u64,
    /// What those were told that got none.
    turned_away: Vec<String>,
}

impl Report {
    /// The most that the node may hold for all clients: full queues, outcomes that are owed, a frame that is being read, the reading itself.
    #[must_use]
    pub const fn bound_kib() -> u64 {
        let StageLimits { mailbox_capacity, payload_max, clients_max } = LIMITS;
        let queues = 3 * mailbox_capacity * (payload_max + 512);
        let owed = 10 * mailbox_capacity * 512;
        let reading = 2 * (payload_max + 16 * 1024);
        // The node's own application is like one client more.
        ((clients_max + 1) * (queues + owed + reading) / 1024) as u64
    }

    /// The most that one who has direct links may hold for them: of each a ring of either side and a frame, and what waits to be
    /// received.
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

    /// The node lived within its bound, served the others, counted every refusal that it told, and gave all back.
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

/// Whether nothing is kept of an attack but what an allocator keeps, however long it was.
fn is_given_back((before, after): &(Held, Held)) -> bool {
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
            refused: told,
            rings,
            lies,
            links,
            lingering,
            lingering_came,
        } = tally;
        writeln!(f, "{seconds:.1} s, {tricks} tricks on {connections} connections, {bytes} bytes taken")?;
        writeln!(f, "{rings} links with rings, {links} direct links, {lies} lies written into their memory")?;
        writeln!(
            f,
            "{lingering} descriptors that do not close were passed, on {kernel}: {lingering_came} came, the others were refused by the system"
        )?;
        writeln!(f, "refusals: {told} told to the hostile ones, {refused} counted by the node")?;
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

/// The role of an attacker, `SOCKET SEED MILLISECONDS KEEPER`: tells what it did at its end.
pub(super) fn play_attacker(arguments: &[String]) {
    let number = |index: usize| arguments[index].parse::<u64>().expect("a number");
    let end = Instant::now() + Duration::from_millis(number(2));
    let mut attacker = Attacker::new(Path::new(&arguments[0]), Dice::new(number(1)), number(3) as u16);
    while Instant::now() < end {
        attacker.play_one();
    }
    let Tally { tricks, connections, bytes, refused, rings, lies, links, lingering, lingering_came } =
        attacker.tally;
    say(&format!(
        "{tricks} {connections} {bytes} {refused} {rings} {lies} {links} {lingering} {lingering_came}"
    ));
}

/// The role of one that stops in mid-frame, `SOCKET`: stops itself, and goes on where it was if it is let.
pub(super) fn play_sleeper(arguments: &[String]) {
    let socket = Path::new(&arguments[0]);
    let frame = Frame::new(
        &sinew_runtime::wire::Header::new(Kind::named("x"), sinew::Tid::NONE, sinew::Tid::BROADCAST),
        vec![7; 5_000],
    );
    // The node may have no place for it just now.
    if let Ok(Some(mut stranger)) = Stranger::register(socket)
        && stranger.write(&frame.bytes()[..3_000]).is_ok()
    {
        kill_process(getpid(), Signal::STOP).expect("a process may signal itself");
        let _ = stranger.write(&frame.bytes()[3_000..]);
    }
    told().for_each(drop);
}

struct Cast {
    plan: Plan,
    stage: Stage,
    echo: Performer,
    hosts: Vec<Performer>,
    /// Of the echo, then of each host.
    pingers: Vec<Performer>,
    answers: Receiver<String>,
    tally: Arc<Mutex<Tally>>,
    keeper: Arc<Keeper>,
    dice: Dice,
}

impl Cast {
    fn new(plan: Plan) -> Self {
        let stage = Stage::on(plan.kernel, &plan.program, LIMITS);
        let (say, answers) = sync_channel(64);
        let start = |role: &str, arguments: &[String]| {
            let say = say.clone();
            // Nobody hears it any more when the director has gone.
            let performer = stage.start(role, arguments, move |line| drop(say.send(line.to_owned())));
            assert_eq!(answers.recv_timeout(DEADLINE).as_deref(), Ok("up"), "{role} comes up");
            performer
        };
        let echo = start("taker", &[ECHO.to_owned()]);
        let names = HOSTS.map(|(name, _)| name.to_owned());
        let hosts = names.iter().map(|name| start("host", std::slice::from_ref(name))).collect();
        let of_hosts = names.iter().map(|name| start("pinger", std::slice::from_ref(name)));
        let pingers = std::iter::once(start("pinger", &[])).chain(of_hosts).collect();
        let dice = Dice::new(plan.seed);
        Self {
            plan,
            stage,
            echo,
            hosts,
            pingers,
            answers,
            tally: Arc::default(),
            keeper: Arc::new(Keeper::new()),
            dice,
        }
    }

    /// What each of the others measured since the last one; at least one round trip.
    fn windows(&mut self) -> Vec<Window> {
        let answers = &self.answers;
        let window = |pinger: &mut Performer| {
            until("a round trip ends", || {
                pinger.tell("window");
                let window = Window::read(&answers.recv_timeout(DEADLINE).expect("the pinger answers"));
                (window.count + window.failed > 0).then_some(window)
            })
        };
        self.pingers.iter_mut().map(window).collect()
    }

    /// What the node holds, then each host.
    fn held(&self) -> Vec<Held> {
        self.processes().into_iter().map(Held::of).collect()
    }

    fn processes(&self) -> Vec<u32> {
        std::iter::once(self.stage.node_id()).chain(self.hosts.iter().map(Performer::id)).collect()
    }

    /// Ends all in order.
    fn end(self) {
        for one in self.pingers.into_iter().chain(self.hosts).chain([self.echo]) {
            let status = one.end();
            assert!(status.success(), "one of the others ended with {status}");
        }
        self.stage.end();
    }

    fn start_attacker(&mut self) -> Performer {
        let tally = self.tally.clone();
        let keeper = self.keeper.port().to_string();
        let arguments = [self.dice.roll().to_string(), LIFE.as_millis().to_string(), keeper];
        self.stage.start("attacker", &arguments, move |line| {
            let numbers: Vec<u64> =
                line.split_whitespace().map(|word| word.parse().expect("a number")).collect();
            let mut tally = tally.lock().unwrap_or_else(PoisonError::into_inner);
            tally.tricks += numbers[0];
            tally.connections += numbers[1];
            tally.bytes += numbers[2];
            tally.refused += numbers[3];
            tally.rings += numbers[4];
            tally.lies += numbers[5];
            tally.links += numbers[6];
            tally.lingering += numbers[7];
            tally.lingering_came += numbers[8];
        })
    }

    /// Attackers, and one that sleeps, again and again: for the plan's time, and on a slow machine until each sort of trick was played.
    fn attack(&mut self) {
        let end = Instant::now() + self.plan.lasts;
        let tally = self.tally.clone();
        let has_tried_all = || tally.lock().unwrap_or_else(PoisonError::into_inner).has_all_sorts();
        let goes_on = |now: Instant| now < end || !has_tried_all() && now < end + DEADLINE;
        while goes_on(Instant::now()) {
            let sleeper = self.stage.start("sleeper", &[], |_| {});
            let attackers: Vec<_> = (0..ATTACKERS).map(|_| self.start_attacker()).collect();
            thread::sleep(LIFE.mul_f64(0.5));
            sleeper.signal(Signal::CONT);
            for attacker in attackers {
                if self.dice.once_in(4) {
                    // It may be over by now.
                    let _ = attacker.kill();
                } else {
                    let status = attacker.end();
                    assert!(status.success(), "an attacker ended with {status}");
                }
            }
            sleeper.signal(Signal::CONT);
            drop(sleeper);
        }
    }
}

/// Ends the look also when the attack panics: else nobody would hear of it.
struct EndsIt<'a>(&'a AtomicBool);

impl Drop for EndsIt<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Looks at these processes' memory until it is told not to; returns the most that each had.
fn watch(processes: &[u32], over: &AtomicBool) -> Vec<u64> {
    let mut most = vec![0; processes.len()];
    while !over.load(Ordering::Relaxed) {
        for (most, process) in most.iter_mut().zip(processes) {
            *most = Held::of(*process).own_kib.max(*most);
        }
        thread::sleep(LOOK);
    }
    most
}

/// Asks for an address again and again, until it is told not to, as a program does that is started.
fn come(socket: &Path, over: &AtomicBool) -> Newcomers {
    let mut newcomers = Newcomers::default();
    while !over.load(Ordering::Relaxed) {
        let api = NodeApi::connect(socket).expect("the door is open");
        match api.register_transport_address(Registration::new()) {
            Ok(_) => newcomers.served += 1,
            Err(error) if newcomers.turned_away.len() < TOLD_MAX => {
                newcomers.turned_away.push(error.to_string())
            }
            Err(_) => {}
        }
        thread::sleep(LOOK);
    }
    newcomers
}

/// Lets hostile clients do what they like, and says what the node and the hosts made of it.
///
/// # Panics
/// If the node or one of the others ends.
#[must_use]
pub fn run(plan: Plan) -> Report {
    let (kernel, held_up_max) = (plan.kernel, plan.held_up_max);
    let mut cast = Cast::new(plan);
    cast.windows();
    thread::sleep(cast.plan.lasts / 8);
    let alone = cast.windows();
    let (before, over, began) = (cast.held(), AtomicBool::new(false), Instant::now());
    let (socket, processes, keeper) = (cast.stage.socket(), cast.processes(), cast.keeper.clone());
    let (most, newcomers) = thread::scope(|scope| {
        let watching = scope.spawn(|| watch(&processes, &over));
        let coming = scope.spawn(|| come(&socket, &over));
        scope.spawn(|| keeper.keep(&over));
        let ends = EndsIt(&over);
        cast.attack();
        drop(ends);
        (watching.join().expect("it only looks"), coming.join().expect("the door is open all the time"))
    });
    let attacked = cast.windows();
    let end = Instant::now() + DEADLINE;
    let is_back = |now: &[Held]| now.iter().zip(&before).all(|(now, before)| now.is_back_at(before));
    while !is_back(&cast.held()) && Instant::now() < end {
        thread::sleep(LOOK);
    }
    let (seconds, refused, after) = (began.elapsed().as_secs_f64(), cast.stage.refused(), cast.held());
    let seen = |at: usize| Host {
        name: at.checked_sub(1).map_or("node", |host| HOSTS[host].0),
        grown_kib: most[at].max(after[at].own_kib).saturating_sub(before[at].own_kib),
        held: (before[at], after[at]),
        windows: [alone[at], attacked[at]],
    };
    let Host { grown_kib, held, windows, .. } = seen(0);
    let hosts = (1..=HOSTS.len()).map(seen).collect();
    let tally = *cast.tally.lock().unwrap_or_else(PoisonError::into_inner);
    cast.end();
    Report { seconds, held_up_max, kernel, tally, refused, grown_kib, held, windows, hosts, newcomers }
}
