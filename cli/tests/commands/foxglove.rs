//! `sinew view --foxglove`: a client of the protocol gets the messages that the audit counts, and the parameters.

use std::{
    io::{ErrorKind, Read as _, Write as _},
    net::TcpStream,
    time::Duration,
};

use serde_json::{Value, json};
use sinew::{
    AppAddress, Endpoint, NodeApi, Outcome, Registration, Tid,
    inspect::{AskNode, NodeReport},
};
use sinew_testkit::{DEADLINE, NodeProcess, until};
use tungstenite::{Error, Message, WebSocket, protocol::Role};

use crate::{
    record::Count,
    scenario::Scenario,
    view::{View, mailboxes},
};

const TOPIC: &str = "/sensor/scenario.count/view";
/// Messages that are compared with the audit.
const COUNTED: u64 = 200;
/// Time for a message that may not come.
const MOMENT: Duration = Duration::from_millis(100);

/// A client of the server.
struct Client(WebSocket<TcpStream>);

/// Sends a request to the server, and returns the connection and the first part of the answer.
fn request(address: &str, path: &str, headers: &str) -> (TcpStream, String) {
    let mut stream = TcpStream::connect(address).expect("it listens");
    stream.set_read_timeout(Some(DEADLINE)).expect("a valid time");
    write!(stream, "GET {path} HTTP/1.1\r\n{headers}\r\n").expect("it is read");
    let mut head = Vec::new();
    let mut byte = [0];
    while !head.ends_with(b"\r\n\r\n") && stream.read(&mut byte).expect("it answers") > 0 {
        head.push(byte[0]);
    }
    (stream, String::from_utf8(head).expect("it is text"))
}

/// Returns the address and the path of a URL.
fn parts(url: &str) -> (&str, &str) {
    let rest = url.strip_prefix("ws://").expect("a URL");
    rest.split_at(rest.find('/').expect("a path"))
}

fn upgrade(host: &str, protocol: &str) -> String {
    format!(
        "Host: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n\
         Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: {protocol}\r\n"
    )
}

impl Client {
    fn of(view: &View) -> Self {
        let (address, path) = parts(&view.foxglove);
        let (stream, head) = request(address, path, &upgrade(address, "foxglove.websocket.v1"));
        let head = head.to_lowercase();
        assert!(head.starts_with("http/1.1 101"), "{head}");
        assert!(head.contains("sec-websocket-accept: s3pplmbitxaq9kygzzhzrbk+xoo="), "{head}");
        assert!(head.contains("sec-websocket-protocol: foxglove.websocket.v1"), "{head}");
        Self(WebSocket::from_raw_socket(stream, Role::Client, None))
    }

    fn send(&mut self, message: &Value) {
        self.0.send(Message::text(message.to_string())).expect("it is read");
    }

    fn set_patience(&self, patience: Duration) {
        self.0.get_ref().set_read_timeout(Some(patience)).expect("a valid time");
    }

    /// Returns the next text of this operation for which `find` returns a value.
    fn find<R>(&mut self, op: &str, mut find: impl FnMut(&Value) -> Option<R>) -> R {
        loop {
            let message = self.0.read().unwrap_or_else(|why| panic!("waited for {op}: {why}"));
            let Message::Text(text) = message else { continue };
            let json: Value = serde_json::from_str(text.as_str()).expect("it is JSON");
            if json["op"] == op
                && let Some(found) = find(&json)
            {
                return found;
            }
        }
    }

