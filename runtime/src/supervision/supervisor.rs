//! The supervisor's shell: an actix actor that carries out what its core decides.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc, sync::Arc, time::Duration};

use actix::{Actor, ActorContext, AsyncContext, Context, SpawnHandle, StreamHandler};

use crate::{
    post::Post,
    supervision::{
        Life, Place, ReadyGate, Reason, Threads,
        core::{ChildId, Core, Flags, Generation, Input, Order, Policy},
        guard::Guard,
        panics::install_hook,
        tenant::{Fate, Tenant},
        vitals::Vitals,
    },
    time::Time,
};

/// Makes a new instance of a child, on the child's thread. A panic in it is a failed start.
pub type Launch = Arc<dyn Fn(ReadyGate) -> Box<dyn Life> + Send + Sync>;

/// One child of a supervisor.
pub struct ChildSpec {
    /// Which child of its node it is.
    pub id: ChildId,
    /// Its name, for people.
    pub name: String,
    /// What its supervisor may do with it.
    pub policy: Policy,
    /// Where it runs.
    pub place: Place,
    /// How it is made.
    pub launch: Launch,
}

/// What a supervisor says to its owner.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SupervisorFact {
    /// This child takes messages.
    Ready(ChildId),
    /// This child failed or was stopped, and is started again if its turn comes.
    Failed(ChildId, Reason),
    /// This child is gone for good.
    Gone(ChildId, Reason),
    /// All children that are wanted and released are ready.
    AllReady,
    /// No child lives any more.
    Ended(Reason),
}

/// A child's declaration, and what holds its present life.
struct Child {
    spec: ChildSpec,
    tenant: Option<Tenant>,
}

/// Supervises children; ends when none of them lives any more.
pub struct Supervisor {
    name: &'static str,
    core: Core,
    children: BTreeMap<ChildId, Child>,
    threads: Rc<RefCell<Threads>>,
    post: Post<Input>,
    listener: Box<dyn FnMut(SupervisorFact)>,
    alarm: Option<SpawnHandle>,
}

/// Events that wait for a supervisor at most. Each child causes a handful; only a fault could fill this.
const POST_CAPACITY: usize = 16_384;
/// Time in which a thread that does not hang lets go a child whose life is taken.
const LETTING_GO: Duration = Duration::from_millis(200);

impl Supervisor {
    /// A supervisor called `name`, and the post through which it hears. `listener` is told of what happens, on the
    /// supervisor's thread.
    pub fn new(
        name: &'static str,
        flags: impl Into<Flags>,
        children: Vec<ChildSpec>,
        threads: Rc<RefCell<Threads>>,
        listener: impl FnMut(SupervisorFact) + 'static,
    ) -> (Self, Post<Input>) {
        let policies = children.iter().map(|child| (child.id, child.policy.clone())).collect();
        let post = Post::new(POST_CAPACITY);
        let supervisor = Self {
            name,
            core: Core::new(flags.into(), seed(), policies),
            children: children.into_iter().map(|spec| (spec.id, Child { spec, tenant: None })).collect(),
            threads,
            post: post.clone(),
            listener: Box::new(listener),
            alarm: None,
        };
        (supervisor, post)
    }

    fn feed(&mut self, input: Input, context: &mut Context<Self>) {
        self.core.handle(Time::now(), input);
        while let Some(order) = self.core.poll() {
            self.obey(order, context);
        }
        if let Some(alarm) = self.alarm.take() {
            context.cancel_future(alarm);
        }
        if let Some(wake) = self.core.next_wake() {
            let wait = wake.since(Time::now());
            self.alarm = Some(context.run_later(wait, |this, context| {
                this.alarm = None;
                this.feed(Input::TimePassed, context);
            }));
        }
    }

    fn obey(&mut self, order: Order, context: &mut Context<Self>) {
        match order {
            Order::Spawn(id, generation) => self.spawn(id, generation),
            Order::Stop(id, _) => {
                if let Some(tenant) = self.children.get(&id).and_then(|child| child.tenant.as_ref()) {
                    tenant.stop();
                }
            }
            Order::Abandon(id, _) => self.abandon(id, context),
            Order::Failed(id, reason) => {
                if reason.is_failure() {
                    tracing::error!(supervisor = self.name, child = self.name_of(id), %reason, "a child failed");
                }
                (self.listener)(SupervisorFact::Failed(id, reason));
            }
            Order::Ready(id) => {
                tracing::debug!(supervisor = self.name, child = self.name_of(id), "ready");
                (self.listener)(SupervisorFact::Ready(id));
            }
            Order::Gone(id, reason) => {
                tracing::info!(supervisor = self.name, child = self.name_of(id), %reason, "gone");
                (self.listener)(SupervisorFact::Gone(id, reason));
            }
            // Commands come to this shell with supervisors that are built at run time.
            Order::Deleted(_) | Order::Done(..) | Order::Refused(..) => {}
            Order::AllReady => (self.listener)(SupervisorFact::AllReady),
            Order::Ended(reason) => {
                (self.listener)(SupervisorFact::Ended(reason));
                context.stop();
            }
        }
    }

