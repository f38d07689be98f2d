//! Whoever is told that a node is lost gets no message of that life of it afterwards: slow receivers under a flood, whose sender is killed
//! at any moment, an actor and an endpoint in another process's place.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::Instant,
};

use rustix::process::Signal;
use sinew::{Endpoint, NodeApi, Registration, events::DownClass, message::Kind, prelude::*};
use sinew_tests::{Ground, Log, OwnDirectory, Program, node_under_test};

/// Lives of the sender, each of which ends by a kill.
const LIVES: usize = 6;
/// Counts that both have got before it is killed.
const BEFORE: usize = 3_000;
/// What handling one takes: more come.
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

/// Says that it is over, also where the test fails.
struct Over<'a>(&'a AtomicBool);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Receives until it is over.
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

/// After each end, the first count is the first one of the next life.
fn judge(who: &str, log: &Log<Saw>, end: Saw) {
    let all = log.all();
    assert_eq!(all.iter().filter(|saw| **saw == end).count(), LIVES, "{who}: {end:?}");
    for (at, _) in all.iter().enumerate().filter(|(_, saw)| **saw == end) {
        let next = all[at..].iter().find(|saw| matches!(saw, Saw::Count(_)));
        assert!(matches!(next, None | Some(Saw::Count(1))), "{who}: {next:?} came after {end:?}");
    }
}

fn sender(directory: &OwnDirectory, ground: &Ground) -> Program {
    let path = directory.join("flood.toml");
    let text = format!(
        "[node]\nname = \"flood\"\naddress = \"127.0.0.9\"\n[ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
        ground.group
    );
    std::fs::write(&path, text).expect("the test's own directory");
    node_under_test(
        None,
        &path,
        &["--requires", "slow", "--requires", "client", "--floods", "slow", "--floods", "client"],
    )
}

#[test]
fn who_is_told_of_a_lost_node_gets_no_message_of_that_life_afterwards() {
    let (ground, directory) = (Ground::new(), OwnDirectory::new());
    let (slow, client, is_over) = (Log::default(), Log::default(), AtomicBool::new(false));
    let log = slow.clone();
    let spec = AppSpec::new("slow", move || Slow(log.clone()));
    let spec = spec.handles::<Count>().handles::<NodeEvent>().handles::<Down>().own_thread();
    let socket = directory.join("hub.sock");
    let node = ground.node("hub").configure(|config| config.lncl.socket = Some(socket.clone()));
    let _node = node.app(spec).start().expect("a node");
    let api = NodeApi::connect(&socket).expect("the node is up");
    let registration = Registration::new().name("client").subscribe::<NodeEvent>();
    let endpoint = api.register_transport_address(registration).expect("the name is free");
    std::thread::scope(|scope| {
        scope.spawn(|| receive(endpoint, &client, &is_over));
        let _over = Over(&is_over);
        for life in 1..=LIVES {
            let flood = sender(&directory, &ground);
            for log in [&slow, &client] {
                let has_begun = |all: &[Saw]| {
                    let lost = all.iter().filter(|saw| **saw == Saw::Lost).count();
                    let counts = all.iter().rev().take_while(|saw| **saw != Saw::Lost).count();
                    (lost == life - 1 && counts > BEFORE).then_some(())
                };
                log.wait("the flood", has_begun);
            }
            flood.signal(Signal::KILL);
            for (log, end) in [(&slow, Saw::Lost), (&slow, Saw::Down), (&client, Saw::Lost)] {
                let is_told =
                    |all: &[Saw]| (all.iter().filter(|saw| **saw == end).count() == life).then_some(());
                log.wait(&format!("{end:?} of life {life}"), is_told);
            }
        }
    });
    judge("the actor", &slow, Saw::Lost);
    judge("the actor", &slow, Saw::Down);
    judge("the endpoint", &client, Saw::Lost);
}
