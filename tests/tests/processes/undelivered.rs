//! Undelivered unconfirmed messages: from an application in a process of its own, and to one.

use sinew::{AppAddress, Tid, message::Rejection, prelude::*};
use sinew_testkit::until;
use sinew_tests::orders::Order;

use super::scenario::Scenario;

payload!("process.unheard", Control =>
    #[derive(Debug)]
    struct Unheard {}
);

#[test]
fn app_in_own_process_is_told_of_undelivered_messages() {
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
fn sender_is_told_of_types_that_the_app_lacks() {
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
