//! A message that has come and is being handled: it is counted once, whatever panics.

use super::{
    super::arrivals::{Arrivals, End},
    Way,
};

/// A message in hand. If nobody says how it ended, it has failed.
pub(in crate::gncl) struct Hand<'a>(Option<&'a Way>);

impl<'a> Hand<'a> {
    pub(super) const fn of(way: &'a Way) -> Self {
        Self(Some(way))
    }

    /// The message has ended so.
    pub(in crate::gncl) fn ends(mut self, end: End) {
        if let Some(way) = self.0.take() {
            way.end(end);
        }
    }

    /// It had come before: nothing is in hand, and nothing came.
    pub(in crate::gncl) fn had_come(mut self) {
        if let Some(way) = self.0.take() {
            way.leaves_the_hand(Arrivals::take_none);
        }
    }

    /// The message waits in a line.
    pub(in crate::gncl) fn empty(mut self) {
        self.0 = None;
    }
}

impl Drop for Hand<'_> {
    fn drop(&mut self) {
        if let Some(way) = self.0 {
            way.end(End::Failed);
        }
    }
}
