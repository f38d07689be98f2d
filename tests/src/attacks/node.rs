//! The role of each node of the robot: an application that answers, one that looks who is there, and one that asks.

use std::{
    collections::BTreeMap,
    fmt,
    io::BufRead,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use sinew::{
    NodeAddress,
    message::{Reply, Sender},
    prelude::*,
};

use super::together;
use crate::{
    DEADLINE,
    load::Times,
    puppet::{Order, desk},
    until,
};

/// The name of the application that answers.
pub(super) const ECHO: &str = "echo";
/// Questions that may wait for their answers at once: one that takes long holds up none, as in a control loop, and a stall of the machine is
/// no queue that lasts for many times as long.
const OPEN_MAX: usize = 64;
/// Time between the moments at which two questions are due.
const PACE: Duration = Duration::from_millis(1);

/// How long another answer may take when the attack is over, on a machine that is shared.
const AGAIN: Duration = Duration::from_secs(30);

/// All by the last byte of a node's address.
#[derive(Default)]
struct Counts {
    /// How often it was lost.
    lost: BTreeMap<u8, u64>,
    /// How often it was found.
    found: BTreeMap<u8, u64>,
    /// Messages that nobody asks with, which say that they are from there: nobody of the robot sends any.
    sent: BTreeMap<u8, u64>,
}

struct Echo(Arc<Mutex<Counts>>);

impl Echo {
    fn note(&self, which: impl FnOnce(&mut Counts) -> &mut BTreeMap<u8, u64>, node: NodeAddress) {
        let mut counts = lock(&self.0);
        *which(&mut counts).entry(node.bits() as u8).or_default() += 1;
    }
}

/// What was measured since the last time that somebody asked for it.
///
/// A question is due each [`PACE`], whether the one before has its answer or not, and its answer is timed from then on: what waits behind a
/// silence has waited, too.
struct Measured {
    since: Instant,
    /// In the window that began then.
    window: Window,
    /// When the oldest question was due that has no answer yet.
    due: Instant,
    /// Answers in all.
    answers: u64,
}

/// What was measured in a window, or in several.
#[derive(Default)]
struct Window {
    times: Times,
    count: u64,
    failed: u64,
    /// Questions that were asked more than a pace after they were due, because who asks had no CPU, or [`OPEN_MAX`] had no answer.
    late: u64,
    /// Questions that were due and had no answer at the end.
    waiting: u64,
    lasted: Duration,
}

impl Window {
    /// What was measured in another one is measured in this one, too.
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

    /// The question that was `due` then has been asked.
    fn asked(&mut self, due: Instant, now: Instant) {
        self.window.late += u64::from(now.saturating_duration_since(due) > PACE);
    }

    /// The oldest one, which was `due` then, has its answer, or will never have one. An answer to one of before this window counted there, as
    /// one that waits.
    fn ended(&mut self, due: Instant, now: Instant, is_answered: bool) {
        self.answers += u64::from(is_answered);
        self.window.failed += u64::from(!is_answered);
        if is_answered && due >= self.since {
            self.window.times.note(now.saturating_duration_since(due));
            self.window.count += 1;
        }
        self.due = (due + PACE).max(self.since);
    }

    /// Ends the window, and begins the next one. Questions that were due and have no answer count with the time that they have waited: else
    /// silence would look like no traffic at all.
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
            // Neither comes nor goes.
            NodeEvent::AppStalled { .. } | NodeEvent::AppResumed { .. } | NodeEvent::NodeRestarted { .. } => {
            }
        }
    }
}

