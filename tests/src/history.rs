//! What became of every message, from what senders and receivers wrote down. Pure: notes in, a verdict out.
//!
//! | file | what it is |
//! | --- | --- |
//! | `note` | what parties write down, one line each |
//! | `flow` | the messages of one source to one destination in one class |
//! | `verdict` | what is right and what is wrong with all of them |

mod flow;
mod note;
#[cfg(test)]
mod tests;
mod verdict;

use std::collections::BTreeMap;

use sinew::Class;

use self::{flow::Flow, verdict::Judge};
pub use self::{
    note::{Note, Party, Station},
    verdict::{Fault, Verdict},
};

/// From whom, to whom, in which class.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Path {
    pub(crate) from: Party,
    pub(crate) to: Station,
    pub(crate) class: Class,
}

/// All that was written down. The notes of one party come in their order; between parties there is none.
#[derive(Debug, Default)]
pub struct History {
    flows: BTreeMap<Path, Flow>,
    /// The latest life of a source that a party has got something of.
    heard: BTreeMap<(Party, Station, Class), u32>,
    killed: Vec<Party>,
    judge: Judge,
}

impl History {
    /// Adds what `who` has written down.
    pub fn note(&mut self, who: Party, note: Note) {
        match note {
            Note::Sent { to, class, first, count, asked } => {
                let path = Path { from: who, to, class };
                let noted = self.flows.entry(path).or_default().sent(first, count, asked);
                self.judge.add(path, noted);
            }
            Note::Ended { to, class, number, outcome } => {
                let path = Path { from: who, to, class };
                let noted = self.flows.entry(path).or_default().ended(number, outcome);
                self.judge.add(path, noted);
            }
            Note::Got { from, class, first, count } => self.got(who, from, class, first..first + count),
            Note::Damaged { from, class, number } => {
                let path = Path { from, to: who.station, class };
                self.judge.add(path, Err((Fault::Damaged, number)));
            }
            Note::PeerLost { to, upto } => {
                for (class, upto) in [Class::Control, Class::Stream, Class::Bulk].into_iter().zip(upto) {
                    self.flows.entry(Path { from: who, to, class }).or_default().peer_lost(upto);
                }
                self.give_up(who, to);
            }
        }
    }

    /// `who` was told that the node of `lost` is lost: that is the life of which it has got something last.
    fn give_up(&mut self, who: Party, lost: Station) {
        let classes = [Class::Control, Class::Stream, Class::Bulk];
        let heard = |class| self.heard.get(&(who, lost, class)).copied();
        let Some(life) = classes.into_iter().filter_map(heard).max() else { return };
        for class in classes {
            let path = Path { from: Party { station: lost, life }, to: who.station, class };
            self.flows.entry(path).or_default().forgotten();
        }
    }

    fn got(&mut self, who: Party, from: Party, class: Class, numbers: std::ops::Range<u64>) {
        let path = Path { from, to: who.station, class };
        let heard = self.heard.entry((who, from.station, class)).or_default();
        if from.life < *heard {
            self.judge.add(path, Err((Fault::Reordered, numbers.start)));
        }
        *heard = from.life.max(*heard);
        let flow = self.flows.entry(path).or_default();
        for number in numbers {
            let noted = flow.got(who.life, number);
            self.judge.add(path, noted);
        }
    }

    /// The party's process was killed: what it has written down may be less than what it has done.
    pub fn killed(&mut self, who: Party) {
        self.killed.push(who);
    }

    /// The last number that a source has written down as sent so far.
    #[must_use]
    pub fn last_sent(&self, from: Party, to: Station, class: Class) -> u64 {
        self.flows.get(&Path { from, to, class }).map_or(0, |flow| flow.sent)
    }

    /// The last number that has come of a source so far.
    #[must_use]
    pub fn last_got(&self, from: Party, to: Station, class: Class) -> u64 {
        self.flows.get(&Path { from, to, class }).map_or(0, Flow::last_got)
    }

    /// What became of everything so far. Nothing is to be on its way any more.
    #[must_use]
    pub fn verdict(&self) -> Verdict {
        let mut judge = self.judge.clone();
        for (path, flow) in &self.flows {
            let killed = self.killed.iter().filter(|killed| killed.station == path.to);
            let last_killed = killed.map(|killed| killed.life).max().unwrap_or(0);
            judge.judge(*path, flow, self.killed.contains(&path.from), last_killed);
        }
        judge.into_verdict()
    }
}
