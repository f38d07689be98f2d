//! A root that hangs.

use super::*;

// spec: NDL-9.2
#[test]
fn a_node_whose_root_hangs_says_so_asks_it_once_and_says_that_it_gets_on_when_it_answers() {
    run(async {
        // given: a root that takes nothing out of its post
        let mut first = Node::start(1, |ndl| ndl.period = Duration::from_millis(100)).await;
        let seed = first.udp();
        let mut second = Node::new(2, 1, |ndl| {
            (ndl.period, ndl.seeds) = (Duration::from_millis(100), vec![seed.into()]);
        });
        second.has_root = false;
        second.start_layer().await;
        let root = Tid::new(second.stores.node, AppAddress::NONE);
        let found: NodeEvent = first.event().await.decode().unwrap();
        assert!(matches!(found, NodeEvent::NodeFound { .. }), "{found:?}");
        // then
        let told: NodeEvent = first.event().await.decode().unwrap();
        assert!(matches!(told, NodeEvent::AppStalled { app, .. } if app == root), "{told:?}");
        assert_eq!(second.stores.posts.root.len(), 1, "it is asked nothing more");
        // and when it goes on
        let layer = second.layer.as_ref().expect("it runs");
        layer.spawn(all_gets_on(second.stores.posts.root.attach()));
        let told: NodeEvent = first.event().await.decode().unwrap();
        assert!(matches!(told, NodeEvent::AppResumed { app, .. } if app == root), "{told:?}");
    });
}
