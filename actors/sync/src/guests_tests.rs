//! Tests of how much guests may have queued at the sync manager, and that they keep out nobody else's messages.

use sinew_model::{guest_quotas::OF_USER_AT_SYNC, limits::EVENT_QUEUE_CAPACITY};

use super::*;

/// An application of a guest, and two users that are guests.
const GUEST: AppAddress = AppAddress::new(0x8000_0000);
const USERS: [u32; 2] = [1_001, 1_002];

impl Bench {
    /// Sends arrivals of an application of this user, by LNCL, until one is rejected. Returns the number of accepted
    /// ones.
    fn guest_fills(&self, uid: u32) -> usize {
        let sends = |correlation| {
            let admitted = self.guest_quotas.admit(HERE, uid, arrival(GUEST, correlation));
            admitted.is_ok_and(|message| self.state.ctx.router.send(message).is_ok())
        };
        (1..=EVENT_QUEUE_CAPACITY as u64).take_while(|correlation| sends(*correlation)).count()
    }

    /// Waits until the manager has read all that is queued.
    async fn reads_all(&self) {
        let read = async {
            while !self.state.ctx.event_queues.sync.is_empty() {
                tokio::task::yield_now().await;
            }
        };
        within("all is read", read).await;
    }
}

#[test]
fn own_arrivals_are_accepted_with_guests_at_their_limit() {
    run(async {
        // Given: the manager reads none of the messages, as the test occupies its thread
        let bench = Bench::new().await;
        // When
        assert_eq!(USERS.map(|uid| bench.guest_fills(uid)), [OF_USER_AT_SYNC; 2]);
        assert_eq!(bench.guest_fills(1_003), 0, "two have all that guests may have");
        // Then: as many as ever are accepted from the robot's own applications, and as many from other nodes
        assert_eq!(bench.state.ctx.event_queues.sync.len(), 2 * OF_USER_AT_SYNC);
        let knee = || directory(Tid::new(KNEE, AppAddress::SYNC), Bytes::new());
        for correlation in (2 * OF_USER_AT_SYNC..EVENT_QUEUE_CAPACITY / 2).step_by(2) {
            bench.state.ctx.router.send(arrival(GAIT, correlation as u64)).unwrap();
            bench.state.ctx.router.deliver(knee()).unwrap();
        }
    });
}

#[test]
fn guest_has_room_again_after_the_manager_has_read() {
    run(async {
        let bench = Bench::new().await;
        for _ in 0..2 {
            assert_eq!(bench.guest_fills(USERS[0]), OF_USER_AT_SYNC);
            bench.reads_all().await;
        }
    });
}

#[test]
fn failing_manager_costs_the_guest_no_room() {
    run(async {
        // Given: a manager that fails while it answers the guest's first message
        let bench = Bench::new().await;
        let route = LocalRoute { sink: Arc::new(Mine), events: Arc::new([]) };
        bench.state.ctx.router.set_local(GUEST, route);
        assert_eq!(bench.guest_fills(USERS[0]), OF_USER_AT_SYNC);
        let fails = async {
            while bench.state.ctx.event_queues.sync.len() == OF_USER_AT_SYNC {
                tokio::task::yield_now().await;
            }
        };
        within("the first message is read", fails).await;
        assert_eq!(
            bench.state.ctx.event_queues.sync.len(),
            OF_USER_AT_SYNC - 1,
            "the others wait for the next manager"
        );
        assert_eq!(bench.guest_fills(USERS[0]), 1, "the one that was in its hand waits no more");
        // When
        bench.state.ctx.router.remove_local(GUEST);
        bench.start_manager().await;
        bench.reads_all().await;
        // Then
        assert_eq!(bench.guest_fills(USERS[0]), OF_USER_AT_SYNC);
    });
}

#[test]
fn rejected_and_discarded_messages_leave_the_guest_its_room() {
    run(async {
        // Given
        let bench = Bench::new().await;
        assert_eq!(bench.guest_fills(USERS[0]), OF_USER_AT_SYNC);
        // When
        drop(bench.state.ctx.event_queues.sync.close());
        // Then: all that was queued there is gone, and rejected messages take no room
        assert_eq!([(); 2].map(|()| bench.guest_fills(USERS[0])), [0; 2]);
        let admit = |number| bench.guest_quotas.admit(HERE, USERS[0], arrival(GUEST, number)).ok();
        let held: Vec<_> = (1..=1_000).map_while(admit).collect();
        assert_eq!(held.len(), OF_USER_AT_SYNC);
    });
}
