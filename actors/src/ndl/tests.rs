//! Real NDL actors over the loopback interface, each test in a multicast group and on ports of its own.

mod keys;
mod mdns;
mod remembered;
mod root;

use std::{
    net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket},
    sync::{
        Arc,
        atomic::{AtomicU8, Ordering},
    },
    time::Duration,
};

use actix::{Actor, Arbiter, System};
use futures_util::StreamExt;
use sinew_runtime::{
    outcome::Rejection,
    post::{Post, PostStream},
    router::{LocalRoute, Outlet, Refused},
    supervision::ReadyGate,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Message, Payload},
};

use super::{
    Event, LossReason, MembershipFact, NdlActor, NodeEvent, Progress, Source, actor::lock, core::Input,
};
use crate::{
    config::{NdlConfig, NodeConfig},
    gncl::{self, LinkFact},
    lncl,
    node::RootEvent,
    stores::Stores,
    sync,
};

const LOOPBACK: Ipv4Addr = Ipv4Addr::LOCALHOST;

async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    let waited = tokio::time::timeout(Duration::from_secs(60), future).await;
    waited.unwrap_or_else(|_| panic!("waited 60 s for {what}"))
}

/// A UDP port that is free now.
fn free_port() -> u16 {
    UdpSocket::bind((LOOPBACK, 0)).unwrap().local_addr().unwrap().port()
}

/// A group that no other test of this process has, at a port that no other process has.
fn own_group() -> SocketAddrV4 {
    static NEXT: AtomicU8 = AtomicU8::new(1);
    SocketAddrV4::new(Ipv4Addr::new(239, 255, 77, NEXT.fetch_add(1, Ordering::Relaxed)), free_port())
}

/// No source of addresses at all.
fn alone(ndl: &mut NdlConfig) {
    ndl.multicast = None;
    ndl.mdns_port = None;
}

/// An application that takes every event.
struct Inbox(Post<Message>);

impl Outlet for Inbox {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        self.0.post(message).map_err(|message| Refused::new(message, Rejection::QueueFull))
    }
}

/// A node with NDL and no other layer.
struct Node {
    stores: Arc<Stores>,
    layer: Option<Arbiter>,
    facts: PostStream<gncl::Event>,
    events: PostStream<Message>,
    /// One that says that all gets on; else it hangs.
    has_root: bool,
}

async fn all_gets_on(mut root: PostStream<RootEvent>) {
    while let Some(event) = root.next().await {
        if let RootEvent::TellProgress(answer) = event {
            drop(answer.send(Progress::default()));
        }
    }
}

impl Node {
    async fn start(number: u32, set: impl FnOnce(&mut NdlConfig)) -> Self {
        Self::start_life(number, 1, set).await
    }

    async fn start_life(number: u32, incarnation: u64, set: impl FnOnce(&mut NdlConfig)) -> Self {
        let mut node = Self::new(number, incarnation, set);
        node.start_layer().await;
        node
    }

    fn new(number: u32, incarnation: u64, set: impl FnOnce(&mut NdlConfig)) -> Self {
        let mut config = NodeConfig::new(format!("node-{number}"));
        config.address = Some(NodeAddress::new(number));
        alone(&mut config.ndl);
        set(&mut config.ndl);
        Self::of(config, incarnation)
    }

    fn of(config: NodeConfig, incarnation: u64) -> Self {
        let number = config.node_address().bits();
        let stores = Stores::for_test(config, Incarnation(incarnation));
        stores.gncl_listen.set(gncl_of(number)).unwrap();
        let (inbox, facts) = (Post::new(1_000), stores.posts.gncl.attach());
        let events = inbox.attach();
        let route = LocalRoute { outlet: Arc::new(Inbox(inbox)), events: Arc::new([NodeEvent::KIND]) };
        stores.router.set_local(AppAddress::new(0x1000), route);
        lncl::app_ready(&stores, AppAddress::new(0x1000));
        Self { stores, layer: None, facts, events, has_root: true }
    }

