//! `sinew view`: the metrics of two nodes, and hostile requests.

use std::{
    collections::BTreeMap,
    io::{Read as _, Write as _},
    net::{Shutdown, SocketAddr, TcpListener, TcpStream},
    process::{Command, Stdio},
    time::Duration,
};

use rustix::process::Signal;
use serde_json::Value;
use sinew_testkit::{DEADLINE, NodeProcess, until};

use crate::scenario::{Answer, Scenario, named};

/// A running `sinew view`.
pub(crate) struct View {
    process: NodeProcess,
    pub(crate) address: SocketAddr,
    /// The path of the page, with the token.
    pub(crate) page: String,
    /// The address for Foxglove, with its token; empty without `--foxglove`.
    pub(crate) foxglove: String,
}

/// An answer over HTTP.
pub(crate) struct HttpAnswer {
    pub(crate) status: u16,
    pub(crate) head: String,
    pub(crate) body: String,
}

impl View {
    pub(crate) fn of(scenario: &Scenario, node: &str) -> Self {
        Self::with(scenario, node, &[])
    }

    /// Same as `of`, with these further words.
    pub(crate) fn with(scenario: &Scenario, node: &str, more: &[&str]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
        command.arg("--socket").arg(scenario.socket(node)).arg("--json");
        command.args(["view", "--listen", "127.0.0.1:0"]).args(more);
        let mut process = NodeProcess::start("sinew view", command);
        let line: Value = serde_json::from_str(&process.wait_for(&["listens"])).expect("JSON");
        let address = line["listens"].as_str().expect("a text").parse().expect("an address");
        let page = line["page"].as_str().expect("a text");
        let page = page.strip_prefix(&format!("http://{address}")).expect("it is of this server").to_owned();
        let foxglove = line["foxglove"].as_str().unwrap_or_default().to_owned();
        Self { process, address, page, foxglove }
    }

    pub(crate) fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect_timeout(&self.address, DEADLINE).expect("it listens");
        stream.set_read_timeout(Some(DEADLINE)).expect("a valid time");
        stream.set_write_timeout(Some(DEADLINE)).expect("a valid time");
        stream
    }

    /// Sends these bytes, and reads up to the end; `None` if the connection was cut without an answer.
    pub(crate) fn send(&self, bytes: &[u8]) -> Option<HttpAnswer> {
        let mut stream = self.connect();
        // A server may refuse before it has read everything.
        let _ = stream.write_all(bytes);
        let mut text = Vec::new();
        let _ = stream.read_to_end(&mut text);
        let text = String::from_utf8(text).expect("an answer is text");
        let (head, body) = text.split_once("\r\n\r\n")?;
        let status = head.split_whitespace().nth(1)?.parse().ok()?;
        Some(HttpAnswer { status, head: head.to_lowercase(), body: body.to_owned() })
    }

    pub(crate) fn get(&self, path: &str, more: &str) -> HttpAnswer {
        let request = format!("GET {path} HTTP/1.1\r\nHost: {}\r\n{more}\r\n", self.address);
        self.send(request.as_bytes()).expect("a valid request has an answer")
    }

    pub(crate) fn metrics(&self) -> Metrics {
        let answer = self.get("/metrics", "");
        assert_eq!(answer.status, 200, "{}{}", answer.head, answer.body);
        Metrics::parse(&answer.body)
    }

    /// Scrapes until the condition holds.
    fn until(&self, what: &str, is_so: impl Fn(&Metrics) -> bool) -> Metrics {
        until(what, || Some(self.metrics()).filter(&is_so))
    }
}

/// The samples of a scrape: the value of each name with its labels.
pub(crate) struct Metrics(BTreeMap<String, f64>);

impl Metrics {
    fn parse(text: &str) -> Self {
        assert!(text.ends_with("# EOF\n"), "{text}");
        let samples = text.lines().filter(|line| !line.starts_with('#')).map(|line| {
            let (sample, value) = line.rsplit_once(' ').unwrap_or_else(|| panic!("no value: {line}"));
            (sample.to_owned(), value.parse().unwrap_or_else(|why| panic!("{why}: {line}")))
        });
        let all: Vec<(String, f64)> = samples.collect();
        let count = all.len();
        let by_name: BTreeMap<_, _> = all.into_iter().collect();
        assert_eq!(by_name.len(), count, "a sample is there twice:\n{text}");
        Self(by_name)
    }

