//! Joint work of two nodes of the robot, which a local client could disturb without touching a message: `hip`
//! sends to a group with `knee` as its only member, and both meet at barriers.
//!
//! Each doubling of the number of rounds uses a barrier with a new name. A barrier that was known before an
//! attack does not show whether there is room for another one.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{
        Arc, Mutex, MutexGuard,
        atomic::{AtomicBool, AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use sinew::{
    barrier::{Barrier, Meet as _},
    message::Sender,
    prelude::*,
};
use sinew_runtime::app::DynApp;
use sinew_runtime::lock;

use super::{
    keys::{HIP, KNEE},
    robot::{Member, Robot},
};
use sinew_testkit::scripted::reactor;
use sinew_testkit::{DEADLINE, until};

payload!("attacks.call", Control =>
    /// Sent to the group.
    #[derive(Clone, Copy, Debug)]
    struct Call { run: u64, number: u64 }
);

/// A group of the robot. Its address is among the highest, so it is among the last that fit in a list of
/// groups.
const GROUP: &str = "joints";
/// Time between two calls, and between two barriers. Their load is small compared with the timed requests:
/// there are no calls while requests are timed without an attack.
const PACE: Duration = Duration::from_millis(10);
const PAUSE: Duration = Duration::from_millis(50);
/// Timeout of a party at a barrier. The barrier opens as soon as the other party arrives.
const WITHIN: Duration = Duration::from_secs(10);
/// Grace period for calls in flight after the last one was sent.
const GRACE: Duration = Duration::from_secs(10);
/// Interval between checks for the end.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// The received calls of each run.
#[derive(Default)]
struct ReceivedCalls(Mutex<BTreeMap<u64, BTreeSet<u64>>>);

impl ReceivedCalls {
    fn calls(&self) -> MutexGuard<'_, BTreeMap<u64, BTreeSet<u64>>> {
        lock(&self.0)
    }
}

struct Party {
    lend: SyncSender<Sender>,
    received: Arc<ReceivedCalls>,
    is_member: bool,
}

impl Actor for Party {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        if self.is_member {
            context.join(GROUP);
        }
        // A later incarnation sends the same value, but it has no receiver then.
        let _ = self.lend.try_send(context.sender());
    }
}

impl Handler<Delivery<Call>> for Party {
    type Result = ();

    fn handle(&mut self, call: Delivery<Call>, _: &mut Self::Context) {
        self.received.calls().entry(call.run).or_default().insert(call.number);
    }
}

/// The name of a node's application for the joint work.
fn name_on(node: &str) -> String {
    format!("robot.{node}")
}

/// The application of a node, and its part in the joint work.
pub(super) fn part_of(node: &str) -> (DynApp, Part) {
    let (lend, lent) = sync_channel(1);
    let (received, is_member) = (Arc::<ReceivedCalls>::default(), node == KNEE.name);
    let noted = received.clone();
    let party = move || Party { lend: lend.clone(), received: noted.clone(), is_member };
    let app = AppSpec::new(name_on(node), party).handles::<Call>().own_thread().into();
    (app, Part { leads: node == HIP.name, lent, sender: None, received, running: None })
}

/// The part of one node.
pub(super) struct Part {
    /// It sends the calls, and leaves first at the end.
    leads: bool,
    lent: Receiver<Sender>,
    sender: Option<Sender>,
    received: Arc<ReceivedCalls>,
    running: Option<Running>,
}

struct Running {
    over: Arc<AtomicBool>,
    calling: Option<JoinHandle<Went>>,
    meeting: JoinHandle<Went>,
}

/// Number of attempts and failures.
#[derive(Default)]
struct Went {
    tried: u64,
    failed: u64,
    /// The first error.
    words: Option<String>,
}

impl Went {
    fn note<T, E: std::fmt::Display>(&mut self, result: Result<T, E>) {
        self.tried += 1;
        if let Err(error) = result {
            self.failed += 1;
            self.words.get_or_insert_with(|| error.to_string().replace('\n', " "));
        }
    }
}

impl Part {
    /// Answers a command of the scenario; `None` if it is not about the joint work. Commands:
    ///
    /// - `call`: one call outside of any run
    /// - `together RUN`: starts the run
    /// - `apart`: ends it
    /// - `parted`: `no`, or `SENT MET FAILED WORDS`
    /// - `received RUN`: the number of received calls of this run
    pub(super) fn answer(&mut self, line: &str) -> Option<String> {
        let (word, run) = line.split_once(' ').unwrap_or((line, "0"));
        let run = || run.parse().expect("a run's number");
        match word {
            "call" => {
                // The scenario checks whether the call is received.
                let _ = self.sender().send(Tid::group(GROUP), &Call { run: 0, number: 0 });
                Some("called".to_owned())
            }
            "together" => Some(self.begin(run())),
            "apart" => {
                self.running.iter().for_each(|running| running.over.store(true, Ordering::Relaxed));
                Some("stopping".to_owned())
            }
            "parted" => Some(self.parted()),
            "received" => Some(self.received.calls().get(&run()).map_or(0, BTreeSet::len).to_string()),
            _ => None,
        }
    }

    fn sender(&mut self) -> Sender {
        let lent = &self.lent;
        let sender = self
            .sender
            .get_or_insert_with(|| lent.recv_timeout(DEADLINE).expect("it starts: it requires nothing"));
        sender.clone()
    }

