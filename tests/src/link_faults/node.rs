//! The role of a node: one application that sends at a rate and receives.

use std::{
    io::BufRead,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::SystemTime,
};

use sinew::{Class, NodeHandle, Time, fault::Fault, prelude::*};
use sinew_runtime::lock;

use super::{
    clerk::Clerk,
    pacer::{Bulk, Control, Numbers, Pacer, Stream, filling, name, pattern},
};
use sinew_testkit::{
    DEADLINE,
    history::{Note, Party, Station},
    scripted::sender_app,
    until,
};

/// The application.
struct Office {
    peer: Station,
    clerk: Clerk,
    numbers: Arc<Numbers>,
    lulls: Arc<Lulls>,
    pattern: Arc<Vec<u8>>,
    length: usize,
    /// Whether the peer's node is up, according to the notifications.
    is_peer_there: bool,
}

/// The longest time between two received messages.
#[derive(Debug, Default)]
struct Lull {
    last: Mutex<Option<Time>>,
    longest_ns: AtomicU64,
}

impl Lull {
    fn end(&self, now: Time) {
        let last = lock(&self.last).replace(now);
        if let Some(last) = last {
            let lull = u64::try_from(now.since(last).as_nanos()).unwrap_or(u64::MAX);
            self.longest_ns.fetch_max(lull, Ordering::Relaxed);
        }
    }
}

/// The same for all messages, and for each class separately: a class that flows does not show that another
/// one stalls.
#[derive(Debug, Default)]
struct Lulls {
    all: Lull,
    /// In the order of [`CLASSES`](super::CLASSES).
    each: [Lull; 3],
}

impl Lulls {
    /// Records a message of this class.
    fn end(&self, class: Class, now: Time) {
        self.all.end(now);
        self.each[class as usize].end(now);
    }

    /// The longest times since the last call, in nanoseconds: of all, then of each class.
    fn take(&self) -> String {
        let all = std::iter::once(&self.all).chain(&self.each);
        let all = all.map(|lull| lull.longest_ns.swap(0, Ordering::Relaxed).to_string());
        all.collect::<Vec<_>>().join(" ")
    }
}

impl Actor for Office {
    type Context = AppContext<Self>;
}

impl Office {
    fn got(&self, (class, incarnation, number): (Class, u32, u64), filled: &[u8], is_awaited: bool) {
        self.lulls.end(class, Time::now());
        let from = Party { station: self.peer, incarnation };
        if filled != filling(&self.pattern, number, self.length) {
            self.clerk.note(Note::Damaged { from, class, number });
        }
        self.clerk.got(from, class, number, is_awaited);
    }

    fn peer_lost(&self) {
        self.clerk.note(Note::PeerLost { to: self.peer, upto: self.numbers.tried() });
    }
}

impl Handler<Delivery<Bulk>> for Office {
    type Result = ();

    fn handle(&mut self, bulk: Delivery<Bulk>, _: &mut Self::Context) {
        self.got((Class::Bulk, bulk.incarnation, bulk.number), &bulk.filling, false);
    }
}

impl Handler<Delivery<Stream>> for Office {
    type Result = ();

    fn handle(&mut self, stream: Delivery<Stream>, _: &mut Self::Context) {
        self.got((Class::Stream, stream.incarnation, stream.number), &stream.filling, false);
    }
}

impl Handler<Delivery<Control>> for Office {
    type Result = ();

    fn handle(&mut self, control: Delivery<Control>, _: &mut Self::Context) {
        self.got((Class::Control, control.incarnation, control.number), &control.filling, control.asked);
    }
}

impl Handler<Delivery<NodeEvent>> for Office {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        match event.payload {
            NodeEvent::NodeFound { .. } => self.is_peer_there = true,
            // The office only records outcomes, and a merely slow peer does not matter to it.
            NodeEvent::AppStalled { .. } | NodeEvent::AppResumed { .. } => {}
            NodeEvent::NodeLost { .. } => {
                self.is_peer_there = false;
                self.peer_lost();
            }
            NodeEvent::NodeRestarted { .. } => {
                if std::mem::replace(&mut self.is_peer_there, true) {
                    self.peer_lost();
                }
            }
        }
    }
}

