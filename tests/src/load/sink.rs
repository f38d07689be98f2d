//! Takes what is sent, and knows what is missing, double or out of order.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use sinew::{Outcome, prelude::*};

use super::{Account, pacer::Sent};
use crate::{
    puppet::{Job, Order},
    until,
};

/// The numbers of one class from one node.
#[derive(Debug, Default)]
struct Track {
    /// One bit each, from number 0.
    seen: Vec<u64>,
    unique: u64,
    last: u64,
    duplicated: u64,
    reordered: u64,
}

impl Track {
    fn note(&mut self, number: u64) {
        let (word, bit) = (usize::try_from(number / 64).expect("memory ends before"), number % 64);
        if self.seen.len() <= word {
            self.seen.resize(word + 1, 0);
        }
        if self.seen[word] & (1 << bit) != 0 {
            self.duplicated += 1;
            return;
        }
        self.seen[word] |= 1 << bit;
        self.unique += 1;
        if number < self.last {
            self.reordered += 1;
        }
        self.last = self.last.max(number);
    }

    fn has(&self, number: u64) -> bool {
        let word = usize::try_from(number / 64).ok().and_then(|word| self.seen.get(word));
        word.is_some_and(|word| word & (1 << (number % 64)) != 0)
    }
}

/// What has come, by node and class: Bulk, Control.
#[derive(Clone, Debug, Default)]
pub(super) struct Tracks(Arc<Mutex<BTreeMap<NodeAddress, [Track; 2]>>>);

impl Tracks {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<NodeAddress, [Track; 2]>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn last(&self, from: NodeAddress) -> [u64; 2] {
        self.lock().get(&from).map_or([0, 0], |tracks| [tracks[0].last, tracks[1].last])
    }

    /// Waits until messages of both classes have come from both nodes.
    pub(super) fn wait_for_traffic(&self, here: NodeAddress, there: NodeAddress) {
        for node in [here, there] {
            self.wait_for_next(node, [0, 0]);
        }
    }

    /// Waits until both classes are past these numbers.
    pub(super) fn wait_for_next(&self, from: NodeAddress, upto: [u64; 2]) {
        until(&format!("messages from {from} flow"), || {
            let last = self.last(from);
            (last[0] > upto[0] && last[1] > upto[1]).then_some(())
        });
    }

    /// Waits until the last ones have come, which nothing was done to.
    pub(super) fn wait_for_the_last(&self, from: NodeAddress, upto: [u64; 2]) {
        until(&format!("the last messages from {from}, {upto:?}"), || {
            (self.last(from) == upto).then_some(())
        });
    }

    /// What has not come, by class and number.
    pub(super) fn missing(&self, from: NodeAddress, upto: [u64; 2]) -> Vec<(usize, u64)> {
        let tracks = self.lock();
        let Some(tracks) = tracks.get(&from) else { return Vec::new() };
        let of_class =
            |class: usize| (1..=upto[class]).filter(move |n| !tracks[class].has(*n)).map(move |n| (class, n));
        of_class(0).chain(of_class(1)).collect()
    }

    pub(super) fn account(&self, from: NodeAddress, sent: &Sent) -> Account {
        let lost = self.missing(from, sent.upto).len() as u64;
        let tracks = self.lock();
        let tracks = &tracks[&from];
        let mut account = Account {
            sent: sent.upto.iter().sum(),
            handled: tracks.iter().map(|track| track.unique).sum(),
            lost,
            duplicated: tracks.iter().map(|track| track.duplicated).sum(),
            reordered: tracks.iter().map(|track| track.reordered).sum(),
            confirmed: sent.outcomes.len() as u64,
            again: sent.again,
            ..Account::default()
        };
        for (number, outcome) in &sent.outcomes {
            match (outcome, tracks[1].has(*number)) {
                (Outcome::Delivered, true) => account.delivered += 1,
                (Outcome::Unknown, true) => account.unknown_handled += 1,
                (Outcome::Unknown, false) => account.unknown_lost += 1,
                // Said to be delivered and never seen, or ended as nothing here may end.
                (Outcome::Delivered, false)
                | (Outcome::Rejected(_) | Outcome::Expired | Outcome::Failed | Outcome::PeerLost, _) => {
                    account.wrong += 1;
                }
            }
        }
        account
    }
}

/// The application that takes the messages.
pub(super) struct Sink(Tracks);

impl Sink {
    pub(super) const fn new(tracks: Tracks) -> Self {
        Self(tracks)
    }

    fn note(&self, from: NodeAddress, class: usize, number: u64) {
        self.0.lock().entry(from).or_default()[class].note(number);
    }
}

impl Actor for Sink {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Job>> for Sink {
    type Result = ();

    fn handle(&mut self, job: Delivery<Job>, _: &mut Self::Context) {
        self.note(job.source.node, 0, job.number);
    }
}

impl Handler<Delivery<Order>> for Sink {
    type Result = ();

    fn handle(&mut self, order: Delivery<Order>, _: &mut Self::Context) {
        self.note(order.source.node, 1, order.number);
    }
}
