//! The role of each node of the robot: one application answers requests, one tracks the membership, and one
//! sends requests.

use std::{
    collections::BTreeMap,
    fmt,
    io::BufRead,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use sinew::{
    NodeAddress,
    message::{Reply, Sender},
    prelude::*,
};
use sinew_runtime::lock;

use super::together;
use sinew_testkit::report::Times;
use sinew_testkit::scripted::reactor;
use sinew_testkit::{
    DEADLINE,
    scripted::{Order, sender_app},
    until,
};

/// The name of the application that answers.
pub(super) const ECHO: &str = "echo";
/// Maximum number of unanswered requests. A slow answer does not delay the next request, as in a control
/// loop. The bound keeps a stall of the machine from building up a queue that lasts many times as long.
const OPEN_MAX: usize = 64;
/// Time between the due times of two requests.
const PACE: Duration = Duration::from_millis(1);

/// Maximum wait for an answer after the attack, on a shared machine.
const AGAIN: Duration = Duration::from_secs(30);

/// Counters, each by the last byte of a node's address.
#[derive(Default)]
struct Counts {
    /// Number of times that the node was lost.
    lost: BTreeMap<u8, u64>,
    /// Number of times that the node was found.
    found: BTreeMap<u8, u64>,
    /// Messages with this source that are not requests. No node of the robot sends any.
    sent: BTreeMap<u8, u64>,
}

struct Echo(Arc<Mutex<Counts>>);

impl Echo {
    fn note(&self, which: impl FnOnce(&mut Counts) -> &mut BTreeMap<u8, u64>, node: NodeAddress) {
        let mut counts = lock(&self.0);
        *which(&mut counts).entry(node.bits() as u8).or_default() += 1;
    }
}

/// Measurements since the last query.
///
/// A request is due each [`PACE`], even if the previous one has no answer yet. Its latency counts from its
/// due time, so that requests delayed by a stall include the wait.
struct Measured {
    since: Instant,
    /// The window that started at `since`.
    window: Window,
    /// Due time of the oldest unanswered request.
    due: Instant,
    /// Total number of answers.
    answers: u64,
}

/// The measurements of one or several windows.
#[derive(Default)]
struct Window {
    times: Times,
    count: u64,
    failed: u64,
    /// Requests sent more than one pace after their due time, because the sender had no CPU or [`OPEN_MAX`]
    /// requests were unanswered.
    late: u64,
    /// Requests that were due but unanswered at the end.
    waiting: u64,
    lasted: Duration,
}

impl Window {
    /// Adds the measurements of another window.
    fn add(&mut self, other: Self) {
        let Self { times, count, failed, late, waiting, lasted } = other;
        self.times.add(times);
        self.count += count;
        self.failed += failed;
        self.late += late;
        self.waiting += waiting;
        self.lasted += lasted;
    }
}

impl fmt::Display for Window {
    /// `COUNT FAILED LATE WAITING P50 P99 MAX LASTED`, times in nanoseconds.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { times, count, failed, late, waiting, lasted } = self;
        let [p50, p99, max] = [0.5, 0.99, 1.0].map(|share| times.percentile(share).as_nanos());
        write!(f, "{count} {failed} {late} {waiting} {p50} {p99} {max} {}", lasted.as_nanos())
    }
}

impl Measured {
    fn new(now: Instant) -> Self {
        Self { since: now, window: Window::default(), due: now, answers: 0 }
    }

    /// Records that the request due at `due` was sent.
    fn asked(&mut self, due: Instant, now: Instant) {
        self.window.late += u64::from(now.saturating_duration_since(due) > PACE);
    }

    /// Records that the oldest request, due at `due`, was answered or failed. A request due before this
    /// window already counted as unanswered in the previous one, so its answer is not counted again.
    fn ended(&mut self, due: Instant, now: Instant, is_answered: bool) {
        self.answers += u64::from(is_answered);
        self.window.failed += u64::from(!is_answered);
        if is_answered && due >= self.since {
            self.window.times.note(now.saturating_duration_since(due));
            self.window.count += 1;
        }
        self.due = (due + PACE).max(self.since);
    }

    /// Ends the window and starts the next one. Due but unanswered requests count with their waiting time so
    /// far. Otherwise a stall would look like no traffic.
    fn window(&mut self, now: Instant) -> Window {
        let mut window = std::mem::take(&mut self.window);
        let mut due = self.due;
        while due < now {
            window.times.note(now - due);
            window.waiting += 1;
            due += PACE;
        }
        window.lasted = now - std::mem::replace(&mut self.since, now);
        window
    }
}

