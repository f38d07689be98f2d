//! Real NDL actors over the loopback interface, each test in a multicast group and on ports of its own.

mod keys;
mod mdns;
mod node;
mod remembered;
mod root;

use std::{
    net::{Ipv4Addr, SocketAddrV4, UdpSocket},
    sync::{
        Arc,
        atomic::{AtomicU8, Ordering},
    },
    time::Duration,
};

use actix::System;
use futures_util::StreamExt;
use sinew_model::{
    config::{NdlConfig, NodeConfig},
    events::{GnclEvent, SyncEvent},
    facts::{LinkFact, LossReason, MembershipFact, NodeEvent},
};
use sinew_runtime::{
    event_queue::EventQueue,
    router::LocalRoute,
    tid::{AppAddress, Incarnation, Tid},
    time::Time,
    wire::Payload,
};

use self::node::{Inbox, Node};
use super::{Event, Source, actor::lock_core, core::Input};
use crate::State;

const LOOPBACK: Ipv4Addr = Ipv4Addr::LOCALHOST;

async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    let waited = tokio::time::timeout(Duration::from_secs(60), future).await;
    waited.unwrap_or_else(|_| panic!("waited 60 s for {what}"))
}

/// Returns a UDP port that is free now.
fn free_port() -> u16 {
    UdpSocket::bind((LOOPBACK, 0)).unwrap().local_addr().unwrap().port()
}

/// Returns a group that no other test of this process uses, at a port that no other process uses.
fn own_group() -> SocketAddrV4 {
    static NEXT: AtomicU8 = AtomicU8::new(1);
    SocketAddrV4::new(Ipv4Addr::new(239, 255, 77, NEXT.fetch_add(1, Ordering::Relaxed)), free_port())
}

/// Disables every source of addresses.
fn alone(ndl: &mut NdlConfig) {
    ndl.multicast = None;
    ndl.mdns_port = None;
}

fn run(test: impl Future<Output = ()>) {
    System::new().block_on(test);
}

#[test]
fn nodes_find_each_other_by_multicast_alone() {
    run(async {
        let group = own_group();
        let mut first = Node::start(1, |ndl| ndl.multicast = Some(group)).await;
        let mut second = Node::start(2, |ndl| ndl.multicast = Some(group)).await;
        first.finds(&second).await;
        second.finds(&first).await;
        assert!(first.sources().contains(&Source::Multicast), "{:?}", first.sources());
        // One host has one clock: the measured offset is the error, and must be within its bound.
        let (node, incarnation) = (second.state.ctx.node, second.state.ctx.incarnation);
        let offset =
            first.state.ctx.clocks.get(node, incarnation).expect("measured before the fact is reported");
        assert!(offset.theirs_minus_ours_ns.unsigned_abs() as u128 <= offset.bound.as_nanos(), "{offset:?}");
    });
}

