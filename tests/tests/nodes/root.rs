//! A node with a failing root: the one fault that ends it, in order.

use sinew::{node::NodeEnd, prelude::*};
use sinew_testkit::{
    Loopback, all_run,
    scripted::{Order, Script, Seen},
};

#[test]
fn panic_of_the_root_ends_the_node_in_order() {
    let (scripted, log) = Script::new().app("scripted");
    let node = Loopback::new().node("node").app(scripted).start().expect("a node");
    log.wait_for(Seen::Started(1));
    node.handle().fail_root();
    log.wait_for(Seen::Stopping(1));
    let NodeEnd::GaveUp(why) = node.stop() else { panic!("it gave up") };
    assert!(why.contains("the root panicked: a fault was planned for the root"), "{why}");
}

#[test]
fn panic_of_the_root_grants_stop_time_and_wills() {
    let loopback = Loopback::new();
    // Longer than the stop limit of applications without a declared one, and never enough.
    let time = Duration::from_millis(5_500);
    let (slow, _) = Script::new().stopping(|_, _| Running::Continue).app("slow");
    let slow = slow.requires(["heir"]).stop_within(time).last_will("heir", &Order { number: 7 });
    let (heir, seen) = Script::new().app("heir");
    let there = loopback.node("there").app(heir).start().expect("a node");
    let here = loopback.node("home").app(slow).start().expect("a node");
    all_run(&[&there, &here]);
    here.handle().fail_root();
    seen.wait_for(Seen::Got(1, 7));
    assert!(matches!(here.wait_for_end(), NodeEnd::GaveUp(_)));
}
