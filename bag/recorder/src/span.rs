//! A span of a journal that is not written any more: a frozen one, or the ring of a dead node.

use std::{collections::BTreeMap, ops::RangeInclusive, path::Path};

use sinew_shm::journal::{ReadJournalError, each_record};

/// The records of a span, by their numbers in each channel.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Span {
    /// First and last number of each place.
    pub(crate) numbers: BTreeMap<u16, (u64, u64)>,
    /// Records within the span.
    pub records: u64,
    /// The earliest time of a record, in nanoseconds of its writer's monotonic clock; 0 without any.
    pub first_ns: u64,
    /// The latest time of a record; 0 without any.
    pub last_ns: u64,
}

impl Span {
    /// Reads the journal at `path`, and notes its records with these times.
    ///
    /// # Errors
    /// The journal cannot be read.
    pub fn scan(path: &Path, times: &RangeInclusive<u64>) -> Result<Self, ReadJournalError> {
        let mut span = Self::default();
        each_record::<ReadJournalError>(path, times, |record, _| {
            span.add(record.place, record.number, record.time);
            Ok(())
        })?;
        Ok(span)
    }

    /// Returns the number of the last record before the span, by place.
    pub(crate) fn before(&self) -> BTreeMap<u16, u64> {
        self.numbers.iter().map(|(place, (first, _))| (*place, first.saturating_sub(1))).collect()
    }

    /// Returns the number of the last record of the span, by place.
    pub(crate) fn until(&self) -> BTreeMap<u16, u64> {
        self.numbers.iter().map(|(place, (_, last))| (*place, *last)).collect()
    }

    fn add(&mut self, place: u16, number: u64, time: u64) {
        self.first_ns = if self.records == 0 { time } else { self.first_ns.min(time) };
        self.last_ns = self.last_ns.max(time);
        self.records += 1;
        let (first, last) = self.numbers.entry(place).or_insert((number, number));
        (*first, *last) = ((*first).min(number), (*last).max(number));
    }
}