/// `CONFIGURATION [asks | tries]`: says `up` when all runs; one that tries to get in says `runs` then, and `up` if it has got in. `window
/// NAME`: what was measured since the last one, with all that was called so before; `again`: whether questions are answered from now on; `seen`: who was lost, who was found, and what came unasked; `refused`: what the node refused, for each cause; `tid`: that of
/// the application that answers. What it does with another one is told in words of [`together::Part::answer`].
pub(super) fn play(arguments: &[String]) {
    let config = NodeConfig::from_file(&arguments[0]).expect("the director's configuration");
    let tries = arguments.get(1).is_some_and(|what| what == "tries");
    let asks = tries || arguments.get(1).is_some_and(|what| what == "asks");
    let counts: Arc<Mutex<Counts>> = Arc::default();
    let counted = counts.clone();
    let name = if asks { "idle" } else { ECHO };
    let echo = AppSpec::new(name, move || Echo(counted.clone()))
        .handles::<Order>()
        .handles::<NodeEvent>()
        .own_thread();
    let (asker, key) = desk("asker");
    let (party, mut part) = together::part_of(&config.name);
    let builder = Node::builder(config.name.clone()).config(config).app(echo).app(asker).app(party);
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
        // It is up when it has an answer.
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
                let name = name.unwrap_or_else(|| panic!("{line:?} is nothing that a node is told"));
                let all = windows.entry(name.to_owned()).or_default();
                // Whoever asks waits for no reckoning.
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

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Waits for the answer to a question that is asked from now on: the first one that comes may be to an older one.
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

/// Asks when a question is due, whether those before have their answers or not; another thread takes these, which come in the order of the
/// questions.
fn question(sender: &Sender, over: &AtomicBool, measured: &Mutex<Measured>) {
    let (put, taken) = std::sync::mpsc::sync_channel::<(u64, Instant, Option<Reply<Order>>)>(OPEN_MAX);
    std::thread::scope(|threads| {
        threads.spawn(|| {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
            let runtime = runtime.expect("a reactor with nothing but a timer");
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
    fn what_waits_behind_a_silence_is_late_and_as_slow_as_it_was_for_who_waited() {
        // Given: 100 questions, each answered in 100 us, but for the tenth, which takes 50 ms
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
        // Then: half of those that it held up waited for 25 ms and more, not one of a hundred
        let seen = window(&mut measured, now);
        let [count, failed, late, waiting, _, p99, max, _] = seen[..] else { panic!("{seen:?}") };
        assert_eq!((count, failed, waiting), (100, 0, 0));
        assert!((50..60).contains(&late), "{late}");
        assert_eq!(max, 50_000_000);
        assert!((45_000_000..50_000_000).contains(&p99), "{p99}");
    }

    #[test]
    fn a_silence_that_does_not_end_is_all_that_is_due_in_it_and_the_next_window_begins_anew() {
        let begin = Instant::now();
        let mut measured = Measured::new(begin);
        measured.asked(begin, begin);
        // When: nothing comes for 20 ms, and the answer 5 ms later
        let seen = window(&mut measured, begin + PACE * 20);
        measured.ended(begin, begin + PACE * 25, true);
        // Then
        assert_eq!(seen[..4], [0, 0, 0, 20]);
        assert_eq!((seen[5], seen[6]), (20_000_000, 20_000_000));
        assert_eq!(measured.due, begin + PACE * 20, "those before were counted");
        measured.asked(begin + PACE * 20, begin + PACE * 25);
        measured.ended(begin + PACE * 20, begin + PACE * 25, false);
        let seen = window(&mut measured, begin + PACE * 26);
        // One that was asked late and failed, and five that have no answer.
        assert_eq!(seen[..4], [0, 1, 1, 5]);
    }

    #[test]
    fn windows_of_one_name_are_one_whose_percentiles_are_those_of_all_their_answers() {
        let (begin, mut all) = (Instant::now(), Window::default());
        // Given: three windows of 100 answers each, of which the second alone has slow ones
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
        // Then: 4 of 300 are slow, so one of a hundred is
        let numbers: Vec<u128> = all.to_string().split(' ').map(|word| word.parse().unwrap()).collect();
        let quick = (PACE / 10).as_nanos();
        assert_eq!(numbers[..4], [300, 0, 0, 0]);
        assert_eq!(numbers[4..], [quick, (PACE / 2).as_nanos(), (PACE / 2).as_nanos(), 300_000_000]);
    }
}