    async fn start_layer(&mut self) {
        let (say, ready) = tokio::sync::oneshot::channel();
        let gate = ReadyGate::new(move || say.send(()).expect("the test waits"));
        let (stores, layer) = (self.stores.clone(), Arbiter::new());
        layer.spawn_fn(move || drop(NdlActor::new(stores, gate).start()));
        if self.has_root {
            layer.spawn(all_gets_on(self.stores.posts.root.attach()));
        }
        within("NDL to be ready", ready).await.expect("NDL says that it is ready");
        self.layer = Some(layer);
    }

    /// Ends the layer as a crash would: its thread goes, with all that ran on it.
    fn end_layer(&mut self) {
        if let Some(layer) = self.layer.take() {
            layer.stop();
            layer.join().expect("the layer's thread ends without a panic");
        }
    }

    fn udp(&self) -> SocketAddr {
        lock(&self.stores).paths().first().copied().expect("NDL has bound its socket")
    }

    async fn fact(&mut self, what: &str) -> MembershipFact {
        let event = within(what, self.facts.next()).await.expect("nobody else reads this post");
        let gncl::Event::Membership(fact) = event else { panic!("no node moves: {event:?}") };
        fact
    }

    async fn finds(&mut self, other: &Self) {
        let (node, incarnation) = (other.stores.node, other.stores.incarnation);
        let found = MembershipFact::NodeFound { node, incarnation, gncl: vec![gncl_of(node.bits())] };
        assert_eq!(self.fact(&format!("node {node} to be found")).await, found);
    }

    async fn loses(&mut self, other: &Self, reason: LossReason) {
        let (node, incarnation) = (other.stores.node, other.stores.incarnation);
        let lost = MembershipFact::NodeLost { node, incarnation, why: reason };
        assert_eq!(self.fact(&format!("node {node} to be lost")).await, lost);
    }

    async fn event(&mut self) -> Message {
        within("an event", self.events.next()).await.expect("nobody else reads this inbox")
    }

    fn sources(&self) -> Vec<Source> {
        let members = lock(&self.stores).members(Time::now());
        members.iter().flat_map(|member| member.sources.keys().copied()).collect()
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        self.end_layer();
    }
}

fn gncl_of(number: u32) -> SocketAddr {
    SocketAddr::from((LOOPBACK, 40_000 + number as u16))
}

fn run(test: impl Future<Output = ()>) {
    System::new().block_on(test);
}

#[test]
fn two_nodes_find_each_other_by_multicast_alone_and_know_their_clocks() {
    run(async {
        let group = own_group();
        let mut first = Node::start(1, |ndl| ndl.multicast = Some(group)).await;
        let mut second = Node::start(2, |ndl| ndl.multicast = Some(group)).await;
        first.finds(&second).await;
        second.finds(&first).await;
        assert!(first.sources().contains(&Source::Multicast), "{:?}", first.sources());
        // One host has one clock: what is measured is the error, and it keeps to its bound.
        let (node, life) = (second.stores.node, second.stores.incarnation);
        let offset = first.stores.clocks.get(node, life).expect("measured before the fact is told");
        assert!(offset.theirs_minus_ours_ns.unsigned_abs() as u128 <= offset.bound.as_nanos(), "{offset:?}");
    });
}

#[test]
fn two_nodes_find_each_other_by_one_seed_alone() {
    run(async {
        let mut first = Node::start(1, |_| {}).await;
        let seed = first.udp();
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&second).await;
        second.finds(&first).await;
        assert_eq!(first.sources(), [Source::Query]);
        assert!(second.sources().contains(&Source::Seed));
    });
}

