//! The page of `sinew view`: its token, its stream, plots and parameters, without a browser. `view/browser` has one.

use std::io::{BufRead as _, BufReader, Write as _};

use serde_json::{Value, json};
use sinew_testkit::until;

use crate::{
    scenario::{Scenario, named},
    view::View,
};

/// The stream of a page.
struct Stream(BufReader<std::net::TcpStream>);

impl View {
    /// Opens the page, and returns the header with its cookie.
    fn open(&self) -> String {
        let page = self.get(&self.page, "");
        assert!(page.status == 200 && page.body.contains("<script"), "{}{}", page.head, page.body);
        let cookie = page.head.lines().find_map(|line| line.strip_prefix("set-cookie: "));
        let cookie = cookie.unwrap_or_else(|| panic!("no cookie: {}", page.head));
        assert!(cookie.contains("httponly") && cookie.contains("samesite=strict"), "{cookie}");
        format!("Cookie: {}\r\n", cookie.split(';').next().expect("a pair"))
    }

    fn stream(&self, cookie: &str, query: &str) -> Stream {
        let mut stream = self.connect();
        let address = self.address;
        write!(stream, "GET /api/stream?{query} HTTP/1.1\r\nHost: {address}\r\n{cookie}\r\n")
            .expect("it is read");
        Stream(BufReader::new(stream))
    }

    fn set(&self, cookie: &str, body: &Value) -> Value {
        let (address, body) = (self.address, body.to_string());
        let request = format!(
            "POST /api/parameters HTTP/1.1\r\nHost: {address}\r\nOrigin: http://{address}\r\n{cookie}\
             Content-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
            body.len()
        );
        let answer = self.send(request.as_bytes()).expect("a valid request has an answer");
        serde_json::from_str(&answer.body).unwrap_or_else(|why| panic!("{why}: {}", answer.body))
    }
}

impl Stream {
    /// Returns the next event of this name for which `find` returns a value. The connection has a time limit.
    fn find<R>(&mut self, name: &str, mut find: impl FnMut(&Value) -> Option<R>) -> R {
        let mut event = String::new();
        loop {
            let mut line = String::new();
            let read = self.0.read_line(&mut line).unwrap_or_else(|why| panic!("waited for {name}: {why}"));
            assert!(read > 0, "the stream has ended before {name}");
            let line = line.trim_end();
            if let Some(of) = line.strip_prefix("event: ") {
                of.clone_into(&mut event);
            } else if let Some(data) = line.strip_prefix("data: ").filter(|_| event == name) {
                let data = serde_json::from_str(data).unwrap_or_else(|why| panic!("{why}: {data}"));
                if let Some(found) = find(&data) {
                    return found;
                }
            }
        }
    }
}

fn node<'v>(state: &'v Value, label: &str) -> Option<&'v Value> {
    state["nodes"].as_array()?.iter().find(|node| node["label"] == label)
}

#[test]
fn killed_node_is_shown_and_logged_with_its_class() {
    // Given
    let scenario = Scenario::new();
    let (_hip, mut knee) = scenario.start_a_hip_that_sends_to_a_knee();
    let view = View::of(&scenario, "hip");
    let mut stream = view.stream(&view.open(), "");
    stream.find("state", |state| {
        let is_up = |label| node(state, label).is_some_and(|node| node["state"] == "up");
        (is_up("hip") && is_up("knee")).then_some(())
    });
    // When
    assert!(knee.kill());
    // Then
    let class = stream.find("state", |state| {
        node(state, "knee").filter(|node| node["state"] == "lost").map(|node| node["class"].clone())
    });
    assert_eq!(class, json!("crashed"));
    let mut stream = view.stream(&view.open(), "");
    stream.find("log", |events| {
        let is_it = |event: &Value| event["subject"] == "knee" && event["text"] == "is lost: crashed";
        events.as_array()?.iter().any(is_it).then_some(())
    });
}

#[test]
fn blocked_start_names_the_missing_application() {
    let scenario = Scenario::new();
    let (_hip, _knee) = scenario.start_a_knee_that_waits_for_an_ankle();
    let view = View::of(&scenario, "hip");
    let mut stream = view.stream(&view.open(), "");
    let missing = stream.find("state", |state| {
        let app = named(&state["apps"], "knee")?;
        app["missing"].get(0).cloned()
    });
    assert_eq!(missing["name"], json!("ankle"), "{missing}");
    assert!(missing["why"].as_str().is_some_and(|why| !why.is_empty()), "{missing}");
}

