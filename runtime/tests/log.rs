//! The runtime's own log: what it says arrives whole, and a reader that takes nothing stops nobody.

mod reader;

use std::{
    sync::{Arc, Mutex, mpsc::sync_channel},
    time::Duration,
};

use reader::Reader;
use sinew_runtime::log;
use tracing::{Level, Metadata, subscriber::with_default};

const INFO: fn(&Metadata<'_>) -> bool = |metadata| *metadata.level() <= Level::INFO;
const DEADLINE: Duration = Duration::from_secs(60);

/// One test, because there is one log in a process.
#[test]
fn what_is_logged_arrives_whole_and_in_order_and_a_reader_that_blocks_holds_nobody_up() {
    // Given a reader on this thread.
    let (read, lines) = sync_channel(10_000);
    let reader = Arc::new(Reader { wants: INFO, read: read.clone(), may_go_on: None });
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
    let reader = Arc::new(Reader { wants: INFO, read, may_go_on: Some(Mutex::new(may_go_on)) });
    with_default(reader, || log::info!("the first"));
    assert_eq!(next(), "INFO log: message=the first");
    // Then whoever logs goes on: what has no room is lost, and counted.
    let before = log::lost();
    let (read, more) = sync_channel(10_000);
    with_default(Arc::new(Reader { wants: INFO, read, may_go_on: None }), || {
        (0..2_000_u64).for_each(|number| log::info!(number, "one of many"));
    });
    let lost = log::lost() - before;
    assert_eq!(lost, 2_000 - 1_024);
    // And the rest is written when it comes back.
    go_on.send(()).expect("it waits for this");
    log::flush(DEADLINE);
    assert_eq!(more.try_iter().count(), 1_024);
}