    pub(crate) fn value(&self, sample: &str) -> Option<f64> {
        self.0.get(sample).copied()
    }

    fn is(&self, sample: &str, expected: f64) -> bool {
        self.value(sample).is_some_and(|value| (value - expected).abs() < f64::EPSILON)
    }
}

/// Returns the delivered and refused messages of the mailboxes of the node's application of the same name, by class.
pub(crate) fn mailboxes(audit: &Value, node: &str) -> BTreeMap<String, [f64; 2]> {
    let app = node;
    let node = named(&audit["nodes"], node).unwrap_or_else(|| panic!("no {node}: {audit}"));
    let entries = node["entries"].as_array().expect("a list").iter();
    let mailbox = |entry: &Value| {
        let place = entry["place"].get("Mailbox")?;
        let word = |key: &str| place[key].as_str().expect("a text").to_owned();
        let count = |key: &str| entry["account"][key].as_f64().unwrap_or(0.0);
        (word("name") == app).then(|| (word("class").to_lowercase(), [count("delivered"), count("refused")]))
    };
    entries.filter_map(mailbox).collect()
}

fn audit(scenario: &Scenario) -> Value {
    scenario.sinew("hip", &["audit", "--json"]).json()
}

#[test]
fn metrics_agree_with_the_audit_of_both_nodes() {
    // Given: the hip sends counts to the knee all the time
    let scenario = Scenario::new();
    let (_hip, _knee) = scenario.start_a_hip_that_sends_to_a_knee();
    let view = View::of(&scenario, "hip");
    // When: the first scrape, which no earlier one answers, lies between two audits
    let before = mailboxes(&audit(&scenario), "knee");
    let metrics = view.metrics();
    let after = mailboxes(&audit(&scenario), "knee");
    // Then
    assert!(before.values().any(|[delivered, _]| *delivered > 0.0), "{before:?}");
    for (class, least) in before {
        let most = after[&class];
        for (at, outcome) in ["delivered", "refused"].into_iter().enumerate() {
            let sample = format!(
                "sinew_app_messages_total{{node=\"knee\",app=\"knee\",class=\"{class}\",outcome=\"{outcome}\"}}"
            );
            let value = metrics.value(&sample).unwrap_or_else(|| panic!("no {sample}"));
            assert!((least[at]..=most[at]).contains(&value), "{sample}: {value} of {least:?}, {most:?}");
        }
    }
    for node in ["hip", "knee"] {
        assert!(metrics.is(&format!("sinew_node_up{{node=\"{node}\"}}"), 1.0));
        assert!(metrics.is(&format!("sinew_app_ready{{node=\"{node}\",app=\"{node}\"}}"), 1.0));
    }
    // And: the links come up, and the clock is measured
    view.until("the knee is linked and measured", |metrics| {
        let link = |class: &str| format!("sinew_link_up{{node=\"hip\",peer=\"knee\",class=\"{class}\"}}");
        let all_up = ["control", "stream", "bulk"].iter().all(|class| metrics.is(&link(class), 1.0));
        let measured = metrics.value("sinew_peer_clock_offset_bound_seconds{node=\"hip\",peer=\"knee\"}");
        all_up && measured.is_some_and(|bound| bound > 0.0 && bound < 1.0)
    });
}

#[test]
fn waits_and_lost_nodes_are_metrics() {
    // Given: the knee waits for an absent ankle
    let scenario = Scenario::new();
    let (_hip, mut knee) = scenario.start_a_knee_that_waits_for_an_ankle();
    let view = View::of(&scenario, "hip");
    view.until("the knee waits for the ankle", |metrics| {
        let waits = metrics.value("sinew_barrier_wait_seconds{node=\"knee\",app=\"knee\"}");
        let blocked = metrics.value("sinew_barrier_blocked_seconds{node=\"knee\",app=\"ankle\"}");
        metrics.is("sinew_app_ready{node=\"knee\",app=\"knee\"}", 0.0)
            && waits.is_some_and(|seconds| seconds > 0.0)
            && blocked.is_some()
    });
    // When
    assert!(knee.kill());
    // Then
    view.until("the knee is lost", |metrics| {
        metrics.is("sinew_node_lost{node=\"knee\",why=\"crashed\"}", 1.0)
            && metrics.is("sinew_node_up{node=\"knee\"}", 0.0)
            && metrics.is("sinew_node_up{node=\"hip\"}", 1.0)
    });
}

