//! The file or the views, and the faults of the file.

use sinew_bag::{
    BagError, BagWriter, ChannelId, ChannelInfo, ClockReading, Event, Record, Totals, ViewItem, ViewWriter,
};

/// Where messages go.
#[derive(Debug)]
enum Target {
    File(Box<BagWriter>),
    Views(Box<ViewWriter>),
}

/// Writes into the file, or makes views. A fault is kept until its owner asks for it: the messages are counted all the
/// same.
#[derive(Debug)]
pub(crate) struct Sink {
    target: Target,
    /// The oldest fault that was not taken.
    fault: Option<BagError>,
    is_full: bool,
}

impl Sink {
    pub(crate) fn new(bag: BagWriter) -> Self {
        Self { target: Target::File(Box::new(bag)), fault: None, is_full: false }
    }

    pub(crate) fn of_views(views: ViewWriter) -> Self {
        Self { target: Target::Views(Box::new(views)), fault: None, is_full: false }
    }

    /// Returns the writer of views, if it has one.
    pub(crate) fn views(&mut self) -> Option<&mut ViewWriter> {
        match &mut self.target {
            Target::File(_) => None,
            Target::Views(views) => Some(views),
        }
    }

    /// Returns the views since the last call.
    pub(crate) fn take_views(&mut self) -> Vec<ViewItem> {
        self.views().map(ViewWriter::take).unwrap_or_default()
    }

    pub(crate) fn channel(&mut self, info: &ChannelInfo<'_>) -> Option<ChannelId> {
        match &mut self.target {
            Target::File(bag) => {
                let found = bag.channel(info);
                self.keep(found)
            }
            Target::Views(views) => views.channel(info),
        }
    }

    pub(crate) fn message(&mut self, channel: ChannelId, record: &Record<'_>) {
        match &mut self.target {
            Target::File(bag) => {
                let written = bag.message(channel, record);
                self.keep(written);
            }
            Target::Views(views) => views.message(channel, record),
        }
    }

    pub(crate) fn dropped(&mut self, channel: ChannelId, count: u64, span_ns: (u64, u64)) {
        if count == 0 {
            return;
        }
        match &mut self.target {
            Target::File(bag) => {
                let written = bag.dropped(channel, count, span_ns);
                self.keep(written);
            }
            Target::Views(views) => views.dropped(channel, count, span_ns),
        }
    }

    pub(crate) fn event(&mut self, event: &Event<'_>) {
        match &mut self.target {
            Target::File(bag) => {
                let written = bag.event(event);
                self.keep(written);
            }
            Target::Views(views) => views.event(event),
        }
    }

    pub(crate) fn clock(&mut self, now_ns: u64, reading: &ClockReading) {
        match &mut self.target {
            Target::File(bag) => {
                let written = bag.clock(now_ns, reading);
                self.keep(written);
            }
            Target::Views(views) => views.clock(now_ns, reading),
        }
    }

    pub(crate) fn lose_events(&mut self, count: u64) {
        match &mut self.target {
            Target::File(bag) => bag.lose_events(count),
            Target::Views(views) => views.lose_events(count),
        }
    }

    pub(crate) fn tally(&mut self, now_ns: u64) {
        match &mut self.target {
            Target::File(bag) => {
                let written = bag.tally(now_ns);
                self.keep(written);
            }
            Target::Views(views) => views.tally(now_ns),
        }
    }

    /// Returns the counters of the file; of views none.
    pub(crate) fn totals(&self) -> Totals {
        match &self.target {
            Target::File(bag) => bag.totals(),
            Target::Views(_) => Totals::default(),
        }
    }

    pub(crate) const fn is_full(&self) -> bool {
        self.is_full
    }

    pub(crate) const fn take_fault(&mut self) -> Option<BagError> {
        self.fault.take()
    }

    pub(crate) fn finish(self, now_ns: u64) -> Result<Totals, BagError> {
        match self.target {
            Target::File(bag) => bag.finish(now_ns),
            Target::Views(_) => Ok(Totals::default()),
        }
    }

    fn keep<T>(&mut self, result: Result<T, BagError>) -> Option<T> {
        match result {
            Ok(value) => Some(value),
            Err(BagError::Full { .. }) => {
                self.is_full = true;
                None
            }
            Err(fault) => {
                self.fault.get_or_insert(fault);
                None
            }
        }
    }
}
