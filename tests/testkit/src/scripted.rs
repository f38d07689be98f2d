//! An application of a scenario: runs the scenario's code at each point of its lifecycle, and logs these
//! points.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
    mpsc::sync_channel,
};

use actix::StreamHandler;
use sinew::{message::Sender, prelude::*};
use tokio::runtime::Runtime;

use crate::{DEADLINE, Log};

payload!("scenario.job", Bulk =>
    /// A Bulk message.
    #[derive(Clone, Copy, Debug)]
    pub struct Job {
        /// Its number.
        pub number: u64,
    }
);
payload!("scenario.order", Control =>
    /// A Control message, or a request that is answered by the same.
    #[derive(Clone, Copy, Debug)]
    pub struct Order {
        /// Its number.
        pub number: u64,
    }
);
payload!("scenario.value", Stream =>
    /// A Stream message.
    #[derive(Clone, Copy, Debug)]
    pub struct Value {
        /// Its number.
        pub number: u64,
    }
);

/// A log entry of a scripted application. The first number is its incarnation, from 1.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Seen {
    /// Its factory created it.
    Made(u64),
    /// Its `started` ran.
    Started(u64),
    /// It received this message.
    Got(u64, u64),
    /// Its `stopping` ran.
    Stopping(u64),
    /// It was dropped.
    Dropped(u64),
    /// It was notified about a node.
    Node(NodeEvent),
    /// It was notified about a requirement.
    Requirement(RequirementEvent),
    /// A note of the scenario.
    Note(u64, &'static str),
}

type Place = Arc<dyn Fn(&mut ScriptedApp, &mut AppContext<ScriptedApp>) + Send + Sync>;
type LastPlace = Arc<dyn Fn(&mut ScriptedApp, &mut AppContext<ScriptedApp>) -> Running + Send + Sync>;

/// The scenario's code for each point.
#[derive(Clone, Default)]
struct Steps {
    made: Option<Arc<dyn Fn(u64) + Send + Sync>>,
    started: Option<Place>,
    got: Option<Place>,
    stopping: Option<LastPlace>,
    dropped: Option<Arc<dyn Fn(u64) + Send + Sync>>,
}

/// The application's actor.
pub struct ScriptedApp {
    /// Its incarnation, from 1.
    pub incarnation: u64,
    /// The number of the current message.
    pub number: u64,
    log: Log<Seen>,
    steps: Steps,
}

impl std::fmt::Debug for ScriptedApp {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "ScriptedApp(incarnation {})", self.incarnation)
    }
}

/// Declares a scripted application.
pub struct Script {
    steps: Steps,
    log: Log<Seen>,
}

impl std::fmt::Debug for Script {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Script")
    }
}

impl Default for Script {
    fn default() -> Self {
        Self::new()
    }
}

impl Script {
    /// A scripted application that only logs.
    #[must_use]
    pub fn new() -> Self {
        Self { steps: Steps::default(), log: Log::default() }
    }

    /// Runs `act` in its factory, with its incarnation.
    #[must_use]
    pub fn made(mut self, act: impl Fn(u64) + Send + Sync + 'static) -> Self {
        self.steps.made = Some(Arc::new(act));
        self
    }

    /// Runs `act` in its `started`.
    #[must_use]
    pub fn started(
        mut self,
        act: impl Fn(&mut ScriptedApp, &mut AppContext<ScriptedApp>) + Send + Sync + 'static,
    ) -> Self {
        self.steps.started = Some(Arc::new(act));
        self
    }

    /// Runs `act` for each message.
    #[must_use]
    pub fn got(
        mut self,
        act: impl Fn(&mut ScriptedApp, &mut AppContext<ScriptedApp>) + Send + Sync + 'static,
    ) -> Self {
        self.steps.got = Some(Arc::new(act));
        self
    }

    /// Runs `act` in its `stopping`.
    #[must_use]
    pub fn stopping(
        mut self,
        act: impl Fn(&mut ScriptedApp, &mut AppContext<ScriptedApp>) -> Running + Send + Sync + 'static,
    ) -> Self {
        self.steps.stopping = Some(Arc::new(act));
        self
    }

    /// Runs `act` in its `Drop`, with its incarnation.
    #[must_use]
    pub fn dropped(mut self, act: impl Fn(u64) + Send + Sync + 'static) -> Self {
        self.steps.dropped = Some(Arc::new(act));
        self
    }

    /// The application and its log. It handles jobs, orders and values, on a thread of its own.
    #[must_use]
    pub fn app(self, name: &str) -> (AppSpec<ScriptedApp>, Log<Seen>) {
        let Self { steps, log } = self;
        let (written, incarnations) = (log.clone(), AtomicU64::new(0));
        let make = move || {
            let incarnation = incarnations.fetch_add(1, Ordering::Relaxed) + 1;
            written.write(Seen::Made(incarnation));
            if let Some(act) = &steps.made {
                act(incarnation);
            }
            ScriptedApp { incarnation, number: 0, log: written.clone(), steps: steps.clone() }
        };
        let spec = AppSpec::new(name, make).handles::<Job>().handles::<Order>().handles::<Value>();
        (spec.own_thread(), log)
    }
}

impl ScriptedApp {
    /// Logs a note.
    pub fn note(&self, text: &'static str) {
        self.log.write(Seen::Note(self.incarnation, text));
    }

    fn got(&mut self, number: u64, context: &mut AppContext<Self>) {
        self.log.write(Seen::Got(self.incarnation, number));
        self.number = number;
        if let Some(act) = self.steps.got.clone() {
            act(self, context);
        }
    }
}

