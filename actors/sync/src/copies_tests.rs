//! Tests of when holders of a copy of the directory are notified of a change, and when not.

use std::task::{Context, Wake, Waker};

use super::*;

/// A waker that runs when the directory changes, in the task that changes it. It records whether the directory can be
/// read at that moment.
struct ReadAttempt(Arc<State>, Mutex<Vec<bool>>);

impl Wake for ReadAttempt {
    fn wake(self: Arc<Self>) {
        let can_be_read = self.0.core.try_lock().is_ok();
        self.1.lock().unwrap_or_else(PoisonError::into_inner).push(can_be_read);
    }
}

#[test]
fn directory_change_is_counted_before_it_is_visible() {
    run(async {
        let mut bench = Bench::new().await;
        let _sent = bench.links_knee();
        bench.registers_gait();
        // When: the test waits for the next change
        let attempt = Arc::new(ReadAttempt(bench.state.clone(), Mutex::default()));
        let waker = Waker::from(attempt.clone());
        let mut changes = bench.state.ctx.directory_changes.subscribe();
        {
            let mut changed = std::pin::pin!(changes.changed());
            assert!(changed.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
            bench.knee_publishes(1, true);
            assert_eq!(bench.released().await, GAIT);
        }
        // Then
        assert_eq!(*attempt.1.lock().unwrap_or_else(PoisonError::into_inner), [false]);
    });
}

#[test]
fn unchanged_directory_wakes_no_holder_of_a_copy() {
    run(async {
        // Given
        let mut bench = Bench::new().await;
        let _sent = bench.links_knee();
        bench.registers_gait();
        bench.knee_publishes(1, true);
        assert_eq!(bench.released().await, GAIT);
        let changes = bench.state.ctx.directory_changes.subscribe();
        let before = *changes.borrow();
        // When: the knee repeats its list, as it does every two seconds, while a task waits
        bench.knee_publishes(1, true);
        bench.state.ctx.router.deliver(arrival(GAIT, 7)).unwrap();
        bench.post_event(Event::Monitors);
        while !bench.state.ctx.event_queues.sync.is_empty() {
            tokio::task::yield_now().await;
        }
        // Then
        assert_eq!(*changes.borrow() - before, 0);
        // And: when the list has changed
        bench.knee_publishes(2, false);
        while !bench.state.ctx.event_queues.sync.is_empty() {
            tokio::task::yield_now().await;
        }
        assert!(*changes.borrow() > before);
    });
}
