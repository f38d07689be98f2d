//! Two processes that LNCL has introduced to each other do not need the node any more.

use std::{
    thread,
    time::{Duration, Instant},
};

use rustix::process::{Pid, Signal, kill_process};
use sinew::{ApiError, Endpoint, NodeApi, Registration, prelude::*};
use sinew_tests::{
    DEADLINE, Log,
    clients::{Performer, Stage, StageLimits},
    program,
    puppet::Order,
};

/// Who has not answered by then is not asked directly yet.
const SOON: Duration = Duration::from_millis(300);

struct Scene {
    stage: Stage,
    echo: Performer,
    asking: Endpoint,
    to: Tid,
    ups: Log<()>,
}

impl Scene {
    fn new() -> Self {
        let limits = StageLimits { mailbox_capacity: 64, payload_max: 64 * 1024, clients_max: 16 };
        let stage = Stage::new(&program("client_kills"), limits);
        let ups = Log::default();
        let echo = start_echo(&stage, &ups, 1);
        let api = NodeApi::connect(stage.socket()).expect("the door is open");
        let mut asking =
            api.register_transport_address(Registration::new().direct(true)).expect("an address");
        let to = asking.resolve("echo", DEADLINE).expect("the node answers").expect("it is registered");
        Self { stage, echo, asking, to, ups }
    }

    fn signal_node(&self, signal: Signal) {
        let id = i32::try_from(self.stage.node_id()).ok().and_then(Pid::from_raw).expect("a process id");
        kill_process(id, signal).expect("the node runs");
    }

    fn ask(&mut self, number: u64, within: Duration) -> Result<Order, ApiError> {
        self.asking.ask(self.to, &Order { number }, within)
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

fn start_echo(stage: &Stage, ups: &Log<()>, count: usize) -> Performer {
    let says = ups.clone();
    let echo = stage.start("taker", &["echo".to_owned()], move |line| {
        if line == "up" {
            says.write(());
        }
    });
    ups.wait_for_many((), count);
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
    scene.echo.signal(Signal::STOP);
    let Scene { stage, echo, mut asking, to, ups } = scene;
    let waiting = thread::spawn(move || {
        let answer = asking.ask::<Order, Order>(to, &Order { number: 7 }, DEADLINE * 3);
        (asking, answer)
    });

    // When: it is killed.
    assert!(echo.kill(), "it had lived until then");

    // Then: the question has failed, and a new life is asked through the node, which goes on.
    let (asking, answer) = waiting.join().expect("it does not panic");
    assert!(matches!(answer, Err(ApiError::Ended(Outcome::Failed))), "{answer:?}");
    let node = Pid::from_raw(i32::try_from(stage.node_id()).expect("a process id")).expect("a process id");
    kill_process(node, Signal::CONT).expect("the node runs");
    let echo = start_echo(&stage, &ups, 2);
    let mut scene = Scene { stage, echo, asking, to, ups };
    scene.to = scene.asking.resolve("echo", DEADLINE).expect("the node answers").expect("it is registered");
    assert_eq!(scene.ask(8, DEADLINE).expect("an answer").number, 8);
    scene.end();
}
