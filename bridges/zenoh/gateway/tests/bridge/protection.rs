//! Commands of protected types.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use zenoh::Wait;

use crate::stage::Stage;

const RULES: &str = r#"
[[in]]
to = "motor"
types = ["robot.torque"]
encoding = "json"
class = "stream"
protected = { period_ms = 100 }

[[in]]
to = "knee.drive"
types = ["robot.torque"]
encoding = "json"
"#;

/// Ends a loop in another thread, also if the test fails: its scope waits for that thread.
struct EndOnDrop<'a>(&'a AtomicBool);

impl Drop for EndOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[test]
fn protected_commands_pass_only_through_the_protected_sender() {
    let Some(mut stage) = Stage::start(RULES, "") else { return };
    stage.robot.wait_for(&["guarded"]);
    let session = stage.session();
    let (torque, other) = (stage.key("n/motor/robot.torque"), stage.key("n/knee.drive/robot.torque"));
    let is_over = AtomicBool::new(false);
    thread::scope(|scope| {
        let _end = EndOnDrop(&is_over);
        scope.spawn(|| {
            while !is_over.load(Ordering::Relaxed) {
                session.put(&torque, r#"{"newton_metres":2.5}"#).wait().expect("a session");
                // Half of the period of the type.
                thread::sleep(Duration::from_millis(50));
            }
        });
        stage.robot.wait_for(&["armed"]);
        stage.robot.wait_for(&["torque 2.5"]);
    });
    stage.bridge.wait_for(&["robot.torque is a protected type"]);
    // The rule has no protected sender.
    session.put(&other, r#"{"newton_metres":9}"#).wait().expect("a session");
    stage.wait_for_count("unprotected", 1);
    assert!(!stage.robot.output().iter().any(|line| line == "torque 9"));
}
