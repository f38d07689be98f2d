//! `sinew contracts`: contracts that close, a planted missing one, and planted times that do not add up.

use std::process::Command;

use serde_json::Value;
use sinew_testkit::{NodeProcess, program};

use crate::scenario::Scenario;

/// Starts the node of this number in the scenario of contracts: 0 commands outputs, the others obey.
fn start(scenario: &Scenario, number: u8, plant: &str) -> NodeProcess {
    let mut command = Command::new(program("scenarios"));
    command.args(["--role", "contract-node", &number.to_string(), &scenario.group.to_string(), "cli"]);
    // No machine is too slow for this slack.
    command.arg(scenario.directory.join("")).arg("1000").arg(plant);
    let mut node = NodeProcess::start(&format!("node {number}"), command);
    node.wait_for(&["up"]);
    node
}

/// Whether the node of `drive.left` knows the name of its commander, and has measured its output.
fn is_known(json: &Value) -> bool {
    let rows = json["contracts"].as_array().map_or(&[][..], Vec::as_slice);
    json["outputs"] == 1
        && json["silent"] == serde_json::json!([])
        && rows.iter().all(|row| !row["measured_us"].is_null())
}

#[test]
fn contracts_of_two_nodes_close() {
    let scenario = Scenario::new();
    let _central = start(&scenario, 0, "none");
    let _left = start(&scenario, 1, "none");
    // When, then
    let json = scenario.until("all contracts close", "central", &["contracts"], |json| {
        is_known(json)
            && json["closes"] == true
            && json["contracts"].as_array().is_some_and(|rows| rows.len() == 3)
    });
    let lost = &json["contracts"][0];
    assert_eq!(
        (&lost["app"], &lost["subject"], &lost["condition"]),
        (&"drive.left".into(), &"control".into(), &"lost".into())
    );
    assert_eq!(
        (&lost["within_us"], &lost["worst_us"], &lost["fault"]),
        (&1_220_000.into(), &1_220_000.into(), &Value::Null)
    );
    let table = scenario.sinew("left", &["contracts"]);
    assert_eq!(table.code, Some(0), "{}{}", table.out, table.err);
    assert!(
        table.out.contains("control late by 160.0 ms") && table.out.contains("all close"),
        "{}",
        table.out
    );
}

#[test]
fn missing_contract_is_named_with_its_declaration() {
    let scenario = Scenario::new();
    let _central = start(&scenario, 0, "none");
    let _left = start(&scenario, 1, "missing");
    let json = scenario.until("the commander is known", "central", &["contracts"], |json| {
        json["missing"][0]["sender"] == "control"
    });
    assert_eq!(json["missing"][0]["conditions"], serde_json::json!(["lost", "late", "stopped"]), "{json}");
    let answer = scenario.sinew("central", &["contracts", "--wide"]);
    assert_eq!(answer.code, Some(1), "{}{}", answer.out, answer.err);
    assert!(answer.out.contains("drive.left obeys control by careless.torque"), "{}", answer.out);
    assert!(answer.out.contains("Contract::when_lost(\"control\")"), "{}", answer.out);
}

#[test]
fn times_that_do_not_add_up_are_named() {
    let scenario = Scenario::new();
    let _central = start(&scenario, 0, "none");
    let _left = start(&scenario, 1, "short");
    scenario.until("the commander is known", "central", &["contracts"], |json| {
        json["contracts"][0]["worst_us"] == 1_220_000 && json["missing"] == serde_json::json!([])
    });
    let answer = scenario.sinew("central", &["contracts", "--wide"]);
    assert_eq!(answer.code, Some(1), "{}{}", answer.out, answer.err);
    let sum = "160.0 ms age_max of careless.torque + 60.0 ms within of careless.torque + 1000.0 ms contracts.slack_ms = 1220.0 ms, more than 1219.0 ms";
    assert!(answer.out.contains(sum), "{}", answer.out);
    assert!(answer.out.contains("does not close"), "{}", answer.out);
}
