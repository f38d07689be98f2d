//! The same application in a thread and in a process of its own: the observable behaviour is the same.

use std::time::{Duration, Instant};

use rustix::process::Signal;
use sinew::{
    Outcome, Registration, Tid,
    message::{Kind, Rejection},
    payload,
};
use sinew_testkit::{DEADLINE, until};
use sinew_tests::orders::{Count, Level, Me, Order, Who};

use super::scenario::Scenario;

/// Runs each test with the application in every place.
macro_rules! in_every_place {
    ($($claim:ident)+) => {
        mod in_a_thread { $( #[test] fn $claim() { super::$claim("thread"); } )+ }
        mod in_a_process { $( #[test] fn $claim() { super::$claim("process"); } )+ }
    };
}

in_every_place! {
    messages_of_a_class_are_handled_in_order
    outcome_reflects_the_handlers_result
    message_that_waits_too_long_expires
    newest_waiting_stream_value_is_handled
    urgent_messages_overtake_those_that_wait
    panic_fails_the_handled_message_and_keeps_the_queue
    stopped_application_ramps_down_and_restarts
    sends_and_requests_have_outcomes
    group_membership_survives_restarts
    group_send_reports_each_members_outcome
    silent_input_is_noticed
    lost_requirement_is_reported_and_resolved_again
    pause_lasts_until_the_requirement_returns
    restart_waits_until_the_requirement_returns
    large_messages_go_both_ways
    stopping_node_lets_the_application_ramp_down
    stopping_the_actix_system_ends_nothing_and_is_logged
}

fn start(place: &str) -> Scenario {
    Scenario::start(&["--place", place])
}

fn messages_of_a_class_are_handled_in_order(place: &str) {
    let mut scenario = start(place);
    for hundred in 0..5 {
        (1..100).for_each(|number| scenario.count(100 * hundred + number));
        // The mailbox holds 256.
        assert_eq!(scenario.count_confirmed(100 * (hundred + 1)), Outcome::Delivered);
    }
    assert_eq!(scenario.who().counts, (1..=500).collect::<Vec<_>>());
}

payload!("process.unknown" => struct Unknown {});

fn outcome_reflects_the_handlers_result(place: &str) {
    let mut scenario = start(place);
    assert_eq!(scenario.count_confirmed(1), Outcome::Delivered);
    assert_eq!(scenario.order_confirmed(Order::Refuse), Outcome::Rejected(Rejection::ByHandler));
    let (endpoint, drive) = (&mut scenario.endpoint, scenario.drive);
    let outcome = endpoint.message(drive, &Unknown {}).confirmed(DEADLINE).expect("the node takes it");
    assert_eq!(outcome, Outcome::Rejected(Rejection::UnknownKind));
    assert_eq!(scenario.order_confirmed(Order::Panic), Outcome::Failed);
    assert_eq!(scenario.count_confirmed(2), Outcome::Delivered);
}

fn message_that_waits_too_long_expires(place: &str) {
    let mut scenario = sent_while_it_holds(place, |_| {});
    let (endpoint, drive) = (&mut scenario.endpoint, scenario.drive);
    let outcome = endpoint
        .message(drive, &Count { number: 1 })
        .confirmed(Duration::from_millis(1))
        .expect("the node takes it");
    assert!(matches!(outcome, Outcome::Unknown | Outcome::Expired), "{outcome:?}");
    assert_eq!(scenario.who().counts, [0; 0], "it was not handled");
}

/// Returns a scenario in which this was sent while one handler ran. On a slow machine the handler has to run
/// for longer.
fn sent_while_it_holds(place: &str, send: impl Fn(&mut Scenario)) -> Scenario {
    for millis in [1_000, 5_000, 30_000] {
        let mut scenario = Scenario::start(&["--place", place, "--turns-within", "600000"]);
        let began = Instant::now();
        scenario.order(Order::Hold(millis));
        scenario.node.wait_for(&["holds"]);
        send(&mut scenario);
        // The following messages arrive before its end, too.
        if began.elapsed() < Duration::from_millis(millis) / 2 {
            return scenario;
        }
    }
    panic!("what is sent takes 15 s");
}

fn newest_waiting_stream_value_is_handled(place: &str) {
    let mut scenario = sent_while_it_holds(place, |scenario| {
        for value in 1..=1_000 {
            scenario.endpoint.send(scenario.drive, &Level { value }).expect("the node takes it");
        }
    });
    scenario.node.wait_for(&["level 1000"]);
    let levels = scenario.node.output().iter().filter(|line| line.contains("level")).count();
    assert!(levels < 500, "{levels} of 1000 values were handled, although all came while one handler ran");
}

fn urgent_messages_overtake_those_that_wait(place: &str) {
    let mut scenario =
        sent_while_it_holds(place, |scenario| (1..=200).for_each(|number| scenario.count(number)));
    let handled = scenario.who().counts.len();
    assert!(handled <= 32, "{handled} of 200 messages that yield were handled before an urgent one");
}

fn panic_fails_the_handled_message_and_keeps_the_queue(place: &str) {
    let mut scenario = start(place);
    scenario.count_confirmed(1);
    scenario.order(Order::Hold(300));
    scenario.node.wait_for(&["holds"]);
    scenario.order(Order::Panic);
    (2..=200).for_each(|number| scenario.count(number));
    assert_eq!(scenario.count_confirmed(201), Outcome::Delivered);
    assert_eq!(scenario.who().counts, (2..=201).collect::<Vec<_>>(), "of the new instance");
    scenario.node.wait_for(&["a child failed", "a panic at", "process_under_test.rs"]);
}

fn stopped_application_ramps_down_and_restarts(place: &str) {
    let mut scenario = start(place);
    scenario.order(Order::Stop);
    scenario.node.wait_for(&["ramping down"]);
    scenario.node.wait_for(&["stopping"]);
    scenario.node.wait_for(&["started"]);
    scenario.node.wait_for(&["started"]);
    assert_eq!(scenario.count_confirmed(1), Outcome::Delivered);
}

fn sends_and_requests_have_outcomes(place: &str) {
    let mut scenario = start(place);
    scenario.order(Order::Send("test".to_owned(), 7));
    let received = scenario.endpoint.receive(DEADLINE).expect("the node is there").expect("a number");
    assert_eq!(
        (received.source(), received.decode::<Count>().expect("a number").number),
        (scenario.drive, 7)
    );
    drop(received);
    scenario.node.wait_for(&["sent 7: Delivered"]);
    scenario.order(Order::Ask("test".to_owned()));
    let question = scenario.endpoint.receive(DEADLINE).expect("the node is there").expect("a question");
    assert_eq!(question.kind(), Kind::named("process.who"));
    scenario.endpoint.reply(&question, &Me { pid: 0, counts: vec![4, 2] }).expect("the node takes it");
    scenario.node.wait_for(&["answer [4, 2]"]);
    scenario.order(Order::Send("nobody".to_owned(), 8));
    scenario.node.wait_for(&["not sent 8: no application is called 'nobody'"]);
    let mut nobody = scenario
        .api
        .register_transport_address(Registration::new().name("nobody"))
        .expect("the node takes it");
    scenario.order(Order::Send("nobody".to_owned(), 9));
    assert_eq!(
        nobody
            .receive(DEADLINE)
            .expect("the node is there")
            .expect("a number")
            .decode::<Count>()
            .expect("a number")
            .number,
        9
    );
    scenario.node.wait_for(&["sent 9: Delivered"]);
}

fn group_membership_survives_restarts(place: &str) {
    let mut scenario = start(place);
    let group = Tid::group("drives");
    let send = |scenario: &mut Scenario, value| {
        scenario.endpoint.send(group, &Level { value }).expect("the node takes it")
    };
    // Once it is handled, the node has processed the order before it: its messages arrive in order.
    let wait_until_handled = |scenario: &mut Scenario| {
        scenario.order(Order::Send("test".to_owned(), 1));
        drop(scenario.endpoint.receive(DEADLINE).expect("the node is there").expect("a number"));
    };
    scenario.order(Order::Join("drives".to_owned()));
    wait_until_handled(&mut scenario);
    send(&mut scenario, 1);
    scenario.node.wait_for(&["level 1"]);
    assert_eq!(scenario.order_confirmed(Order::Panic), Outcome::Failed);
    send(&mut scenario, 2);
    scenario.node.wait_for(&["level 2"]);
    scenario.order(Order::Leave("drives".to_owned()));
    wait_until_handled(&mut scenario);
    send(&mut scenario, 3);
    scenario.endpoint.send(scenario.drive, &Level { value: 4 }).expect("the node takes it");
    scenario.node.wait_for(&["level 4"]);
    assert!(scenario.node.output().iter().all(|line| !line.contains("level 3")));
}

fn group_send_reports_each_members_outcome(place: &str) {
    let mut scenario = start(place);
    // The group is empty.
    scenario.order(Order::SendToGroup("drives".to_owned()));
    scenario.node.wait_for(&["group 1: "]);
    // Two members in other processes: one accepts the message, and the other does not handle it.
    let register = || {
        let member = scenario.api.register_transport_address(Registration::new());
        let mut member = member.expect("the node takes it");
        member.join("drives").expect("it is in few groups");
        member
    };
    let (mut takes, mut refuses) = (register(), register());
    scenario.order(Order::SendToGroup("drives".to_owned()));
    takes.receive(DEADLINE).expect("the node is there").expect("a number").settle(Outcome::Delivered);
    let refused = Outcome::Rejected(Rejection::UnknownKind);
    refuses.receive(DEADLINE).expect("the node is there").expect("a number").settle(refused);
    let line = format!("group 1: {}: Delivered, {}: Rejected(UnknownKind)", takes.tid(), refuses.tid());
    scenario.node.wait_for(&[&line]);
    // And: a message to the application's group has its outcome, too
    takes.leave("drives").expect("it was in it");
    assert_eq!(scenario.order_confirmed(Order::Join("drives".to_owned())), Outcome::Delivered);
    let (drive, count) = (scenario.drive, Count { number: 2 });
    let list = until("both are members", || {
        let sent = takes.message(Tid::group("drives"), &count).confirmed_by_each(Duration::from_millis(500));
        Some(sent.expect("it is sent")).filter(|list| list.len() == 2)
    });
    let entry = list.iter().find(|member| member.tid == drive).expect("it is a member");
    assert_eq!(entry.outcome, Outcome::Delivered);
}

fn silent_input_is_noticed(place: &str) {
    let mut scenario = start(place);
    scenario.node.wait_for(&["silence"]);
    scenario.endpoint.send(scenario.drive, &Level { value: 1 }).expect("the node takes it");
    scenario.node.wait_for(&["level 1"]);
    scenario.node.wait_for(&["silence"]);
}

fn lost_requirement_is_reported_and_resolved_again(place: &str) {
    let mut scenario = Scenario::start_requiring("helper", &["--place", place]);
    let former = scenario.helper.take().expect("it was required");
    let former_tid = former.tid();
    former.unregister().expect("the node takes it");
    scenario.node.wait_for(&["requirement Lost", "helper is None"]);
    let helper = scenario
        .api
        .register_transport_address(Registration::new().name("helper"))
        .expect("the node takes it");
    assert_ne!(helper.tid(), former_tid);
    scenario.node.wait_for(&["requirement Met", &format!("helper is Some({:?})", helper.tid())]);
}

fn pause_lasts_until_the_requirement_returns(place: &str) {
    let mut scenario = Scenario::start_requiring("helper", &["--place", place, "--on-lost", "pause"]);
    scenario.helper.take().expect("it was required").unregister().expect("the node answers");
    scenario.node.wait_for(&["requirement Lost"]);
    (1..=100).for_each(|number| scenario.count(number));
    let paused =
        scenario.endpoint.message(scenario.drive, &Order::Refuse).confirmed(Duration::from_millis(100));
    assert!(matches!(paused, Ok(Outcome::Unknown | Outcome::Expired)), "{paused:?}");
    let helper = scenario.api.register_transport_address(Registration::new().name("helper"));
    scenario.node.wait_for(&["requirement Met"]);
    assert_eq!(scenario.count_confirmed(101), Outcome::Delivered);
    assert_eq!(scenario.who().counts, (1..=101).collect::<Vec<_>>());
    drop(helper);
}

fn restart_waits_until_the_requirement_returns(place: &str) {
    let mut scenario = Scenario::start_requiring("helper", &["--place", place, "--on-lost", "restart"]);
    scenario.node.wait_for(&["started"]);
    scenario.helper.take().expect("it was required").unregister().expect("the node answers");
    scenario.node.wait_for(&["stopping"]);
    scenario.count(1);
    let helper = scenario.api.register_transport_address(Registration::new().name("helper"));
    scenario.node.wait_for(&["started"]);
    assert_eq!(scenario.count_confirmed(2), Outcome::Delivered);
    assert_eq!(scenario.who().counts, [1, 2]);
    assert!(scenario.node.output().iter().all(|line| !line.contains("a child failed")));
    drop(helper);
}

fn large_messages_go_both_ways(place: &str) {
    let mut scenario = start(place);
    let drive = scenario.drive;
    // More than the window, more than a socket holds, and almost the longest.
    for (length, count) in [(1_000, 100), (100_000, 20), (1_000_000, 3)] {
        let payload = vec![7; length];
        for _ in 0..count {
            scenario
                .endpoint
                .send(drive, &Order::Echo("test".to_owned(), payload.clone()))
                .expect("the node takes it");
        }
        for _ in 0..count {
            let echo = scenario.endpoint.receive(DEADLINE).expect("the node is there").expect("an echo");
            let Order::Echo(_, bytes) = echo.decode().expect("an order") else { panic!("another order") };
            assert!(bytes == payload);
        }
    }
    assert_eq!(
        scenario.endpoint.message(drive, &Who {}).ask::<Me>(DEADLINE).expect("the node takes it").counts,
        [0; 0]
    );
}

fn stopping_node_lets_the_application_ramp_down(place: &str) {
    let mut scenario = start(place);
    scenario.node.signal(Signal::TERM);
    scenario.node.wait_for(&["ramping down"]);
    scenario.node.wait_for(&["stopping"]);
    assert_eq!(scenario.node.wait_for_exit(), Some(0));
}

fn stopping_the_actix_system_ends_nothing_and_is_logged(place: &str) {
    let mut scenario = start(place);
    assert_eq!(scenario.count_confirmed(1), Outcome::Delivered);
    for count in 2..=3 {
        assert_eq!(scenario.order_confirmed(Order::StopTheSystem), Outcome::Delivered);
        assert_eq!(scenario.count_confirmed(count), Outcome::Delivered);
    }
    scenario.node.wait_for(&["actix::System::current().stop()", "NodeHandle::stop"]);
    assert_eq!(scenario.who().counts, [1, 2, 3], "it is the same incarnation");
    scenario.node.signal(Signal::TERM);
    assert_eq!(scenario.node.wait_for_exit(), Some(0), "and the node still ends in order");
}
