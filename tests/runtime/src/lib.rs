//! A root with applications only, on a thread of its own: for tests and benches of the supervision of actors.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

use std::{
    cell::RefCell,
    rc::Rc,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::{Duration, Instant},
};

use actix::Actor;
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    app::{AppWiring, DynApp},
    event_queue::EventQueue,
    mailbox::Mailbox,
    pending::{AppSink, Pending},
    router::{LocalRoute, Router},
    sender::{Directory, Sender},
    supervision::{
        ChildId, ChildSpec, Flags, Input, Intensity, Place, Policy, Reason, Supervisor, SupervisorFact,
        Threads,
    },
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Class, Payload},
};

/// No test waits longer than this for an event.
pub const DEADLINE: Duration = Duration::from_secs(60);

const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);

/// The TID of the n-th application.
pub fn tid(index: usize) -> Tid {
    Tid::new(NODE, AppAddress::fixed(index as u32).unwrap())
}

/// The message of the tests.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Number(pub u64);

impl Payload for Number {
    const NAME: &'static str = "test.number";
    const CLASS: Class = Class::Bulk;
}

/// A directory without names.
pub struct Nobody;

impl Directory for Nobody {
    fn resolve(&self, _: &str) -> Option<Tid> {
        None
    }

    fn set_member(&self, _: AppAddress, _: AppAddress, _: bool) {}
}

/// Applications under one supervisor.
pub struct Stage {
    /// The routing table.
    pub router: Arc<Router>,
    /// The mailbox of each application.
    pub mailboxes: Vec<Arc<Mailbox>>,
    /// The sender of each application.
    pub senders: Vec<Sender>,
    supervisor: EventQueue<Input>,
    facts: Receiver<(Time, SupervisorFact)>,
    abandoned: Arc<Abandoned>,
}

/// Threads that were abandoned and have not ended.
#[derive(Debug, Default)]
struct Abandoned {
    now: AtomicUsize,
    at_most: AtomicUsize,
}

/// The restart limits of the supervisor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Patience {
    /// The default limits.
    Default,
    /// Unlimited restarts, each after the first wait of the default; under SCHED_FIFO, where granted.
    Endless,
}

impl Stage {
    /// Starts these applications under a supervisor with the default limits.
    pub fn start(apps: Vec<DynApp>) -> Self {
        Self::start_with(apps, Patience::Default)
    }

    /// Starts these applications under a supervisor with these limits.
    pub fn start_with(apps: Vec<DynApp>, patience: Patience) -> Self {
        let router = Arc::new(Router::new(NODE));
        let (mut children, mut mailboxes, mut senders) = (Vec::new(), Vec::new(), Vec::new());
        for (index, app) in apps.into_iter().enumerate() {
            let mailbox = Mailbox::new(patience.mailbox_capacity());
            let pending = Pending::new(64);
            let tid = tid(index);
            let address = tid.app;
            let sender = Sender::new(tid, router.clone(), Arc::new(Nobody), pending.clone(), 1 << 20);
            let sink = Arc::new(AppSink { pending, inbox: mailbox.clone() });
            router.set_local(address, LocalRoute { sink, events: Arc::new([]) });
            children.push(ChildSpec {
                id: ChildId(index as u64),
                tid: None,
                name: app.name().to_owned(),
                policy: patience.policy(app.policy()),
                place: app.place().clone(),
                launch: app.launch(AppWiring { sender: sender.clone(), mailbox: mailbox.clone() }),
            });
            mailboxes.push(mailbox);
            senders.push(sender);
        }
        let (say, facts) = sync_channel(1_000);
        let abandoned = Arc::new(Abandoned::default());
        let counts = abandoned.clone();
        let (give, given) = sync_channel(1);
        std::thread::spawn(move || {
            if patience == Patience::Endless {
                // A bench shares its machine with others.
                Place::thread("root").realtime(60).prepare();
            }
            run(children, patience.flags(), say, counts, give);
        });
        let supervisor = given.recv_timeout(DEADLINE).expect("the supervisor's queue");
        Self { router, mailboxes, senders, supervisor, facts, abandoned }
    }

    /// Sends a number to an application, from itself.
    pub fn send(&self, to: usize, number: u64) {
        let sender = &self.senders[to];
        sender.send(sender.tid(), &Number(number)).expect("the mailbox takes it");
    }

