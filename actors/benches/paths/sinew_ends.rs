//! Sinew's ends: applications that send a block there and back.

use std::{
    io::Read,
    net::Ipv4Addr,
    path::Path,
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};
use sinew::{NodeApi, Registration, prelude::*};
use sinew_figures::{End, Figures, Pinning};

use crate::{WARM_UP, case::Echo, rounds};

/// No wait of this bench is longer.
const DEADLINE: Duration = Duration::from_secs(60);

#[derive(Serialize, Deserialize)]
struct There {
    #[serde(with = "serde_bytes")]
    block: Vec<u8>,
}

impl Payload for There {
    const NAME: &'static str = "paths.there";
}

#[derive(Serialize, Deserialize)]
struct Back {
    #[serde(with = "serde_bytes")]
    block: Vec<u8>,
}

impl Payload for Back {
    const NAME: &'static str = "paths.back";
}

struct Echoer;

impl Actor for Echoer {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<There>> for Echoer {
    type Result = ();

    fn handle(&mut self, there: Delivery<There>, context: &mut Self::Context) {
        let source = there.source;
        context.send(source, &Back { block: there.payload.block }).expect("the measuring end takes it");
    }
}

struct Pinger {
    to: Option<Tid>,
    bytes: usize,
    round: u64,
    rounds: u64,
    sent: Instant,
    figures: Option<Figures>,
    done: SyncSender<Figures>,
}

impl Pinger {
    fn new(bytes: usize, done: SyncSender<Figures>) -> Self {
        Self {
            to: None,
            bytes,
            round: 0,
            rounds: rounds(),
            sent: Instant::now(),
            figures: Some(Figures::new()),
            done,
        }
    }

    fn ping(&mut self, context: &AppContext<Self>) {
        self.sent = Instant::now();
        let to = self.to.expect("it was found at the start");
        context.send(to, &There { block: vec![7; self.bytes] }).expect("the echo takes it");
    }
}

impl Actor for Pinger {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.to = context.resolve("echo");
        self.ping(context);
    }
}

impl Handler<Delivery<Back>> for Pinger {
    type Result = ();

    fn handle(&mut self, back: Delivery<Back>, context: &mut Self::Context) {
        assert_eq!(back.block.len(), self.bytes);
        if self.round >= WARM_UP
            && let Some(figures) = &mut self.figures
        {
            figures.record(self.sent.elapsed());
        }
        self.round += 1;
        if self.round < WARM_UP + self.rounds {
            self.ping(context);
        } else if let Some(figures) = self.figures.take() {
            self.done.send(figures).expect("somebody waits for the figures");
        }
    }
}

fn echoer() -> AppSpec<Echoer> {
    AppSpec::new("echo", || Echoer).handles::<There>()
}

fn pinger(bytes: usize) -> (AppSpec<Pinger>, Receiver<Figures>) {
    let (done, figures) = sync_channel(1);
    (
        AppSpec::new("ping", move || Pinger::new(bytes, done.clone())).handles::<Back>().requires(["echo"]),
        figures,
    )
}

/// A node that nobody else finds.
fn alone(name: &str) -> NodeBuilder {
    Node::builder(name).configure(|config| {
        config.ndl.multicast = None;
        config.ndl.mdns_port = None;
    })
}

/// Two applications of one node.
pub(crate) fn in_process(bytes: usize, pinning: Pinning, same_thread: bool) -> Figures {
    let place = |name: &str, end| match pinning.cpu(end) {
        Some(cpu) => Place::thread(name).on_cpu(cpu),
        None => Place::thread(name),
    };
    let (ping, figures) = pinger(bytes);
    let there = if same_thread { place("ping", End::Measuring) } else { place("echo", End::Echoing) };
    let node =
        alone("paths").app(echoer().place(there)).app(ping.place(place("ping", End::Measuring))).start();
    let node = node.expect("a node");
    let figures = figures.recv_timeout(DEADLINE).expect("the rounds end");
    node.stop();
    figures
}

/// An application of a node and an endpoint in another process.
pub(crate) fn through_lncl(path: &Path, bytes: usize, start_echo: impl FnOnce() -> Echo) -> Figures {
    let (ping, figures) = pinger(bytes);
    let node = alone("paths").configure(|config| config.lncl.socket = Some(path.to_owned()));
    let node = node.app(ping.on_io_thread()).start().expect("a node");
    let echo = start_echo();
    let figures = figures.recv_timeout(DEADLINE).expect("the rounds end");
    drop(echo);
    node.stop();
    figures
}

/// The endpoint that echoes.
pub(crate) fn echo_endpoint(at: &str) {
    println!("there");
    let api = NodeApi::connect(Path::new(at)).expect("the node's door");
    let mut endpoint = api.register_transport_address(Registration::new().name("echo")).expect("an address");
    loop {
        let Some(there) = endpoint.receive(DEADLINE).expect("the node lives") else { return };
        let source = there.source();
        let block = there.decode::<There>().expect("a block").block;
        endpoint.send(source, &Back { block }).expect("the measuring end takes it");
    }
}

fn neighbour(name: &str, host: u8, group: &str) -> NodeBuilder {
    let group = group.parse().expect("a group that this program wrote itself");
    Node::builder(name).address(Ipv4Addr::new(127, 0, 0, host)).configure(|config| {
        config.ndl.multicast = Some(group);
        config.ndl.mdns_port = None;
    })
}

/// The node that echoes, in a process of its own.
pub(crate) fn echo_node(group: &str, on_io_thread: bool) {
    let echo = if on_io_thread { echoer().on_io_thread() } else { echoer().own_thread() };
    let _node = neighbour("echo", 2, group).app(echo).start().expect("a node");
    println!("there");
    // Until the measuring end closes the pipe or ends this process.
    let _ = std::io::stdin().read(&mut [0]);
}

/// An application of this node and one of another.
pub(crate) fn between_nodes(group: &str, bytes: usize, on_io_thread: bool) -> Figures {
    let (ping, figures) = pinger(bytes);
    let ping = if on_io_thread { ping.on_io_thread() } else { ping.own_thread() };
    let node = neighbour("ping", 1, group).app(ping).start().expect("a node");
    let figures = figures.recv_timeout(DEADLINE).expect("the rounds end");
    node.stop();
    figures
}
