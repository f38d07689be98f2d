//! Applications under a supervisor, without any layer: delivery, panics, periods, watchdogs, requests, stop.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

use std::{
    cell::RefCell,
    rc::Rc,
    sync::{
        Arc,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
};

use actix::{Actor, ActorContext, AsyncContext, Handler, Running, fut::WrapFuture};
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    app::{AppContext, AppSpec, AppWiring, Delivery, DynApp, InputCriterion, InputTimeout, SendOutcome},
    mailbox::Mailbox,
    outcome::{Outcome, Rejection},
    pending::{AppOutlet, Pending},
    post::Post,
    router::{LocalRoute, Router},
    sender::{Directory, SendError, Sender},
    supervision::{ChildId, ChildSpec, Input, Policy, Strategy, Supervisor, SupervisorFact, Threads},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Class, Kind, Message, Payload},
};

const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
/// No test waits longer than this for anything.
const DEADLINE: Duration = Duration::from_secs(60);

struct Nobody;

impl Directory for Nobody {
    fn resolve(&self, _: &str) -> Option<Tid> {
        None
    }

    fn set_member(&self, _: AppAddress, _: AppAddress, _: bool) {}
}

#[derive(Serialize, Deserialize)]
struct Number(u64);

impl Payload for Number {
    const NAME: &'static str = "test.number";
    const CLASS: Class = Class::Bulk;
}

#[derive(Serialize, Deserialize)]
struct Unheard;

impl Payload for Unheard {
    const NAME: &'static str = "test.unheard";
}

/// A root with applications and nothing else, on a thread of its own.
struct Bench {
    router: Arc<Router>,
    mailboxes: Vec<Arc<Mailbox>>,
    senders: Vec<Sender>,
    supervisor: Post<Input>,
    facts: Receiver<SupervisorFact>,
}

