//! When the other nodes hear of a change.

use sinew_runtime::wire::Kind;

use super::*;
use crate::sync::core::barrier::RETRY;

// spec: SYNC-2
#[test]
fn a_change_follows_a_short_list_within_a_millisecond_and_a_long_one_within_five() {
    for (kinds, waits) in [(1, 1), (64, 5)] {
        // Given: lists of some hundred bytes, and of some 5,000.
        let mut bench = Bench::new();
        bench.links(KNEE, LIFE);
        for index in 0..16 {
            bench.registers(index, &format!("drive.{index}"), &[]);
            let kinds = (0..kinds).map(|kind| Kind::named(&format!("demo.{kind}"))).collect();
            bench.hears(Input::AppChanged(AppFact::Handles { app: app(index), kinds }));
        }
        assert_eq!(published(&bench.passes(REPEAT)).len(), 1);
        // When
        assert_eq!(published(&bench.ready(0)), []);
        // Then
        for millisecond in 1..=waits {
            let said = published(&bench.passes(Duration::from_millis(1)));
            assert_eq!(said.len(), usize::from(millisecond == waits), "after {millisecond} ms of {waits}");
        }
    }
}

// spec: SYNC-2
#[test]
fn what_the_queue_to_a_peer_did_not_take_is_said_again_soon() {
    let mut bench = Bench::new();
    bench.registers(0, "sensor", &[]);
    assert_eq!(published(&bench.links(KNEE, LIFE)).len(), 1);
    bench.hears(Input::ListNotTaken { to: KNEE });
    assert_eq!(published(&bench.passes(RETRY)).len(), 1);
}

// spec: SYNC-2
#[test]
fn others_hear_of_a_change_before_an_application_of_this_node_is_let_go_by_it() {
    let mut bench = Bench::new();
    bench.links(KNEE, LIFE);
    bench.registers(0, "sensor", &[]);
    bench.registers(1, "gait", &["sensor"]);
    bench.passes(SPACING);
    bench.now = bench.now + SPACING;
    let outputs = bench.ready(0);
    assert!(matches!(outputs[..], [Output::Publish { to: KNEE, .. }, Output::Release { .. }]), "{outputs:?}");
}