    /// Returns the next message; `None` if none comes within the patience.
    fn read(&mut self) -> Option<Message> {
        match self.0.read() {
            Ok(message) => Some(message),
            Err(Error::Io(why)) if matches!(why.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => None,
            Err(why) => panic!("{why}"),
        }
    }

    /// Returns the number in the next view of a count; `None` if none comes within the patience.
    fn number(&mut self, subscription: u32) -> Option<u64> {
        loop {
            if let Message::Binary(bytes) = self.read()? {
                assert_eq!((bytes[0], &bytes[1..5]), (1, &subscription.to_le_bytes()[..]));
                return Some(first_field(&bytes[13..]));
            }
        }
    }

    fn subscribe(&mut self, topic: &str, id: u32) {
        let channel = self.find("advertise", |json| {
            let channels = json["channels"].as_array()?;
            channels.iter().find(|channel| channel["topic"] == topic).cloned()
        });
        assert_eq!(
            (&channel["encoding"], &channel["schemaEncoding"], &channel["schemaName"]),
            (&json!("protobuf"), &json!("protobuf"), &json!("sinew.scenario.Count")),
            "{channel}"
        );
        assert!(channel["schema"].as_str().is_some_and(|schema| !schema.is_empty()), "{channel}");
        let subscription = json!({ "id": id, "channelId": channel["id"] });
        self.send(&json!({ "op": "subscribe", "subscriptions": [subscription] }));
    }
}

/// Returns the first field of a message of protocol buffers, a `uint64`; 0 where it is left out.
fn first_field(bytes: &[u8]) -> u64 {
    if bytes.first() != Some(&0x08) {
        return 0;
    }
    let mut value = 0;
    for (place, byte) in bytes[1..].iter().enumerate() {
        value |= u64::from(byte & 0x7f) << (7 * place);
        if byte & 0x80 == 0 {
            break;
        }
    }
    value
}

/// Returns the number of programs for which the node records.
fn programs(endpoint: &mut Endpoint) -> u32 {
    let inspection = Tid::new(endpoint.tid().node, AppAddress::INSPECT);
    let report = endpoint.message(inspection, &AskNode {}).ask::<NodeReport>(Duration::from_secs(10));
    report.expect("it answers").recording.map_or(0, |recording| recording.programs)
}

/// Starts the knee, and an application that sends counts to it.
fn start(scenario: &Scenario, registration: Registration) -> (NodeProcess, Tid, Endpoint) {
    let mut knee = scenario.start("knee", 2, &[]);
    let line = knee.wait_for(&["started"]);
    let tid = line.split_once(' ').expect("it says its TID").1.parse().expect("a TID");
    let api = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
    let sensor = api.register_transport_address(registration.name("sensor")).expect("it is registered");
    (knee, tid, sensor)
}

fn send(sensor: &mut Endpoint, to: Tid, number: u64) {
    let sent = sensor.message(to, &Count { number }).confirmed(Duration::from_secs(10));
    assert_eq!(sent.expect("an outcome"), Outcome::Delivered);
}

/// Returns the counts that the audit has of the knee.
fn audited(scenario: &Scenario) -> f64 {
    let audit = scenario.sinew("knee", &["audit", "--json"]).json();
    mailboxes(&audit, "knee").get("bulk").map_or(0.0, |[delivered, _]| *delivered)
}

#[test]
fn client_gets_as_many_messages_as_the_audit_counts() {
    // Given: a client without a subscription, for which nothing is recorded
    let scenario = Scenario::new();
    let (_knee, to, mut sensor) = start(&scenario, Registration::new().sends::<Count>());
    let view = View::with(&scenario, "knee", &["--foxglove", "0"]);
    let mut client = Client::of(&view);
    client.find("serverInfo", |_| Some(()));
    assert_eq!(programs(&mut sensor), 0);
    // When: it subscribes, and the first message comes
    client.subscribe(TOPIC, 7);
    client.set_patience(MOMENT);
    let mut next = 0;
    let first = until("a message comes", || {
        send(&mut sensor, to, next);
        next += 1;
        client.number(7)
    });
    assert_eq!(programs(&mut sensor), 1);
    client.set_patience(DEADLINE);
    for number in first + 1..next {
        assert_eq!(client.number(7), Some(number));
    }
    // Then: it gets each further one, in order
    let before = audited(&scenario);
    for number in next..next + COUNTED {
        send(&mut sensor, to, number);
    }
    let got: Vec<_> = (0..COUNTED).map(|_| client.number(7).expect("it comes")).collect();
    assert_eq!(got, (next..next + COUNTED).collect::<Vec<_>>());
    let counted = audited(&scenario) - before;
    assert!((counted - COUNTED as f64).abs() < f64::EPSILON, "the audit counts {counted}");
    client.set_patience(MOMENT);
    assert_eq!(client.number(7), None, "and no more");
    let metrics = view.metrics();
    assert_eq!(metrics.value("sinew_foxglove_clients"), Some(1.0));
    let all = (next - first + COUNTED) as f64;
    assert_eq!(metrics.value("sinew_foxglove_messages_total"), Some(all));
    for why in ["client", "journal"] {
        assert_eq!(metrics.value(&format!("sinew_foxglove_dropped_total{{why=\"{why}\"}}")), Some(0.0));
    }
    // And: without the subscription the node records nothing
    client.send(&json!({ "op": "unsubscribe", "subscriptionIds": [7] }));
    until("the recording ends", || (programs(&mut sensor) == 0).then_some(()));
}

#[test]
fn recording_ends_with_a_client_that_is_gone() {
    let scenario = Scenario::new();
    let (_knee, _, mut sensor) = start(&scenario, Registration::new().sends::<Count>());
    let view = View::with(&scenario, "knee", &["--foxglove", "0"]);
    let mut client = Client::of(&view);
    client.subscribe(TOPIC, 7);
    until("the node records", || (programs(&mut sensor) == 1).then_some(()));
    // When: it ends without a word
    drop(client);
    until("the recording ends", || (programs(&mut sensor) == 0).then_some(()));
    assert_eq!(view.metrics().value("sinew_foxglove_clients"), Some(0.0));
}

#[test]
fn malformed_messages_are_answered_and_too_large_ones_close() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    let view = View::with(&scenario, "knee", &["--foxglove", "0"]);
    let mut client = Client::of(&view);
    for (message, part) in [
        (Message::text("no JSON"), "no message of foxglove.websocket.v1"),
        (Message::text(r#"{"op":"subscribe"}"#), "missing field"),
        (Message::text(r#"{"op":"advertise","channels":[]}"#), "messages and parameters only"),
        (Message::binary(vec![1, 2, 3]), "`sinew send`"),
        (
            Message::text(r#"{"op":"subscribe","subscriptions":[{"id":1,"channelId":9999}]}"#),
            "no channel 9999",
        ),
    ] {
        client.0.send(message).expect("it is read");
        let why = client.find("status", |json| json["message"].as_str().map(str::to_owned));
        assert!(why.contains(part), "{why}");
    }
    // The server may close it before it has read everything.
    let _ = client.0.send(Message::text("x".repeat(300 * 1_024)));
    let end = std::iter::repeat_with(|| client.0.read()).find_map(Result::err).expect("it ends");
    let is_open =
        matches!(&end, Error::Io(why) if matches!(why.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut));
    assert!(!is_open, "{end}");
}

#[test]
fn channels_of_undeclared_types_come_with_the_tally() {
    // Given: an application that sends a type, which it has not declared
    let scenario = Scenario::new();
    let (_knee, to, mut sensor) = start(&scenario, Registration::new());
    let view = View::with(&scenario, "knee", &["--foxglove", "0", "--foxglove-app", "sens*"]);
    let mut client = Client::of(&view);
    let tally = client.find("advertise", |json| {
        let channels = json["channels"].as_array()?;
        channels.iter().find(|channel| channel["topic"] == "/sinew/tally").map(|one| one["id"].clone())
    });
    // When
    client.send(&json!({ "op": "subscribe", "subscriptions": [{ "id": 1, "channelId": tally }] }));
    client.set_patience(MOMENT);
    let (mut is_offered, mut tallied) = (false, Value::Null);
    until("the channel is offered, and counted", || {
        send(&mut sensor, to, 1);
        match client.read()? {
            Message::Text(text) => {
                let json: Value = serde_json::from_str(text.as_str()).expect("it is JSON");
                is_offered |= json["channels"].as_array()?.iter().any(|channel| channel["topic"] == TOPIC);
            }
            Message::Binary(bytes) => {
                tallied = serde_json::from_slice(&bytes[13..]).expect("it is JSON");
            }
            Message::Ping(_) | Message::Pong(_) | Message::Close(_) | Message::Frame(_) => {}
        }
        let counted = tallied["channels"].as_array().into_iter().flatten();
        let mut own = counted.filter(|channel| channel["topic"] == "/sensor/scenario.count");
        (is_offered && own.any(|channel| channel["written"].as_u64() > Some(0))).then_some(())
    });
}

#[test]
fn parameters_are_listed_and_set_where_allowed() {
    const NAME: &str = "knee.gains.assistance";
    let value = |json: &Value| {
        let list = json["parameters"].as_array()?;
        list.iter().find(|one| one["name"] == NAME).map(|one| one["value"].clone())
    };
    let set = |value: f64| json!({ "op": "setParameters", "id": "s", "parameters": [{ "name": NAME, "value": value }] });
    // Given
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &["--tuned"]);
    knee.wait_for(&["started"]);
    let view = View::with(&scenario, "knee", &["--foxglove", "0"]);
    let mut client = Client::of(&view);
    let first = until("the parameters are listed", || {
        client.send(&json!({ "op": "getParameters", "parameterNames": [], "id": "g" }));
        client.find("parameterValues", |json| (json["id"] == "g").then(|| value(json)))
    });
    assert_eq!(first, json!(0.3));
    // When, then: sets are off
    client.send(&set(0.5));
    let kept = client.find("parameterValues", |json| (json["id"] == "s").then(|| value(json)).flatten());
    assert_eq!(kept, json!(0.3));
    let why = client.find("status", |json| json["message"].as_str().map(str::to_owned));
    assert!(why.contains("--foxglove-writes"), "{why}");
    // When, then: they are on
    let view = View::with(&scenario, "knee", &["--foxglove", "0", "--foxglove-writes"]);
    let mut client = Client::of(&view);
    client.send(&json!({ "op": "subscribeParameterUpdates", "parameterNames": [NAME] }));
    client.send(&set(0.5));
    knee.wait_for(&["assistance 0.5 at tick "]);
    // The list after the set has the value once the slope, if there is one, has reached it.
    client.find("parameterValues", |json| (value(json)? == json!(0.5)).then_some(()));
    client.send(&set(1.4));
    let why = client.find("status", |json| json["message"].as_str().map(str::to_owned));
    assert!(why.contains("outside 0.0 to 1.0"), "{why}");
    // And: a set by another program is an update
    let answer = scenario.sinew("knee", &["param", "set", "knee.gains.assistance=0.25"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    client.find("parameterValues", |json| (value(json)? == json!(0.25)).then_some(()));
}

#[test]
fn connection_needs_the_token_and_the_protocol() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    let view = View::with(&scenario, "knee", &["--foxglove", "0"]);
    let (address, path) = parts(&view.foxglove);
    let legal = upgrade(address, "foxglove.sdk.v1");
    let page = &view.page;
    for (path, headers, status) in [
        (path, legal.clone() + "Origin: https://app.example\r\n", 101),
        ("/", legal.clone(), 401),
        // The token of the page is another one.
        (page.as_str(), legal.clone(), 401),
        (path, upgrade("evil.example", "foxglove.sdk.v1"), 403),
        (path, upgrade(address, "chat"), 400),
        (path, format!("Host: {address}\r\n"), 426),
        (path, format!("{legal}Content-Length: 5\r\n"), 413),
    ] {
        let (_stream, head) = request(address, path, &headers);
        assert!(head.starts_with(&format!("HTTP/1.1 {status} ")), "{path} {headers}: {head}");
    }
}

#[test]
fn open_server_is_read_without_token_by_programs_alone() {
    const NAME: &str = "knee.gains.assistance";
    // Given
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &["--tuned"]);
    knee.wait_for(&["started"]);
    let view = View::with(&scenario, "knee", &["--foxglove", "0", "--foxglove-open", "--foxglove-writes"]);
    let (address, _) = parts(&view.foxglove);
    let legal = upgrade(address, "foxglove.sdk.v1");
    for (origin, status) in [
        ("Origin: https://app.example\r\n".to_owned(), 401),
        (format!("Origin: http://{address}\r\n"), 401),
        (format!("Origin: ws://{address}\r\n"), 101),
    ] {
        let (_stream, head) = request(address, "/", &(legal.clone() + &origin));
        assert!(head.starts_with(&format!("HTTP/1.1 {status} ")), "{origin}: {head}");
    }
    // When: a client without the token sets a parameter, as those with it may
    let (stream, head) = request(address, "/", &legal);
    assert!(head.starts_with("HTTP/1.1 101 "), "{head}");
    let mut client = Client(WebSocket::from_raw_socket(stream, Role::Client, None));
    client.find("advertise", |json| json["channels"].as_array().map(|_| ()));
    let parameters = json!([{ "name": NAME, "value": 0.5 }]);
    client.send(&json!({ "op": "setParameters", "id": "s", "parameters": parameters }));
    // Then
    let why = client.find("status", |json| json["message"].as_str().map(str::to_owned));
    assert!(why.contains("with the token"), "{why}");
    let answer = scenario.sinew("knee", &["param", "get", NAME]);
    assert_eq!(answer.out, "0.3\n", "{}", answer.err);
}

#[test]
fn silent_connections_leave_room_for_clients() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    let view = View::with(&scenario, "knee", &["--foxglove", "0"]);
    let (address, _) = parts(&view.foxglove);
    // As many as are served at a time, which send no request
    let silent: Vec<_> = (0..16).map(|_| TcpStream::connect(address).expect("it listens")).collect();
    let mut client = Client::of(&view);
    client.find("serverInfo", |_| Some(()));
    drop(silent);
}

#[test]
fn clients_have_a_bound() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    let view = View::with(&scenario, "knee", &["--foxglove", "0"]);
    let mut clients: Vec<_> = (0..8).map(|_| Client::of(&view)).collect();
    for client in &mut clients {
        client.find("serverInfo", |_| Some(()));
    }
    let why = Client::of(&view).find("status", |json| json["message"].as_str().map(str::to_owned));
    assert!(why.contains("too many clients"), "{why}");
    clients.pop();
    until("a place is free", || {
        let first = Client::of(&view).0.read().expect("it answers");
        first.to_text().is_ok_and(|text| text.contains("serverInfo")).then_some(())
    });
}

#[test]
fn port_in_use_is_an_error_with_a_remedy() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
    let port = taken.local_addr().expect("an address").port().to_string();
    let words = ["view", "--listen", "127.0.0.1:0", "--foxglove", &port];
    let answer = scenario.sinew("knee", &words);
    assert_eq!(answer.code, Some(1), "{}", answer.err);
    assert!(answer.err.contains(&port) && answer.err.contains("--foxglove PORT"), "{}", answer.err);
    let answer = scenario.sinew("knee", &["view", "--foxglove", "0", "--foxglove-app", "\n"]);
    assert_eq!(answer.code, Some(2), "{}", answer.err);
}