impl Actor for Echo {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Order>> for Echo {
    type Result = ();

    fn handle(&mut self, order: Delivery<Order>, context: &mut Self::Context) {
        if context.reply(&order, &Order { number: order.number }).is_err() {
            self.note(|counts| &mut counts.sent, order.source.node);
        }
    }
}

impl Handler<Delivery<NodeEvent>> for Echo {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        match &event.payload {
            NodeEvent::NodeFound { node, .. } => self.note(|counts| &mut counts.found, *node),
            NodeEvent::NodeLost { node, .. } => self.note(|counts| &mut counts.lost, *node),
            // Not a change of the membership.
            NodeEvent::AppStalled { .. } | NodeEvent::AppResumed { .. } | NodeEvent::NodeRestarted { .. } => {
            }
        }
    }
}

/// `CONFIGURATION [asks | tries]`: prints `up` when everything runs. An intruder prints `runs` then, and `up`
/// once it has joined.
///
/// Commands on standard input:
///
/// - `window NAME`: measurements since the last window, added to all earlier windows of this name
/// - `again`: whether requests are answered from now on
/// - `seen`: nodes that were lost, nodes that were found, and unrequested messages
/// - `refused`: refusals of the node, by cause
/// - `tid`: the TID of the application that answers
///
/// The commands for joint work with the other node are those of [`together::Part::answer`].
pub(super) fn run(arguments: &[String]) {
    let config = NodeConfig::from_file(&arguments[0]).expect("the scenario's configuration");
    let tries = arguments.get(1).is_some_and(|what| what == "tries");
    let asks = tries || arguments.get(1).is_some_and(|what| what == "asks");
    let counts: Arc<Mutex<Counts>> = Arc::default();
    let counted = counts.clone();
    let name = if asks { "idle" } else { ECHO };
    let echo = AppSpec::new(name, move || Echo(counted.clone()))
        .handles::<Order>()
        .handles::<NodeEvent>()
        .own_thread();
    let (requester, key) = sender_app("requester");
    let (party, mut part) = together::part_of(&config.name);
    let builder = Node::builder(config.name.clone()).config(config).app(echo).app(requester).app(party);
    let node = builder.start().expect("a node");
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    if tries {
        println!("runs");
    }
    let sender = key.sender();
    let echo = until("the echo is there", || sender.resolve(ECHO));
    let over = Arc::new(AtomicBool::new(false));
    let measured = Arc::new(Mutex::new(Measured::new(Instant::now())));
    let asking = asks.then(|| {
        let (over, measured) = (over.clone(), measured.clone());
        std::thread::spawn(move || question(&sender, &over, &measured))
    });
    if asks {
        // It is up once it has an answer.
        until("the first answer", || (lock(&measured).answers > 0).then_some(()));
    }
    println!("up");
    let mut windows: BTreeMap<String, Window> = BTreeMap::new();
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        if let Some(answer) = part.answer(&line) {
            println!("{answer}");
            continue;
        }
        match &*line {
            "again" => println!("{}", u8::from(is_answered(&measured))),
            "seen" => {
                let counts = lock(&counts);
                let words = |kind: &str, of: &BTreeMap<u8, u64>| {
                    of.iter().map(|(node, count)| format!(" {kind} {node} {count}")).collect::<String>()
                };
                let Counts { lost, found, sent } = &*counts;
                println!("seen{}{}{}", words("lost", lost), words("found", found), words("sent", sent));
            }
            "refused" => {
                let refused = node.handle().audit_here().refused;
                let words = refused.iter().map(|(cause, count)| format!("\t{cause}\t{count}"));
                println!("refused{}", words.collect::<String>());
            }
            "tid" => println!("{}", echo.bits()),
            _ => {
                let name = line.strip_prefix("window ");
                let name = name.unwrap_or_else(|| panic!("{line:?} is no command of a node"));
                let all = windows.entry(name.to_owned()).or_default();
                // Printed after the lock is released, so that the requesting threads do not wait.
                let window = lock(&measured).window(Instant::now());
                all.add(window);
                println!("{all}");
            }
        }
    }
    over.store(true, Ordering::Relaxed);
    asking.into_iter().for_each(|thread| thread.join().expect("it does not fail"));
    node.stop();
}

/// Waits for the answer to a request sent after this call: the first answer may belong to an older request.
fn is_answered(measured: &Mutex<Measured>) -> bool {
    let (before, deadline) = (lock(measured).answers, Instant::now() + AGAIN);
    while lock(measured).answers < before + 2 {
        if Instant::now() > deadline {
            return false;
        }
        std::thread::sleep(PACE);
    }
    true
}

