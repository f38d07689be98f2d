//! A root with applications and nothing else, on a thread of its own: for tests of what becomes of actors.

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
    mailbox::Mailbox,
    pending::{AppOutlet, Pending},
    post::Post,
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

/// No test waits longer than this for anything.
pub(crate) const DEADLINE: Duration = Duration::from_secs(60);

const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);

/// The TID of the n-th application.
pub(crate) fn tid(index: usize) -> Tid {
    Tid::new(NODE, AppAddress::fixed(index as u32).unwrap())
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Number(pub(crate) u64);

impl Payload for Number {
    const NAME: &'static str = "test.number";
    const CLASS: Class = Class::Bulk;
}

pub(crate) struct Nobody;

impl Directory for Nobody {
    fn resolve(&self, _: &str) -> Option<Tid> {
        None
    }

    fn set_member(&self, _: AppAddress, _: AppAddress, _: bool) {}
}

/// Applications under one supervisor.
pub(crate) struct Stage {
    pub(crate) mailboxes: Vec<Arc<Mailbox>>,
    pub(crate) senders: Vec<Sender>,
    supervisor: Post<Input>,
    facts: Receiver<(Time, SupervisorFact)>,
    abandoned: Arc<Abandoned>,
}

/// Threads that are given up and have not ended.
#[derive(Debug, Default)]
struct Abandoned {
    now: AtomicUsize,
    at_most: AtomicUsize,
}

/// How forgiving the supervisor is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Patience {
    /// As by default.
    Default,
    /// It restarts without end, each time after the first wait of the default; under SCHED_FIFO, where granted.
    Endless,
}

impl Stage {
    pub(crate) fn start(apps: Vec<DynApp>) -> Self {
        Self::start_with(apps, Patience::Default)
    }

    pub(crate) fn start_with(apps: Vec<DynApp>, patience: Patience) -> Self {
        let router = Arc::new(Router::new(NODE));
        let (mut children, mut mailboxes, mut senders) = (Vec::new(), Vec::new(), Vec::new());
        for (index, app) in apps.into_iter().enumerate() {
            let mailbox = Mailbox::new(patience.mailbox_capacity());
            let pending = Pending::new(64);
            let tid = tid(index);
            let address = tid.app;
            let sender = Sender::new(tid, router.clone(), Arc::new(Nobody), pending.clone(), 1 << 20);
            let outlet = Arc::new(AppOutlet { pending, inbox: mailbox.clone() });
            router.set_local(address, LocalRoute { outlet, events: Arc::new([]) });
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
        let supervisor = given.recv_timeout(DEADLINE).expect("the supervisor's post");
        Self { mailboxes, senders, supervisor, facts, abandoned }
    }

    pub(crate) fn send(&self, to: usize, number: u64) {
        let sender = &self.senders[to];
        sender.send(sender.tid(), &Number(number)).expect("the mailbox takes it");
    }

    /// What the supervisor says next, and when it said it.
    pub(crate) fn next_fact_at(&self) -> (Time, SupervisorFact) {
        self.facts.recv_timeout(DEADLINE).expect("the supervisor says something")
    }

    pub(crate) fn next_fact(&self) -> SupervisorFact {
        self.next_fact_at().1
    }

    /// What the supervisor said and nobody has heard yet, for the words of a test that fails.
    pub(crate) fn facts_so_far(&self) -> Vec<(Time, SupervisorFact)> {
        self.facts.try_iter().collect()
    }

    pub(crate) fn wait_ready(&self, child: u64) {
        while self.next_fact() != SupervisorFact::Ready(ChildId(child)) {}
    }

    /// Who fails next, and why.
    pub(crate) fn next_failed(&self) -> (u64, Reason) {
        loop {
            if let SupervisorFact::Failed(ChildId(id), reason) = self.next_fact() {
                return (id, reason);
            }
        }
    }

    /// Why this child failed next.
    pub(crate) fn wait_failed(&self, child: u64) -> Reason {
        loop {
            let (id, reason) = self.next_failed();
            if id == child {
                return reason;
            }
        }
    }

    /// Waits until so many threads are given up and have not ended.
    pub(crate) fn wait_abandoned(&self, wanted: usize) {
        let until = Instant::now() + DEADLINE;
        while self.abandoned.now.load(Ordering::Relaxed) != wanted {
            assert!(Instant::now() < until, "never {wanted} threads that are given up");
            std::thread::sleep(Duration::from_millis(1)); // the pace of the question
        }
    }

    /// The most threads that were given up at once so far.
    pub(crate) fn most_abandoned(&self) -> usize {
        self.abandoned.at_most.load(Ordering::Relaxed)
    }

    pub(crate) fn order_stop(&self) {
        // One that has given up by itself reads no more orders.
        let _ = self.supervisor.post(Input::StopOrdered);
    }

    pub(crate) fn stop(self) -> Reason {
        self.order_stop();
        self.wait_end()
    }

    /// Why the supervisor ended.
    pub(crate) fn wait_end(self) -> Reason {
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
    give: SyncSender<Post<Input>>,
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
            // A test that has seen enough listens no more.
            let _ = say.send((Time::now(), fact));
            if is_last {
                actix::System::current().stop();
            }
        };
        let (supervisor, post) = Supervisor::new("test", flags, children, threads, listener);
        supervisor.start();
        give.send(post).unwrap();
    });
    system.run().unwrap();
}
