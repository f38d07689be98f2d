//! A node for the scenarios of applications in processes of their own.
//!
//! ```text
//! process_under_test CONFIG.toml [--place thread|process|io] [--requires NAME] [--on-lost pause|restart]
//! [--dies-at-start CODE] [--neighbour-hangs MILLIS] [--talks] [--stays]
//! [--swells-at-start MIB] [--starts-in MILLIS] [--starts-within MILLIS] [--ramps-for MILLIS] [--stops-within MILLIS]
//! [--tree rest-for-one|escalation] [--hangs-in started|factory TOKEN] [--audits] [--layers-panic]
//! ```
//!
//! The application `drive` executes orders (`Order`), and prints its observations, one line each. The
//! options:
//!
//! - `--neighbour-hangs`: another application on the `io` thread blocks that thread for this time, a moment
//!   after its start; with 0 ms each incarnation of it blocks forever.
//! - `--talks`: the drive sends its process id continuously to an application `witness`, which prints each
//!   number that it receives.
//! - `--stays`: the program continues after the end of its node, until its standard input ends.
//! - `--tree`: the drive runs under the supervisor `leg`, after an application `leader` of the same kind in a
//!   thread. For an escalation, `leg` has the strategy one-for-one and allows one restart.
//! - `--audits`: the node prints the fates of the drive's messages whenever they have changed.
//! - `--layers-panic`: a layer panics when a line of the standard input names it.

use std::{
    os::unix::process::CommandExt,
    path::Path,
    process::{Command, ExitCode, Stdio},
    sync::atomic::{AtomicBool, AtomicU64, Ordering},
};

use super::Options;
use crate::orders::{Count, Level, Me, Order, Who};
use rustix::process::{Signal, getpid, kill_process};
use sinew::{
    NodeHandle,
    app::GroupOutcome,
    audit::{Account, Place},
    prelude::*,
    supervision::ReadyGate,
};
use sinew_testkit::DEADLINE;

#[derive(Default)]
struct Drive {
    counts: Vec<u64>,
    talks: bool,
    /// Memory that it allocates at its start, in MiB; it never becomes ready then.
    swells: Option<usize>,
    /// Time until it is ready; the limit is a second by default.
    starts_in: Option<Duration>,
    /// Its first incarnation does not return from `started`.
    hangs: Option<Token>,
    /// Time that it takes to stop; the limit is half a second by default.
    ramps_for: Duration,
}

/// The place at which one incarnation hangs, and the file that records whether one has hung.
#[derive(Clone)]
struct Token {
    place: String,
    file: String,
}

impl Token {
    fn hang_in(&self, place: &str) {
        if self.place == place && std::fs::remove_file(&self.file).is_ok() {
            print_line(&format!("hangs in its {place}"));
            loop {
                std::thread::park();
            }
        }
    }
}

fn print_line(what: &str) {
    println!("{} {what}", std::process::id());
}

/// Other live processes of its node, according to the kernel.
fn brothers() -> Vec<String> {
    let parent = std::os::unix::process::parent_id().to_string();
    let is_brother = |process: std::fs::DirEntry| {
        let stat = std::fs::read_to_string(process.path().join("stat")).ok()?;
        // The name before it may contain blanks.
        let (_, after_name) = stat.rsplit_once(')')?;
        let words: Vec<&str> = after_name.split_ascii_whitespace().collect();
        let has_ended = matches!(*words.first()?, "Z" | "X");
        // Skips entries such as `self`.
        let id: u32 = process.file_name().to_str()?.parse().ok()?;
        (*words.get(1)? == parent && id != std::process::id() && !has_ended).then_some(stat)
    };
    let processes = std::fs::read_dir("/proc").expect("it is always there");
    processes.filter_map(|process| is_brother(process.ok()?)).collect()
}

impl Actor for Drive {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        print_line(&format!("started {}", context.tid()));
        self.hangs.iter().for_each(|token| token.hang_in("started"));
        context.watch_input::<Level>(None, Duration::from_millis(50), |_, _, _| print_line("silence"));
        if self.talks {
            context.every(Duration::from_millis(2), |_, _, context| {
                // A message that the node rejects is not received.
                let _ = context.send("witness", &Count { number: u64::from(std::process::id()) });
            });
        }
        if let Some(mib) = self.swells {
            print_line(&format!("process has these brothers: {:?}", brothers()));
            // A process with a lot of memory to free takes a while to die.
            std::mem::forget((vec![1_u8; mib << 20], context.hold_ready()));
            print_line("has swollen");
        }
        if let Some(time) = self.starts_in {
            let mut ready = context.hold_ready();
            context.after(time, move |_, _, _| ready.take().into_iter().for_each(ReadyGate::reached));
        }
    }

    fn stopping(&mut self, context: &mut Self::Context) -> Running {
        if self.counts.contains(&u64::MAX) {
            print_line("stopping");
            return Running::Stop;
        }
        print_line("ramping down");
        self.counts.push(u64::MAX);
        context.after(self.ramps_for, |_, _, context| context.stop());
        Running::Continue
    }
}

