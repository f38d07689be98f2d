//! Results as a table and as JSON.

use std::{collections::BTreeMap, fmt, time::Duration};

use serde_json::{Value, json};

use super::{
    ANSWERED_AT_REST, ANSWERED_MIN, Attack, DIALS_OF_A_NEWCOMER, GROWTH_MAX, Happened, Knocked, LATE_AT_REST,
    SLOWER_MAX,
    keys::{self, ANKLE},
    robot::{NDL_PERIOD, Refused, Seen, Window},
    rounds::{Attacked, Rounds},
};

/// The results of all attacks.
#[derive(Debug)]
pub struct Report {
    /// One row per attack.
    pub rows: Vec<Row>,
    /// Measuring time of live traffic in each of its three states.
    pub timed: Duration,
    /// Number of rounds.
    pub rounds: u32,
}

/// The result of one attack.
#[derive(Debug)]
pub struct Row {
    /// Name of the attack.
    pub name: &'static str,
    /// Description of the attack.
    pub tried: &'static str,
    /// Description of the outcome.
    pub happened: String,
    /// Live traffic without an attack, with the decoy attacked, and with the node attacked.
    pub rounds: Rounds,
    /// Live traffic during the check for intrusions.
    pub lived: Window,
    /// Peak memory of the attacked node above its memory before, in bytes.
    pub growth: u64,
    /// Violations other than slow answers; empty if the node has held.
    pub broken: Vec<String>,
}

impl Row {
    pub(super) fn of(attack: &Attack, outcome: Outcome) -> Self {
        let mut summary = vec![outcome.happened.what.clone()];
        let Happened { broken, let_in, .. } = &outcome.happened;
        let mut broken = [&broken[..], let_in].concat();
        if let Some(came) = outcome.came {
            summary.push(format!("ankle talks after {} ms", came.as_millis()));
        }
        if let Some(Knocked { came_in, attempts, longest, never }) = &outcome.by_hand {
            summary.push(format!(
                "{came_in} honest peers came in by {attempts} attempts, the last of them after {} ms",
                longest.as_millis()
            ));
            broken.extend(never.iter().map(|why| format!("an honest peer never came in: {why}")));
        }
        outcome.members(&mut broken);
        outcome.messages(attack.own.host, &mut summary, &mut broken);
        outcome.service(&mut broken);
        outcome.refusals(&mut summary, &mut broken);
        outcome.dials(attack.inside, &mut summary, &mut broken);
        let Outcome { rounds, lived, growth, .. } = outcome;
        if growth > GROWTH_MAX {
            broken.push(format!("memory grew by {} MiB", growth >> 20));
        }
        let (name, tried, happened) = (attack.name, attack.tried, summary.join("; "));
        Self { name, tried, happened, rounds, lived, growth, broken }
    }

    /// Ratio of the 99th percentile with the node attacked to that without an attack.
    #[must_use]
    pub fn ratio(&self) -> f64 {
        ratio(&self.rounds.node.window, &self.rounds.before)
    }

    /// The same with the decoy attacked: this part is due to the machine.
    #[must_use]
    pub fn decoy_ratio(&self) -> Option<f64> {
        self.rounds.decoy.as_ref().map(|decoy| ratio(&decoy.window, &self.rounds.before))
    }

    /// Fraction of the slowdown at the 99th percentile that also occurs with the decoy attacked: 0 to 1.
    /// `None` if there is no decoy or no slowdown.
    #[must_use]
    pub fn decoy_share(&self) -> Option<f64> {
        let Rounds { before, decoy, node, .. } = &self.rounds;
        let longer = |attacked: &Attacked| attacked.window.p99.as_secs_f64() - before.p99.as_secs_f64();
        let (all, machine) = (longer(node), longer(decoy.as_ref()?));
        (all > 0.0).then(|| (machine / all).clamp(0.0, 1.0))
    }

    /// Returns whether the invariants that hold on every machine held: no intruder, no lost node, bounded
    /// memory.
    #[must_use]
    pub const fn has_held(&self) -> bool {
        self.broken.is_empty()
    }

    /// Returns whether the machine was idle without an attack; otherwise latencies are meaningless.
    #[must_use]
    pub fn was_at_rest(&self) -> bool {
        self.rounds.was_at_rest()
    }

