//! A node whose root fails: the one fault that ends it, in order.

use sinew::{node::NodeEnd, prelude::*};
use sinew_tests::{
    Ground, all_run,
    puppet::{Order, Seen, Stage},
};

#[test]
fn a_root_that_panics_ends_its_node_in_order_with_its_words_and_tells_the_applications() {
    let (puppet, log) = Stage::new().app("puppet");
    let node = Ground::new().node("node").app(puppet).start().expect("a node");
    log.wait_for(Seen::Started(1));
    node.handle().fail_root();
    log.wait_for(Seen::Stopping(1));
    let NodeEnd::GaveUp(why) = node.stop() else { panic!("it gave up") };
    assert!(why.contains("the root panicked: a fault was planned for the root"), "{why}");
}

#[test]
fn an_application_has_its_time_to_stop_after_a_panic_of_the_root_and_then_its_last_will_is_sent() {
    let ground = Ground::new();
    // Longer than is waited for what was declared with no time, and never enough.
    let time = Duration::from_millis(5_500);
    let (slow, _) = Stage::new().stopping(|_, _| Running::Continue).app("slow");
    let slow = slow.requires(["heir"]).stop_within(time).last_will("heir", &Order { number: 7 });
    let (heir, seen) = Stage::new().app("heir");
    let there = ground.node("there").app(heir).start().expect("a node");
    let here = ground.node("home").app(slow).start().expect("a node");
    all_run(&[&there, &here]);
    here.handle().fail_root();
    seen.wait_for(Seen::Got(1, 7));
    assert!(matches!(here.wait_for_end(), NodeEnd::GaveUp(_)));
}
