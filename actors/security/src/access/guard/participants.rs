//! The participants of transactions of parameters. Their messages to each other need no rule: an operator has named
//! them to the application that receives them. Without this any application could fill the queue of any other one by
//! them.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    sync::Mutex,
    time::Duration,
};

use sinew_runtime::{
    lock,
    parameters::{DOUBT_WITHIN, LEAD_MAX, PARTICIPANTS_MAX, SetParameters, TransactionId},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Header, Message},
};

/// How long the participants may send: a transaction has ended then.
const LASTS: Duration = LEAD_MAX.saturating_add(DOUBT_WITHIN);
/// Maximum number of transactions for one application. It takes part in one at a time; others are refused by it, and
/// must not shorten the one in which it takes part. On overflow the oldest is forgotten.
const EACH_MAX: usize = 8;
/// Maximum number of applications with participants, as many as a node has addresses in use. Beyond it no further
/// application takes part until a transaction has ended.
const APPS_MAX: usize = 4_096;

/// The participants that operators have named to applications of this node.
#[derive(Debug, Default)]
pub(super) struct Participants(Mutex<BTreeMap<AppAddress, VecDeque<Named>>>);

/// The participants of one transaction.
#[derive(Debug)]
struct Named {
    id: TransactionId,
    tids: BTreeSet<u64>,
    until: Time,
}

impl Participants {
    /// Notes the participants that an operator names to one application, if the message begins a transaction.
    pub(super) fn note(&self, now: Time, set: &Message) {
        let app = set.header.destination.app;
        let Ok(SetParameters::Prepare(transaction)) = set.decode::<SetParameters>() else { return };
        if transaction.participants.len() > PARTICIPANTS_MAX {
            // The application refuses it.
            return;
        }
        let tids = transaction.participants.iter().map(|one| one.tid).collect();
        let mut apps = lock(&self.0);
        apps.retain(|_, named| named.back().is_some_and(|last| now <= last.until));
        if apps.len() >= APPS_MAX && !apps.contains_key(&app) {
            return;
        }
        let named = apps.entry(app).or_default();
        // A message is offered again after a full queue.
        named.retain(|one| one.id != transaction.id);
        if named.len() >= EACH_MAX {
            named.pop_front();
        }
        named.push_back(Named { id: transaction.id, tids, until: now + LASTS });
    }

    /// Returns whether the sender of this message is a participant that an operator has named to the application.
    pub(super) fn has(&self, now: Time, vote: &Header, app: AppAddress) -> bool {
        let source: Tid = vote.source;
        let apps = lock(&self.0);
        let mut named = apps.get(&app).into_iter().flatten();
        vote.destination.is_single() && named.any(|one| now <= one.until && one.tids.contains(&source.bits()))
    }
}
