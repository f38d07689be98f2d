//! What was seen, as a table and as JSON.

use std::{fmt, time::Duration};

use serde_json::{Value, json};

use super::{
    ANSWERED_MIN, Attack, DIALS_OF_A_NEWCOMER, GROWTH_MAX, Happened, Knocked, LATE_AT_REST, SLOWER_MAX,
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
        outcome.dials(attack.inside, &mut said, &mut broken);
        let Outcome { before, during, growth, .. } = outcome;
        if growth > GROWTH_MAX {
            broken.push(format!("memory grew by {} MiB", growth >> 20));
        }
        let (name, tried, happened) = (attack.name, attack.tried, said.join("; "));
        Self { name, tried, happened, before, during, growth, broken }
    }

    /// How much longer 99 of 100 answers took, whatever they took before.
    #[must_use]
    pub fn ratio(&self) -> f64 {
        self.during.p99.as_secs_f64() / self.before.p99.as_secs_f64().max(f64::MIN_POSITIVE)
    }

    /// All that has to hold on every machine holds: nobody got in, nobody was lost, memory is bounded.
    #[must_use]
    pub const fn has_held(&self) -> bool {
        self.broken.is_empty()
    }

    /// The machine was at rest before it: else times say nothing.
    #[must_use]
    pub fn was_at_rest(&self) -> bool {
        self.before.missed() as f64 <= LATE_AT_REST * self.before.asked() as f64
    }

    /// Live traffic did not feel it, on a machine that would have shown it.
    #[must_use]
    pub fn is_unfelt(&self) -> bool {
        self.was_at_rest() && self.ratio() <= SLOWER_MAX
    }

    fn json(&self) -> Value {
        let window = |window: &Window| {
            let us = |time: Duration| time.as_micros() as u64;
            json!({
                "answers": window.count, "failed": window.failed, "late": window.late, "waiting": window.waiting,
                "answers_per_s": window.rate() as u64,
                "p50_us": us(window.p50), "p99_us": us(window.p99), "max_us": us(window.max),
            })
        };
        json!({
            "attack": self.name, "tried": self.tried, "happened": self.happened,
            "before": window(&self.before), "during": window(&self.during), "p99_ratio": self.ratio(),
            "growth_kib": self.growth >> 10, "held": self.has_held(), "at_rest": self.was_at_rest(), "unfelt": self.is_unfelt(), "broken": self.broken,
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
    /// Connections that both nodes have begun meanwhile.
    pub(super) dials: [u64; 2],
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

    /// Nobody has a node dial whom it would not: one that comes is dialled, and again as seldom as GNCL-8 says.
    fn dials(&self, inside: bool, said: &mut Vec<String>, broken: &mut Vec<String>) {
        let most =
            if self.came.is_some() { DIALS_OF_A_NEWCOMER + dials_again(self.during.lasted) } else { 0 };
        let hosts = if inside { 1 } else { 2 };
        for (dials, name) in self.dials.iter().zip(["hip", "knee"]).take(hosts) {
            said.push(format!("{name} dialled {dials} times"));
            if *dials > most {
                broken.push(format!(
                    "{name} dialled {dials} times, and {most} is the most that it had reason to"
                ));
            }
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

/// How often a node dials one again within this time: after 10 ms, then twice that, up to 1 s, each a fifth less by chance (GNCL-8, by default).
fn dials_again(within: Duration) -> u64 {
    let (mut wait, mut all, mut dials) = (Duration::from_millis(10), Duration::ZERO, 0);
    loop {
        all += wait.mul_f64(0.8);
        if all > within {
            return dials;
        }
        dials += 1;
        wait = (wait * 2).min(Duration::from_secs(1));
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:<20} {:>10} {:>10} {:>6} {:>10} {:>14} {:>10}  held",
            "attack", "p99 before", "during", "ratio", "longest", "missed", "grown"
        )?;
        for row in &self.rows {
            let Row { name, tried, happened, before, during, growth, broken } = row;
            let us = |time: Duration| format!("{} us", time.as_micros());
            let missed = format!("{} of {}", during.missed(), during.asked());
            let (longest, kib) = (format!("{} ms", during.max.as_millis()), growth >> 10);
            let held = match (row.has_held(), row.is_unfelt()) {
                (true, true) => "yes",
                (true, false) if !row.was_at_rest() => "yes, not at rest",
                (true, false) => "yes, and felt",
                (false, _) => "NO",
            };
            writeln!(
                f,
                "{name:<20} {:>10} {:>10} {:>6.2} {longest:>10} {missed:>14} {kib:>6} KiB  {held}",
                us(before.p99),
                us(during.p99),
                row.ratio()
            )?;
            let [was, is] = [before.rate(), during.rate()];
            writeln!(
                f,
                "    answers in a second: {was:.0} before, {is:.0} during it; before it the longest took {} ms, {} were missed",
                before.max.as_millis(),
                before.missed()
            )?;
            writeln!(f, "    tried: {tried}\n    happened: {happened}")?;
            broken.iter().try_for_each(|what| writeln!(f, "    BROKEN: {what}"))?;
        }
        write!(
            f,
            "A question is due each millisecond, and its answer timed from then on. Missed: asked late, or without an answer at the end.\n\
             limits: p99 {SLOWER_MAX} times that before, where at most {} % were missed then (at rest), memory {} MiB",
            LATE_AT_REST * 100.0,
            GROWTH_MAX >> 20
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_has_no_reason_to_dial_more_often_than_its_waits_let_it() {
        // 10, 20, 40 ... 640 ms are 1.27 s, and then one a second, all a fifth less.
        let [second, ten] = [1, 10].map(|seconds| dials_again(Duration::from_secs(seconds)));
        assert_eq!((dials_again(Duration::from_millis(7)), second, ten), (0, 6, 18));
    }
}
