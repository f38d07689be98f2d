//! A series of values with at most two points in each sixtieth of a second: its least and its greatest value. So no
//! peak is lost. A value that is no number is a third point, without a value: a gap of the plot.

use std::collections::VecDeque;

/// Points that wait for a page. Beyond it the oldest are dropped: a page that reads too slowly has gaps.
const WAITING_MAX: usize = 256;
/// Nanoseconds of a slot: a sixtieth of a second, as often as a screen is drawn.
const SLOT_NS: u64 = 1_000_000_000 / 60;

/// A value and its time in nanoseconds.
pub(crate) type Point = (u64, f64);

/// The values since the last slot that has ended.
#[derive(Clone, Copy, Debug)]
struct Slot {
    number: u64,
    /// The least and the greatest value.
    extremes: Option<(Point, Point)>,
    /// When it last had a value that is no number.
    gap_ns: Option<u64>,
}

/// Thins out a series.
#[derive(Debug, Default)]
pub(crate) struct Decimator {
    slot: Option<Slot>,
    waiting: VecDeque<Point>,
    dropped: u64,
}

impl Decimator {
    /// Takes a value. A value with an earlier time counts for the current slot.
    pub(crate) fn take(&mut self, at_ns: u64, value: f64) {
        let number = at_ns / SLOT_NS;
        if self.slot.is_some_and(|slot| slot.number < number) {
            self.end_slot();
        }
        let slot = self.slot.get_or_insert(Slot { number, extremes: None, gap_ns: None });
        let point = (at_ns, value);
        if !value.is_finite() {
            slot.gap_ns = Some(at_ns);
            return;
        }
        let (least, greatest) = slot.extremes.get_or_insert((point, point));
        if value < least.1 {
            *least = point;
        }
        if value > greatest.1 {
            *greatest = point;
        }
    }

    /// Returns the points of all slots that have ended by now.
    pub(crate) fn drain(&mut self, now_ns: u64) -> Vec<Point> {
        if self.slot.is_some_and(|slot| slot.number < now_ns / SLOT_NS) {
            self.end_slot();
        }
        self.waiting.drain(..).collect()
    }

    /// Returns the number of points that were dropped, once.
    pub(crate) const fn take_dropped(&mut self) -> u64 {
        std::mem::replace(&mut self.dropped, 0)
    }

    fn end_slot(&mut self) {
        let Some(Slot { extremes, gap_ns, .. }) = self.slot.take() else { return };
        let (least, greatest) = extremes.unzip();
        let one = greatest.filter(|greatest| Some(*greatest) != least);
        let mut points: Vec<_> = least.into_iter().chain(one).collect();
        points.extend(gap_ns.map(|at_ns| (at_ns, f64::NAN)));
        points.sort_by_key(|(at_ns, _)| *at_ns);
        points.into_iter().for_each(|point| self.put(point));
    }

    fn put(&mut self, point: Point) {
        if self.waiting.len() == WAITING_MAX {
            self.waiting.pop_front();
            self.dropped += 1;
        }
        self.waiting.push_back(point);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn slot_has_its_extremes_in_the_order_of_time() {
        let mut series = Decimator::default();
        for (at, value) in [(1, 5.0), (2, 9.0), (3, -1.0), (4, 4.0)] {
            series.take(at * MS, value);
        }
        assert!(series.drain(5 * MS).is_empty(), "the slot has not ended");
        assert_eq!(series.drain(20 * MS), [(2 * MS, 9.0), (3 * MS, -1.0)]);
        assert!(series.drain(40 * MS).is_empty());
    }

    #[test]
    fn constant_value_is_one_point() {
        let mut series = Decimator::default();
        for at in 0..10 {
            series.take(at * MS, 2.0);
        }
        assert_eq!(series.drain(20 * MS), [(0, 2.0)]);
    }

    #[test]
    fn values_without_a_number_are_one_gap() {
        let mut series = Decimator::default();
        for at in 0..10 {
            series.take(at * MS, 2.0 + at as f64);
            series.take(at * MS, if at < 6 { f64::NAN } else { 0.0 });
        }
        series.take(20 * MS, f64::INFINITY);
        let found = series.drain(u64::MAX);
        let times: Vec<_> = found.iter().map(|(at, _)| at / MS).collect();
        assert_eq!(times, [5, 6, 9, 20], "{found:?}");
        assert!(found[0].1.is_nan() && found[3].1.is_nan());
        assert_eq!((found[1].1, found[2].1), (0.0, 11.0));
    }

    #[test]
    fn points_without_a_reader_are_dropped_and_counted() {
        let mut series = Decimator::default();
        for slot in 0..WAITING_MAX as u64 + 10 {
            series.take(slot * SLOT_NS, 1.0);
        }
        assert_eq!(series.drain(u64::MAX).len(), WAITING_MAX);
        assert_eq!((series.take_dropped(), series.take_dropped()), (10, 0));
    }

    proptest! {
        /// However many values come, a second has at most two points for each slot, and the extremes are among them.
        #[test]
        fn second_has_few_points_and_its_extremes(
            values in proptest::collection::vec((0..1_000_000_000_u64, -1e6..1e6_f64), 1..400),
        ) {
            let mut values = values;
            values.sort_by_key(|(at, _)| *at);
            let mut series = Decimator::default();
            values.iter().for_each(|(at, value)| series.take(*at, *value));
            let points = series.drain(u64::MAX);
            prop_assert!(points.len() <= 122);
            let extreme = |points: &[Point], of: fn(f64, f64) -> f64| points.iter().map(|(_, value)| *value).reduce(of);
            prop_assert_eq!(extreme(&points, f64::min), extreme(&values, f64::min));
            prop_assert_eq!(extreme(&points, f64::max), extreme(&values, f64::max));
            prop_assert!(points.is_sorted_by_key(|(at, _)| *at));
        }
    }
}
