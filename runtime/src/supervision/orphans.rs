//! The stop of the children of a failed supervisor: each is stopped, and abandoned after its deadline.
//!
//! No restart is decided any more. Each child has its declared time to stop; after that it is abandoned. The
//! supervisor's listener is notified of each end as usual.

use std::{
    cell::RefCell,
    collections::BTreeMap,
    panic::{AssertUnwindSafe, catch_unwind},
    rc::Rc,
    time::Duration,
};

use futures_util::{FutureExt, StreamExt};
use tokio::time::timeout;

use super::{
    Reason, SupervisorFact, Threads,
    actor_handle::ActorHandle,
    core::{ChildId, Input},
    panics::panic_message,
    watchdog::DeadlineExtension,
};
use crate::{event_queue::EventQueue, time::Time};

/// Time in which a thread that is not hung releases an abandoned child.
pub(super) const RELEASE_WITHIN: Duration = Duration::from_millis(200);

/// The receiver of facts about a supervisor's children.
pub(super) type Listener = Box<dyn FnMut(SupervisorFact)>;

/// The slot where a failed supervisor leaves its children for its overseer.
pub(super) type OrphanSlot = Rc<RefCell<Option<Orphans>>>;

/// A child without a reported end.
pub(super) struct Orphan {
    pub(super) handle: ActorHandle,
    pub(super) stop_within: Duration,
}

/// The remaining children of a supervisor. Dropping them fences all of them.
pub(super) struct Orphans {
    remaining: BTreeMap<ChildId, Remaining>,
    threads: Rc<RefCell<Threads>>,
    queue: EventQueue<Input>,
    listener: Listener,
}

/// One remaining child, and the deadline of its current step.
struct Remaining {
    handle: ActorHandle,
    phase: StopPhase,
    until: Time,
    extension: DeadlineExtension,
}

#[derive(Clone, Copy)]
enum StopPhase {
    /// The child was ordered to stop.
    Stop,
    /// The child is fenced and its end is reported; its thread must release it.
    Release,
}

impl Remaining {
    fn new(handle: ActorHandle, phase: StopPhase, within: Duration, threads: &Threads) -> Self {
        let extension = threads.deadline_extension(&handle, within);
        Self { handle, phase, until: Time::now() + within, extension }
    }

    /// Returns whether the deadline has passed, after an extension for CPU time that the child did not get.
    fn is_late(&mut self, now: Time) -> bool {
        if self.until > now {
            return false;
        }
        let is_ending = self.handle.liveness().is_ending();
        let later =
            if self.handle.has_ended() { None } else { self.extension.until(self.until, now, is_ending) };
        self.until = later.unwrap_or(self.until);
        later.is_none()
    }
}

impl Orphans {
    /// Takes over the children, and orders each to stop.
    pub(super) fn take_over(
        orphans: impl Iterator<Item = (ChildId, Orphan)>,
        threads: Rc<RefCell<Threads>>,
        queue: EventQueue<Input>,
        listener: Listener,
    ) -> Self {
        let stop = |(id, Orphan { handle, stop_within }): (ChildId, Orphan)| {
            handle.stop();
            (id, Remaining::new(handle, StopPhase::Stop, stop_within, &threads.borrow()))
        };
        let remaining = orphans.map(stop).collect();
        Self { remaining, threads, queue, listener }
    }

    /// Ends all children on the calling thread, without a caller that waits.
    pub(super) fn stop_detached(mut self) {
        let has_a_loop =
            actix_rt::Arbiter::try_current().is_some() && tokio::runtime::Handle::try_current().is_ok();
        if has_a_loop {
            actix_rt::spawn(async move {
                let why = Reason::GaveUp("its supervisor was dropped".to_owned());
                self.stop_all(&why).await;
                self.notify(SupervisorFact::Ended(why));
            });
        }
        // Without an event loop the thread is ending, and no wait is possible: the children are dropped here
        // without a grace period.
    }

