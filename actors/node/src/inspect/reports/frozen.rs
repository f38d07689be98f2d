//! The limits of the answers about frozen spans. `sinew-record` has their fields.

use sinew_record::{FreezeReport, FrozenReport};
use sinew_runtime::wire::Class;

use super::{Report, halve};

/// The cause of a refusal is short.
impl Report for FreezeReport {
    fn halve(&mut self) -> bool {
        self.refused.take().is_some()
    }
}

impl Report for FrozenReport {
    const TRAVELS: Class = Class::Bulk;

    fn halve(&mut self) -> bool {
        if self.bytes.len() > 1 {
            self.bytes.truncate(self.bytes.len() / 2);
            return true;
        }
        halve(&mut self.spans, &mut self.spans_left_out)
    }
}