impl Bench {
    fn start(apps: Vec<DynApp>) -> Self {
        let router = Arc::new(Router::new(NODE));
        let (mut children, mut mailboxes, mut senders) = (Vec::new(), Vec::new(), Vec::new());
        for (index, app) in apps.into_iter().enumerate() {
            let mailbox = Mailbox::new(64);
            let pending = Pending::new(64);
            let address = AppAddress::fixed(index as u32).unwrap();
            let sender = Sender::new(
                Tid::new(NODE, address),
                router.clone(),
                Arc::new(Nobody),
                pending.clone(),
                1 << 20,
            );
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
        let (give, given) = sync_channel(1);
        std::thread::spawn(move || run(children, say, give));
        let supervisor = given.recv_timeout(DEADLINE).expect("the supervisor's post");
        Self { router, mailboxes, senders, supervisor, facts }
    }

    fn wait_for(&self, wanted: &SupervisorFact) {
        loop {
            let fact = self.facts.recv_timeout(DEADLINE).unwrap_or_else(|_| panic!("no {wanted:?} came"));
            if fact == *wanted {
                return;
            }
        }
    }

    fn stop(self) {
        self.supervisor.post(Input::StopOrdered).unwrap();
        while !matches!(self.facts.recv_timeout(DEADLINE).expect("the end"), SupervisorFact::Ended(_)) {}
    }
}

fn run(children: Vec<ChildSpec>, say: SyncSender<SupervisorFact>, give: SyncSender<Post<Input>>) {
    let system = actix::System::new();
    system.block_on(async move {
        let threads = Rc::new(RefCell::new(Threads::default()));
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

/// Writes down what it gets; panics at 13 and refuses 99.
struct Scribe(SyncSender<u64>);

impl Actor for Scribe {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Number>> for Scribe {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, context: &mut Self::Context) {
        assert!(number.0 != 13, "thirteen");
        if number.0 == 99 {
            context.reject();
            return;
        }
        if number.reply_to().is_some() {
            context.reply(&number, &Number(number.0 * 2)).unwrap();
        }
        self.0.send(number.0).unwrap();
    }
}

fn scribe() -> (AppSpec<Scribe>, Receiver<u64>) {
    let (written, read) = sync_channel(1_000);
    (AppSpec::new("scribe", move || Scribe(written.clone())).handles::<Number>().own_thread(), read)
}

#[test]
fn messages_behind_a_panic_reach_the_new_instance_in_order_behind_the_same_tid() {
    let (spec, read) = scribe();
    let bench = Bench::start(vec![spec.into()]);
    bench.wait_for(&SupervisorFact::Ready(ChildId(0)));
    for number in [1, 13, 2, 3] {
        bench.senders[0].send(bench.senders[0].tid(), &Number(number)).unwrap();
    }
    let seen: Vec<_> = (0..3).map(|_| read.recv_timeout(DEADLINE).expect("a number")).collect();
    assert_eq!(seen, [1, 2, 3]);
    let tally = bench.mailboxes[0].tally(Class::Bulk);
    assert_eq!((tally.taken, tally.failed), (4, 1));
    bench.stop();
}

/// Sends what it is told to and writes down what became of it.
struct Asker {
    to: Tid,
    written: SyncSender<String>,
}

impl Actor for Asker {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let (sender, to, written) = (context.sender(), self.to, self.written.clone());
        let story = async move {
            for number in [7, 13, 99] {
                let outcome = sender.message(to, &Number(number)).confirmed(DEADLINE).unwrap().await;
                written.send(format!("{outcome:?}")).unwrap();
            }
            let unheard = sender.message(to, &Unheard).confirmed(DEADLINE).unwrap().await;
            assert_eq!(unheard, Outcome::Rejected(Rejection::UnknownKind));
            let reply = sender.message(to, &Number(21)).ask::<Number>(DEADLINE).unwrap().await;
            written.send(format!("{}", reply.unwrap().0)).unwrap();
        };
        context.spawn(story.into_actor(self));
    }
}

#[test]
fn every_confirmed_send_ends_in_one_outcome_and_requests_get_their_reply() {
    let (spec, _read) = scribe();
    let (written, told) = sync_channel(10);
    let to = Tid::new(NODE, AppAddress::fixed(0).unwrap());
    let asker = AppSpec::new("asker", move || Asker { to, written: written.clone() });
    let bench = Bench::start(vec![spec.into(), asker.into()]);
    let told: Vec<_> = (0..4).map(|_| told.recv_timeout(DEADLINE).expect("an outcome")).collect();
    assert_eq!(told, ["Delivered", "Failed", "Rejected(ByHandler)", "42"]);
    bench.stop();
}

/// Sends three numbers to each of two, and writes down what it is told of them.
struct Clerk {
    to: [Tid; 2],
    written: SyncSender<(u64, Outcome)>,
}

impl Actor for Clerk {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        for (tag, number) in [7, 13, 99].into_iter().enumerate() {
            context.message(self.to[0], &Number(number)).with_tag(tag as u64).confirmed(DEADLINE).unwrap();
        }
        let nobody = context.message(self.to[1], &Number(1)).with_tag(3).confirmed(DEADLINE);
        assert!(nobody.is_err(), "nobody takes it, and nobody tells of it");
    }
}

impl Handler<SendOutcome> for Clerk {
    type Result = ();

    fn handle(&mut self, told: SendOutcome, _: &mut Self::Context) {
        self.written.send((told.tag, told.outcome)).unwrap();
    }
}

#[test]
fn outcomes_come_as_messages_once_each_to_who_wants_them_so() {
    let (spec, _read) = scribe();
    let (written, told) = sync_channel(10);
    let to = [0, 7].map(|app| Tid::new(NODE, AppAddress::fixed(app).unwrap()));
    let clerk = AppSpec::new("clerk", move || Clerk { to, written: written.clone() });
    let bench = Bench::start(vec![spec.into(), clerk.into()]);
    let mut seen: Vec<_> = (0..3).map(|_| told.recv_timeout(DEADLINE).expect("an outcome")).collect();
    seen.sort_by_key(|(tag, _)| *tag);
    let outcomes = [Outcome::Delivered, Outcome::Failed, Outcome::Rejected(Rejection::ByHandler)];
    assert_eq!(seen, [(0, outcomes[0]), (1, outcomes[1]), (2, outcomes[2])]);
    bench.stop();
    assert!(told.try_recv().is_err(), "each is told once");
}

/// How long a watcher waits for numbers: an actor that gets no CPU for a while ticks five times before.
const SILENCE: Duration = Duration::from_millis(500);

/// Ticks each millisecond, and waits for numbers that stay away.
struct Watcher(SyncSender<&'static str>);

impl Actor for Watcher {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(Duration::from_millis(1), |this, tick, _| {
            if tick.number == 5 {
                this.0.send("five ticks").unwrap();
            }
        });
        context.watch_input::<Number>(None, SILENCE, |this, silence, _| {
            assert!(silence.silent >= SILENCE);
            this.0.send("silence").unwrap();
        });
    }

    fn stopping(&mut self, _: &mut Self::Context) -> Running {
        self.0.send("stopping").unwrap();
        Running::Stop
    }
}

impl Handler<Delivery<Number>> for Watcher {
    type Result = ();

    fn handle(&mut self, _: Delivery<Number>, _: &mut Self::Context) {
        self.0.send("number").unwrap();
    }
}

#[test]
fn periods_tick_and_each_silence_is_told_once() {
    let (say, heard) = sync_channel(100);
    let spec = AppSpec::new("watcher", move || Watcher(say.clone())).handles::<Number>();
    let bench = Bench::start(vec![spec.into()]);
    let next = || heard.recv_timeout(DEADLINE).expect("the watcher says something");
    assert_eq!([next(), next()], ["five ticks", "silence"]);
    bench.senders[0].send(bench.senders[0].tid(), &Number(1)).unwrap();
    assert_eq!([next(), next()], ["number", "silence"], "the next silence is a new one");
    bench.stop();
    assert_eq!(next(), "stopping");
}

/// Says when a watchdog by age, or the one by arrival, reports an input.
struct Judge(SyncSender<InputTimeout>);

impl Actor for Judge {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.watch_input::<Number>(None, SILENCE, |this, timeout, _| this.0.send(timeout).unwrap());
        context.watch_input_age::<Number>(None, SILENCE, |this, timeout, _| this.0.send(timeout).unwrap());
    }
}

impl Handler<Delivery<Number>> for Judge {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, _: &mut Self::Context) {
        assert!(number.is_older_than(SILENCE) && !number.is_older_than(DEADLINE), "{:?}", number.age);
    }
}

