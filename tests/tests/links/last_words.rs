//! After the report of a node's loss, no message of that incarnation of the node is delivered. The receivers
//! are slow and under a flood: an actor, and an endpoint in the role of another process. The sender is killed
//! at any moment.

use sinew_testkit::SetOnDrop;
use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::Instant,
};

use rustix::process::Signal;
use sinew::{Endpoint, NodeApi, Registration, events::DownClass, message::Kind, prelude::*};
use sinew_testkit::{Log, Loopback, NodeProcess, TestDirectory};
use sinew_tests::node_under_test;

/// Incarnations of the sender, each of which is killed.
const INCARNATIONS: usize = 6;
/// Messages that both receivers have received before a kill.
const BEFORE: usize = 3_000;
/// Handling time of one message: more arrive in this time.
const TAKES: Duration = Duration::from_micros(50);

payload!("scenario.count", Bulk => struct Count { number: u64 });

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Saw {
    Count(u64),
    Lost,
    Down,
    Other,
}

fn work() {
    let until = Instant::now() + TAKES;
    while Instant::now() < until {
        std::hint::spin_loop();
    }
}

struct Slow(Log<Saw>);

impl Actor for Slow {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Count>> for Slow {
    type Result = ();

    fn handle(&mut self, count: Delivery<Count>, context: &mut Self::Context) {
        if count.number == 1 {
            context.monitor(count.source).expect("it has room");
        }
        work();
        self.0.write(Saw::Count(count.number));
    }
}

impl Handler<Delivery<NodeEvent>> for Slow {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        self.0.write(saw(&event.payload));
    }
}

impl Handler<Delivery<Down>> for Slow {
    type Result = ();

    fn handle(&mut self, down: Delivery<Down>, _: &mut Self::Context) {
        assert_eq!(down.class, DownClass::NodeLost, "{}", down.payload);
        self.0.write(Saw::Down);
    }
}

const fn saw(event: &NodeEvent) -> Saw {
    match event {
        NodeEvent::NodeLost { .. } => Saw::Lost,
        NodeEvent::NodeFound { .. }
        | NodeEvent::NodeRestarted { .. }
        | NodeEvent::AppStalled { .. }
        | NodeEvent::AppResumed { .. } => Saw::Other,
    }
}

/// Receives until the flag is set.
fn receive(mut endpoint: Endpoint, log: &Log<Saw>, is_over: &AtomicBool) {
    while !is_over.load(Ordering::Relaxed) {
        let Some(message) = endpoint.receive(Duration::from_millis(20)).expect("the node lives") else {
            continue;
        };
        let kind = message.kind();
        if kind == Kind::named("scenario.count") {
            work();
            let count: Count = message.decode().expect("a count");
            log.write(Saw::Count(count.number));
        } else if kind == NodeEvent::KIND {
            log.write(saw(&message.decode().expect("an event")));
        }
    }
}

/// Checks that after each end the first count is the first one of the next incarnation.
fn judge(who: &str, log: &Log<Saw>, end: Saw) {
    let all = log.all();
    assert_eq!(all.iter().filter(|saw| **saw == end).count(), INCARNATIONS, "{who}: {end:?}");
    for (at, _) in all.iter().enumerate().filter(|(_, saw)| **saw == end) {
        let next = all[at..].iter().find(|saw| matches!(saw, Saw::Count(_)));
        assert!(matches!(next, None | Some(Saw::Count(1))), "{who}: {next:?} came after {end:?}");
    }
}

fn sender(directory: &TestDirectory, loopback: &Loopback) -> NodeProcess {
    let text = format!(
        "[node]\nname = \"flood\"\naddress = \"127.0.0.9\"\n[ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
        loopback.group
    );
    let path = directory.write("flood.toml", &text);
    node_under_test(
        None,
        &path,
        &["--requires", "slow", "--requires", "client", "--floods", "slow", "--floods", "client"],
    )
}

#[test]
fn no_message_follows_the_report_of_a_nodes_loss() {
    let (loopback, directory) = (Loopback::new(), TestDirectory::new());
    let (slow, client, is_over) = (Log::default(), Log::default(), AtomicBool::new(false));
    let log = slow.clone();
    let spec = AppSpec::new("slow", move || Slow(log.clone()));
    let spec = spec.handles::<Count>().handles::<NodeEvent>().handles::<Down>().own_thread();
    let socket = directory.join("hub.sock");
    let node = loopback.node("hub").configure(|config| config.lncl.socket = Some(socket.clone()));
    let _node = node.app(spec).start().expect("a node");
    let api = NodeApi::connect(&socket).expect("the node is up");
    let registration = Registration::new().name("client").subscribe::<NodeEvent>();
    let endpoint = api.register_transport_address(registration).expect("the name is free");
    std::thread::scope(|scope| {
        scope.spawn(|| receive(endpoint, &client, &is_over));
        let _over = SetOnDrop(&is_over);
        for incarnation in 1..=INCARNATIONS {
            let flood = sender(&directory, &loopback);
            for log in [&slow, &client] {
                let has_begun = |all: &[Saw]| {
                    let lost = all.iter().filter(|saw| **saw == Saw::Lost).count();
                    let counts = all.iter().rev().take_while(|saw| **saw != Saw::Lost).count();
                    (lost == incarnation - 1 && counts > BEFORE).then_some(())
                };
                log.wait("the flood", has_begun);
            }
            flood.signal(Signal::KILL);
            for (log, end) in [(&slow, Saw::Lost), (&slow, Saw::Down), (&client, Saw::Lost)] {
                let is_told = |all: &[Saw]| {
                    (all.iter().filter(|saw| **saw == end).count() == incarnation).then_some(())
                };
                log.wait(&format!("{end:?} of incarnation {incarnation}"), is_told);
            }
        }
    });
    judge("the actor", &slow, Saw::Lost);
    judge("the actor", &slow, Saw::Down);
    judge("the endpoint", &client, Saw::Lost);
}