    fn begin(&mut self, run: u64) -> String {
        self.received.calls().retain(|number, _| *number == run);
        let over = Arc::new(AtomicBool::new(false));
        let calling = self.leads.then(|| {
            let (sender, over) = (self.sender(), over.clone());
            thread::spawn(move || call(&sender, run, &over))
        });
        let (sender, leads, ends) = (self.sender(), self.leads, over.clone());
        let meeting = thread::spawn(move || meet(&sender, run, leads, &ends));
        self.running = Some(Running { over, calling, meeting });
        "begun".to_owned()
    }

    fn parted(&mut self) -> String {
        let has_ended = |running: &Running| {
            running.meeting.is_finished() && running.calling.as_ref().is_none_or(JoinHandle::is_finished)
        };
        let Some(running) = self.running.take_if(|running| has_ended(running)) else {
            return "no".to_owned();
        };
        let join = |thread: JoinHandle<Went>| thread.join().expect("it only tries");
        let (called, met) = (running.calling.map(join).unwrap_or_default(), join(running.meeting));
        let words = [met.words, called.words].into_iter().flatten().next().unwrap_or_default();
        // A call that was not accepted has not arrived either: it counts as missed.
        format!("{} {} {} {words}", called.tried, met.tried - met.failed, met.failed)
    }
}

/// Sends calls to the group until the run is over.
fn call(sender: &Sender, run: u64, over: &AtomicBool) -> Went {
    let mut went = Went::default();
    for number in 0.. {
        if over.load(Ordering::Relaxed) {
            break;
        }
        went.note(sender.send(Tid::group(GROUP), &Call { run, number }));
        thread::sleep(PACE);
    }
    went
}

/// Meets the other node at barriers repeatedly. The leader ends between two rounds. The other party then
/// waits in vain, and ends on command.
fn meet(sender: &Sender, run: u64, leads: bool, over: &AtomicBool) -> Went {
    let runtime = reactor();
    let (mut went, is_over) = (Went::default(), || over.load(Ordering::Relaxed));
    for round in 1_u64.. {
        if is_over() {
            break;
        }
        let name = format!("robot.{run}.{}", round.ilog2());
        let barrier = Barrier::new(name, [HIP, KNEE].map(|node| name_on(node.name))).within(WITHIN);
        let passed = runtime.block_on(async {
            let mut meeting = sender.meet(&barrier);
            loop {
                match tokio::time::timeout(POLL_INTERVAL, &mut meeting).await {
                    Ok(passed) => break Some(passed),
                    Err(_) if is_over() && !leads => break None,
                    Err(_) => {}
                }
            }
        });
        let Some(passed) = passed else { break };
        went.note(passed);
        thread::sleep(PAUSE);
    }
    went
}

/// One run of the joint work, as the scenario sees it.
pub(super) struct Run<'a> {
    robot: &'a Robot,
    number: u64,
}

/// The result.
#[derive(Debug, Default)]
pub(super) struct Together {
    /// Calls sent to the group.
    pub(super) sent: u64,
    /// Calls that arrived.
    pub(super) received: u64,
    /// Barriers that opened for `hip`.
    pub(super) met: u64,
    /// Number of times that a barrier did not open for one of them, and the reason.
    pub(super) failed: u64,
    pub(super) words: String,
}

/// Starts both, as soon as a call of `hip` reaches `knee`.
pub(super) fn begin(robot: &Robot) -> Run<'_> {
    /// No run has the number 0.
    static RUNS: AtomicU64 = AtomicU64::new(1);
    let number = RUNS.fetch_add(1, Ordering::Relaxed);
    let [hip, knee] = robot.talkers();
    for node in [knee, hip] {
        node.ask("apart");
    }
    until("a call to the group reaches its member", || {
        hip.ask("call");
        (count(knee, 0) > 0).then_some(())
    });
    for node in [knee, hip] {
        node.ask(&format!("together {number}"));
    }
    Run { robot, number }
}

impl Run<'_> {
    /// Ends both, and returns the result after a grace period for the calls in flight.
    pub(super) fn end(self) -> Together {
        let [hip, knee] = self.robot.talkers();
        let (sent, met, failed, words) = part(hip);
        let (_, _, failed_there, words_there) = part(knee);
        let until = Instant::now() + GRACE;
        let mut received = count(knee, self.number);
        while received < sent && Instant::now() < until {
            thread::sleep(POLL_INTERVAL);
            received = count(knee, self.number);
        }
        let words = if words.is_empty() { words_there } else { words };
        Together { sent, received, met, failed: failed + failed_there, words }
    }
}

fn count(knee: &Member, run: u64) -> u64 {
    knee.ask(&format!("received {run}")).parse().expect("a number")
}

/// Ends its part. Returns the number of calls sent, of barriers that opened and that did not, and the reason.
fn part(node: &Member) -> (u64, u64, u64, String) {
    node.ask("apart");
    let line = until("one of both ends", || Some(node.ask("parted")).filter(|line| line != "no"));
    // Without a failure there is no fourth word.
    let mut words = line.splitn(4, ' ');
    let mut number = || {
        let word = words.next().and_then(|word| word.parse().ok());
        word.unwrap_or_else(|| panic!("{line:?} is no end"))
    };
    let [sent, met, failed] = [number(), number(), number()];
    (sent, met, failed, words.next().unwrap_or_default().to_owned())
}
