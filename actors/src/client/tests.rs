//! NodeAPI against a real LNCL: what a program in a process of its own sees, in every form.

mod forms;
mod played_node;

use std::{thread, time::Duration};

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    outcome::{MemberOutcome, Outcome, Rejection},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, Flags, Kind, Message, Payload},
};

use super::{ApiError, NodeApi, Registration, Transport};
use crate::lncl::{
    AppFact,
    testing::{PlayedApp, RawClient, TestDirectory, TestNode, WATCHDOG},
};

use forms::{Api, Client, Under};

#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Torque {
    newton_metres: f32,
}

impl Payload for Torque {
    const NAME: &'static str = "test.torque";
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Doubled {
    newton_metres: f32,
}

impl Payload for Doubled {
    const NAME: &'static str = "test.doubled";
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Setpoint(u32);

impl Payload for Setpoint {
    const NAME: &'static str = "test.setpoint";
    const CLASS: Class = Class::Stream;
}

pub(super) const TORQUE: Torque = Torque { newton_metres: 2.5 };

/// Every claim of NodeAPI holds whatever carries the messages, and in every form. `; in_rust:` are those of which `forms/in_c.rs`
/// says why C has them not.
macro_rules! on_every_transport {
    ($($claim:ident)* $(; in_rust: $($rust:ident)*)?) => {
        on_every_transport!(@ring Ring Thread false, $($claim)* $($($rust)*)?);
        on_every_transport!(@direct Ring Thread true, $($claim)* $($($rust)*)?);
        on_every_transport!(@socket Socket Thread false, $($claim)* $($($rust)*)?);
        on_every_transport!(@async_ring Ring Task false, $($claim)* $($($rust)*)?);
        on_every_transport!(@async_direct Ring Task true, $($claim)* $($($rust)*)?);
        on_every_transport!(@async_socket Socket Task false, $($claim)* $($($rust)*)?);
        on_every_transport!(@c_ring Ring C false, $($claim)*);
        on_every_transport!(@c_direct Ring C true, $($claim)*);
        on_every_transport!(@c_socket Socket C false, $($claim)*);
    };
    (@$module:ident $transport:ident $form:ident $direct:literal, $($claim:ident)*) => {
        mod $module {
            use super::{Transport, forms::{Form, Under}};

            const UNDER: Under =
                Under { transport: Transport::$transport, form: Form::$form, direct: $direct };

            $(#[test] fn $claim() { super::$claim(UNDER) })*
        }
    };
}

mod awaiting;
mod loans;
mod protected;
mod registration;
mod returns;
mod room;

on_every_transport! {
    messages_go_to_and_fro_between_processes
    raw_memory_is_lent_filled_and_sent
    what_is_handled_while_memory_is_lent_is_told_when_it_is_given_back
    raw_memory_is_confirmed_asked_with_and_replied_with
    a_confirmed_message_ends_in_what_its_receiver_says
    an_outcome_that_nobody_says_is_unknown_at_the_deadline
    messages_that_come_while_an_outcome_is_awaited_are_received_afterwards
    two_endpoints_of_one_process_ask_and_reply
    a_request_that_cannot_be_handled_ends_at_once
    what_asks_for_no_reply_gets_none
    another_endpoint_cannot_reply_to_what_this_one_was_asked
    a_received_message_counts_as_handled_when_it_is_dropped
    a_message_that_is_in_hand_at_a_panic_has_failed
    of_a_stream_only_the_newest_value_is_received
    a_member_gets_what_is_sent_to_its_group_until_it_leaves
    each_member_of_a_group_says_what_became_of_it
    a_member_that_says_nothing_is_unknown_at_the_deadline_and_others_have_their_outcomes
    the_end_of_the_node_is_an_error_with_its_reason
    what_nobody_takes_is_said_with_its_number_and_once
    ; in_rust:
    what_waited_in_a_dropped_endpoint_was_not_handled
}

fn on(under: Under) -> Registration {
    Registration::new().transport(under.transport).direct(under.direct)
}

fn register(under: Under, node: &TestNode, registration: Registration) -> Client {
    Api::connect(under, node).register(registration).unwrap()
}

fn messages_go_to_and_fro_between_processes(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    endpoint.send(app.tid, &TORQUE).unwrap();
    let message = app.next();
    assert_eq!((message.header.source, message.header.sequence), (endpoint.tid(), 1));
    assert_eq!(message.decode::<Torque>().unwrap(), TORQUE);
    node.stores.router.send(Message::typed(app.tid, endpoint.tid(), &TORQUE)).unwrap();
    let received = endpoint.receive(WATCHDOG).unwrap().expect("a message");
    assert_eq!((received.source(), received.kind()), (app.tid, Torque::KIND));
    assert_eq!(received.decode::<Torque>().unwrap(), TORQUE);
    assert!(received.age(Time::MAX) > Some(Duration::ZERO));
    assert!(endpoint.receive(Duration::ZERO).unwrap().is_none());
}

fn raw_memory_is_lent_filled_and_sent(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    let kind = Kind::named("test.raw");
    let mut buffer = endpoint.create_message(app.tid, kind, 100_000).unwrap();
    buffer[99_999] = 7;
    endpoint.loaned(buffer).send().unwrap();
    let message = app.next();
    assert_eq!((message.header.kind, message.payload.len(), message.payload[99_999]), (kind, 100_000, 7));
    let too_long = endpoint.create_message(app.tid, kind, endpoint.payload_max() + 1);
    assert!(matches!(too_long, Err(ApiError::TooLong { .. })));
    let not_ours = endpoint.create_message(app.tid, Kind::NDL_QUERY, 1);
    assert!(matches!(not_ours, Err(ApiError::NotYours(Kind::NDL_QUERY))));
}

fn what_is_handled_while_memory_is_lent_is_told_when_it_is_given_back(under: Under) {
    const MESSAGES: u32 = 6_000;
    let node = TestNode::start_with(|config| config.mailbox_capacity = 8_192);
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    let lent = endpoint.create_message(app.tid, Kind::named("test.raw"), 8).unwrap();
    let outcomes: Vec<_> =
        (0..MESSAGES).map(|_| node.send_confirmed(app.tid, endpoint.tid(), &TORQUE)).collect();
    for _ in 0..MESSAGES {
        drop(endpoint.receive(WATCHDOG).unwrap().expect("it was sent"));
    }
    drop(lent);
    // They are more than the ring holds, and nothing is said between two calls.
    let deadline = Time::now() + WATCHDOG;
    for outcome in outcomes {
        let told = loop {
            match outcome.try_recv() {
                Ok(told) => break told,
                Err(_) => assert!(Time::now() < deadline, "waited for all outcomes"),
            }
            assert!(endpoint.receive(Duration::from_millis(1)).unwrap().is_none());
        };
        assert_eq!(told, Outcome::Delivered);
    }
}

fn raw_memory_is_confirmed_asked_with_and_replied_with(under: Under) {
    let node = TestNode::start();
    let mut asking = register(under, &node, on(under).handles_named("test.raw"));
    let mut replying = register(under, &node, on(under));
    let (to, kind) = (replying.tid(), Kind::named("test.raw"));
    let thread = thread::spawn(move || {
        replying
            .receive(WATCHDOG)
            .unwrap()
            .expect("a message")
            .settle(Outcome::Rejected(Rejection::ByHandler));
        let request = replying.receive(WATCHDOG).unwrap().expect("a request");
        let mut reply = replying.create_message(Tid::NONE, kind, 1).unwrap();
        reply[0] = request.bytes()[0] + 1;
        replying.loaned(reply).reply_to(&request).unwrap();
    });
    let mut buffer = asking.create_message(to, kind, 1).unwrap();
    buffer[0] = 6;
    let outcome = asking.loaned(buffer).confirmed(WATCHDOG).unwrap();
    assert_eq!(outcome, Outcome::Rejected(Rejection::ByHandler));
    let mut buffer = asking.create_message(to, kind, 1).unwrap();
    buffer[0] = 7;
    assert_eq!(asking.loaned(buffer).ask_raw(WATCHDOG).unwrap().bytes(), [8]);
    thread.join().unwrap();
}

fn a_confirmed_message_ends_in_what_its_receiver_says(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    for said in [Outcome::Delivered, Outcome::Rejected(Rejection::ByHandler), Outcome::Failed] {
        let told = thread::scope(|scope| {
            scope.spawn(|| app.next().settle(said));
            endpoint.message(app.tid, &TORQUE).confirmed(WATCHDOG).unwrap()
        });
        assert_eq!(told, said);
    }
    let nobody = Tid::new(node.address(), AppAddress::new(0x7777));
    let told = endpoint.message(nobody, &TORQUE).confirmed(WATCHDOG).unwrap();
    assert_eq!(told, Outcome::Rejected(Rejection::NoSuchApplication));
    let told = endpoint.message(app.tid, &Setpoint(1)).confirmed(WATCHDOG).unwrap();
    assert_eq!(told, Outcome::Rejected(Rejection::Unsupported), "of a Stream the newest wins");
}

fn an_outcome_that_nobody_says_is_unknown_at_the_deadline(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    let told = endpoint.message(app.tid, &TORQUE).confirmed(Duration::from_millis(1)).unwrap();
    assert_eq!(told, Outcome::Unknown);
    // The late outcome of the first is not taken for the second's.
    app.next().settle(Outcome::Delivered);
    let told = thread::scope(|scope| {
        scope.spawn(|| app.next().settle(Outcome::Failed));
        endpoint.message(app.tid, &TORQUE).confirmed(WATCHDOG).unwrap()
    });
    assert_eq!(told, Outcome::Failed);
}

fn messages_that_come_while_an_outcome_is_awaited_are_received_afterwards(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    let tid = endpoint.tid();
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut message = app.next();
            node.stores.router.send(Message::typed(app.tid, tid, &TORQUE)).unwrap();
            message.settle(Outcome::Delivered);
        });
        assert_eq!(endpoint.message(app.tid, &TORQUE).confirmed(WATCHDOG).unwrap(), Outcome::Delivered);
    });
    assert!(endpoint.receive(Duration::ZERO).unwrap().is_some());
}

