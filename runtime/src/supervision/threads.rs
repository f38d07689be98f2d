//! The threads of actors, by name.

use std::{
    cell::RefCell,
    collections::BTreeMap,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicI32, AtomicUsize, Ordering},
    },
    time::Duration,
};

use actix_rt::{Arbiter, ArbiterHandle};
use thread_priority::{ThreadId, ThreadPriority, set_thread_priority_and_policy, thread_native_id};

use super::{
    DropQueue, Place, Reason,
    actor_handle::{ActorEvent, ActorHandle, WeakActorHandle},
    liveness::Neighbours,
    own_system::{OwnSystem, set_own_system},
    place::Owner,
    watchdog::{DeadlineExtension, Watchdog},
};
use crate::{
    lock,
    thread::{mark_runtime_thread, system},
    time::Time,
};

/// One thread of a node, from its creation to its end.
#[derive(Debug)]
pub(super) struct ThreadSlot {
    place: Place,
    /// The kernel's ID of the thread, while it exists.
    tid: AtomicI32,
    /// The handle for changes of its priority. Its lock keeps the thread from ending during a change.
    native: Mutex<Option<ThreadId>>,
    is_abandoned: AtomicBool,
    /// The incarnations that run on the thread.
    actors: Mutex<Vec<WeakActorHandle>>,
    /// Number of abandoned threads of the node that have not ended.
    abandoned: Arc<AtomicUsize>,
}

impl ThreadSlot {
    fn new(place: &Place, abandoned: Arc<AtomicUsize>) -> Arc<Self> {
        Arc::new(Self {
            place: place.clone(),
            tid: AtomicI32::new(0),
            native: Mutex::new(None),
            is_abandoned: AtomicBool::new(false),
            actors: Mutex::default(),
            abandoned,
        })
    }

    /// Creates the entry of the calling thread, which belongs to no node and is never abandoned.
    pub(super) fn of_this_thread(place: &Place) -> Arc<Self> {
        let slot = Self::new(place, Arc::default());
        slot.clone().register_thread();
        slot
    }

    /// Returns the kernel's ID of the thread; `None` before its start and after its end.
    pub(super) fn tid(&self) -> Option<i32> {
        Some(self.tid.load(Ordering::Relaxed)).filter(|tid| *tid > 0)
    }

    /// Marks the thread as abandoned, and returns the number of abandoned threads. Returns `None` if it was
    /// abandoned before, or has ended.
    fn mark_abandoned(&self) -> Option<usize> {
        // The thread takes this lock when it ends, so each increment has one decrement.
        let native = lock(&self.native);
        if native.is_none() || self.is_abandoned.swap(true, Ordering::AcqRel) {
            return None;
        }
        Some(self.abandoned.fetch_add(1, Ordering::AcqRel) + 1)
    }

    /// Lowers the thread to idle scheduling, from any priority.
    pub(super) fn demote(&self) {
        let native = lock(&self.native);
        if let Some(native) = *native {
            // If the system refuses, the thread continues as before; nothing here depends on it.
            let _ = set_thread_priority_and_policy(native, ThreadPriority::Min, system::IDLE);
        }
    }

    /// Returns the activity of the thread's actors except this one.
    pub(super) fn neighbours_of(&self, handle: &ActorHandle) -> Neighbours {
        let mut neighbours = Neighbours::default();
        for other in self.living() {
            if !Arc::ptr_eq(other.liveness(), handle.liveness()) {
                let snapshot = other.liveness().snapshot();
                neighbours.are_busy |= snapshot.is_busy();
                neighbours.turns = neighbours.turns.wrapping_add(snapshot.turn);
            }
        }
        neighbours
    }

    /// Returns the sum of the turn numbers of the thread's actors.
    pub(super) fn turn_sum(&self) -> u64 {
        let add = |sum: u64, handle: &ActorHandle| sum.wrapping_add(handle.liveness().snapshot().turn);
        self.living().iter().fold(0, add)
    }

    /// Returns the incarnations on the thread that have not ended.
    fn living(&self) -> Vec<ActorHandle> {
        // The result may become the last owner of an incarnation, so none is dropped under the lock.
        let mut handles: Vec<_> = lock(&self.actors).iter().filter_map(WeakActorHandle::upgrade).collect();
        handles.retain(|handle| !handle.has_ended());
        handles
    }

    pub(super) fn add(&self, handle: &ActorHandle) {
        let mut former = Vec::new();
        let mut actors = lock(&self.actors);
        actors.retain(|actor| {
            let actor = actor.upgrade();
            let is_living = actor.as_ref().is_some_and(|actor| !actor.has_ended());
            former.extend(actor);
            is_living
        });
        actors.push(handle.downgrade());
        // Those in `former` are dropped after the lock; see `living`.
        drop(actors);
    }

    /// Registers the calling thread in this entry.
    fn register_thread(self: Arc<Self>) {
        self.tid.store(system::thread_id(), Ordering::Relaxed);
        *lock(&self.native) = Some(thread_native_id());
        mark_runtime_thread();
        REGISTRATION.set(Some(Registration(self)));
    }
}

thread_local! {
    /// The entry of this thread, which is updated when the thread ends.
    static REGISTRATION: RefCell<Option<Registration>> = const { RefCell::new(None) };
}

struct Registration(Arc<ThreadSlot>);

impl Drop for Registration {
    fn drop(&mut self) {
        self.0.tid.store(0, Ordering::Relaxed);
        let mut native = lock(&self.0.native);
        *native = None;
        if self.0.is_abandoned.load(Ordering::Acquire) {
            self.0.abandoned.fetch_sub(1, Ordering::AcqRel);
        }
    }
}

