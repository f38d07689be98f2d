//! Rings without room, long messages, and the bounds on links and their memory.

use sinew_protocol::payload::{self, Gone};
use sinew_runtime::{
    tid::Tid,
    wire::{HEADER_LEN, Header, Message},
};
use sinew_shm::Armed;

use super::*;
use crate::{
    direct::{
        ReorderDecision, Room,
        budget::Budget,
        peer_fd::{CLOSING_MAX, DeferredClose},
        reorder::ReorderBuffer,
    },
    routes::LINKS_MAX,
};

#[test]
fn newest_stream_value_waits_for_ring_room() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    // No endpoint reads meanwhile, and no send waits.
    for number in 1..=1_000 {
        one.send(other.tid(), &Setpoint(number)).unwrap();
    }
    let mut last = 0;
    let deadline = Time::now() + WATCHDOG;
    while last < 1_000 {
        assert!(Time::now() < deadline, "waited for the newest value; the last was {last}");
        drop(one.receive(Duration::ZERO).unwrap());
        let Some(received) = other.receive(Duration::from_millis(1)).unwrap() else { continue };
        let Setpoint(number) = received.decode().unwrap();
        assert!(number > last, "{number} came after {last}");
        last = number;
    }
}

/// Sends values until one waits for room in the ring.
fn fill(from: &mut Endpoint, to: Tid) -> u64 {
    for number in 1.. {
        from.send(to, &Setpoint(number)).unwrap();
        if from.direct.open[0].has_pending() {
            return number;
        }
    }
    unreachable!("a ring takes no end of values")
}

#[test]
fn other_kind_does_not_overtake_waiting_value() {
    // given: a value that waits, and room for it
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let last = fill(&mut one, other.tid());
    while other.receive(Duration::from_millis(1)).unwrap().is_some() {}
    // when
    one.direct.next_flush = Time::MAX;
    one.send(other.tid(), &Mode(1)).unwrap();
    // then
    let first = other.receive(WATCHDOG).unwrap().expect("a value");
    assert_eq!(first.decode::<Setpoint>().ok(), Some(Setpoint(last)));
    let second = other.receive(WATCHDOG).unwrap().expect("a value");
    assert_eq!(second.decode::<Mode>().ok(), Some(Mode(1)));
}

#[test]
fn short_command_does_not_wait_for_long_value() {
    // given: a long value that waits, and room for a short message
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    while !one.direct.open[0].has_pending() {
        one.send(other.tid(), &Picture("long".repeat(250))).unwrap();
    }
    let link = one.direct.open[0].number;
    let mut arm = |class| {
        let room = Room { link, length: HEADER_LEN + 8, class };
        let armed = one.direct.arm_room(room);
        one.direct.disarm_room(room);
        armed
    };
    // then
    assert_eq!([Class::Control, Class::Bulk].map(&mut arm), [Armed::Ready; 2]);
    assert_eq!(arm(Class::Stream), Armed::Sleep, "values keep their order");
}

#[test]
fn waiting_value_counts_as_undelivered_at_link_end() {
    // given
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let to = other.tid();
    fill(&mut one, to);
    // when: it reads nothing, and the node reports that it is dead
    let gone = Gone { peer: to.bits(), number: one.direct.open[0].number.0 };
    let lncl = payload::lncl_of(node.address());
    node.router().send(payload::frame(Kind::LNCL_GONE, lncl, one.tid(), &gone)).unwrap();
    let deadline = Time::now() + WATCHDOG;
    while !one.direct.open.is_empty() {
        assert!(Time::now() < deadline, "waited for the end of the link");
        drop(one.receive(Duration::from_millis(1)).unwrap());
    }
    // then
    let undelivered = one.take_undelivered().expect("something was lost");
    assert_eq!((undelivered.destination, undelivered.why, undelivered.count), (to, Rejection::Closed, 1));
}

#[test]
fn stuck_peer_costs_stall_timeout_but_not_link() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let mut one = register(&node, with_links().stall_timeout(Duration::from_millis(10)));
    let mut other = endpoint(&node);
    link(&mut one, &mut other);
    let mut taken = 0;
    let stalled = loop {
        match one.send(other.tid(), &Counted(taken)) {
            Ok(()) => taken += 1,
            Err(error) => break error,
        }
        assert!(taken < 4_096, "a ring of 4,096 bytes takes no end of messages");
    };
    assert!(matches!(stalled, ApiError::Stalled(_)), "{stalled}");
    for number in 0..taken {
        let received = other.receive(WATCHDOG).unwrap().expect("what was taken comes");
        assert_eq!(received.decode::<Counted>().unwrap(), Counted(number));
    }
    one.send(other.tid(), &Counted(taken)).unwrap();
    assert!(other.receive(WATCHDOG).unwrap().is_some());
}

