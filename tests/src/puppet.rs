//! An application of a scenario: does what the scenario says in each place of its life, and writes down that it was there.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
    mpsc::sync_channel,
};

use actix::StreamHandler;
use sinew::{message::Sender, prelude::*};

use crate::{DEADLINE, Log};

payload!("scenario.job", Bulk =>
    /// A Bulk message.
    #[derive(Clone, Copy, Debug)]
    pub struct Job {
        /// Which one.
        pub number: u64,
    }
);
payload!("scenario.order", Control =>
    /// A Control message, or a request that is answered by the same.
    #[derive(Clone, Copy, Debug)]
    pub struct Order {
        /// Which one.
        pub number: u64,
    }
);
payload!("scenario.value", Stream =>
    /// A Stream message.
    #[derive(Clone, Copy, Debug)]
    pub struct Value {
        /// Which one.
        pub number: u64,
    }
);

/// What a puppet writes down; the first number is its life, from 1.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Seen {
    /// Its factory made it.
    Made(u64),
    /// Its `started` ran.
    Started(u64),
    /// It has this message in its hand.
    Got(u64, u64),
    /// Its `stopping` ran.
    Stopping(u64),
    /// It was dropped.
    Dropped(u64),
    /// It heard of a node.
    Node(NodeEvent),
    /// It heard of a requirement.
    Requirement(RequirementEvent),
    /// What the scenario lets it say.
    Said(u64, &'static str),
}

type Place = Arc<dyn Fn(&mut Puppet, &mut AppContext<Puppet>) + Send + Sync>;
type LastPlace = Arc<dyn Fn(&mut Puppet, &mut AppContext<Puppet>) -> Running + Send + Sync>;

/// What the scenario does in each place.
#[derive(Clone, Default)]
struct Script {
    made: Option<Arc<dyn Fn(u64) + Send + Sync>>,
    started: Option<Place>,
    got: Option<Place>,
    stopping: Option<LastPlace>,
    dropped: Option<Arc<dyn Fn(u64) + Send + Sync>>,
}

/// The application's actor.
pub struct Puppet {
    /// Which of its lives this is, from 1.
    pub life: u64,
    /// The number of the message in its hand.
    pub number: u64,
    log: Log<Seen>,
    script: Script,
}

impl std::fmt::Debug for Puppet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Puppet(life {})", self.life)
    }
}

/// Declares a puppet.
pub struct Stage {
    script: Script,
    log: Log<Seen>,
}

impl std::fmt::Debug for Stage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Stage")
    }
}

impl Default for Stage {
    fn default() -> Self {
        Self::new()
    }
}

impl Stage {
    /// A puppet that only writes down.
    #[must_use]
    pub fn new() -> Self {
        Self { script: Script::default(), log: Log::default() }
    }

    /// In its factory, with the number of its life.
    #[must_use]
    pub fn made(mut self, act: impl Fn(u64) + Send + Sync + 'static) -> Self {
        self.script.made = Some(Arc::new(act));
        self
    }

    /// In its `started`.
    #[must_use]
    pub fn started(
        mut self,
        act: impl Fn(&mut Puppet, &mut AppContext<Puppet>) + Send + Sync + 'static,
    ) -> Self {
        self.script.started = Some(Arc::new(act));
        self
    }

    /// With each message in its hand.
    #[must_use]
    pub fn got(mut self, act: impl Fn(&mut Puppet, &mut AppContext<Puppet>) + Send + Sync + 'static) -> Self {
        self.script.got = Some(Arc::new(act));
        self
    }

    /// In its `stopping`.
    #[must_use]
    pub fn stopping(
        mut self,
        act: impl Fn(&mut Puppet, &mut AppContext<Puppet>) -> Running + Send + Sync + 'static,
    ) -> Self {
        self.script.stopping = Some(Arc::new(act));
        self
    }

    /// In its `Drop`, with the number of its life.
    #[must_use]
    pub fn dropped(mut self, act: impl Fn(u64) + Send + Sync + 'static) -> Self {
        self.script.dropped = Some(Arc::new(act));
        self
    }

    /// The application, and what it writes down. It takes jobs, orders and values, on a thread of its own.
    #[must_use]
    pub fn app(self, name: &str) -> (AppSpec<Puppet>, Log<Seen>) {
        let Self { script, log } = self;
        let (written, lives) = (log.clone(), AtomicU64::new(0));
        let make = move || {
            let life = lives.fetch_add(1, Ordering::Relaxed) + 1;
            written.write(Seen::Made(life));
            if let Some(act) = &script.made {
                act(life);
            }
            Puppet { life, number: 0, log: written.clone(), script: script.clone() }
        };
        let spec = AppSpec::new(name, make).handles::<Job>().handles::<Order>().handles::<Value>();
        (spec.own_thread(), log)
    }
}

impl Puppet {
    /// Writes this down.
    pub fn say(&self, words: &'static str) {
        self.log.write(Seen::Said(self.life, words));
    }

