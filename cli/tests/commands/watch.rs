//! `sinew watch` of applications here and on another node.

use std::{
    io::{BufRead, BufReader, Lines},
    process::{Child, ChildStdout, Command, Stdio},
};

use serde_json::Value;
use sinew::{NodeApi, Registration, message::Kind};

use crate::scenario::{Answer, Scenario};

/// `sinew watch`, until it is dropped.
struct Watcher {
    command: Child,
    out: Lines<BufReader<ChildStdout>>,
}

impl Watcher {
    fn of(scenario: &Scenario, whom: &str) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
        command.arg("--socket").arg(scenario.socket("knee")).args(["watch", whom, "--json"]);
        let mut command = command.stdout(Stdio::piped()).spawn().expect("the command starts");
        let out = BufReader::new(command.stdout.take().expect("its output is a pipe")).lines();
        Self { command, out }
    }

    /// The next message that is seen. Whenever there was none for as long as rates are said, it is sent again: the watch begins some time.
    fn message(&mut self, send: impl Fn() -> Answer) -> Value {
        loop {
            let line = self.out.next().expect("it lives").expect("it says a line");
            let line: Value = serde_json::from_str(&line).expect("JSON");
            if line["event"] == "message" {
                return line;
            }
            let sent = send();
            assert_eq!(sent.code, Some(0), "{}{}", sent.out, sent.err);
        }
    }
}

impl Drop for Watcher {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.command.kill();
        let _ = self.command.wait();
    }
}

/// Each line as JSON.
fn lines(text: &str) -> Vec<Value> {
    text.lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|why| panic!("{why}: {line}")))
        .collect()
}

#[test]
fn what_an_application_gets_and_sends_is_seen_decoded_from_either_node() {
    // Given: the hip sends counts to the knee
    let scenario = Scenario::new();
    let (_hip, _knee) = scenario.start_a_hip_that_sends_to_a_knee();
    for here in ["hip", "knee"] {
        for (whom, is_sent) in [("hip", true), ("knee", false)] {
            // When
            let answer = scenario.sinew(here, &["watch", whom, "--count", "20", "--json"]);
            // Then: all of them, in order, but for what the node says that it dropped
            assert_eq!(answer.code, Some(0), "{}", answer.err);
            let said = lines(&answer.out);
            let messages: Vec<_> = said.iter().filter(|line| line["event"] == "message").collect();
            assert_eq!(messages.len(), 20);
            let numbers: Vec<_> =
                messages.iter().map(|m| m["payload"]["number"].as_u64().expect("a count")).collect();
            assert!(numbers.is_sorted_by(|one, next| one < next), "{numbers:?}");
            for message in messages {
                assert_eq!((&message["sent"], &message["kind"]), (&is_sent.into(), &"scenario.count".into()));
                assert_eq!((&message["class"], &message["source_name"]), (&"bulk".into(), &"hip".into()));
                assert!(message["refused"].is_null() && message["age_ns"].is_u64(), "{message}");
            }
            let rates: Vec<_> = said.iter().filter(|line| line["event"] == "rates").collect();
            let counted: u64 = rates
                .iter()
                .flat_map(|r| r["kinds"].as_array())
                .flatten()
                .filter_map(|k| k["count"].as_u64())
                .sum();
            assert!(counted >= 20, "{rates:?}");
            // A node that is not asked in time drops what it saw, and says how much.
            let missing = numbers[19] - numbers[0] - 19;
            let dropped: u64 = rates.iter().filter_map(|r| r["dropped"].as_u64()).sum();
            assert!(missing <= dropped, "{numbers:?} {rates:?}");
        }
    }
    // And: for people, and only what was asked for
    let text = scenario.sinew("hip", &["watch", "knee", "--count", "3"]).out;
    assert!(text.contains("-> scenario.count") && text.contains(r#"{"number":"#), "{text}");
    let none = scenario.sinew("hip", &["watch", "knee", "--sent", "--for", "1", "--json"]);
    assert!(lines(&none.out).iter().all(|line| line["event"] == "rates"), "{}", none.out);
    let other = scenario.sinew("hip", &["watch", "knee", "--kind", "test.other", "--for", "1", "--json"]);
    assert!(lines(&other.out).iter().all(|line| line["event"] == "rates"), "{}", other.out);
}

#[test]
fn a_message_that_is_refused_is_seen_with_the_reason() {
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &[]);
    let tid = knee.wait_for(&["started"]).split_once(' ').expect("it says its TID").1.to_owned();
    // When: somebody sends to an address that nobody has, and somebody watches that
    let mut watcher = Watcher::of(&scenario, "127.0.0.2/1fff");
    let seen = watcher
        .message(|| scenario.sinew("knee", &["send", "127.0.0.2/1fff", "test.any", "[1]", "--unconfirmed"]));
    // Then
    assert_eq!((&seen["refused"], &seen["payload"]), (&"NoSuchApplication".into(), &serde_json::json!([1])));
    assert_eq!(seen["kind"], format!("{}", Kind::named("test.any")), "nobody has said what this is called");
    drop(tid);
}

#[test]
fn a_name_is_followed_to_where_its_application_is_started_again() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    for name in ["sensor", "leg/sensor"] {
        // Given: an application of another process, which is watched by its name
        let register = || {
            let api = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
            api.register_transport_address(Registration::new().name(name)).expect("it is registered")
        };
        let send = || scenario.sinew("knee", &["send", name, "test.any", "1", "--unconfirmed"]);
        let first = register();
        let mut watcher = Watcher::of(&scenario, name);
        let seen = watcher.message(send);
        assert_eq!(seen["target"], first.tid().to_string());
        // When: it ends, somebody else takes its address, and it comes again at another
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
fn a_node_is_no_application_to_be_watched() {
    let scenario = Scenario::new();
    let _node = scenario.start("knee", 2, &["--requires", "ankle"]);
    let answer = scenario.sinew("knee", &["watch", "127.0.0.2", "--for", "1"]);
    assert!(answer.code == Some(1) && answer.err.contains("sinew apps"), "{}{}", answer.out, answer.err);
}