    /// Returns whether the attacker was active in the rounds against each target; otherwise latencies are
    /// meaningless.
    #[must_use]
    pub fn was_timed(&self) -> bool {
        let Rounds { decoy, node, .. } = &self.rounds;
        node.is_attack() && decoy.as_ref().is_none_or(Attacked::is_attack)
    }

    /// Returns whether live traffic was not slowed down, on a machine that would have shown a slowdown.
    #[must_use]
    pub fn is_unfelt(&self) -> bool {
        self.was_at_rest() && self.was_timed() && self.ratio() <= SLOWER_MAX
    }

    /// The text of the verdict column.
    fn verdict(&self) -> String {
        match (self.has_held(), self.is_unfelt()) {
            (false, _) => "NO".to_owned(),
            (true, true) => "yes".to_owned(),
            (true, false) if !self.was_at_rest() => "yes, not at rest".to_owned(),
            (true, false) if !self.was_timed() => "yes, not timed".to_owned(),
            (true, false) => match self.decoy_share() {
                Some(share) => format!("yes, and felt: {:.0} % of it with the decoy, too", share * 100.0),
                None => "yes, and felt".to_owned(),
            },
        }
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
        let Rounds { before, decoy, node, .. } = &self.rounds;
        json!({
            "attack": self.name, "tried": self.tried, "happened": self.happened,
            "before": window(before), "decoy": decoy.as_ref().map(|decoy| window(&decoy.window)), "during": window(&node.window),
            "p99_ratio": self.ratio(), "p99_ratio_decoy": self.decoy_ratio(), "decoy_share": self.decoy_share(),
            "done_per_s": { "decoy": decoy.as_ref().map(Attacked::done_per_s), "node": node.done_per_s() },
            "whole": window(&self.lived),
            "growth_kib": self.growth >> 10, "held": self.has_held(), "at_rest": self.was_at_rest(), "timed": self.was_timed(), "unfelt": self.is_unfelt(), "broken": self.broken,
        })
    }
}

/// Observations of one attack.
pub(super) struct Outcome {
    /// Observed by the attacker.
    pub(super) happened: Happened,
    /// Observed by the requesting node, in the rounds and during the full attack.
    pub(super) rounds: Rounds,
    pub(super) lived: Window,
    /// Whether a request sent afterwards was answered.
    pub(super) answers_again: bool,
    /// Memory growth of the attacked node, in bytes.
    pub(super) growth: u64,
    /// Refusals by the attacked node meanwhile.
    pub(super) refused: Refused,
    /// Observed by both nodes.
    pub(super) seen: [Seen; 2],
    /// Time until the node started during the attack had joined.
    pub(super) came: Option<Duration>,
    pub(super) by_hand: Option<Knocked>,
    /// Connections that both nodes opened in the rounds and during the full attack, and the duration of both.
    pub(super) dials: [u64; 2],
    pub(super) dialled_for: Duration,
}

impl Outcome {
    /// Checks that the nodes of the robot stay members. The node started during the attack joins once and
    /// leaves once.
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

    /// Checks that no message with a forged source was accepted, and that messages with the sender's own name
    /// arrived.
    fn messages(&self, own: u8, summary: &mut Vec<String>, broken: &mut Vec<String>) {
        for (seen, name) in self.seen.iter().zip(["hip", "knee"]) {
            let forged: u64 =
                seen.sent.iter().filter(|(node, _)| **node != own).map(|(_, count)| count).sum();
            if forged > 0 {
                broken.push(format!("{name} took {forged} messages in the name of others"));
            }
        }
        let (Happened { own_sent: sent, own_perhaps: perhaps, .. }, [_, knee]) = (&self.happened, &self.seen);
        let taken = knee.sent.get(&own).copied().unwrap_or_default();
        if taken > 0 {
            summary.push(format!("{taken} taken in the sender's own name"));
        }
        // A tenth may be missing: messages in flight when the link ends have no guarantee.
        if sent + perhaps > 0 && (taken > sent + perhaps || taken < sent - sent / 10) {
            broken.push(format!("{taken} messages were taken in the sender's own name, of {sent}"));
        }
    }

