//! The outcome of a confirmed message, as a record of a fixed length: the thread that settles a message writes it.

use sinew_runtime::{
    outcome::{Outcome, Ticket},
    tid::Tid,
};

use crate::{
    channel::Form,
    entry::{HEAD, VERSION},
};

/// Bytes behind the first ones of the record.
const LEN: usize = 32;

/// The outcome of a confirmed message. A recorded message has the same source, destination and correlation.
///
/// ```text
/// byte 0  source
///      8  destination
///     16  correlation
///     24  byte of the outcome on the wire
///     25  zero, seven bytes
/// ```
///
/// Numbers are little-endian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OutcomeEntry {
    /// The message: its sender, its destination and its number. Of one member of a message to many, the member is the
    /// destination, or its node without an application.
    pub ticket: Ticket,
    /// The outcome.
    pub outcome: Outcome,
}

impl OutcomeEntry {
    /// Returns the record. It allocates nothing.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew_record::{Entry, OutcomeEntry};
    /// use sinew_runtime::{outcome::{Outcome, Ticket}, tid::Tid};
    ///
    /// let ticket = Ticket { source: Tid::from_bits(7), destination: Tid::NONE, correlation: 3 };
    /// let entry = OutcomeEntry { ticket, outcome: Outcome::Expired };
    /// assert_eq!(Entry::read(&entry.record())?, Entry::Outcome(entry));
    /// # Ok::<(), sinew_record::EntryError>(())
    /// ```
    #[must_use]
    pub fn record(&self) -> [u8; HEAD + LEN] {
        let Ticket { source, destination, correlation } = self.ticket;
        let mut bytes = [0; HEAD + LEN];
        (bytes[0], bytes[1]) = (VERSION, Form::Outcome.code());
        let words = [source.bits(), destination.bits(), correlation, u64::from(self.outcome.code())];
        for (to, word) in bytes[HEAD..].chunks_exact_mut(8).zip(words) {
            to.copy_from_slice(&word.to_le_bytes());
        }
        bytes
    }

    /// Reads the bytes behind the first ones of a record.
    pub(crate) fn read(bytes: &[u8]) -> Option<Self> {
        let (words, []) = bytes.as_chunks::<8>() else { return None };
        let [source, destination, correlation, code] = <[[u8; 8]; 4]>::try_from(words).ok()?;
        let tid = |word| Tid::from_bits(u64::from_le_bytes(word));
        let (source, destination) = (tid(source), tid(destination));
        let ticket = Ticket { source, destination, correlation: u64::from_le_bytes(correlation) };
        let code = u8::try_from(u64::from_le_bytes(code)).ok()?;
        Some(Self { ticket, outcome: Outcome::from_code(code)? })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sinew_runtime::outcome::Rejection;

    use super::*;
    use crate::{Entry, EntryError};

    #[test]
    fn outcome_is_read_as_it_was_written() {
        let ticket =
            Ticket { source: Tid::from_bits(1 << 60), destination: Tid::from_bits(9), correlation: 17 };
        for outcome in (0..=u8::MAX).filter_map(Outcome::from_code) {
            let entry = OutcomeEntry { ticket, outcome };
            assert_eq!(Entry::read(&entry.record()).expect("it is one"), Entry::Outcome(entry));
        }
        let mut record =
            OutcomeEntry { ticket, outcome: Outcome::Rejected(Rejection::QueueFull) }.record().to_vec();
        record[2] = 16;
        assert!(matches!(Entry::read(&record), Err(EntryError::Form)), "no outcome is itself rejected");
        record[2] = 0;
        record.push(0);
        assert!(matches!(Entry::read(&record), Err(EntryError::Outcome)));
    }

    proptest! {
        /// Any bytes are an outcome or none, and one of them is written back as the same bytes.
        #[test]
        fn any_bytes_are_read_or_refused(mut bytes in any::<[u8; LEN]>(), code in 0..40_u8) {
            prop_assert_eq!(OutcomeEntry::read(&bytes[1..]), None);
            bytes[24..].copy_from_slice(&u64::from(code).to_le_bytes());
            if let Some(entry) = OutcomeEntry::read(&bytes) {
                prop_assert_eq!(&entry.record()[HEAD..], &bytes[..]);
            }
        }
    }
}
