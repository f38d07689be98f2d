//! Abandoned waits at barriers.

use std::sync::{Mutex, PoisonError, mpsc::SyncSender};

use sinew_model::barrier::{ArriveAtBarrier, LeaveBarrier};
use sinew_runtime::{
    router::{LocalRoute, MessageSink, SubmitError},
    tid::AppAddress,
};

use super::*;
use crate::Barrier;

/// Replaces the node's sync manager: keeps the messages that it receives.
struct Manager(Mutex<SyncSender<Message>>);

impl MessageSink for Manager {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        let requests = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        requests.send(message).map_err(|refused| SubmitError::new(refused.0, Rejection::Closed))
    }
}

// spec: SYNC-10
#[test]
fn abandoned_wait_leaves_the_barrier() {
    for transport in BOTH {
        // Given: an application waits at a barrier
        let node = TestNode::start();
        let (sender, requests) = sync_channel(8);
        let sink = Arc::new(Manager(Mutex::new(sender)));
        node.router().set_local(AppAddress::SYNC, LocalRoute { sink, events: Arc::new([]) });
        runtime().block_on(async {
            let mut endpoint = endpoint(&node, transport).await;
            let barrier = Barrier::new("calibrated", ["hip", "knee"]);
            let mut arrived = None;
            {
                let mut meeting = pin!(endpoint.meet(&barrier));
                while arrived.is_none() {
                    assert!(poll!(meeting.as_mut()).is_pending());
                    arrived = requests.try_recv().ok();
                    tokio::task::yield_now().await;
                }
                // When: it is dropped here, as when a stop comes first
            }
            // Then
            let arrived = arrived.unwrap();
            assert_eq!(arrived.header.kind, ArriveAtBarrier::KIND);
            let left = requests.recv_timeout(WATCHDOG).expect("it leaves");
            assert_eq!(left.header.source, endpoint.tid());
            let left: LeaveBarrier = left.decode().unwrap();
            let correlation = Some(arrived.header.correlation);
            assert_eq!(left, LeaveBarrier { barrier: "calibrated".to_owned(), correlation });
        });
    }
}

// spec: SYNC-10
#[test]
fn wait_abandoned_during_loan_leaves_after_the_loan() {
    let node = TestNode::start();
    let (sender, requests) = sync_channel(8);
    let sink = Arc::new(Manager(Mutex::new(sender)));
    node.router().set_local(AppAddress::SYNC, LocalRoute { sink, events: Arc::new([]) });
    runtime().block_on(async {
        // Given: nothing is sent while memory is loaned
        let mut endpoint = endpoint(&node, Transport::Ring).await;
        let lent = endpoint.create_message(Tid::NONE, RAW, 8).unwrap();
        let barrier = Barrier::new("calibrated", ["hip", "knee"]);
        assert!(endpoint.meet(&barrier).await.is_err(), "nothing goes out while memory is lent");
        assert!(requests.try_recv().is_err());
        // When
        drop(lent);
        assert!(timeout(Duration::from_millis(1), endpoint.receive()).await.is_err(), "no request is sent");
        // Then
        let left: LeaveBarrier = requests.recv_timeout(WATCHDOG).expect("it leaves").decode().unwrap();
        assert_eq!(left.barrier, "calibrated");
    });
}
