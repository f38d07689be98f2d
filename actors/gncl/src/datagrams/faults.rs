//! Faults that the simulation plants in a core. Only the feature `testing` has them, and no node has that
//! feature.

use super::core::Core;

/// A fault of a core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Each value is forwarded, with any number.
    NumbersNotCompared,
    /// A value that counts as lost is not sent again.
    NotRepeated,
    /// An answered probe counts for every length.
    AllLengthsTrusted,
}

impl<K, V> Core<K, V> {
    /// Plants a fault.
    pub const fn plant(&mut self, fault: Fault) {
        match fault {
            Fault::NumbersNotCompared => self.incoming.planted = Some(fault),
            Fault::NotRepeated => self.outgoing.planted = Some(fault),
            Fault::AllLengthsTrusted => self.lengths.planted = Some(fault),
        }
    }
}