/// `CONFIGURATION STATION LIFE PEER FILLING`
pub(super) fn run(arguments: &[String]) {
    if std::env::var_os("RUST_LOG").is_some() {
        let filter = tracing_subscriber::EnvFilter::from_default_env();
        tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    }
    // Suppresses the messages of a thousand panics; they are in each supervisor's log.
    std::panic::set_hook(Box::new(|_| {}));
    let number = |at: usize| arguments[at].parse::<u64>().expect("a number");
    let (station, incarnation, peer) = (number(1) as Station, number(2) as u32, number(3) as Station);
    let (clerk, numbers, lulls) =
        (Clerk::default(), Arc::new(Numbers::default()), Arc::new(Lulls::default()));
    let length = number(4) as usize;
    let office = {
        let (clerk, numbers, lulls) = (clerk.clone(), numbers.clone(), lulls.clone());
        let pattern = Arc::new(pattern());
        AppSpec::new(name(station).as_str(), move || Office {
            peer,
            clerk: clerk.clone(),
            numbers: numbers.clone(),
            lulls: lulls.clone(),
            pattern: pattern.clone(),
            length,
            is_peer_there: false,
        })
    };
    let office = office.handles::<Bulk>().handles::<Control>().handles::<Stream>().handles::<NodeEvent>();
    let (sender_app, key) = sender_app("sender");
    let config = NodeConfig::from_file(&arguments[0]).expect("the scenario's configuration");
    let node = Node::builder(config.name.clone()).config(config).app(office.own_thread()).app(sender_app);
    let node = node.start().expect("a node");
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    serve(&node, Pacer { sender: key.sender(), clerk, numbers, to: peer, incarnation, length }, &lulls);
    node.stop();
}

/// Prints the address of the node, and executes commands until standard input closes.
fn serve(node: &Node, pacer: Pacer, lulls: &Lulls) {
    let handle = node.handle();
    let address = |address: Option<std::net::SocketAddr>| address.expect("its layers are ready");
    println!("up {} {}", address(handle.gncl_address()), address(handle.ndl_address()));
    let (numbers, clerk) = (pacer.numbers.clone(), pacer.clerk.clone());
    let pacing = std::thread::spawn(move || pacer.run());
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            ["rate", rate] => numbers.rate.store(rate.parse().expect("a number"), Ordering::Relaxed),
            ["panic"] => println!("ready {}", panic_gncl(&handle).as_nanos()),
            ["gap"] => println!("gap {}", lulls.take()),
            ["report"] => clerk.report(),
            ["wall"] => println!("wall {}", wall_seconds()),
            ["queues"] => println!("queues {}", queues(&handle)),
            ["audit"] => {
                let audit = handle.audit(DEADLINE).expect("it runs, and nobody else asks");
                println!("audit {}", serde_json::to_string(&audit).expect("every field can be written"));
            }
            ["quiet"] => {
                numbers.quiet.store(true, Ordering::Relaxed);
                until("the pacer ends", || pacing.is_finished().then_some(()));
                clerk.report();
                println!("quiet");
            }
            _ => panic!("{line:?} is no command of a node"),
        }
    }
    clerk.report();
}

/// The current queue lengths of the node, as text.
fn queues(node: &NodeHandle) -> String {
    let queues = node.audit_here().entries.into_iter().filter_map(|entry| {
        let (place, waiting, under_way) = (entry.place, entry.account.waiting, entry.account.unacknowledged);
        (waiting + under_way > 0).then(|| match under_way {
            0 => format!("{place}: {waiting} wait"),
            _ => format!("{place}: {waiting} wait, {under_way} are under way"),
        })
    });
    let queues: Vec<_> = queues.collect();
    if queues.is_empty() { "nothing waits".to_owned() } else { queues.join("; ") }
}

/// Seconds since 1970, by the wall clock.
#[expect(clippy::disallowed_methods, reason = "it is the very clock that is to jump")]
pub(super) fn wall_seconds() -> u64 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).expect("it is later").as_secs()
}

/// Makes GNCL panic. Returns the time until it is ready again.
fn panic_gncl(node: &NodeHandle) -> Duration {
    let lives = || node.lives("GNCL").expect("every node has it");
    let before = lives().readies;
    node.inject("GNCL", Fault::panic()).expect("every node has it");
    until("GNCL is ready again", || (lives().readies > before).then_some(()));
    let lives = lives();
    lives.ready.expect("it is ready").since(lives.struck.expect("it was struck"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stalled_class_is_visible_while_others_flow() {
        let lulls = Lulls::default();
        for ms in 0..=30 {
            let now = Time::from_nanos(ms * 1_000_000);
            lulls.end(Class::Bulk, now);
            if ms % 10 == 0 {
                lulls.end(Class::Stream, now);
            }
            if ms == 5 || ms == 28 {
                lulls.end(Class::Control, now);
            }
        }
        assert_eq!(lulls.take(), "1000000 23000000 10000000 1000000");
        assert_eq!(lulls.take(), "0 0 0 0", "since it was asked last");
    }
}