#[test]
fn late_values_that_keep_arriving_trip_a_watchdog_by_age() {
    let (say, heard) = sync_channel(100);
    let bench =
        Bench::start(vec![AppSpec::new("judge", move || Judge(say.clone())).handles::<Number>().into()]);
    let to = bench.senders[0].tid();
    // A machine that stands still for so long that nothing arrives trips the other one, too.
    let timeout = loop {
        let mut late = Message::typed(to, to, &Number(1));
        late.header.sent = Time::now() - 2 * SILENCE;
        bench.router.send(late).unwrap();
        match heard.recv_timeout(Duration::from_millis(1)) {
            Ok(timeout) if timeout.criterion == InputCriterion::Age => break timeout,
            Ok(_) | Err(_) => {}
        }
    };
    assert_eq!((timeout.kind, timeout.limit), (Number::KIND, SILENCE));
    assert!(timeout.is_silent() || timeout.age > Some(2 * SILENCE), "{timeout:?}");
    bench.stop();
}

/// Needs three more periods after it was told to stop, as a drive does that ramps its torque down.
struct Ramp {
    left: u32,
    down: SyncSender<()>,
}

impl Actor for Ramp {
    type Context = AppContext<Self>;

    fn stopping(&mut self, context: &mut Self::Context) -> Running {
        if self.left == 0 {
            return Running::Stop;
        }
        context.every(Duration::from_millis(1), |this, _, context| {
            this.left = this.left.saturating_sub(1);
            if this.left == 0 {
                this.down.try_send(()).ok();
                context.stop();
            }
        });
        Running::Continue
    }
}

#[test]
fn an_application_may_ramp_down_before_it_stops() {
    let (down, is_down) = sync_channel(1);
    let spec = AppSpec::new("drive", move || Ramp { left: 3, down: down.clone() });
    let bench = Bench::start(vec![spec.into()]);
    bench.wait_for(&SupervisorFact::Ready(ChildId(0)));
    bench.stop();
    is_down.recv_timeout(DEADLINE).expect("the ramp ended before the application did");
}

/// A backlog of slow messages beside a period.
struct Busy {
    handled: u64,
    say: SyncSender<u64>,
}

impl Actor for Busy {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(Duration::from_millis(1), |this, tick, _| {
            if tick.number == 1 {
                this.say.send(this.handled).unwrap();
            }
        });
    }
}

impl Handler<Delivery<Number>> for Busy {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, context: &mut Self::Context) {
        self.handled += 1;
        // Never lets its mailbox run empty.
        context.send(context.tid(), &number.payload).unwrap();
    }
}

#[test]
fn a_backlog_that_never_ends_starves_neither_the_periods_nor_the_stop() {
    let (say, heard) = sync_channel(1);
    let spec = AppSpec::new("busy", move || Busy { handled: 0, say: say.clone() }).handles::<Number>();
    let bench = Bench::start(vec![spec.into()]);
    bench.wait_for(&SupervisorFact::Ready(ChildId(0)));
    bench.senders[0].send(bench.senders[0].tid(), &Number(1)).unwrap();
    heard.recv_timeout(DEADLINE).expect("a tick in the middle of the backlog");
    assert_eq!(bench.router.refused(), 0);
    bench.stop();
}