#[test]
fn messages_are_plotted_only_while_a_page_looks() {
    let scenario = Scenario::new();
    let (_hip, _knee) = scenario.start_a_hip_that_sends_to_a_knee();
    let view = View::of(&scenario, "hip");
    let cookie = view.open();
    // The hip is the entry node, the knee another one of this host.
    for app in ["hip", "knee"] {
        let mut stream = view.stream(&cookie, &format!("app={app}"));
        let key = stream.find("messages", |data| {
            let channels = data["channels"].as_array()?;
            let is_it = |channel: &&Value| {
                channel["key"].as_str().is_some_and(|key| key.starts_with("hip\tknee\t"))
                    && channel["count"].as_u64() > Some(2)
                    && channel["fields"].get("@age_ms").is_some()
            };
            channels.iter().find(is_it).map(|channel| channel["key"].as_str().unwrap_or_default().to_owned())
        });
        let series = format!("{key}\t@age_ms").replace('\t', "%09");
        let mut stream = view.stream(&cookie, &format!("app={app}&series={series}"));
        let points = stream.find("points", |points| Some(points[0].clone()));
        assert_eq!(points["series"], json!(0), "{points}");
        assert!(points["v"].as_array().is_some_and(|values| !values.is_empty()), "{points}");
    }
    // And: without a page the nodes record nothing for it
    until("the recordings end", || {
        let mut stream = view.stream(&cookie, "");
        stream
            .find("state", |state| {
                let programs =
                    |label| node(state, label).map(|node| node["report"]["recording"]["programs"] == 0);
                Some(programs("hip")? && programs("knee")?)
            })
            .then_some(())
    });
}

#[test]
fn parameter_is_set_with_its_outcome_and_logged() {
    // Given
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &["--tuned"]);
    knee.wait_for(&["started"]);
    let view = View::of(&scenario, "knee");
    let cookie = view.open();
    let list = until("the parameters are listed", || {
        let answer = view.get("/api/parameters", &cookie);
        let json: Value = serde_json::from_str(&answer.body).expect("JSON");
        json["apps"].get(0).filter(|app| app["list"].is_object()).cloned()
    });
    assert_eq!(
        named(&list["list"]["parameters"], "assistance").expect("it is declared")["value"],
        json!({ "Number": 0.3 })
    );
    // When
    let set =
        |value: &str| json!({ "app": "knee.gains", "values": [{ "name": "assistance", "value": value }] });
    let applied = view.set(&cookie, &set("0.5"));
    // Then
    let tick = applied["outcome"]["Applied"]["tick"].as_u64().unwrap_or_else(|| panic!("{applied}"));
    knee.wait_for(&[&format!("assistance 0.5 at tick {tick}")]);
    let refused = view.set(&cookie, &set("1.4"));
    let why = refused["outcome"]["Refused"]["why"].as_str().unwrap_or_else(|| panic!("{refused}"));
    assert!(why.contains("outside 0.0 to 1.0"), "{why}");
    let undone = view.set(&cookie, &json!({ "app": "knee.gains", "undo": true }));
    assert!(undone["outcome"]["Applied"].is_object(), "{undone}");
    knee.wait_for(&["assistance 0.3 at tick "]);
    let mut stream = view.stream(&cookie, "");
    stream.find("log", |events| {
        let writes = events.as_array()?.iter().filter(|event| event["topic"] == "write");
        let fine: Vec<_> = writes.map(|event| event["is_fine"].as_bool()).collect();
        (fine == [Some(true), Some(false), Some(true)]).then_some(())
    });
}

#[test]
fn page_needs_its_token_and_writes_need_its_origin() {
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let view = View::of(&scenario, "hip");
    let cookie = view.open();
    let other = format!("{}0", view.page);
    for (path, more, status) in [
        ("/", "", 401),
        (other.as_str(), "", 401),
        ("/api/stream", "", 401),
        ("/main.js", "", 401),
        ("/main.js", cookie.as_str(), 200),
        ("/nothing", cookie.as_str(), 404),
    ] {
        assert_eq!(view.get(path, more).status, status, "{path}");
    }
    let evil = format!("{cookie}Origin: http://evil.example\r\n");
    assert_eq!(view.get("/api/stream", &evil).status, 403);
    let address = view.address;
    let write =
        format!("POST /api/parameters HTTP/1.1\r\nHost: {address}\r\n{evil}Content-Length: 2\r\n\r\n{{}}");
    assert_eq!(view.send(write.as_bytes()).map(|answer| answer.status), Some(403));
}

#[test]
fn streams_have_a_bound_and_end_with_their_pages() {
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let view = View::of(&scenario, "hip");
    let cookie = view.open();
    let mut streams: Vec<_> = (0..16).map(|_| view.stream(&cookie, "")).collect();
    for stream in &mut streams {
        stream.find("state", |_| Some(()));
    }
    assert_eq!(view.get("/api/stream", &cookie).status, 503);
    // The metrics are not affected.
    assert_eq!(view.get("/metrics", "").status, 200);
    streams.clear();
    until("a place is free", || {
        let mut stream = view.stream(&cookie, "");
        let mut status = String::new();
        stream.0.read_line(&mut status).expect("it is answered");
        status.starts_with("HTTP/1.1 200").then_some(())
    });
}
