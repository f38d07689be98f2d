//! A node for the scenarios of applications in processes of their own.
//!
//! `process_under_test CONFIG.toml [--place thread|process|io] [--requires NAME] [--on-lost pause|restart]
//! [--dies-at-start CODE] [--neighbour-hangs MILLIS] [--talks] [--stays]
//! [--swells-at-start MIB] [--starts-in MILLIS] [--starts-within MILLIS] [--ramps-for MILLIS] [--stops-within MILLIS]
//! [--tree rest-for-one|escalation] [--hangs-in started|factory TOKEN] [--audits]`
//!
//! The application `drive` does as it is told (`Order`), and says what it sees, one line each. With a neighbour there is another
//! one on the `io` thread, which blocks that thread a moment after its start for so long; if for 0 ms, each life of it for ever.
//! A drive that talks tells its number to an application `witness` all the time, which says whom it heard. A program that
//! stays goes on after the end of its node, until its standard input ends. In a tree it is under the supervisor `leg`, behind
//! an application `leader` of the same kind in a thread; for an escalation, `leg` restarts one by one, and once. A node that audits says what
//! became of the drive's messages whenever that has changed.

use std::{
    os::unix::process::CommandExt,
    process::{Command, ExitCode, Stdio},
    sync::atomic::{AtomicBool, AtomicU64, Ordering},
};

use rustix::process::{Signal, getpid, kill_process};
use sinew::{
    NodeHandle,
    app::GroupOutcome,
    audit::{Account, Place},
    prelude::*,
    supervision::ReadyGate,
};
use sinew_tests::orders::{Count, Level, Me, Order, Who};

#[derive(Default)]
struct Drive {
    counts: Vec<u64>,
    talks: bool,
    /// How much memory it takes at its start, in MiB; it is never ready then.
    swells: Option<usize>,
    /// How long it takes until it is ready; it has a second, unless said otherwise.
    starts_in: Option<Duration>,
    /// Its first life does not come back from `started`.
    hangs: Option<Token>,
    /// How long it takes to stop; it has half a second, unless said otherwise.
    ramps_for: Duration,
}

/// Where one life hangs, and the file that says that none has yet.
#[derive(Clone)]
struct Token {
    place: String,
    file: String,
}

impl Token {
    fn hang_in(&self, place: &str) {
        if self.place == place && std::fs::remove_file(&self.file).is_ok() {
            say(&format!("hangs in its {place}"));
            loop {
                std::thread::park();
            }
        }
    }
}

fn say(what: &str) {
    println!("{} {what}", std::process::id());
}

/// Other processes of its node's that have not ended, as the kernel tells of them.
fn brothers() -> Vec<String> {
    let parent = std::os::unix::process::parent_id().to_string();
    let is_brother = |process: std::fs::DirEntry| {
        let stat = std::fs::read_to_string(process.path().join("stat")).ok()?;
        // The name before it may have blanks of its own.
        let (_, after_name) = stat.rsplit_once(')')?;
        let words: Vec<&str> = after_name.split_ascii_whitespace().collect();
        let has_ended = matches!(*words.first()?, "Z" | "X");
        // Not by the name `self`.
        let id: u32 = process.file_name().to_str()?.parse().ok()?;
        (*words.get(1)? == parent && id != std::process::id() && !has_ended).then_some(stat)
    };
    let processes = std::fs::read_dir("/proc").expect("it is always there");
    processes.filter_map(|process| is_brother(process.ok()?)).collect()
}

impl Actor for Drive {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        say(&format!("started {}", context.tid()));
        self.hangs.iter().for_each(|token| token.hang_in("started"));
        context.watch_input::<Level>(None, Duration::from_millis(50), |_, _, _| say("silence"));
        if self.talks {
            context.every(Duration::from_millis(2), |_, _, context| {
                // What the node does not take is not heard.
                let _ = context.send("witness", &Count { number: u64::from(std::process::id()) });
            });
        }
        if let Some(mib) = self.swells {
            say(&format!("process has these brothers: {:?}", brothers()));
            // A process that has much to give back takes its time to die.
            std::mem::forget((vec![1_u8; mib << 20], context.hold_ready()));
            say("has swollen");
        }
        if let Some(time) = self.starts_in {
            let mut ready = context.hold_ready();
            context.after(time, move |_, _, _| ready.take().into_iter().for_each(ReadyGate::reached));
        }
    }

    fn stopping(&mut self, context: &mut Self::Context) -> Running {
        if self.counts.contains(&u64::MAX) {
            say("stopping");
            return Running::Stop;
        }
        say("ramping down");
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
        say(&format!("level {}", level.value));
    }
}

