//! zenoh: two peers over TCP on the loopback interface, with `express` (sent at once, never batched) and
//! reliable publications. The echo is in the subscriber's callback, as in zenoh's own ping and pong.

use std::{
    net::{Ipv4Addr, TcpListener},
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    time::{Duration, Instant},
};

use sinew_figures::{
    Figures, Pinning, Rounds,
    process::{Process, await_end, print_ready},
};
use zenoh::{
    Config, Session, Wait,
    pubsub::{Publisher, Subscriber},
    qos::CongestionControl,
    sample::Sample,
};

use crate::{
    path::{Path, echo_role},
    ping::DEADLINE,
};

const THERE: &str = "sinew/peers/there";
const BACK: &str = "sinew/peers/back";

/// A session that connects only to the given peer.
pub(crate) fn session(listens: bool, at: &str) -> Session {
    let mut config = Config::default();
    let address = format!(r#"["tcp/{at}"]"#);
    let (here, there) = if listens { (address.as_str(), "[]") } else { ("[]", address.as_str()) };
    for (key, value) in [
        ("mode", r#""peer""#),
        ("scouting/multicast/enabled", "false"),
        ("listen/endpoints", here),
        ("connect/endpoints", there),
    ] {
        config.insert_json5(key, value).expect("a key and a value that it knows");
    }
    zenoh::open(config).wait().expect("a session")
}

/// A free port of the loopback interface; the listening session takes it right after.
pub(crate) fn free_address() -> String {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a free port");
    listener.local_addr().expect("it is bound").to_string()
}

pub(crate) fn publisher(session: &Session, is_there: bool, is_express: bool) -> Publisher<'static> {
    let publisher = session.declare_publisher(if is_there { THERE } else { BACK });
    let publisher = publisher.congestion_control(CongestionControl::Block).express(is_express);
    publisher.wait().expect("a publisher")
}

pub(crate) fn subscriber(
    session: &Session,
    is_there: bool,
    callback: impl Fn(Sample) + Send + Sync + 'static,
) -> Subscriber<()> {
    let subscriber = session.declare_subscriber(if is_there { THERE } else { BACK });
    subscriber.callback(callback).wait().expect("a subscriber")
}

/// The channel for replies, from the subscriber's callback to the measuring thread.
pub(crate) fn answers() -> (SyncSender<Sample>, Receiver<Sample>) {
    sync_channel(16)
}

/// Publishes until an answer arrives: then the sessions have found each other.
pub(crate) fn meet(publisher: &Publisher<'_>, answers: &Receiver<Sample>, payload: &[u8]) {
    let deadline = Instant::now() + DEADLINE;
    while Instant::now() < deadline {
        publisher.put(payload).wait().expect("a session");
        if answers.recv_timeout(Duration::from_millis(100)).is_ok() {
            // Late answers to earlier tries.
            while answers.recv_timeout(Duration::from_millis(100)).is_ok() {}
            return;
        }
    }
    panic!("nobody answered within {DEADLINE:?}");
}

/// Round trips.
pub(crate) fn measure(rounds: Rounds, pinning: Pinning) -> Figures {
    let at = free_address();
    let _echo = Process::start(&echo_role(Path::Zenoh, rounds.bytes, pinning, &at));
    let session = session(false, &at);
    let (answer, answers) = answers();
    let _subscriber = subscriber(&session, false, move |sample| drop(answer.send(sample)));
    let publisher = publisher(&session, true, true);
    let buffer = vec![7; rounds.bytes];
    meet(&publisher, &answers, &buffer);
    rounds.time(|| {
        publisher.put(buffer.as_slice()).wait().expect("a session");
        let back = answers.recv_timeout(DEADLINE).expect("the echo answers");
        assert_eq!(back.payload().len(), buffer.len());
    })
}

/// The other end.
pub(crate) fn echo(at: &str) {
    let session = session(true, at);
    let publisher = publisher(&session, false, true);
    let _subscriber = subscriber(&session, true, move |sample| {
        publisher.put(sample.payload().clone()).wait().expect("a session");
    });
    print_ready();
    await_end();
}
