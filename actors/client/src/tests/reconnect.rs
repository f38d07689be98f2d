//! Endpoints of a restarted node: their errors meanwhile, and their state after the reconnect, in every form.

use std::{thread, time::Duration};

use super::{
    ApiError, AppAddress, Kind, NodeApi, Outcome, Registration, Rejection, TORQUE, TestNode, Tid, Time,
    Torque, Transport, WATCHDOG,
    forms::{self, Client, Form, Under},
    on, register,
};
use crate::{Endpoint, link::Ended};

on_every_transport! {
    reconnect_restores_name_address_and_groups
    absence_is_reported_once_and_by_each_send
    confirmed_message_lost_with_node_is_unknown
    messages_handled_after_node_end_are_unknown
    endpoint_without_reconnect_stays_closed
    send_with_own_limit_does_not_reconnect
    send_reconnects_with_any_stall_timeout
    partial_message_ends_with_connection
}

/// Receives until it has reconnected. Returns the number of errors about the missing node.
fn await_reconnect(client: &mut Client) -> u32 {
    let (deadline, before) = (Time::now() + WATCHDOG, client.registrations());
    let mut errors = 0;
    while client.registrations() == before {
        assert!(Time::now() < deadline, "waited for the endpoint to reconnect");
        match client.receive(Duration::from_millis(10)) {
            Ok(None) => {}
            Ok(Some(received)) => panic!("{received:?}"),
            Err(ApiError::Disconnected(_)) => errors += 1,
            Err(error) => panic!("{error}"),
        }
    }
    errors
}

/// Receives until the end of the connection is seen.
fn await_end(client: &mut Client) -> ApiError {
    let deadline = Time::now() + WATCHDOG;
    loop {
        assert!(Time::now() < deadline, "waited for the end of the connection");
        match client.receive(Duration::from_millis(10)) {
            Ok(None) => {}
            Ok(Some(received)) => panic!("{received:?}"),
            Err(error) => return error,
        }
    }
}

fn reconnect_restores_name_address_and_groups(under: Under) {
    let mut node = TestNode::start();
    let fixed = AppAddress::fixed(77).unwrap();
    let mut client = register(under, &node, on(under).name("knee").fixed_address(fixed));
    let tid = client.tid();
    client.join("drives").unwrap();
    for registrations in 2..4 {
        node.restart();
        assert_eq!(await_reconnect(&mut client), 1, "reported once");
        assert_eq!((client.tid(), client.registrations()), (tid, registrations));
        let mut other = register(under, &node, on(under));
        assert_eq!(other.resolve("knee", WATCHDOG).unwrap(), Some(tid));
        other.send(Tid::group("drives"), &TORQUE).unwrap();
        let received = client.receive(WATCHDOG).unwrap().expect("what was sent to the group");
        assert_eq!(received.destination(), Tid::group("drives"));
    }
}

/// A node with a list by which its own user joins these groups alone.
fn list_of_groups(groups: &str) -> String {
    let uid = rustix::process::geteuid().as_raw();
    format!("[[client]]\nuid = {uid}\ngroups = [{groups}]\n[[rule]]\nfrom = ['*']\nto = ['*']\n")
}

#[test]
fn forbidden_group_is_reported_and_others_rejoined() {
    // Given: an endpoint in two groups, and an access list that no longer names one of them
    let node = TestNode::start_guarded(&list_of_groups("'drives', 'lamps'"));
    let api = NodeApi::connect(node.path()).unwrap();
    let mut endpoint = api.register_transport_address(Registration::new().deadline(WATCHDOG)).unwrap();
    ["drives", "lamps"].into_iter().for_each(|name| endpoint.join(name).unwrap());
    node.replace_access(&list_of_groups("'drives'"));
    // When: it reconnects
    endpoint.node.writer.close();
    endpoint.end(Ended { why: "a test ends it".to_owned(), again: true });
    // It gets one error about the missing node.
    await_rejoined_groups(&mut endpoint, |endpoint| drop(endpoint.receive(Duration::from_millis(10))));
    // Then
    assert_eq!(node.refused("membership"), 1);
    assert_eq!(endpoint.reconnect.groups.len(), 2, "it asks again at the next reconnection");
    assert!(node.router().is_member(AppAddress::group("drives"), endpoint.tid().app));
    let refused = endpoint.join("lamps");
    assert!(matches!(refused, Err(ApiError::Ended(Outcome::Rejected(Rejection::NotAllowed)))), "{refused:?}");
}

