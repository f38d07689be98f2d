//! The state of a recorder, and a recorder that makes views in place of a file.

use std::collections::BTreeSet;

use sinew_bag::{BagError, Totals, ViewItem, ViewWriter};
use sinew_runtime::tid::Tid;
use sinew_shm::journal::{JournalReader, ReadJournalError, ReaderCounts};

use super::Recorder;
use crate::{setup::Setup, sink::Sink};

impl Recorder {
    /// Begins with the next message, and makes views of the messages.
    pub(crate) fn begin_views(
        reader: JournalReader,
        views: ViewWriter,
        setup: Setup,
    ) -> Result<Self, ReadJournalError> {
        Self::begin_with(reader, Sink::of_views(views), setup)
    }

    /// Sets the topics of which views are made.
    pub(crate) fn want(&mut self, topics: &BTreeSet<String>) {
        if let Some(views) = self.sink.views() {
            views.want(topics);
        }
    }

    /// Returns the views since the last call. One call of [`pump`](Self::pump) makes few more than 4,096.
    pub(crate) fn take_views(&mut self) -> Vec<ViewItem> {
        self.sink.take_views()
    }

    /// Leaves out the messages of these applications from now on.
    pub(crate) fn leave_out(&mut self, apps: Vec<Tid>) {
        self.setup.left_out = apps;
    }

    /// Returns the oldest fault of the file since the last call. Its messages are counted as dropped, and a new part of
    /// the file is tried once a second.
    pub const fn take_fault(&mut self) -> Option<BagError> {
        self.sink.take_fault()
    }

    /// Returns whether the file has its maximum size. Further messages are counted as dropped.
    #[must_use]
    pub const fn is_full(&self) -> bool {
        self.sink.is_full()
    }

    /// Returns the counters so far.
    #[must_use]
    pub fn totals(&self) -> Totals {
        self.sink.totals()
    }

    /// Returns the events that cost the reader records.
    #[must_use]
    pub const fn counts(&self) -> ReaderCounts {
        self.reader.counts()
    }

    /// Returns whether the node is alive and still writes this journal.
    #[must_use]
    pub fn is_writer_alive(&self) -> bool {
        self.reader.is_writer_alive()
    }

    /// Returns whether the node has ended the journal in order, which a killed one does not.
    ///
    /// # Errors
    /// The journal cannot be read.
    pub fn is_closed(&self) -> Result<bool, ReadJournalError> {
        self.reader.is_closed()
    }
}