    /// Checks that requests were answered during and after the attack.
    fn service(&self, broken: &mut Vec<String>) {
        let Self { rounds: Rounds { before, decoy, node, .. }, lived, .. } = self;
        let attacked = [Some(lived), Some(&node.window), decoy.as_ref().map(|decoy| &decoy.window)];
        let failed: u64 = attacked.into_iter().flatten().map(|window| window.failed).sum();
        if before.count == 0 || failed > 0 {
            broken.push(format!("{failed} questions without an answer, and {} answers before", before.count));
        }
        let least = if self.rounds.was_at_rest() { ANSWERED_AT_REST } else { ANSWERED_MIN };
        if lived.rate() < least * before.rate() {
            let [before, during] = [before.rate(), lived.rate()];
            broken.push(format!("{during:.1} answers in a second, and {before:.1} before"));
        }
        if !self.answers_again {
            broken.push("a question that was asked afterwards has no answer".to_owned());
        }
    }

    /// Checks that the attack does not make a node dial excessively. A newcomer is dialled, and redialled no
    /// more often than GNCL-8 allows. The host of a member that misses an answer (as under a flood that
    /// leaves it no CPU) is tried once per period (NDL-4.6).
    fn dials(&self, inside: bool, summary: &mut Vec<String>, broken: &mut Vec<String>) {
        let newcomers = u64::from(self.came.is_some());
        let of_newcomers = newcomers * (DIALS_OF_A_NEWCOMER + dials_again(self.lived.lasted));
        let most = of_newcomers + (1 + newcomers) * hosts_tried(self.dialled_for);
        let hosts = if inside { 1 } else { 2 };
        for (dials, name) in self.dials.iter().zip(["hip", "knee"]).take(hosts) {
            summary.push(format!("{name} dialled {dials} times"));
            if *dials > most {
                broken.push(format!(
                    "{name} dialled {dials} times, and {most} is the most that it had reason to"
                ));
            }
        }
    }

    /// Checks that the attack reached the node: it must have counted its refusals.
    fn refusals(&self, summary: &mut Vec<String>, broken: &mut Vec<String>) {
        let counted = |cause: &str| self.refused.get(cause).copied().unwrap_or_default();
        let some = self.refused.iter().filter(|(_, count)| **count > 0);
        let words: Vec<_> = some.map(|(cause, count)| format!("'{cause}' {count}")).collect();
        if !words.is_empty() {
            summary.push(format!("knee counted {}", words.join(", ")));
        }
        for (cause, least) in &self.happened.refused {
            if counted(cause) < *least {
                broken.push(format!("knee counted {} refusals for '{cause}', of {least}", counted(cause)));
            }
        }
    }
}

impl Report {
    /// Returns whether every attack was held off.
    #[must_use]
    pub fn has_held(&self) -> bool {
        self.rows.iter().all(Row::has_held)
    }

    /// Returns whether no attack slowed down live traffic.
    #[must_use]
    pub fn is_unfelt(&self) -> bool {
        self.rows.iter().all(Row::is_unfelt)
    }

    /// One JSON object per attack.
    #[must_use]
    pub fn json(&self) -> Value {
        self.rows.iter().map(Row::json).collect()
    }
}

/// Maximum number of redials within this time. The backoff is 10 ms, doubled up to 1 s, with up to a fifth of
/// random reduction (GNCL-8, defaults).
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

/// Maximum number of attempts to reach the host of one member within this time.
fn hosts_tried(within: Duration) -> u64 {
    within.as_nanos().div_ceil(NDL_PERIOD.as_nanos()) as u64
}

/// Ratio of the 99th percentiles.
fn ratio(attacked: &Window, before: &Window) -> f64 {
    attacked.p99.as_secs_f64() / before.p99.as_secs_f64().max(f64::MIN_POSITIVE)
}

fn us(time: Duration) -> String {
    format!("{} us", time.as_micros())
}