#[test]
fn long_message_is_split_for_short_ring() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let to = other.tid();
    let kind = Kind::named("test.long");
    let sending = thread::spawn(move || {
        let mut buffer = one.create_message(to, kind, 100_000).unwrap();
        buffer.fill(7);
        one.loaned(buffer).send().unwrap();
        one
    });
    let received = other.receive(WATCHDOG).unwrap().expect("a message");
    assert!(received.bytes().len() == 100_000 && received.bytes().iter().all(|byte| *byte == 7));
    sending.join().unwrap();
}

#[test]
fn mutual_waits_for_room_read_meanwhile() {
    // given: rings that hold a fraction of the messages that each sends before it receives anything
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let wanted = || with_links().stall_timeout(WATCHDOG / 2);
    let (mut one, mut other) = (register(&node, wanted()), register(&node, wanted()));
    link(&mut one, &mut other);
    let (one_tid, other_tid, number) = (one.tid(), other.tid(), one.direct.open[0].number);
    // when
    let exchange = |endpoint: &mut Endpoint, to| {
        for _ in 0..20 {
            let long = endpoint.create_message(to, Kind::named("test.long"), 20_000).unwrap();
            endpoint.loaned(long).send().unwrap();
        }
        for _ in 0..20 {
            assert_eq!(endpoint.receive(WATCHDOG).unwrap().expect("a message").bytes().len(), 20_000);
        }
    };
    thread::scope(|scope| {
        scope.spawn(|| exchange(&mut one, other_tid));
        exchange(&mut other, one_tid);
    });
    // then
    assert_eq!(one.direct.open[0].number, number, "no sender stalled within a frame");
}

fn send_long(from: &mut Endpoint, to: Tid, length: usize) -> Result<(), ApiError> {
    let mut long = from.create_message(to, Kind::named("test.long"), length).unwrap();
    long.fill(7);
    from.loaned(long).send()
}

#[test]
fn timed_out_long_message_delivers_nothing() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let mut one = register(&node, with_links().stall_timeout(Duration::from_millis(1)));
    let mut other = endpoint(&node);
    link(&mut one, &mut other);
    let to = other.tid();
    // With some of these lengths there is no room left to withdraw the message.
    for length in (0..1_100).step_by(8) {
        // when: the peer does not read
        let mut sent = Vec::new();
        send_long(&mut one, to, length).unwrap();
        sent.push(length);
        let refused = send_long(&mut one, to, 20_000).unwrap_err();
        assert!(matches!(refused, ApiError::Stalled(_)), "{refused}");
        while send_long(&mut one, to, 1).is_ok() {
            sent.push(1);
        }
        // then
        for length in sent {
            let received = other.receive(WATCHDOG).unwrap().expect("what was sent comes");
            assert_eq!(received.bytes().len(), length);
        }
        assert!(other.receive(Duration::ZERO).unwrap().is_none());
    }
    assert!(has_link(&one, &other) && has_link(&other, &one), "the link has not ended");
}

#[test]
fn exit_after_timed_out_message_keeps_accepted_ones() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let mut one = register(&node, with_links().stall_timeout(Duration::from_millis(10)));
    let mut other = endpoint(&node);
    link(&mut one, &mut other);
    let mut sent = 0;
    while sent < 4 {
        one.send(other.tid(), &Counted(sent)).unwrap();
        sent += 1;
    }
    send_long(&mut one, other.tid(), 20_000).unwrap_err();
    // when
    drop(one);
    // then
    let mut received = 0;
    let deadline = Time::now() + WATCHDOG;
    loop {
        // The call that sees the end of the link may have read several messages before.
        match other.receive(Duration::from_millis(1)).unwrap() {
            Some(next) => {
                assert_eq!(next.decode::<Counted>().unwrap(), Counted(received));
                received += 1;
            }
            None if other.direct.open.is_empty() => break,
            None => assert!(Time::now() < deadline, "waited for the end of the link to be seen"),
        }
    }
    assert_eq!(received, sent);
}

