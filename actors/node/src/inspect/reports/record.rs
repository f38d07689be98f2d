//! The lists of the answer to a program that records, within their limits. Its types are those of `sinew-record`.

use sinew_record::{CLOCKS_MAX, RECORDED_MAX, RecordReport};

use super::{Report, Shortened};

/// Limits the lists to those of an answer.
pub(crate) fn bounded(mut report: RecordReport) -> RecordReport {
    let cut = |length: usize, max: usize| length.saturating_sub(max) as u64;
    report.apps_left_out = cut(report.apps.len(), RECORDED_MAX);
    report.types_left_out = cut(report.types.len(), RECORDED_MAX);
    report.clocks_left_out = cut(report.clocks.len(), CLOCKS_MAX);
    report.apps.truncate(RECORDED_MAX);
    report.types.truncate(RECORDED_MAX);
    report.clocks.truncate(CLOCKS_MAX);
    report
}

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