impl Handler<Delivery<Who>> for Drive {
    type Result = ();

    fn handle(&mut self, who: Delivery<Who>, context: &mut Self::Context) {
        let me = Me { pid: std::process::id(), counts: self.counts.clone() };
        if let Err(error) = context.reply(&who, &me) {
            say(&format!("no reply: {error}"));
        }
    }
}

impl Handler<Delivery<NodeEvent>> for Drive {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        say(&format!("event {:?}", event.payload));
    }
}

impl Handler<Delivery<RequirementEvent>> for Drive {
    type Result = ();

    fn handle(&mut self, event: Delivery<RequirementEvent>, context: &mut Self::Context) {
        let name = event.name();
        say(&format!("requirement {:?}, {name} is {:?}", event.payload, context.resolve(name)));
    }
}

impl Handler<Delivery<Undelivered>> for Drive {
    type Result = ();

    fn handle(&mut self, undelivered: Delivery<Undelivered>, _: &mut Self::Context) {
        say(&format!("undelivered: {}", undelivered.payload));
    }
}

impl Handler<Delivery<Order>> for Drive {
    type Result = ();

    fn handle(&mut self, order: Delivery<Order>, context: &mut Self::Context) {
        match order.payload {
            Order::Panic => panic!("this is the panic that the scenario asks for"),
            Order::Stop => context.stop(),
            Order::Hold(millis) => {
                say("holds");
                std::thread::sleep(Duration::from_millis(millis));
            }
            Order::Hang => loop {
                std::thread::park();
            },
            Order::Exit(code) => std::process::exit(code),
            Order::Abort => std::process::abort(),
            Order::OverflowTheStack => say(&format!("{}", overflow(&[0; 1024]))),
            Order::Kill => signal_myself(Signal::KILL),
            Order::Segfault => signal_myself(Signal::SEGV),
            Order::Refuse => context.reject(),
            Order::Join(group) => context.join(&group),
            Order::Leave(group) => context.leave(&group),
            Order::Send(to, number) => send(context, &to, number),
            Order::SendTo(tid) => {
                let sent = context.send(Tid::from_bits(tid), &Count { number: 1 });
                say(&format!("sent: {sent:?}"));
            }
            Order::SendToGroup(group) => send_to_group(context, &group),
            Order::Ask(whom) => ask(context, &whom),
            Order::Echo(ref to, _) => {
                if let Err(error) = context.send(&**to, &order.payload) {
                    say(&format!("no echo: {error}"));
                }
            }
            Order::ForgeNumbers(ref to) => {
                // The next one is the last that there is.
                let far = u64::MAX - 1;
                assert!(context.sender().count_on_from(far, far));
                send(context, to, 0);
            }
            Order::StopTheSystem => actix::System::current().stop(),
            Order::StartACommand => {
                let status = Command::new("true").status();
                say(&format!("command {status:?}"));
            }
            Order::StartASleeper(in_own_group) => start_a_sleeper(in_own_group),
        }
    }
}

/// It does not hold the output: the scenario waits for the end of that.
#[expect(clippy::zombie_processes, reason = "what becomes of it is what is tried")]
fn start_a_sleeper(in_own_group: bool) {
    let mut command = Command::new("sleep");
    command.arg("120").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    if in_own_group {
        command.process_group(0);
    }
    let sleeper = command.spawn().expect("a program that every system has");
    say(&format!("sleeper {}", sleeper.id()));
}