/// The rate of each action, as text.
fn words(done: &BTreeMap<&'static str, f64>) -> String {
    let words: Vec<_> = done.iter().map(|(what, rate)| format!("{rate:.0} {what}")).collect();
    words.join(", ")
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, tried, happened, rounds, lived, growth, broken } = self;
        let Rounds { before, decoy, node, .. } = rounds;
        let during = &node.window;
        let missed = format!("{} of {}", during.missed(), during.asked());
        let (longest, kib) = (format!("{} ms", during.max.as_millis()), growth >> 10);
        let with_decoy = decoy.as_ref().map_or_else(|| "-".to_owned(), |decoy| us(decoy.window.p99));
        let decoy_ratio = self.decoy_ratio().map_or_else(|| "-".to_owned(), |ratio| format!("{ratio:.2}"));
        writeln!(
            f,
            "{name:<20} {:>10} {with_decoy:>10} {:>10} {decoy_ratio:>6} {:>6.2} {longest:>9} {missed:>14} {kib:>6} KiB  {}",
            us(before.p99),
            us(during.p99),
            self.ratio(),
            self.verdict()
        )?;
        if let Some(decoy) = decoy {
            writeln!(f, "    in a second, to the decoy: {}", words(&decoy.done_per_s()))?;
        }
        writeln!(f, "    in a second, to the node: {}", words(&node.done_per_s()))?;
        let [was, is, then] = [before, during, lived].map(Window::rate);
        writeln!(
            f,
            "    answers in a second: {was:.0} before, {is:.0} during, {then:.0} while others came; before the longest took {} ms, {} were missed",
            before.max.as_millis(),
            before.missed()
        )?;
        writeln!(f, "    tried: {tried}\n    happened: {happened}")?;
        broken.iter().try_for_each(|what| writeln!(f, "    BROKEN: {what}"))
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:<20} {:>10} {:>10} {:>10} {:>6} {:>6} {:>9} {:>14} {:>10}  held",
            "attack", "p99 before", "decoy", "during", "decoy", "ratio", "longest", "missed", "grown"
        )?;
        self.rows.iter().try_for_each(|row| write!(f, "{row}"))?;
        let Self { timed, rounds, .. } = self;
        write!(
            f,
            "A question is due each millisecond, and its answer timed from then on. Missed: asked late, or without an answer at the end.\n\
             p99: of {timed:.1?} each in {rounds} rounds by turns, left alone (before), with the same attack on a decoy on the node's host, on the node (during).\n\
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
    fn allowed_redials_follow_the_backoff() {
        // 10, 20, 40 ... 640 ms sum up to 1.27 s, then one per second, all reduced by a fifth.
        let [second, ten] = [1, 10].map(|seconds| dials_again(Duration::from_secs(seconds)));
        assert_eq!((dials_again(Duration::from_millis(7)), second, ten), (0, 6, 18));
    }

    /// A row with these 99th percentiles, in microseconds.
    fn row(before: u64, decoy: Option<u64>, during: u64) -> Row {
        let window = |us| Window { count: 1_000, p99: Duration::from_micros(us), ..Window::default() };
        let attacked = |us| Attacked { window: window(us), done: BTreeMap::from([("connections", 1)]) };
        let rounds = Rounds {
            before: window(before),
            decoy: decoy.map(attacked),
            node: attacked(during),
            ..Rounds::default()
        };
        Row {
            name: "",
            tried: "",
            happened: String::new(),
            rounds,
            lived: Window::default(),
            growth: 0,
            broken: Vec::new(),
        }
    }

    #[test]
    fn slowdown_reports_the_share_of_the_decoy() {
        // Given: answers that took 500 us take 2000 us, and the decoy accounts for 900 us of this
        let felt = row(500, Some(1_400), 2_000);
        assert_eq!((felt.ratio(), felt.decoy_ratio()), (4.0, Some(2.8)));
        assert_eq!(felt.verdict(), "yes, and felt: 60 % of it with the decoy, too");
        // Then: it counts as a slowdown, however much of it is due to the machine
        let machine = row(500, Some(2_500), 2_000);
        assert!(!machine.is_unfelt());
        assert_eq!(machine.verdict(), "yes, and felt: 100 % of it with the decoy, too");
        assert_eq!(row(500, Some(400), 2_000).decoy_share(), Some(0.0));
        assert_eq!(row(500, None, 2_000).verdict(), "yes, and felt");
        assert_eq!(row(500, Some(2_000), 400).decoy_share(), None);
        assert_eq!(row(500, Some(400), 1_000).verdict(), "yes");
    }

    #[test]
    fn idle_attacker_makes_latencies_untimed() {
        let mut none = row(500, Some(500), 500);
        none.rounds.node.done.clear();
        assert!(!none.is_unfelt());
        assert_eq!(none.verdict(), "yes, not timed");
        let mut none = row(500, Some(500), 500);
        none.rounds.decoy =
            Some(Attacked { done: BTreeMap::from([("connections", 0)]), ..none.rounds.node.clone() });
        assert_eq!(none.verdict(), "yes, not timed");
    }
}
