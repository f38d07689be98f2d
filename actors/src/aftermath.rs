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
    collections::{BTreeSet, VecDeque},
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
use tokio::sync::Notify;

use crate::stores::{Stores, lock};

/// Time that a node which said goodbye has for its last messages: it gives them 3 s itself (GNCL-10).
const LEAVE_MAX: Duration = Duration::from_secs(5);
/// Events that are kept back at most; one more is offered again by whoever tells it.
const WAITING_MAX: usize = 4_096;
/// How often it is looked whether the last message has come: at first, and of what has waited for longer than [`SOON`].
const LOOK: Duration = Duration::from_millis(1);
const LOOK_LATER: Duration = Duration::from_millis(10);
const SOON: Duration = Duration::from_millis(100);

/// Events that are kept back, in the order in which they were told.
#[derive(Debug, Default)]
pub(crate) struct Aftermath {
    waiting: Mutex<VecDeque<Waiting>>,
    news: Notify,
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
    let is_early = matches!(about, About::End(_)) && stores.gncl.owes(key.1, key.0);
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
    stores.aftermath.news.notify_one();
    Ok(())
}

/// Tells what is kept back, each when its turn has come.
pub(crate) async fn carry_on(stores: Arc<Stores>) {
    loop {
        let oldest = lock(&stores.aftermath.waiting).front().map(|waiting| waiting.since);
        match oldest {
            None => stores.aftermath.news.notified().await,
            Some(since) if Time::now().since(since) < SOON => tokio::time::sleep(LOOK).await,
            Some(_) => tokio::time::sleep(LOOK_LATER).await,
        }
        tell_whose_turn_has_come(&stores, Time::now());
    }
}

fn tell_whose_turn_has_come(stores: &Stores, now: Time) {
    // Whoever is told meanwhile comes behind these, for they are looked at under the lock.
    let mut all = lock(&stores.aftermath.waiting);
    let mut stay = BTreeSet::new();
    let waiting = std::mem::take(&mut *all);
    for waiting in waiting {
        let key = waiting.key();
        if now.since(waiting.since) >= LEAVE_MAX {
            stores.gncl.fence_who_left(key.1, now, LEAVE_MAX);
        }
        if stay.contains(&key) || stores.gncl.owes(key.1, key.0) || !is_taken(stores, &waiting.event) {
            stay.insert(key);
            all.push_back(waiting);
        }
    }
}

/// Whether it need not be told again: any other refusal says that the application is gone.
fn is_taken(stores: &Stores, event: &Message) -> bool {
    let copy = Message::new(event.header, event.payload.clone());
    stores.router.send(copy) != Err(Rejection::QueueFull)
}
