//! What messages do between two nodes of one process: requests, outcomes, groups, broadcasts, ages, order by class.

use std::{
    net::SocketAddrV4,
    sync::mpsc::{Receiver, SyncSender, sync_channel},
};

use sinew::{
    StartError,
    message::{Rejection, SendError},
    prelude::*,
};
use sinew_tests::{DEADLINE, own_group, until};

payload!("messages.question", Control => struct Question { number: u64 });
payload!("messages.answer", Control => struct Answer { number: u64 });
payload!("messages.word", Bulk => struct Word { text: String });
payload!("messages.unheard", Control => struct Unheard;);

/// A node of a pair that finds only the other.
fn node(name: &str, address: u8, group: SocketAddrV4) -> NodeBuilder {
    Node::builder(name).address([127, 0, 0, address]).configure(|config| {
        config.ndl.multicast = Some(group);
        config.ndl.mdns_port = None;
    })
}

/// Doubles numbers, refuses 99, panics at 13; says which words it heard.
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
            context.reply(&question, &Answer { number: question.number * 2 }).expect("the asker waits");
        }
    }
}

impl Handler<Delivery<Word>> for Oracle {
    type Result = ();

    fn handle(&mut self, word: Delivery<Word>, _: &mut Self::Context) {
        // The first one may come before anybody here has measured the other's clock.
        assert!(word.age.is_none_or(|age| age < DEADLINE), "{:?}", word.age);
        self.0.send(word.payload.text).expect("the test listens");
    }
}

fn oracle(name: &str) -> (AppSpec<Oracle>, Receiver<String>) {
    let (say, heard) = sync_channel(1_000);
    let spec = AppSpec::new(name, move || Oracle(say.clone())).handles::<Question>().handles::<Word>();
    (spec, heard)
}

/// Runs a story in an actor's own future and says when it is told.
struct Teller<F> {
    story: F,
    told: SyncSender<()>,
}

impl<F: AsyncFn(sinew::message::Sender) + Clone + Unpin + 'static> Actor for Teller<F> {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let (story, sender, told) = (self.story.clone(), context.sender(), self.told.clone());
        let telling = async move {
            story(sender).await;
            told.send(()).expect("the test waits");
        };
        context.spawn(telling.into_actor(self));
    }
}

/// Two nodes: the story is told on the first, once the applications on the second are ready. Dropping them stops them.
#[must_use]
fn tell<F>(second: impl FnOnce(NodeBuilder) -> NodeBuilder, requires: &[&str], story: F) -> (Node, Node)
where
    F: AsyncFn(sinew::message::Sender) + Clone + Send + Sync + Unpin + 'static,
{
    let group = own_group();
    let (told, is_told) = sync_channel(1);
    let teller = AppSpec::new("teller", move || Teller { story: story.clone(), told: told.clone() });
    let there = second(node("there", 2, group)).start().expect("a node");
    let here = node("home", 1, group).app(teller.requires(requires.iter().copied())).start().expect("a node");
    if is_told.recv_timeout(DEADLINE).is_err() {
        panic!("the story was not told; who waits: {:?}", here.handle().waiting());
    }
    (here, there)
}

