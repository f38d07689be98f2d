//! A layer hangs and is restarted on a new thread: the tasks of its former instance remain registered as waiters, and
//! are never polled.

use std::{cell::Cell, pin::pin, time::Duration};

use sinew_model::{config::NodeConfig, notifications::testing::waits, periodic_checks::PeriodicChecks};
use sinew_runtime::{tid::Incarnation, time::Time};

use super::{
    bench::{ByHand, NINE, Node, next, run, within},
    node_down_events::{incarnation_of, notify_of_the_end},
};
use crate::{State, node_down_events, peer::Store};

#[test]
fn present_end_notifier_is_woken_despite_a_former_waiter() {
    run(async {
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let mut former = pin!(node_down_events::run_retries(state.clone()));
        waits(former.as_mut());
        let mut present = pin!(node_down_events::run_retries(state.clone()));
        let woken = waits(present.as_mut());
        state.store.fewer_outstanding.notify_one();
        assert!(woken.is());
    });
}

#[test]
fn end_notifier_polls_although_others_consume_all_notifications() {
    run(async {
        // Given
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let _peer = ByHand::linked_to(&mut node).await;
        let gncl = &node.state.store;
        let mut looks = pin!(node_down_events::run_retries(node.state.clone()));
        let woken = waits(looks.as_mut());
        let mut others: Vec<_> = (0..64).map(|_| Box::pin(gncl.fewer_outstanding.notified())).collect();
        others.iter_mut().for_each(|other| drop(waits(other.as_mut())));
        gncl.fewer_outstanding.notify_one();
        assert!(woken.is(), "it was the first");
        waits(looks.as_mut());
        // When
        gncl.record_departure(Time::now(), NINE, incarnation_of(&node, NINE));
        notify_of_the_end(&node, NINE);
        gncl.fence(NINE, incarnation_of(&node, NINE));
        // Then
        tokio::select! {
            () = looks => panic!("it never ends"),
            event = next("its end", &mut inbox) => assert_eq!(event.payload[..], *b"its end"),
        }
    });
}

#[test]
fn present_queue_server_is_woken_despite_a_former_waiter() {
    run(async {
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let mut former = pin!(Store::serve_queues(state.clone()));
        waits(former.as_mut());
        let mut present = pin!(Store::serve_queues(state.clone()));
        let woken = waits(present.as_mut());
        state.store.queues_changed.notify_one();
        assert!(woken.is());
    });
}

#[test]
fn present_ticker_is_woken_despite_a_former_waiter() {
    run(async {
        let (ticks, looks) = (PeriodicChecks::default(), Cell::new(0));
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
            // There is nothing: it is polled twice.
            () = looked(2) => {}
        }
        tokio::select! {
            () = present.as_mut() => panic!("it never ends"),
            () = looked(4) => {}
        }
        let woken = waits(present.as_mut());
        ticks.request();
        assert!(woken.is());
    });
}