/// Repeats `does` until the endpoint has reconnected and has the answers for all its groups.
fn await_rejoined_groups(endpoint: &mut Endpoint, does: impl Fn(&mut Endpoint)) {
    let deadline = Time::now() + WATCHDOG;
    while endpoint.registrations() == 1 || !endpoint.reconnect.rejoining.is_empty() {
        assert!(Time::now() < deadline, "waited for what becomes of its groups");
        does(endpoint);
    }
}

#[test]
fn reconnect_rejoins_more_groups_than_it_confirms() {
    // Given: rings and a mailbox that hold few answers
    let mut node = TestNode::start_with(|config| {
        config.lncl.ring_bytes = 4_096;
        config.mailbox_capacity = 1;
    });
    let api = NodeApi::connect(node.path()).unwrap();
    let mut endpoint = api.register_transport_address(Registration::new().deadline(WATCHDOG)).unwrap();
    (0..256).for_each(|number| endpoint.join(&number.to_string()).unwrap());
    // When
    node.restart();
    // It gets one error about the missing node.
    await_rejoined_groups(&mut endpoint, |endpoint| drop(endpoint.receive(Duration::from_millis(10))));
    // Then
    assert_eq!((endpoint.registrations(), node.router().memberships()), (2, 256));
}

#[test]
fn sends_alone_read_the_answers_of_rejoins() {
    // Given: a node that stops reading from a client as soon as one answer is unread
    let mut node = TestNode::start_with(|config| config.mailbox_capacity = 1);
    let api = NodeApi::connect(node.path()).unwrap();
    let mut endpoint = api.register_transport_address(Registration::new().deadline(WATCHDOG)).unwrap();
    (0..20).for_each(|number| endpoint.join(&number.to_string()).unwrap());
    // When
    node.restart();
    // It fails while the node is away.
    await_rejoined_groups(&mut endpoint, |endpoint| drop(endpoint.send(Tid::group("drives"), &TORQUE)));
    // Then
    assert_eq!((endpoint.registrations(), node.router().memberships()), (2, 20));
}

fn absence_is_reported_once_and_by_each_send(under: Under) {
    let mut node = TestNode::start();
    let mut client = register(under, &node, on(under));
    node.stop();
    let error = await_end(&mut client);
    assert!(matches!(error, ApiError::Disconnected(_)), "{error}");
    assert!(error.to_string().contains("registers again by itself"), "{error}");
    assert!(client.receive(Duration::from_millis(1)).unwrap().is_none(), "it was reported once");
    let to = Tid::new(client.tid().node, AppAddress::fixed(1).unwrap());
    for refused in [
        client.send(to, &TORQUE),
        client.message(to, &TORQUE).room_within(Duration::ZERO).send(),
        client.message(to, &TORQUE).confirmed(WATCHDOG).map(drop),
        client.message(to, &TORQUE).ask::<Torque>(WATCHDOG).map(drop),
        client.resolve("anybody", WATCHDOG).map(drop),
        client.join("drives"),
    ] {
        assert!(matches!(refused, Err(ApiError::Disconnected(_))), "{refused:?}");
    }
    node.restart();
    assert_eq!(await_reconnect(&mut client), 0, "it was reported before");
    let app = node.local(1);
    client.send(to, &TORQUE).unwrap();
    assert_eq!(app.next().decode::<Torque>().unwrap(), TORQUE);
}

fn confirmed_message_lost_with_node_is_unknown(under: Under) {
    let mut node = TestNode::start();
    let app = node.local(1);
    let mut client = register(under, &node, on(under));
    let to = app.tid;
    let sending = thread::spawn(move || client.message(to, &TORQUE).confirmed(WATCHDOG * 3));
    // Its receiver has it in hand, and settles nothing before the node's end.
    let in_hand = app.next();
    node.stop();
    assert_eq!(sending.join().unwrap().unwrap(), Outcome::Unknown);
    drop(in_hand);
}

