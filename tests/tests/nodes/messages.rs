//! Messages between two nodes of one process: requests, outcomes, groups, broadcasts, ages, order by class.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use sinew::{
    StartError,
    message::{Rejection, SendError},
    prelude::*,
};
use sinew_testkit::{DEADLINE, Loopback, until};

payload!("messages.question", Control => struct Question { number: u64 });
payload!("messages.answer", Control => struct Answer { number: u64 });
payload!("messages.word", Bulk => struct Word { text: String });
payload!("messages.unheard", Control => struct Unheard;);

/// The nodes of a pair, which find only each other. Each has its address, whichever starts first.
fn pair() -> (NodeBuilder, NodeBuilder) {
    let loopback = Loopback::new();
    (loopback.node("home"), loopback.node("there"))
}

/// Doubles numbers, rejects 99, panics at 13; reports the words that it received.
struct Oracle(SyncSender<String>);

impl Actor for Oracle {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.join("listeners");
    }
}

impl Handler<Delivery<Question>> for Oracle {
    type Result = ();

    fn handle(&mut self, question: Delivery<Question>, context: &mut Self::Context) {
        assert!(question.number != 13, "thirteen");
        if question.number == 99 {
            context.reject();
        } else if question.reply_to().is_some() {
            context.reply(&question, &Answer { number: question.number * 2 }).expect("the requester waits");
        }
    }
}

impl Handler<Delivery<Word>> for Oracle {
    type Result = ();

    fn handle(&mut self, word: Delivery<Word>, _: &mut Self::Context) {
        // The first one may arrive before this node has measured the other's clock.
        assert!(word.age.is_none_or(|age| age < DEADLINE), "{:?}", word.age);
        self.0.send(word.payload.text).expect("the test listens");
    }
}

fn oracle(name: &str) -> (AppSpec<Oracle>, Receiver<String>) {
    let (sender, received) = sync_channel(1_000);
    let spec = AppSpec::new(name, move || Oracle(sender.clone())).handles::<Question>().handles::<Word>();
    (spec, received)
}

/// Runs a story in an actor's own future and reports its end.
struct Storyteller<F> {
    story: F,
    ends: SyncSender<()>,
}

impl<F: AsyncFn(sinew::message::Sender) + Clone + Unpin + 'static> Actor for Storyteller<F> {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let (story, sender, ends) = (self.story.clone(), context.sender(), self.ends.clone());
        let running = async move {
            story(sender).await;
            ends.send(()).expect("the test waits");
        };
        context.spawn(running.into_actor(self));
    }
}

/// Starts two nodes: the story runs on the first, once the applications on the second are ready. Dropping
/// them stops them.
#[must_use]
fn run_story<F>(second: impl FnOnce(NodeBuilder) -> NodeBuilder, requires: &[&str], story: F) -> (Node, Node)
where
    F: AsyncFn(sinew::message::Sender) + Clone + Send + Sync + Unpin + 'static,
{
    let (home, there) = pair();
    let (ends, has_ended) = sync_channel(1);
    let storyteller =
        AppSpec::new("storyteller", move || Storyteller { story: story.clone(), ends: ends.clone() });
    let there = second(there).start().expect("a node");
    let here = home.app(storyteller.requires(requires.iter().copied())).start().expect("a node");
    if has_ended.recv_timeout(DEADLINE).is_err() {
        panic!("the story did not end; these wait: {:?}", here.handle().waiting());
    }
    (here, there)
}

#[test]
fn remote_requests_and_confirmed_sends_have_outcomes() {
    let (spec, _received) = oracle("oracle");
    let _nodes = run_story(
        |node| node.app(spec),
        &["oracle"],
        async |sender: sinew::message::Sender| {
            let ask = sender
                .message("oracle", &Question { number: 21 })
                .ask::<Answer>(DEADLINE)
                .expect("it is sent");
            assert_eq!(ask.await.expect("a reply").number, 42);
            let outcome = async |number| {
                let sent = sender.message("oracle", &Question { number }).confirmed(DEADLINE);
                sent.expect("it is sent").await
            };
            assert_eq!(outcome(1).await, Outcome::Delivered);
            assert_eq!(outcome(99).await, Outcome::Rejected(Rejection::ByHandler));
            assert_eq!(outcome(13).await, Outcome::Failed);
            assert_eq!(outcome(2).await, Outcome::Delivered, "by the new instance behind the same TID");
            let unheard = sender.message("oracle", &Unheard).confirmed(DEADLINE).expect("it is sent").await;
            assert_eq!(unheard, Outcome::Rejected(Rejection::UnknownKind));
            let nobody = Tid::new([127, 0, 0, 2].into(), AppAddress::fixed(7).expect("a fixed address"));
            let lost = sender.message(nobody, &Unheard).confirmed(DEADLINE).expect("it is sent").await;
            assert_eq!(lost, Outcome::Rejected(Rejection::NoSuchApplication));
        },
    );
}

