//! The place of an actor: a named thread, or a process of its own.

use std::ffi::CString;

use thread_priority::{
    NormalThreadSchedulePolicy, RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id, thread_schedule_policy_param,
};

use crate::thread::{set_normal_schedule, system};

/// The place of an actor: a thread with a name. Actors that name the same thread share it, and must request
/// the same priority and CPU.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Hip;
/// struct Knee;
/// # impl Actor for Hip { type Context = AppContext<Self>; }
/// # impl Actor for Knee { type Context = AppContext<Self>; }
///
/// // Both controllers share one real-time thread: no wake between them.
/// let leg = || Place::thread("leg").realtime(60);
/// let hip = AppSpec::new("hip", || Hip).place(leg());
/// let knee = AppSpec::new("knee", || Knee).place(leg());
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// The name of the thread; the kernel shows its first 15 bytes.
    pub thread: String,
    /// The owner of the thread.
    pub owner: Owner,
    /// SCHED_FIFO priority, 1 to 99. An application's must be below [that of the thread which makes outputs
    /// safe](crate::protection::SAFE_OUTPUT_PRIORITY). If the system refuses it, the node logs that once and
    /// runs without it.
    pub realtime_priority: Option<u8>,
    /// A priority for the node's own thread, if the system grants one; a refusal is not logged.
    pub at_best: Option<u8>,
    /// The only CPU on which the thread may run.
    pub cpu: Option<usize>,
    /// Whether the thread is in a process of its own, a child of the node's process.
    pub own_process: bool,
}

/// The owner of a thread. Threads of the same name and of different owners are different threads, so that
/// equal names cannot share one by accident.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Owner {
    /// The node: for its layers; the thread that reads its sockets also runs applications that use [`Place::io`].
    Node,
    /// All actors that name it.
    Everybody,
    /// The application of the same name, and no other one.
    Application,
}

impl Place {
    const fn of(owner: Owner, thread: String) -> Self {
        Self { thread, owner, realtime_priority: None, at_best: None, cpu: None, own_process: false }
    }

    /// Returns the thread called `name`, with the ordinary schedule, shared by all actors that name it.
    /// Actors without a place share the thread `apps`.
    #[must_use]
    pub fn thread(name: impl Into<String>) -> Self {
        Self::of(Owner::Everybody, name.into())
    }

    /// Returns an unshared thread, named like its application: the declaration sets the name.
    #[must_use]
    pub const fn own_thread() -> Self {
        Self::of(Owner::Application, String::new())
    }

    /// Returns the place of the application called `name`.
    #[must_use]
    pub(crate) fn of_application(mut self, name: &str) -> Self {
        if self.owner == Owner::Application {
            name.clone_into(&mut self.thread);
        }
        self
    }

    /// Returns the thread that reads the node's sockets. The node sets its priority and its CPU.
    #[must_use]
    pub fn io() -> Self {
        Self::layer("io")
    }

    /// Returns a thread for layers of the node.
    #[must_use]
    pub fn layer(name: impl Into<String>) -> Self {
        Self::of(Owner::Node, name.into())
    }

    /// Returns a process of its own, a child of the node's process: its thread is named like the application.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Camera;
    /// # impl Actor for Camera { type Context = AppContext<Self>; }
    ///
    /// let camera = AppSpec::new("camera", || Camera).place(Place::process().on_cpu(1));
    /// ```
    #[must_use]
    pub const fn process() -> Self {
        let mut place = Self::own_thread();
        place.own_process = true;
        place
    }

    /// Sets SCHED_FIFO with this priority, 1 to 99. A node rejects an application with 90 or more, because
    /// the [thread that makes outputs safe](crate::protection::SAFE_OUTPUT_PRIORITY) must preempt the threads
    /// that it guards.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// let place = Place::own_thread().realtime(60);
    /// assert_eq!(place.realtime_priority, Some(60));
    /// ```
    #[must_use]
    pub const fn realtime(mut self, priority: u8) -> Self {
        self.realtime_priority = Some(priority);
        self
    }

    /// Sets SCHED_FIFO with this priority, 1 to 99, if the system allows it, and otherwise the ordinary schedule.
    #[must_use]
    pub const fn realtime_at_best(mut self, priority: u8) -> Self {
        self.at_best = Some(priority);
        self
    }

    /// Pins the thread to one CPU.
    #[must_use]
    pub const fn on_cpu(mut self, cpu: usize) -> Self {
        self.cpu = Some(cpu);
        self
    }

    /// Returns the key of the thread in its node.
    pub(super) fn key(&self) -> (Owner, String) {
        (self.owner, self.thread.clone())
    }

    /// Returns the conflict with `other`, if it names this thread and requests another priority or CPU. A
    /// text without a remedy.
    #[must_use]
    pub fn clash(&self, other: &Self) -> Option<String> {
        let is_same =
            (self.owner, &self.thread, self.own_process) == (other.owner, &other.thread, other.own_process);
        let wants_the_same = (self.realtime_priority, self.cpu) == (other.realtime_priority, other.cpu);
        // Each process has its own thread.
        if self.own_process || !is_same || wants_the_same {
            return None;
        }
        let (thread, has, asked) = (&self.thread, self.scheduling(), other.scheduling());
        Some(format!("the thread '{thread}' has {has}, and cannot have {asked} as well"))
    }

    fn scheduling(&self) -> String {
        let priority = match self.realtime_priority {
            Some(priority) => format!("real-time priority {priority}"),
            None => "no real-time priority".to_owned(),
        };
        match self.cpu {
            Some(cpu) => format!("{priority} on CPU {cpu}"),
            None => format!("{priority} on any CPU"),
        }
    }

