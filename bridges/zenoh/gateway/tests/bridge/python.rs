//! A program with the Zenoh of PyPI (`eclipse-zenoh`).

use std::{path::Path, process::Command};

use sinew_testkit::NodeProcess;

use crate::stage::{RULES, Stage};

const MORE: &str = r#"
[liveness]
apps = ["knee.*"]

[[out]]
name = "operator"
types = ["robot.question"]
encoding = "json"
reply = "robot.answer"
"#;

#[test]
fn python_program_sends_receives_asks_and_sees_liveliness() {
    let python = std::env::var_os("SINEW_PYTHON").unwrap_or_else(|| "python3".into());
    let found = Command::new(&python).args(["-c", "import zenoh"]).output();
    if !found.is_ok_and(|output| output.status.success()) {
        println!("skipped: {} has no eclipse-zenoh: pip install eclipse-zenoh", python.display());
        return;
    }
    let Some(mut stage) = Stage::start(&(RULES.to_owned() + MORE), "") else { return };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/client.py");
    let mut command = Command::new(python);
    command.arg(script).args([&stage.endpoint, &stage.project]);
    let mut program = NodeProcess::start("client.py", command);
    stage.robot.wait_for(&["moved to 55"]);
    stage.robot.wait_for(&["answer: 7 of Python"]);
    program.wait_for(&["done"]);
    assert_eq!(program.wait_for_exit(), Some(0));
    stage.wait_for_count("malformed", 1);
    stage.wait_for_count("foreign_key", 1);
    stage.wait_for_count("no_rule", 1);
}
