//! The messages at which one page looks: their channels with the latest values, and the plotted series.

use std::{collections::BTreeMap, fmt::Write as _};

use serde_json::{Value, json};
use sinew::Time;

use crate::{
    decimate::Decimator,
    fields::numbers,
    look::{Look, SEPARATOR},
    source::Sighting,
};

/// Channels of one page. Messages of further ones are counted.
const CHANNELS_MAX: usize = 128;
/// The name of the field that each message has: its age in milliseconds.
const AGE: &str = "@age_ms";

/// The messages of one type from one application to another.
#[derive(Debug, Default)]
struct Channel {
    count: u64,
    /// Messages since the last table.
    recent: u64,
    rejected: u64,
    fields: BTreeMap<String, f64>,
    /// The plotted fields: the name, and its place in the list of series.
    plotted: Vec<(String, usize)>,
}

/// The messages of one page.
#[derive(Debug)]
pub(crate) struct Scope {
    look: Look,
    channels: BTreeMap<String, Channel>,
    series: Vec<Decimator>,
    left_out: u64,
    key: String,
    tabled: Option<Time>,
    faults: Vec<String>,
}

impl Scope {
    pub(crate) fn new(look: Look) -> Self {
        let series = look.series.iter().map(|_| Decimator::default()).collect();
        let (channels, key) = (BTreeMap::new(), String::new());
        Self { look, channels, series, left_out: 0, key, tabled: None, faults: Vec::new() }
    }

    pub(crate) const fn look(&self) -> &Look {
        &self.look
    }

    pub(crate) fn set_faults(&mut self, faults: &[String]) {
        self.faults = faults.to_vec();
    }

    /// Takes a message, if the page looks at one of its ends.
    pub(crate) fn take(&mut self, seen: &Sighting<'_>) {
        let Sighting { source, destination, kind, .. } = *seen;
        if !self.look.apps.contains(source) && !self.look.apps.contains(destination) {
            return;
        }
        self.key.clear();
        let _ = write!(self.key, "{source}{SEPARATOR}{destination}{SEPARATOR}{kind}");
        if !self.channels.contains_key(&self.key) {
            if self.channels.len() >= CHANNELS_MAX {
                self.left_out += 1;
                return;
            }
            let plotted = self.look.plotted(&self.key);
            self.channels.insert(self.key.clone(), Channel { plotted, ..Channel::default() });
        }
        let channel = self.channels.get_mut(&self.key).expect("it was inserted if it was missing");
        channel.count += 1;
        channel.recent += 1;
        channel.rejected += u64::from(seen.is_rejected);
        let at_ns = seen.at.as_nanos();
        let (fields, plotted, series) = (&mut channel.fields, &channel.plotted, &mut self.series);
        let mut put = |path: &str, value: f64| {
            if let Some(field) = fields.get_mut(path) {
                *field = value;
            } else if fields.len() <= crate::fields::NUMBERS_MAX {
                fields.insert(path.to_owned(), value);
            }
            for (_, place) in plotted.iter().filter(|(field, _)| field == path) {
                series[*place].take(at_ns, value);
            }
        };
        if let Some(age) = seen.age {
            put(AGE, age.as_secs_f64() * 1e3);
        }
        numbers(seen.payload, &mut put);
    }

    /// Returns the new points of the plotted series; `None` without any. Times are seconds of the wall clock, which is
    /// `offset_s` ahead of the clock of the messages.
    pub(crate) fn points(&mut self, now: Time, offset_s: f64) -> Option<Value> {
        let mut all = Vec::new();
        for (place, series) in self.series.iter_mut().enumerate() {
            let points = series.drain(now.as_nanos());
            let dropped = series.take_dropped();
            if points.is_empty() && dropped == 0 {
                continue;
            }
            let times: Vec<_> = points.iter().map(|(at, _)| *at as f64 / 1e9 + offset_s).collect();
            let values: Vec<_> = points.iter().map(|(_, value)| *value).collect();
            all.push(json!({ "series": place, "t": times, "v": values, "dropped": dropped }));
        }
        (!all.is_empty()).then_some(Value::Array(all))
    }

