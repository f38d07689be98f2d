//! Roles that must stay unaffected by the others: one sends requests at a steady pace and measures, one
//! answers, and one only receives.

use sinew_runtime::lock;
use sinew_testkit::numbers;
use std::{
    fmt,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use sinew::{
    Endpoint, NodeApi, Payload as _,
    client::{ApiError, DirectLinks},
};

use super::{
    commands, fd_holder, print_line,
    registration::{register, wishes},
};
use sinew_testkit::{DEADLINE, scripted::Order};

/// The name of the process that answers.
pub(super) const ECHO: &str = "echo";
/// The name of the process that only receives.
pub(super) const SINK: &str = "sink";

/// Time between two requests.
const PACE: Duration = Duration::from_millis(1);

/// Latencies of answers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Window {
    /// Number of answers.
    pub count: u64,
    /// Requests without an answer within the scenario's deadline.
    pub failed: u64,
    /// Median latency, in microseconds.
    pub p50_us: u64,
    /// 99th percentile.
    pub p99_us: u64,
    /// Maximum.
    pub max_us: u64,
}

impl Window {
    /// Parses the output of the measuring process.
    ///
    /// # Panics
    /// If it is malformed.
    #[must_use]
    pub fn read(line: &str) -> Self {
        let [count, failed, p50_us, p99_us, max_us] = numbers(line)[..] else {
            panic!("{line:?} is no window")
        };
        Self { count, failed, p50_us, p99_us, max_us }
    }
}

impl fmt::Display for Window {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { count, failed, p50_us, p99_us, max_us } = self;
        write!(f, "{count} round trips, {failed} failed; p50 {p50_us} us, p99 {p99_us} us, max {max_us} us")
    }
}

/// Number of separately measured parts.
pub(super) const PARTS: usize = 4;
/// Longer times count as this long; only the maximum is exact.
const TIME_MAX_US: usize = 1 << 16;

/// A histogram of one part, in microseconds. Its memory does not grow with the number of answers, because the
/// memory of the measuring process is checked.
#[derive(Clone, Debug)]
struct Times {
    counts: Vec<u32>,
    failed: u64,
    max_us: u64,
}

impl Times {
    fn new() -> Self {
        Self { counts: vec![0; TIME_MAX_US + 1], failed: 0, max_us: 0 }
    }

    fn count(&mut self, took: Duration) {
        let us = took.as_micros() as u64;
        self.counts[(us as usize).min(TIME_MAX_US)] += 1;
        self.max_us = self.max_us.max(us);
    }

    /// The measurements of these parts together.
    fn window(parts: &[&Self]) -> Window {
        let at = |us: usize| parts.iter().map(|part| u64::from(part.counts[us])).sum::<u64>();
        let count: u64 = (0..=TIME_MAX_US).map(at).sum();
        let below = |share: u64| {
            let mut seen = 0;
            let found = (0..=TIME_MAX_US).find(|us| {
                seen += at(*us);
                seen > count * share / 100
            });
            found.unwrap_or_default() as u64
        };
        let failed = parts.iter().map(|part| part.failed).sum();
        let max_us = parts.iter().map(|part| part.max_us).max().unwrap_or_default();
        Window { count, failed, p50_us: below(50), p99_us: below(99), max_us }
    }
}

/// `SOCKET [NAME]`: sends requests to the process with this name, over a direct link if possible, or else to
/// the echo. Commands:
///
/// - `measure PART`: the following requests belong to this part (initially part 0)
/// - `rest`: the following requests belong to no part
/// - `window [PARTS]`: prints the measurements of these parts, by default of part 0
/// - `forget`: clears all parts
pub(super) fn run_pinger(arguments: &[String]) {
    let api = NodeApi::connect(&arguments[0]).expect("the node accepts clients");
    let (name, is_direct) = arguments.get(1).map_or((ECHO, false), |name| (&**name, true));
    let wishes = wishes().requires([name]);
    let mut endpoint = register(&api, &if is_direct { wishes.direct(DirectLinks::Always) } else { wishes });
    let echo = endpoint.resolve(name, DEADLINE).expect("the node answers").expect("it is ready");
    let measured = Arc::new(Mutex::new(vec![Times::new(); PARTS]));
    let measuring = measured.clone();
    let part = Arc::new(AtomicUsize::new(0));
    let present = part.clone();
    thread::spawn(move || {
        for number in 0.. {
            let (asked, part) = (Instant::now(), present.load(Ordering::Relaxed));
            let answer = endpoint.message(echo, &Order { number }).ask::<Order>(DEADLINE);
            let took = asked.elapsed();
            let mut measured = lock(&measuring);
            match answer {
                Ok(answer) => {
                    assert_eq!(answer.number, number, "the answer to another question");
                    measured.get_mut(part).into_iter().for_each(|times| times.count(took));
                }
                Err(error) => {
                    eprintln!("question {number} after {took:?}: {error}");
                    // A failure counts in any part: there must be none.
                    measured[part.min(PARTS - 1)].failed += 1;
                }
            }
            drop(measured);
            thread::sleep(PACE.saturating_sub(asked.elapsed()));
        }
    });
    print_line(&"up");
    for order in commands() {
        let mut words = order.split_whitespace();
        let word = words.next().unwrap_or_default();
        let parts: Vec<usize> = words.map(|part| part.parse().expect("the number of a part")).collect();
        match word {
            "rest" => part.store(usize::MAX, Ordering::Relaxed),
            "measure" => part.store(parts[0], Ordering::Relaxed),
            "forget" => lock(&measured).fill(Times::new()),
            "window" if parts.is_empty() => {
                say_window(&lock(&measured), &[0]);
                lock(&measured)[0] = Times::new();
            }
            "window" => say_window(&lock(&measured), &parts),
            _ => panic!("the pinger gets the order {order:?}"),
        }
    }
}

fn say_window(measured: &[Times], parts: &[usize]) {
    let parts: Vec<_> = parts.iter().map(|part| &measured[*part]).collect();
    let Window { count, failed, p50_us, p99_us, max_us } = Times::window(&parts);
    print_line(&format!("{count} {failed} {p50_us} {p99_us} {max_us}"));
}

/// `SOCKET NAME`: answers requests, and drops everything else. Leaves a child behind on the command `fork`.
pub(super) fn run_taker(arguments: &[String]) {
    let api = NodeApi::connect(&arguments[0]).expect("the node accepts clients");
    let endpoint = register(&api, &wishes().direct(DirectLinks::Always).name(&*arguments[1]));
    let over = Arc::new(AtomicBool::new(false));
    let ends = over.clone();
    let taker = thread::spawn(move || take(endpoint, &ends));
    print_line(&"up");
    for order in commands() {
        assert_eq!(order, "fork");
        print_line(&format!("forked {}", fd_holder::fork()));
    }
    over.store(true, Ordering::Relaxed);
    taker.join().expect("the node outlives this process");
}

fn take(mut endpoint: Endpoint, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        let received = match endpoint.receive(Duration::from_millis(100)) {
            Ok(Some(received)) => received,
            // It reconnects by itself after its node was replaced.
            Ok(None) | Err(ApiError::Disconnected(_)) => continue,
            Err(error) => panic!("{error}"),
        };
        if received.kind() == Order::KIND && received.wants_reply() {
            let question: Order = received.decode().expect("each question here is an order");
            // The requester may have been killed meanwhile.
            let _ = endpoint.reply(&received, &question);
        }
    }
}
