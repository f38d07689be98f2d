//! A node for the scenarios: one application that sends messages, and prints its observations, one line each.
//!
//! ```text
//! node_under_test CONFIG.toml [--requires NAME]... [--sends-to NAME] [--floods NAME]... [--will NAME]...
//! [--meets NAME]... [--incarnation NUMBER] [--says-directory] [--streams-to NAME [--stream BYTES]...]
//! [--stamps-to NAME] [--logs | --logs-info | --default-log] [--held] [--forgets-a-handler]
//! [--sends-text-to NAME] [--panics] [--tuned] [--tuned-apart]
//! ```
//!
//! With `--held` a thread-local variable of the main thread holds the node, and `main` returns 3 once the
//! node runs. The destructor of the variable stops the node.
//!
//! For each `--stream` length it runs another application, which sends a Stream value of this length every 20
//! ms. With `--stamps-to` a further application sends its own monotonic time every 20 ms. To each `--floods`
//! destination it sends the same counts, as many as are accepted. A will is a count of 1,000,000. The default
//! incarnation is the clock of its host.
//!
//! By default its log goes to standard error. With `--logs` warnings go to standard output, with
//! `--logs-info` more than these. With `--default-log` it installs no subscriber, as a first program does:
//! Sinew's own lines go to standard error.
//!
//! With `--tuned` it runs another application, called like the node with `.gains` behind it, which has parameters and
//! prints one of them when it changes. With `--tuned-apart` it runs one more, with `.apart` behind its name, in a
//! process of its own.
//!
//! Some options cause mistakes. With `--forgets-a-handler` counts are not declared as handled. With
//! `--sends-text-to` it sends a type with the name of a count but a text in its field, every 20 ms. With
//! `--panics` its application panics at the first count that it receives.
//!
//! It waits once at a barrier with the `--meets` parties, including itself, when it starts. It prints its
//! start time in nanoseconds of the monotonic clock, which all hosts of one machine share. With
//! `--says-directory` it prints the directory at each line `directory` of its standard input.

use std::{cell::RefCell, process::ExitCode, sync::Arc};

use sinew::{
    NodeHandle,
    barrier::{Barrier, Meet},
    prelude::*,
};

use super::Options;

payload!("scenario.count", Bulk => struct Count { number: u64 });

// The same message name in another version of the program.
payload!("scenario.count", Bulk => struct TextCount { number: String });

payload!("scenario.sized", Stream => struct Sized { number: u64, filler: Vec<u8> });

/// Maximum number of bytes of a value beside its filler.
const FRAME_OF_FILLER: usize = 12;

// The time of the sender: before this message was sent, and after the one before was.
payload!("scenario.stamp", Bulk => struct Stamp { number: u64, before_ns: u64, last_after_ns: u64 });

/// Sends stamps.
struct Stamper {
    to: String,
    number: u64,
    after_ns: u64,
}

impl Actor for Stamper {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(Duration::from_millis(20), |this, _, context| {
            this.number += 1;
            let before_ns = Time::now().as_nanos();
            let stamp = Stamp { number: this.number, before_ns, last_after_ns: this.after_ns };
            // A refused one is not compared.
            let _ = context.send(&*this.to, &stamp);
            this.after_ns = Time::now().as_nanos();
        });
    }
}

/// Sends values of one length.
struct Streamer {
    to: String,
    length: usize,
    sent: u64,
}

impl Actor for Streamer {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(Duration::from_millis(20), |this, _, context| {
            let filler = vec![7; this.length.saturating_sub(FRAME_OF_FILLER)];
            this.sent += u64::from(context.send(&*this.to, &Sized { number: this.sent + 1, filler }).is_ok());
        });
    }
}

params! {
    /// The parameters of a node under test.
    struct Gains {
        /// Assistance, as a share of the model's torque.
        assistance: f64 = 0.3, unit "1", range 0.0..=1.0;
        /// Greatest torque, which moves to a new value.
        torque_max: f64 = 20.0, unit "Nm", range 0.0..=60.0, slope 10.0, keep;
        /// Whether the joint is damped.
        damped: bool = false;
    }
}

/// Has parameters, and prints the assistance when it changes.
struct Tuned {
    gains: Arc<Gains>,
    printed: f64,
}

