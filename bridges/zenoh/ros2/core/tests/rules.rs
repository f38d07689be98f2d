//! Rules of a mapping file, and the messages that they let through or refuse.

use std::{collections::BTreeMap, time::Duration};

use sinew_ros2_core::{
    Attachment, Catalog, Cause, Incoming, Outgoing, Payload, Value, decode, encode,
    mapping::{Mapping, MappingFile},
};

const HEAD: &str = "socket = \"/run/sinew/leg.sock\"\nrouters = [\"tcp/127.0.0.1:7447\"]\n";
const JOINTS: &str = r#"
[[to_ros]]
topic = "/joint_states"
type = "sensor_msgs/msg/JointState"
rate_hz = 100
max_age_ms = 50
set = { name = ["hip", "knee"], "header.frame_id" = "leg" }
[[to_ros.from]]
app = "hip.sensor"
sinew = "demo.angle"
fields = { "position[0]" = "degrees / 2" }
[[to_ros.from]]
app = "knee.sensor"
sinew = "demo.angle"
fields = { "position[1]" = "degrees * 2 + 1" }
"#;
const COMMAND: &str = r#"
[[from_ros]]
topic = "/knee/torque"
type = "std_msgs/msg/Float64"
rate_hz = 100
max_age_ms = 200
sinew = "demo.torque"
to = "knee.drive"
fields = { "set.newton_metres" = "data / 10" }
set = { "set.source" = "ros", count = 3 }
"#;

fn ms(milliseconds: u64) -> Duration {
    Duration::from_millis(milliseconds)
}

fn check(rules: &str) -> Result<Mapping, Vec<String>> {
    MappingFile::parse(&format!("{HEAD}{rules}")).map_err(|why| vec![why])?.check(&Catalog::shipped())
}

fn faults(rules: &str) -> String {
    check(rules).expect_err(rules).join("; ")
}

fn payload(members: &[(&str, Payload)]) -> Vec<u8> {
    let members = members.iter().map(|(name, value)| ((*name).to_owned(), value.clone())).collect();
    Payload::Map(members).write().expect("bytes")
}

fn degrees(degrees: f64) -> Vec<u8> {
    payload(&[("degrees", Payload::Float(degrees))])
}

fn joints() -> Outgoing {
    check(JOINTS).expect("a mapping").to_ros.remove(0)
}

fn torque() -> Incoming {
    check(COMMAND).expect("a mapping").from_ros.remove(0)
}

fn positions(topic: &Outgoing, bytes: &[u8]) -> Vec<Value> {
    decode(&topic.message, bytes).expect("a message").at(2).expect("positions").list().to_vec()
}

#[test]
fn topic_is_published_when_all_inputs_are_fresh() {
    let mut topic = joints();
    topic.take(0, &degrees(30.0), ms(1_000)).expect("it fits");
    assert_eq!(topic.poll(ms(1_001), 0), Ok(None), "the knee is missing");
    topic.take(1, &degrees(-4.0), ms(1_005)).expect("it fits");
    let bytes = topic.poll(ms(1_010), 5_000_000_123).expect("no fault").expect("all are there");
    let value = decode(&topic.message, &bytes).expect("a message");
    let header = value.at(0).expect("a header");
    // The newest input is 5 ms old.
    let stamp = Value::Message(vec![Value::Signed(4), Value::Unsigned(995_000_123)]);
    assert_eq!(header, &Value::Message(vec![stamp, Value::Text("leg".to_owned())]));
    assert_eq!(value.at(1).map(|names| names.list().len()), Some(2));
    assert_eq!(positions(&topic, &bytes), [Value::Float(15.0), Value::Float(-7.0)]);
    assert_eq!(topic.poll(ms(1_020), 0), Ok(None), "nothing is new");
    topic.take(1, &degrees(0.0), ms(1_060)).expect("it fits");
    assert_eq!(topic.poll(ms(1_060), 0), Ok(None), "the hip is 60 ms old");
}

#[test]
fn topic_keeps_its_rate() {
    let mut topic = joints();
    let mut published = 0;
    for at in 0..1_000 {
        topic.take(0, &degrees(1.0), ms(at)).expect("it fits");
        topic.take(1, &degrees(1.0), ms(at)).expect("it fits");
        published += u32::from(topic.poll(ms(at), 0).expect("no fault").is_some());
    }
    assert_eq!(published, 101);
}

#[test]
fn unfit_input_changes_nothing() {
    let mut topic = joints();
    topic.take(0, &degrees(2.0), ms(0)).expect("it fits");
    topic.take(1, &degrees(2.0), ms(0)).expect("it fits");
    let absent = topic.take(0, &payload(&[("radians", Payload::Float(1.0))]), ms(1));
    assert!(absent.expect_err("absent").to_string().contains("degrees: demo.angle has no such field"));
    let text = topic.take(0, &payload(&[("degrees", Payload::Text("1".to_owned()))]), ms(1));
    assert!(text.expect_err("a text").to_string().contains("a text in place of a number"));
    assert!(topic.take(0, &[0xc1], ms(1)).is_err());
    let bytes = topic.poll(ms(2), 0).expect("no fault").expect("it is fresh");
    assert_eq!(positions(&topic, &bytes), [Value::Float(1.0), Value::Float(5.0)]);
}

