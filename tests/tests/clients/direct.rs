//! Two processes with a direct link, set up by LNCL, no longer need the node.

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
use sinew::{
    Endpoint, NodeApi, Registration,
    client::{ApiError, DirectLinks},
    message::Rejection,
    prelude::*,
};
use sinew_testkit::NodeProcess;
use sinew_testkit::{DEADLINE, scripted::Order, until, wait_until_asleep};
use sinew_tests::clients::{FixtureLimits, NodeFixture};

/// A request that is not answered within this time does not go over a direct link yet.
const SOON: Duration = Duration::from_millis(300);

struct Scene {
    fixture: NodeFixture,
    echo: NodeProcess,
    asking: Endpoint,
    to: Tid,
}

impl Scene {
    fn new() -> Self {
        let limits = FixtureLimits { mailbox_capacity: 64, payload_max: 64 * 1024, clients_max: 16 };
        let fixture = NodeFixture::new(limits);
        let echo = start_echo(&fixture);
        let api = NodeApi::connect(fixture.socket()).expect("the door is open");
        let registration = Registration::new().direct(DirectLinks::Always);
        let mut asking = api.register_transport_address(registration).expect("an address");
        let to = asking.resolve("echo", DEADLINE).expect("the node answers").expect("it is registered");
        Self { fixture, echo, asking, to }
    }

    fn ask(&mut self, number: u64, within: Duration) -> Result<Order, ApiError> {
        self.asking.message(self.to, &Order { number }).ask(within)
    }

    /// Sends requests until one is answered while the node is stopped; the node stays stopped.
    fn stop_the_node_when_it_is_not_needed(&mut self) {
        let until = Instant::now() + DEADLINE;
        loop {
            self.ask(0, DEADLINE).expect("an answer, whichever way");
            // The node passes messages on until it stands still.
            self.fixture.node().pause();
            if self.ask(0, SOON).is_ok() {
                return;
            }
            self.fixture.node().signal(Signal::CONT);
            assert!(Instant::now() < until, "waited for an answer without the node");
        }
    }

    fn end(self) {
        assert!(self.echo.stop().success());
        drop(self.asking);
        self.fixture.end();
    }
}

fn start_echo(fixture: &NodeFixture) -> NodeProcess {
    let mut echo = fixture.start("taker", &["echo"]);
    echo.expect("up");
    echo
}

#[test]
fn messages_flow_while_the_node_is_stopped() {
    let mut scene = Scene::new();
    scene.stop_the_node_when_it_is_not_needed();
    for number in 1..=1_000 {
        assert_eq!(scene.ask(number, DEADLINE).expect("an answer").number, number);
    }
    scene.fixture.node().signal(Signal::CONT);
    scene.end();
}

#[test]
fn peer_death_settles_requests_while_the_node_is_stopped() {
    // Given: a request that is held by a process that does nothing.
    let mut scene = Scene::new();
    scene.stop_the_node_when_it_is_not_needed();
    scene.echo.pause();
    let Scene { fixture, mut echo, mut asking, to } = scene;
    let (begins, begun) = sync_channel(1);
    let waiting = thread::spawn(move || {
        begins.send(gettid().as_raw_nonzero().get()).expect("the test waits for it");
        let answer = asking.message(to, &Order { number: 7 }).ask::<Order>(DEADLINE * 3);
        (asking, answer)
    });
    // It sleeps once the request is in the ring, and not before.
    wait_until_asleep(begun.recv_timeout(DEADLINE).expect("the thread begins"));

    // When: it is killed.
    assert!(echo.kill(), "it had lived until then");

    // Then: the fate of the request is unknown while the node is stopped. Once the node continues, a new
    // incarnation is reached through it.
    let (asking, answer) = waiting.join().expect("it does not panic");
    assert!(matches!(answer, Err(ApiError::Ended(Outcome::Unknown))), "{answer:?}");
    fixture.node().signal(Signal::CONT);
    let echo = start_echo(&fixture);
    let mut scene = Scene { fixture, echo, asking, to };
    scene.to = scene.asking.resolve("echo", DEADLINE).expect("the node answers").expect("it is registered");
    assert_eq!(scene.ask(8, DEADLINE).expect("an answer").number, 8);
    scene.end();
}