impl Actor for Tuned {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(Duration::from_millis(5), |this, tick, _| {
            let assistance = this.gains.assistance.get();
            if assistance != this.printed {
                println!("assistance {assistance} at tick {}", tick.number);
                this.printed = assistance;
            }
        });
    }
}

/// Counts per millisecond to each flooded destination.
const AT_ONCE: u32 = 100;

thread_local! {
    static HELD: RefCell<Option<Node>> = const { RefCell::new(None) };
}

struct Probe {
    sends_to: Option<String>,
    floods: Vec<String>,
    meets: Option<Barrier>,
    sends_text_to: Option<String>,
    panics: bool,
    sent: u64,
    last: u64,
}

impl Actor for Probe {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        println!("started {}", context.tid());
        println!("clock_ns {}", Time::now().as_nanos());
        if let Some(barrier) = &self.meets {
            let meeting = context.meet(barrier).into_actor(self);
            context.spawn(meeting.map(|passed, _, _| match passed {
                Ok(generation) => println!("met {generation}"),
                Err(error) => println!("not met: {error}"),
            }));
        }
        for to in self.floods.clone() {
            let mut sent = 0;
            context.every(Duration::from_millis(1), move |_, _, context| {
                for _ in 0..AT_ONCE {
                    sent += u64::from(context.send(&*to, &Count { number: sent + 1 }).is_ok());
                }
            });
        }
        if let Some(to) = self.sends_text_to.clone() {
            context.every(Duration::from_millis(20), move |_, tick, context| {
                let _ = context.send(&*to, &TextCount { number: format!("{}th", tick.number) });
            });
        }
        let Some(to) = self.sends_to.clone() else { return };
        context.every(Duration::from_millis(20), move |this, _, context| {
            // A message that is rejected while the network is cut does not count as sent.
            if context.send(&*to, &Count { number: this.sent + 1 }).is_ok() {
                this.sent += 1;
            }
        });
    }

    fn stopping(&mut self, _: &mut Self::Context) -> Running {
        println!("stopping");
        Running::Stop
    }
}

impl Handler<Delivery<Count>> for Probe {
    type Result = ();

    fn handle(&mut self, count: Delivery<Count>, _: &mut Self::Context) {
        assert!(!self.panics, "no encoder at /dev/ttyUSB0");
        println!("count {} from {} after {}", count.number, count.source, self.last);
        self.last = count.number;
    }
}

impl Handler<Delivery<Stamp>> for Probe {
    type Result = ();

    fn handle(&mut self, _: Delivery<Stamp>, _: &mut Self::Context) {}
}

impl Handler<Delivery<Sized>> for Probe {
    type Result = ();

    fn handle(&mut self, value: Delivery<Sized>, _: &mut Self::Context) {
        println!("sized {} number {}", value.filler.len() + FRAME_OF_FILLER, value.number);
    }
}

impl Handler<Delivery<NodeEvent>> for Probe {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        println!("event {:?}", event.payload);
    }
}

impl Handler<Delivery<RequirementEvent>> for Probe {
    type Result = ();

    fn handle(&mut self, event: Delivery<RequirementEvent>, _: &mut Self::Context) {
        println!("requirement {:?}", event.payload);
    }
}

/// Prints all applications and whether each is ready, at each request, until standard input closes.
fn say_the_directory(node: &NodeHandle) {
    for line in std::io::stdin().lines().map_while(Result::ok) {
        if line == "directory" {
            let directory = node.directory();
            let entries: Vec<String> =
                directory.iter().map(|entry| format!("{}={}", entry.name, entry.ready)).collect();
            println!("directory {}", entries.join(" "));
        }
    }
}

/// One application per streamed length.
fn streamers(name: &str, receivers: &[String], lengths: &[String]) -> Vec<AppSpec<Streamer>> {
    let of_one = |to: &String| {
        let lengths = lengths.iter().filter_map(|length| length.parse().ok());
        let of_length = |length: usize| {
            let receiver = to.clone();
            let make = move || Streamer { to: receiver.clone(), length, sent: 0 };
            AppSpec::new(format!("{name}.{length}"), make).requires([to.clone()])
        };
        lengths.map(of_length).collect::<Vec<_>>()
    };
    receivers.iter().flat_map(of_one).collect()
}

