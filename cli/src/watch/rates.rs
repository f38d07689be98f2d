//! The rate and the age of messages per type.

use std::{collections::BTreeMap, time::Duration};

use serde_json::{Value, json};
use sinew::inspect::SeenMessage;

use crate::table::time;

/// Maximum number of distinguished types; further ones are counted together.
const KINDS_MAX: usize = 256;

/// Counts since the last report.
#[derive(Debug, Default)]
pub(super) struct Rates {
    kinds: BTreeMap<(String, bool), Kind>,
    dropped: u64,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Kind {
    count: u64,
    bytes: u64,
    /// Number of messages with a known age.
    aged: u64,
    age_sum_ns: u128,
    age_max_ns: Option<u64>,
    refused: u64,
}

/// The report on a period.
#[derive(Debug)]
pub(super) struct Rated {
    rates: Rates,
    over: Duration,
}

impl Rates {
    pub(super) fn add(&mut self, message: &SeenMessage) {
        let mut key = (super::screen::kind(message), message.is_sent);
        if self.kinds.len() >= KINDS_MAX && !self.kinds.contains_key(&key) {
            key.0 = "(others)".to_owned();
        }
        let kind = self.kinds.entry(key).or_default();
        kind.count += 1;
        kind.bytes += message.length;
        if let Some(age_ns) = message.age_ns {
            kind.aged += 1;
            kind.age_sum_ns += u128::from(age_ns);
            kind.age_max_ns = kind.age_max_ns.max(Some(age_ns));
        }
        kind.refused += u64::from(message.refused.is_some());
    }

    /// Adds messages that were not recorded.
    pub(super) const fn drop(&mut self, count: u64) {
        self.dropped += count;
    }

    /// Starts a new period. Returns the counts of the last one.
    pub(super) fn end(&mut self, over: Duration) -> Rated {
        Rated { rates: std::mem::take(self), over }
    }
}

impl Rated {
    pub(super) fn text(&self) -> String {
        let seconds = self.over.as_secs_f64().max(1e-3);
        let line = |((name, is_sent), kind): (&(String, bool), &Kind)| {
            let arrow = if *is_sent { "<-" } else { "->" };
            let refused =
                if kind.refused > 0 { format!(", {} REFUSED", kind.refused) } else { String::new() };
            format!(
                "   --- {arrow} {name}: {:.1}/s, {:.0} B/s, age mean {} max {}{refused}\n",
                kind.count as f64 / seconds,
                kind.bytes as f64 / seconds,
                age(kind.age_mean_ns()),
                age(kind.age_max_ns),
            )
        };
        let mut text: String = self.rates.kinds.iter().map(line).collect();
        if text.is_empty() {
            text += &format!("   --- nothing in {seconds:.1} s\n");
        }
        if self.rates.dropped > 0 {
            text += &format!(
                "   --- {} further ones are not shown: they came faster than they are fetched, the application did not wait for it\n",
                self.rates.dropped
            );
        }
        text
    }

    pub(super) fn json(&self, time_s: f64) -> Value {
        let seconds = self.over.as_secs_f64().max(1e-3);
        let kinds = self.rates.kinds.iter().map(|((name, is_sent), kind)| {
            json!({
                "kind": name, "sent": is_sent, "count": kind.count, "per_s": kind.count as f64 / seconds,
                "bytes_per_s": kind.bytes as f64 / seconds, "age_mean_ns": kind.age_mean_ns(),
                "age_max_ns": kind.age_max_ns, "refused": kind.refused,
            })
        });
        let kinds: Vec<_> = kinds.collect();
        json!({ "event": "rates", "time_s": time_s, "over_s": seconds, "dropped": self.rates.dropped, "kinds": kinds })
    }
}

/// Formats an age as for a single message: unknown for nodes without a clock measurement.
fn age(ns: Option<u64>) -> String {
    ns.map_or_else(|| "?".to_owned(), |ns| time(ns / 1_000))
}

impl Kind {
    /// Returns the mean age; `None` if no age is known.
    fn age_mean_ns(&self) -> Option<u64> {
        let mean = self.age_sum_ns.checked_div(self.aged.into())?;
        Some(u64::try_from(mean).unwrap_or(u64::MAX))
    }
}

#[cfg(test)]
mod tests {
    use sinew::{AppAddress, Class, NodeAddress, Tid, message::Rejection};

    use super::*;

    fn message(name: &str, age_ns: Option<u64>, refused: Option<Rejection>) -> SeenMessage {
        let tid = Tid::new(NodeAddress::from([127, 0, 0, 1]), AppAddress::new(0x1000));
        SeenMessage {
            seen_us: 0,
            age_ns,
            age_error_ns: age_ns.map(|_| 0),
            is_sent: false,
            source: tid,
            target: tid,
            kind: sinew::message::Kind::named(name),
            name: Some(name.to_owned()),
            class: Class::Control,
            sequence: 1,
            wants: None,
            length: 100,
            payload: Vec::new(),
            refused,
        }
    }

    #[test]
    fn types_and_dropped_messages_have_lines() {
        let mut rates = Rates::default();
        (0..10).for_each(|number| rates.add(&message("a", Some(number * 2_000), None)));
        // Of unknown age: it does not count in the mean.
        rates.add(&message("a", None, None));
        rates.add(&message("b", Some(0), Some(Rejection::QueueFull)));
        rates.drop(7);
        let shown = rates.end(Duration::from_secs(2));
        assert_eq!(
            shown.text().lines().take(2).collect::<Vec<_>>(),
            [
                "   --- -> a: 5.5/s, 550 B/s, age mean 9 us max 18 us",
                "   --- -> b: 0.5/s, 50 B/s, age mean 0 us max 0 us, 1 REFUSED"
            ]
        );
        assert!(shown.text().contains("   --- 7 further ones"));
        assert_eq!(rates.end(Duration::from_secs(1)).text(), "   --- nothing in 1.0 s\n", "it begins anew");
    }

    #[test]
    fn unknown_age_is_not_shown_as_0() {
        let mut rates = Rates::default();
        rates.add(&message("a", None, None));
        rates.add(&message("b", Some(0), None));
        let shown = rates.end(Duration::from_secs(1));
        assert_eq!(
            shown.text().lines().collect::<Vec<_>>(),
            [
                "   --- -> a: 1.0/s, 100 B/s, age mean ? max ?",
                "   --- -> b: 1.0/s, 100 B/s, age mean 0 us max 0 us"
            ]
        );
        let json = shown.json(0.0);
        let ages = ["age_mean_ns", "age_max_ns"].map(|age| [&json["kinds"][0][age], &json["kinds"][1][age]]);
        assert_eq!(ages, [[&Value::Null, &json!(0)]; 2]);
    }
}