    fn name_of(&self, id: ChildId) -> &str {
        self.children.get(&id).map_or("unknown", |child| &child.spec.name)
    }

    fn spawn(&mut self, id: ChildId, generation: Generation) {
        install_hook();
        let Some(Child { spec, tenant: held }) = self.children.get_mut(&id) else { return };
        let mut threads = self.threads.borrow_mut();
        let post = self.post.clone();
        let (thread, seat) = match threads.get(&spec.place) {
            Ok(found) => found,
            Err(error) => {
                let why = format!("there is no thread for it: {error}; raise `ulimit -u` and `ulimit -n`");
                return say(&post, Input::Ended(id, generation, Reason::GaveUp(why)));
            }
        };
        let report = Box::new(move |fate| match fate {
            Fate::Hung(reason) => say(&post, Input::Hung(id, generation, reason)),
            Fate::Ended(reason) => say(&post, Input::Ended(id, generation, reason)),
        });
        let vitals = Vitals::new(&*spec.name);
        let tenant = Tenant::new(vitals, Some(seat), spec.policy.progress_within, report);
        threads.settle(&tenant);
        *held = Some(tenant.clone());
        let ready = {
            let (post, vitals) = (self.post.clone(), tenant.vitals().clone());
            ReadyGate::new(move || {
                vitals.set_ready();
                say(&post, Input::BecameReady(id, generation));
            })
        };
        let (launch, unborn) = (spec.launch.clone(), Unborn(Some(tenant)));
        // A thread that has ended drops this, which is reported: the next start makes a new thread.
        thread.spawn_fn(move || start(&launch, ready, unborn));
    }

    /// Takes a child's life. Its thread may have other tenants: it is given up only if it does not let the child go.
    fn abandon(&mut self, id: ChildId, context: &mut Context<Self>) {
        let Some(Child { spec, tenant }) = self.children.get_mut(&id) else { return };
        let Some(tenant) = tenant.take() else { return };
        tracing::error!(supervisor = self.name, child = spec.name, "its life is taken");
        tenant.kill();
        if tenant.holds_its_thread().is_some() {
            self.threads.borrow_mut().give_up(&tenant);
            return;
        }
        context.run_later(LETTING_GO, move |this, _| {
            if !tenant.has_ended() {
                this.threads.borrow_mut().give_up(&tenant);
            }
        });
    }
}

/// Chance from the operating system: nodes that are one program and start at one instant wait for different times.
fn seed() -> u64 {
    std::hash::BuildHasher::hash_one(&std::hash::RandomState::new(), 0_u8)
}

/// Runs on the child's thread.
fn start(launch: &Launch, ready: ReadyGate, mut unborn: Unborn) {
    if let Some(tenant) = unborn.0.take()
        && let Some(guard) = Guard::make(launch, ready, tenant)
    {
        actix_rt::spawn(guard);
    }
}

/// A child whose thread has not come to it yet, and perhaps never will.
struct Unborn(Option<Tenant>);

impl Drop for Unborn {
    fn drop(&mut self) {
        if let Some(tenant) = self.0.take() {
            tenant.vitals().set_gone();
            tenant.report(Fate::Ended(Reason::ThreadEnded));
        }
    }
}

fn say(post: &Post<Input>, input: Input) {
    if let Err(lost) = post.post(input) {
        tracing::error!(
            ?lost,
            "a supervisor was not told: its post is full, or who told it was replaced; its deadlines will notice"
        );
    }
}

impl Actor for Supervisor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        context.add_stream(self.post.attach());
        self.feed(Input::Started, context);
    }
}

impl StreamHandler<Input> for Supervisor {
    fn handle(&mut self, input: Input, context: &mut Context<Self>) {
        self.feed(input, context);
    }
}