#[test]
fn cancelled_requests_free_their_slots() {
    /// More than may be pending at the same time.
    const DROPPED: u64 = 5_000;
    let (spec, _received) = oracle("oracle");
    let _nodes = run_story(
        |node| node.app(spec),
        &["oracle"],
        async |sender: sinew::message::Sender| {
            let mut asked = 0;
            while asked < DROPPED {
                match sender.message("oracle", &Question { number: 21 }).ask::<Answer>(DEADLINE) {
                    Ok(reply) => {
                        drop(reply);
                        asked += 1;
                    }
                    // The path to the other node is full for the moment.
                    Err(SendError::Rejected(Rejection::QueueFull)) => {
                        actix::clock::sleep(Duration::from_millis(1)).await;
                    }
                    Err(other) => panic!("{other:?} after {asked}"),
                }
            }
            // After all of them: the reply that arrives now belongs to this request.
            let last = loop {
                match sender.message("oracle", &Question { number: 21 }).ask::<Answer>(DEADLINE) {
                    Ok(reply) => break reply,
                    Err(_) => actix::clock::sleep(Duration::from_millis(1)).await,
                }
            };
            assert_eq!(last.await.expect("a reply").number, 42);
        },
    );
}

/// A request that may expire before it is handled.
const HASTY: u64 = 3;

/// Replies only when the requester no longer waits.
struct Ponderer;

impl Actor for Ponderer {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Question>> for Ponderer {
    type Result = ();

