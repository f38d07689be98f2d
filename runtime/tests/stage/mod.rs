//! A root with applications and nothing else, on a thread of its own: for tests of what becomes of actors.

use std::{
    cell::RefCell,
    rc::Rc,
    sync::{
        Arc,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
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
    supervision::{ChildId, ChildSpec, Input, Policy, Reason, Strategy, Supervisor, SupervisorFact, Threads},
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Class, Payload},
};

/// No test waits longer than this for anything.
pub(crate) const DEADLINE: Duration = Duration::from_secs(20);

const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Number(pub(crate) u64);

impl Payload for Number {
    const NAME: &'static str = "test.number";
    const CLASS: Class = Class::Bulk;
}

struct Nobody;

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
    facts: Receiver<SupervisorFact>,
    abandoned: Receiver<usize>,
}

impl Stage {
    pub(crate) fn start(apps: Vec<DynApp>) -> Self {
        let router = Arc::new(Router::new(NODE));
        let (mut children, mut mailboxes, mut senders) = (Vec::new(), Vec::new(), Vec::new());
        for (index, app) in apps.into_iter().enumerate() {
            let mailbox = Mailbox::new(64);
            let pending = Pending::new(64);
            let address = AppAddress::fixed(index as u32).unwrap();
            let tid = Tid::new(NODE, address);
            let sender = Sender::new(tid, router.clone(), Arc::new(Nobody), pending.clone(), 1 << 20);
            let outlet = Arc::new(AppOutlet { pending, inbox: mailbox.clone() });
            router.set_local(address, LocalRoute { outlet, events: Arc::new([]) });
            children.push(ChildSpec {
                id: ChildId(index as u64),
                tid: None,
                name: app.name().to_owned(),
                policy: Policy { held: false, ..app.policy().clone() },
                place: app.place().clone(),
                launch: app.launch(AppWiring { sender: sender.clone(), mailbox: mailbox.clone() }),
            });
            mailboxes.push(mailbox);
            senders.push(sender);
        }
        let (say, facts) = sync_channel(1_000);
        let (count, abandoned) = sync_channel(1_000);
        let (give, given) = sync_channel(1);
        std::thread::spawn(move || run(children, say, count, give));
        let supervisor = given.recv_timeout(DEADLINE).expect("the supervisor's post");
        Self { mailboxes, senders, supervisor, facts, abandoned }
    }

    pub(crate) fn send(&self, to: usize, number: u64) {
        let sender = &self.senders[to];
        sender.send(sender.tid(), &Number(number)).expect("the mailbox takes it");
    }

    pub(crate) fn next_fact(&self) -> SupervisorFact {
        self.facts.recv_timeout(DEADLINE).expect("the supervisor says something")
    }

    pub(crate) fn wait_ready(&self, child: u64) {
        while self.next_fact() != SupervisorFact::Ready(ChildId(child)) {}
    }

    /// Why this child failed next.
    pub(crate) fn wait_failed(&self, child: u64) -> Reason {
        loop {
            if let SupervisorFact::Failed(ChildId(id), reason) = self.next_fact()
                && id == child
            {
                return reason;
            }
        }
    }

    /// Waits until so many threads are given up and have not ended.
    pub(crate) fn wait_abandoned(&self, wanted: usize) {
        while self.abandoned.recv_timeout(DEADLINE).expect("the count is as wanted, at last") != wanted {}
    }

    pub(crate) fn stop(self) -> Reason {
        // One that has given up by itself reads no more orders.
        let _ = self.supervisor.post(Input::StopOrdered);
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

fn run(
    children: Vec<ChildSpec>,
    say: SyncSender<SupervisorFact>,
    count: SyncSender<usize>,
    give: SyncSender<Post<Input>>,
) {
    let system = actix::System::new();
    system.block_on(async move {
        let threads = Rc::new(RefCell::new(Threads::default()));
        let counted = threads.clone();
        actix::spawn(async move {
            loop {
                // Nobody reads it in most tests: then it fills up and the rest is lost.
                let _ = count.try_send(counted.borrow().abandoned());
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        });
        let listener = move |fact: SupervisorFact| {
            let is_last = matches!(fact, SupervisorFact::Ended(_));
            say.send(fact).unwrap();
            if is_last {
                actix::System::current().stop();
            }
        };
        let (supervisor, post) = Supervisor::new("test", Strategy::OneForOne, children, threads, listener);
        supervisor.start();
        give.send(post).unwrap();
    });
    system.run().unwrap();
}