fn command(rule: &mut Incoming, data: f64, now: Duration, age_ms: i64) -> Result<Payload, Cause> {
    let bytes = encode(&rule.message, &Value::Message(vec![Value::Float(data)])).expect("bytes");
    let attachment = Attachment { sequence: 1, time_ns: 1_000_000_000 - age_ms * 1_000_000, gid: [0; 16] };
    let taken = rule.take(&bytes, Some(&attachment.encode()), now, 1_000_000_000);
    taken.map(|payload| Payload::read(&payload).expect("a payload")).map_err(|refusal| refusal.cause)
}

#[test]
fn command_has_fields_and_constants() {
    let mut rule = torque();
    let Ok(Payload::Map(members)) = command(&mut rule, 35.0, ms(0), 10) else { panic!("no command") };
    let members: BTreeMap<_, _> = members.into_iter().collect();
    assert_eq!(members["count"], Payload::Integer(3));
    let expected = [
        ("source".to_owned(), Payload::Text("ros".to_owned())),
        ("newton_metres".to_owned(), Payload::Float(3.5)),
    ];
    assert_eq!(members["set"], Payload::Map(expected.to_vec()));
}

#[test]
fn bad_commands_are_refused_by_cause() {
    let mut rule = torque();
    assert_eq!(command(&mut rule, 1.0, ms(0), 201), Err(Cause::TooOld));
    assert_eq!(command(&mut rule, 1.0, ms(0), -201), Err(Cause::TooOld), "from the future");
    assert_eq!(command(&mut rule, f64::NAN, ms(0), 0), Err(Cause::Malformed));
    assert_eq!(command(&mut rule, f64::INFINITY, ms(0), 0), Err(Cause::Malformed));
    let bytes = [0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    let cause = |refused: Result<Vec<u8>, sinew_ros2_core::Refusal>| refused.expect_err("a fault").cause;
    assert_eq!(cause(rule.take(&bytes, None, ms(0), 0)), Cause::TooOld);
    assert_eq!(cause(rule.take(&[0; 70_000], None, ms(0), 0)), Cause::TooLong);
    let attachment = Attachment { sequence: 1, time_ns: 0, gid: [0; 16] }.encode();
    assert_eq!(cause(rule.take(&bytes[..9], Some(&attachment), ms(0), 0)), Cause::Malformed);
    // None of them has used up the rate.
    assert!(command(&mut rule, 1.0, ms(0), 0).is_ok() && command(&mut rule, 1.0, ms(0), 0).is_ok());
    assert_eq!(command(&mut rule, 1.0, ms(0), 0), Err(Cause::TooOften));
    assert!(command(&mut rule, 1.0, ms(20), 0).is_ok());
}

#[test]
fn all_faults_are_reported_together() {
    let rules = JOINTS.replace("position[0]", "position").replace("rate_hz = 100", "rate_hz = 0")
        + &COMMAND.replace("to = \"knee.drive\"", "to = \"a\"\ngroup = \"b\"")
        + "[stop]\nservice = \"stop\"\n";
    let text = faults(&rules);
    for words in
        ["stop.service: 'stop'", "to_ros[0] (/joint_states): rate_hz", "from_ros[0] (/knee/torque): either"]
    {
        assert!(text.contains(words), "{words}: {text}");
    }
}

#[test]
fn illegal_rules_are_refused() {
    for (rules, words) in [
        (String::new(), "it has no rule"),
        (COMMAND.replace("demo.torque", "sinew.inspect.record"), "one of Sinew's own types"),
        (COMMAND.replace("std_msgs/msg/Float64", "std_msgs/msg/Float63"), "Float63 is not known"),
        (COMMAND.replace("/knee/torque", "/knee/*"), "a name is as"),
        (COMMAND.replace("\"set.newton_metres\"", "\"set[0]\""), "has no index"),
        (COMMAND.replace("data / 10", "dat / 10"), "std_msgs/msg/Float64 has data"),
        (COMMAND.to_owned() + COMMAND, "another rule has this topic"),
        (JOINTS.replace("[\"hip\", \"knee\"]", "[1]"), "set.name"),
        (JOINTS.replace("position[1]", "header"), "name a field"),
        ("name = \"\"\n".to_owned() + COMMAND, "name: 1 to 63"),
        ("address = 1\n".to_owned() + COMMAND, "address: 0x1000"),
        ("domain = 233\n".to_owned() + COMMAND, "domain: 0 to 232"),
    ] {
        let text = faults(&rules);
        assert!(text.contains(words), "{words}: {text}");
    }
    assert!(faults("unknown = 1\n").contains("unknown"));
}

#[test]
fn protected_commands_go_to_one_application() {
    let limits =
        "protected = { within_ms = 100, age_max_ms = 200, lost_max = 2, bad_max = 1, good_min = 1 }\n";
    let rules = COMMAND.replace("fields =", &format!("{limits}fields ="));
    let mapping = check(&rules).expect("a mapping");
    assert_eq!(mapping.from_ros[0].protected.map(|limits| limits.lost_max), Some(2));
    let group = rules.replace("to =", "group =");
    assert!(faults(&group).contains("commands go to one application"));
    assert!(faults(&rules.replace("good_min = 1", "good_min = 0")).contains("good_min 1 or more"));
}

#[test]
fn shipped_mapping_of_the_exoskeleton_is_legal() {
    let text = include_str!("../../exoskeleton.toml");
    let mapping = MappingFile::parse(text).expect("a file").check(&Catalog::shipped()).expect("a mapping");
    assert_eq!(mapping.to_ros[0].topic, "/joint_states");
    assert_eq!(mapping.to_ros[0].inputs.len(), 3);
    assert!(mapping.stop.is_some());
}