impl Handler<Delivery<Count>> for Drive {
    type Result = ();

    fn handle(&mut self, count: Delivery<Count>, _: &mut Self::Context) {
        self.counts.push(count.number);
    }
}

impl Handler<Delivery<Level>> for Drive {
    type Result = ();

    fn handle(&mut self, level: Delivery<Level>, _: &mut Self::Context) {
        print_line(&format!("level {}", level.value));
    }
}

impl Handler<Delivery<Who>> for Drive {
    type Result = ();

    fn handle(&mut self, who: Delivery<Who>, context: &mut Self::Context) {
        let me = Me { pid: std::process::id(), counts: self.counts.clone() };
        if let Err(error) = context.reply(&who, &me) {
            print_line(&format!("no reply: {error}"));
        }
    }
}

impl Handler<Delivery<NodeEvent>> for Drive {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        print_line(&format!("event {:?}", event.payload));
    }
}

impl Handler<Delivery<RequirementEvent>> for Drive {
    type Result = ();

    fn handle(&mut self, event: Delivery<RequirementEvent>, context: &mut Self::Context) {
        let name = event.name();
        print_line(&format!("requirement {:?}, {name} is {:?}", event.payload, context.resolve(name)));
    }
}

impl Handler<Delivery<Undelivered>> for Drive {
    type Result = ();

    fn handle(&mut self, undelivered: Delivery<Undelivered>, _: &mut Self::Context) {
        print_line(&format!("undelivered: {}", undelivered.payload));
    }
}

impl Handler<Delivery<Order>> for Drive {
    type Result = ();

