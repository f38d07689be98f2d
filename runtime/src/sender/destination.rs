//! The destination of a message: an address or a name.

use crate::tid::Tid;

/// The destination of a message: a TID (an application, a group, all applications) or a name.
///
/// # Examples
///
/// ```
/// use sinew::{Tid, message::Destination};
///
/// let by_name: Destination<'_> = "knee.drive".into();
/// let by_address: Destination<'_> = Tid::group("drives").into();
/// assert_ne!(by_name, by_address);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Destination<'a> {
    /// A destination address.
    Tid(Tid),
    /// A name, resolved in the directory that all nodes share.
    Name(&'a str),
}

impl From<Tid> for Destination<'_> {
    fn from(tid: Tid) -> Self {
        Self::Tid(tid)
    }
}

impl<'a> From<&'a str> for Destination<'a> {
    fn from(name: &'a str) -> Self {
        Self::Name(name)
    }
}
