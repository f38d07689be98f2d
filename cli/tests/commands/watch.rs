//! `sinew watch` of applications here and on another node.

use std::process::Command;

use serde_json::Value;
use sinew::{NodeApi, Registration, message::Kind};
use sinew_testkit::NodeProcess;

use crate::scenario::{Answer, Scenario};

/// A running `sinew watch`.
struct Watcher(NodeProcess);

impl Watcher {
    fn of(scenario: &Scenario, target: &str) -> Self {
        Self::with(scenario, target, &[])
    }

    fn with(scenario: &Scenario, target: &str, more: &[&str]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
        command.arg("--socket").arg(scenario.socket("knee")).args(["watch", target, "--json"]).args(more);
        Self(NodeProcess::start("sinew watch", command))
    }

    /// Returns the next shown message. It is sent again after each interval of rates without one, because the watch may
    /// start later.
    fn message(&mut self, send: impl Fn() -> Answer) -> Value {
        loop {
            let line: Value = serde_json::from_str(&self.0.wait_for(&[])).expect("JSON");
            if line["event"] == "message" {
                return line;
            }
            let sent = send();
            assert_eq!(sent.code, Some(0), "{}{}", sent.out, sent.err);
        }
    }
}

/// Parses each line as JSON.
fn lines(text: &str) -> Vec<Value> {
    text.lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|why| panic!("{why}: {line}")))
        .collect()
}

#[test]
fn traffic_is_shown_decoded_from_either_node() {
    // Given: the hip sends counts to the knee
    let scenario = Scenario::new();
    let (_hip, _knee) = scenario.start_a_hip_that_sends_to_a_knee();
    for here in ["hip", "knee"] {
        for (target, is_sent) in [("hip", true), ("knee", false)] {
            // When
            let answer = scenario.sinew(here, &["watch", target, "--count", "20", "--json"]);
            // Then: all of them, in order, except those that the node reports as dropped
            assert_eq!(answer.code, Some(0), "{}", answer.err);
            let events = lines(&answer.out);
            let messages: Vec<_> = events.iter().filter(|line| line["event"] == "message").collect();
            assert_eq!(messages.len(), 20);
            let numbers: Vec<_> =
                messages.iter().map(|m| m["payload"]["number"].as_u64().expect("a count")).collect();
            assert!(numbers.is_sorted_by(|one, next| one < next), "{numbers:?}");
            for message in messages {
                assert_eq!((&message["sent"], &message["kind"]), (&is_sent.into(), &"scenario.count".into()));
                assert_eq!((&message["class"], &message["source_name"]), (&"bulk".into(), &"hip".into()));
                assert!(message["refused"].is_null() && message["age_ns"].is_u64(), "{message}");
            }
            let rates: Vec<_> = events.iter().filter(|line| line["event"] == "rates").collect();
            let counted: u64 = rates
                .iter()
                .flat_map(|r| r["kinds"].as_array())
                .flatten()
                .filter_map(|k| k["count"].as_u64())
                .sum();
            assert!(counted >= 20, "{rates:?}");
            // A node that is not polled in time drops copies, and reports their number.
            let missing = numbers[19] - numbers[0] - 19;
            let dropped: u64 = rates.iter().filter_map(|r| r["dropped"].as_u64()).sum();
            assert!(missing <= dropped, "{numbers:?} {rates:?}");
        }
    }
    // And: as text, and only the requested number
    let text = scenario.sinew("hip", &["watch", "knee", "--count", "3"]).out;
    assert!(text.contains("-> scenario.count") && text.contains(r#"{"number":"#), "{text}");
    let none = scenario.sinew("hip", &["watch", "knee", "--sent", "--for", "1", "--json"]);
    assert!(lines(&none.out).iter().all(|line| line["event"] == "rates"), "{}", none.out);
    let other = scenario.sinew("hip", &["watch", "knee", "--kind", "test.other", "--for", "1", "--json"]);
    assert!(lines(&other.out).iter().all(|line| line["event"] == "rates"), "{}", other.out);
}

#[test]
fn rejected_message_is_shown_with_the_reason() {
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &[]);
    let tid = knee.wait_for(&["started"]).split_once(' ').expect("it says its TID").1.to_owned();
    // When: a message is sent to an unused address, and that address is watched
    let mut watcher = Watcher::of(&scenario, "127.0.0.2/1fff");
    let seen = watcher
        .message(|| scenario.sinew("knee", &["send", "127.0.0.2/1fff", "test.any", "[1]", "--unconfirmed"]));
    // Then
    assert_eq!((&seen["refused"], &seen["payload"]), (&"NoSuchApplication".into(), &serde_json::json!([1])));
    assert_eq!(seen["kind"], format!("{}", Kind::named("test.any")), "no program has named this kind");
    drop(tid);
}

#[test]
fn watched_name_is_followed_to_a_new_address() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    for name in ["sensor", "leg/sensor"] {
        // Given: an application of another process, watched by its name
        let register = || {
            let api = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
            api.register_transport_address(Registration::new().name(name)).expect("it is registered")
        };
        let send = || scenario.sinew("knee", &["send", name, "test.any", "1", "--unconfirmed"]);
        let first = register();
        let mut watcher = Watcher::of(&scenario, name);
        let seen = watcher.message(send);
        assert_eq!(seen["target"], first.tid().to_string());
        // When: it ends, another application takes its address, and it starts again at a different one
        first.unregister().expect("it gives its address back");
        let other = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
        let other = other.register_transport_address(Registration::new()).expect("it is registered");
        let second = register();
        assert_ne!(second.tid(), other.tid());
        // Then
        let target = second.tid().to_string();
        while watcher.message(send)["target"] != target {}
        drop(other);
    }
}

#[test]
fn unknown_name_is_an_error_without_wait() {
    let scenario = Scenario::new();
    let mut node = scenario.start("knee", 2, &[]);
    node.wait_for(&["started"]);
    let answer = scenario.sinew("knee", &["watch", "kneee"]);
    assert!(
        answer.code == Some(1) && answer.err.contains("`kneee`; nearest: knee (application)"),
        "{}",
        answer.err
    );
    assert!(answer.err.contains("`--wait` waits for it"), "{}", answer.err);
    let long = "k".repeat(64);
    let answer = scenario.sinew("knee", &["watch", &long, "--wait"]);
    assert!(answer.code == Some(1) && answer.err.contains("it has 64 bytes"), "{}", answer.err);
    // When: the command waits for it, and an application with the name starts
    let mut watcher = Watcher::with(&scenario, "sensor", &["--wait"]);
    let api = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
    let sensor =
        api.register_transport_address(Registration::new().name("sensor")).expect("it is registered");
    // Then
    let seen =
        watcher.message(|| scenario.sinew("knee", &["send", "sensor", "test.any", "1", "--unconfirmed"]));
    assert_eq!(seen["target"], sensor.tid().to_string());
}

#[test]
fn node_cannot_be_watched_as_an_application() {
    let scenario = Scenario::new();
    let _node = scenario.start("knee", 2, &["--requires", "ankle"]);
    let answer = scenario.sinew("knee", &["watch", "127.0.0.2", "--for", "1"]);
    assert!(answer.code == Some(1) && answer.err.contains("sinew apps"), "{}{}", answer.out, answer.err);
}