    fn handle(&mut self, question: Delivery<Question>, context: &mut Self::Context) {
        let Some(to) = question.reply_to() else { return };
        let is_wanted = context.is_wanted(&question);
        assert!(is_wanted || question.number == HASTY, "it was not given up before it was handled");
        let sender = context.sender();
        let pondering = async move {
            while sender.is_wanted(&to) {
                actix::clock::sleep(Duration::from_millis(1)).await;
            }
            sender.reply(to, &Answer { number: question.number }).expect("the way back is free");
        };
        context.spawn(pondering.into_actor(self));
    }
}

#[test]
fn handler_sees_a_cancelled_request_and_late_replies_count() {
    let _nodes = run_story(
        |node| node.app(AppSpec::new("ponderer", || Ponderer).handles::<Question>()),
        &["ponderer"],
        async |sender: sinew::message::Sender| {
            let ask = |within| sender.message("ponderer", &Question { number: 1 }).ask::<Answer>(within);
            // Cancelled by the requester: the deadline is beyond the test's.
            let reply = ask(DEADLINE * 2).expect("it is sent");
            let behind = sender.message("ponderer", &Question { number: 2 }).confirmed(DEADLINE);
            assert_eq!(behind.expect("it is sent").await, Outcome::Delivered, "so the request is handled");
            drop(reply);
            // Its deadline passes: a request that expires in the mailbox is not handled, and has no reply.
            while sender.late_replies() < 2 {
                let hasty = Question { number: HASTY };
                let over = sender.message("ponderer", &hasty).ask::<Answer>(Duration::from_millis(100));
                assert!(over.expect("it is sent").await.is_err(), "nobody replied in time");
                // The reply is in flight, if there is one.
                let behind = sender.message("ponderer", &Question { number: 2 }).confirmed(DEADLINE);
                assert_eq!(behind.expect("it is sent").await, Outcome::Delivered);
            }
        },
    );
}

#[test]
fn sent_messages_arrive_before_their_stopping_node_leaves() {
    const WORDS: usize = 900;
    let (spec, received) = oracle("oracle");
    let (here, _there) = run_story(
        |node| node.app(spec),
        &["oracle"],
        async |sender: sinew::message::Sender| {
            // More than sockets and the session's window hold: most of it waits when the node is asked to
            // stop.
            for number in 0..WORDS {
                let text = format!("{number:>16384}");
                sender.send("oracle", &Word { text }).expect("there is room for it");
            }
        },
    );
    here.stop();
    for number in 0..WORDS {
        let word = received.recv_timeout(DEADLINE).expect("it was sent before the node stopped");
        assert_eq!(word.trim_start(), number.to_string());
    }
}

#[test]
fn group_and_broadcast_reach_each_member_once() {
    let ((first, at_first), (second, at_second)) = (oracle("first"), oracle("second"));
    let (here, there) = run_story(
        |node| node.app(first).app(second),
        &["first", "second"],
        async |sender: sinew::message::Sender| {
            let word = |text: &str| Word { text: text.to_owned() };
            // The membership arrives one list after the readiness; until then the message is not accepted.
            while sender.send(Tid::group("listeners"), &word("group")).is_err() {
                actix::clock::sleep(Duration::from_millis(1)).await;
            }
            sender.send(Tid::BROADCAST, &word("everybody")).expect("somebody takes it");
        },
    );
    for received in [at_first, at_second] {
        let words = [received.recv_timeout(DEADLINE), received.recv_timeout(DEADLINE)];
        assert_eq!(words, [Ok("group".to_owned()), Ok("everybody".to_owned())]);
        assert_eq!(received.try_recv().ok(), None);
    }
    let sent = here.handle().traffic();
    assert_eq!(sent.len(), 1, "one peer");
    drop((here, there));
}

#[test]
fn a_thousand_messages_arrive_once_and_in_order() {
    let (spec, received) = oracle("oracle");
    let _nodes = run_story(
        |node| node.configure(|config| config.mailbox_capacity = 2_000).app(spec),
        &["oracle"],
        async |sender: sinew::message::Sender| {
            for number in 0..1_000 {
                sender.send("oracle", &Word { text: number.to_string() }).expect("it is sent");
            }
        },
    );
    for number in 0..1_000 {
        assert_eq!(received.recv_timeout(DEADLINE), Ok(number.to_string()));
    }
}

#[test]
fn circular_requirements_are_rejected_with_the_circle() {
    let (first, _a) = oracle("first");
    let (second, _b) = oracle("second");
    let node = Loopback::new().node("circle").app(first.requires(["second"])).app(second.requires(["first"]));
    let error = node.start().expect_err("nobody can be the first");
    assert!(error.to_string().contains("first requires second requires first"), "{error}");
}

#[test]
fn pattern_with_another_match_closes_no_circle() {
    let app = |name: &str, requires: &str| oracle(name).0.requires([requires]);
    let either =
        Loopback::new().node("either").app(app("first", "second | other")).app(app("second", "first"));
    either.start().expect("another node may have `other`");
    let many = Loopback::new().node("many").app(app("first", "2 of second.*")).app(app("second.a", "first"));
    many.start().expect("other nodes may have more of them");
    let limited =
        Loopback::new().node("limited").app(app("first", "second")).app(app("second", "first ?50ms"));
    let limited = limited.start().expect("one of them goes on without the other");
    limited.handle().wait_until_running(DEADLINE).expect("both run");
}

#[test]
fn circle_through_another_node_ends_only_idle_nodes() {
    // Given: a node that runs another application beside the one in the circle
    let (home, there) = pair();
    let app = |name: &str| oracle(name).0;
    let there = there.app(app("other")).app(app("knee").requires(["hip"]));
    let there = there.start().expect("the layers start");
    until("the other one runs", || there.handle().directory().iter().any(|entry| entry.ready).then_some(()));
    let handle = there.handle();
    let runs_on = std::thread::spawn(move || there.run());
    // When: a node starts that closes the circle, and runs no other application
    let here = home.app(app("hip").requires(["knee"])).start().expect("the layers start");
    let asked = here.handle();
    let error = asked.wait_until_running(DEADLINE).expect_err("nobody can be the first");
    assert!(error.to_string().contains("hip requires knee (node there) requires hip"), "{error}");
    // Then
    assert_eq!(format!("{:?}", here.run()), format!("{:?}", std::process::ExitCode::FAILURE));
    assert!(!runs_on.is_finished(), "the circle ends no node that runs");
    assert!(handle.directory().iter().any(|entry| entry.name == "other" && entry.ready));
    handle.stop();
    runs_on.join().expect("it was stopped");
}

#[test]
fn opened_circle_is_no_longer_reported() {
    // Given: two nodes with applications that require each other
    let (home, there) = pair();
    let oracle = |name: &str| oracle(name).0;
    let here = home.app(oracle("hip").requires(["knee"])).start().expect("the layers start");
    let there = there.app(oracle("knee").requires(["hip"])).start().expect("the layers start");
    let error = here.handle().wait_until_running(DEADLINE).expect_err("nobody can be the first");
    assert!(matches!(error, StartError::Cycle(_)), "{error}");
    // When: the other one no longer requires it
    there.handle().stop_app("knee").expect("it is there");
    there.handle().remove_app("knee").expect("it has stopped");
    there.handle().add_app(oracle("knee"), None).expect("its name is free");
    // As far as `here` knows, the circle exists until it is notified of the change.
    until("both run", || here.handle().wait_until_running(DEADLINE).ok());
    // Then: a waiting application is not notified of the circle
    here.handle().add_app(oracle("late").requires(["never"]), None).expect("its name is free");
    let error = here.handle().wait_until_running(Duration::from_millis(50)).expect_err("it waits");
    assert!(matches!(error, StartError::Waiting { .. }), "{error}");
}

struct Unplugged;

impl Actor for Unplugged {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.fail_start("/dev/encoder: No such file or directory");
    }
}

#[test]
fn wait_for_all_applications_names_a_failing_start() {
    let app = AppSpec::new("encoder", || Unplugged);
    let node = Loopback::new().node("alone").app(app).start().expect("the layers start");
    let words = until("the first start has failed", || {
        let error = node.handle().wait_until_running(Duration::from_millis(50)).expect_err("it never starts");
        Some(error.to_string()).filter(|words| words.contains("No such file"))
    });
    assert!(words.contains("these are not ready:\n  encoder: "), "{words}");
}

#[test]
fn waiting_applications_and_requirements_are_listed() {
    let (spec, _received) = oracle("oracle");
    let node = Loopback::new().node("alone").app(spec.requires(["never"])).start().expect("the layers start");
    let error = node.handle().wait_until_running(Duration::from_millis(50)).expect_err("it waits");
    let words = error.to_string();
    assert!(words.contains("oracle") && words.contains("never (not there; missing for "), "{words}");
}