    /// Waits until each child has ended or its deadline has passed, and notifies `listener` of each end. An
    /// orderly end is reported with the reason `why`: the failure of the supervisor.
    pub(super) async fn stop_all(&mut self, why: &Reason) {
        let mut events = self.queue.attach();
        while let Some(Some(event)) = events.next().now_or_never() {
            self.handle_event(event, why);
        }
        self.report_ended(why);
        while let Some(next) = self.remaining.values().map(|remaining| remaining.until).min() {
            match timeout(next.since(Time::now()), events.next()).await {
                Ok(Some(event)) => self.handle_event(event, why),
                // Another reader was attached, which never happens: the children are dropped without a grace period.
                Ok(None) => return,
                Err(_) => self.handle_deadlines(Time::now(), why),
            }
        }
    }

    fn handle_event(&mut self, event: Input, why: &Reason) {
        let (Input::Ended(id, _, reason) | Input::Hung(id, _, reason)) = event else { return };
        let Some(Remaining { handle, phase, .. }) = self.remaining.get(&id) else { return };
        match phase {
            // The event is late and belongs to a former incarnation: this one is not fenced yet.
            _ if !handle.liveness().is_fenced() => {}
            StopPhase::Stop => {
                let reason = if reason.is_failure() { reason } else { why.clone() };
                self.end_child(id, reason);
            }
            StopPhase::Release if handle.has_ended() => _ = self.remaining.remove(&id),
            StopPhase::Release => {}
        }
    }

    /// Reports the children that ended without a report.
    fn report_ended(&mut self, why: &Reason) {
        let ended = self.remaining.iter().filter(|(_, remaining)| remaining.handle.has_ended());
        for id in ended.map(|(id, _)| *id).collect::<Vec<_>>() {
            self.end_child(id, why.clone());
        }
    }

    fn handle_deadlines(&mut self, now: Time, why: &Reason) {
        let late = self
            .remaining
            .iter_mut()
            .filter_map(|(id, remaining)| remaining.is_late(now).then_some((*id, remaining.phase)));
        for (id, phase) in late.collect::<Vec<_>>() {
            match phase {
                StopPhase::Stop => {
                    let has_ended =
                        self.remaining.get(&id).is_some_and(|remaining| remaining.handle.has_ended());
                    self.end_child(id, if has_ended { why.clone() } else { Reason::Killed });
                }
                StopPhase::Release => {
                    if let Some(remaining) = self.remaining.remove(&id) {
                        self.abandon(&remaining.handle);
                    }
                }
            }
        }
    }

    /// Fences a child and reports its end. Its thread has a limited time to release it.
    fn end_child(&mut self, id: ChildId, reason: Reason) {
        let Some(Remaining { handle, .. }) = self.remaining.remove(&id) else { return };
        handle.kill();
        crate::log::warn!(child = handle.liveness().name(), %reason, "ended without its supervisor");
        self.notify(SupervisorFact::Gone(id, reason));
        if handle.blocked_since().is_some() {
            self.abandon(&handle);
        } else if !handle.has_ended() {
            let remaining =
                Remaining::new(handle, StopPhase::Release, RELEASE_WITHIN, &self.threads.borrow());
            self.remaining.insert(id, remaining);
        }
    }

    fn abandon(&self, handle: &ActorHandle) {
        if !handle.has_ended() {
            self.threads.borrow_mut().abandon(handle);
        }
    }

    /// The listener may be the cause of the supervisor's failure, so its panics are caught.
    fn notify(&mut self, fact: SupervisorFact) {
        if let Err(panic) = catch_unwind(AssertUnwindSafe(|| (self.listener)(fact))) {
            crate::log::error!(
                panic = panic_message(panic),
                "the listener of a supervisor panicked; it receives the remaining facts"
            );
        }
    }
}

impl Drop for Orphans {
    fn drop(&mut self) {
        for remaining in self.remaining.values() {
            // Has no effect on a child that has ended.
            remaining.handle.kill();
        }
    }
}