#[test]
fn requests_to_another_node_are_answered_and_every_confirmed_send_has_its_outcome() {
    let (spec, _heard) = oracle("oracle");
    let _nodes = tell(
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
fn requests_that_nobody_waits_for_any_more_take_no_places_and_their_late_replies_disturb_nobody() {
    /// More than may be waited for at once.
    const DROPPED: u64 = 5_000;
    let (spec, _heard) = oracle("oracle");
    let _nodes = tell(
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
                    // The way there is full for the moment.
                    Err(SendError::Rejected(Rejection::QueueFull)) => {
                        actix::clock::sleep(Duration::from_millis(1)).await;
                    }
                    Err(other) => panic!("{other:?} after {asked}"),
                }
            }
            // Behind all of them; what comes now is its own.
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

/// Of a request whose time may be over before it is handled.
const HASTY: u64 = 3;

/// Replies only when nobody waits any more.
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
fn a_handler_sees_that_nobody_waits_for_its_reply_any_more_and_a_late_reply_is_counted() {
    let _nodes = tell(
        |node| node.app(AppSpec::new("ponderer", || Ponderer).handles::<Question>()),
        &["ponderer"],
        async |sender: sinew::message::Sender| {
            let ask = |within| sender.message("ponderer", &Question { number: 1 }).ask::<Answer>(within);
            // Given up by whoever asked: the deadline is beyond the test's.
            let reply = ask(DEADLINE * 2).expect("it is sent");
            let behind = sender.message("ponderer", &Question { number: 2 }).confirmed(DEADLINE);
            assert_eq!(behind.expect("it is sent").await, Outcome::Delivered, "so the request is handled");
            drop(reply);
            // Its time is over: one that waited for its handler so long is not handled, and has no reply.
            while sender.late_replies() < 2 {
                let hasty = Question { number: HASTY };
                let over = sender.message("ponderer", &hasty).ask::<Answer>(Duration::from_millis(100));
                assert!(over.expect("it is sent").await.is_err(), "nobody replied in time");
                // The reply is on its way, if there is one.
                let behind = sender.message("ponderer", &Question { number: 2 }).confirmed(DEADLINE);
                assert_eq!(behind.expect("it is sent").await, Outcome::Delivered);
            }
        },
    );
}

#[test]
fn all_that_was_sent_arrives_before_the_node_that_sent_it_is_gone() {
    const WORDS: usize = 900;
    let (spec, heard) = oracle("oracle");
    let (here, _there) = tell(
        |node| node.app(spec),
        &["oracle"],
        async |sender: sinew::message::Sender| {
            // More than sockets and the session's window hold: most of it waits when the node is told to stop.
            for number in 0..WORDS {
                let text = format!("{number:>16384}");
                sender.send("oracle", &Word { text }).expect("there is room for it");
            }
        },
    );
    here.stop();
    for number in 0..WORDS {
        let word = heard.recv_timeout(DEADLINE).expect("it was sent before the node stopped");
        assert_eq!(word.trim_start(), number.to_string());
    }
}

#[test]
fn a_group_and_a_broadcast_reach_each_member_on_every_node_once() {
    let ((first, at_first), (second, at_second)) = (oracle("first"), oracle("second"));
    let (here, there) = tell(
        |node| node.app(first).app(second),
        &["first", "second"],
        async |sender: sinew::message::Sender| {
            let word = |text: &str| Word { text: text.to_owned() };
            // The membership follows the readiness by one list; until then nobody takes the message.
            while sender.send(Tid::group("listeners"), &word("group")).is_err() {
                actix::clock::sleep(Duration::from_millis(1)).await;
            }
            sender.send(Tid::BROADCAST, &word("everybody")).expect("somebody takes it");
        },
    );
    for heard in [at_first, at_second] {
        let words = [heard.recv_timeout(DEADLINE), heard.recv_timeout(DEADLINE)];
        assert_eq!(words, [Ok("group".to_owned()), Ok("everybody".to_owned())]);
        assert_eq!(heard.try_recv().ok(), None);
    }
    let sent = here.handle().traffic();
    assert_eq!(sent.len(), 1, "one peer");
    drop((here, there));
}

#[test]
fn a_thousand_messages_arrive_once_and_in_order() {
    let (spec, heard) = oracle("oracle");
    let _nodes = tell(
        |node| node.configure(|config| config.mailbox_capacity = 2_000).app(spec),
        &["oracle"],
        async |sender: sinew::message::Sender| {
            for number in 0..1_000 {
                sender.send("oracle", &Word { text: number.to_string() }).expect("it is sent");
            }
        },
    );
    for number in 0..1_000 {
        assert_eq!(heard.recv_timeout(DEADLINE), Ok(number.to_string()));
    }
}

#[test]
fn requirements_in_a_circle_are_refused_with_the_circle_spelled_out() {
    let (first, _a) = oracle("first");
    let (second, _b) = oracle("second");
    let node = node("circle", 1, own_group()).app(first.requires(["second"])).app(second.requires(["first"]));
    let error = node.start().expect_err("nobody can be the first");
    assert!(error.to_string().contains("first requires second requires first"), "{error}");
}

#[test]
fn a_requirement_that_anything_else_can_meet_closes_no_circle_at_the_start() {
    let app = |name: &str, requires: &str| oracle(name).0.requires([requires]);
    let either =
        node("either", 1, own_group()).app(app("first", "second | other")).app(app("second", "first"));
    either.start().expect("another node may have `other`");
    let many = node("many", 1, own_group()).app(app("first", "2 of second.*")).app(app("second.a", "first"));
    many.start().expect("other nodes may have more of them");
    let limited =
        node("limited", 1, own_group()).app(app("first", "second")).app(app("second", "first ?50ms"));
    let limited = limited.start().expect("one of them goes on without the other");
    limited.handle().wait_until_running(DEADLINE).expect("both run");
}

#[test]
fn a_run_ends_with_a_circle_through_another_node_and_a_node_that_runs_others_goes_on() {
    // Given: a node that runs another application beside the one in the circle
    let group = own_group();
    let app = |name: &str| oracle(name).0;
    let there = node("there", 2, group).app(app("other")).app(app("knee").requires(["hip"]));
    let there = there.start().expect("the layers start");
    until("the other one runs", || there.handle().directory().iter().any(|entry| entry.ready).then_some(()));
    let handle = there.handle();
    let runs_on = std::thread::spawn(move || there.run());
    // When: a node starts that closes the circle, and runs nothing else
    let here = node("home", 1, group).app(app("hip").requires(["knee"])).start().expect("the layers start");
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
fn a_circle_that_was_opened_on_another_node_is_told_of_no_more() {
    // Given: two nodes whose applications require each other
    let group = own_group();
    let oracle = |name: &str| oracle(name).0;
    let here =
        node("home", 1, group).app(oracle("hip").requires(["knee"])).start().expect("the layers start");
    let there =
        node("there", 2, group).app(oracle("knee").requires(["hip"])).start().expect("the layers start");
    let error = here.handle().wait_until_running(DEADLINE).expect_err("nobody can be the first");
    assert!(matches!(error, StartError::Cycle(_)), "{error}");
    // When: the other one requires it no more
    there.handle().stop_app("knee").expect("it is there");
    there.handle().remove_app("knee").expect("it has stopped");
    there.handle().add_app(oracle("knee"), None).expect("its name is free");
    // Until `here` has heard of that the circle stands, as far as it knows.
    until("both run", || here.handle().wait_until_running(DEADLINE).ok());
    // Then: who waits is not told of the circle
    here.handle().add_app(oracle("late").requires(["never"]), None).expect("its name is free");
    let error = here.handle().wait_until_running(Duration::from_millis(50)).expect_err("it waits");
    assert!(matches!(error, StartError::Waiting { .. }), "{error}");
}

#[test]
fn who_waits_for_whom_can_be_asked() {
    let (spec, _heard) = oracle("oracle");
    let node = node("alone", 1, own_group()).app(spec.requires(["never"])).start().expect("the layers start");
    let error = node.handle().wait_until_running(Duration::from_millis(50)).expect_err("it waits");
    let words = error.to_string();
    assert!(words.contains("oracle") && words.contains("never (not there; missing for "), "{words}");
}

#[test]
fn a_port_in_use_fails_the_start_in_words() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
    let port = taken.local_addr().expect("it is bound").port();
    let node = node("late", 1, own_group()).configure(|config| config.gncl.port = port);
    let words = node.start().expect_err("the port is taken").to_string();
    assert!(words.contains(&port.to_string()) && words.contains("gncl.port"), "{words}");
}
