//! What applications are told of the end of a node: behind the last message of it.
//!
//! | where its messages may be | what sees to it |
//! | --- | --- |
//! | on the way, in sockets | its sessions are fenced before anybody is told |
//! | in the hand of a thread, or in a line for an application that is full | [`tell`] keeps back what is for that application |
//! | in a mailbox, a client's queue, another process | the event says [what it is about](About), and every queue heeds that |
//!
//! A node that leaves in order is heard to its end first: until its connections are through, and for [`LEAVE_MAX`] at most.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    sync::{Arc, Mutex},
    time::Duration,
};

use sinew_runtime::{
    mailbox::About,
    outcome::Rejection,
    tid::{AppAddress, NodeAddress},
    time::Time,
    wire::Message,
};

use crate::{
    stores::{Stores, lock},
    takeover::take_over,
};

/// Time that a node which said goodbye has for its last messages: it gives them 3 s itself (GNCL-10).
pub(crate) const LEAVE_MAX: Duration = Duration::from_secs(5);
/// Events that are kept back at most; one more is offered again by whoever tells it.
const WAITING_MAX: usize = 4_096;
/// So long it is not looked again: messages end one after the other, and a look is for all that ended meanwhile.
const REST: Duration = Duration::from_millis(1);
/// How often an event is offered again to an application that has no room for it.
const OFFER_PERIOD: Duration = Duration::from_millis(10);
/// After so long it is looked whatever is heard.
pub(crate) const LOOK_PERIOD: Duration = Duration::from_secs(1);

/// Events that are kept back, in the order in which they were told.
#[derive(Debug, Default)]
pub(crate) struct Aftermath {
    waiting: Mutex<VecDeque<Waiting>>,
}

#[derive(Debug)]
struct Waiting {
    event: Message,
    node: NodeAddress,
    since: Time,
}

impl Waiting {
    const fn key(&self) -> (AppAddress, NodeAddress) {
        (self.event.header.destination.app, self.node)
    }
}

/// Tells an application of this node an event about a node, at once or as soon as its turn has come.
///
/// # Errors
/// As [`Router::send`](sinew_runtime::router::Router::send); `QueueFull` also if too many are kept back.
pub(crate) fn tell(stores: &Stores, about: About, mut event: Message) -> Result<(), Rejection> {
    about.write(&mut event.header);
    let waiting = Waiting { event, node: about.node(), since: Time::now() };
    let key = waiting.key();
    // Without a lock in hand: GNCL's are asked.
    let is_early = matches!(about, About::End(_)) && stores.gncl.owed(key.1).has(key.0);
    let mut all = lock(&stores.aftermath.waiting);
    if !is_early && all.iter().all(|other| other.key() != key) {
        drop(all);
        return stores.router.send(waiting.event);
    }
    if all.len() >= WAITING_MAX {
        return Err(Rejection::QueueFull);
    }
    all.push_back(waiting);
    drop(all);
    stores.gncl.fewer_owed.notify_one();
    Ok(())
}

/// Tells what is kept back, each when its turn has come. GNCL says when that may be: while nothing ends, nothing is looked at but what is
/// offered to a full application. Once in [`LOOK_PERIOD`] it is looked also where nothing was kept back: what GNCL says may have been
/// heard by somebody else.
///
/// A look costs a search among those to whom something is owed for each event that is kept, and a moment of the locks of the sessions of
/// each node that these are about. There is one a millisecond at most.
pub(crate) async fn carry_on(stores: Arc<Stores>) {
    take_over(&stores.gncl.fewer_owed);
    loop {
        let news = stores.gncl.fewer_owed.notified();
        let pause = tell_whose_turn_has_come(&stores, Time::now());
        drop(tokio::time::timeout(pause.unwrap_or(LOOK_PERIOD), news).await);
        if pause.is_some() {
            tokio::time::sleep(REST).await;
        }
    }
}

/// Returns for how long it need not be looked again if nothing is heard; `None` if nothing is kept back.
pub(crate) fn tell_whose_turn_has_come(stores: &Stores, now: Time) -> Option<Duration> {
    // Whoever is told meanwhile comes behind these, for they are looked at under the lock.
    let mut all = lock(&stores.aftermath.waiting);
    let (mut owed, mut stay, mut pause) = (BTreeMap::new(), BTreeSet::new(), LOOK_PERIOD);
    for waiting in std::mem::take(&mut *all) {
        let key = waiting.key();
        let left = LEAVE_MAX.saturating_sub(now.since(waiting.since));
        // The first one of a node is the oldest.
        let owed = owed.entry(key.1).or_insert_with(|| {
            if left.is_zero() {
                stores.gncl.fence_who_left(key.1, now, LEAVE_MAX);
            } else {
                pause = pause.min(left);
            }
            stores.gncl.owed(key.1)
        });
        if !stay.contains(&key) && !owed.has(key.0) {
            if is_taken(stores, &waiting.event) {
                continue;
            }
            pause = pause.min(OFFER_PERIOD);
        }
        stay.insert(key);
        all.push_back(waiting);
    }
    (!all.is_empty()).then_some(pause)
}

/// Whether it need not be told again: any other refusal says that the application is gone.
fn is_taken(stores: &Stores, event: &Message) -> bool {
    let copy = Message::new(event.header, event.payload.clone());
    stores.router.send(copy) != Err(Rejection::QueueFull)
}