    /// Configures the calling thread, which must be new, for this place.
    pub fn prepare(&self) {
        let name: Vec<u8> = self.thread.bytes().filter(|byte| *byte != 0).take(15).collect();
        if let Ok(name) = CString::new(name) {
            system::name_thread(&name);
        }
        if let Some(cpu) = self.cpu
            && let Err(error) = system::pin_to(cpu)
        {
            crate::log::warn!(thread = self.thread, cpu, %error, "the thread stays on any CPU; does this one exist?");
        }
        if let Some(priority) = self.at_best {
            let granted = set_realtime_priority(priority).is_ok();
            crate::log::debug!(
                thread = self.thread,
                priority,
                granted,
                "a real-time priority, if one is granted"
            );
        }
        if let Some(priority) = self.realtime_priority {
            self.make_realtime(priority);
        }
    }

    fn make_realtime(&self, priority: u8) {
        if let Err(error) = set_realtime_priority(priority) {
            crate::log::warn!(
                thread = self.thread,
                priority,
                ?error,
                "the system refuses a real-time priority; allow it with `ulimit -r 99` or `setcap cap_sys_nice+ep` on the program"
            );
        }
    }
}

/// Configures the calling thread, which is new, to be independent of the thread that created it. It may run
/// on any CPU, under SCHED_FIFO with the priority `wanted`, or the highest one that is granted. Returns the
/// granted priority, and logs it.
pub(crate) fn set_highest_priority(thread: &str, wanted: u8) -> u8 {
    if let Err(error) = system::unpin() {
        crate::log::warn!(thread, %error, "the thread stays on the CPUs of the thread that created it");
    }
    let has = request_priority(wanted);
    if has >= wanted {
        crate::log::debug!(thread, priority = has, "has its real-time priority, and may run on any CPU");
    } else {
        crate::log::warn!(
            thread,
            wanted,
            has,
            "the system refuses this thread its real-time priority; it has another (0: none), so threads of the same or a higher priority delay it, and without \
             one any busy CPU does; allow it with `ulimit -r 99` or `setcap cap_sys_nice+ep` on the program"
        );
    }
    has
}

/// Gives the calling thread the real-time priority `wanted`, or the highest one that is granted, and lets it run on any
/// CPU. Returns the priority, 0 for none. For the thread of a node's stop: a control loop that never sleeps must not
/// keep it from running. It logs nothing: the thread `safe-output` does.
pub fn request_stop_priority(wanted: u8) -> u8 {
    // If the system refuses, it stays where it is.
    let _ = system::unpin();
    request_priority(wanted)
}

/// Requests SCHED_FIFO with the priority `wanted`, or the highest one that is granted, for the calling thread.
/// Returns the priority that it has then, 0 for none.
pub(crate) fn request_priority(wanted: u8) -> u8 {
    let (policy, inherited) = schedule();
    let granted = priorities(wanted, system::realtime_limit(), inherited)
        .into_iter()
        .flatten()
        .any(|priority| set_realtime_priority(priority).is_ok());
    // The creating thread may have the idle schedule, which yields to all others.
    let yields_to_others = matches!(policy, Some(ThreadSchedulePolicy::Normal(normal)) if normal != NormalThreadSchedulePolicy::Other);
    if !granted && yields_to_others {
        set_normal_schedule();
    }
    realtime_priority()
}

/// Returns the calling thread's real-time priority, 0 for none.
pub(crate) fn realtime_priority() -> u8 {
    let (_, priority) = schedule();
    priority
}

/// Returns the real-time priorities to request, in order, for a thread that inherited one, 0 for none: the
/// wanted one, then the highest one within the limit, if that is above the inherited one.
fn priorities(wanted: u8, limit: u8, inherited: u8) -> [Option<u8>; 2] {
    [Some(wanted), Some(limit.min(wanted)).filter(|granted| *granted > inherited)]
}

/// Returns the scheduling policy of the calling thread, and its real-time priority, 0 for none.
fn schedule() -> (Option<ThreadSchedulePolicy>, u8) {
    thread_schedule_policy_param(thread_native_id()).map_or((None, 0), |(policy, params)| {
        (Some(policy), u8::try_from(params.sched_priority).unwrap_or(0))
    })
}

/// Sets the calling thread to SCHED_FIFO with this priority, 1 to 99.
pub(super) fn set_realtime_priority(priority: u8) -> Result<(), thread_priority::Error> {
    let level = priority
        .try_into()
        .map_err(|_| thread_priority::Error::Priority("a real-time priority is 1 to 99"))?;
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(level), policy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shared_thread_has_one_priority_and_one_cpu() {
        let leg = || Place::thread("leg");
        let words = leg().realtime(40).clash(&leg().on_cpu(1)).expect("they ask for different things");
        assert_eq!(
            words,
            "the thread 'leg' has real-time priority 40 on any CPU, and cannot have no real-time priority on CPU 1 as well"
        );
        assert_eq!(leg().realtime(40).clash(&leg().realtime(40)), None);
        assert_eq!(leg().clash(&Place::thread("arm").realtime(40)), None);
        let own = Place::own_thread().of_application("leg").realtime(40);
        assert_eq!(leg().clash(&own), None, "that is another thread");
        assert_eq!(Place::process().clash(&Place::process().realtime(40)), None, "each has its own");
    }

    #[test]
    fn refused_priority_falls_back_to_the_highest_granted() {
        let asked = |limit, inherited| -> Vec<u8> {
            priorities(90, limit, inherited).into_iter().flatten().collect()
        };
        assert_eq!(asked(0, 0), [90]);
        assert_eq!(asked(80, 0), [90, 80]);
        assert_eq!(asked(99, 0), [90, 90]);
        assert_eq!(asked(40, 50), [90], "what it has is more");
    }
}
