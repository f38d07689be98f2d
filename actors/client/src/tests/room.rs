//! A send without room: the length of its wait, and its remains.

use std::{thread, time::Duration};

use super::{
    ApiError, Kind, TestNode, Transport, WATCHDOG,
    forms::{self, Client, Under},
    played_node::PlayedNode,
};

const RAW: Kind = Kind::named("test.raw");
/// More than a socket's buffer and both rings hold.
const LONG: usize = 1 << 20;
const SHORT: usize = 1_000;
const NO_TIME: Duration = Duration::ZERO;

on_every_transport! {
    stall_timeout_restarts_with_node_progress
    stalled_long_message_is_whole_or_absent
    zero_limit_fails_at_once_and_sends_nothing
    long_message_with_zero_limit_is_whole_or_absent
    send_waits_for_room_up_to_its_limit
    answer_deadline_also_limits_wait_for_room
    stall_timeout_is_spent_once_until_node_reads
    own_limit_does_not_restore_spent_stall_timeout
    unregister_ends_despite_endless_stall_timeout
    values_and_replies_accept_a_limit
    unregister_waits_until_sent_messages_are_written
}

fn register(under: Under, node: &PlayedNode, stall_timeout: Duration) -> Client {
    let registration = super::on(under).stall_timeout(stall_timeout);
    forms::Api::at(under, &node.path()).register(registration).unwrap()
}

fn message(from: &mut Client, number: u64, length: usize) -> forms::Loaned {
    let mut message = from.create_message(PlayedNode::remote_app(), RAW, length).unwrap();
    message[..8].copy_from_slice(&number.to_le_bytes());
    message
}

fn number_of(node: &PlayedNode, length: usize) -> u64 {
    let message = node.next();
    assert_eq!(message.payload.len(), length);
    u64::from_le_bytes(*message.payload.first_chunk().unwrap())
}

/// Sends without waiting until there is no room; how many were taken.
fn fill(from: &mut Client, length: usize) -> u64 {
    for number in 0.. {
        let message = message(from, number, length);
        match from.loaned(message).room_within(NO_TIME).send() {
            Ok(()) => {}
            Err(ApiError::Stalled(waited)) => {
                assert_eq!(waited, NO_TIME);
                return number;
            }
            Err(other) => panic!("{other}"),
        }
    }
    unreachable!("a queue without an end")
}

fn stall_timeout_restarts_with_node_progress(under: Under) {
    const STALL_TIMEOUT: Duration = Duration::from_secs(2);
    let node = PlayedNode::start();
    let mut client = register(under, &node, STALL_TIMEOUT);
    // given: a node that reads a little of a message again and again, for longer than the stall timeout
    let long = message(&mut client, 1, LONG);
    let sending = thread::spawn(move || {
        client.loaned(long).send().unwrap();
        client
    });
    let began = std::time::Instant::now();
    while began.elapsed() < STALL_TIMEOUT * 5 / 4 {
        thread::sleep(STALL_TIMEOUT / 10);
        node.take(LONG / 40);
    }
    // when: it reads the rest
    node.take_all();
    // then: it is sent, and so is the next one
    let mut client = sending.join().unwrap();
    assert_eq!(number_of(&node, LONG), 1);
    let next = message(&mut client, 2, SHORT);
    client.loaned(next).send().unwrap();
    assert_eq!(number_of(&node, SHORT), 2);
}

fn stalled_long_message_is_whole_or_absent(under: Under) {
    let node = PlayedNode::start();
    let mut client = register(under, &node, Duration::from_millis(50));
    // given: a node that reads nothing
    let long = message(&mut client, 1, LONG);
    let is_sent = match client.loaned(long).send() {
        Ok(()) => true,
        Err(ApiError::Stalled(_)) => false,
        Err(other) => panic!("{other}"),
    };
    assert_eq!(is_sent, under.transport == Transport::Socket, "from a ring it is withdrawn");
    let refused = message(&mut client, 2, SHORT);
    let error = client.loaned(refused).send().unwrap_err();
    assert!(matches!(error, ApiError::Stalled(_)), "{error}");
    assert!(node.next_now().is_none());
    // when: it reads again, and the client does nothing but receive
    node.take_all();
    if is_sent {
        let arrived = loop {
            assert!(client.receive(Duration::from_millis(1)).unwrap().is_none());
            if let Some(arrived) = node.next_now() {
                break arrived;
            }
        };
        assert_eq!((arrived.payload.len(), arrived.payload[0]), (LONG, 1));
    }
    // then
    let third = message(&mut client, 3, SHORT);
    client.loaned(third).room_within(WATCHDOG).send().unwrap();
    assert_eq!(number_of(&node, SHORT), 3, "the refused one does not come");
}

