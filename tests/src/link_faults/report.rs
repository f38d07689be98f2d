//! What was seen of a link to which things happened, as a table and as JSON.

use std::{collections::BTreeMap, fmt, time::Duration};

use serde_json::{Value, json};
use sinew::Audit;

use super::{Plan, trouble::Trouble};
use crate::{history::Verdict, load::Times, proxy::Counts};

/// The longest time without a message, by what had happened.
#[derive(Clone, Debug, Default)]
pub(super) struct Gaps(BTreeMap<Trouble, Times>);

impl Gaps {
    pub(super) fn note(&mut self, trouble: Trouble, gap: Duration) {
        self.0.entry(trouble).or_default().note(gap);
    }
}

/// What was seen.
#[derive(Debug)]
pub struct Report {
    pub(super) plan: Plan,
    pub(super) seconds: f64,
    /// What became of the messages.
    pub verdict: Verdict,
    /// What the network did.
    pub network: Counts,
    pub(super) gaps: Gaps,
    /// What the nodes themselves say of all messages, at the end.
    pub audit: Audit,
}

impl Report {
    /// Nothing was lost in silence, double, out of order or told falsely; where no node was lost, everything arrived. And the nodes can
    /// explain every message.
    #[must_use]
    pub fn holds(&self) -> bool {
        if self.audit.missing() > 0 {
            return false;
        }
        if self.plan.troubles.iter().all(|trouble| trouble.is_short()) {
            self.verdict.is_perfect()
        } else {
            self.verdict.holds()
        }
    }

    /// One line for other programs.
    #[must_use]
    pub fn json(&self) -> Value {
        let gaps: BTreeMap<String, Value> =
            self.gaps.0.iter().map(|(trouble, gaps)| (trouble.to_string(), gaps.json())).collect();
        let Counts { made, cut, flips, lost, passed, .. } = self.network;
        json!({
            "bench": "link_faults", "holds": self.holds(), "seed": self.plan.seed, "faults": self.plan.faults,
            "rate": self.plan.rate, "back_rate": self.plan.back_rate, "filling": self.plan.filling,
            "unexplained": self.audit.missing(), "seconds": self.seconds, "messages": self.verdict.json(), "gaps": gaps,
            "network": {
                "connections": made, "cut": cut, "bits_flipped": flips, "datagrams_lost": lost,
                "bytes_there": passed[1], "bytes_back": passed[0],
            },
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { plan, seconds, verdict, network, gaps, audit } = self;
        let per_second = verdict.sent as f64 / seconds;
        writeln!(
            f,
            "seed {}: {} faults in {seconds:.1} s, {per_second:.0} messages a second; {} connections, {} cut, {} bits flipped",
            plan.seed, plan.faults, network.made, network.cut, network.flips
        )?;
        writeln!(f, "{verdict}")?;
        write!(f, "{:<16} {:>6} {:>9} {:>9} {:>9}", "longest gap", "faults", "p50 ms", "p99 ms", "max ms")?;
        gaps.0.iter().try_for_each(|(trouble, gaps)| write!(f, "\n{trouble:<16} {gaps}"))?;
        write!(f, "\n{audit}")
    }
}
