//! The threads that actors live on, by name.

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
    Burials, Place, Reason,
    own_system::{OwnSystem, settle_in},
    panics::is_the_runtimes,
    place::Owner,
    system,
    tenant::{Fate, Tenant, WeakTenant},
    vitals::Neighbours,
    watchdog::{Reprieve, Watchdog},
};
use crate::{post::lock, time::Time};

/// One thread of a node, from its making to its end.
#[derive(Debug)]
pub(super) struct Seat {
    place: Place,
    /// The kernel's number of the thread, while it lives.
    tid: AtomicI32,
    /// What a thread's priority is set by. Held by whoever sets it, so that the thread does not end meanwhile.
    native: Mutex<Option<ThreadId>>,
    given_up: AtomicBool,
    /// Who lives on it.
    tenants: Mutex<Vec<WeakTenant>>,
    /// Threads of the node that were given up and have not ended.
    abandoned: Arc<AtomicUsize>,
}

impl Seat {
    fn new(place: &Place, abandoned: Arc<AtomicUsize>) -> Arc<Self> {
        Arc::new(Self {
            place: place.clone(),
            tid: AtomicI32::new(0),
            native: Mutex::new(None),
            given_up: AtomicBool::new(false),
            tenants: Mutex::default(),
            abandoned,
        })
    }

    /// The seat of the calling thread, which is no node's: nobody gives it up.
    pub(super) fn of_this_thread(place: &Place) -> Arc<Self> {
        let seat = Self::new(place, Arc::default());
        seat.clone().occupy();
        seat
    }

    /// The kernel's number of the thread; `None` before its first and after its last breath.
    pub(super) fn tid(&self) -> Option<i32> {
        Some(self.tid.load(Ordering::Relaxed)).filter(|tid| *tid > 0)
    }

    /// Counts the thread among those that were given up, once. `None` if it was before, or has ended.
    fn set_given_up(&self) -> Option<usize> {
        // Under this lock, which the thread takes when it ends: it is counted down as often as up.
        let native = lock(&self.native);
        if native.is_none() || self.given_up.swap(true, Ordering::AcqRel) {
            return None;
        }
        Some(self.abandoned.fetch_add(1, Ordering::AcqRel) + 1)
    }

    /// Lets the thread run only when the CPU has nothing else to do, whatever priority it had.
    pub(super) fn demote(&self) {
        let native = lock(&self.native);
        if let Some(native) = *native {
            // A system that refuses this has the thread go on as before: nothing here depends on it.
            let _ = set_thread_priority_and_policy(native, ThreadPriority::Min, system::IDLE);
        }
    }

    /// What its tenants but this one do.
    pub(super) fn others_than(&self, tenant: &Tenant) -> Neighbours {
        let mut neighbours = Neighbours::default();
        for other in lock(&self.tenants).iter().filter_map(WeakTenant::living) {
            if !Arc::ptr_eq(other.vitals(), tenant.vitals()) {
                let sight = other.vitals().sight();
                neighbours.are_busy |= sight.is_busy();
                neighbours.turns = neighbours.turns.wrapping_add(sight.turn);
            }
        }
        neighbours
    }

    fn add(&self, tenant: &Tenant) {
        let mut tenants = lock(&self.tenants);
        tenants.retain(|tenant| tenant.living().is_some());
        tenants.push(tenant.downgrade());
    }

    /// Sits down on the calling thread.
    fn occupy(self: Arc<Self>) {
        self.tid.store(system::thread_id(), Ordering::Relaxed);
        *lock(&self.native) = Some(thread_native_id());
        is_the_runtimes();
        OCCUPIED.set(Some(Occupied(self)));
    }
}

thread_local! {
    /// The seat of this thread, which is told when the thread ends.
    static OCCUPIED: RefCell<Option<Occupied>> = const { RefCell::new(None) };
}

struct Occupied(Arc<Seat>);

impl Drop for Occupied {
    fn drop(&mut self) {
        self.0.tid.store(0, Ordering::Relaxed);
        let mut native = lock(&self.0.native);
        *native = None;
        if self.0.given_up.load(Ordering::Acquire) {
            self.0.abandoned.fetch_sub(1, Ordering::AcqRel);
        }
    }
}

/// What an actor did when somebody looked.
#[derive(Clone, Debug)]
pub struct Turn {
    /// Its name.
    pub actor: String,
    /// Another number for each turn of one life.
    pub number: u64,
    /// Whether it is in the middle of that turn, or rests after it.
    pub is_on: bool,
    /// When the turn began, if the actor knew; else whoever looks twice knows since when it lasts at least.
    pub begun: Option<Time>,
}

impl Turn {
    /// What this one does now.
    pub(super) fn of(tenant: &Tenant) -> Self {
        let vitals = tenant.vitals();
        let sight = vitals.sight();
        Self {
            actor: vitals.name().to_owned(),
            number: sight.turn,
            is_on: sight.is_busy(),
            begun: sight.begun,
        }
    }
}

