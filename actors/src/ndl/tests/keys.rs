//! A node with keys and one without, which do not find each other: what each of them says of that.

use std::{net::SocketAddr, time::Duration};

use sinew_runtime::{tid::Incarnation, time::Time};

use super::{LOOPBACK, Node, free_port, lock, run, within};
use crate::{
    secured::Secured,
    security::{
        Identity,
        tests::ground::{self, Authority},
    },
    stores::Stores,
};

/// Gives a node that has not begun keys of its own.
fn secure(stores: &Stores) {
    let project = stores.config.project.clone();
    let keys = Authority::new(&project);
    let name = stores.config.name.clone();
    let credentials = keys.credentials_of(&Identity { project, address: stores.node, name });
    let secured = Secured::new(ground::tls(&credentials), &credentials, 8, Incarnation(1));
    assert!(stores.secured.set(secured).is_ok(), "it had none");
}

/// The detail of what was refused because of this, as whoever asks is told it.
fn refused(stores: &Stores, cause: &str) -> Option<String> {
    let told = [lock(stores).refusals().told(), stores.refusals.told()];
    told.into_iter().flatten().find(|told| told.cause == cause).map(|told| told.detail)
}

#[test]
fn a_node_with_keys_and_one_without_do_not_find_each_other_and_each_says_why_with_what_mends_it() {
    run(async {
        // given: each has the other for a seed
        let ports = [free_port(), free_port()];
        let [at, other] = ports.map(|port| SocketAddr::from((LOOPBACK, port)));
        let start = |number, port, seed: SocketAddr| {
            Node::new(number, 1, |ndl| {
                (ndl.port, ndl.seeds, ndl.period) = (port, vec![seed.into()], Duration::from_millis(50));
            })
        };
        let (mut open, mut secured) = (start(1, ports[0], other), start(2, ports[1], at));
        secure(&secured.stores);
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
                    if let Some(detail) = refused(&node.stores, cause) {
                        break detail;
                    }
                    tokio::time::sleep(Duration::from_millis(1)).await;
                }
            })
            .await;
            assert!(detail.contains(words), "{detail}");
            // It is not cut where it is shown.
            assert!(detail.ends_with(last), "{detail}");
            // Nobody who proves nothing has a secured node advise to be without keys.
            assert!(detail.contains("take security.keys from") == std::ptr::eq(node, &open), "{detail}");
            assert!(lock(&node.stores).members(Time::now()).is_empty());
        }
        assert_eq!(refused(&open.stores, "NDL datagram is not a frame"), None);
    });
}
