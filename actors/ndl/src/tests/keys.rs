//! A node with keys and one without do not find each other: the report of each.

use std::{net::SocketAddr, time::Duration};

use sinew_runtime::{tid::Incarnation, time::Time};
use sinew_security::{
    Identity,
    node_security::NodeSecurity,
    testing::{self, Authority},
};

use super::{LOOPBACK, Node, free_port, lock_core, run, within};
use crate::State;

/// Gives keys to a node that has not started.
fn secure(state: &State) {
    let project = state.ctx.config.project.clone();
    let keys = Authority::new(&project);
    let name = state.ctx.config.name.clone();
    let credentials = keys.credentials_of(&Identity { project, address: state.ctx.node, name });
    let secured = NodeSecurity::new(testing::tls(&credentials), &credentials, 8, Incarnation(1));
    assert!(state.security.secured.set(secured).is_ok(), "it had none");
}

/// Returns the detail of rejections for this cause, as an inspection shows it.
fn refused(state: &State, cause: &str) -> Option<String> {
    let told = [lock_core(state).refusals().reports(), state.ctx.refusals.reports()];
    told.into_iter().flatten().find(|told| told.cause == cause).map(|told| told.detail)
}

#[test]
fn nodes_with_and_without_keys_explain_their_refusal() {
    run(async {
        // given: each is a seed of the other
        let ports = [free_port(), free_port()];
        let [at, other] = ports.map(|port| SocketAddr::from((LOOPBACK, port)));
        let start = |number, port, seed: SocketAddr| {
            Node::new(number, 1, |ndl| {
                (ndl.port, ndl.seeds, ndl.period) = (port, vec![seed.into()], Duration::from_millis(50));
            })
        };
        let (mut open, mut secured) = (start(1, ports[0], other), start(2, ports[1], at));
        secure(&secured.state);
        // when
        open.start_layer().await;
        secured.start_layer().await;
        // then
        for (node, cause, words, last) in [
            (&open, "sealed NDL datagram at a node without keys", "it is sealed", "that one's configuration"),
            (
                &secured,
                "NDL datagram not of this project's keys",
                "it has no seal",
                "set security.keys there",
            ),
        ] {
            let detail = within("a refusal", async {
                loop {
                    if let Some(detail) = refused(&node.state, cause) {
                        break detail;
                    }
                    tokio::time::sleep(Duration::from_millis(1)).await;
                }
            })
            .await;
            assert!(detail.contains(words), "{detail}");
            // The text is not truncated in the report.
            assert!(detail.ends_with(last), "{detail}");
            // An unauthenticated node must not make a secured node advise the removal of keys.
            assert!(detail.contains("take security.keys from") == std::ptr::eq(node, &open), "{detail}");
            assert!(lock_core(&node.state).members(Time::now()).is_empty());
        }
        assert_eq!(refused(&open.state, "NDL datagram is not a frame"), None);
    });
}
