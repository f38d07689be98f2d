//! What guests may have wait at the sync manager, and that it keeps nobody else out.

use super::*;
use crate::{lncl::OF_USER_AT_SYNC, stores::POST_CAPACITY};

/// An application of a guest, and two users who are guests.
const GUEST: AppAddress = AppAddress::new(0x8000_0000);
const USERS: [u32; 2] = [1_001, 1_002];

impl Bench {
    /// An application of this user arrives, by way of LNCL, as often as that is taken; and how often it was.
    fn guest_fills(&self, uid: u32) -> usize {
        let sends = |correlation| {
            let admitted = self.stores.shares_of_guests.admit(HERE, uid, arrival(GUEST, correlation));
            admitted.is_ok_and(|message| self.stores.router.send(message).is_ok())
        };
        (1..=POST_CAPACITY as u64).take_while(|correlation| sends(*correlation)).count()
    }

    /// The manager has read all that waits.
    async fn reads_all(&self) {
        let read = async {
            while !self.stores.posts.sync.is_empty() {
                tokio::task::yield_now().await;
            }
        };
        within("all is read", read).await;
    }
}

#[test]
fn the_robots_own_arrivals_are_taken_where_guests_have_sent_all_that_they_may() {
    run(async {
        // Given: it comes to none of them, as this has its thread
        let bench = Bench::new().await;
        // When
        assert_eq!(USERS.map(|uid| bench.guest_fills(uid)), [OF_USER_AT_SYNC; 2]);
        assert_eq!(bench.guest_fills(1_003), 0, "two have all that guests may have");
        // Then: of the robot's own as many as ever, and as many of other nodes
        assert_eq!(bench.stores.posts.sync.len(), 2 * OF_USER_AT_SYNC);
        let knee = || directory(Tid::new(KNEE, AppAddress::SYNC), Bytes::new());
        for correlation in (2 * OF_USER_AT_SYNC..POST_CAPACITY / 2).step_by(2) {
            bench.stores.router.send(arrival(GAIT, correlation as u64)).unwrap();
            bench.stores.router.deliver(knee()).unwrap();
        }
    });
}

#[test]
fn what_a_guest_sends_has_room_again_when_the_manager_has_read_what_it_sent_before() {
    run(async {
        let bench = Bench::new().await;
        for _ in 0..2 {
            assert_eq!(bench.guest_fills(USERS[0]), OF_USER_AT_SYNC);
            bench.reads_all().await;
        }
    });
}

#[test]
fn a_manager_that_fails_with_a_guests_message_in_hand_costs_that_guest_no_room_nor_does_its_successor() {
    run(async {
        // Given: a manager that fails when it answers the guest's first message
        let bench = Bench::new().await;
        let route = LocalRoute { outlet: Arc::new(Mine), events: Arc::new([]) };
        bench.stores.router.set_local(GUEST, route);
        assert_eq!(bench.guest_fills(USERS[0]), OF_USER_AT_SYNC);
        let fails = async {
            while bench.stores.posts.sync.len() == OF_USER_AT_SYNC {
                tokio::task::yield_now().await;
            }
        };
        within("the first message is read", fails).await;
        assert_eq!(
            bench.stores.posts.sync.len(),
            OF_USER_AT_SYNC - 1,
            "the others wait for the next manager"
        );
        assert_eq!(bench.guest_fills(USERS[0]), 1, "the one that was in its hand waits no more");
        // When
        bench.stores.router.remove_local(GUEST);
        bench.start_manager().await;
        bench.reads_all().await;
        // Then
        assert_eq!(bench.guest_fills(USERS[0]), OF_USER_AT_SYNC);
    });
}

#[test]
fn what_is_not_taken_of_a_guest_or_waits_where_nobody_reads_any_more_leaves_it_its_room() {
    run(async {
        // Given
        let bench = Bench::new().await;
        assert_eq!(bench.guest_fills(USERS[0]), OF_USER_AT_SYNC);
        // When
        drop(bench.stores.posts.sync.close());
        // Then: all that waited there has gone, and what is refused there takes no room
        assert_eq!([(); 2].map(|()| bench.guest_fills(USERS[0])), [0; 2]);
        let admit = |number| bench.stores.shares_of_guests.admit(HERE, USERS[0], arrival(GUEST, number)).ok();
        let held: Vec<_> = (1..=1_000).map_while(admit).collect();
        assert_eq!(held.len(), OF_USER_AT_SYNC);
    });
}
