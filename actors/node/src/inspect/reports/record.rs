//! The lists of the answer to a program that records, within their limits. Its types are those of `sinew-record`.

use sinew_record::RecordReport;

use super::{Report, Shortened};

/// The longest list is halved.
impl Report for RecordReport {
    fn halve(&mut self) -> bool {
        let mut lists: [&mut dyn Shortened; 3] = [
            &mut (&mut self.apps, &mut self.apps_left_out),
            &mut (&mut self.types, &mut self.types_left_out),
            &mut (&mut self.clocks, &mut self.clocks_left_out),
        ];
        lists.sort_by_key(|list| std::cmp::Reverse(list.bytes()));
        lists[0].halve()
    }
}