#[test]
fn two_nodes_find_each_other_by_mdns_alone() {
    run(async {
        let port = free_port();
        let mut first = Node::start(1, |ndl| ndl.mdns_port = Some(port)).await;
        let mut second = Node::start(2, |ndl| ndl.mdns_port = Some(port)).await;
        first.finds(&second).await;
        second.finds(&first).await;
        let sources = [first.sources(), second.sources()].concat();
        assert!(sources.contains(&Source::Mdns), "{sources:?}");
    });
}

#[test]
fn an_application_hears_who_comes_and_who_falls_silent() {
    run(async {
        // given
        let mut first = Node::start(1, |ndl| ndl.period = Duration::from_millis(50)).await;
        let seed = first.udp();
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&second).await;
        let found = first.event().await;
        assert_eq!(found.header.source, Tid::new(first.stores.node, AppAddress::NDL));
        let (node, incarnation) = (second.stores.node, Incarnation(1));
        let expected = NodeEvent::NodeFound { node, name: "node-2".to_owned(), incarnation };
        assert_eq!(found.decode::<NodeEvent>().unwrap(), expected);
        // when: it ends without a word
        second.end_layer();
        // then
        first.loses(&second, LossReason::Crashed).await;
        let lost: NodeEvent = first.event().await.decode().unwrap();
        assert!(matches!(lost, NodeEvent::NodeLost { why: LossReason::Crashed, .. }), "{lost:?}");
        assert_eq!(first.stores.clocks.get(node, incarnation), None);
    });
}

#[test]
fn a_node_that_falls_silent_while_its_host_takes_connections_for_it_hangs() {
    run(async {
        // given: its GNCL listens, and takes nobody
        let mut first = Node::start(1, |ndl| ndl.period = Duration::from_millis(50)).await;
        let listener = std::net::TcpListener::bind((LOOPBACK, 0)).unwrap();
        let seed = first.udp();
        let mut second = Node::new(2, 1, |ndl| ndl.seeds = vec![seed.into()]);
        second.stores = {
            let stores = Stores::for_test(second.stores.config.clone(), Incarnation(1));
            stores.gncl_listen.set(listener.local_addr().unwrap()).unwrap();
            stores
        };
        second.start_layer().await;
        drop(first.fact("node 2 to be found").await);
        // when
        second.end_layer();
        // then
        first.loses(&second, LossReason::Hung).await;
    });
}

#[test]
fn a_node_that_stops_says_goodbye_and_a_later_life_is_a_restart() {
    run(async {
        // given: a period so long that only the goodbye can tell
        let mut first = Node::start(1, |ndl| ndl.period = Duration::from_secs(60)).await;
        let seed = first.udp();
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&second).await;
        drop(first.event().await);
        second.finds(&first).await;
        // when
        second.stores.stopping.store(true, Ordering::Relaxed);
        second.end_layer();
        // then
        first.loses(&second, LossReason::Left).await;
        drop(first.event().await);
        // when
        let third = Node::start_life(2, 2, |ndl| ndl.seeds = vec![seed.into()]).await;
        // then
        first.finds(&third).await;
        let clock = |life| first.stores.clocks.get(third.stores.node, Incarnation(life));
        assert!(clock(2).is_some() && clock(1).is_none(), "{:?}", [1, 2].map(clock));
        let event: NodeEvent = first.event().await.decode().unwrap();
        assert!(matches!(event, NodeEvent::NodeRestarted { incarnation: Incarnation(2), .. }), "{event:?}");
    });
}

