//! The periodic checks, and their pauses.

use std::{cell::Cell, rc::Rc, time::Duration};

use sinew_model::periodic_checks::PeriodicChecks;
use tokio::time::timeout;

use super::bench::{run, within};

const PERIOD: Duration = Duration::from_millis(1);

#[test]
fn nothing_is_polled_while_there_is_nothing() {
    run(async {
        let (ticks, left, looks) = (PeriodicChecks::default(), Cell::new(3), Rc::new(Cell::new(0)));
        let counted = looks.clone();
        let look = move || {
            counted.set(counted.get() + 1);
            left.set(left.get() - 1);
            left.get() > 0
        };
        let mut looking = std::pin::pin!(ticks.run(PERIOD, look));
        let mut comes_to = async |count| {
            let reached = async {
                while looks.get() < count {
                    let looked = timeout(PERIOD, looking.as_mut()).await;
                    looked.expect_err("it never ends");
                }
            };
            within("so many looks", reached).await;
            timeout(20 * PERIOD, looking.as_mut()).await.expect_err("it never ends");
            assert_eq!(looks.get(), count, "then nothing was wanted");
        };
        // Twice there is something, and twice nothing.
        comes_to(4).await;
        ticks.request();
        ticks.request();
        // There is nothing: it is polled twice.
        comes_to(6).await;
    });
}

#[test]
fn repeated_requests_are_polled_every_time() {
    run(async {
        let (ticks, waits, taken) = (PeriodicChecks::default(), Cell::new(false), Cell::new(0));
        let look = || {
            taken.set(taken.get() + u32::from(waits.replace(false)));
            false
        };
        let want = async {
            for n in 1..=100 {
                waits.set(true);
                ticks.request();
                within("a look", async {
                    while taken.get() < n {
                        tokio::task::yield_now().await;
                    }
                })
                .await;
            }
        };
        tokio::select! {
            () = ticks.run(PERIOD, look) => {}
            () = want => {}
        }
        assert_eq!(taken.get(), 100);
    });
}