/// Each turn of its period takes longer than the period.
struct Overrun(SyncSender<u64>);

impl Actor for Overrun {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(Duration::from_micros(100), |_, _, _| {
            let until = std::time::Instant::now() + Duration::from_micros(300);
            while std::time::Instant::now() < until {
                std::hint::spin_loop();
            }
        });
    }
}

impl Handler<Delivery<Number>> for Overrun {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, _: &mut Self::Context) {
        self.0.send(number.0).unwrap();
    }
}

#[test]
fn a_handler_that_overruns_its_period_does_not_shut_the_mailbox_out() {
    let (say, heard) = sync_channel(10);
    let spec = AppSpec::new("overrun", move || Overrun(say.clone())).handles::<Number>();
    let bench = Bench::start(vec![spec.into()]);
    bench.wait_for(&SupervisorFact::Ready(ChildId(0)));
    for number in 0..10 {
        bench.senders[0].send(bench.senders[0].tid(), &Number(number)).unwrap();
    }
    for number in 0..10 {
        assert_eq!(heard.recv_timeout(DEADLINE), Ok(number));
    }
    bench.stop();
}

#[test]
fn an_application_does_not_speak_as_a_layer() {
    let (say, heard) = sync_channel(100);
    let spec = AppSpec::new("overrun", move || Overrun(say.clone())).handles::<Number>();
    let bench = Bench::start(vec![spec.into()]);
    bench.wait_for(&SupervisorFact::Ready(ChildId(0)));
    let sender = &bench.senders[0];
    let forged = sender.create_message(sender.tid(), Kind::NDL_LEAVE, 3).unwrap();
    assert!(matches!(sender.loaned(forged).send(), Err(SendError::NotYours(Kind::NDL_LEAVE))));
    // And: what is its own still goes
    sender.send(sender.tid(), &Number(1)).unwrap();
    assert_eq!(heard.recv_timeout(DEADLINE), Ok(1));
    bench.stop();
}

#[test]
fn bytes_that_are_no_payload_do_not_feed_the_input_watchdog() {
    let (say, heard) = sync_channel(100);
    let spec = AppSpec::new("watcher", move || Watcher(say.clone())).handles::<Number>();
    let bench = Bench::start(vec![spec.into()]);
    bench.wait_for(&SupervisorFact::Ready(ChildId(0)));
    let (sender, stop) = (bench.senders[0].clone(), Arc::new(std::sync::atomic::AtomicBool::new(false)));
    let rubbish = {
        let stop = stop.clone();
        std::thread::spawn(move || {
            while !stop.load(std::sync::atomic::Ordering::Relaxed) {
                let mut garbage = sender.create_message(sender.tid(), Number::KIND, 3).unwrap();
                garbage.fill(0xc1); // the one byte that MessagePack never uses
                // An actor that gets no CPU for a while has no room for it.
                let _ = sender.loaned(garbage).send();
                std::thread::sleep(Duration::from_millis(1)); // the pace of the rubbish
            }
        })
    };
    while heard.recv_timeout(DEADLINE).expect("the watcher says something") != "silence" {}
    stop.store(true, std::sync::atomic::Ordering::Relaxed);
    rubbish.join().unwrap();
    bench.stop();
}

/// Never becomes ready.
struct Hesitant;

impl Actor for Hesitant {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        // Kept by nobody, and so never reached.
        drop(context.hold_ready());
    }
}

#[test]
fn one_that_never_becomes_ready_leaves_the_others_on_its_thread_alone() {
    let (spec, read) = scribe();
    let place = sinew_runtime::supervision::Place::thread("shared");
    let hesitant =
        AppSpec::new("hesitant", || Hesitant).start_within(Duration::from_millis(20)).place(place.clone());
    let bench = Bench::start(vec![spec.place(place).into(), hesitant.into()]);
    bench.wait_for(&SupervisorFact::Ready(ChildId(0)));
    for _ in 0..2 {
        bench.wait_for(&SupervisorFact::Failed(ChildId(1), sinew_runtime::supervision::Reason::StartTimeout));
    }
    bench.senders[0].send(bench.senders[0].tid(), &Number(1)).unwrap();
    assert_eq!(read.recv_timeout(DEADLINE), Ok(1));
    bench.stop();
}