#[test]
fn an_event_that_finds_a_full_mailbox_is_told_when_there_is_room() {
    run(async {
        // given: room for one event
        let mut first = Node::start(1, |_| {}).await;
        let inbox = Post::new(1);
        first.events = inbox.attach();
        let route = LocalRoute { outlet: Arc::new(Inbox(inbox)), events: Arc::new([NodeEvent::KIND]) };
        first.stores.router.set_local(AppAddress::new(0x1000), route);
        let seed = first.udp();
        let second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&second).await;
        let third = Node::start(3, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&third).await;
        // when
        within("the mailbox to refuse", async {
            while first.stores.refusals.of("event not taken by an application") == 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
        // then
        for node in [second.stores.node, third.stores.node] {
            let event: NodeEvent = first.event().await.decode().unwrap();
            assert!(matches!(event, NodeEvent::NodeFound { node: found, .. } if found == node), "{event:?}");
        }
    });
}

#[test]
fn layers_whose_posts_are_full_learn_who_came_and_went_when_they_have_room() {
    run(async {
        // given
        let mut first = Node::start(1, |ndl| ndl.period = Duration::from_millis(200)).await;
        let posts = &first.stores.posts;
        while posts.gncl.post(gncl::Event::DenyListChanged).is_ok() {}
        while posts.sync.post(sync::Event::Monitors).is_ok() {}
        let mut told = posts.sync.attach();
        let seed = first.udp();
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        let mut third = Node::start(3, |ndl| ndl.seeds = vec![seed.into()]).await;
        drop([first.event().await, first.event().await]);
        second.end_layer();
        let lost: NodeEvent = first.event().await.decode().unwrap();
        assert!(matches!(lost, NodeEvent::NodeLost { .. }), "{lost:?}");
        assert!(first.stores.refusals.of("a layer's post is full") > 0);
        // when: both layers read on
        let (mut to_gncl, mut to_sync) = (Vec::new(), Vec::new());
        within("both layers to be told of both nodes", async {
            while to_gncl.len() < 2 || to_sync.len() < 2 {
                tokio::select! {
                    Some(event) = first.facts.next(), if to_gncl.len() < 2 => {
                        if let gncl::Event::Membership(fact) = event { to_gncl.push(fact) }
                    }
                    Some(event) = told.next(), if to_sync.len() < 2 => {
                        if let sync::Event::Membership(fact) = event { to_sync.push(fact) }
                    }
                }
            }
        })
        .await;
        // then: the second came and went
        let has_lost = |facts: &[MembershipFact]| {
            let lost = |fact: &MembershipFact| matches!(fact, MembershipFact::NodeLost { node, .. } if *node == second.stores.node);
            facts.iter().any(lost)
        };
        let has_found = |facts: &[MembershipFact]| {
            let found = |fact: &MembershipFact| matches!(fact, MembershipFact::NodeFound { node, .. } if *node == third.stores.node);
            facts.iter().any(found)
        };
        assert!(has_lost(&to_gncl) && has_lost(&to_sync), "{to_gncl:?} {to_sync:?}");
        assert!(has_found(&to_gncl) && has_found(&to_sync), "{to_gncl:?} {to_sync:?}");
        third.end_layer();
    });
}

#[test]
fn nobody_notices_that_the_layer_of_a_node_is_restarted() {
    run(async {
        // given
        let mut first = Node::start(1, |_| {}).await;
        let seed = first.udp();
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&second).await;
        second.finds(&first).await;
        // when
        let before = second.udp();
        second.end_layer();
        second.start_layer().await;
        // then: the next thing that either hears of is a third node
        assert_eq!(second.udp(), before);
        let seeds = vec![seed.into(), before.into()];
        let third = Node::start(3, |ndl| ndl.seeds = seeds).await;
        first.finds(&third).await;
        second.finds(&third).await;
        assert_eq!(lock(&second.stores).members(Time::now()).len(), 2);
    });
}

#[test]
fn a_refused_dial_after_gncl_and_ndl_were_restarted_is_a_crash_of_who_was_linked() {
    run(async {
        // given: a link stood, of which no more is heard, and a period so long that only the refusal can tell
        let mut first = Node::start(1, |ndl| ndl.period = Duration::from_secs(60)).await;
        let seed = first.udp();
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&second).await;
        let (node, incarnation) = (second.stores.node, Incarnation(1));
        let up = Input::Link(LinkFact::LinkUp { node, incarnation });
        lock(&first.stores).handle(Time::now(), up);
        first.end_layer();
        first.start_layer().await;
        second.end_layer();
        // when: it is refused in dial after dial, as it may have answered before it ended
        let stores = first.stores.clone();
        let refuses = async {
            loop {
                let refused = Event::Link(LinkFact::DialRefused { node, incarnation });
                stores.posts.ndl.post(refused).unwrap();
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        };
        // then
        tokio::select! {
            () = refuses => unreachable!("it goes on"),
            () = first.loses(&second, LossReason::Crashed) => {}
        }
    });
}