/// The activity of an actor at one moment.
#[derive(Clone, Debug)]
pub struct Turn {
    /// The name of the actor.
    pub actor: String,
    /// The number of the turn, different for each turn of one incarnation.
    pub number: u64,
    /// Whether the turn is in progress; otherwise the actor is idle after it.
    pub is_on: bool,
    /// When the turn began, if the actor recorded it. Otherwise two observations give a lower bound of its duration.
    pub begun: Option<Time>,
}

impl Turn {
    /// Returns the current activity of an actor.
    pub(super) fn of(handle: &ActorHandle) -> Self {
        let liveness = handle.liveness();
        let snapshot = liveness.snapshot();
        Self {
            actor: liveness.name().to_owned(),
            number: snapshot.turn,
            is_on: snapshot.is_busy(),
            begun: snapshot.begun,
        }
    }
}

/// The threads of a node. Each is created for its first actor; used on the node's root thread only.
#[derive(Debug, Default)]
pub struct Threads {
    arbiters: BTreeMap<(Owner, String), (Arbiter, Arc<ThreadSlot>)>,
    watchdog: Watchdog,
    abandoned: Arc<AtomicUsize>,
    drop_queue: DropQueue,
}

impl Threads {
    /// Returns the queue for drops of user values.
    #[must_use]
    pub fn drop_queue(&self) -> DropQueue {
        self.drop_queue.clone()
    }

    /// Returns the thread of `place`, and creates it if none exists.
    ///
    /// # Errors
    /// A text: the system gives no thread, or no descriptors for its reactor; or the thread has another
    /// real-time priority or CPU than `place` requests.
    pub(super) fn get(&mut self, place: &Place) -> Result<(ArbiterHandle, Arc<ThreadSlot>), String> {
        self.arbiters.retain(|_, (arbiter, _)| arbiter.alive());
        if let Some((arbiter, slot)) = self.arbiters.get(&place.key()) {
            return match slot.place.clash(place) {
                None => Ok((arbiter.handle(), slot.clone())),
                Some(why) => Err(format!("{why}; give all actors of this thread the same")),
            };
        }
        let made = self.make(place);
        made.map_err(|error| {
            let remedy = crate::remedy::remedy(crate::remedy::Wanted::Reactor, &error);
            format!("there is no thread for it: {error}; {remedy}")
        })
    }

    fn make(&mut self, place: &Place) -> std::io::Result<(ArbiterHandle, Arc<ThreadSlot>)> {
        let slot = ThreadSlot::new(place, self.abandoned.clone());
        let (prepared, new_slot) = (place.clone(), slot.clone());
        let arbiter = Arbiter::try_with_tokio_rt(move || {
            prepared.prepare();
            new_slot.register_thread();
            tokio::runtime::Builder::new_current_thread().enable_all().build().map(OwnSystem)
        })?;
        arbiter.spawn_fn(set_own_system);
        let handle = arbiter.handle();
        self.arbiters.insert(place.key(), (arbiter, slot.clone()));
        Ok((handle, slot))
    }

    /// Removes an actor of `place`: its thread ends, unless it has other actors.
    pub(super) fn leave(&mut self, place: &Place) {
        if self.arbiters.get(&place.key()).is_some_and(|(_, slot)| slot.living().is_empty()) {
            self.end(&place.key());
        }
    }

    fn end(&mut self, key: &(Owner, String)) {
        if let Some((arbiter, _)) = self.arbiters.remove(key) {
            arbiter.stop();
        }
    }

    /// Returns the activity of every actor on these threads. Reads the state that their threads write,
    /// without waiting for them.
    #[must_use]
    pub fn turns(&self) -> Vec<Turn> {
        let slots = self.arbiters.values().map(|(_, slot)| slot);
        let actors = slots.flat_map(|slot| slot.living());
        actors.map(|handle| Turn::of(&handle)).collect()
    }

    /// Registers an incarnation with its thread and the watchdog.
    pub(super) fn register(&self, handle: &ActorHandle) {
        if let Some(slot) = handle.slot() {
            slot.add(handle);
        }
        self.watchdog.watch(handle);
    }

    /// Starts a deadline of an incarnation that can be extended.
    pub(super) fn deadline_extension(&self, handle: &ActorHandle, within: Duration) -> DeadlineExtension {
        self.watchdog.deadline_extension(handle, within)
    }

    /// Abandons the thread that `hung` blocks: it ends when the actor returns, and the next actor of this
    /// place gets a new one. Its other actors are lost with it.
    pub(super) fn abandon(&mut self, hung: &ActorHandle) {
        let Some(slot) = hung.slot() else { return };
        let Some(abandoned) = slot.mark_abandoned() else { return };
        slot.demote();
        let mut neighbours = slot.living();
        neighbours.retain(|other| !Arc::ptr_eq(other.liveness(), hung.liveness()));
        let (thread, child) = (&slot.place.thread, hung.liveness().name());
        crate::log::error!(
            child,
            thread,
            abandoned,
            neighbours = neighbours.len(),
            "a thread hangs and is given up"
        );
        for neighbour in neighbours {
            neighbour.kill();
            neighbour.report(ActorEvent::Ended(Reason::ThreadEnded));
        }
        let key = slot.place.key();
        if self.arbiters.get(&key).is_some_and(|(_, present)| Arc::ptr_eq(present, slot)) {
            self.end(&key);
        }
    }

    /// Returns the number of abandoned threads that have not ended.
    #[must_use]
    pub fn abandoned(&self) -> usize {
        self.abandoned.load(Ordering::Acquire)
    }

    /// Stops all threads.
    pub fn stop(&mut self) {
        for (arbiter, _) in std::mem::take(&mut self.arbiters).into_values() {
            arbiter.stop();
        }
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        // No owner is left that could stop them or receive a report of a hang.
        self.stop();
    }
}
