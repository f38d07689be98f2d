//! When other nodes receive a change.

use sinew_runtime::wire::Kind;

use super::*;

// spec: SYNC-2
#[test]
fn changes_are_spaced_by_the_length_of_the_list() {
    for (kinds, waits) in [(1, 1), (64, 5)] {
        // Given: lists of some hundred bytes, and of some 5,000.
        let mut bench = Bench::new();
        bench.links(KNEE, INCARNATION);
        for index in 0..16 {
            bench.registers(index, &format!("drive.{index}"), &[]);
            let kinds = (0..kinds).map(|kind| Kind::named(&format!("demo.{kind}"))).collect();
            bench.handle(Input::AppChanged(AppFact::Handles { app: app(index), kinds }));
        }
        assert_eq!(published(&bench.passes(REPEAT)).len(), 1);
        // When
        assert_eq!(published(&bench.ready(0)), []);
        // Then
        for millisecond in 1..=waits {
            let lists = published(&bench.passes(Duration::from_millis(1)));
            assert_eq!(lists.len(), usize::from(millisecond == waits), "after {millisecond} ms of {waits}");
        }
    }
}

// spec: SYNC-2
#[test]
fn list_rejected_by_a_queue_is_retried_soon() {
    let mut bench = Bench::new();
    bench.registers(0, "sensor", &[]);
    assert_eq!(published(&bench.links(KNEE, INCARNATION)).len(), 1);
    bench.handle(Input::ListRejected { to: KNEE });
    assert_eq!(published(&bench.passes(RETRY)).len(), 1);
}

// spec: SYNC-2
#[test]
fn change_is_published_before_it_releases_a_local_application() {
    let mut bench = Bench::new();
    bench.links(KNEE, INCARNATION);
    bench.registers(0, "sensor", &[]);
    bench.registers(1, "gait", &["sensor"]);
    bench.passes(SPACING);
    bench.now = bench.now + SPACING;
    let outputs = bench.ready(0);
    assert!(matches!(outputs[..], [Output::Publish { to: KNEE, .. }, Output::Release { .. }]), "{outputs:?}");
}
