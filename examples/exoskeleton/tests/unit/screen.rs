//! Tests of `src/robot/launch/screen.rs`.

use super::*;

#[test]
fn waiting_is_printed_without_its_time() {
    let words = "knee.drive has waited 1.3 s for hip.sensor (not there)";
    assert_eq!(untimed(words), "knee.drive waits for hip.sensor (not there)");
    assert_eq!(untimed("something else"), "something else");
}
