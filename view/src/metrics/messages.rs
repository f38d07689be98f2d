//! The metrics of messages: the outcomes at each place of a node.

use sinew::{
    audit::{Account, Entry, NodeAudit, Place},
    message::Class,
};

use super::{
    apps::{AppNames, OTHER},
    samples::Samples,
    table::{APP_DIRECT, APP_MESSAGES, Metric, PEER_RECEIVED, PEER_SENT},
};
use crate::nodes::NodeLabels;

/// The label of counters without a class.
const ALL_CLASSES: &str = "all";

/// Adds the accounts of a node.
pub(super) fn add(
    samples: &mut Samples,
    audit: &NodeAudit,
    node: &str,
    (names, labels): (&mut AppNames, &NodeLabels),
) {
    for Entry { place, account } in &audit.entries {
        let mut add = |metric: &Metric, place: &str, class: &str| {
            for (outcome, count) in outcomes(account) {
                samples.count(metric, [node, place, class, outcome], count);
            }
        };
        match place {
            Place::Mailbox { name, class, .. } => add(&APP_MESSAGES, &names.label(name), word(*class)),
            Place::Client { name, .. } => add(&APP_MESSAGES, &names.label(name), ALL_CLASSES),
            Place::OtherMailboxes | Place::OtherClients => add(&APP_MESSAGES, OTHER, ALL_CLASSES),
            Place::ToNode { node, class } => {
                add(&PEER_SENT, &labels.get(*node), class.map_or(ALL_CLASSES, word));
            }
            Place::ToFormerNodes => add(&PEER_SENT, OTHER, ALL_CLASSES),
            Place::FromNode { node, class } => {
                add(&PEER_RECEIVED, &labels.get(*node), class.map_or(ALL_CLASSES, word));
            }
            Place::FromFormerNodes => add(&PEER_RECEIVED, OTHER, ALL_CLASSES),
            Place::DirectLink { to_name, .. } => {
                add_direct(samples, account, [node, &names.label(to_name)]);
            }
            Place::OtherDirectLinks => add_direct(samples, account, [node, OTHER]),
        }
    }
}

fn add_direct(samples: &mut Samples, account: &Account, [node, app]: [&str; 2]) {
    for (outcome, count) in outcomes(account) {
        samples.count(&APP_DIRECT, [node, app, outcome], count);
    }
}

const fn word(class: Class) -> &'static str {
    match class {
        Class::Control => "control",
        Class::Stream => "stream",
        Class::Bulk => "bulk",
    }
}

/// Returns the number of messages with each outcome. Those without one yet are in none.
const fn outcomes(account: &Account) -> [(&'static str, u64); 8] {
    [
        ("delivered", account.delivered),
        ("superseded", account.superseded),
        ("rejected", account.rejected),
        ("expired", account.expired),
        ("failed", account.failed),
        ("lost", account.lost),
        ("unknown", account.unknown),
        ("refused", account.refused),
    ]
}
