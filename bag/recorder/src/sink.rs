//! The file, and its faults.

use sinew_bag::{BagError, BagWriter, ChannelId, ChannelInfo, ClockReading, Event, Record, Totals};

/// Writes into the file. A fault is kept until its owner asks for it: the messages are counted all the same.
#[derive(Debug)]
pub(crate) struct Sink {
    bag: BagWriter,
    /// The oldest fault that was not taken.
    fault: Option<BagError>,
    is_full: bool,
}

impl Sink {
    pub(crate) const fn new(bag: BagWriter) -> Self {
        Self { bag, fault: None, is_full: false }
    }

    pub(crate) fn channel(&mut self, info: &ChannelInfo<'_>) -> Option<ChannelId> {
        let found = self.bag.channel(info);
        self.keep(found)
    }

    pub(crate) fn message(&mut self, channel: ChannelId, record: &Record<'_>) {
        let written = self.bag.message(channel, record);
        self.keep(written);
    }

    pub(crate) fn dropped(&mut self, channel: ChannelId, count: u64, span_ns: (u64, u64)) {
        if count > 0 {
            let written = self.bag.dropped(channel, count, span_ns);
            self.keep(written);
        }
    }

    pub(crate) fn event(&mut self, event: &Event<'_>) {
        let written = self.bag.event(event);
        self.keep(written);
    }

    pub(crate) fn clock(&mut self, now_ns: u64, reading: &ClockReading) {
        let written = self.bag.clock(now_ns, reading);
        self.keep(written);
    }

    pub(crate) const fn lose_events(&mut self, count: u64) {
        self.bag.lose_events(count);
    }

    pub(crate) fn tally(&mut self, now_ns: u64) {
        let written = self.bag.tally(now_ns);
        self.keep(written);
    }

    pub(crate) fn totals(&self) -> Totals {
        self.bag.totals()
    }

    pub(crate) const fn is_full(&self) -> bool {
        self.is_full
    }

    pub(crate) const fn take_fault(&mut self) -> Option<BagError> {
        self.fault.take()
    }

    pub(crate) fn finish(self, now_ns: u64) -> Result<Totals, BagError> {
        self.bag.finish(now_ns)
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