/// Sends direct requests to the echo until the flag is set; returns their number. Each is answered once,
/// under its own number.
fn ask_all_along(asking: &mut Endpoint, to: Tid, is_over: &AtomicBool) -> u64 {
    let mut number = 0;
    while !is_over.load(Ordering::Relaxed) {
        number += 1;
        let answer = asking.message(to, &Order { number }).ask::<Order>(DEADLINE);
        assert_eq!(answer.expect("the link stands").number, number);
        let outcome = asking.message(to, &Order { number }).confirmed(DEADLINE);
        assert!(matches!(outcome, Ok(Outcome::Delivered)), "{number}: {outcome:?}");
    }
    number
}

/// Both endpoints are back, and reachable through the node as well.
fn is_whole_again(scene: &mut Scene, registrations: u64) {
    until("the asking endpoint is back", || {
        match scene.asking.receive(Duration::from_millis(20)) {
            Ok(None) | Err(ApiError::Disconnected(_)) => {}
            other => panic!("{other:?}"),
        }
        (scene.asking.registrations() >= registrations).then_some(())
    });
    // Before any other process requests an address.
    let echo =
        until("the echo is back", || scene.asking.resolve("echo", DEADLINE).expect("the node answers"));
    let api = NodeApi::connect(scene.fixture.socket()).expect("the door is open");
    let mut third = api.register_transport_address(Registration::new()).expect("an address");
    assert_eq!(echo, scene.to, "it has its address again");
    let answer = third.message(echo, &Order { number: 3 }).ask::<Order>(DEADLINE).expect("an answer");
    assert_eq!(answer.number, 3);
}

/// Lets the node fail `times` times while requests are sent on a link.
fn asks_while(times: u64, mut fails: impl FnMut(&mut NodeFixture)) {
    let mut scene = Scene::new();
    scene.stop_the_node_when_it_is_not_needed();
    scene.fixture.node().signal(Signal::CONT);
    let is_over = AtomicBool::new(false);
    let Scene { mut fixture, echo, asking, to } = scene;
    let (asking, answered) = thread::scope(|scope| {
        let asks = scope.spawn(|| {
            let mut asking = asking;
            let answered = ask_all_along(&mut asking, to, &is_over);
            (asking, answered)
        });
        for _ in 0..times {
            thread::sleep(SOON);
            fails(&mut fixture);
        }
        thread::sleep(SOON);
        is_over.store(true, Ordering::Relaxed);
        asks.join().expect("it does not panic")
    });
    assert!(answered > times, "{answered} questions in all");
    let mut scene = Scene { fixture, echo, asking, to };
    is_whole_again(&mut scene, 2);
    scene.end();
}

#[test]
fn requests_have_one_answer_while_the_node_is_replaced() {
    asks_while(3, NodeFixture::replace_node);
}

#[test]
fn requests_have_one_answer_while_lncl_panics() {
    asks_while(5, NodeFixture::panic_lncl);
}

#[test]
fn peer_death_is_noticed_despite_an_inherited_link() {
    // Given: a request on a link, held by a process that does nothing. A child of that process has all its
    // descriptors.
    let mut scene = Scene::new();
    scene.stop_the_node_when_it_is_not_needed();
    scene.fixture.node().signal(Signal::CONT);
    scene.echo.send_line("fork");
    let heir = scene.echo.expect("forked").parse().ok().and_then(Pid::from_raw).expect("a process id");
    scene.echo.pause();
    let Scene { fixture, mut echo, mut asking, to } = scene;
    let (begins, begun) = sync_channel(1);
    let waiting = thread::spawn(move || {
        begins.send(gettid().as_raw_nonzero().get()).expect("the test waits for it");
        let answer = asking.message(to, &Order { number: 7 }).ask::<Order>(DEADLINE);
        (asking, answer)
    });
    wait_until_asleep(begun.recv_timeout(DEADLINE).expect("the thread begins"));

    // When: it is killed, then: the request is known to be undelivered, although the child still runs.
    assert!(echo.kill(), "it had lived until then");
    let (asking, answer) = waiting.join().expect("it does not panic");
    assert!(matches!(answer, Err(ApiError::Ended(Outcome::Rejected(Rejection::Closed)))), "{answer:?}");
    kill_process(heir, Signal::KILL).expect("the child is there all the time");

    // And: a new incarnation answers.
    let echo = start_echo(&fixture);
    let mut scene = Scene { fixture, echo, asking, to };
    scene.to = scene.asking.resolve("echo", DEADLINE).expect("the node answers").expect("it is registered");
    assert_eq!(scene.ask(8, DEADLINE).expect("an answer").number, 8);
    scene.end();
}
