//! Endpoints whose node is restarted: what they say meanwhile, and what they come back to, in every form.

use std::{thread, time::Duration};

use super::{
    ApiError, AppAddress, Kind, NodeApi, Outcome, Registration, Rejection, TORQUE, TestNode, Tid, Time,
    Torque, Transport, WATCHDOG,
    forms::{self, Client, Form, Under},
    on, register,
};
use crate::client::{Endpoint, link::Ended};

on_every_transport! {
    an_endpoint_comes_back_to_its_name_its_address_and_its_groups
    meanwhile_it_says_once_that_it_is_away_and_each_send_says_it_was_not_sent
    a_confirmed_message_that_its_node_took_along_is_unknown
    what_an_endpoint_had_and_takes_after_its_node_has_gone_is_unknown_to_its_senders
    who_is_there_for_one_connection_does_not_come_back
    a_send_with_a_time_of_its_own_does_not_look_for_the_node
    a_send_of_whatever_patience_does_and_comes_back
    what_is_left_of_a_long_message_ends_with_the_connection_and_the_next_one_is_whole
}

/// Receives until it has come back. Says how often it was told that it is away.
fn await_return(client: &mut Client) -> u32 {
    let (deadline, before) = (Time::now() + WATCHDOG, client.registrations());
    let mut told = 0;
    while client.registrations() == before {
        assert!(Time::now() < deadline, "waited for the endpoint to come back");
        match client.receive(Duration::from_millis(10)) {
            Ok(None) => {}
            Ok(Some(received)) => panic!("{received:?}"),
            Err(ApiError::Disconnected(_)) => told += 1,
            Err(error) => panic!("{error}"),
        }
    }
    told
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

fn an_endpoint_comes_back_to_its_name_its_address_and_its_groups(under: Under) {
    let mut node = TestNode::start();
    let fixed = AppAddress::fixed(77).unwrap();
    let mut client = register(under, &node, on(under).name("knee").fixed_address(fixed));
    let tid = client.tid();
    client.join("drives").unwrap();
    for life in 2..4 {
        node.restart();
        assert_eq!(await_return(&mut client), 1, "said once");
        assert_eq!((client.tid(), client.registrations()), (tid, life));
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
fn who_comes_back_and_may_not_join_a_group_any_more_hears_it_and_is_in_the_others() {
    // Given: an endpoint in two groups, and a list that does not name one of them any more
    let node = TestNode::start_guarded(&list_of_groups("'drives', 'lamps'"));
    let api = NodeApi::connect(node.path()).unwrap();
    let mut endpoint = api.register_transport_address(Registration::new().deadline(WATCHDOG)).unwrap();
    ["drives", "lamps"].into_iter().for_each(|name| endpoint.join(name).unwrap());
    node.stores.access.get().expect("it has a list").replace_in_test(&list_of_groups("'drives'"));
    // When: it comes back
    endpoint.writer.close();
    endpoint.end(Ended { why: "a test ends it".to_owned(), again: true });
    // It is told once that it is away.
    until_it_is_back_in_its_groups(&mut endpoint, |endpoint| {
        drop(endpoint.receive(Duration::from_millis(10)))
    });
    // Then
    assert_eq!(node.refused("membership"), 1);
    assert_eq!(endpoint.home.groups.len(), 2, "it asks again when it comes back the next time");
    assert!(node.stores.router.is_member(AppAddress::group("drives"), endpoint.tid().app));
    let refused = endpoint.join("lamps");
    assert!(matches!(refused, Err(ApiError::Ended(Outcome::Rejected(Rejection::NotAllowed)))), "{refused:?}");
}

/// It does this again and again, until it has come back and has heard of all its groups.
fn until_it_is_back_in_its_groups(endpoint: &mut Endpoint, does: impl Fn(&mut Endpoint)) {
    let deadline = Time::now() + WATCHDOG;
    while endpoint.registrations() == 1 || !endpoint.home.rejoining.is_empty() {
        assert!(Time::now() < deadline, "waited for what becomes of its groups");
        does(endpoint);
    }
}

#[test]
fn who_comes_back_to_more_groups_than_it_asks_about_is_in_all_of_them() {
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
    // It is told once that it is away.
    until_it_is_back_in_its_groups(&mut endpoint, |endpoint| {
        drop(endpoint.receive(Duration::from_millis(10)))
    });
    // Then
    assert_eq!((endpoint.registrations(), node.stores.router.memberships()), (2, 256));
}

#[test]
fn who_comes_back_and_only_sends_takes_what_becomes_of_its_groups_so_that_the_node_reads_on() {
    // Given: a node that reads nothing more of who leaves one answer lying
    let mut node = TestNode::start_with(|config| config.mailbox_capacity = 1);
    let api = NodeApi::connect(node.path()).unwrap();
    let mut endpoint = api.register_transport_address(Registration::new().deadline(WATCHDOG)).unwrap();
    (0..20).for_each(|number| endpoint.join(&number.to_string()).unwrap());
    // When
    node.restart();
    // It fails while the node is away.
    until_it_is_back_in_its_groups(&mut endpoint, |endpoint| {
        drop(endpoint.send(Tid::group("drives"), &TORQUE))
    });
    // Then
    assert_eq!((endpoint.registrations(), node.stores.router.memberships()), (2, 20));
}

fn meanwhile_it_says_once_that_it_is_away_and_each_send_says_it_was_not_sent(under: Under) {
    let mut node = TestNode::start();
    let mut client = register(under, &node, on(under));
    node.stop();
    let told = await_end(&mut client);
    assert!(matches!(told, ApiError::Disconnected(_)), "{told}");
    assert!(told.to_string().contains("registers again by itself"), "{told}");
    assert!(client.receive(Duration::from_millis(1)).unwrap().is_none(), "it was said once");
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
    assert_eq!(await_return(&mut client), 0, "it was said before");
    let app = node.local(1);
    client.send(to, &TORQUE).unwrap();
    assert_eq!(app.next().decode::<Torque>().unwrap(), TORQUE);
}

fn a_confirmed_message_that_its_node_took_along_is_unknown(under: Under) {
    let mut node = TestNode::start();
    let app = node.local(1);
    let mut client = register(under, &node, on(under));
    let to = app.tid;
    let sending = thread::spawn(move || client.message(to, &TORQUE).confirmed(WATCHDOG * 3));
    // Its receiver has it in hand, and says nothing before the node's end.
    let in_hand = app.next();
    node.stop();
    assert_eq!(sending.join().unwrap().unwrap(), Outcome::Unknown);
    drop(in_hand);
}

fn what_an_endpoint_had_and_takes_after_its_node_has_gone_is_unknown_to_its_senders(under: Under) {
    // Given: confirmed messages that a client has been given, and has not taken.
    let mut node = TestNode::start();
    let app = node.local(1);
    let mut client = register(under, &node, on(under));
    // The first one has been taken when the others are sent: what it is given by then goes to its ring.
    let first = node.send_confirmed(app.tid, client.tid(), &TORQUE);
    drop(client.receive(WATCHDOG).unwrap().expect("the first"));
    assert_eq!(first.recv_timeout(WATCHDOG), Ok(Outcome::Delivered));
    let outcomes: Vec<_> = (0..3).map(|_| node.send_confirmed(app.tid, client.tid(), &TORQUE)).collect();
    // When: its node has gone, and it lives on.
    node.stop();
    // Then: what it still handles, nobody is told that it was not handled.
    let told: Vec<_> = outcomes.iter().map(|outcome| outcome.recv_timeout(WATCHDOG)).collect();
    let (mut handled, deadline) = (0, Time::now() + WATCHDOG);
    while handled < 3 {
        assert!(Time::now() < deadline, "waited for what it was given; {handled} of 3 have come");
        // Between them it is told once that its node is away.
        handled += client.receive(Duration::from_millis(10)).ok().flatten().map_or(0, |_| 1);
    }
    assert_eq!(told, vec![Ok(Outcome::Unknown); 3]);
}

fn who_is_there_for_one_connection_does_not_come_back(under: Under) {
    let mut node = TestNode::start();
    let mut client = register(under, &node, on(under).without_reconnect());
    node.restart();
    for _ in 0..3 {
        let told = await_end(&mut client);
        assert!(matches!(told, ApiError::Closed(_)), "{told}");
        assert!(told.to_string().contains("register a new one"), "{told}");
    }
    let refused = client.send(Tid::NONE, &TORQUE);
    assert!(matches!(refused, Err(ApiError::Closed(_))), "{refused:?}");
    assert_eq!(client.registrations(), 1);
}

fn a_send_with_a_time_of_its_own_does_not_look_for_the_node(under: Under) {
    let mut node = TestNode::start();
    let mut client = register(under, &node, on(under));
    node.restart();
    assert!(matches!(await_end(&mut client), ApiError::Disconnected(_)));
    let before = client.registrations();
    for _ in 0..100 {
        let refused = client.message(Tid::NONE, &TORQUE).room_within(Duration::from_millis(1)).send();
        assert!(matches!(refused, Err(ApiError::Disconnected(_))), "{refused:?}");
        // Of a task a thread of its runtime's pool looks meanwhile.
        if !matches!(under.form, Form::Task) {
            let refused = client.message(Tid::NONE, &TORQUE).confirmed(Duration::from_millis(1));
            assert!(matches!(refused, Err(ApiError::Disconnected(_))), "{refused:?}");
        }
    }
    assert_eq!(client.registrations(), before);
    await_return(&mut client);
}

fn a_send_of_whatever_patience_does_and_comes_back(under: Under) {
    for stall_timeout in [Duration::ZERO, Duration::MAX] {
        let mut node = TestNode::start();
        let mut client = register(under, &node, on(under).stall_timeout(stall_timeout));
        let to = Tid::new(client.tid().node, AppAddress::fixed(1).unwrap());
        node.restart();
        let app = node.local(1);
        let deadline = Time::now() + WATCHDOG;
        while client.registrations() == 1 || client.send(to, &TORQUE).is_err() {
            assert!(Time::now() < deadline, "waited for the endpoint to come back");
            // Refused until it has.
            let _ = client.send(Tid::NONE, &TORQUE);
        }
        assert_eq!(app.next().decode::<Torque>().unwrap(), TORQUE);
    }
}

fn what_is_left_of_a_long_message_ends_with_the_connection_and_the_next_one_is_whole(under: Under) {
    const LONG: usize = 1 << 20;
    let mut node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let raw = Kind::named("test.raw");
    let to = node.local(1).tid;
    let mut client = register(under, &node, on(under).stall_timeout(Duration::from_millis(1)));
    for _ in 0..3 {
        let mut half = client.create_message(to, raw, LONG).unwrap();
        half.fill(1);
        // From a socket it is sent with its first byte; from a ring it is taken back, for which there may be no room yet.
        let begun = client.loaned(half).room_within(Duration::ZERO).send();
        assert!(matches!(begun, Ok(()) | Err(ApiError::Stalled(_))), "{begun:?}");
        node.restart();
        await_return(&mut client);
        let app = node.local(1);
        let mut whole = client.create_message(to, raw, LONG).unwrap();
        whole.fill(2);
        client.loaned(whole).room_within(WATCHDOG).send().unwrap();
        assert_eq!(app.next().payload[..], vec![2; LONG]);
    }
}