#[test]
fn a_later_instance_ends_the_former_one_and_takes_over() {
    run(async {
        let mut first = Node::start(1, |_| {}).await;
        let former = first.layer.take();
        first.start_layer().await;
        // The former one still holds the port; the later one has another, and is the one that is found.
        let seed = first.udp();
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        second.finds(&first).await;
        first.finds(&second).await;
        if let Some(former) = former {
            former.stop();
            former.join().unwrap();
        }
    });
}

#[test]
fn a_flood_of_rubbish_is_refused_and_keeps_nobody_out() {
    run(async {
        // given
        let mut first = Node::start(1, |_| {}).await;
        let target = first.udp();
        // when: garbage, cut frames and oversized datagrams, as fast as a thread can write them
        let flood = std::thread::spawn(move || {
            let socket = UdpSocket::bind((LOOPBACK, 0)).unwrap();
            for length in (0..30_000).map(|round| round % 1_400) {
                // A full buffer is what a flood is about.
                let _ = socket.send_to(&vec![b'S'; length], target);
            }
        });
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![target.into()]).await;
        // then
        second.finds(&first).await;
        first.finds(&second).await;
        flood.join().unwrap();
        assert!(lock(&first.stores).refusals().total() > 0);
    });
}

#[test]
fn a_group_that_cannot_be_joined_leaves_the_other_sources() {
    run(async {
        let no_group = SocketAddrV4::new(Ipv4Addr::new(203, 0, 113, 1), 9);
        let mut first = Node::start(1, |ndl| ndl.multicast = Some(no_group)).await;
        let seed = first.udp();
        let second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&second).await;
    });
}

#[test]
fn what_cannot_be_had_is_named_with_its_place_and_remedy() {
    let words = |node: &Node| super::actor::start_words(node.stores.clone()).unwrap_err();
    // A port that somebody has.
    let taken = UdpSocket::bind((LOOPBACK, 0)).unwrap();
    let port = taken.local_addr().unwrap().port();
    let said = words(&Node::new(1, 1, |ndl| ndl.port = port));
    assert!(said.contains(&format!("127.0.0.1:{port}")) && said.contains("`ndl.port`"), "{said}");
    assert!(said.contains("another node"), "{said}");
}

#[test]
fn an_address_that_this_host_does_not_have_yet_is_waited_for() {
    // 192.0.2.0/24 is for documentation: no host has it.
    let node = Node::new(1, 1, |ndl| ndl.interface = [192, 0, 2, 1].into());
    super::actor::start_words(node.stores.clone()).expect("it may come later");
}

#[cfg(target_os = "linux")]
#[test]
fn its_datagrams_are_marked_as_what_keeps_the_network_up_unless_marks_are_off() {
    for (marks, expected) in [(true, (48, 6)), (false, (0, 0))] {
        let mut config = NodeConfig::new("marked");
        config.gncl.marks = marks;
        let stores = Stores::for_test(config, Incarnation(1));
        stores.gncl_listen.get_or_init(|| (LOOPBACK, 1).into());
        super::actor::start_words(stores.clone()).expect("any free port");
        let kept = crate::stores::lock(&stores.ndl_sockets);
        let socket = socket2::SockRef::from(kept.all().next().expect("it is kept for the next instance"));
        let seen = (socket.tos_v4().expect("Linux tells") >> 2, socket.priority().expect("Linux tells"));
        assert_eq!(seen, expected, "with gncl.marks = {marks}");
    }
}
