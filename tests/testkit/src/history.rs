//! Determines the fate of every message from the notes of senders and receivers. Pure: notes in, a verdict
//! out.
//!
//! | file | content |
//! | --- | --- |
//! | `note` | the notes of the parties, one line each |
//! | `numbers` | a set of numbers |
//! | `flow` | the messages of one source to one destination in one class |
//! | `verdict` | valid and invalid fates of all messages |

mod flow;
mod note;
mod numbers;
#[cfg(test)]
mod tests;
mod verdict;

use std::collections::BTreeMap;

use sinew::Class;

use self::{flow::Flow, verdict::Judge};
pub use self::{
    note::{Note, Party, Station},
    numbers::Numbers,
    verdict::{Fault, Verdict},
};

/// Source, destination and class of messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Path {
    from: Party,
    to: Station,
    class: Class,
}

/// All notes. The notes of one party are ordered; between parties there is no order.
#[derive(Debug, Default)]
pub struct History {
    flows: BTreeMap<Path, Flow>,
    /// The latest incarnation of a source from which a party has received a message.
    latest: BTreeMap<(Party, Station, Class), u32>,
    killed: Vec<Party>,
    judge: Judge,
}

impl History {
    /// Adds a note of this party.
    pub fn note(&mut self, party: Party, note: Note) {
        match note {
            Note::Sent { to, class, first, count, asked } => {
                let path = Path { from: party, to, class };
                let noted = self.flows.entry(path).or_default().sent(first, count, asked);
                self.judge.add(path, noted);
            }
            Note::Ended { to, class, number, outcome } => {
                let path = Path { from: party, to, class };
                let noted = self.flows.entry(path).or_default().ended(number, outcome);
                self.judge.add(path, noted);
            }
            Note::Got { from, class, first, count } => self.got(party, from, class, first..first + count),
            Note::Damaged { from, class, number } => {
                let path = Path { from, to: party.station, class };
                self.judge.add(path, Err((Fault::Damaged, number)));
            }
            Note::PeerLost { to, upto } => {
                for (class, upto) in [Class::Control, Class::Stream, Class::Bulk].into_iter().zip(upto) {
                    self.flows.entry(Path { from: party, to, class }).or_default().peer_lost(upto);
                }
                self.give_up(party, to);
            }
        }
    }

    /// Records that `party` was notified of the loss of the node of `lost`. This refers to the incarnation
    /// from which it received the last message.
    fn give_up(&mut self, party: Party, lost: Station) {
        let classes = [Class::Control, Class::Stream, Class::Bulk];
        let latest = |class| self.latest.get(&(party, lost, class)).copied();
        let Some(incarnation) = classes.into_iter().filter_map(latest).max() else { return };
        for class in classes {
            let path = Path { from: Party { station: lost, incarnation }, to: party.station, class };
            self.flows.entry(path).or_default().forgotten();
        }
    }

    fn got(&mut self, party: Party, from: Party, class: Class, numbers: std::ops::Range<u64>) {
        let path = Path { from, to: party.station, class };
        let latest = self.latest.entry((party, from.station, class)).or_default();
        if from.incarnation < *latest {
            self.judge.add(path, Err((Fault::Reordered, numbers.start)));
        }
        *latest = from.incarnation.max(*latest);
        let flow = self.flows.entry(path).or_default();
        for number in numbers {
            let noted = flow.got(party.incarnation, number);
            self.judge.add(path, noted);
        }
    }

    /// Records that the party's process was killed: its notes may be incomplete.
    pub fn killed(&mut self, party: Party) {
        self.killed.push(party);
    }

    /// The last number that the source has noted as sent.
    #[must_use]
    pub fn last_sent(&self, from: Party, to: Station, class: Class) -> u64 {
        self.flows.get(&Path { from, to, class }).map_or(0, |flow| flow.sent)
    }

    /// The last number received from the source.
    #[must_use]
    pub fn last_got(&self, from: Party, to: Station, class: Class) -> u64 {
        self.flows.get(&Path { from, to, class }).map_or(0, Flow::last_got)
    }

    /// The numbers of messages that the source has sent and the destination has not received.
    #[must_use]
    pub fn missing(&self, from: Party, to: Station, class: Class) -> Vec<u64> {
        let Some(flow) = self.flows.get(&Path { from, to, class }) else { return Vec::new() };
        (1..=flow.sent).filter(|number| !flow.has_come(*number)).collect()
    }

    /// The fates of all messages so far. No message may be in flight any more.
    #[must_use]
    pub fn verdict(&self) -> Verdict {
        let mut judge = self.judge.clone();
        for (path, flow) in &self.flows {
            let killed = self.killed.iter().filter(|killed| killed.station == path.to);
            let last_killed = killed.map(|killed| killed.incarnation).max().unwrap_or(0);
            judge.judge(*path, flow, self.killed.contains(&path.from), last_killed);
        }
        judge.into_verdict()
    }
}
