//! Direct links of tasks: with each other, and with threads.

use std::{
    cell::Cell,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use futures_util::poll;
use sinew_lncl::testing::{TestNode, WATCHDOG};
use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    time::Time,
    wire::{Class, HEADER_LEN},
};
use sinew_shm::{Armed, Spin};
use tokio::time::timeout;

use super::{RAW, number_of, numbered, runtime};
use crate::{
    AsyncEndpoint, DirectLinks, Endpoint, NodeApi, Registration,
    direct::{Room, Sent},
    incoming::WhenFull,
    node_link::NodeLink,
    reactor::Until,
    wait_mode::WaitMode,
};

fn with_links() -> Registration {
    Registration::new().direct(DirectLinks::Always).stall_timeout(WATCHDOG)
}

async fn task(node: &TestNode) -> AsyncEndpoint {
    task_with(node, with_links()).await
}

async fn task_with(node: &TestNode, request: Registration) -> AsyncEndpoint {
    let api = NodeApi::connect(node.path()).unwrap();
    api.register_transport_address_async(request).await.unwrap()
}

fn has_link(from: &Endpoint, to: Tid) -> bool {
    from.direct.open.iter().any(|link| link.peer == to)
}

async fn send(from: &mut AsyncEndpoint, to: Tid, number: u64, length: usize) {
    let mut message = from.create_message(to, RAW, length).unwrap();
    message.set_class(Class::Bulk);
    message[..8].copy_from_slice(&number.to_le_bytes());
    from.loaned(message).send().await.unwrap();
}

/// Two tasks, each with an open link with the other.
async fn linked(node: &TestNode) -> (AsyncEndpoint, AsyncEndpoint) {
    linked_with(node, with_links()).await
}

async fn linked_with(node: &TestNode, first: Registration) -> (AsyncEndpoint, AsyncEndpoint) {
    let (mut one, mut other) = (task_with(node, first).await, task(node).await);
    let (to, back) = (other.tid(), one.tid());
    send(&mut one, to, 0, 8).await;
    let deadline = Time::now() + WATCHDOG;
    while !(has_link(&one.endpoint, to) && has_link(&other.endpoint, back)) {
        assert!(Time::now() < deadline, "waited for a link");
        for endpoint in [&mut one, &mut other] {
            let _ = timeout(Duration::from_millis(1), endpoint.receive()).await;
        }
    }
    (one, other)
}

#[test]
fn two_tasks_communicate_directly_without_the_node() {
    let node = TestNode::start();
    runtime().block_on(async {
        let (mut one, mut other) = linked(&node).await;
        // The node has no route to either of them any more.
        for tid in [one.tid(), other.tid()] {
            node.router().remove_local(tid.app);
        }
        let to = other.tid();
        let echo = async {
            for _ in 0..100 {
                let request = timeout(WATCHDOG, other.receive()).await.expect("a request").unwrap();
                let reply = other.create_message(request.source(), RAW, 8).unwrap();
                other.loaned(reply).reply_to(&request).await.unwrap();
            }
        };
        let ask = async {
            for _ in 0..100 {
                let request = one.create_message(to, RAW, 8).unwrap();
                assert!(request.is_in_place());
                drop(one.loaned(request).ask_raw(WATCHDOG).await.unwrap());
            }
        };
        tokio::join!(echo, ask);
    });
}

#[test]
fn tasks_and_threads_have_links_with_each_other() {
    let node = TestNode::start();
    let mut blocking =
        NodeApi::connect(node.path()).unwrap().register_transport_address(with_links()).unwrap();
    let thread_tid = blocking.tid();
    let thread_has_link = Arc::new(AtomicBool::new(false));
    let seen_by_thread = thread_has_link.clone();
    let thread = thread::spawn(move || {
        while let Some(request) = blocking.receive(WATCHDOG).unwrap() {
            if has_link(&blocking, request.source()) {
                seen_by_thread.store(true, Ordering::SeqCst);
            }
            if !request.wants_reply() {
                return;
            }
            let reply = blocking.create_message(request.source(), RAW, 8).unwrap();
            blocking.loaned(reply).reply_to(&request).unwrap();
        }
        panic!("the last word did not come");
    });
    runtime().block_on(async {
        let mut endpoint = task(&node).await;
        let deadline = Time::now() + WATCHDOG;
        let has_both = |endpoint: &AsyncEndpoint| {
            has_link(&endpoint.endpoint, thread_tid) && thread_has_link.load(Ordering::SeqCst)
        };
        while !has_both(&endpoint) {
            assert!(Time::now() < deadline, "waited for a link in each direction");
            let request = endpoint.create_message(thread_tid, RAW, 8).unwrap();
            drop(endpoint.loaned(request).ask_raw(WATCHDOG).await.unwrap());
        }
        send(&mut endpoint, thread_tid, 0, 8).await;
    });
    thread.join().unwrap();
}