#[test]
fn long_message_cut_by_link_end_is_delivered_once() {
    // given
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let mut one = register(&node, with_links().stall_timeout(WATCHDOG / 2));
    let mut other = endpoint(&node);
    link(&mut one, &mut other);
    let (to, peer) = (other.tid(), one.tid());
    let sending = thread::spawn(move || {
        send_long(&mut one, to, 20_000).unwrap();
        one
    });
    let link = &mut other.direct.open[0];
    let deadline = Time::now() + WATCHDOG;
    while !link.has_unsorted() {
        assert!(Time::now() < deadline, "waited for the first piece");
        thread::sleep(Duration::from_millis(1));
    }
    // when
    let number = link.number;
    other.direct.end(peer, number, Time::now());
    // then
    let received = other.receive(WATCHDOG).unwrap().expect("a message");
    assert!(received.bytes().len() == 20_000 && received.bytes().iter().all(|byte| *byte == 7));
    drop(received);
    let mut one = sending.join().unwrap();
    one.send(to, &Counted(1)).unwrap();
    assert_eq!(other.receive(WATCHDOG).unwrap().expect("a message").decode::<Counted>().unwrap(), Counted(1));
}

#[test]
fn newest_stream_value_arrives_despite_sender_exit() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let mut one = register(&node, with_links().stall_timeout(WATCHDOG));
    let mut other = endpoint(&node);
    link(&mut one, &mut other);
    for number in 1..=1_000 {
        one.send(other.tid(), &Setpoint(number)).unwrap();
    }
    // when
    let going = thread::spawn(move || one.unregister().unwrap());
    // then
    let deadline = Time::now() + WATCHDOG;
    let mut last = 0;
    while last < 1_000 {
        assert!(Time::now() < deadline, "waited for the newest value; the last was {last}");
        let Some(received) = other.receive(Duration::from_millis(1)).unwrap() else { continue };
        let Setpoint(number) = received.decode().unwrap();
        assert!(number > last, "{number} came after {last}");
        last = number;
    }
    going.join().unwrap();
}

#[test]
fn messages_beyond_link_limit_go_through_node() {
    let node = TestNode::start_with(|config| {
        config.lncl.ring_bytes = 4_096;
        // All of them are in this process.
        config.lncl.clients_per_process_max = 256;
    });
    let mut hub = endpoint(&node);
    let mut others: Vec<_> = (0..=LINKS_MAX).map(|_| endpoint(&node)).collect();
    let deadline = Time::now() + WATCHDOG * 3;
    while hub.direct.open.len() < LINKS_MAX {
        assert!(Time::now() < deadline, "waited for {LINKS_MAX} links; there are {}", hub.direct.open.len());
        for other in &mut others {
            hub.send(other.tid(), &Counted(1)).unwrap();
            drop(other.receive(Duration::ZERO).unwrap());
            drop(hub.receive(Duration::ZERO).unwrap());
        }
    }
    for other in &mut others {
        hub.send(other.tid(), &Urgent(9)).unwrap();
        while other.receive(WATCHDOG).unwrap().expect("a message").kind() != Urgent::KIND {}
    }
    assert_eq!(hub.direct.open.len(), LINKS_MAX);
}

#[test]
fn messages_beyond_ring_budget_go_through_node() {
    let node = TestNode::start();
    let (mut one, mut other, mut third) = (endpoint(&node), endpoint(&node), endpoint(&node));
    // given: room for one ring of either endpoint
    let budgets = [&mut one, &mut other].map(|endpoint| {
        let budget = Box::leak(Box::new(Budget::new(endpoint.direct.terms.ring_bytes * 3 / 2)));
        endpoint.direct.terms.budget = budget;
        &*budget
    });
    link(&mut one, &mut other);
    assert!(budgets[0].held() > 0 && budgets[1].held() > 0);
    // when
    for _ in 0..20 {
        one.send(third.tid(), &Counted(1)).unwrap();
        drop(third.receive(WATCHDOG).unwrap().expect("a message"));
        third.send(other.tid(), &Counted(1)).unwrap();
        drop(other.receive(WATCHDOG).unwrap().expect("a message"));
    }
    // then
    assert_eq!((one.direct.open.len(), other.direct.open.len()), (1, 1));
    assert!(third.direct.is_empty());
    drop(one);
    let deadline = Time::now() + WATCHDOG;
    while !other.direct.is_empty() {
        assert!(Time::now() < deadline, "waited for the end of the link");
        assert!(other.receive(Duration::from_millis(1)).unwrap().is_none());
    }
    assert_eq!(budgets.map(Budget::held), [0, 0], "a link returns its share");
}

