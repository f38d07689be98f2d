//! Waits at barriers that are given up half way.

use std::sync::{Mutex, PoisonError, mpsc::SyncSender};

use sinew_runtime::{
    router::{LocalRoute, Outlet, Refused},
    tid::AppAddress,
};

use super::*;
use crate::{
    client::Barrier,
    sync::{ArriveAtBarrier, LeaveBarrier},
};

/// In place of the node's sync manager: keeps what it is sent.
struct Manager(Mutex<SyncSender<Message>>);

impl Outlet for Manager {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        let said = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        said.send(message).map_err(|refused| Refused::new(refused.0, Rejection::Closed))
    }
}

// spec: SYNC-10
#[test]
fn who_gives_a_wait_at_a_barrier_up_leaves_it() {
    for transport in BOTH {
        // Given: an application waits at a barrier
        let node = TestNode::start();
        let (say, said) = sync_channel(8);
        let outlet = Arc::new(Manager(Mutex::new(say)));
        node.stores.router.set_local(AppAddress::SYNC, LocalRoute { outlet, events: Arc::new([]) });
        runtime().block_on(async {
            let mut endpoint = endpoint(&node, transport).await;
            let barrier = Barrier::new("calibrated", ["hip", "knee"]);
            let mut arrived = None;
            {
                let mut meeting = pin!(endpoint.meet(&barrier));
                while arrived.is_none() {
                    assert!(poll!(meeting.as_mut()).is_pending());
                    arrived = said.try_recv().ok();
                    tokio::task::yield_now().await;
                }
                // When: it is dropped here, as where a stop came first
            }
            // Then
            let arrived = arrived.unwrap();
            assert_eq!(arrived.header.kind, ArriveAtBarrier::KIND);
            let left = said.recv_timeout(WATCHDOG).expect("it leaves");
            assert_eq!(left.header.source, endpoint.tid());
            let left: LeaveBarrier = left.decode().unwrap();
            let correlation = Some(arrived.header.correlation);
            assert_eq!(left, LeaveBarrier { barrier: "calibrated".to_owned(), correlation });
        });
    }
}

// spec: SYNC-10
#[test]
fn who_gives_a_wait_up_while_memory_is_lent_leaves_when_that_is_given_back() {
    let node = TestNode::start();
    let (say, said) = sync_channel(8);
    let outlet = Arc::new(Manager(Mutex::new(say)));
    node.stores.router.set_local(AppAddress::SYNC, LocalRoute { outlet, events: Arc::new([]) });
    runtime().block_on(async {
        // Given: nothing goes out while memory is lent
        let mut endpoint = endpoint(&node, Transport::Ring).await;
        let lent = endpoint.create_message(Tid::NONE, RAW, 8).unwrap();
        let barrier = Barrier::new("calibrated", ["hip", "knee"]);
        assert!(endpoint.meet(&barrier).await.is_err(), "nothing goes out while memory is lent");
        assert!(said.try_recv().is_err());
        // When
        drop(lent);
        assert!(
            timeout(Duration::from_millis(1), endpoint.receive()).await.is_err(),
            "nobody sends anything"
        );
        // Then
        let left: LeaveBarrier = said.recv_timeout(WATCHDOG).expect("it leaves").decode().unwrap();
        assert_eq!(left.barrier, "calibrated");
    });
}
