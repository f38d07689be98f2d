//! Tests of `src/robot/drive/anomaly.rs`.

use super::*;

#[test]
fn repeated_or_reordered_command_is_suspect() {
    for wrong in [Tally { repeated: 1, ..Tally::default() }, Tally { backwards: 1, ..Tally::default() }] {
        let mut anomaly = Anomaly::default();
        anomaly.note(&wrong, true);
        assert!(anomaly.is_there(), "{wrong:?}");
    }
    let mut anomaly = Anomaly::default();
    anomaly.note(&Tally { too_old: 9, restarted: 1, gaps: 3, lost: 3, ..Tally::default() }, true);
    assert!(!anomaly.is_there(), "late, lost and anew are what networks and nodes do");
}

fn after(words: &[(u64, u64, bool)]) -> bool {
    let mut anomaly = Anomaly::default();
    for &(good, corrupt, is_open) in words {
        anomaly.note(&Tally { good, corrupt, ..Tally::default() }, is_open);
    }
    anomaly.is_there()
}

#[test]
fn damaged_commands_after_silence_stay_suspect() {
    assert!(!after(&[(100, 0, true), (100, 0, false)]), "silence alone is not");
    assert!(after(&[(100, 0, true), (100, 0, false), (100, 3, false)]));
    assert!(after(&[(100, 0, true), (100, 3, false), (1_000, 3, false)]), "it is shut all the while");
}

#[test]
fn tolerated_damaged_command_is_forgotten_after_a_good_stretch() {
    let borne = [(100, 1, true), (100 + GOOD_STRETCH - 1, 1, true)];
    assert!(after(&borne));
    assert!(!after(&[borne[0], (100 + GOOD_STRETCH, 1, true), (100 + GOOD_STRETCH, 1, false)]));
}

#[test]
fn damaged_command_after_arming_is_suspect_again() {
    let mut anomaly = Anomaly::default();
    let tally = |corrupt| Tally { good: 100, corrupt, ..Tally::default() };
    anomaly.note(&tally(2), false);
    anomaly.forget();
    anomaly.note(&tally(2), true);
    assert!(!anomaly.is_there());
    anomaly.note(&tally(3), false);
    assert!(anomaly.is_there());
}
