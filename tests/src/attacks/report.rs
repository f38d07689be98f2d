//! What was seen, as a table and as JSON.

use std::{fmt, time::Duration};

use serde_json::{Value, json};

use super::{
    ANSWERED_MIN, Attack, GROWTH_MAX, Happened, Knocked, P99_FLOOR, SLOWER_MAX,
    keys::{self, ANKLE},
    robot::{Refused, Seen, Window},
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
    pub(super) fn of(attack: &Attack, outcome: Outcome) -> Self {
        let mut said = vec![outcome.happened.what.clone()];
        let mut broken = outcome.happened.broken.clone();
        if let Some(came) = outcome.came {
            said.push(format!("ankle talks after {} ms", came.as_millis()));
        }
        if let Some(Knocked { came_in, attempts, longest, never }) = &outcome.by_hand {
            said.push(format!(
                "{came_in} honest strangers came in by {attempts} attempts, the last of them after {} ms",
                longest.as_millis()
            ));
            broken.extend(never.iter().map(|why| format!("an honest stranger never came in: {why}")));
        }
        outcome.members(&mut broken);
        outcome.messages(attack.own.host, &mut said, &mut broken);
        outcome.service(&mut broken);
        outcome.refusals(&mut said, &mut broken);
        let Outcome { before, during, growth, .. } = outcome;
        if growth > GROWTH_MAX {
            broken.push(format!("memory grew by {} MiB", growth >> 20));
        }
        let (name, tried, happened) = (attack.name, attack.tried, said.join("; "));
        Self { name, tried, happened, before, during, growth, broken }
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
                "answers": window.count, "failed": window.failed, "answers_per_s": window.rate() as u64,
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

/// What was seen of one attack.
pub(super) struct Outcome {
    /// By the attacker.
    pub(super) happened: Happened,
    /// By the node that asks, before and meanwhile.
    pub(super) before: Window,
    pub(super) during: Window,
    /// A question that was asked afterwards has an answer.
    pub(super) answers_again: bool,
    /// Of the attacked node's memory, in bytes.
    pub(super) growth: u64,
    /// By the attacked node meanwhile.
    pub(super) refused: Refused,
    /// By both nodes.
    pub(super) seen: [Seen; 2],
    /// The node that was started in the middle of it, after so long.
    pub(super) came: Option<Duration>,
    pub(super) by_hand: Option<Knocked>,
}

impl Outcome {
    /// Who is of the robot is there; the one that is started in the middle of it comes once, and goes once.
    fn members(&self, broken: &mut Vec<String>) {
        let once = u64::from(self.came.is_some());
        for ((seen, name), peer) in self.seen.iter().zip(["hip", "knee"]).zip([keys::KNEE, keys::HIP]) {
            let allowed = |node: u8, of_peer| match node {
                node if node == peer.host => of_peer,
                node if node == ANKLE.host => once,
                _ => 0,
            };
            for (node, count) in seen.lost.iter().filter(|(node, count)| **count > allowed(**node, 0)) {
                broken.push(format!("{name} has lost the node of host {node} {count} times"));
            }
            for (node, count) in seen.found.iter().filter(|(node, count)| **count > allowed(**node, 1)) {
                broken.push(format!("{name} has found the node of host {node} {count} times"));
            }
        }
    }

    /// Nobody speaks for others, and who speaks for himself is heard.
    fn messages(&self, own: u8, said: &mut Vec<String>, broken: &mut Vec<String>) {
        for (seen, name) in self.seen.iter().zip(["hip", "knee"]) {
            let forged: u64 =
                seen.sent.iter().filter(|(node, _)| **node != own).map(|(_, count)| count).sum();
            if forged > 0 {
                broken.push(format!("{name} took {forged} messages in the name of others"));
            }
        }
        let (sent, [_, knee]) = (self.happened.own_sent, &self.seen);
        let taken = knee.sent.get(&own).copied().unwrap_or_default();
        if taken > 0 {
            said.push(format!("{taken} taken in the sender's own name"));
        }
        // All but a tenth: what is under way when the link ends is nobody's promise.
        if sent > 0 && (taken > sent || taken < sent - sent / 10) {
            broken.push(format!("{taken} messages were taken in the sender's own name, of {sent}"));
        }
    }

    /// Answers go on meanwhile, and afterwards.
    fn service(&self, broken: &mut Vec<String>) {
        let Self { before, during, .. } = self;
        if before.count == 0 || during.failed > 0 {
            broken.push(format!("{} questions without an answer, {} before", during.failed, before.count));
        }
        if during.rate() < ANSWERED_MIN * before.rate() {
            let [before, during] = [before.rate(), during.rate()];
            broken.push(format!("{during:.1} answers in a second, and {before:.1} before"));
        }
        if !self.answers_again {
            broken.push("a question that was asked afterwards has no answer".to_owned());
        }
    }

    /// The attack reached the node: it counted what it refused.
    fn refusals(&self, said: &mut Vec<String>, broken: &mut Vec<String>) {
        let counted = |cause: &str| self.refused.get(cause).copied().unwrap_or_default();
        let some = self.refused.iter().filter(|(_, count)| **count > 0);
        let words: Vec<_> = some.map(|(cause, count)| format!("'{cause}' {count}")).collect();
        if !words.is_empty() {
            said.push(format!("knee counted {}", words.join(", ")));
        }
        for (cause, least) in &self.happened.refused {
            if counted(cause) < *least {
                broken.push(format!("knee counted {} refusals for '{cause}', of {least}", counted(cause)));
            }
        }
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
            writeln!(
                f,
                "    answers in a second: {:.0} before, {:.0} during it, the longest after {} ms",
                row.before.rate(),
                row.during.rate(),
                row.during.max.as_millis()
            )?;
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