fn two_endpoints_of_one_process_ask_and_reply(under: Under) {
    let node = TestNode::start();
    let mut asking = register(under, &node, on(under));
    let mut replying = register(under, &node, on(under));
    let to = replying.tid();
    let thread = thread::spawn(move || {
        let request = replying.receive(WATCHDOG).unwrap().expect("a request");
        assert!(request.wants_reply());
        let Torque { newton_metres } = request.decode().unwrap();
        replying.reply(&request, &Doubled { newton_metres: 2.0 * newton_metres }).unwrap();
    });
    let reply: Doubled = asking.message(to, &TORQUE).ask(WATCHDOG).unwrap();
    assert_eq!(reply, Doubled { newton_metres: 5.0 });
    thread.join().unwrap();
}

fn a_request_that_cannot_be_handled_ends_at_once(under: Under) {
    let node = TestNode::start();
    let mut endpoint = register(under, &node, on(under));
    let nobody = Tid::new(node.address(), AppAddress::new(0x7777));
    let error = endpoint.message(nobody, &TORQUE).ask::<Doubled>(WATCHDOG).unwrap_err();
    assert!(matches!(error, ApiError::Ended(Outcome::Rejected(Rejection::NoSuchApplication))), "{error}");
}

fn what_asks_for_no_reply_gets_none(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    node.stores.router.send(Message::typed(app.tid, endpoint.tid(), &TORQUE)).unwrap();
    let received = endpoint.receive(WATCHDOG).unwrap().expect("a message");
    assert!(matches!(endpoint.reply(&received, &TORQUE), Err(ApiError::NotAsked)));
}

