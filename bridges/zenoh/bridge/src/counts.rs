//! Counters of passed and refused messages.

use std::{
    fmt,
    sync::atomic::{AtomicU64, Ordering},
};

/// A way in which a message passes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Passed {
    /// A put, as an unconfirmed message.
    PutIn,
    /// A put, as a protected command.
    ProtectedIn,
    /// A query, as a request.
    AskedIn,
    /// A query, as a confirmed message.
    ConfirmedIn,
    /// A message, as a put.
    PutOut,
    /// A request, as a query.
    AskedOut,
}

/// The cause for which a message does not pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Refusal {
    /// Its key names no destination of the project.
    ForeignKey,
    /// No rule has its destination and its type.
    NoRule,
    /// Its rule does not allow a put, a get or a delete.
    NotThisAct,
    /// A bridge has sent it: it would come round again.
    FromBridge,
    /// It is longer than the node accepts.
    TooLong,
    /// It has no timestamp, or an old one; or a protected command has waited too long.
    TooOld,
    /// Its payload is no payload of its type.
    Malformed,
    /// Its payload is the envelope of a protected command: a forged one.
    Envelope,
    /// Its type is protected, and its rule has no protected sender.
    Unprotected,
    /// A queue of the bridge is full.
    QueueFull,
    /// The node did not take it, or no application has the name.
    NotSent,
    /// Its receiver, or the access list of the receiver's node, has rejected it.
    Rejected,
    /// A message of Sinew for which there is no rule.
    NoRuleOut,
    /// A message of Sinew that cannot be written in the encoding of its rule.
    MalformedOut,
    /// A message of Sinew for which the queue to Zenoh had no room.
    QueueFullOut,
    /// A request of Sinew that no Zenoh program has answered in time, or that it has refused.
    NoReply,
}

impl Passed {
    /// All ways.
    pub const ALL: [Self; 6] =
        [Self::PutIn, Self::ProtectedIn, Self::AskedIn, Self::ConfirmedIn, Self::PutOut, Self::AskedOut];

    /// Returns its name in metrics.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::PutIn => "put_in",
            Self::ProtectedIn => "protected_in",
            Self::AskedIn => "asked_in",
            Self::ConfirmedIn => "confirmed_in",
            Self::PutOut => "put_out",
            Self::AskedOut => "asked_out",
        }
    }
}

impl Refusal {
    /// All causes.
    pub const ALL: [Self; 16] = [
        Self::ForeignKey,
        Self::NoRule,
        Self::NotThisAct,
        Self::FromBridge,
        Self::TooLong,
        Self::TooOld,
        Self::Malformed,
        Self::Envelope,
        Self::Unprotected,
        Self::QueueFull,
        Self::NotSent,
        Self::Rejected,
        Self::NoRuleOut,
        Self::MalformedOut,
        Self::QueueFullOut,
        Self::NoReply,
    ];

    /// Returns its name in metrics.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::ForeignKey => "foreign_key",
            Self::NoRule => "no_rule",
            Self::NotThisAct => "not_this_act",
            Self::FromBridge => "from_bridge",
            Self::TooLong => "too_long",
            Self::TooOld => "too_old",
            Self::Malformed => "malformed",
            Self::Envelope => "envelope",
            Self::Unprotected => "unprotected",
            Self::QueueFull => "queue_full",
            Self::NotSent => "not_sent",
            Self::Rejected => "rejected",
            Self::NoRuleOut => "no_rule_out",
            Self::MalformedOut => "malformed_out",
            Self::QueueFullOut => "queue_full_out",
            Self::NoReply => "no_reply",
        }
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::ForeignKey => "its key names no destination of the project; see `sinew-zenoh-bridge --help`",
            Self::NoRule => "no [[in]] of the file has its destination and its type; add one",
            Self::NotThisAct => "its rule does not allow this; set `put` or `get` of the [[in]]",
            Self::FromBridge => "a bridge has sent it, and a second one would send it round; let one bridge have this rule",
            Self::TooLong => "it is longer than the node accepts; raise `node.payload_max`, or send it in parts",
            Self::TooOld => {
                "it is too old, or has no timestamp; synchronize the clocks, and let the router add timestamps"
            }
            Self::Malformed => "it is no payload of its type; do both programs use the same type?",
            Self::Envelope => "it is the envelope of a protected command, which only its own sender makes",
            Self::Unprotected => "its type is protected; give the [[in]] a `protected` with the period of its sender",
            Self::QueueFull => "the bridge has no room; send more slowly, or raise `queue`",
            Self::NotSent => "the node did not take it; is its application there?",
            Self::Rejected => "its receiver, or the access list of the receiver's node, has rejected it",
            Self::NoRuleOut => "no [[out]] of the file has its destination and its type; add one",
            Self::MalformedOut => "it is no MessagePack; use `encoding = \"raw\"` for payloads that are bytes",
            Self::QueueFullOut => "the router takes messages more slowly than they come; raise `queue`, or send less",
            Self::NoReply => "no Zenoh program has answered; does one have a queryable for the key?",
        })
    }
}

/// The counters of a bridge. They never go back.
#[derive(Debug, Default)]
pub struct Counts {
    passed: [AtomicU64; Passed::ALL.len()],
    refused: [AtomicU64; Refusal::ALL.len()],
}

impl Counts {
    /// Counts messages that have passed.
    pub fn pass(&self, way: Passed) {
        self.passed[way as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// Counts messages that were refused. Returns how many were refused for this cause before.
    pub fn refuse(&self, why: Refusal, messages: u64) -> u64 {
        self.refused[why as usize].fetch_add(messages, Ordering::Relaxed)
    }

    /// Returns the number of messages that have passed in this way.
    #[must_use]
    pub fn passed(&self, way: Passed) -> u64 {
        self.passed[way as usize].load(Ordering::Relaxed)
    }

    /// Returns the number of messages that were refused for this cause.
    #[must_use]
    pub fn refused(&self, why: Refusal) -> u64 {
        self.refused[why as usize].load(Ordering::Relaxed)
    }
}

/// The text format of Prometheus.
impl fmt::Display for Counts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("# TYPE sinew_zenoh_bridge_passed_total counter\n")?;
        for way in Passed::ALL {
            writeln!(f, "sinew_zenoh_bridge_passed_total{{way=\"{}\"}} {}", way.word(), self.passed(way))?;
        }
        f.write_str("# TYPE sinew_zenoh_bridge_refused_total counter\n")?;
        for why in Refusal::ALL {
            writeln!(
                f,
                "sinew_zenoh_bridge_refused_total{{cause=\"{}\"}} {}",
                why.word(),
                self.refused(why)
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_cause_has_a_counter_and_a_remedy() {
        let counts = Counts::default();
        for (place, why) in Refusal::ALL.into_iter().enumerate() {
            assert_eq!(why as usize, place);
            assert_eq!(counts.refuse(why, 2), 0);
            assert!(why.to_string().contains([';', ',']), "{why}");
        }
        for (place, way) in Passed::ALL.into_iter().enumerate() {
            assert_eq!(way as usize, place);
            counts.pass(way);
        }
        let text = counts.to_string();
        assert!(text.contains("sinew_zenoh_bridge_refused_total{cause=\"no_rule\"} 2\n"), "{text}");
        assert_eq!(text.lines().count(), 2 + Passed::ALL.len() + Refusal::ALL.len());
    }
}