/// The threads of a node. Made when the first actor needs them; used on the node's root thread only.
#[derive(Debug, Default)]
pub struct Threads {
    arbiters: BTreeMap<(Owner, String), (Arbiter, Arc<Seat>)>,
    watchdog: Watchdog,
    abandoned: Arc<AtomicUsize>,
    burials: Burials,
}

impl Threads {
    /// Where to drop what is foreign.
    #[must_use]
    pub fn burials(&self) -> Burials {
        self.burials.clone()
    }

    /// The thread of `place`, a new one if it has none that lives.
    ///
    /// # Errors
    /// In words: the system gives no thread, or no descriptors for its reactor; or the thread has another real-time
    /// priority or CPU than `place` asks for.
    pub(super) fn get(&mut self, place: &Place) -> Result<(ArbiterHandle, Arc<Seat>), String> {
        self.arbiters.retain(|_, (arbiter, _)| arbiter.alive());
        if let Some((arbiter, seat)) = self.arbiters.get(&place.key()) {
            return match seat.place.clash(place) {
                None => Ok((arbiter.handle(), seat.clone())),
                Some(why) => Err(format!("{why}; give all who live there the same")),
            };
        }
        let made = self.make(place);
        made.map_err(|error| {
            let remedy = crate::remedy::remedy(crate::remedy::Wanted::Reactor, &error);
            format!("there is no thread for it: {error}; {remedy}")
        })
    }

    fn make(&mut self, place: &Place) -> std::io::Result<(ArbiterHandle, Arc<Seat>)> {
        let seat = Seat::new(place, self.abandoned.clone());
        let (prepared, occupied) = (place.clone(), seat.clone());
        let arbiter = Arbiter::try_with_tokio_rt(move || {
            prepared.prepare();
            occupied.occupy();
            tokio::runtime::Builder::new_current_thread().enable_all().build().map(OwnSystem)
        })?;
        arbiter.spawn_fn(settle_in);
        let handle = arbiter.handle();
        self.arbiters.insert(place.key(), (arbiter, seat.clone()));
        Ok((handle, seat))
    }

    /// Somebody who lived at `place` will never again: its thread ends, unless it has other tenants.
    pub(super) fn leave(&mut self, place: &Place) {
        let is_empty = |seat: &Seat| lock(&seat.tenants).iter().all(|tenant| tenant.living().is_none());
        if self.arbiters.get(&place.key()).is_some_and(|(_, seat)| is_empty(seat)) {
            self.end(&place.key());
        }
    }

    fn end(&mut self, key: &(Owner, String)) {
        if let Some((arbiter, _)) = self.arbiters.remove(key) {
            arbiter.stop();
        }
    }

    /// What every actor on these threads does. Reads what their threads write, and waits for none of them.
    #[must_use]
    pub fn turns(&self) -> Vec<Turn> {
        let seats = self.arbiters.values().map(|(_, seat)| seat);
        let tenants = seats
            .flat_map(|seat| lock(&seat.tenants).iter().filter_map(WeakTenant::living).collect::<Vec<_>>());
        tenants.map(|tenant| Turn::of(&tenant)).collect()
    }

    /// A life moves in: its thread knows it, and the watchdog watches it.
    pub(super) fn settle(&self, tenant: &Tenant) {
        if let Some(seat) = tenant.seat() {
            seat.add(tenant);
        }
        self.watchdog.watch(tenant);
    }

    /// A life has so much time for something, from now on.
    pub(super) fn reprieve(&self, tenant: &Tenant, within: Duration) -> Reprieve {
        self.watchdog.reprieve(tenant, within)
    }

    /// Gives up the thread that `hung` does not let go: it ends when it comes back; the next actor of this place gets a new
    /// one. Its other tenants are lost with it.
    pub(super) fn give_up(&mut self, hung: &Tenant) {
        let Some(seat) = hung.seat() else { return };
        let Some(abandoned) = seat.set_given_up() else { return };
        seat.demote();
        let neighbours: Vec<_> = lock(&seat.tenants)
            .iter()
            .filter_map(WeakTenant::living)
            .filter(|other| !Arc::ptr_eq(other.vitals(), hung.vitals()))
            .collect();
        let (thread, child) = (&seat.place.thread, hung.vitals().name());
        crate::log::error!(
            child,
            thread,
            abandoned,
            neighbours = neighbours.len(),
            "a thread hangs and is given up"
        );
        for neighbour in neighbours {
            neighbour.kill();
            neighbour.report(Fate::Ended(Reason::ThreadEnded));
        }
        let key = seat.place.key();
        if self.arbiters.get(&key).is_some_and(|(_, present)| Arc::ptr_eq(present, seat)) {
            self.end(&key);
        }
    }

    /// Threads that were given up and have not ended.
    #[must_use]
    pub fn abandoned(&self) -> usize {
        self.abandoned.load(Ordering::Acquire)
    }

    /// Ends all threads.
    pub fn stop(&mut self) {
        for (arbiter, _) in std::mem::take(&mut self.arbiters).into_values() {
            arbiter.stop();
        }
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        // Nobody is left who could end them, or would hear who hangs.
        self.stop();
    }
}
