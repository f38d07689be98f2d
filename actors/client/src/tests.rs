//! NodeAPI against a real LNCL: the view of a program in its own process, in every form.

mod forms;
mod played_node;

use std::{thread, time::Duration};

use forms::{Api, Client, Under};
use serde::{Deserialize, Serialize};
use sinew_lncl::testing::{PlayedApp, RawClient, TestDirectory, TestNode, WATCHDOG};
use sinew_model::facts::AppFact;
use sinew_runtime::{
    outcome::{MemberOutcome, Outcome, Rejection},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, Flags, Kind, Message, Payload},
};

use super::{ApiError, DirectLinks, NodeApi, Registration, Transport};

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

/// Every claim of NodeAPI holds on every transport and in every form. Claims after `; in_rust:` do not apply
/// to C; `forms/in_c.rs` states the reason.
macro_rules! on_every_transport {
    ($($claim:ident)* $(; in_rust: $($rust:ident)*)?) => {
        on_every_transport!(@ring Ring Thread false, $($claim)* $($($rust)*)?);
        on_every_transport!(@direct Ring Thread true, $($claim)* $($($rust)*)?);
        on_every_transport!(@socket Socket Thread false, $($claim)* $($($rust)*)?);
        on_every_transport!(@async_ring Ring Task false, $($claim)* $($($rust)*)?);
        on_every_transport!(@async_direct Ring Task true, $($claim)* $($($rust)*)?);
        on_every_transport!(@async_socket Socket Task false, $($claim)* $($($rust)*)?);
        on_every_transport!(@polled_ring Ring Polled false, $($claim)* $($($rust)*)?);
        on_every_transport!(@polled_direct Ring Polled true, $($claim)* $($($rust)*)?);
        on_every_transport!(@polled_socket Socket Polled false, $($claim)* $($($rust)*)?);
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
mod parameters;
mod protected;
mod reconnect;
mod registration;
mod room;

on_every_transport! {
    messages_pass_both_ways_between_processes
    raw_loan_is_filled_and_sent
    settlement_during_loan_is_sent_after_it
    raw_loans_are_confirmed_and_replied
    confirmed_message_ends_with_receivers_outcome
    missing_outcome_is_unknown_at_deadline
    messages_during_wait_for_outcome_are_kept
    two_endpoints_of_one_process_ask_and_reply
    impossible_request_fails_at_once
    message_without_request_gets_no_reply
    other_endpoint_cannot_reply_to_request
    dropped_message_counts_as_handled
    message_in_hand_at_panic_has_failed
    only_newest_stream_value_is_received
    member_receives_group_messages_until_it_leaves
    each_group_member_reports_its_outcome
    silent_group_member_is_unknown_at_deadline
    end_of_node_is_an_error_with_reason
    undelivered_messages_are_reported_once_with_count
    ; in_rust:
    messages_waiting_in_dropped_endpoint_are_rejected
}

fn on(under: Under) -> Registration {
    let links = if under.direct { DirectLinks::Always } else { DirectLinks::Never };
    Registration::new().transport(under.transport).direct(links)
}

fn register(under: Under, node: &TestNode, registration: Registration) -> Client {
    Api::connect(under, node).register(registration).unwrap()
}

fn messages_pass_both_ways_between_processes(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    endpoint.send(app.tid, &TORQUE).unwrap();
    let message = app.next();
    assert_eq!((message.header.source, message.header.sequence), (endpoint.tid(), 1));
    assert_eq!(message.decode::<Torque>().unwrap(), TORQUE);
    node.router().send(Message::typed(app.tid, endpoint.tid(), &TORQUE)).unwrap();
    let received = endpoint.receive(WATCHDOG).unwrap().expect("a message");
    assert_eq!((received.source(), received.kind()), (app.tid, Torque::KIND));
    assert_eq!(received.decode::<Torque>().unwrap(), TORQUE);
    assert!(received.age(Time::MAX) > Some(Duration::ZERO));
    assert!(endpoint.receive(Duration::ZERO).unwrap().is_none());
}

fn raw_loan_is_filled_and_sent(under: Under) {
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

fn settlement_during_loan_is_sent_after_it(under: Under) {
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
    // They are more than the ring holds, and nothing is sent between two calls.
    let deadline = Time::now() + WATCHDOG;
    for outcome in outcomes {
        let outcome = loop {
            match outcome.try_recv() {
                Ok(outcome) => break outcome,
                Err(_) => assert!(Time::now() < deadline, "waited for all outcomes"),
            }
            assert!(endpoint.receive(Duration::from_millis(1)).unwrap().is_none());
        };
        assert_eq!(outcome, Outcome::Delivered);
    }
}

fn raw_loans_are_confirmed_and_replied(under: Under) {
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

fn confirmed_message_ends_with_receivers_outcome(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    for expected in [Outcome::Delivered, Outcome::Rejected(Rejection::ByHandler), Outcome::Failed] {
        let outcome = thread::scope(|scope| {
            scope.spawn(|| app.next().settle(expected));
            endpoint.message(app.tid, &TORQUE).confirmed(WATCHDOG).unwrap()
        });
        assert_eq!(outcome, expected);
    }
    let absent = Tid::new(node.address(), AppAddress::new(0x7777));
    let outcome = endpoint.message(absent, &TORQUE).confirmed(WATCHDOG).unwrap();
    assert_eq!(outcome, Outcome::Rejected(Rejection::NoSuchApplication));
    let outcome = endpoint.message(app.tid, &Setpoint(1)).confirmed(WATCHDOG).unwrap();
    assert_eq!(outcome, Outcome::Rejected(Rejection::Unsupported), "of a Stream the newest wins");
}

fn missing_outcome_is_unknown_at_deadline(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    let outcome = endpoint.message(app.tid, &TORQUE).confirmed(Duration::from_millis(1)).unwrap();
    assert_eq!(outcome, Outcome::Unknown);
    // The late outcome of the first is not taken for the second's.
    app.next().settle(Outcome::Delivered);
    let outcome = thread::scope(|scope| {
        scope.spawn(|| app.next().settle(Outcome::Failed));
        endpoint.message(app.tid, &TORQUE).confirmed(WATCHDOG).unwrap()
    });
    assert_eq!(outcome, Outcome::Failed);
}

fn messages_during_wait_for_outcome_are_kept(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    let tid = endpoint.tid();
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut message = app.next();
            node.router().send(Message::typed(app.tid, tid, &TORQUE)).unwrap();
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

fn impossible_request_fails_at_once(under: Under) {
    let node = TestNode::start();
    let mut endpoint = register(under, &node, on(under));
    let absent = Tid::new(node.address(), AppAddress::new(0x7777));
    let error = endpoint.message(absent, &TORQUE).ask::<Doubled>(WATCHDOG).unwrap_err();
    assert!(matches!(error, ApiError::Ended(Outcome::Rejected(Rejection::NoSuchApplication))), "{error}");
}

fn message_without_request_gets_no_reply(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    node.router().send(Message::typed(app.tid, endpoint.tid(), &TORQUE)).unwrap();
    let received = endpoint.receive(WATCHDOG).unwrap().expect("a message");
    assert!(matches!(endpoint.reply(&received, &TORQUE), Err(ApiError::NotAsked)));
}

fn other_endpoint_cannot_reply_to_request(under: Under) {
    // Given: two endpoints of a program; one of them receives a request.
    let node = TestNode::start();
    let (mut asked, mut other) = (register(under, &node, on(under)), register(under, &node, on(under)));
    let (to, mut asking) = (asked.tid(), register(under, &node, on(under)));
    let asks = thread::spawn(move || asking.message(to, &TORQUE).ask::<Doubled>(WATCHDOG));
    let request = asked.receive(WATCHDOG).unwrap().expect("a request");
    // When: the other one replies, by mistake:
    let refused = other.reply(&request, &Doubled { newton_metres: 3.0 });
    // Then: it gets an error, and the endpoint with the request can still reply.
    assert!(matches!(refused, Err(ApiError::OthersRequest(tid)) if tid == to), "{refused:?}");
    asked.reply(&request, &Doubled { newton_metres: 5.0 }).unwrap();
    drop(request);
    assert_eq!(asks.join().unwrap().unwrap().newton_metres, 5.0);
}

fn dropped_message_counts_as_handled(under: Under) {
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

fn message_in_hand_at_panic_has_failed(under: Under) {
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

fn messages_waiting_in_dropped_endpoint_are_rejected(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    let first = node.send_confirmed(app.tid, endpoint.tid(), &TORQUE);
    let second = node.send_confirmed(app.tid, endpoint.tid(), &TORQUE);
    // Both arrive with one poll of the socket.
    drop(endpoint.receive(WATCHDOG).unwrap().expect("a message"));
    drop(endpoint);
    assert_eq!(first.recv_timeout(WATCHDOG), Ok(Outcome::Delivered));
    assert_eq!(second.recv_timeout(WATCHDOG), Ok(Outcome::Rejected(Rejection::Closed)));
}

fn only_newest_stream_value_is_received(under: Under) {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = register(under, &node, on(under));
    for value in 0..10 {
        node.router().send(Message::typed(app.tid, endpoint.tid(), &Setpoint(value))).unwrap();
    }
    let received = endpoint.receive(WATCHDOG).unwrap().expect("a message");
    assert_eq!(received.decode::<Setpoint>().unwrap(), Setpoint(9));
    assert!(endpoint.receive(Duration::ZERO).unwrap().is_none());
}

fn member_receives_group_messages_until_it_leaves(under: Under) {
    let node = TestNode::start();
    let mut member = register(under, &node, on(under));
    let mut sender = register(under, &node, on(under));
    let group = Tid::group("drives");
    member.join("drives").unwrap();
    sender.send(group, &TORQUE).unwrap();
    assert_eq!(member.receive(WATCHDOG).unwrap().expect("a message").destination(), group);
    member.leave("drives").unwrap();
    sender.send(group, &TORQUE).unwrap();
    // The sender's direct message arrives after its message to the group.
    sender.send(member.tid(), &TORQUE).unwrap();
    assert_eq!(member.receive(WATCHDOG).unwrap().expect("a message").destination(), member.tid());
}

fn each_group_member_reports_its_outcome(under: Under) {
    let node = TestNode::start();
    let (app, mut member) = (node.local(1), register(under, &node, on(under)));
    let mut sender = register(under, &node, on(under));
    let group = Tid::group("drives");
    // A group has no outcome of its own, and the error states the remedy.
    let error = sender.message(group, &TORQUE).confirmed(WATCHDOG).unwrap_err();
    assert!(error.to_string().contains("confirmed_by_each"), "{error}");
    // An empty group has no outcomes.
    assert_eq!(sender.message(group, &TORQUE).confirmed_by_each(WATCHDOG).unwrap(), []);
    // The sender itself has none.
    sender.join("drives").unwrap();
    member.join("drives").unwrap();
    node.router().set_member(group.app, app.tid.app, true);
    let of_member = member.tid();
    let outcomes = thread::scope(|scope| {
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
    assert_eq!(outcomes, expected);
    // One application has one outcome.
    let outcomes = thread::scope(|scope| {
        scope.spawn(|| app.next().settle(Outcome::Delivered));
        sender.message(app.tid, &TORQUE).confirmed_by_each(WATCHDOG).unwrap()
    });
    assert_eq!(outcomes, [MemberOutcome { tid: app.tid, outcome: Outcome::Delivered }]);
}

fn silent_group_member_is_unknown_at_deadline(under: Under) {
    let node = TestNode::start();
    let [takes, hangs] = [1, 2].map(|index| node.local(index));
    let mut sender = register(under, &node, on(under));
    let group = Tid::group("drives");
    for app in [&takes, &hangs] {
        node.router().set_member(group.app, app.tid.app, true);
    }
    let send = |sender: &mut Client, within| {
        thread::scope(|scope| {
            scope.spawn(|| takes.next_within(within).map(|mut message| message.settle(Outcome::Delivered)));
            sender.message(group, &TORQUE).confirmed_by_each(within).unwrap()
        })
    };
    let entry = |app: &PlayedApp, outcome| MemberOutcome { tid: app.tid, outcome };
    let expected = [entry(&takes, Outcome::Delivered), entry(&hangs, Outcome::Unknown)];
    // The whole time limit passes, because one member never answers. On a machine that was stopped meanwhile
    // the other member has not answered in time either, so the next try has more time.
    let mut within = Duration::from_millis(250);
    let mut outcomes = send(&mut sender, within);
    while outcomes != expected && within < WATCHDOG / 4 {
        within *= 4;
        outcomes = send(&mut sender, within);
    }
    assert_eq!(outcomes, expected);
}

fn end_of_node_is_an_error_with_reason(under: Under) {
    let mut node = TestNode::start();
    let mut endpoint = register(under, &node, on(under));
    node.stop();
    let error = endpoint.receive(WATCHDOG).unwrap_err();
    assert!(error.to_string().contains("LNCL has ended"), "{error}");
    let error = endpoint.send(Tid::NONE, &TORQUE).unwrap_err();
    assert!(error.to_string().contains("LNCL has ended"), "{error}");
}

fn undelivered_messages_are_reported_once_with_count(under: Under) {
    // The number of messages that the test's application accepts.
    const ROOM: u64 = 1_024;
    const MORE: u64 = 20;
    let node = TestNode::start();
    let app = node.local(1);
    let absent = Tid::new(node.address(), AppAddress::fixed(9).unwrap());
    let mut endpoint = register(under, &node, on(under));
    assert_eq!(endpoint.take_undelivered(), None);
    for _ in 0..ROOM + MORE {
        endpoint.send(app.tid, &Torque { newton_metres: 1.0 }).unwrap();
    }
    endpoint.send(absent, &Torque { newton_metres: 1.0 }).unwrap();
    let (mut full, mut unknown) = (0, 0);
    let deadline = Time::now() + WATCHDOG;
    while full < MORE || unknown < 1 {
        assert!(Time::now() < deadline, "waited for {MORE} and 1, was notified of {full} and {unknown}");
        let Some(undelivered) = endpoint.take_undelivered() else {
            assert!(
                endpoint.receive(Duration::from_millis(10)).unwrap().is_none(),
                "no application sends to it"
            );
            continue;
        };
        match (undelivered.destination, undelivered.why) {
            (to, Rejection::QueueFull) if to == app.tid => full += undelivered.count,
            (to, Rejection::NoSuchApplication) if to == absent => unknown += undelivered.count,
            other => panic!("{other:?}"),
        }
    }
    assert_eq!((full, unknown, endpoint.take_undelivered()), (MORE, 1, None));
}
