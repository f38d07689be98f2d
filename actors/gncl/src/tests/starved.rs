//! An instance of this layer that starts while its process has no free descriptor.

use std::{
    cell::Cell,
    fs::File,
    process::{Command, Stdio},
    rc::Rc,
    sync::Arc,
    thread,
    time::Duration,
};

use actix::{Actor, ActorContext, Addr, AsyncContext};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use sinew_model::config::NodeConfig;
use sinew_runtime::{
    supervision::ReadyGate,
    tid::{Incarnation, NodeAddress, Tid},
    wire::{Class, Kind},
};
use tokio::net::TcpStream;

use super::{
    bench::{ByHand, NINE, Node, introduction, run, within},
    classes::{lane_by_hand, of_class},
    secured::{keys, secured_stores},
};
use crate::{
    Gncl, State,
    core::{CLASSES, Introduction, Lane, write},
    frame::frame,
    transport::Transport,
};

/// Tells a test that it is alone in its process.
const ALONE: &str = "SINEW_TEST_IS_ALONE";

/// Runs the calling test in a process of its own, so its changes of limits do not affect other tests.
fn alone(test: impl Future<Output = ()>) {
    if std::env::var_os(ALONE).is_some() {
        return run(test);
    }
    let this = thread::current();
    let program = std::env::current_exe().expect("a test has a path");
    let mut command = Command::new(program);
    command.args(["--exact", this.name().expect("a test's thread has its name")]).env(ALONE, "1");
    let ended = command.stdin(Stdio::null()).output().expect("a test can be started");
    assert!(
        ended.status.success(),
        "{}\n{}",
        String::from_utf8_lossy(&ended.stdout),
        String::from_utf8_lossy(&ended.stderr)
    );
}

/// An instance of the layer on this thread, as the IO thread runs them one after the other.
struct Instance(Addr<Gncl>, Rc<Cell<bool>>);

impl Instance {
    async fn begin(state: &Arc<State>) -> Self {
        let (say, ready) = tokio::sync::oneshot::channel();
        let gate = ReadyGate::new(move || say.send(()).expect("the test waits"));
        let (state, is_over) = (state.clone(), Rc::new(Cell::new(false)));
        let over = is_over.clone();
        let layer = Gncl::create(move |ctx| {
            ctx.run_interval(Duration::from_millis(1), move |_, ctx| {
                if over.get() {
                    ctx.stop();
                }
            });
            Gncl::new(state, gate)
        });
        within("GNCL to be ready", ready).await.expect("GNCL says that it is ready");
        Self(layer, is_over)
    }

    async fn end(self) {
        self.1.set(true);
        within("the layer to end", async {
            while self.0.connected() {
                tokio::task::yield_now().await;
            }
        })
        .await;
    }
}

/// While it exists, no descriptor is free: it holds all that the limit allows.
struct Starved(Rlimit, Vec<File>);

impl Starved {
    fn begin() -> Self {
        const FEW: u64 = 256;
        let limit = getrlimit(Resource::Nofile);
        setrlimit(Resource::Nofile, Rlimit { current: Some(FEW), ..limit }).expect("less is always allowed");
        let taken: Vec<_> = std::iter::from_fn(|| File::open("/dev/null").ok()).collect();
        assert!(!taken.is_empty(), "the test has fewer than {FEW}");
        Self(limit, taken)
    }
}

impl Drop for Starved {
    fn drop(&mut self) {
        setrlimit(Resource::Nofile, self.0).expect("it was so before");
        self.1.clear();
    }
}

#[test]
fn layer_started_without_descriptors_listens_as_before() {
    alone(async {
        let mut config = NodeConfig::new("node-1");
        config.address = Some(NodeAddress::new(1));
        let open = State::for_test(config, Incarnation(1));
        let secured = secured_stores(Incarnation(1), 2, (&keys(), 2), |_| {});
        for (state, answer) in [(open, Kind::GNCL_WELCOME), (secured, Kind::GNCL_REFUSAL)] {
            Instance::begin(&state).await.end().await;
            let starved = Starved::begin();
            let instance = Instance::begin(&state).await;
            drop(starved);
            let at = *state.ctx.listens.first.get().expect("GNCL listens");
            let socket = within("a connection", TcpStream::connect(at)).await.expect("it listens");
            let mut peer = ByHand::on(socket);
            let hello = introduction(state.ctx.node);
            peer.send(&frame(NINE, state.ctx.node, Kind::GNCL_HELLO, write(&hello))).await;
            assert_eq!(peer.receive().await.header.kind, answer);
            instance.end().await;
        }
    });
}

#[test]
fn bulk_connection_without_a_descriptor_ends_alone() {
    alone(async {
        // Given: a thread for Bulk, a stranger, and a peer
        let mut node = Node::start_with(1, |config| config.gncl.handshake = Duration::from_mins(10)).await;
        let connected = within("a connection", TcpStream::connect(node.listens_at())).await;
        let stranger = Transport::plain(connected.expect("the node listens"));
        drop(node.state.store.relocate(Lane::Bulk, stranger.clone()).expect("there are descriptors"));
        let mut bulk = ByHand::dial(&node).await;
        // It was accepted after these two.
        let mut first = lane_by_hand(&node, Lane::Control, 1).await;
        node.up().await;
        // When
        let starved = Starved::begin();
        let features = vec![CLASSES.to_owned()];
        let hello =
            Introduction { lane: Lane::Bulk, link: 1, dial: 2, features, ..introduction(node.address()) };
        bulk.send(&frame(NINE, node.address(), Kind::GNCL_HELLO, write(&hello))).await;
        // Then
        assert!(bulk.try_receive_any().await.is_none(), "it is not welcomed");
        assert_eq!(node.state.store.refusals.of("no descriptor for a connection of Bulk"), 1);
        assert_eq!(
            node.state.store.refusals.of("not accepted"),
            0,
            "nothing else has said that there is none"
        );
        let mut buffer = bytes::BytesMut::new();
        let end = within("the stranger to go", stranger.read(&mut buffer, 1)).await;
        assert_eq!(end.expect("it is closed in order"), 0);
        drop(starved);
        let mut again = lane_by_hand(&node, Lane::Bulk, 3).await;
        let to = Tid::new(NINE, node.tid(1).app);
        for (class, lane) in [(Class::Control, &mut first), (Class::Bulk, &mut again)] {
            let message = of_class(class, node.message(to, b"goes on"));
            node.state.ctx.router.send(message).expect("the peer is linked");
            let mut received = lane.receive().await;
            while received.header.kind == Kind::GNCL_PING {
                received = lane.receive().await;
            }
            assert_eq!(received.payload[..], *b"goes on", "{class:?}");
        }
    });
}
