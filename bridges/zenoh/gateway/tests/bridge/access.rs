//! The access list of the node decides on the bridge's messages, too.

use zenoh::Wait;

use crate::stage::{RULES, Stage, get};

#[test]
fn access_list_refuses_a_message_that_its_rule_passes() {
    let directory = sinew_testkit::TestDirectory::new();
    let list = "[[rule]]\nfrom = [\"zenoh\"]\nto = [\"knee.drive\"]\n[[rule]]\nfrom = [\"*\"]\ngroups = [\"telemetry\"]\n";
    let path = directory.write("access.toml", list);
    let settings = format!("[security]\naccess = \"{}\"\n", path.display());
    let Some(mut stage) = Stage::start(RULES, &settings) else { return };
    let session = stage.session();
    let moves = stage.key("n/knee.drive/robot.move");
    session.put(&moves, r#"{"degrees":30}"#).wait().expect("a session");
    stage.robot.wait_for(&["moved to 30"]);
    // Confirmed messages come from the clients for requests, which no rule of the list names.
    let outcome = get(&session, &moves, r#"{"degrees":40}"#).expect("an outcome");
    assert!(outcome.contains("NotAllowed"), "{outcome}");
    stage.wait_for_count("rejected", 1);
}
