//! A process with one node and one application: it starts when its requirements are ready, and meets the
//! others repeatedly.

use std::{
    io::BufRead,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use sinew::{
    NodeBuilder,
    barrier::{Barrier, Meet},
    prelude::*,
};

use super::{Event, PARTIES};

/// Printed when the node's layers run.
pub(super) const UP: &str = "up";
/// Command: print the directory.
pub(super) const DIRECTORY: &str = "directory";
/// Command: do not arrive any more.
pub(super) const STAY_AWAY: &str = "stay away";
/// Printed when the party has continued and stays away on command.
pub(super) const KEPT_BACK: &str = "kept back";
/// Command: arrive again.
pub(super) const COME: &str = "come";
/// Pause between a round and the next arrival.
const PAUSE: Duration = Duration::from_millis(5);
/// Timeout of a party at the barrier; longer than any scenario needs.
const WITHIN: Duration = Duration::from_secs(600);

struct Party {
    barrier: Barrier,
    stays_away: Arc<AtomicBool>,
    is_kept_back: bool,
}

impl Actor for Party {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        Event::Started(Time::now().as_nanos()).print();
        self.arrive(context);
    }
}

impl Party {
    fn arrive(&mut self, context: &mut AppContext<Self>) {
        if self.stays_away.load(Ordering::Relaxed) {
            if !std::mem::replace(&mut self.is_kept_back, true) {
                println!("{KEPT_BACK}");
            }
            context.run_later(PAUSE, Self::arrive);
            return;
        }
        self.is_kept_back = false;
        Event::Arrived(Time::now().as_nanos()).print();
        let meeting = context.meet(&self.barrier).into_actor(self);
        context.spawn(meeting.map(|passed, _, context| {
            match passed {
                Ok(generation) => Event::Passed(Time::now().as_nanos(), generation).print(),
                Err(error) => println!("failed {error}"),
            }
            context.run_later(PAUSE, Self::arrive);
        }));
    }
}

/// `INDEX GROUP`: runs the node of this party.
pub(crate) fn run(arguments: &[String]) {
    let [index, group] = arguments else { panic!("an index and a group, not {arguments:?}") };
    let index: usize = index.parse().expect("the scenario counts");
    let stays_away = Arc::new(AtomicBool::new(false));
    let node = node(index, group.parse().expect("the scenario's group"), &stays_away).start();
    let node = node.unwrap_or_else(|error| panic!("{error}"));
    println!("{UP}");
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        match line.as_str() {
            STAY_AWAY => stays_away.store(true, Ordering::Relaxed),
            COME => stays_away.store(false, Ordering::Relaxed),
            DIRECTORY => say_the_directory(&node),
            other => panic!("{other:?} is no command of a party"),
        }
    }
}

fn say_the_directory(node: &Node) {
    let directory = node.handle().directory();
    let ready: Vec<String> =
        directory.iter().map(|entry| format!("{}={}", entry.name, entry.ready)).collect();
    println!("{DIRECTORY} {}", ready.join(" "));
}

fn node(index: usize, group: std::net::SocketAddrV4, stays_away: &Arc<AtomicBool>) -> NodeBuilder {
    let (name, requires) = PARTIES[index];
    let barrier = Barrier::new("step", PARTIES.map(|(name, _)| name)).within(WITHIN);
    let stays_away = stays_away.clone();
    let party = AppSpec::new(name, move || Party {
        barrier: barrier.clone(),
        stays_away: stays_away.clone(),
        is_kept_back: false,
    })
    .requires(requires.iter().copied())
    .address(AppAddress::fixed(0).expect("the first fixed address"));
    let address = u8::try_from(index + 1).expect("four of them");
    Node::builder(name)
        .address([127, 0, 0, address])
        .configure(move |config| {
            config.ndl.multicast = Some(group);
            config.ndl.mdns_port = None;
            config.rt.probe = Duration::ZERO;
        })
        .app(party)
}