    fn handle(&mut self, order: Delivery<Order>, context: &mut Self::Context) {
        match order.payload {
            Order::Panic => panic!("this is the panic that the scenario asks for"),
            Order::Stop => context.stop(),
            Order::Hold(millis) => {
                print_line("holds");
                std::thread::sleep(Duration::from_millis(millis));
            }
            Order::HoldWhile(file) => {
                print_line("holds");
                let end = Time::now() + DEADLINE;
                while Path::new(&file).exists() {
                    assert!(Time::now() < end, "{file} was not removed within {DEADLINE:?}");
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
            Order::Hang => loop {
                std::thread::park();
            },
            Order::Exit(code) => std::process::exit(code),
            Order::Abort => std::process::abort(),
            Order::OverflowTheStack => print_line(&format!("{}", overflow(&[0; 1024]))),
            Order::Kill => signal_myself(Signal::KILL),
            Order::Segfault => signal_myself(Signal::SEGV),
            Order::Refuse => context.reject(),
            Order::Join(group) => context.join(&group),
            Order::Leave(group) => context.leave(&group),
            Order::Send(to, number) => send(context, &to, number, &Count { number }),
            Order::SendOrder(to, sent) => send(context, &to, 0, &*sent),
            Order::SendTo(tid) => {
                let sent = context.send(Tid::from_bits(tid), &Count { number: 1 });
                print_line(&format!("sent: {sent:?}"));
            }
            Order::SendToGroup(group) => send_to_group(context, &group),
            Order::Ask(target) => ask(context, &target),
            Order::Echo(ref to, _) => {
                if let Err(error) = context.send(&**to, &order.payload) {
                    print_line(&format!("no echo: {error}"));
                }
            }
            Order::ForgeNumbers(ref to) => {
                // The next number is the last one possible.
                let far = u64::MAX - 1;
                assert!(context.sender().count_on_from(far, far));
                send(context, to, 0, &Count { number: 0 });
            }
            Order::StopTheSystem => actix::System::current().stop(),
            Order::StartACommand => {
                let status = Command::new("true").status();
                print_line(&format!("command {status:?}"));
            }
            Order::StartASleeper(in_own_group) => start_a_sleeper(in_own_group),
        }
    }
}

/// It does not inherit the output, because the scenario waits for the end of that.
#[expect(clippy::zombie_processes, reason = "what becomes of it is what is tried")]
pub(super) fn start_a_sleeper(in_own_group: bool) {
    let mut command = Command::new("sleep");
    command.arg("120").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    if in_own_group {
        command.process_group(0);
    }
    let sleeper = command.spawn().expect("a program that every system has");
    print_line(&format!("sleeper {}", sleeper.id()));
}

/// Does not return: another thread may take the signal, a moment later. The first SIGSEGV may be caught by
/// Rust's handler for stack overflows, the second one is not.
pub(super) fn signal_myself(signal: Signal) -> ! {
    loop {
        kill_process(getpid(), signal).expect("a process may signal itself");
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[expect(unconditional_recursion, reason = "it is what is asked for")]
fn overflow(frame: &[u8; 1024]) -> u8 {
    let mut next = *frame;
    next[0] = next[0].wrapping_add(1);
    overflow(std::hint::black_box(&next)).wrapping_add(next[1])
}

/// Sends a confirmed message, and prints its outcome under this number.
fn send(context: &mut AppContext<Drive>, to: &str, number: u64, payload: &impl Payload) {
    match context.message(to, payload).confirmed(DEADLINE) {
        Ok(confirmation) => {
            let wait =
                confirmation.into_actor(&Drive::default()).map(move |outcome, _: &mut Drive, _: &mut _| {
                    print_line(&format!("sent {number}: {outcome:?}"));
                });
            context.spawn(wait);
        }
        Err(error) => print_line(&format!("not sent {number}: {error}")),
    }
}

fn send_to_group(context: &mut AppContext<Drive>, group: &str) {
    let within = Duration::from_secs(10);
    let message = context.message(Tid::group(group), &Count { number: 1 });
    if let Err(error) = message.with_tag(1).confirmed_by_each(within) {
        print_line(&format!("not sent to {group}: {error}"));
    }
}

impl Handler<GroupOutcome> for Drive {
    type Result = ();

    fn handle(&mut self, outcome: GroupOutcome, _: &mut AppContext<Self>) {
        let members = outcome.members.iter().map(|member| format!("{}: {:?}", member.tid, member.outcome));
        print_line(&format!("group {}: {}", outcome.tag, members.collect::<Vec<_>>().join(", ")));
    }
}

fn ask(context: &mut AppContext<Drive>, target: &str) {
    match context.message(target, &Who {}).ask::<Me>(Duration::from_secs(10)) {
        Ok(reply) => {
            let wait = reply.into_actor(&Drive::default()).map(|me, _: &mut Drive, _: &mut _| match me {
                Ok(me) => print_line(&format!("answer {:?}", me.counts)),
                Err(error) => print_line(&format!("no answer: {error}")),
            });
            context.spawn(wait);
        }
        Err(error) => print_line(&format!("not asked: {error}")),
    }
}

/// The drive after its leader.
fn leg(tree: &str, drive: AppSpec<Drive>) -> SupervisorSpec {
    let leader = AppSpec::new("leader", Drive::default).handles::<Who>().handles::<Order>().own_thread();
    let leg = SupervisorSpec::new("leg").app(leader).app(drive);
    match tree {
        "rest-for-one" => leg.strategy(Strategy::RestForOne),
        _ => leg.intensity(1, Duration::from_secs(600)),
    }
}

/// Whether the witness has received a message.
static IS_HEARD: AtomicBool = AtomicBool::new(false);

/// Blocks its thread in a timer.
struct Neighbour {
    time: Duration,
    /// Waits until the witness has received a message.
    listens: bool,
    hangs: bool,
}

impl Actor for Neighbour {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        static LIVES: AtomicU64 = AtomicU64::new(0);
        let (time, is_first) = (self.time, LIVES.fetch_add(1, Ordering::Relaxed) == 0);
        context.every(Duration::from_millis(500), move |neighbour, _, _| {
            if neighbour.hangs || (neighbour.listens && !IS_HEARD.load(Ordering::Relaxed)) {
                return;
            }
            neighbour.hangs = true;
            if time.is_zero() {
                print_line("hangs");
                std::thread::park_timeout(Duration::MAX);
            } else if is_first {
                print_line("hangs");
                std::thread::sleep(time);
                print_line("comes back");
            }
        });
    }
}

fn neighbour(time: Duration, listens: bool) -> AppSpec<Neighbour> {
    AppSpec::new("neighbour", move || Neighbour { time, listens, hangs: false })
        .requires(["drive"])
        .on_io_thread()
        .progress_within(Duration::from_millis(100))
}

/// Prints each received number, with its sequence number.
struct Witness;

impl Actor for Witness {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Count>> for Witness {
    type Result = ();

    fn handle(&mut self, count: Delivery<Count>, _: &mut Self::Context) {
        print_line(&format!("heard {} in {}", count.number, count.sequence));
        IS_HEARD.store(true, Ordering::Relaxed);
    }
}

/// Prints the fates of the drive's messages, and the number of unknown ones, whenever they have changed.
fn audit(node: &NodeHandle) {
    let mut printed = String::new();
    loop {
        let audit = node.audit_here();
        let is_drives = |place: &Place| matches!(place, Place::Mailbox { name, .. } if name == "drive");
        let entries = audit.entries.iter().filter(|entry| is_drives(&entry.place));
        let account: Account = entries.map(|entry| entry.account).sum();
        let Account { delivered, failed, waiting, .. } = account;
        let unexplained: i64 = audit.entries.iter().map(|entry| entry.account.unexplained()).sum();
        let words = format!(
            "audit: {delivered} delivered, {failed} failed, {waiting} waiting, {unexplained} unexplained"
        );
        if words != printed {
            print_line(&words);
            printed = words;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Runs the node to its end, and the program beyond it if it `--stays`. Meanwhile, prints the fates of
/// messages if it `--audits`, and makes layers panic on command.
fn finish(node: Node, options: &Options<'_>) -> ExitCode {
    if options.has("--audits") {
        let handle = node.handle();
        std::thread::spawn(move || audit(&handle));
    }
    if options.has("--layers-panic") {
        let handle = node.handle();
        std::thread::spawn(move || crate::load::panic_on_command(&handle));
    }
    let code = node.run();
    if options.has("--stays") {
        print_line("node has ended");
        // The parent process ends it by closing the input.
        let _ = std::io::stdin().read_line(&mut String::new());
    }
    code
}

fn log_to_standard_error() {
    tracing_subscriber::fmt()
        .with_env_filter(
            tracing_subscriber::EnvFilter::builder()
                .with_default_directive(tracing::Level::WARN.into())
                .from_env_lossy(),
        )
        .with_writer(std::io::stderr)
        .init();
}

pub(super) fn run(arguments: &[String]) -> ExitCode {
    log_to_standard_error();
    let options = Options(arguments);
    let (is_set, after) = (|name: &str| options.has(name), |name: &str| options.value(name));
    let config = NodeConfig::from_file(&arguments[0]).expect("a scenario's configuration");
    let dies_with = after("--dies-at-start").map(|code| code.parse().expect("an exit code"));
    let talks = is_set("--talks");
    let swells: Option<usize> = after("--swells-at-start").map(|mib| mib.parse().expect("a number of MiB"));
    let time = |flag: &str| after(flag).map(|text| Duration::from_millis(text.parse().expect("a time")));
    let (starts_in, ramps_for) =
        (time("--starts-in"), time("--ramps-for").unwrap_or(Duration::from_millis(20)));
    let mut places = arguments.windows(3).filter(|flag| flag[0] == "--hangs-in");
    let hangs = places.next().map(|flag| Token { place: flag[1].clone(), file: flag[2].clone() });
    let drive = move || {
        hangs.iter().for_each(|token| token.hang_in("factory"));
        if let Some(code) = dies_with {
            std::process::exit(code);
        }
        Drive { talks, swells, starts_in, ramps_for, hangs: hangs.clone(), ..Drive::default() }
    };
    let mut drive = AppSpec::new("drive", drive)
        .handles::<Count>()
        .handles::<Level>()
        .handles::<Who>()
        .handles::<Order>()
        .handles::<NodeEvent>()
        .handles::<RequirementEvent>()
        .handles::<Undelivered>()
        .requires(after("--requires"));
    if swells.is_some() || starts_in.is_some() {
        drive = drive.start_within(time("--starts-within").unwrap_or(Duration::from_secs(1)));
    }
    drive = time("--stops-within").into_iter().fold(drive, AppSpec::stop_within);
    drive = time("--turns-within").into_iter().fold(drive, AppSpec::progress_within);
    drive = match after("--on-lost").as_deref() {
        None => drive,
        Some("pause") => drive.on_requirement_lost(RequirementPolicy::Pause),
        Some(_) => drive.on_requirement_lost(RequirementPolicy::Restart),
    };
    drive = match after("--place").as_deref() {
        None | Some("process") => drive.own_process(),
        Some("thread") => drive.own_thread(),
        Some(_) => drive.on_io_thread(),
    };
    let builder = Node::builder(config.name.clone()).config(config).heed_signals();
    let mut builder = match after("--tree").as_deref() {
        None => builder.app(drive),
        Some(tree) => builder.supervisor(leg(tree, drive)),
    };
    if talks {
        builder = builder.app(AppSpec::new("witness", || Witness).handles::<Count>().own_thread());
    }
    if let Some(millis) = after("--neighbour-hangs") {
        builder = builder.app(neighbour(Duration::from_millis(millis.parse().expect("a time")), talks));
    }
    match builder.start() {
        Ok(node) => {
            print_line("is up");
            finish(node, &options)
        }
        Err(error) => {
            print_line(&format!("refused {error}"));
            ExitCode::FAILURE
        }
    }
}
