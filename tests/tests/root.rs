//! A node whose root fails: the one fault that ends it, in order.

use sinew::NodeEnd;
use sinew_tests::{
    Ground,
    puppet::{Seen, Stage},
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