fn messages_handled_after_node_end_are_unknown(under: Under) {
    // Given: confirmed messages that a client has been given, and has not taken.
    let mut node = TestNode::start();
    let app = node.local(1);
    let mut client = register(under, &node, on(under));
    // The first one has been received when the others are sent: they go directly to its ring.
    let first = node.send_confirmed(app.tid, client.tid(), &TORQUE);
    drop(client.receive(WATCHDOG).unwrap().expect("the first"));
    assert_eq!(first.recv_timeout(WATCHDOG), Ok(Outcome::Delivered));
    let outcomes: Vec<_> = (0..3).map(|_| node.send_confirmed(app.tid, client.tid(), &TORQUE)).collect();
    // When: its node has ended, and the endpoint continues.
    node.stop();
    // Then: no message is reported as unhandled, because the endpoint still handles it.
    let settled: Vec<_> = outcomes.iter().map(|outcome| outcome.recv_timeout(WATCHDOG)).collect();
    let (mut handled, deadline) = (0, Time::now() + WATCHDOG);
    while handled < 3 {
        assert!(Time::now() < deadline, "waited for its messages; {handled} of 3 have arrived");
        // Between them it gets one error about the missing node.
        handled += client.receive(Duration::from_millis(10)).ok().flatten().map_or(0, |_| 1);
    }
    assert_eq!(settled, vec![Ok(Outcome::Unknown); 3]);
}

fn endpoint_without_reconnect_stays_closed(under: Under) {
    let mut node = TestNode::start();
    let mut client = register(under, &node, on(under).without_reconnect());
    node.restart();
    for _ in 0..3 {
        let error = await_end(&mut client);
        assert!(matches!(error, ApiError::Closed(_)), "{error}");
        assert!(error.to_string().contains("register a new one"), "{error}");
    }
    let refused = client.send(Tid::NONE, &TORQUE);
    assert!(matches!(refused, Err(ApiError::Closed(_))), "{refused:?}");
    assert_eq!(client.registrations(), 1);
}

fn send_with_own_limit_does_not_reconnect(under: Under) {
    let mut node = TestNode::start();
    let mut client = register(under, &node, on(under));
    node.restart();
    assert!(matches!(await_end(&mut client), ApiError::Disconnected(_)));
    let before = client.registrations();
    for _ in 0..100 {
        let refused = client.message(Tid::NONE, &TORQUE).room_within(Duration::from_millis(1)).send();
        assert!(matches!(refused, Err(ApiError::Disconnected(_))), "{refused:?}");
        // A task looks for the node on a thread of its runtime's pool.
        if !matches!(under.form, Form::Task) {
            let refused = client.message(Tid::NONE, &TORQUE).confirmed(Duration::from_millis(1));
            assert!(matches!(refused, Err(ApiError::Disconnected(_))), "{refused:?}");
        }
    }
    assert_eq!(client.registrations(), before);
    await_reconnect(&mut client);
}

fn send_reconnects_with_any_stall_timeout(under: Under) {
    for stall_timeout in [Duration::ZERO, Duration::MAX] {
        let mut node = TestNode::start();
        let mut client = register(under, &node, on(under).stall_timeout(stall_timeout));
        let to = Tid::new(client.tid().node, AppAddress::fixed(1).unwrap());
        node.restart();
        let app = node.local(1);
        let deadline = Time::now() + WATCHDOG;
        while client.registrations() == 1 || client.send(to, &TORQUE).is_err() {
            assert!(Time::now() < deadline, "waited for the endpoint to reconnect");
            // Refused until it has.
            let _ = client.send(Tid::NONE, &TORQUE);
        }
        assert_eq!(app.next().decode::<Torque>().unwrap(), TORQUE);
    }
}

fn partial_message_ends_with_connection(under: Under) {
    const LONG: usize = 1 << 20;
    let mut node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let raw = Kind::named("test.raw");
    let to = node.local(1).tid;
    let mut client = register(under, &node, on(under).stall_timeout(Duration::from_millis(1)));
    for _ in 0..3 {
        let mut half = client.create_message(to, raw, LONG).unwrap();
        half.fill(1);
        // From a socket it is sent with its first byte; from a ring it is taken back, for which there may be
        // no room yet.
        let begun = client.loaned(half).room_within(Duration::ZERO).send();
        assert!(matches!(begun, Ok(()) | Err(ApiError::Stalled(_))), "{begun:?}");
        node.restart();
        await_reconnect(&mut client);
        let app = node.local(1);
        let mut whole = client.create_message(to, raw, LONG).unwrap();
        whole.fill(2);
        client.loaned(whole).room_within(WATCHDOG).send().unwrap();
        assert_eq!(app.next().payload[..], vec![2; LONG]);
    }
}