fn another_endpoint_cannot_reply_to_what_this_one_was_asked(under: Under) {
    // Given: two endpoints of a program, one of which is asked.
    let node = TestNode::start();
    let (mut asked, mut other) = (register(under, &node, on(under)), register(under, &node, on(under)));
    let (to, mut asking) = (asked.tid(), register(under, &node, on(under)));
    let asks = thread::spawn(move || asking.message(to, &TORQUE).ask::<Doubled>(WATCHDOG));
    let request = asked.receive(WATCHDOG).unwrap().expect("a request");
    // When the other one replies, by mistake:
    let refused = other.reply(&request, &Doubled { newton_metres: 3.0 });
    // Then it is told, and who was asked can still do it.
    assert!(matches!(refused, Err(ApiError::OthersRequest(tid)) if tid == to), "{refused:?}");
    asked.reply(&request, &Doubled { newton_metres: 5.0 }).unwrap();
    drop(request);
    assert_eq!(asks.join().unwrap().unwrap().newton_metres, 5.0);
}

fn a_received_message_counts_as_handled_when_it_is_dropped(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    let tid = endpoint.tid();
    let outcome = node.send_confirmed(app.tid, tid, &TORQUE);
    drop(endpoint.receive(WATCHDOG).unwrap().expect("a message"));
    assert_eq!(outcome.recv_timeout(WATCHDOG), Ok(Outcome::Delivered));
    let outcome = node.send_confirmed(app.tid, tid, &TORQUE);
    endpoint.receive(WATCHDOG).unwrap().expect("a message").settle(Outcome::Rejected(Rejection::Malformed));
    assert_eq!(outcome.recv_timeout(WATCHDOG), Ok(Outcome::Rejected(Rejection::Malformed)));
}

