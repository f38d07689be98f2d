//! Where an actor runs: a thread with a name, or a process of its own.

use std::ffi::CString;

use thread_priority::{
    NormalThreadSchedulePolicy, RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id, thread_schedule_policy_param,
};

use super::system;

/// Where an actor runs: a thread with a name. Actors that name the same one share it; what they ask of it besides must be the
/// same, too.
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
    /// Name of the thread; the kernel shows its first 15 bytes.
    pub thread: String,
    /// Whose thread it is.
    pub owner: Owner,
    /// SCHED_FIFO priority, 1 to 99; an application's is below [that of the thread which makes outputs
    /// safe](crate::protection::SAFE_OUTPUT_PRIORITY). Where the system refuses it, the node says so once and goes on without.
    pub realtime_priority: Option<u8>,
    /// A priority for the node's own thread where the system grants one; nothing is said where it does not.
    pub at_best: Option<u8>,
    /// The one CPU that the thread may run on.
    pub cpu: Option<usize>,
    /// The thread is in a process of its own, a child of the node's.
    pub own_process: bool,
}

/// Whose a thread is. Threads of the same name and of different owners are different threads: nobody comes to live on another
/// one's because he happens to be called like it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Owner {
    /// The node's: its layers live there, and on the one that reads its sockets whoever asks for [`Place::io`].
    Node,
    /// Everybody's who names it.
    Everybody,
    /// The application's that it is called like, and nobody else's.
    Application,
}

impl Place {
    const fn of(owner: Owner, thread: String) -> Self {
        Self { thread, owner, realtime_priority: None, at_best: None, cpu: None, own_process: false }
    }

    /// The thread called `name`, scheduled like any other, shared by all who name it. Those that name none share the one called
    /// `apps`.
    #[must_use]
    pub fn thread(name: impl Into<String>) -> Self {
        Self::of(Owner::Everybody, name.into())
    }

    /// A thread that is shared with nobody, called like the application that has it: its declaration fills the name in.
    #[must_use]
    pub const fn own_thread() -> Self {
        Self::of(Owner::Application, String::new())
    }

    /// The place of the application called `name`.
    #[must_use]
    pub(crate) fn of_application(mut self, name: &str) -> Self {
        if self.owner == Owner::Application {
            name.clone_into(&mut self.thread);
        }
        self
    }

    /// The thread that reads the node's sockets. Its priority and its CPU are the node's.
    #[must_use]
    pub fn io() -> Self {
        Self::layer("io")
    }

    /// A thread for layers of the node.
    #[must_use]
    pub fn layer(name: impl Into<String>) -> Self {
        Self::of(Owner::Node, name.into())
    }

    /// A process of its own, a child of the node's: its thread is called like the application.
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

    /// The same thread under SCHED_FIFO with this priority, 1 to 99; an application with 90 or more is refused by its node, as
    /// [what makes outputs safe](crate::protection::SAFE_OUTPUT_PRIORITY) has to come before what it guards.
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

    /// The same thread under SCHED_FIFO with this priority, 1 to 99, where the system allows it, and as any other where it does not.
    #[must_use]
    pub const fn realtime_at_best(mut self, priority: u8) -> Self {
        self.at_best = Some(priority);
        self
    }

    /// The same thread on one CPU only.
    #[must_use]
    pub const fn on_cpu(mut self, cpu: usize) -> Self {
        self.cpu = Some(cpu);
        self
    }

    /// Which thread of a node this is.
    pub(super) fn key(&self) -> (Owner, String) {
        (self.owner, self.thread.clone())
    }

    /// What is wrong with `other`, if it names this thread and asks for another priority or CPU. In words, without a remedy.
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

    /// Makes the calling thread, which is new, the thread of this place.
    pub fn prepare(&self) {
        let name: Vec<u8> = self.thread.bytes().filter(|byte| *byte != 0).take(15).collect();
        if let Ok(name) = CString::new(name) {
            system::name_thread(&name);
        }
        if let Some(cpu) = self.cpu
            && let Err(error) = system::keep_on(cpu)
        {
            crate::log::warn!(thread = self.thread, cpu, %error, "the thread stays on any CPU; does this one exist?");
        }
        if let Some(priority) = self.at_best {
            let granted = make_realtime(priority).is_ok();
            crate::log::debug!(
                thread = self.thread,
                priority,
                granted,
                "a real-time priority, where one is to be had"
            );
        }
        if let Some(priority) = self.realtime_priority {
            self.make_realtime(priority);
        }
    }