    /// Returns the table of all channels with their latest values and their rates since the last table.
    pub(crate) fn table(&mut self, now: Time) -> Value {
        let seconds = self.tabled.map(|last| now.since(last).as_secs_f64()).filter(|seconds| *seconds > 0.0);
        self.tabled = Some(now);
        let mut rows = Vec::with_capacity(self.channels.len());
        for (key, channel) in &mut self.channels {
            let recent = std::mem::replace(&mut channel.recent, 0);
            rows.push(json!({
                "key": key, "count": channel.count, "rejected": channel.rejected, "fields": channel.fields,
                "per_s": seconds.map(|seconds| recent as f64 / seconds),
            }));
        }
        json!({ "channels": rows, "left_out": self.left_out, "faults": self.faults })
    }
}

#[cfg(test)]
mod tests {
    use std::{collections::BTreeMap, time::Duration};

    use super::*;

    const MS: u64 = 1_000_000;

    fn look(query: &str) -> Look {
        Look::of_query(query).expect("it is legal")
    }

    fn payload(angle: f64) -> Vec<u8> {
        rmp_serde::to_vec_named(&BTreeMap::from([("angle", angle)])).expect("it can be encoded")
    }

    fn seen<'m>(source: &'m str, at_ms: u64, payload: &'m [u8]) -> Sighting<'m> {
        let age = Some(Duration::from_millis(3));
        let at = Time::from_nanos(at_ms * MS);
        Sighting { source, destination: "knee", kind: "exo.angle", at, age, is_rejected: false, payload }
    }

    #[test]
    fn chosen_field_is_plotted_and_all_are_listed() {
        let mut scope = Scope::new(look("app=hip&series=hip%09knee%09exo.angle%09angle"));
        for (at, angle) in [(1, 0.5), (2, 0.75)] {
            scope.take(&seen("hip", at, &payload(angle)));
        }
        assert_eq!(scope.points(Time::from_nanos(3 * MS), 0.0), None, "the slot has not ended");
        let points = scope.points(Time::from_nanos(40 * MS), 100.0).expect("two values");
        assert_eq!(points[0]["v"], json!([0.5, 0.75]));
        assert_eq!((&points[0]["series"], &points[0]["t"][0]), (&json!(0), &json!(100.001)));
        let table = scope.table(Time::from_nanos(40 * MS));
        let row = &table["channels"][0];
        assert_eq!((&row["key"], &row["count"]), (&json!("hip\tknee\texo.angle"), &json!(2)));
        assert_eq!(row["fields"], json!({ "@age_ms": 3.0, "angle": 0.75 }));
    }

    #[test]
    fn value_without_a_number_is_null() {
        let mut scope = Scope::new(look("app=hip&series=hip%09knee%09exo.angle%09angle"));
        scope.take(&seen("hip", 1, &payload(f64::NAN)));
        let points = scope.points(Time::from_nanos(40 * MS), 0.0).expect("a gap");
        assert_eq!(points[0]["v"], json!([null]));
    }

    #[test]
    fn messages_of_other_applications_are_ignored() {
        let mut scope = Scope::new(look("app=hip"));
        scope.take(&seen("ankle", 1, &payload(1.0)));
        assert_eq!(scope.table(Time::from_nanos(MS))["channels"], json!([]));
    }

    #[test]
    fn channels_have_a_bound_and_further_ones_are_counted() {
        let mut scope = Scope::new(look("app=knee"));
        let bytes = payload(1.0);
        for number in 0..CHANNELS_MAX + 5 {
            scope.take(&seen(&format!("app{number}"), 1, &bytes));
        }
        let table = scope.table(Time::from_nanos(MS));
        assert_eq!(table["channels"].as_array().map(Vec::len), Some(CHANNELS_MAX));
        assert_eq!(table["left_out"], json!(5));
    }
}