fn a_message_that_is_in_hand_at_a_panic_has_failed(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    let outcome = node.send_confirmed(app.tid, endpoint.tid(), &TORQUE);
    let thread = thread::spawn(move || {
        let _in_hand = endpoint.receive(WATCHDOG).unwrap().expect("a message");
        panic!("this is the panic that the test asks for");
    });
    assert!(thread.join().is_err());
    assert_eq!(outcome.recv_timeout(WATCHDOG), Ok(Outcome::Failed));
}

fn what_waited_in_a_dropped_endpoint_was_not_handled(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    let first = node.send_confirmed(app.tid, endpoint.tid(), &TORQUE);
    let second = node.send_confirmed(app.tid, endpoint.tid(), &TORQUE);
    // Both have come with one look at the socket.
    drop(endpoint.receive(WATCHDOG).unwrap().expect("a message"));
    drop(endpoint);
    assert_eq!(first.recv_timeout(WATCHDOG), Ok(Outcome::Delivered));
    assert_eq!(second.recv_timeout(WATCHDOG), Ok(Outcome::Rejected(Rejection::Closed)));
}

fn of_a_stream_only_the_newest_value_is_received(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    for value in 0..10 {
        node.stores.router.send(Message::typed(app.tid, endpoint.tid(), &Setpoint(value))).unwrap();
    }
    let received = endpoint.receive(WATCHDOG).unwrap().expect("a message");
    assert_eq!(received.decode::<Setpoint>().unwrap(), Setpoint(9));
    assert!(endpoint.receive(Duration::ZERO).unwrap().is_none());
}

fn a_member_gets_what_is_sent_to_its_group_until_it_leaves(under: Under) {
    let node = TestNode::start();
    let mut member = register(under, &node, on(under));
    let mut sender = register(under, &node, on(under));
    let group = Tid::group("drives");
    member.join("drives").unwrap();
    sender.send(group, &TORQUE).unwrap();
    assert_eq!(member.receive(WATCHDOG).unwrap().expect("a message").destination(), group);
    member.leave("drives").unwrap();
    sender.send(group, &TORQUE).unwrap();
    // What the sender says directly comes after what it said to the group.
    sender.send(member.tid(), &TORQUE).unwrap();
    assert_eq!(member.receive(WATCHDOG).unwrap().expect("a message").destination(), member.tid());
}

