//! The roles of those who are not to feel what happens to others: one that asks at a steady pace and measures, one that
//! answers, and one that takes what comes.

use std::{
    fmt,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use sinew::{ApiError, Endpoint, NodeApi, Payload as _};

use super::{
    heir,
    registration::{register, wishes},
    say, told,
};
use crate::{DEADLINE, puppet::Order};

/// The name of the one that answers.
pub(super) const ECHO: &str = "echo";
/// The name of the one that takes what comes.
pub(super) const SINK: &str = "sink";

/// Time between two questions.
const PACE: Duration = Duration::from_millis(1);

/// How long answers took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Window {
    /// Answers.
    pub count: u64,
    /// Questions without an answer when the scenario's deadline was over.
    pub failed: u64,
    /// Half of the answers took no longer, in microseconds.
    pub p50_us: u64,
    /// 99 of 100.
    pub p99_us: u64,
    /// The longest.
    pub max_us: u64,
}

impl Window {
    fn of(mut times: Vec<Duration>, failed: u64) -> Self {
        times.sort_unstable();
        let at = |share: usize| {
            let index = (times.len() * share / 100).min(times.len().saturating_sub(1));
            times.get(index).map_or(0, |time| time.as_micros() as u64)
        };
        Self { count: times.len() as u64, failed, p50_us: at(50), p99_us: at(99), max_us: at(100) }
    }

    /// As it was said by the one that asks.
    ///
    /// # Panics
    /// If it was not.
    #[must_use]
    pub fn read(line: &str) -> Self {
        let numbers: Vec<u64> = line.split_whitespace().map(|word| word.parse().expect("a number")).collect();
        let [count, failed, p50_us, p99_us, max_us] = numbers[..] else { panic!("{line:?} is no window") };
        Self { count, failed, p50_us, p99_us, max_us }
    }
}

impl fmt::Display for Window {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { count, failed, p50_us, p99_us, max_us } = self;
        write!(f, "{count} round trips, {failed} failed; p50 {p50_us} us, p99 {p99_us} us, max {max_us} us")
    }
}

/// `SOCKET [NAME]`: asks the one of this name, directly where it can, or the echo, and says what it measured since it was last told to
/// (`window`). What it asks while it is told to `rest` is not measured, until it is told to `measure`.
pub(super) fn play_pinger(arguments: &[String]) {
    let api = NodeApi::connect(&arguments[0]).expect("the door is open");
    let (name, is_direct) = arguments.get(1).map_or((ECHO, false), |name| (&**name, true));
    let wishes = wishes().requires([name]);
    let mut endpoint = register(&api, &if is_direct { wishes.direct(true) } else { wishes });
    let echo = endpoint.resolve(name, DEADLINE).expect("the node answers").expect("it is ready");
    let measured: Arc<Mutex<(Vec<Duration>, u64)>> = Arc::default();
    let measuring = measured.clone();
    let measures = Arc::new(AtomicBool::new(true));
    let is_measured = measures.clone();
    thread::spawn(move || {
        for number in 0.. {
            let (asked, counts) = (Instant::now(), is_measured.load(Ordering::Relaxed));
            let answer = endpoint.ask::<Order, Order>(echo, &Order { number }, DEADLINE);
            let took = asked.elapsed();
            let mut measured = measuring.lock().unwrap_or_else(PoisonError::into_inner);
            match answer {
                Ok(answer) => {
                    assert_eq!(answer.number, number, "the answer to another question");
                    measured.0.extend(counts.then_some(took));
                }
                Err(error) => {
                    eprintln!("question {number} after {took:?}: {error}");
                    measured.1 += 1;
                }
            }
            drop(measured);
            thread::sleep(PACE.saturating_sub(asked.elapsed()));
        }
    });
    say(&"up");
    for order in told() {
        match &*order {
            "rest" => measures.store(false, Ordering::Relaxed),
            "measure" => measures.store(true, Ordering::Relaxed),
            "window" => say_window(&measured),
            _ => panic!("the pinger is told {order:?}"),
        }
    }
}

fn say_window(measured: &Mutex<(Vec<Duration>, u64)>) {
    let (times, failed) = std::mem::take(&mut *measured.lock().unwrap_or_else(PoisonError::into_inner));
    let Window { count, failed, p50_us, p99_us, max_us } = Window::of(times, failed);
    say(&format!("{count} {failed} {p50_us} {p99_us} {max_us}"));
}

/// `SOCKET NAME`: answers questions, and lets go of everything else. Leaves a child behind if it is told to (`fork`).
pub(super) fn play_taker(arguments: &[String]) {
    let api = NodeApi::connect(&arguments[0]).expect("the door is open");
    let endpoint = register(&api, &wishes().direct(true).name(&*arguments[1]));
    let over = Arc::new(AtomicBool::new(false));
    let ends = over.clone();
    let taker = thread::spawn(move || take(endpoint, &ends));
    say(&"up");
    for order in told() {
        assert_eq!(order, "fork");
        say(&format!("forked {}", heir::fork()));
    }
    over.store(true, Ordering::Relaxed);
    taker.join().expect("the node lives as long as this");
}

fn take(mut endpoint: Endpoint, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        let received = match endpoint.receive(Duration::from_millis(100)) {
            Ok(Some(received)) => received,
            // It comes back by itself when its node was replaced.
            Ok(None) | Err(ApiError::Away(_)) => continue,
            Err(error) => panic!("{error}"),
        };
        if received.kind() == Order::KIND && received.wants_reply() {
            let question: Order = received.decode().expect("whoever asks here asks so");
            // Whoever asked may have been killed meanwhile.
            let _ = endpoint.reply(&received, &question);
        }
    }
}