/// Does not return: another thread may take the signal, a moment later. The first SIGSEGV may meet the handler that Rust has
/// for stack overflows, the second one does not.
fn signal_myself(signal: Signal) -> ! {
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

fn send(context: &mut AppContext<Drive>, to: &str, number: u64) {
    match context.message(to, &Count { number }).confirmed(Duration::from_secs(10)) {
        Ok(confirmation) => {
            let wait =
                confirmation.into_actor(&Drive::default()).map(move |outcome, _: &mut Drive, _: &mut _| {
                    say(&format!("sent {number}: {outcome:?}"));
                });
            context.spawn(wait);
        }
        Err(error) => say(&format!("not sent {number}: {error}")),
    }
}

fn send_to_group(context: &mut AppContext<Drive>, group: &str) {
    let within = Duration::from_secs(10);
    let message = context.message(Tid::group(group), &Count { number: 1 });
    if let Err(error) = message.with_tag(1).confirmed_by_each(within) {
        say(&format!("not sent to {group}: {error}"));
    }
}

impl Handler<GroupOutcome> for Drive {
    type Result = ();

    fn handle(&mut self, told: GroupOutcome, _: &mut AppContext<Self>) {
        let members = told.members.iter().map(|member| format!("{}: {:?}", member.tid, member.outcome));
        say(&format!("group {}: {}", told.tag, members.collect::<Vec<_>>().join(", ")));
    }
}

fn ask(context: &mut AppContext<Drive>, whom: &str) {
    match context.message(whom, &Who {}).ask::<Me>(Duration::from_secs(10)) {
        Ok(reply) => {
            let wait = reply.into_actor(&Drive::default()).map(|me, _: &mut Drive, _: &mut _| match me {
                Ok(me) => say(&format!("answer {:?}", me.counts)),
                Err(error) => say(&format!("no answer: {error}")),
            });
            context.spawn(wait);
        }
        Err(error) => say(&format!("not asked: {error}")),
    }
}

/// The drive behind its leader.
fn leg(tree: &str, drive: AppSpec<Drive>) -> SupervisorSpec {
    let leader = AppSpec::new("leader", Drive::default).handles::<Who>().handles::<Order>().own_thread();
    let leg = SupervisorSpec::new("leg").app(leader).app(drive);
    match tree {
        "rest-for-one" => leg.strategy(Strategy::RestForOne),
        _ => leg.intensity(1, Duration::from_secs(600)),
    }
}

/// Somebody was heard by the witness.
static IS_HEARD: AtomicBool = AtomicBool::new(false);

/// Blocks its thread in a timer.
struct Neighbour {
    time: Duration,
    /// It waits until the witness has heard somebody.
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
                say("hangs");
                std::thread::park_timeout(Duration::MAX);
            } else if is_first {
                say("hangs");
                std::thread::sleep(time);
                say("comes back");
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

/// Says whom it heard.
struct Witness;

impl Actor for Witness {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Count>> for Witness {
    type Result = ();

    fn handle(&mut self, count: Delivery<Count>, _: &mut Self::Context) {
        say(&format!("heard {} in {}", count.number, count.sequence));
        IS_HEARD.store(true, Ordering::Relaxed);
    }
}

/// Says what became of the messages of the drive, and of how many that is not known, whenever it has changed.
fn audit(node: &NodeHandle) {
    let mut said = String::new();
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
        if words != said {
            say(&words);
            said = words;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Runs the node to its end, and the program beyond it if it `stays`; says meanwhile what became of messages if it `audits`.
fn run(node: Node, stays: bool, audits: bool) -> ExitCode {
    if audits {
        let handle = node.handle();
        std::thread::spawn(move || audit(&handle));
    }
    let code = node.run();
    if stays {
        say("node has ended");
        // Whoever started this program ends it so.
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

fn main() -> ExitCode {
    log_to_standard_error();
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let after = |flag: &str| {
        let mut pairs = arguments.windows(2).filter(|pair| pair[0] == flag);
        pairs.next().map(|pair| pair[1].clone())
    };
    let config = NodeConfig::from_file(&arguments[0]).expect("a scenario's configuration");
    let dies_with = after("--dies-at-start").map(|code| code.parse().expect("an exit code"));
    let is_set = |flag: &str| arguments.iter().any(|argument| argument == flag);
    let (talks, stays) = (is_set("--talks"), is_set("--stays"));
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
            say("is up");
            run(node, stays, is_set("--audits"))
        }
        Err(error) => {
            say(&format!("refused {error}"));
            ExitCode::FAILURE
        }
    }
}
