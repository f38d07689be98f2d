//! The roles of those who are not to feel what happens to others: one that asks at a steady pace and measures, one that
//! answers, and one that takes what comes.

use std::{
    fmt,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use sinew::{Endpoint, NodeApi, Payload as _, client::ApiError};

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

/// Parts of a measurement that are told apart.
pub(super) const PARTS: usize = 4;
/// What takes longer is counted as this long: then only the longest is known exactly.
const TIME_MAX_US: usize = 1 << 16;

/// How many answers of one part took how many microseconds. Its memory does not grow with them: what the one that asks holds is counted.
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

    /// What was measured in these parts together.
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

/// `SOCKET [NAME]`: asks the one of this name, directly where it can, or the echo. `measure PART`: what it asks from now on belongs to
/// this part, at first to part 0; `rest`: to none. `window [PARTS]`: it says what it measured in these parts, else in part 0; `forget`: it
/// begins anew with all.
pub(super) fn play_pinger(arguments: &[String]) {
    let api = NodeApi::connect(&arguments[0]).expect("the door is open");
    let (name, is_direct) = arguments.get(1).map_or((ECHO, false), |name| (&**name, true));
    let wishes = wishes().requires([name]);
    let mut endpoint = register(&api, &if is_direct { wishes.direct(true) } else { wishes });
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
                    // Wherever it belongs: none may fail.
                    measured[part.min(PARTS - 1)].failed += 1;
                }
            }
            drop(measured);
            thread::sleep(PACE.saturating_sub(asked.elapsed()));
        }
    });
    say(&"up");
    for order in told() {
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
            _ => panic!("the pinger is told {order:?}"),
        }
    }
}

fn lock(measured: &Mutex<Vec<Times>>) -> MutexGuard<'_, Vec<Times>> {
    measured.lock().unwrap_or_else(PoisonError::into_inner)
}

fn say_window(measured: &[Times], parts: &[usize]) {
    let parts: Vec<_> = parts.iter().map(|part| &measured[*part]).collect();
    let Window { count, failed, p50_us, p99_us, max_us } = Times::window(&parts);
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
            Ok(None) | Err(ApiError::Disconnected(_)) => continue,
            Err(error) => panic!("{error}"),
        };
        if received.kind() == Order::KIND && received.wants_reply() {
            let question: Order = received.decode().expect("whoever asks here asks so");
            // Whoever asked may have been killed meanwhile.
            let _ = endpoint.reply(&received, &question);
        }
    }
}
