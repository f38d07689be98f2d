//! Two processes that LNCL has introduced to each other do not need the node any more.

use std::{
    sync::{
        atomic::{AtomicBool, Ordering},
        mpsc::sync_channel,
    },
    thread,
    time::{Duration, Instant},
};

use rustix::{
    process::{Pid, Signal, kill_process},
    thread::gettid,
};
use sinew::{Endpoint, NodeApi, Registration, client::ApiError, message::Rejection, prelude::*};
use sinew_tests::{
    DEADLINE, Log,
    clients::{Performer, Stage, StageLimits},
    program,
    puppet::Order,
    until, wait_until_asleep, wait_until_frozen,
};

/// Who has not answered by then is not asked directly yet.
const SOON: Duration = Duration::from_millis(300);

struct Scene {
    stage: Stage,
    echo: Performer,
    asking: Endpoint,
    to: Tid,
    said: Said,
}

/// What echoes have said.
#[derive(Clone, Default)]
struct Said {
    ups: Log<()>,
    /// Their children.
    heirs: Log<u32>,
}

impl Scene {
    fn new() -> Self {
        let limits = StageLimits { mailbox_capacity: 64, payload_max: 64 * 1024, clients_max: 16 };
        let stage = Stage::new(&program("client_kills"), limits);
        let said = Said::default();
        let echo = start_echo(&stage, &said, 1);
        let api = NodeApi::connect(stage.socket()).expect("the door is open");
        let mut asking =
            api.register_transport_address(Registration::new().direct(true)).expect("an address");
        let to = asking.resolve("echo", DEADLINE).expect("the node answers").expect("it is registered");
        Self { stage, echo, asking, to, said }
    }

    fn signal_node(&self, signal: Signal) {
        let id = i32::try_from(self.stage.node_id()).ok().and_then(Pid::from_raw).expect("a process id");
        kill_process(id, signal).expect("the node runs");
        if signal == Signal::STOP {
            // Until then it passes messages on.
            wait_until_frozen(self.stage.node_id());
        }
    }

    fn ask(&mut self, number: u64, within: Duration) -> Result<Order, ApiError> {
        self.asking.message(self.to, &Order { number }).ask(within)
    }

    /// Asks until there is an answer while the node is stopped; it stays so.
    fn stop_the_node_when_it_is_not_needed(&mut self) {
        let until = Instant::now() + DEADLINE;
        loop {
            self.ask(0, DEADLINE).expect("an answer, whichever way");
            self.signal_node(Signal::STOP);
            if self.ask(0, SOON).is_ok() {
                return;
            }
            self.signal_node(Signal::CONT);
            assert!(Instant::now() < until, "waited for an answer without the node");
        }
    }

    fn end(self) {
        assert!(self.echo.end().success());
        drop(self.asking);
        self.stage.end();
    }
}

fn start_echo(stage: &Stage, said: &Said, count: usize) -> Performer {
    let says = said.clone();
    let echo = stage.start("taker", &["echo".to_owned()], move |line| {
        if line == "up" {
            says.ups.write(());
        } else if let Some(heir) = line.strip_prefix("forked ") {
            says.heirs.write(heir.parse().expect("a process id"));
        }
    });
    said.ups.wait_for_many((), count);
    echo
}

#[test]
fn messages_flow_between_two_processes_while_the_node_is_stopped() {
    let mut scene = Scene::new();
    scene.stop_the_node_when_it_is_not_needed();
    for number in 1..=1_000 {
        assert_eq!(scene.ask(number, DEADLINE).expect("an answer").number, number);
    }
    scene.signal_node(Signal::CONT);
    scene.end();
}

#[test]
fn the_death_of_a_peer_is_an_outcome_also_while_the_node_is_stopped() {
    // Given: a question in the hand of a process that does nothing.
    let mut scene = Scene::new();
    scene.stop_the_node_when_it_is_not_needed();
    scene.echo.freeze();
    let Scene { stage, echo, mut asking, to, said } = scene;
    let (say, begun) = sync_channel(1);
    let waiting = thread::spawn(move || {
        say.send(gettid().as_raw_nonzero().get()).expect("the test waits for it");
        let answer = asking.message(to, &Order { number: 7 }).ask::<Order>(DEADLINE * 3);
        (asking, answer)
    });
    // It sleeps when the question is in the ring, and not before.
    wait_until_asleep(begun.recv_timeout(DEADLINE).expect("the thread begins"));

    // When: it is killed.
    assert!(echo.kill(), "it had lived until then");

    // Then: what became of the question nobody can say while the node does not, and a new life is asked through the node, which goes on.
    let (asking, answer) = waiting.join().expect("it does not panic");
    assert!(matches!(answer, Err(ApiError::Ended(Outcome::Unknown))), "{answer:?}");
    let node = Pid::from_raw(i32::try_from(stage.node_id()).expect("a process id")).expect("a process id");
    kill_process(node, Signal::CONT).expect("the node runs");
    let echo = start_echo(&stage, &said, 2);
    let mut scene = Scene { stage, echo, asking, to, said };
    scene.to = scene.asking.resolve("echo", DEADLINE).expect("the node answers").expect("it is registered");
    assert_eq!(scene.ask(8, DEADLINE).expect("an answer").number, 8);
    scene.end();
}

