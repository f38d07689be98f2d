//! How often messages of each type go by, and how old they are.

use std::{collections::BTreeMap, time::Duration};

use serde_json::{Value, json};
use sinew::inspect::SeenMessage;

use crate::table::time;

/// Types that are told apart at most; further ones are counted together.
const KINDS_MAX: usize = 256;

/// Counts since the last time that they were said.
#[derive(Debug, Default)]
pub(super) struct Rates {
    kinds: BTreeMap<(String, bool), Kind>,
    dropped: u64,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Kind {
    count: u64,
    bytes: u64,
    /// Those of them whose age is known.
    aged: u64,
    age_sum_ns: u128,
    age_max_ns: Option<u64>,
    refused: u64,
}

/// What is said of a time that is over.
#[derive(Debug)]
pub(super) struct Rated {
    rates: Rates,
    over: Duration,
}

impl Rates {
    pub(super) fn add(&mut self, message: &SeenMessage) {
        let mut key = (super::kind(message), message.is_sent);
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

    /// So many were not seen.
    pub(super) const fn drop(&mut self, count: u64) {
        self.dropped += count;
    }

    /// Begins anew; returns what was counted in this time.
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

/// As of a single message: nothing is said of what came from nodes whose clocks nobody has measured.
fn age(ns: Option<u64>) -> String {
    ns.map_or_else(|| "?".to_owned(), |ns| time(ns / 1_000))
}

impl Kind {
    /// `None` where no age is known.
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
    fn each_type_has_a_line_and_what_was_dropped_has_one() {
        let mut rates = Rates::default();
        (0..10).for_each(|number| rates.add(&message("a", Some(number * 2_000), None)));
        // Of unknown age: it makes no mean.
        rates.add(&message("a", None, None));
        rates.add(&message("b", Some(0), Some(Rejection::QueueFull)));
        rates.drop(7);
        let said = rates.end(Duration::from_secs(2));
        assert_eq!(
            said.text().lines().take(2).collect::<Vec<_>>(),
            [
                "   --- -> a: 5.5/s, 550 B/s, age mean 9 us max 18 us",
                "   --- -> b: 0.5/s, 50 B/s, age mean 0 us max 0 us, 1 REFUSED"
            ]
        );
        assert!(said.text().contains("   --- 7 further ones"));
        assert_eq!(rates.end(Duration::from_secs(1)).text(), "   --- nothing in 1.0 s\n", "it begins anew");
    }

    #[test]
    fn an_age_that_is_not_known_is_not_said_to_be_0() {
        let mut rates = Rates::default();
        rates.add(&message("a", None, None));
        rates.add(&message("b", Some(0), None));
        let said = rates.end(Duration::from_secs(1));
        assert_eq!(
            said.text().lines().collect::<Vec<_>>(),
            [
                "   --- -> a: 1.0/s, 100 B/s, age mean ? max ?",
                "   --- -> b: 1.0/s, 100 B/s, age mean 0 us max 0 us"
            ]
        );
        let json = said.json(0.0);
        let ages = ["age_mean_ns", "age_max_ns"].map(|age| [&json["kinds"][0][age], &json["kinds"][1][age]]);
        assert_eq!(ages, [[&Value::Null, &json!(0)]; 2]);
    }
}