// spec: LNCL-18
#[test]
fn no_new_links_while_all_closing_threads_are_busy() {
    let node = TestNode::start();
    let (mut one, mut third) = (endpoint(&node), endpoint(&node));
    let [mut asked, mut asking] = [endpoint(&node), endpoint(&node)];
    // Given: an endpoint with all closing threads busy.
    let closing: &DeferredClose = Box::leak(Box::new(DeferredClose::new(CLOSING_MAX)));
    one.direct.terms.closing = closing;
    // When: it sends, and is sent to.
    for _ in 0..20 {
        one.send(third.tid(), &Counted(1)).unwrap();
        drop(third.receive(WATCHDOG).unwrap().expect("a message"));
        third.send(one.tid(), &Counted(1)).unwrap();
        drop(one.receive(WATCHDOG).unwrap().expect("a message"));
    }
    // Then: all messages go through the node.
    assert!(one.direct.is_empty() && third.direct.is_empty());
    // When: one of the threads is done.
    closing.done();
    // Then:
    link(&mut one, &mut asked);
    link(&mut asking, &mut one);
}

#[test]
fn stuck_peer_costs_stall_timeout_only_once() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let stall_timeout = WATCHDOG / 30;
    let mut one = register(&node, with_links().stall_timeout(stall_timeout));
    let (mut other, mut third) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    while one.send(other.tid(), &Counted(1)).is_ok() {}
    // when
    let deadline = Time::now() + WATCHDOG;
    for number in 0..100 {
        assert!(
            Time::now() < deadline,
            "{number} messages were refused, and each after the sender's stall_timeout"
        );
        let refused = one.send(other.tid(), &Counted(2)).unwrap_err();
        assert!(matches!(refused, ApiError::Stalled(_)), "{refused}");
        // then: others are served
        one.send(third.tid(), &Counted(number)).unwrap();
        assert_eq!(
            third.receive(WATCHDOG).unwrap().expect("a message").decode::<Counted>().unwrap(),
            Counted(number)
        );
    }
    // It reads again, and sends wait for it again.
    while let Some(received) = other.receive(Duration::ZERO).unwrap() {
        drop(received);
    }
    one.send(other.tid(), &Counted(3)).unwrap();
    assert_eq!(other.receive(WATCHDOG).unwrap().expect("a message").decode::<Counted>().unwrap(), Counted(3));
}

#[test]
fn messages_waiting_for_ring_end_are_bounded_in_bytes() {
    const LENGTH: usize = 64 << 10;
    // given: an endpoint where messages through the node follow the messages in its ring
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let number = other.direct.open[0].number;
    other.direct.reordered.insert(one.tid(), ReorderBuffer::after(number));
    // when
    let payload = bytes::Bytes::from(vec![0; LENGTH]);
    let mut keep = || {
        let header = Header::new(Counted::KIND, one.tid(), other.tid());
        other.direct.reorder(Message::new(header, payload.clone()))
    };
    let kept = (0..1_000).take_while(|_| matches!(keep(), ReorderDecision::Kept)).count();
    // then
    assert_eq!(kept * LENGTH, 4 << 20);
    assert!(matches!(keep(), ReorderDecision::Refuse(_)));
}

/// Receives until messages of all three sources have come, each of which has more than the inbox has room for.
#[test]
fn flood_of_one_source_does_not_keep_others_waiting() {
    for capacity in [1, 4] {
        // Given: many messages from the node's side, and on each of two links
        let node = TestNode::start();
        let mut other = register(&node, with_links().inbox_capacity(capacity));
        let mut peers = [endpoint(&node), endpoint(&node)];
        let app = node.local(1);
        for peer in &mut peers {
            link(peer, &mut other);
        }
        for number in 0..40 {
            node.router().send(Message::typed(app.tid, other.tid(), &Counted(number))).unwrap();
            for peer in &mut peers {
                peer.send(other.tid(), &Counted(number)).unwrap();
            }
        }
        // When: some are received. Then: some of each source are among them.
        let mut sources = std::collections::BTreeMap::new();
        for _ in 0..40 {
            let received = other.receive(WATCHDOG).unwrap().expect("a message");
            *sources.entry(received.source()).or_insert(0) += 1;
        }
        assert!(sources.len() == 3 && sources.values().all(|count| *count >= 5), "{capacity}: {sources:?}");
    }
}