/// Asks the echo directly until it is told to end; how many questions were answered. Each is, by its own number, once.
fn ask_all_along(asking: &mut Endpoint, to: Tid, is_over: &AtomicBool) -> u64 {
    let mut number = 0;
    while !is_over.load(Ordering::Relaxed) {
        number += 1;
        let answer = asking.message(to, &Order { number }).ask::<Order>(DEADLINE);
        assert_eq!(answer.expect("the link stands").number, number);
        let told = asking.message(to, &Order { number }).confirmed(DEADLINE);
        assert!(matches!(told, Ok(Outcome::Delivered)), "{number}: {told:?}");
    }
    number
}

/// Both come back, and through the node as well.
fn is_whole_again(scene: &mut Scene, registrations: u64) {
    until("the asking endpoint is back", || {
        match scene.asking.receive(Duration::from_millis(20)) {
            Ok(None) | Err(ApiError::Disconnected(_)) => {}
            other => panic!("{other:?}"),
        }
        (scene.asking.registrations() >= registrations).then_some(())
    });
    // Before anybody else asks for an address.
    let echo =
        until("the echo is back", || scene.asking.resolve("echo", DEADLINE).expect("the node answers"));
    let api = NodeApi::connect(scene.stage.socket()).expect("the door is open");
    let mut third = api.register_transport_address(Registration::new()).expect("an address");
    assert_eq!(echo, scene.to, "it has its address again");
    let answer = third.message(echo, &Order { number: 3 }).ask::<Order>(DEADLINE).expect("an answer");
    assert_eq!(answer.number, 3);
}

/// Lets the node fail so `times` while questions are asked on a link.
fn asks_while(times: u64, mut fails: impl FnMut(&mut Stage)) {
    let mut scene = Scene::new();
    scene.stop_the_node_when_it_is_not_needed();
    scene.signal_node(Signal::CONT);
    let is_over = AtomicBool::new(false);
    let Scene { mut stage, echo, asking, to, said } = scene;
    let (asking, answered) = thread::scope(|scope| {
        let asks = scope.spawn(|| {
            let mut asking = asking;
            let answered = ask_all_along(&mut asking, to, &is_over);
            (asking, answered)
        });
        for _ in 0..times {
            thread::sleep(SOON);
            fails(&mut stage);
        }
        thread::sleep(SOON);
        is_over.store(true, Ordering::Relaxed);
        asks.join().expect("it does not panic")
    });
    assert!(answered > times, "{answered} questions in all");
    let mut scene = Scene { stage, echo, asking, to, said };
    is_whole_again(&mut scene, 2);
    scene.end();
}

#[test]
fn every_question_on_a_link_has_its_one_answer_while_the_node_is_killed_and_replaced() {
    asks_while(3, Stage::replace_node);
}

#[test]
fn every_question_on_a_link_has_its_one_answer_while_lncl_panics() {
    asks_while(5, Stage::panic_lncl);
}

#[test]
fn the_death_of_a_peer_is_an_outcome_also_where_a_child_of_its_holds_the_link() {
    // Given: a question on a link, in the hand of a process that does nothing and has a child with all its descriptors.
    let mut scene = Scene::new();
    scene.stop_the_node_when_it_is_not_needed();
    scene.signal_node(Signal::CONT);
    scene.echo.tell("fork");
    let heir = scene.said.heirs.wait("a child of the echo", |heirs| heirs.first().copied());
    let heir = Pid::from_raw(i32::try_from(heir).expect("a process id")).expect("a process id");
    scene.echo.freeze();
    let Scene { stage, echo, mut asking, to, said } = scene;
    let (say, begun) = sync_channel(1);
    let waiting = thread::spawn(move || {
        say.send(gettid().as_raw_nonzero().get()).expect("the test waits for it");
        let answer = asking.message(to, &Order { number: 7 }).ask::<Order>(DEADLINE);
        (asking, answer)
    });
    wait_until_asleep(begun.recv_timeout(DEADLINE).expect("the thread begins"));

    // When: it is killed, then: it is known that it had not taken the question, although the child is there.
    assert!(echo.kill(), "it had lived until then");
    let (asking, answer) = waiting.join().expect("it does not panic");
    assert!(matches!(answer, Err(ApiError::Ended(Outcome::Rejected(Rejection::Closed)))), "{answer:?}");
    kill_process(heir, Signal::KILL).expect("the child is there all the time");

    // And a new life is asked.
    let echo = start_echo(&stage, &said, 2);
    let mut scene = Scene { stage, echo, asking, to, said };
    scene.to = scene.asking.resolve("echo", DEADLINE).expect("the node answers").expect("it is registered");
    assert_eq!(scene.ask(8, DEADLINE).expect("an answer").number, 8);
    scene.end();
}