    fn make_realtime(&self, priority: u8) {
        if let Err(error) = make_realtime(priority) {
            crate::log::warn!(
                thread = self.thread,
                priority,
                ?error,
                "the system refuses a real-time priority; allow it with `ulimit -r 99` or `setcap cap_sys_nice+ep` on the program"
            );
        }
    }
}

/// Makes the calling thread, which is new and has the CPUs and the priority of whoever made it, one that depends on neither: it may run on any
/// CPU, under SCHED_FIFO with the priority `wanted`, or with the highest that is granted. Says which it has, as does the log.
pub(crate) fn make_foremost(thread: &str, wanted: u8) -> u8 {
    if let Err(error) = system::keep_on_any() {
        crate::log::warn!(thread, %error, "the thread stays on the CPUs of whoever made it");
    }
    let (policy, inherited) = schedule();
    let granted = priorities(wanted, system::realtime_limit(), inherited)
        .into_iter()
        .flatten()
        .any(|priority| make_realtime(priority).is_ok());
    // Whoever made it may be one that waits for all others.
    let gives_way = matches!(policy, Some(ThreadSchedulePolicy::Normal(normal)) if normal != NormalThreadSchedulePolicy::Other);
    if !granted && gives_way {
        make_ordinary();
    }
    let (_, has) = schedule();
    if has >= wanted {
        crate::log::debug!(thread, priority = has, "has its real-time priority, and may run on any CPU");
    } else {
        crate::log::warn!(
            thread,
            wanted,
            has,
            "the system refuses this thread its real-time priority; it has another (0: none), and what has one as high or higher or, without one, a busy CPU \
             makes it late; allow it with `ulimit -r 99` or `setcap cap_sys_nice+ep` on the program"
        );
    }
    has
}

/// The calling thread's real-time priority, 0 for none.
pub(crate) fn realtime_priority() -> u8 {
    let (_, priority) = schedule();
    priority
}

/// The real-time priorities to ask for, one after the other, of a thread that has inherited one, 0 for none: the one that is wanted, and the
/// highest that the limit grants, where that is more than it has.
fn priorities(wanted: u8, limit: u8, inherited: u8) -> [Option<u8>; 2] {
    [Some(wanted), Some(limit.min(wanted)).filter(|granted| *granted > inherited)]
}

/// How the calling thread is scheduled, and its real-time priority, 0 for none.
fn schedule() -> (Option<ThreadSchedulePolicy>, u8) {
    thread_schedule_policy_param(thread_native_id()).map_or((None, 0), |(policy, params)| {
        (Some(policy), u8::try_from(params.sched_priority).unwrap_or(0))
    })
}

/// Puts the calling thread under SCHED_FIFO with this priority, 1 to 99.
pub(super) fn make_realtime(priority: u8) -> Result<(), thread_priority::Error> {
    let level = priority
        .try_into()
        .map_err(|_| thread_priority::Error::Priority("a real-time priority is 1 to 99"))?;
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(level), policy)
}

/// The middle of `thread_priority`'s scale of 0 to 99, which is a niceness of 0.
const MIDDLE: u8 = 48;

/// Puts the calling thread under the ordinary schedule: a thread begins with that of who made it.
pub fn make_ordinary() {
    let policy = ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Other);
    let level = ThreadPriority::Crossplatform(MIDDLE.try_into().expect("it is on the scale"));
    // The schedule itself is refused to nobody; the niceness stays where that is.
    let _ = set_thread_priority_and_policy(thread_native_id(), level, policy);
}

/// The same, and on the CPUs that the process was started with.
pub(crate) fn make_like_any_other() {
    // Refused, it stays where whoever made it is.
    let _ = system::keep_on_the_processes();
    make_ordinary();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_that_two_name_has_one_priority_and_one_cpu() {
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
    fn a_thread_that_is_refused_its_priority_takes_the_highest_that_is_granted() {
        let asked = |limit, inherited| -> Vec<u8> {
            priorities(90, limit, inherited).into_iter().flatten().collect()
        };
        assert_eq!(asked(0, 0), [90]);
        assert_eq!(asked(80, 0), [90, 80]);
        assert_eq!(asked(99, 0), [90, 90]);
        assert_eq!(asked(40, 50), [90], "what it has is more");
    }
}