/// Logs to standard output at this level, or else to standard error.
fn log(level: Option<tracing::Level>) {
    if let Some(level) = level {
        tracing_subscriber::fmt().with_max_level(level).init();
    } else {
        tracing_subscriber::fmt()
            .with_env_filter(tracing_subscriber::EnvFilter::from_default_env())
            .with_writer(std::io::stderr)
            .init();
    }
}

pub(super) fn run(arguments: &[String]) -> ExitCode {
    let options = Options(arguments);
    let (has, after) = (|name: &str| options.has(name), |name: &str| options.values(name));
    if !has("--default-log") {
        let info = has("--logs-info").then_some(tracing::Level::INFO);
        log(info.or_else(|| has("--logs").then_some(tracing::Level::WARN)));
    }
    let config = match NodeConfig::from_file(&arguments[0]) {
        Ok(config) => config,
        Err(faults) => {
            println!("refused {faults}");
            return ExitCode::FAILURE;
        }
    };
    let sends_to = after("--sends-to").into_iter().next();
    let floods = after("--floods");
    let name = config.name.clone();
    let parties = after("--meets");
    let meets = (!parties.is_empty()).then(|| Barrier::new("step", parties));
    let (sends_text_to, panics) = (after("--sends-text-to").into_iter().next(), has("--panics"));
    let make = move || {
        let (sends_to, floods, meets) = (sends_to.clone(), floods.clone(), meets.clone());
        Probe { sends_to, floods, meets, sends_text_to: sends_text_to.clone(), panics, sent: 0, last: 0 }
    };
    let mut probe = AppSpec::new(name.as_str(), make);
    if !has("--forgets-a-handler") {
        probe = probe.handles::<Count>();
    }
    probe = probe
        .handles::<Sized>()
        .handles::<Stamp>()
        .handles::<NodeEvent>()
        .handles::<RequirementEvent>()
        .requires(after("--requires"))
        .own_thread();
    for heir in after("--will") {
        probe = probe.last_will(heir.as_str(), &Count { number: 1_000_000 });
    }
    let mut builder = Node::builder(name.clone()).config(config).app(probe).heed_signals();
    for streamer in streamers(&name, &after("--streams-to"), &after("--stream")) {
        builder = builder.app(streamer);
    }
    for to in after("--stamps-to") {
        let (app, receiver) = (format!("{name}.stamps"), to.clone());
        let make = move || Stamper { to: receiver.clone(), number: 0, after_ns: 0 };
        builder = builder.app(AppSpec::new(app, make).requires([to]));
    }
    if has("--tuned") {
        builder = builder.app(tuned(format!("{name}.gains")));
    }
    if has("--tuned-apart") {
        builder = builder.app(tuned(format!("{name}.apart")).own_process());
    }
    for number in after("--incarnation") {
        let Ok(number) = number.parse() else {
            println!("refused --incarnation {number}: it is no number");
            return ExitCode::FAILURE;
        };
        builder = builder.incarnation(sinew::address::Incarnation(number));
    }
    // Used before all others, so that its destructor runs after theirs.
    HELD.with(|held| drop(held.borrow()));
    start(builder, has("--held"), has("--says-directory"))
}

/// An application with parameters.
fn tuned(name: String) -> AppSpec<Tuned> {
    let gains = Gains::new();
    let shared = gains.clone();
    let make = move || Tuned { printed: shared.assistance.get(), gains: shared.clone() };
    AppSpec::new(name, make).params(&gains)
}

fn start(builder: NodeBuilder, is_held: bool, says_directory: bool) -> ExitCode {
    match builder.start() {
        Ok(node) if is_held => {
            let running = node.handle().wait_until_running(Duration::from_secs(60));
            HELD.set(Some(node));
            ExitCode::from(if running.is_ok() { 3 } else { 4 })
        }
        Ok(node) => {
            println!("up");
            if says_directory {
                let handle = node.handle();
                std::thread::spawn(move || say_the_directory(&handle));
            }
            node.run()
        }
        Err(error) => {
            println!("refused {error}");
            ExitCode::FAILURE
        }
    }
}
