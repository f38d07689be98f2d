//! The runtime's own log: entries arrive complete, and a blocked reader blocks no other thread.

use std::{
    sync::{Arc, Mutex, mpsc::sync_channel},
    time::Duration,
};

use sinew_runtime::log::{self, LogObserver, observe};
use tracing::{Level, Metadata, level_filters::LevelFilter, subscriber::with_default};

use super::{alone, reader::Reader};

const INFO: fn(&Metadata<'_>) -> bool = |metadata| *metadata.level() <= Level::INFO;
const DEADLINE: Duration = Duration::from_secs(60);

/// One test, because there is one log in a process.
#[test]
fn log_is_complete_and_ordered_and_never_blocks() {
    alone("log::log_is_complete_and_ordered_and_never_blocks", || {
        // Given a reader on this thread.
        let (read, lines) = sync_channel(10_000);
        let reader = Arc::new(Reader { wants: INFO, read: read.clone(), may_go_on: None });
        let next = || lines.recv_timeout(DEADLINE).expect("it is written");
        let why = std::io::Error::other("why");
        // When entries are logged, then it receives all that it wants, unchanged.
        with_default(reader, || {
            log::warn!(child = "hip", restarts = 3_u64, %why, "it {}", "failed");
            log::debug!("nobody wants this");
            log::error!("{}", "x".repeat(100_000));
        });
        assert_eq!(next(), "WARN alone::log: message=it failed child='hip' restarts=3u64 why=why");
        assert_eq!(next(), format!("ERROR alone::log: message={}", "x".repeat(4_096)));
        // When an entry is logged to a reader that does not return.
        let (go_on, may_go_on) = sync_channel(0);
        let reader = Arc::new(Reader { wants: INFO, read, may_go_on: Some(Mutex::new(may_go_on)) });
        with_default(reader, || log::info!("the first"));
        assert_eq!(next(), "INFO alone::log: message=the first");
        // Then logging threads continue: entries without room are lost, and counted.
        let before = log::lost();
        let (read, more) = sync_channel(10_000);
        with_default(Arc::new(Reader { wants: INFO, read, may_go_on: None }), || {
            (0..2_000_u64).for_each(|number| log::info!(number, "one of many"));
        });
        let lost = log::lost() - before;
        assert_eq!(lost, 2_000 - 1_024);
        // And the rest is written when the reader returns.
        go_on.send(()).expect("it waits for this");
        log::flush(DEADLINE);
        assert_eq!(more.try_iter().count(), 1_024);
    });
}

/// Keeps the texts of all events.
#[derive(Default)]
struct Texts(Mutex<Vec<String>>);

impl LogObserver for Texts {
    fn wrote(&self, _: Level, _: &str, text: &str) {
        self.0.lock().unwrap().push(text.to_owned());
    }
}

/// The start of a further node in a process sets the level.
#[test]
fn used_place_logs_again_after_level_was_set() {
    alone("log::used_place_logs_again_after_level_was_set", || {
        let texts = Arc::new(Texts::default());
        let observer: Arc<dyn LogObserver> = texts.clone();
        assert!(observe(&observer));
        // One place of the code, and a target of Sinew: the default log has no others.
        let warn = |text: &str| log::warn!(target: "sinew::test", "{text}");
        warn("before");
        log::set_level(LevelFilter::INFO);
        warn("after");
        log::flush(DEADLINE);
        assert_eq!(*texts.0.lock().unwrap(), ["before", "after"]);
    });
}