fn each_member_of_a_group_says_what_became_of_it(under: Under) {
    let node = TestNode::start();
    let (app, mut member) = (node.local(1), register(under, &node, on(under)));
    let mut sender = register(under, &node, on(under));
    let group = Tid::group("drives");
    // A group has no outcome of its own, and what to do is said.
    let error = sender.message(group, &TORQUE).confirmed(WATCHDOG).unwrap_err();
    assert!(error.to_string().contains("confirmed_by_each"), "{error}");
    // An empty one has no outcomes.
    assert_eq!(sender.message(group, &TORQUE).confirmed_by_each(WATCHDOG).unwrap(), []);
    // The sender itself has none.
    sender.join("drives").unwrap();
    member.join("drives").unwrap();
    node.stores.router.set_member(group.app, app.tid.app, true);
    let of_member = member.tid();
    let told = thread::scope(|scope| {
        scope.spawn(|| app.next().settle(Outcome::Rejected(Rejection::UnknownKind)));
        scope.spawn(move || {
            let received = member.receive(WATCHDOG).unwrap().expect("its copy");
            assert_eq!(received.destination(), group);
        });
        sender.message(group, &TORQUE).confirmed_by_each(WATCHDOG).unwrap()
    });
    let mut expected = [
        MemberOutcome { tid: app.tid, outcome: Outcome::Rejected(Rejection::UnknownKind) },
        MemberOutcome { tid: of_member, outcome: Outcome::Delivered },
    ];
    expected.sort_unstable_by_key(|member| member.tid);
    assert_eq!(told, expected);
    // One application has one.
    let told = thread::scope(|scope| {
        scope.spawn(|| app.next().settle(Outcome::Delivered));
        sender.message(app.tid, &TORQUE).confirmed_by_each(WATCHDOG).unwrap()
    });
    assert_eq!(told, [MemberOutcome { tid: app.tid, outcome: Outcome::Delivered }]);
}

fn a_member_that_says_nothing_is_unknown_at_the_deadline_and_others_have_their_outcomes(under: Under) {
    let node = TestNode::start();
    let [takes, hangs] = [1, 2].map(|index| node.local(index));
    let mut sender = register(under, &node, on(under));
    let group = Tid::group("drives");
    for app in [&takes, &hangs] {
        node.stores.router.set_member(group.app, app.tid.app, true);
    }
    let told = thread::scope(|scope| {
        scope.spawn(|| takes.next().settle(Outcome::Delivered));
        sender.message(group, &TORQUE).confirmed_by_each(Duration::from_secs(1)).unwrap()
    });
    let entry = |app: &PlayedApp, outcome| MemberOutcome { tid: app.tid, outcome };
    assert_eq!(told, [entry(&takes, Outcome::Delivered), entry(&hangs, Outcome::Unknown)]);
}

fn the_end_of_the_node_is_an_error_with_its_reason(under: Under) {
    let mut node = TestNode::start();
    let mut endpoint = register(under, &node, on(under));
    node.stop();
    let error = endpoint.receive(WATCHDOG).unwrap_err();
    assert!(error.to_string().contains("LNCL has ended"), "{error}");
    let error = endpoint.send(Tid::NONE, &TORQUE).unwrap_err();
    assert!(error.to_string().contains("LNCL has ended"), "{error}");
}

fn what_nobody_takes_is_said_with_its_number_and_once(under: Under) {
    // What the application that the test plays takes.
    const ROOM: u64 = 1_024;
    const MORE: u64 = 20;
    let node = TestNode::start();
    let app = node.local(1);
    let nobody = Tid::new(node.address(), AppAddress::fixed(9).unwrap());
    let mut endpoint = register(under, &node, on(under));
    assert_eq!(endpoint.take_undelivered(), None);
    for _ in 0..ROOM + MORE {
        endpoint.send(app.tid, &Torque { newton_metres: 1.0 }).unwrap();
    }
    endpoint.send(nobody, &Torque { newton_metres: 1.0 }).unwrap();
    let (mut full, mut gone) = (0, 0);
    let deadline = Time::now() + WATCHDOG;
    while full < MORE || gone < 1 {
        assert!(Time::now() < deadline, "waited for {MORE} and 1, was told of {full} and {gone}");
        let Some(undelivered) = endpoint.take_undelivered() else {
            assert!(endpoint.receive(Duration::from_millis(10)).unwrap().is_none(), "nobody sends to it");
            continue;
        };
        match (undelivered.destination, undelivered.why) {
            (to, Rejection::QueueFull) if to == app.tid => full += undelivered.count,
            (to, Rejection::NoSuchApplication) if to == nobody => gone += undelivered.count,
            other => panic!("{other:?}"),
        }
    }
    assert_eq!((full, gone, endpoint.take_undelivered()), (MORE, 1, None));
}
