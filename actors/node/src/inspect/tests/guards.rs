//! The outputs that applications of the node guard.

use std::time::Duration;

use sinew_model::config::NodeConfig;
use sinew_runtime::{
    protection::{Guard, Protection},
    tid::{AppAddress, NodeAddress, Tid},
    wire::Payload,
};

use super::Bench;
use crate::inspect::reports::GuardReport;

#[derive(serde::Serialize, serde::Deserialize)]
struct Torque;

impl Payload for Torque {
    const NAME: &'static str = "test.inspect.torque";
    const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(20)));
}

#[test]
fn outputs_of_own_applications_are_reported_with_their_states() {
    // Given: an output of an application of the node, and one of another node in the same process
    let bench = Bench::new(NodeConfig::new("knee"));
    let node = bench.node().node;
    let sender = Tid::new(NodeAddress::new(8), AppAddress::new(1));
    let guard = |node| {
        let receiver = Tid::new(node, AppAddress::new(2));
        Guard::new::<Torque>(sender, receiver, (), |(), _| {}).expect("there is the thread")
    };
    let (own, _foreign) = (guard(node), guard(NodeAddress::new(9)));
    // When, then
    let receiver = Tid::new(node, AppAddress::new(2));
    let (kind_name, safe) = (Torque::NAME.to_owned(), Some("NotArmed".to_owned()));
    let expected = GuardReport { receiver, sender, kind_name, safe, is_safe_failed: false };
    assert_eq!(bench.node().guards, [expected]);
    drop(own);
    assert_eq!(bench.node().guards, []);
}