fn zero_limit_fails_at_once_and_sends_nothing(under: Under) {
    let node = PlayedNode::start();
    let mut client = register(under, &node, WATCHDOG);
    let taken = fill(&mut client, SHORT);
    assert!(taken > 0);
    for _ in 0..100 {
        let refused = message(&mut client, 1_000_000, SHORT);
        assert!(matches!(client.loaned(refused).room_within(NO_TIME).send(), Err(ApiError::Stalled(_))));
    }
    node.take_all();
    // Its stall timeout is unused: sends without waiting use none of it.
    let last = message(&mut client, taken, SHORT);
    client.loaned(last).send().unwrap();
    for number in 0..=taken {
        assert_eq!(number_of(&node, SHORT), number);
    }
}

fn long_message_with_zero_limit_is_whole_or_absent(under: Under) {
    let node = PlayedNode::start();
    let mut client = register(under, &node, WATCHDOG);
    for round in 0..3 {
        let first = message(&mut client, 3 * round, LONG);
        let is_sent = client.loaned(first).room_within(NO_TIME).send().is_ok();
        assert_eq!(is_sent, under.transport == Transport::Socket, "from a ring it is withdrawn");
        // Nothing is written behind a partly written message.
        let refused = message(&mut client, 1_000_000, SHORT);
        assert!(matches!(client.loaned(refused).room_within(NO_TIME).send(), Err(ApiError::Stalled(_))));
        node.take_all();
        for (number, length) in [(1, SHORT), (2, LONG)] {
            let next = message(&mut client, 3 * round + number, length);
            client.loaned(next).send().unwrap();
        }
        if is_sent {
            assert_eq!(number_of(&node, LONG), 3 * round);
        }
        assert_eq!(number_of(&node, SHORT), 3 * round + 1);
        assert_eq!(number_of(&node, LONG), 3 * round + 2);
        node.stop_reading();
    }
}

fn send_waits_for_room_up_to_its_limit(under: Under) {
    let node = PlayedNode::start();
    let mut client = register(under, &node, Duration::from_millis(1));
    let taken = fill(&mut client, SHORT);
    let time = Duration::from_millis(30);
    let late = message(&mut client, taken, SHORT);
    let (began, error) =
        (std::time::Instant::now(), client.loaned(late).room_within(time).send().unwrap_err());
    assert!(matches!(error, ApiError::Stalled(waited) if waited == time), "{error}");
    assert!(began.elapsed() >= time);
    // A time of its own is longer than the stall timeout.
    let waits = message(&mut client, taken, SHORT);
    node.take_all_in(Duration::from_millis(20));
    client.loaned(waits).room_within(WATCHDOG).send().unwrap();
    for number in 0..=taken {
        assert_eq!(number_of(&node, SHORT), number);
    }
}

fn answer_deadline_also_limits_wait_for_room(under: Under) {
    let node = PlayedNode::start();
    let mut client = register(under, &node, Duration::MAX);
    fill(&mut client, SHORT);
    fill(&mut client, 8);
    let time = Duration::from_millis(5);
    let lent = message(&mut client, 0, SHORT);
    assert!(matches!(client.loaned(lent).confirmed(time), Err(ApiError::Stalled(_))));
    let lent = message(&mut client, 0, SHORT);
    assert!(matches!(client.loaned(lent).ask_raw(time), Err(ApiError::Stalled(_))));
    assert!(matches!(client.resolve("anybody", time), Err(ApiError::Stalled(_))));
}