#[test]
fn tasks_filling_each_others_rings_lose_nothing() {
    const COUNT: u64 = 200;
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 16_384);
    runtime().block_on(async {
        let (mut one, mut other) = linked(&node).await;
        let (to, back) = (other.tid(), one.tid());
        drain(&mut one).await;
        drain(&mut other).await;
        // Each sends before it receives, so that both rings are full at times; some are longer than a ring.
        let turn = async |endpoint: &mut AsyncEndpoint, to: Tid, next: &Cell<u64>| {
            for number in 0..COUNT {
                send(endpoint, to, number, if number % 16 == 0 { 40_000 } else { 1_000 }).await;
                while number >= next.get() + 40 {
                    expect_next(endpoint, next).await;
                }
            }
            while next.get() < COUNT {
                expect_next(endpoint, next).await;
            }
        };
        let (first, second) = (Cell::new(0), Cell::new(0));
        let both = async { tokio::join!(turn(&mut one, to, &first), turn(&mut other, back, &second)) };
        timeout(WATCHDOG * 2, both).await.expect("both end");
        assert!(has_link(&one.endpoint, to), "the link stands");
    });
}

async fn drain(endpoint: &mut AsyncEndpoint) {
    while timeout(Duration::from_millis(30), endpoint.receive()).await.is_ok() {}
}

async fn expect_next(endpoint: &mut AsyncEndpoint, next: &Cell<u64>) {
    let received = endpoint.receive().await.unwrap();
    assert_eq!(number_of(received.bytes()), next.get());
    next.set(next.get() + 1);
}

/// Sends until the ring is full; returns the room that a sender would wait for then.
fn fill(from: &mut AsyncEndpoint, to: Tid) -> Room {
    let direct = &mut from.endpoint.direct;
    let link = direct.link_to(to).expect("a link");
    for number in 0..10_000 {
        let message = numbered(number, 1_000, from.endpoint.tid, to);
        match direct.send(link, message.into(), Time::now()).unwrap() {
            Sent::Taken => {}
            Sent::Full(_) => return Room { link, length: HEADER_LEN + 1_000, class: Class::Bulk },
            Sent::Begun | Sent::Gone(_) => panic!("it fits, and the peer lives"),
        }
    }
    panic!("the ring takes no end of messages");
}

#[test]
fn peer_read_wakes_task_waiting_for_room() {
    for spin in [Spin::Off, Spin::For(10 * WATCHDOG)] {
        room_wakes_task(spin);
    }
}

fn room_wakes_task(spin: Spin) {
    let node = TestNode::start();
    runtime().block_on(async {
        // given
        let (mut one, mut other) = linked_with(&node, with_links().spin(spin)).await;
        drain(&mut other).await;
        drain(&mut one).await;
        let room = fill(&mut one, other.tid());
        let Endpoint { wait_mode, node: NodeLink { reader, writer, .. }, direct, .. } = &mut one.endpoint;
        let WaitMode::Async(reactor) = wait_mode else { unreachable!("it is a task's") };
        // when: no timer ends it
        let until = Until { deadline: Time::MAX, room: Some(room) };
        let mut waiting = Box::pin(reactor.wait(reader, writer, direct, until));
        assert!(poll!(&mut waiting).is_pending(), "there is no room");
        drop(other.receive().await.unwrap());
        // then
        timeout(WATCHDOG, &mut waiting).await.expect("it is rung for room, however long it spins");
        drop(waiting);
        assert_eq!(direct.arm_room(room), Armed::Ready);
    });
}

#[test]
fn task_waiting_for_room_sleeps_despite_full_inbox() {
    let node = TestNode::start();
    runtime().block_on(async {
        // given: both rings are full, and the inbox of one endpoint is full
        let (mut one, mut other) = linked(&node).await;
        drain(&mut other).await;
        drain(&mut one).await;
        let (room, back) = (fill(&mut one, other.tid()), one.tid());
        while one.endpoint.inbox.has_room() {
            fill(&mut other, back);
            one.endpoint.poll_incoming(None, WhenFull::Leave, Time::now()).unwrap();
        }
        fill(&mut other, back);
        // when
        let now = Time::now();
        let mut waiting = Box::pin(one.endpoint.wait_for_room(room, now + WATCHDOG, now));
        // then
        assert!(poll!(&mut waiting).is_pending(), "it would go round and round");
    });
}

#[test]
fn peer_end_ends_its_requests_and_reroutes_the_rest() {
    let node = TestNode::start();
    runtime().block_on(async {
        let (mut one, mut other) = linked(&node).await;
        drain(&mut other).await;
        let to = other.tid();
        let asking = async {
            let message = one.create_message(to, RAW, 8).unwrap();
            let first = one.loaned(message).confirmed(WATCHDOG).await.unwrap();
            let message = one.create_message(to, RAW, 8).unwrap();
            (first, one.loaned(message).confirmed(WATCHDOG).await.unwrap())
        };
        let dying = async {
            // The message stays in hand forever, and the endpoint is gone.
            std::mem::forget(other.receive().await.unwrap());
            drop(other);
        };
        let (outcomes, ()) = tokio::join!(asking, dying);
        assert_eq!(outcomes, (Outcome::Unknown, Outcome::Rejected(Rejection::NoSuchApplication)));
    });
}