    /// The supervisor's next report, and its time.
    pub fn next_fact_at(&self) -> (Time, SupervisorFact) {
        self.facts.recv_timeout(DEADLINE).expect("waited for a report of the supervisor")
    }

    /// The supervisor's next report.
    pub fn next_fact(&self) -> SupervisorFact {
        self.next_fact_at().1
    }

    /// The supervisor's reports that were not received yet, for the message of a failing test.
    pub fn facts_so_far(&self) -> Vec<(Time, SupervisorFact)> {
        self.facts.try_iter().collect()
    }

    /// Waits until this child is ready.
    pub fn wait_ready(&self, child: u64) {
        while self.next_fact() != SupervisorFact::Ready(ChildId(child)) {}
    }

    /// The child that fails next, and the reason.
    pub fn next_failed(&self) -> (u64, Reason) {
        loop {
            if let SupervisorFact::Failed(ChildId(id), reason) = self.next_fact() {
                return (id, reason);
            }
        }
    }

    /// The reason of this child's next failure.
    pub fn wait_failed(&self, child: u64) -> Reason {
        loop {
            let (id, reason) = self.next_failed();
            if id == child {
                return reason;
            }
        }
    }

    /// Waits until this many threads are abandoned and have not ended.
    pub fn wait_abandoned(&self, wanted: usize) {
        let until = Instant::now() + DEADLINE;
        while self.abandoned.now.load(Ordering::Relaxed) != wanted {
            assert!(Instant::now() < until, "never {wanted} threads that are given up");
            std::thread::sleep(Duration::from_millis(1)); // the polling interval
        }
    }

    /// The most threads that were abandoned at once so far.
    pub fn most_abandoned(&self) -> usize {
        self.abandoned.at_most.load(Ordering::Relaxed)
    }

    /// Orders the supervisor to stop, and does not wait.
    pub fn order_stop(&self) {
        // A supervisor that has given up by itself reads no more orders.
        let _ = self.supervisor.post(Input::StopOrdered);
    }

    /// Stops the supervisor, and returns the reason why it ended.
    pub fn stop(self) -> Reason {
        self.order_stop();
        self.wait_end()
    }

    /// The reason why the supervisor ended.
    pub fn wait_end(self) -> Reason {
        loop {
            if let SupervisorFact::Ended(reason) = self.next_fact() {
                return reason;
            }
        }
    }
}

impl Patience {
    fn policy(self, declared: &Policy) -> Policy {
        let policy = Policy { held: false, ..declared.clone() };
        match self {
            Self::Default => policy,
            Self::Endless => Policy { backoff_max: policy.backoff_min, ..policy },
        }
    }

    const fn mailbox_capacity(self) -> usize {
        match self {
            Self::Default => 64,
            Self::Endless => 65_536,
        }
    }

    fn flags(self) -> Flags {
        match self {
            Self::Default => Flags::default(),
            Self::Endless => Flags {
                intensity: Intensity { restarts_max: 1_000_000, ..Intensity::default() },
                ..Flags::default()
            },
        }
    }
}

fn run(
    children: Vec<ChildSpec>,
    flags: Flags,
    say: SyncSender<(Time, SupervisorFact)>,
    counts: Arc<Abandoned>,
    give: SyncSender<EventQueue<Input>>,
) {
    let system = actix::System::new();
    system.block_on(async move {
        let threads = Rc::new(RefCell::new(Threads::default()));
        let counted = threads.clone();
        actix::spawn(async move {
            loop {
                let now = counted.borrow().abandoned();
                counts.now.store(now, Ordering::Relaxed);
                counts.at_most.fetch_max(now, Ordering::Relaxed);
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        });
        let listener = move |fact: SupervisorFact| {
            let is_last = matches!(fact, SupervisorFact::Ended(_));
            // A test that has received enough no longer listens.
            let _ = say.send((Time::now(), fact));
            if is_last {
                actix::System::current().stop();
            }
        };
        let (supervisor, queue) = Supervisor::new("test", flags, children, threads, listener);
        supervisor.start();
        give.send(queue).unwrap();
    });
    system.run().unwrap();
}
