//! A subscriber for tests: its events come out of a channel, one text for each event.

use std::{
    fmt::Write as _,
    sync::{
        Mutex,
        mpsc::{Receiver, SyncSender},
    },
};

use tracing::{
    Event, Metadata, Subscriber,
    field::{Field, Visit},
    span,
};

/// Records its events. The test can block it in the middle of one.
pub(crate) struct Reader {
    /// Selects the events to record.
    pub(crate) wants: fn(&Metadata<'_>) -> bool,
    /// The channel for the texts. A test may stop reading it.
    pub(crate) read: SyncSender<String>,
    pub(crate) may_go_on: Option<Mutex<Receiver<()>>>,
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
        (self.wants)(metadata)
    }

    fn event(&self, event: &Event<'_>) {
        let mut words = Words(format!("{} {}:", event.metadata().level(), event.metadata().target()));
        event.record(&mut words);
        let _ = self.read.send(words.0);
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
