//! The runtime's own log: what it says arrives whole, and a reader that takes nothing stops nobody.

use std::{
    fmt::Write as _,
    sync::{
        Arc, Mutex,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
};

use sinew_runtime::log;
use tracing::{
    Event, Metadata, Subscriber,
    field::{Field, Visit},
    span,
    subscriber::with_default,
};

const DEADLINE: Duration = Duration::from_secs(20);

/// Writes down what it is told, and may not come back from it before it is allowed to.
struct Reader {
    read: SyncSender<String>,
    may_go_on: Option<Mutex<Receiver<()>>>,
}

struct Words(String);

impl Visit for Words {
    fn record_u64(&mut self, field: &Field, value: u64) {
        write!(self.0, " {field}={value}u64").expect("a text takes everything");
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        write!(self.0, " {field}='{value}'").expect("a text takes everything");
    }

    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        write!(self.0, " {field}={value:?}").expect("a text takes everything");
    }
}

impl Subscriber for Reader {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        *metadata.level() <= tracing::Level::INFO
    }

    fn event(&self, event: &Event<'_>) {
        let mut words = Words(format!("{} {}:", event.metadata().level(), event.metadata().target()));
        event.record(&mut words);
        self.read.send(words.0).expect("the test reads on");
        if let Some(may_go_on) = &self.may_go_on {
            // An error is the end of the test.
            let _ = may_go_on.lock().expect("nobody panics with it").recv();
        }
    }

    fn new_span(&self, _: &span::Attributes<'_>) -> span::Id {
        span::Id::from_u64(1)
    }
    fn record(&self, _: &span::Id, _: &span::Record<'_>) {}
    fn record_follows_from(&self, _: &span::Id, _: &span::Id) {}
    fn enter(&self, _: &span::Id) {}
    fn exit(&self, _: &span::Id) {}
}

/// One test, because there is one log in a process.
#[test]
fn what_is_logged_arrives_whole_and_in_order_and_a_reader_that_blocks_holds_nobody_up() {
    // Given a reader on this thread.
    let (read, lines) = sync_channel(10_000);
    let reader = Arc::new(Reader { read: read.clone(), may_go_on: None });
    let next = || lines.recv_timeout(DEADLINE).expect("it is written");
    let why = std::io::Error::other("why");
    // When things are said, then it reads all of them that it wants, as they were said.
    with_default(reader, || {
        log::warn!(child = "hip", restarts = 3_u64, %why, "it {}", "failed");
        log::debug!("nobody wants this");
        log::error!("{}", "x".repeat(100_000));
    });
    assert_eq!(next(), "WARN log: message=it failed child='hip' restarts=3u64 why=why");
    assert_eq!(next(), format!("ERROR log: message={}", "x".repeat(4_096)));
    // When one is said to a reader that does not come back.
    let (go_on, may_go_on) = sync_channel(0);
    let reader = Arc::new(Reader { read, may_go_on: Some(Mutex::new(may_go_on)) });
    with_default(reader, || log::info!("the first"));
    assert_eq!(next(), "INFO log: message=the first");
    // Then whoever logs goes on: what has no room is lost, and counted.
    let before = log::lost();
    let (read, more) = sync_channel(10_000);
    with_default(Arc::new(Reader { read, may_go_on: None }), || {
        (0..2_000_u64).for_each(|number| log::info!(number, "one of many"));
    });
    let lost = log::lost() - before;
    assert_eq!(lost, 2_000 - 1_024);
    // And the rest is written when it comes back.
    go_on.send(()).expect("it waits for this");
    log::flush(DEADLINE);
    assert_eq!(more.try_iter().count(), 1_024);
}
