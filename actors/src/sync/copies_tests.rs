//! When those who have a copy of the directory are told that it has changed, and when not.

use std::task::{Context, Wake, Waker};

use super::*;

/// Woken when the directory changes, by whoever changes it: sees whether anybody can read it at that moment.
struct Looker(Arc<Stores>, Mutex<Vec<bool>>);

impl Wake for Looker {
    fn wake(self: Arc<Self>) {
        let can_be_read = self.0.sync.try_lock().is_ok();
        self.1.lock().unwrap_or_else(PoisonError::into_inner).push(can_be_read);
    }
}

#[test]
fn a_change_of_the_directory_is_counted_before_anybody_can_see_it() {
    run(async {
        let mut bench = Bench::new().await;
        let _sent = bench.links_knee();
        bench.registers_gait();
        // When: the next change is looked for
        let looker = Arc::new(Looker(bench.stores.clone(), Mutex::default()));
        let waker = Waker::from(looker.clone());
        let mut changes = bench.stores.directory_changes.subscribe();
        {
            let mut changed = std::pin::pin!(changes.changed());
            assert!(changed.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
            bench.knee_says(1, true);
            assert_eq!(bench.released().await, GAIT);
        }
        // Then
        assert_eq!(*looker.1.lock().unwrap_or_else(PoisonError::into_inner), [false]);
    });
}

#[test]
fn what_says_nothing_new_of_the_directory_wakes_nobody_who_has_a_copy_of_it() {
    run(async {
        // Given
        let mut bench = Bench::new().await;
        let _sent = bench.links_knee();
        bench.registers_gait();
        bench.knee_says(1, true);
        assert_eq!(bench.released().await, GAIT);
        let changes = bench.stores.directory_changes.subscribe();
        let before = *changes.borrow();
        // When: the knee says the same again, as it does every two seconds, and somebody waits
        bench.knee_says(1, true);
        bench.stores.router.deliver(arrival(GAIT, 7)).unwrap();
        bench.tells(Event::Monitors);
        while !bench.stores.posts.sync.is_empty() {
            tokio::task::yield_now().await;
        }
        // Then
        assert_eq!(*changes.borrow() - before, 0);
        // And when it says something new
        bench.knee_says(2, false);
        while !bench.stores.posts.sync.is_empty() {
            tokio::task::yield_now().await;
        }
        assert!(*changes.borrow() > before);
    });
}