fn stall_timeout_is_spent_once_until_node_reads(under: Under) {
    let stall_timeout = Duration::from_millis(500);
    let node = PlayedNode::start();
    let mut client = register(under, &node, stall_timeout);
    let taken = fill(&mut client, SHORT);
    let began = std::time::Instant::now();
    let refused = message(&mut client, 0, SHORT);
    assert!(matches!(client.loaned(refused).send(), Err(ApiError::Stalled(_))));
    assert!(began.elapsed() >= stall_timeout);
    // Each with a stall timeout of its own, these would take eight minutes.
    for _ in 0..1_000 {
        let refused = message(&mut client, 0, SHORT);
        let error = client.loaned(refused).send().unwrap_err();
        assert!(matches!(error, ApiError::Stalled(waited) if waited == stall_timeout), "{error}");
    }
    node.take_all();
    while client.send(PlayedNode::remote_app(), &super::TORQUE).is_err() {}
    for number in 0..taken {
        assert_eq!(number_of(&node, SHORT), number);
    }
}

fn own_limit_does_not_restore_spent_stall_timeout(under: Under) {
    let stall_timeout = Duration::from_millis(500);
    let node = PlayedNode::start();
    let mut client = register(under, &node, stall_timeout);
    fill(&mut client, SHORT);
    let refused = message(&mut client, 0, SHORT);
    assert!(matches!(client.loaned(refused).send(), Err(ApiError::Stalled(_))));
    // Each with a stall timeout of its own, these would take eight minutes.
    let deadline = std::time::Instant::now() + 100 * stall_timeout;
    for _ in 0..1_000 {
        let refused = message(&mut client, 0, SHORT);
        assert!(matches!(client.loaned(refused).room_within(NO_TIME).send(), Err(ApiError::Stalled(_))));
        let refused = message(&mut client, 0, SHORT);
        assert!(matches!(client.loaned(refused).send(), Err(ApiError::Stalled(_))));
        assert!(std::time::Instant::now() < deadline, "each waits anew");
    }
}

fn unregister_ends_despite_endless_stall_timeout(under: Under) {
    // given: a node that reads nothing, and an endless stall timeout
    let node = PlayedNode::start();
    let mut client = register(under, &node, Duration::MAX);
    fill(&mut client, SHORT);
    fill(&mut client, 8);
    // when
    let (report, result) = std::sync::mpsc::sync_channel(1);
    thread::spawn(move || report.send(client.unregister()));
    // then
    let result = result.recv_timeout(WATCHDOG).expect("waited for the end of the unregistration");
    assert!(matches!(result, Err(ApiError::Stalled(_))), "{result:?}");
}

fn values_and_replies_accept_a_limit(under: Under) {
    let node = TestNode::start();
    let register = || super::register(under, &node, super::on(under));
    let (mut asking, mut replying) = (register(), register());
    let to = replying.tid();
    asking.message(to, &super::TORQUE).room_within(NO_TIME).send().unwrap();
    assert_eq!(
        replying.receive(WATCHDOG).unwrap().expect("a value").decode::<super::Torque>().unwrap(),
        super::TORQUE
    );
    let asked =
        thread::spawn(move || asking.message(to, &super::TORQUE).ask::<super::Torque>(WATCHDOG).unwrap());
    let request = replying.receive(WATCHDOG).unwrap().expect("a request");
    replying.message(request.source(), &super::TORQUE).room_within(NO_TIME).reply_to(&request).unwrap();
    assert_eq!(asked.join().unwrap(), super::TORQUE);
}

fn unregister_waits_until_sent_messages_are_written(under: Under) {
    let node = PlayedNode::start();
    let mut client = register(under, &node, WATCHDOG);
    let first = message(&mut client, 0, SHORT);
    client.loaned(first).send().unwrap();
    let long = message(&mut client, 1, LONG);
    let is_sent = client.loaned(long).room_within(NO_TIME).send().is_ok();
    assert_eq!(is_sent, under.transport == Transport::Socket, "from a ring it is withdrawn");
    node.take_all_in(Duration::from_millis(20));
    client.unregister().unwrap();
    assert_eq!(number_of(&node, SHORT), 0);
    if is_sent {
        assert_eq!(number_of(&node, LONG), 1);
    }
    assert!(node.next_now().is_none());
}