    fn got(&mut self, number: u64, context: &mut AppContext<Self>) {
        self.log.write(Seen::Got(self.life, number));
        self.number = number;
        if let Some(act) = self.script.got.clone() {
            act(self, context);
        }
    }
}

impl Actor for Puppet {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.log.write(Seen::Started(self.life));
        if let Some(act) = self.script.started.clone() {
            act(self, context);
        }
    }

    fn stopping(&mut self, context: &mut Self::Context) -> Running {
        self.log.write(Seen::Stopping(self.life));
        match self.script.stopping.clone() {
            Some(act) => act(self, context),
            None => Running::Stop,
        }
    }
}

impl Drop for Puppet {
    fn drop(&mut self) {
        self.log.write(Seen::Dropped(self.life));
        if let Some(act) = &self.script.dropped {
            act(self.life);
        }
    }
}

impl Handler<Delivery<Job>> for Puppet {
    type Result = ();

    fn handle(&mut self, job: Delivery<Job>, context: &mut Self::Context) {
        self.got(job.number, context);
    }
}

impl Handler<Delivery<Order>> for Puppet {
    type Result = ();

    fn handle(&mut self, order: Delivery<Order>, context: &mut Self::Context) {
        self.got(order.number, context);
        if order.reply_to().is_some() {
            // Whoever asked may have gone meanwhile.
            let _ = context.reply(&order, &Order { number: order.number });
        }
    }
}

impl Handler<Delivery<Value>> for Puppet {
    type Result = ();

    fn handle(&mut self, value: Delivery<Value>, context: &mut Self::Context) {
        self.got(value.number, context);
    }
}

impl StreamHandler<u64> for Puppet {
    fn handle(&mut self, number: u64, context: &mut Self::Context) {
        self.got(number, context);
    }
}

impl Handler<Delivery<NodeEvent>> for Puppet {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        self.log.write(Seen::Node(event.payload));
    }
}

impl Handler<Delivery<RequirementEvent>> for Puppet {
    type Result = ();

    fn handle(&mut self, event: Delivery<RequirementEvent>, _: &mut Self::Context) {
        self.log.write(Seen::Requirement(event.payload));
    }
}

/// Waits until a puppet got so many messages, over all its lives; returns their numbers in order.
#[track_caller]
pub fn wait_for_numbers(log: &Log<Seen>, count: usize) -> Vec<u64> {
    log.wait(&format!("message {count}"), |seen| Some(numbers(seen)).filter(|got| got.len() >= count))
}

/// How many lives a puppet began so far.
#[must_use]
pub fn lives(log: &Log<Seen>) -> usize {
    log.all().iter().filter(|seen| matches!(seen, Seen::Started(_))).count()
}

/// The numbers of the messages that it got, over all its lives, in order.
#[must_use]
pub fn numbers(entries: &[Seen]) -> Vec<u64> {
    let number = |seen: &Seen| if let Seen::Got(_, number) = seen { Some(*number) } else { None };
    entries.iter().filter_map(number).collect()
}

/// An application that only lends its [`Sender`] to the test.
struct Desk(std::sync::mpsc::SyncSender<Sender>);

impl Actor for Desk {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        // A later life has the same one, and nobody waits for it.
        let _ = self.0.try_send(context.sender());
    }
}

/// The sending side of an application of the test's own.
#[derive(Debug)]
pub struct DeskKey(std::sync::mpsc::Receiver<Sender>);

/// An application called `name` that sends what the test sends.
#[must_use]
pub fn desk(name: &str) -> (sinew_runtime::app::DynApp, DeskKey) {
    let (lend, lent) = sync_channel(1);
    (AppSpec::new(name, move || Desk(lend.clone())).own_thread().into(), DeskKey(lent))
}

impl DeskKey {
    /// The sender, once the application has started.
    ///
    /// # Panics
    /// If it does not in time.
    #[must_use]
    pub fn sender(self) -> Sender {
        self.0.recv_timeout(DEADLINE).expect("the desk starts: it requires nothing")
    }
}

/// Waits for a future that the test's thread got from a sender.
///
/// # Panics
/// If the thread has a reactor already, which a test's has not.
pub fn wait<F: Future>(future: F) -> F::Output {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
    runtime.expect("a reactor with nothing but a timer").block_on(future)
}

/// Sends jobs with these numbers, unconfirmed.
///
/// # Panics
/// If one is not taken.
#[track_caller]
pub fn send_jobs(sender: &Sender, to: &str, numbers: impl IntoIterator<Item = u64>) {
    for number in numbers {
        sender.send(to, &Job { number }).unwrap_or_else(|error| panic!("job {number}: {error}"));
    }
}

/// What became of a job that is sent now.
///
/// # Panics
/// If nobody takes it.
#[track_caller]
pub fn outcome_of_job(sender: &Sender, to: &str, number: u64) -> Outcome {
    wait(sender.message(to, &Job { number }).confirmed(DEADLINE).expect("somebody takes it"))
}