#[test]
fn view_outlives_its_entry_node() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &[]);
    let mut view = View::of(&scenario, "hip");
    assert!(hip.kill());
    view.until("the entry node is gone", |metrics| metrics.is("sinew_entry_node_up", 0.0));
    let _hip = scenario.start("hip", 1, &[]);
    view.until("it is back", |metrics| {
        metrics.is("sinew_entry_node_up", 1.0) && metrics.is("sinew_node_up{node=\"hip\"}", 1.0)
    });
    // And: Ctrl-C ends it in order
    view.process.signal(Signal::INT);
    assert_eq!(view.process.wait_for_exit(), Some(0));
}

#[test]
fn hostile_requests_are_refused_and_bounded() {
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let view = View::of(&scenario, "hip");
    let host = format!("Host: {}\r\n", view.address);
    for (request, status) in [
        ("GET /metrics HTTP/1.1\r\n\r\n".to_owned(), 400),
        (format!("GET /metrics HTTP/1.1\r\n{host}{host}\r\n"), 400),
        ("GET /metrics HTTP/1.1\r\nHost: evil.example\r\n\r\n".to_owned(), 403),
        (format!("GET http://evil.example/metrics HTTP/1.1\r\n{host}\r\n"), 403),
        (format!("POST /metrics HTTP/1.1\r\n{host}Content-Length: 0\r\n\r\n"), 405),
        (format!("GET /metrics HTTP/1.1\r\n{host}Content-Length: 5\r\n\r\nhello"), 413),
        (format!("GET /nothing HTTP/1.1\r\n{host}\r\n"), 401),
        ("\0\x01\x02 nonsense\r\n\r\n".to_owned(), 400),
    ] {
        let answer = view.send(request.as_bytes());
        let answer = answer.unwrap_or_else(|| panic!("no answer to {request:?}"));
        assert_eq!(answer.status, status, "{request:?}: {}", answer.body);
        assert!(!answer.body.contains("sinew_"), "{request:?}: {}", answer.body);
    }
    // Headers without an end, in size and in number: refused, or cut while they are still sent.
    let long = format!("GET / HTTP/1.1\r\n{host}X: {}\r\n\r\n", "x".repeat(1 << 20));
    let many = format!("GET / HTTP/1.1\r\n{host}{}\r\n", "X: y\r\n".repeat(1_000));
    for request in [long, many] {
        let status = view.send(request.as_bytes()).map(|answer| answer.status);
        assert!(matches!(status, None | Some(431)), "{status:?}");
    }
    // And: the server still answers, also while some clients send nothing and others do not read.
    let silent: Vec<_> = (0..16).map(|_| view.connect()).collect();
    let mut slow: Vec<_> = (0..16).map(|_| view.connect()).collect();
    for stream in &mut slow {
        write!(stream, "GET /metrics HTTP/1.1\r\n{host}\r\n").expect("it is read");
    }
    assert!(view.metrics().is("sinew_node_up{node=\"hip\"}", 1.0));
    // Each of them is cut in the end.
    for mut stream in silent {
        let mut rest = Vec::new();
        let cut = stream.read_to_end(&mut rest);
        assert!(cut.is_ok() || cut.is_err_and(|why| why.kind() == std::io::ErrorKind::ConnectionReset));
    }
}

#[test]
fn further_connections_wait_for_a_free_one() {
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let view = View::of(&scenario, "hip");
    let held: Vec<_> = (0..64).map(|_| view.connect()).collect();
    let mut further = view.connect();
    write!(further, "GET /metrics HTTP/1.1\r\nHost: {}\r\n\r\n", view.address).expect("the system takes it");
    further.set_read_timeout(Some(Duration::from_millis(200))).expect("a valid time");
    let early = further.read(&mut [0; 16]).map_err(|why| why.kind());
    assert_eq!(early, Err(std::io::ErrorKind::WouldBlock), "it has to wait");
    for stream in &held {
        stream.shutdown(Shutdown::Both).expect("it is connected");
    }
    further.set_read_timeout(Some(DEADLINE)).expect("a valid time");
    let mut answer = String::new();
    further.read_to_string(&mut answer).expect("it is answered now");
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
}

