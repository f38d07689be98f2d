//! Sinew's applications on two nodes, in two processes.

use std::{
    net::Ipv4Addr,
    sync::mpsc::{SyncSender, sync_channel},
    time::Instant,
};

use serde::{Deserialize, Serialize};
use sinew::prelude::*;
use sinew_figures::{
    Figures, Pinning, Rounds,
    process::{Process, await_end, say_there},
};

use crate::{
    DEADLINE,
    path::{Path, echo_role},
};

/// Sent there.
#[derive(Serialize, Deserialize)]
pub(crate) struct There {
    #[serde(with = "serde_bytes")]
    pub(crate) block: Vec<u8>,
}

impl Payload for There {
    const NAME: &'static str = "peers.there";
}

/// Sent back.
#[derive(Serialize, Deserialize)]
pub(crate) struct Back {
    #[serde(with = "serde_bytes")]
    pub(crate) block: Vec<u8>,
}

impl Payload for Back {
    const NAME: &'static str = "peers.back";
}

struct Echo;

impl Actor for Echo {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<There>> for Echo {
    type Result = ();

    fn handle(&mut self, there: Delivery<There>, context: &mut Self::Context) {
        let source = there.source;
        context.send(source, &Back { block: there.payload.block }).expect("the measuring end takes it");
    }
}

struct Ping {
    to: Option<Tid>,
    rounds: Rounds,
    round: u32,
    sent: Instant,
    times: Figures,
    done: SyncSender<Figures>,
}

impl Ping {
    fn ping(&mut self, context: &AppContext<Self>) {
        self.sent = Instant::now();
        let to = self.to.expect("it was found at the start");
        context.send(to, &There { block: vec![7; self.rounds.bytes] }).expect("the echo takes it");
    }
}

impl Actor for Ping {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.to = context.resolve("echo");
        self.ping(context);
    }
}

impl Handler<Delivery<Back>> for Ping {
    type Result = ();

    fn handle(&mut self, back: Delivery<Back>, context: &mut Self::Context) {
        assert_eq!(back.block.len(), self.rounds.bytes);
        if self.round >= self.rounds.warm_up {
            self.times.record(self.sent.elapsed());
        }
        self.round += 1;
        if self.round >= self.rounds.warm_up + self.rounds.counted {
            self.done.send(std::mem::take(&mut self.times)).expect("somebody waits for the times");
        } else if self.rounds.pace.pause().is_zero() {
            self.ping(context);
        } else {
            context.after(self.rounds.pace.pause(), |ping, _, context| ping.ping(context));
        }
    }
}

/// A node that finds nobody but its neighbour.
pub(crate) fn neighbour(name: &str, host: u8, group: &str) -> NodeBuilder {
    let group = group.parse().expect("a group that this program wrote itself");
    Node::builder(name).address(Ipv4Addr::new(127, 0, 0, host)).configure(|config| {
        config.ndl.multicast = Some(group);
        config.ndl.mdns_port = None;
    })
}

/// A multicast group and port for the nodes of one run.
pub(crate) fn group() -> String {
    let id = std::process::id();
    format!("239.255.84.{}:{}", id % 200 + 1, 20_000 + id % 20_000)
}

/// Round trips between two applications.
pub(crate) fn measure(path: Path, rounds: Rounds, pinning: Pinning) -> Figures {
    let group = group();
    let _echo = Process::start(&echo_role(path, rounds.bytes, pinning, &group));
    let (done, times) = sync_channel(1);
    let make = move || Ping {
        to: None,
        rounds,
        round: 0,
        sent: Instant::now(),
        times: Figures::new(),
        done: done.clone(),
    };
    let ping = AppSpec::new("ping", make).handles::<Back>().requires(["echo"]);
    let ping = if path == Path::NodesIo { ping.on_io_thread() } else { ping.own_thread() };
    let node = neighbour("ping", 1, &group).app(ping).start().expect("a node");
    let times = times.recv_timeout(DEADLINE).expect("the rounds end");
    node.stop();
    times
}

/// The node that echoes.
pub(crate) fn echo(path: Path, group: &str) {
    let echo = AppSpec::new("echo", || Echo).handles::<There>();
    let echo = if path == Path::NodesIo { echo.on_io_thread() } else { echo.own_thread() };
    let _node = neighbour("echo", 2, group).app(echo).start().expect("a node");
    say_there();
    await_end();
}
