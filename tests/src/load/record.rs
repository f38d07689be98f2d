//! The histories of the messages of each node, and the application that receives the messages.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
};

use sinew::prelude::*;
use sinew_runtime::lock;
use sinew_testkit::{
    history::{History, Note, Party, Verdict},
    scripted::{Job, Order},
    until,
};

/// The sender of a node, and the receiver.
const SOURCE: Party = Party { station: 1, incarnation: 1 };
const SINK: Party = Party { station: 2, incarnation: 1 };

/// The classes that are sent.
pub(super) const CLASSES: [Class; 2] = [Class::Bulk, Class::Control];

/// A history for the messages of each node. Clones share them.
#[derive(Clone, Debug, Default)]
pub(super) struct Record(Arc<Mutex<BTreeMap<NodeAddress, History>>>);

impl Record {
    /// Notes messages that this node has sent to the sink, or their outcomes.
    pub(super) fn note(&self, from: NodeAddress, notes: impl IntoIterator<Item = Note>) {
        let mut record = lock(&self.0);
        let history = record.entry(from).or_default();
        notes.into_iter().for_each(|note| history.note(SOURCE, note));
    }

    pub(super) fn sent(class: Class, number: u64, asked: bool) -> Note {
        Note::Sent { to: SINK.station, class, first: number, count: 1, asked }
    }

    pub(super) fn ended(class: Class, number: u64, outcome: Outcome) -> Note {
        Note::Ended { to: SINK.station, class, number, outcome }
    }

    fn got(&self, from: NodeAddress, class: Class, number: u64) {
        let note = Note::Got { from: SOURCE, class, first: number, count: 1 };
        lock(&self.0).entry(from).or_default().note(SINK, note);
    }

    /// The last numbers that have arrived, of each class.
    fn last(&self, from: NodeAddress) -> [u64; 2] {
        let record = lock(&self.0);
        let last =
            |class| record.get(&from).map_or(0, |history| history.last_got(SOURCE, SINK.station, class));
        CLASSES.map(last)
    }

    /// Waits until both classes are past these numbers.
    pub(super) fn wait_for_next(&self, from: NodeAddress, upto: [u64; 2]) {
        until(&format!("messages from {from} flow"), || {
            let last = self.last(from);
            (last[0] > upto[0] && last[1] > upto[1]).then_some(())
        });
    }

    /// Waits until the last messages have arrived; no layer was killed after they were sent.
    pub(super) fn wait_for_the_last(&self, from: NodeAddress, upto: [u64; 2]) {
        until(&format!("the last messages from {from}, {upto:?}"), || {
            (self.last(from) == upto).then_some(())
        });
    }

    /// The missing messages of a node, by the index of their class.
    pub(super) fn missing(&self, from: NodeAddress) -> Vec<(usize, u64)> {
        let record = lock(&self.0);
        let Some(history) = record.get(&from) else { return Vec::new() };
        let of = |(index, class)| {
            let missing = history.missing(SOURCE, SINK.station, class);
            missing.into_iter().map(move |number| (index, number))
        };
        CLASSES.into_iter().enumerate().flat_map(of).collect()
    }

    /// The fates of the messages of a node.
    pub(super) fn verdict(&self, from: NodeAddress) -> Verdict {
        lock(&self.0).get(&from).map(History::verdict).unwrap_or_default()
    }
}

/// The application that receives the messages.
pub(super) struct Sink(pub(super) Record);

impl Actor for Sink {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Job>> for Sink {
    type Result = ();

    fn handle(&mut self, job: Delivery<Job>, _: &mut Self::Context) {
        self.0.got(job.source.node, Class::Bulk, job.number);
    }
}

impl Handler<Delivery<Order>> for Sink {
    type Result = ();

    fn handle(&mut self, order: Delivery<Order>, _: &mut Self::Context) {
        self.0.got(order.source.node, Class::Control, order.number);
    }
}
