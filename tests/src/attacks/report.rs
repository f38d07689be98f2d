//! What was seen, as a table and as JSON.

use std::{fmt, time::Duration};

use serde_json::{Value, json};

use super::{
    Attack, GROWTH_MAX, Happened, Knocked, P99_FLOOR, SLOWER_MAX,
    robot::{Seen, Window},
};

/// What came of all attacks.
#[derive(Debug)]
pub struct Report {
    /// One each.
    pub rows: Vec<Row>,
}

/// What came of one attack.
#[derive(Debug)]
pub struct Row {
    /// Its name.
    pub name: &'static str,
    /// What was tried.
    pub tried: &'static str,
    /// What happened.
    pub happened: String,
    /// Live traffic before.
    pub before: Window,
    /// And during it.
    pub during: Window,
    /// The most of the attacked node's memory above that before, in bytes.
    pub growth: u64,
    /// What must not be, apart from times: none of that if the node has held.
    pub broken: Vec<String>,
}

impl Row {
    pub(super) fn of(
        attack: &Attack,
        [before, during]: [Window; 2],
        growth: u64,
        (happened, seen): (Happened, [Seen; 2]),
        (came, by_hand): (Option<Duration>, Option<Knocked>),
    ) -> Self {
        let Happened { what, mut broken } = happened;
        let mut said = vec![what];
        if let Some(came) = came {
            said.push(format!("ankle talks after {} ms", came.as_millis()));
        }
        if let Some(Knocked { tried, came_in }) = by_hand {
            said.push(format!("{came_in} of {tried} honest strangers came in"));
            // One of them may have been under way at the end.
            if came_in + 1 < tried || came_in == 0 {
                broken.push(format!("{} honest strangers did not come in", tried - came_in));
            }
        }
        // The one that is started in the middle of it goes in the middle of it, too.
        let others = u64::from(came.is_some());
        for (seen, name) in seen.iter().zip(["hip", "knee"]) {
            if seen.lost > others {
                broken.push(format!("{name} has lost {} nodes", seen.lost));
            }
            if seen.found > 1 + others {
                broken.push(format!("{name} has found {} nodes that are none", seen.found - 1 - others));
            }
            let forged = seen.sent.iter().filter(|(node, _)| **node != attack.own.host);
            let forged: u64 = forged.map(|(_, count)| count).sum();
            if forged > 0 {
                broken.push(format!("{name} took {forged} messages in the name of others"));
            }
            let own = seen.sent.get(&attack.own.host);
            said.extend(own.map(|own| format!("{own} taken in the sender's own name")));
        }
        if during.failed > 0 || during.count == 0 {
            broken.push(format!("{} questions without an answer, {} with one", during.failed, during.count));
        }
        if growth > GROWTH_MAX {
            broken.push(format!("memory grew by {} MiB", growth >> 20));
        }
        Self {
            name: attack.name,
            tried: attack.tried,
            happened: said.join("; "),
            before,
            during,
            growth,
            broken,
        }
    }

    /// How much longer 99 of 100 answers took.
    #[must_use]
    pub fn ratio(&self) -> f64 {
        self.during.p99.as_secs_f64() / self.before.p99.max(P99_FLOOR).as_secs_f64()
    }

    /// All that has to hold on every machine holds: nobody got in, nobody was lost, memory is bounded.
    #[must_use]
    pub const fn has_held(&self) -> bool {
        self.broken.is_empty()
    }

    /// Live traffic did not feel it.
    #[must_use]
    pub fn is_unfelt(&self) -> bool {
        self.ratio() <= SLOWER_MAX
    }

    fn json(&self) -> Value {
        let window = |window: &Window| {
            let us = |time: Duration| time.as_micros() as u64;
            json!({
                "answers": window.count, "failed": window.failed,
                "p50_us": us(window.p50), "p99_us": us(window.p99), "max_us": us(window.max),
            })
        };
        json!({
            "attack": self.name, "tried": self.tried, "happened": self.happened,
            "before": window(&self.before), "during": window(&self.during), "p99_ratio": self.ratio(),
            "growth_kib": self.growth >> 10, "held": self.has_held(), "unfelt": self.is_unfelt(), "broken": self.broken,
        })
    }
}

impl Report {
    /// Every attack was held off.
    #[must_use]
    pub fn has_held(&self) -> bool {
        self.rows.iter().all(Row::has_held)
    }

    /// And live traffic felt none.
    #[must_use]
    pub fn is_unfelt(&self) -> bool {
        self.rows.iter().all(Row::is_unfelt)
    }

    /// One object for each attack.
    #[must_use]
    pub fn json(&self) -> Value {
        self.rows.iter().map(Row::json).collect()
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:<20} {:>10} {:>10} {:>6} {:>10}  held",
            "attack", "p99 before", "during", "ratio", "grown"
        )?;
        for row in &self.rows {
            let Row { name, tried, happened, before, during, growth, broken } = row;
            let us = |time: Duration| format!("{} us", time.as_micros());
            let (before, during, kib) = (us(before.p99), us(during.p99), growth >> 10);
            let held = match (row.has_held(), row.is_unfelt()) {
                (true, true) => "yes",
                (true, false) => "yes, and felt",
                (false, _) => "NO",
            };
            writeln!(f, "{name:<20} {before:>10} {during:>10} {:>6.2} {kib:>6} KiB  {held}", row.ratio())?;
            writeln!(f, "    tried: {tried}\n    happened: {happened}")?;
            broken.iter().try_for_each(|what| writeln!(f, "    BROKEN: {what}"))?;
        }
        write!(
            f,
            "limits: p99 {SLOWER_MAX} times that before ({} us at least), memory {} MiB",
            P99_FLOOR.as_micros(),
            GROWTH_MAX >> 20
        )
    }
}
