//! Events about the end of a node, delivered to applications after the last message of that node.
//!
//! | location of its messages | how the order is kept |
//! | --- | --- |
//! | in flight, in sockets | its sessions are fenced before any application is notified |
//! | held by a thread, or in the queue of a full application | [`notify`] holds back the event for that application |
//! | in a mailbox, a client's queue, another process | the event states [its subject](About), and every queue respects that |
//!
//! After an orderly leave, the node's messages are received first: until its connections are drained, but for
//! no longer than [`LEAVE_MAX`].

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    sync::{Arc, Mutex},
    time::Duration,
};

use sinew_model::notifications::claim_notifications;
use sinew_runtime::{
    lock,
    mailbox::About,
    outcome::Rejection,
    tid::{AppAddress, NodeAddress},
    time::Time,
    wire::Message,
};
use tokio::sync::Notify;

use crate::State;

/// Time limit for the last messages of a node that sent GOODBYE: the node itself allows 3 s (GNCL-10).
pub(crate) const LEAVE_MAX: Duration = Duration::from_secs(5);
/// Maximum number of held events; the caller retries a further one.
const HELD_MAX: usize = 4_096;
/// Pause between two checks: messages end one after the other, and one check covers all that ended meanwhile.
const CHECK_PAUSE: Duration = Duration::from_millis(1);
/// Interval after which a check of held events is made without a notification.
pub(crate) const CHECK_PERIOD: Duration = Duration::from_secs(1);
/// The same without held events. A node at rest is not woken more often for that.
const IDLE_CHECK_PERIOD: Duration = LEAVE_MAX;

/// The held events, in order.
#[derive(Debug, Default)]
pub struct NodeDownEvents {
    held: Mutex<VecDeque<HeldEvent>>,
    /// Notified when an event is held.
    added: Notify,
}

#[derive(Debug)]
struct HeldEvent {
    event: Message,
    node: NodeAddress,
    since: Time,
}

impl HeldEvent {
    const fn key(&self) -> (AppAddress, NodeAddress) {
        (self.event.header.destination.app, self.node)
    }
}

/// Delivers an event about a node to an application of this node, at once or in its turn.
///
/// # Errors
/// The reason of the rejection. After `QueueFull` the caller keeps the event, and is notified of room;
/// exception: not if too many events are held.
pub(crate) fn notify(state: &State, about: About, mut event: Message) -> Result<(), Rejection> {
    about.write(&mut event.header);
    let held = HeldEvent { event, node: about.node(), since: Time::now() };
    let key = held.key();
    // Without a lock held: GNCL's locks are taken.
    let is_early = matches!(about, About::End(_)) && state.store.outstanding(key.1).contains(key.0);
    let mut all = lock(&state.node_down_events.held);
    if !is_early && all.iter().all(|other| other.key() != key) {
        drop(all);
        return state.ctx.offer_event(held.event);
    }
    if all.len() >= HELD_MAX {
        return Err(Rejection::QueueFull);
    }
    all.push_back(held);
    drop(all);
    state.store.fewer_outstanding.notify_one();
    state.node_down_events.added.notify_one();
    Ok(())
}

/// Delivers the held events, each in its turn. GNCL notifies when that may be, and the application's queue if that was
/// full. Once per [`CHECK_PERIOD`] a check of held events is made in any case, because another waiter may have consumed
/// GNCL's notification. Nobody else waits for the notification of the first held event.
///
/// A check costs a search among the applications with pending messages for each held event, and short locks
/// of the sessions of the nodes concerned. There is at most one check per millisecond.
pub(crate) async fn run_retries(state: Arc<State>) {
    let (fewer_outstanding, has_room) = (&state.store.fewer_outstanding, &state.ctx.room_notifier.ends);
    let added = &state.node_down_events.added;
    claim_notifications(fewer_outstanding);
    claim_notifications(has_room);
    claim_notifications(added);
    loop {
        let pause = deliver_due(&state, Time::now());
        tokio::select! {
            () = fewer_outstanding.notified() => {}
            () = has_room.notified() => {}
            () = added.notified() => {}
            () = tokio::time::sleep(pause.unwrap_or(IDLE_CHECK_PERIOD)) => {}
        }
        if pause.is_some() {
            tokio::time::sleep(CHECK_PAUSE).await;
        }
    }
}

/// Returns how long no check is needed without a notification; `None` if no event is held.
pub(crate) fn deliver_due(state: &State, now: Time) -> Option<Duration> {
    // Events that arrive meanwhile are delivered after these, because the check holds the lock.
    let mut all = lock(&state.node_down_events.held);
    let (mut outstanding, mut stay, mut pause) = (BTreeMap::new(), BTreeSet::new(), CHECK_PERIOD);
    for held in std::mem::take(&mut *all) {
        let key = held.key();
        let left = LEAVE_MAX.saturating_sub(now.since(held.since));
        // The first event of a node is the oldest.
        let outstanding = outstanding.entry(key.1).or_insert_with(|| {
            if left.is_zero() {
                state.store.fence_departed(key.1, now, LEAVE_MAX);
            } else {
                pause = pause.min(left);
            }
            state.store.outstanding(key.1)
        });
        if !stay.contains(&key) && !outstanding.contains(key.0) && is_done(state, &held.event) {
            continue;
        }
        stay.insert(key);
        all.push_back(held);
    }
    (!all.is_empty()).then_some(pause)
}

/// Returns whether the event need not be delivered again: any refusal except a full queue means that the
/// application has ended.
fn is_done(state: &State, event: &Message) -> bool {
    let copy = Message::new(event.header, event.payload.clone());
    state.ctx.offer_event(copy) != Err(Rejection::QueueFull)
}