/// Sends each request at its due time, even if earlier ones are unanswered. Another thread awaits the
/// answers, which arrive in the order of the requests.
fn question(sender: &Sender, over: &AtomicBool, measured: &Mutex<Measured>) {
    let (put, taken) = std::sync::mpsc::sync_channel::<(u64, Instant, Option<Reply<Order>>)>(OPEN_MAX);
    std::thread::scope(|threads| {
        threads.spawn(|| {
            let runtime = reactor();
            for (number, due, asked) in taken {
                let answer = asked.and_then(|asked| runtime.block_on(asked).ok());
                assert!(
                    answer.as_ref().is_none_or(|answer| answer.number == number),
                    "the answer to another question"
                );
                lock(measured).ended(due, Instant::now(), answer.is_some());
            }
        });
        let mut due = lock(measured).due;
        for number in 0.. {
            if over.load(Ordering::Relaxed) {
                break;
            }
            std::thread::sleep(due.saturating_duration_since(Instant::now()));
            lock(measured).asked(due, Instant::now());
            let asked = sender.message(ECHO, &Order { number }).ask::<Order>(DEADLINE).ok();
            put.send((number, due, asked)).expect("it takes until nothing more comes");
            due += PACE;
        }
        drop(put);
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    fn window(measured: &mut Measured, at: Instant) -> Vec<u128> {
        measured.window(at).to_string().split(' ').map(|word| word.parse().expect("a number")).collect()
    }

    #[test]
    fn requests_delayed_by_a_stall_count_their_waiting_time() {
        // Given: 100 requests, each answered in 100 us, except for the tenth, which takes 50 ms
        let (begin, quick) = (Instant::now(), Duration::from_micros(100));
        let mut measured = Measured::new(begin);
        let mut now = begin;
        for number in 0..100 {
            let due = measured.due;
            now = now.max(due);
            measured.asked(due, now);
            now += if number == 9 { Duration::from_millis(50) } else { quick };
            measured.ended(due, now, true);
        }
        // Then: half of the delayed requests waited for at least 25 ms, not just one in a hundred
        let seen = window(&mut measured, now);
        let [count, failed, late, waiting, _, p99, max, _] = seen[..] else { panic!("{seen:?}") };
        assert_eq!((count, failed, waiting), (100, 0, 0));
        assert!((50..60).contains(&late), "{late}");
        assert_eq!(max, 50_000_000);
        assert!((45_000_000..50_000_000).contains(&p99), "{p99}");
    }

    #[test]
    fn unanswered_requests_count_in_one_window_only() {
        let begin = Instant::now();
        let mut measured = Measured::new(begin);
        measured.asked(begin, begin);
        // When: no answer arrives for 20 ms, and the first one arrives 5 ms later
        let seen = window(&mut measured, begin + PACE * 20);
        measured.ended(begin, begin + PACE * 25, true);
        // Then
        assert_eq!(seen[..4], [0, 0, 0, 20]);
        assert_eq!((seen[5], seen[6]), (20_000_000, 20_000_000));
        assert_eq!(measured.due, begin + PACE * 20, "those before were counted");
        measured.asked(begin + PACE * 20, begin + PACE * 25);
        measured.ended(begin + PACE * 20, begin + PACE * 25, false);
        let seen = window(&mut measured, begin + PACE * 26);
        // One request was sent late and failed, and five are unanswered.
        assert_eq!(seen[..4], [0, 1, 1, 5]);
    }

    #[test]
    fn merged_windows_have_percentiles_over_all_answers() {
        let (begin, mut all) = (Instant::now(), Window::default());
        // Given: three windows of 100 answers each, where only the second one has slow answers
        for (at, slow) in [(0, 0), (1_000, 4), (2_000, 0)] {
            let mut measured = Measured::new(begin + PACE * at);
            for number in 0..100 {
                let time = if number < slow { PACE / 2 } else { PACE / 10 };
                let due = measured.due;
                measured.ended(due, due + time, true);
            }
            let window = measured.window(measured.due);
            all.add(window);
        }
        // Then: 4 of 300 answers are slow, so the 99th percentile is slow
        let numbers: Vec<u128> = all.to_string().split(' ').map(|word| word.parse().unwrap()).collect();
        let quick = (PACE / 10).as_nanos();
        assert_eq!(numbers[..4], [300, 0, 0, 0]);
        assert_eq!(numbers[4..], [quick, (PACE / 2).as_nanos(), (PACE / 2).as_nanos(), 300_000_000]);
    }
}
