//! Unconfirmed messages that are not delivered: from an application in a process of its own, and to one.

use sinew::{AppAddress, Tid, message::Rejection, prelude::*};
use sinew_tests::{orders::Order, until};

use crate::scenario::Scenario;

payload!("process.unheard", Control =>
    #[derive(Debug)]
    struct Unheard {}
);

#[test]
fn an_application_in_a_process_of_its_own_is_told_what_nobody_took() {
    let mut scenario = Scenario::start(&[]);
    let nobody = Tid::new(scenario.drive.node, AppAddress::fixed(9).expect("in the range"));
    scenario.order(Order::SendTo(nobody.bits()));
    scenario.node.wait_for(&["sent: Ok(())"]);
    scenario.node.wait_for(&[
        "undelivered: 1 message of type process.count",
        &nobody.to_string(),
        "no application has this TID",
    ]);
}

#[test]
fn the_sender_of_a_type_that_such_an_application_does_not_handle_is_told() {
    let mut scenario = Scenario::start(&[]);
    scenario.endpoint.send(scenario.drive, &Unheard {}).expect("the node takes it");
    scenario.node.wait_for(&["drive (", "does not handle", "sent by test (", "to its AppSpec"]);
    let undelivered = until("a report", || {
        drop(scenario.endpoint.receive(Duration::from_millis(10)).expect("the node is up"));
        scenario.endpoint.take_undelivered()
    });
    assert_eq!((undelivered.destination, undelivered.why), (scenario.drive, Rejection::UnknownKind));
    assert_eq!(undelivered.name.as_deref(), Some("drive"));
    assert_eq!((undelivered.kind, undelivered.count), (Some(Unheard::KIND), 1));
}