#[test]
fn address_in_use_is_an_error_with_a_remedy() {
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let view = View::of(&scenario, "hip");
    let answer = scenario.sinew("hip", &["view", "--listen", &view.address.to_string()]);
    assert_eq!(answer.code, Some(1), "{}", answer.err);
    assert!(
        answer.err.contains("--listen") && answer.err.contains(&view.address.to_string()),
        "{}",
        answer.err
    );
    let answer = scenario.sinew("gone", &["view"]);
    assert_eq!(answer.code, Some(3), "{}", answer.err);
}

#[test]
fn address_of_a_network_is_served_with_a_warning() {
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    command.arg("--socket").arg(scenario.socket("hip")).args(["view", "--listen", "0.0.0.0:0"]);
    let mut child =
        command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the command starts");
    let mut first = [0; 1];
    child.stdout.as_mut().expect("a pipe").read_exact(&mut first).expect("it announces its address");
    child.kill().expect("it runs");
    let output = child.wait_with_output().expect("it has ended");
    let notes = String::from_utf8(output.stderr).expect("it writes text");
    assert!(notes.contains("warning") && notes.contains("not loopback"), "{notes}");
}

#[test]
fn scrape_passes_the_linter_of_prometheus() {
    let version = Command::new("promtool").arg("--version").output();
    if version.is_err() {
        println!("skipped: there is no promtool (Debian: package prometheus)");
        return;
    }
    let scenario = Scenario::new();
    let (_hip, mut knee) = scenario.start_a_hip_that_sends_to_a_knee();
    let view = View::of(&scenario, "hip");
    let lint = |when: &str| {
        let text = view.get("/metrics", "Accept: text/plain\r\n").body;
        let input =
            std::fs::File::open(scenario.directory.write("metrics.txt", &text)).expect("it was written");
        let answer = Answer::of(Command::new("promtool").args(["check", "metrics"]).stdin(input));
        assert_eq!(answer.code, Some(0), "{when}: {}{}\n{text}", answer.out, answer.err);
    };
    lint("both nodes run");
    assert!(knee.kill());
    view.until("the knee is lost", |metrics| metrics.is("sinew_node_up{node=\"knee\"}", 0.0));
    lint("a node is lost");
    let rules = concat!(env!("CARGO_MANIFEST_DIR"), "/../view/alerts.yml");
    let answer = Answer::of(Command::new("promtool").args(["check", "rules", rules]));
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
}

#[test]
fn prometheus_scrapes_the_state_of_a_node() {
    if Command::new("prometheus").arg("--version").output().is_err() {
        println!("skipped: there is no prometheus (Debian: package prometheus)");
        return;
    }
    // Given
    let scenario = Scenario::new();
    let _hip = scenario.start("hip", 1, &[]);
    let view = View::of(&scenario, "hip");
    let config = format!(
        "global:\n  scrape_interval: 1s\nscrape_configs:\n  - job_name: sinew\n    static_configs:\n      - targets: ['{}']\n",
        view.address
    );
    let file = scenario.directory.write("prometheus.yml", &config);
    let free = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
    let address = free.expect("a free port on loopback");
    // When
    let mut command = Command::new("prometheus");
    command.arg(format!("--config.file={}", file.display()));
    command.arg(format!("--storage.tsdb.path={}", scenario.directory.join("tsdb").display()));
    command.arg(format!("--web.listen-address={address}")).stderr(Stdio::null());
    let _prometheus = NodeProcess::start("prometheus", command);
    // Then
    until("Prometheus has the state of the hip", || {
        let mut stream = TcpStream::connect_timeout(&address, DEADLINE).ok()?;
        stream.set_read_timeout(Some(DEADLINE)).expect("a valid time");
        stream.write_all(b"GET /api/v1/query?query=sinew_node_up HTTP/1.0\r\n\r\n").ok()?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer).ok()?;
        let found: Value = serde_json::from_str(answer.split_once("\r\n\r\n")?.1).ok()?;
        let is_up = |one: &Value| one["metric"]["node"] == "hip" && one["value"][1] == "1";
        found["data"]["result"].as_array()?.iter().any(is_up).then_some(())
    });
}
