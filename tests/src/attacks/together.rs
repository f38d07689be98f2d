//! What two nodes of the robot do together that somebody at a door could disturb without touching a message: `hip` sends to a group in which
//! `knee` alone has a member, and both meet at barriers.
//!
//! Of the barriers each doubling of the rounds has a name of its own: one that was known before an attack says nothing of whether there is
//! room for one more.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
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

use super::{
    keys::{HIP, KNEE},
    robot::{Member, Robot},
};
use crate::{DEADLINE, until};

payload!("attacks.call", Control =>
    /// Sent to the group.
    #[derive(Clone, Copy, Debug)]
    struct Call { run: u64, number: u64 }
);

/// The group of the robot's own. Its address is among the highest, so that it is among the last that have room in a list of groups.
const GROUP: &str = "joints";
/// Time between two calls, and from one barrier to the next: little beside the questions that are timed, as nobody calls while those are
/// timed that are left alone.
const PACE: Duration = Duration::from_millis(10);
const PAUSE: Duration = Duration::from_millis(50);
/// How long a party waits at a barrier that is open as soon as the other one is there.
const WITHIN: Duration = Duration::from_secs(10);
/// Time for a call that is under way when no more are sent.
const GRACE: Duration = Duration::from_secs(10);
/// Time between two looks at whether it is over.
const LOOK: Duration = Duration::from_millis(20);

/// Which calls of which run have come.
#[derive(Default)]
struct Heard(Mutex<BTreeMap<u64, BTreeSet<u64>>>);

impl Heard {
    fn calls(&self) -> MutexGuard<'_, BTreeMap<u64, BTreeSet<u64>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

struct Party {
    lend: SyncSender<Sender>,
    heard: Arc<Heard>,
    is_member: bool,
}

impl Actor for Party {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        if self.is_member {
            context.join(GROUP);
        }
        // A later life has the same one, and nobody waits for it.
        let _ = self.lend.try_send(context.sender());
    }
}

impl Handler<Delivery<Call>> for Party {
    type Result = ();

    fn handle(&mut self, call: Delivery<Call>, _: &mut Self::Context) {
        self.heard.calls().entry(call.run).or_default().insert(call.number);
    }
}

/// The name of a node's application that does all this.
fn name_on(node: &str) -> String {
    format!("robot.{node}")
}

/// The application of a node, and its part in what is done.
pub(super) fn part_of(node: &str) -> (DynApp, Part) {
    let (lend, lent) = sync_channel(1);
    let (heard, is_member) = (Arc::<Heard>::default(), node == KNEE.name);
    let noted = heard.clone();
    let party = move || Party { lend: lend.clone(), heard: noted.clone(), is_member };
    let app = AppSpec::new(name_on(node), party).handles::<Call>().own_thread().into();
    (app, Part { leads: node == HIP.name, lent, sender: None, heard, running: None })
}

/// What one node does.
pub(super) struct Part {
    /// It calls, and goes first when they part.
    leads: bool,
    lent: Receiver<Sender>,
    sender: Option<Sender>,
    heard: Arc<Heard>,
    running: Option<Running>,
}

struct Running {
    over: Arc<AtomicBool>,
    calling: Option<JoinHandle<Went>>,
    meeting: JoinHandle<Went>,
}

/// How often something was tried, and how it failed.
#[derive(Default)]
struct Went {
    tried: u64,
    failed: u64,
    /// The first time.
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
    /// The answer to what the director says; `None` if that is about something else. `call`: one call in no run; `together RUN`: begins it;
    /// `apart`: it is to end; `parted`: `no`, or `SENT MET FAILED WORDS`; `heard RUN`: how many calls of it have come.
    pub(super) fn answer(&mut self, line: &str) -> Option<String> {
        let (word, run) = line.split_once(' ').unwrap_or((line, "0"));
        let run = || run.parse().expect("a run's number");
        match word {
            "call" => {
                // Whether anybody hears it is what the director looks at.
                let _ = self.sender().send(Tid::group(GROUP), &Call { run: 0, number: 0 });
                Some("called".to_owned())
            }
            "together" => Some(self.begin(run())),
            "apart" => {
                self.running.iter().for_each(|running| running.over.store(true, Ordering::Relaxed));
                Some("told".to_owned())
            }
            "parted" => Some(self.parted()),
            "heard" => Some(self.heard.calls().get(&run()).map_or(0, BTreeSet::len).to_string()),
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
        self.heard.calls().retain(|heard, _| *heard == run);
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
        // A call that was not taken has not come either: it is missed.
        format!("{} {} {} {words}", called.tried, met.tried - met.failed, met.failed)
    }
}

/// Calls the group until it is over.
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

/// Meets the other one again and again. Who leads ends between two rounds; the other one, which waits in vain then, when it is told to.
fn meet(sender: &Sender, run: u64, leads: bool, over: &AtomicBool) -> Went {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
    let runtime = runtime.expect("a reactor with nothing but a timer");
    let (mut went, is_over) = (Went::default(), || over.load(Ordering::Relaxed));
    for round in 1_u64.. {
        if is_over() {
            break;
        }
        let name = format!("robot.{run}.{}", round.ilog2());
        let barrier = Barrier::new(name, [HIP, KNEE].map(|who| name_on(who.name))).within(WITHIN);
        let passed = runtime.block_on(async {
            let mut meeting = sender.meet(&barrier);
            loop {
                match tokio::time::timeout(LOOK, &mut meeting).await {
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

/// One time that they do it, as the director sees it.
pub(super) struct Run<'a> {
    robot: &'a Robot,
    number: u64,
}

/// What came of it.
#[derive(Debug, Default)]
pub(super) struct Together {
    /// Calls to the group.
    pub(super) sent: u64,
    /// Those of them that came.
    pub(super) heard: u64,
    /// Barriers that opened for `hip`.
    pub(super) met: u64,
    /// Times that one did not open for one of both, and why.
    pub(super) failed: u64,
    pub(super) words: String,
}

/// Has both begin, as soon as a call of `hip` reaches `knee`.
pub(super) fn begin(robot: &Robot) -> Run<'_> {
    /// No run is called 0.
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
    /// Has both end, and says what came of it when what was under way has had its time.
    pub(super) fn end(self) -> Together {
        let [hip, knee] = self.robot.talkers();
        let (sent, met, failed, words) = part(hip);
        let (_, _, failed_there, words_there) = part(knee);
        let until = Instant::now() + GRACE;
        let mut heard = count(knee, self.number);
        while heard < sent && Instant::now() < until {
            thread::sleep(LOOK);
            heard = count(knee, self.number);
        }
        let words = if words.is_empty() { words_there } else { words };
        Together { sent, heard, met, failed: failed + failed_there, words }
    }
}

fn count(knee: &Member, run: u64) -> u64 {
    knee.ask(&format!("heard {run}")).parse().expect("a number")
}

/// Has it end: calls that were sent, barriers that opened and that did not, and why.
fn part(node: &Member) -> (u64, u64, u64, String) {
    node.ask("apart");
    let line = until("one of both ends", || Some(node.ask("parted")).filter(|line| line != "no"));
    // Where nothing failed there is no fourth word.
    let mut words = line.splitn(4, ' ');
    let mut number = || {
        let word = words.next().and_then(|word| word.parse().ok());
        word.unwrap_or_else(|| panic!("{line:?} is no end"))
    };
    let [sent, met, failed] = [number(), number(), number()];
    (sent, met, failed, words.next().unwrap_or_default().to_owned())
}