impl Actor for ScriptedApp {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.log.write(Seen::Started(self.incarnation));
        if let Some(act) = self.steps.started.clone() {
            act(self, context);
        }
    }

    fn stopping(&mut self, context: &mut Self::Context) -> Running {
        self.log.write(Seen::Stopping(self.incarnation));
        match self.steps.stopping.clone() {
            Some(act) => act(self, context),
            None => Running::Stop,
        }
    }
}

impl Drop for ScriptedApp {
    fn drop(&mut self) {
        self.log.write(Seen::Dropped(self.incarnation));
        if let Some(act) = &self.steps.dropped {
            act(self.incarnation);
        }
    }
}

impl Handler<Delivery<Job>> for ScriptedApp {
    type Result = ();

    fn handle(&mut self, job: Delivery<Job>, context: &mut Self::Context) {
        self.got(job.number, context);
    }
}

impl Handler<Delivery<Order>> for ScriptedApp {
    type Result = ();

    fn handle(&mut self, order: Delivery<Order>, context: &mut Self::Context) {
        self.got(order.number, context);
        if order.reply_to().is_some() {
            // The requester may have exited meanwhile.
            let _ = context.reply(&order, &Order { number: order.number });
        }
    }
}

impl Handler<Delivery<Value>> for ScriptedApp {
    type Result = ();

    fn handle(&mut self, value: Delivery<Value>, context: &mut Self::Context) {
        self.got(value.number, context);
    }
}

impl StreamHandler<u64> for ScriptedApp {
    fn handle(&mut self, number: u64, context: &mut Self::Context) {
        self.got(number, context);
    }
}

impl Handler<Delivery<NodeEvent>> for ScriptedApp {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        self.log.write(Seen::Node(event.payload));
    }
}

impl Handler<Delivery<RequirementEvent>> for ScriptedApp {
    type Result = ();

    fn handle(&mut self, event: Delivery<RequirementEvent>, _: &mut Self::Context) {
        self.log.write(Seen::Requirement(event.payload));
    }
}

/// Waits until a scripted application has received this many messages, over all its incarnations. Returns
/// their numbers in order.
#[track_caller]
pub fn wait_for_numbers(log: &Log<Seen>, count: usize) -> Vec<u64> {
    log.wait(&format!("message {count}"), |seen| Some(numbers(seen)).filter(|got| got.len() >= count))
}

/// Number of incarnations that a scripted application has started so far.
#[must_use]
pub fn incarnations(log: &Log<Seen>) -> usize {
    log.all().iter().filter(|seen| matches!(seen, Seen::Started(_))).count()
}

/// The numbers of the messages that it received, over all its incarnations, in order.
#[must_use]
pub fn numbers(entries: &[Seen]) -> Vec<u64> {
    let number = |seen: &Seen| if let Seen::Got(_, number) = seen { Some(*number) } else { None };
    entries.iter().filter_map(number).collect()
}

/// An application that only gives its [`Sender`] to the test.
struct Desk(std::sync::mpsc::SyncSender<Sender>);

impl Actor for Desk {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        // A later incarnation sends the same value, but it has no receiver then.
        let _ = self.0.try_send(context.sender());
    }
}

/// The sending side of an application of the test.
#[derive(Debug)]
pub struct SenderApp(std::sync::mpsc::Receiver<Sender>);

/// An application called `name` that sends on behalf of the test.
#[must_use]
pub fn sender_app(name: &str) -> (sinew_runtime::app::DynApp, SenderApp) {
    let (lend, lent) = sync_channel(1);
    (AppSpec::new(name, move || Desk(lend.clone())).own_thread().into(), SenderApp(lent))
}

impl SenderApp {
    /// The sender, once the application has started.
    ///
    /// # Panics
    /// If it does not start in time.
    #[must_use]
    pub fn sender(self) -> Sender {
        self.0.recv_timeout(DEADLINE).expect("the sender_app starts: it requires nothing")
    }
}

/// A reactor with nothing but a timer, for the outcomes that a thread awaits.
///
/// # Panics
/// If the system has no descriptor for it.
#[must_use]
pub fn reactor() -> Runtime {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
    runtime.expect("a reactor with nothing but a timer")
}

/// Waits for a future that the test's thread got from a sender.
///
/// # Panics
/// If the thread already has a reactor, which the thread of a test does not.
pub fn wait<F: Future>(future: F) -> F::Output {
    reactor().block_on(future)
}

/// Answers every [`Order`] with the same, and keeps no log.
#[derive(Debug)]
pub struct Echo;

/// An application that answers every [`Order`] with the same, on a thread of its own. It keeps no log.
#[must_use]
pub fn echo(name: &str) -> AppSpec<Echo> {
    AppSpec::new(name, || Echo).handles::<Order>().own_thread()
}

impl Actor for Echo {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Order>> for Echo {
    type Result = ();

    fn handle(&mut self, order: Delivery<Order>, context: &mut Self::Context) {
        if order.reply_to().is_some() {
            // The requester may have exited meanwhile.
            let _ = context.reply(&order, &Order { number: order.number });
        }
    }
}

/// Sends unconfirmed jobs with these numbers.
///
/// # Panics
/// If one is not accepted.
#[track_caller]
pub fn send_jobs(sender: &Sender, to: &str, numbers: impl IntoIterator<Item = u64>) {
    for number in numbers {
        sender.send(to, &Job { number }).unwrap_or_else(|error| panic!("job {number}: {error}"));
    }
}

/// Sends a confirmed job and returns its outcome.
///
/// # Panics
/// If the job is not accepted.
#[track_caller]
pub fn outcome_of_job(sender: &Sender, to: &str, number: u64) -> Outcome {
    wait(sender.message(to, &Job { number }).confirmed(DEADLINE).expect("somebody takes it"))
}