#[test]
fn nodes_find_each_other_by_one_seed_alone() {
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
fn nodes_find_each_other_by_mdns_alone() {
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
fn application_is_notified_of_found_and_silent_nodes() {
    run(async {
        // given
        let mut first = Node::start(1, |ndl| ndl.period = Duration::from_millis(50)).await;
        let seed = first.udp();
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&second).await;
        let found = first.event().await;
        assert_eq!(found.header.source, Tid::new(first.state.ctx.node, AppAddress::NDL));
        let (node, incarnation) = (second.state.ctx.node, Incarnation(1));
        let expected = NodeEvent::NodeFound { node, name: "node-2".to_owned(), incarnation };
        assert_eq!(found.decode::<NodeEvent>().unwrap(), expected);
        // when: it ends without a leave
        second.end_layer();
        // then
        first.loses(&second, LossReason::Crashed).await;
        let lost: NodeEvent = first.event().await.decode().unwrap();
        assert!(matches!(lost, NodeEvent::NodeLost { why: LossReason::Crashed, .. }), "{lost:?}");
        assert_eq!(first.state.ctx.clocks.get(node, incarnation), None);
    });
}

#[test]
fn silent_node_with_accepting_host_is_lost_as_hung() {
    run(async {
        // given: its GNCL listens, and accepts no connection
        let mut first = Node::start(1, |ndl| ndl.period = Duration::from_millis(50)).await;
        let listener = std::net::TcpListener::bind((LOOPBACK, 0)).unwrap();
        let seed = first.udp();
        let mut second = Node::new(2, 1, |ndl| ndl.seeds = vec![seed.into()]);
        second.state = {
            let state = State::for_test(second.state.ctx.config.clone(), Incarnation(1));
            state.ctx.listens.first.set(listener.local_addr().unwrap()).unwrap();
            state
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
fn stopped_node_leaves_and_restarts() {
    run(async {
        // given: a period so long that only the leave can be the cause
        let mut first = Node::start(1, |ndl| ndl.period = Duration::from_secs(60)).await;
        let seed = first.udp();
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&second).await;
        drop(first.event().await);
        second.finds(&first).await;
        // when
        second.state.ctx.stopping.store(true, Ordering::Relaxed);
        second.end_layer();
        // then
        first.loses(&second, LossReason::Left).await;
        drop(first.event().await);
        // when
        let third = Node::start_life(2, 2, |ndl| ndl.seeds = vec![seed.into()]).await;
        // then
        first.finds(&third).await;
        let clock = |number| first.state.ctx.clocks.get(third.state.ctx.node, Incarnation(number));
        assert!(clock(2).is_some() && clock(1).is_none(), "{:?}", [1, 2].map(clock));
        let event: NodeEvent = first.event().await.decode().unwrap();
        assert!(matches!(event, NodeEvent::NodeRestarted { incarnation: Incarnation(2), .. }), "{event:?}");
    });
}

#[test]
fn event_for_a_full_mailbox_is_delivered_later() {
    run(async {
        // given: room for one event
        let mut first = Node::start(1, |_| {}).await;
        let inbox = EventQueue::new(1);
        first.events = inbox.attach();
        let route = LocalRoute { sink: Arc::new(Inbox(inbox)), events: Arc::new([NodeEvent::KIND]) };
        first.state.ctx.router.set_local(AppAddress::new(0x1000), route);
        let seed = first.udp();
        let second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&second).await;
        let third = Node::start(3, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&third).await;
        // when
        within("the mailbox to refuse", async {
            while first.state.ctx.refusals.of("event not taken by an application") == 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
        // then
        for node in [second.state.ctx.node, third.state.ctx.node] {
            let event: NodeEvent = first.event().await.decode().unwrap();
            assert!(matches!(event, NodeEvent::NodeFound { node: found, .. } if found == node), "{event:?}");
        }
    });
}

#[test]
fn layers_with_full_queues_receive_changes_later() {
    run(async {
        // given
        let mut first = Node::start(1, |ndl| ndl.period = Duration::from_millis(200)).await;
        let event_queues = &first.state.ctx.event_queues;
        while event_queues.gncl.post(GnclEvent::DenyListChanged).is_ok() {}
        while event_queues.sync.post(SyncEvent::Monitors).is_ok() {}
        let mut told = event_queues.sync.attach();
        let seed = first.udp();
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        let mut third = Node::start(3, |ndl| ndl.seeds = vec![seed.into()]).await;
        drop([first.event().await, first.event().await]);
        second.end_layer();
        let lost: NodeEvent = first.event().await.decode().unwrap();
        assert!(matches!(lost, NodeEvent::NodeLost { .. }), "{lost:?}");
        assert!(first.state.ctx.refusals.of("a layer's event queue is full") > 0);
        // when: both layers continue to read
        let (mut to_gncl, mut to_sync) = (Vec::new(), Vec::new());
        within("both layers to be told of both nodes", async {
            while to_gncl.len() < 2 || to_sync.len() < 2 {
                tokio::select! {
                    Some(event) = first.facts.next(), if to_gncl.len() < 2 => {
                        if let GnclEvent::Membership(fact) = event { to_gncl.push(fact) }
                    }
                    Some(event) = told.next(), if to_sync.len() < 2 => {
                        if let SyncEvent::Membership(fact) = event { to_sync.push(fact) }
                    }
                }
            }
        })
        .await;
        // then: the second node was found and lost
        let has_lost = |facts: &[MembershipFact]| {
            let lost = |fact: &MembershipFact| matches!(fact, MembershipFact::NodeLost { node, .. } if *node == second.state.ctx.node);
            facts.iter().any(lost)
        };
        let has_found = |facts: &[MembershipFact]| {
            let found = |fact: &MembershipFact| matches!(fact, MembershipFact::NodeFound { node, .. } if *node == third.state.ctx.node);
            facts.iter().any(found)
        };
        assert!(has_lost(&to_gncl) && has_lost(&to_sync), "{to_gncl:?} {to_sync:?}");
        assert!(has_found(&to_gncl) && has_found(&to_sync), "{to_gncl:?} {to_sync:?}");
        third.end_layer();
    });
}

#[test]
fn restart_of_a_layer_is_invisible_to_others() {
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
        // then: the next event of either is a third node
        assert_eq!(second.udp(), before);
        let seeds = vec![seed.into(), before.into()];
        let third = Node::start(3, |ndl| ndl.seeds = seeds).await;
        first.finds(&third).await;
        second.finds(&third).await;
        assert_eq!(lock_core(&second.state).members(Time::now()).len(), 2);
    });
}

#[test]
fn refused_dial_after_restarts_is_a_crash() {
    run(async {
        // given: a link was up, without a report since, and a period so long that only the refusal can be the cause
        let mut first = Node::start(1, |ndl| ndl.period = Duration::from_secs(60)).await;
        let seed = first.udp();
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&second).await;
        let (node, incarnation) = (second.state.ctx.node, Incarnation(1));
        let up = Input::Link(LinkFact::LinkUp { node, incarnation });
        lock_core(&first.state).handle(Time::now(), up);
        first.end_layer();
        first.start_layer().await;
        second.end_layer();
        // when: dial after dial is refused, as the node may have answered before it ended
        let state = first.state.clone();
        let refuses = async {
            loop {
                let refused = Event::Link(LinkFact::DialRefused { node, incarnation });
                state.ctx.event_queues.ndl.post(refused).unwrap();
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
fn later_instance_ends_the_former_one_and_takes_over() {
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
fn flood_of_garbage_keeps_no_node_out() {
    run(async {
        // given
        let mut first = Node::start(1, |_| {}).await;
        let target = first.udp();
        // when: garbage, truncated frames and oversized datagrams arrive, as fast as a thread can write them
        let flood = std::thread::spawn(move || {
            let socket = UdpSocket::bind((LOOPBACK, 0)).unwrap();
            for length in (0..30_000).map(|round| round % 1_400) {
                // A full buffer is part of a flood.
                let _ = socket.send_to(&vec![b'S'; length], target);
            }
        });
        let mut second = Node::start(2, |ndl| ndl.seeds = vec![target.into()]).await;
        // then
        second.finds(&first).await;
        first.finds(&second).await;
        flood.join().unwrap();
        assert!(lock_core(&first.state).refusals().total() > 0);
    });
}

#[test]
fn unjoinable_group_leaves_the_other_sources() {
    run(async {
        let no_group = SocketAddrV4::new(Ipv4Addr::new(203, 0, 113, 1), 9);
        let mut first = Node::start(1, |ndl| ndl.multicast = Some(no_group)).await;
        let seed = first.udp();
        let second = Node::start(2, |ndl| ndl.seeds = vec![seed.into()]).await;
        first.finds(&second).await;
    });
}

#[test]
fn unavailable_resource_is_named_with_place_and_remedy() {
    let words = |node: &Node| super::actor::start_words(node.state.clone()).unwrap_err();
    // A port that is already bound.
    let taken = UdpSocket::bind((LOOPBACK, 0)).unwrap();
    let port = taken.local_addr().unwrap().port();
    let error = words(&Node::new(1, 1, |ndl| ndl.port = port));
    assert!(error.contains(&format!("127.0.0.1:{port}")) && error.contains("`ndl.port`"), "{error}");
    assert!(error.contains("another node"), "{error}");
}

#[test]
fn missing_address_of_this_host_is_waited_for() {
    // 192.0.2.0/24 is for documentation: no host has it.
    let node = Node::new(1, 1, |ndl| ndl.interface = [192, 0, 2, 1].into());
    super::actor::start_words(node.state.clone()).expect("it may come later");
}

#[cfg(target_os = "linux")]
#[test]
fn datagrams_are_marked_as_network_control_unless_disabled() {
    for (marks, expected) in [(true, (48, 6)), (false, (0, 0))] {
        let mut config = NodeConfig::new("marked");
        config.gncl.marks = marks;
        let state = State::for_test(config, Incarnation(1));
        state.ctx.listens.first.get_or_init(|| (LOOPBACK, 1).into());
        super::actor::start_words(state.clone()).expect("any free port");
        let kept = sinew_runtime::lock(&state.sockets);
        let socket = socket2::SockRef::from(kept.all().next().expect("it is kept for the next instance"));
        let seen =
            (socket.tos_v4().expect("Linux reports it") >> 2, socket.priority().expect("Linux reports it"));
        assert_eq!(seen, expected, "with gncl.marks = {marks}");
    }
}
