//! A layer hangs and is restarted on a new thread: the tasks of its former life wait on, and nobody polls them.

use std::{cell::Cell, pin::pin, time::Duration};

use sinew_runtime::{tid::Incarnation, time::Time};

use super::{
    bench::{ByHand, NINE, Node, next, run, within},
    ends::{life, tell_the_end},
};
use crate::{
    aftermath,
    config::NodeConfig,
    gncl::{peer::Store, ticks::Ticks},
    stores::Stores,
    takeover::tests::waits,
};

#[test]
fn who_tells_of_ends_is_told_that_less_is_owed_whoever_waited_before() {
    run(async {
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let mut former = pin!(aftermath::carry_on(stores.clone()));
        waits(former.as_mut());
        let mut present = pin!(aftermath::carry_on(stores.clone()));
        let woken = waits(present.as_mut());
        stores.gncl.fewer_owed.notify_one();
        assert!(woken.is());
    });
}

#[test]
fn who_tells_of_ends_looks_although_somebody_else_is_told_all() {
    run(async {
        // Given
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let _peer = ByHand::linked_to(&mut node).await;
        let gncl = &node.stores.gncl;
        let mut looks = pin!(aftermath::carry_on(node.stores.clone()));
        let woken = waits(looks.as_mut());
        let mut others: Vec<_> = (0..64).map(|_| Box::pin(gncl.fewer_owed.notified())).collect();
        others.iter_mut().for_each(|other| drop(waits(other.as_mut())));
        gncl.fewer_owed.notify_one();
        assert!(woken.is(), "it was the first");
        waits(looks.as_mut());
        // When
        gncl.leaves(Time::now(), NINE, life(&node, NINE));
        tell_the_end(&node, NINE);
        gncl.fence(NINE, life(&node, NINE));
        // Then
        tokio::select! {
            () = looks => panic!("it never ends"),
            event = next("its end", &mut inbox) => assert_eq!(event.payload[..], *b"its end"),
        }
    });
}

#[test]
fn who_offers_what_waits_is_told_of_room_whoever_waited_before() {
    run(async {
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let mut former = pin!(Store::serve_those_held_up(stores.clone()));
        waits(former.as_mut());
        let mut present = pin!(Store::serve_those_held_up(stores.clone()));
        let woken = waits(present.as_mut());
        stores.gncl.held_up.notify_one();
        assert!(woken.is());
    });
}

#[test]
fn who_looks_is_told_what_is_wanted_whoever_looked_before() {
    run(async {
        let (ticks, looks) = (Ticks::default(), Cell::new(0));
        let run = || {
            ticks.run(Duration::from_millis(1), || {
                looks.set(looks.get() + 1);
                false
            })
        };
        let looked = async |times| {
            within("so many looks", async {
                while looks.get() < times {
                    tokio::task::yield_now().await;
                }
            })
            .await;
        };
        let (mut former, mut present) = (pin!(run()), pin!(run()));
        tokio::select! {
            () = former.as_mut() => panic!("it never ends"),
            // There is nothing, looked at twice.
            () = looked(2) => {}
        }
        tokio::select! {
            () = present.as_mut() => panic!("it never ends"),
            () = looked(4) => {}
        }
        let woken = waits(present.as_mut());
        ticks.want();
        assert!(woken.is());
    });
}
