//! A root that hangs.

use super::{node::all_gets_on, *};

// spec: NDL-9.2
#[test]
fn hung_root_and_its_return_are_reported() {
    run(async {
        // given: a root that reads nothing from its queue
        let mut first = Node::start(1, |ndl| ndl.period = Duration::from_millis(100)).await;
        let seed = first.udp();
        let mut second = Node::new(2, 1, |ndl| {
            (ndl.period, ndl.seeds) = (Duration::from_millis(100), vec![seed.into()]);
        });
        second.has_root = false;
        second.start_layer().await;
        let root = Tid::new(second.state.ctx.node, AppAddress::NONE);
        let found: NodeEvent = first.event().await.decode().unwrap();
        assert!(matches!(found, NodeEvent::NodeFound { .. }), "{found:?}");
        // then
        let event: NodeEvent = first.event().await.decode().unwrap();
        assert!(matches!(event, NodeEvent::AppStalled { app, .. } if app == root), "{event:?}");
        assert_eq!(second.root.len(), 1, "it is asked nothing more");
        // and: when it continues
        let layer = second.layer.as_ref().expect("it runs");
        layer.spawn(all_gets_on(second.root.attach()));
        let event: NodeEvent = first.event().await.decode().unwrap();
        assert!(matches!(event, NodeEvent::AppResumed { app, .. } if app == root), "{event:?}");
    });
}
