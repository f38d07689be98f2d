//! The threads that actors live on, by name.

use std::{collections::BTreeMap, ffi::CString};

use actix_rt::{Arbiter, ArbiterHandle};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

/// Where an actor runs: a thread with a name. Actors with the same name share it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// Name of the thread; the kernel shows its first 15 bytes.
    pub thread: String,
    /// SCHED_FIFO priority, 1 to 99. Where the system refuses it, the node says so once and goes on without.
    pub realtime_priority: Option<u8>,
    /// The one CPU that the thread may run on.
    pub cpu: Option<usize>,
    /// The thread is in a process of its own, a child of the node's.
    pub own_process: bool,
}

impl Place {
    /// Name of the thread that reads the node's sockets.
    pub const IO: &'static str = "io";

    /// The thread called `name`, scheduled like any other.
    #[must_use]
    pub fn thread(name: impl Into<String>) -> Self {
        Self { thread: name.into(), realtime_priority: None, cpu: None, own_process: false }
    }

    /// A process of its own, a child of the node's: its thread is called like the application.
    #[must_use]
    pub const fn process() -> Self {
        Self { thread: String::new(), realtime_priority: None, cpu: None, own_process: true }
    }

    /// The same thread under SCHED_FIFO with this priority, 1 to 99.
    #[must_use]
    pub const fn realtime(mut self, priority: u8) -> Self {
        self.realtime_priority = Some(priority);
        self
    }

    /// The same thread on one CPU only.
    #[must_use]
    pub const fn on_cpu(mut self, cpu: usize) -> Self {
        self.cpu = Some(cpu);
        self
    }

    /// Makes the calling thread, which is new, the thread of this place.
    pub fn prepare(&self) {
        let name: Vec<u8> = self.thread.bytes().filter(|byte| *byte != 0).take(15).collect();
        if let Ok(name) = CString::new(name) {
            // Only for people who look at the process; nothing depends on it.
            let _ = rustix::thread::set_name(&name);
        }
        if let Some(cpu) = self.cpu {
            let mut set = rustix::thread::CpuSet::new();
            if cpu < rustix::thread::CpuSet::MAX_CPU {
                set.set(cpu);
            }
            if let Err(error) = rustix::thread::sched_setaffinity(None, &set) {
                tracing::warn!(thread = self.thread, cpu, %error, "the thread stays on any CPU; does this one exist?");
            }
        }
        if let Some(priority) = self.realtime_priority {
            self.make_realtime(priority);
        }
    }

    fn make_realtime(&self, priority: u8) {
        let Ok(level) = priority.try_into() else {
            tracing::warn!(
                thread = self.thread,
                priority,
                "a real-time priority is 1 to 99; the thread has none"
            );
            return;
        };
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        let set =
            set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(level), policy);
        if let Err(error) = set {
            tracing::warn!(
                thread = self.thread,
                priority,
                ?error,
                "the system refuses a real-time priority; allow it with `ulimit -r 99` or `setcap cap_sys_nice+ep` on the program"
            );
        }
    }
}

/// The threads of a node. Made when the first actor needs them; used on the node's root thread only.
#[derive(Debug, Default)]
pub struct Threads {
    arbiters: BTreeMap<String, Arbiter>,
}

impl Threads {
    /// The thread of `place`.
    pub(super) fn get(&mut self, place: &Place) -> ArbiterHandle {
        let make = || {
            let place = place.clone();
            Arbiter::with_tokio_rt(move || {
                place.prepare();
                tokio::runtime::Builder::new_current_thread()
                    .enable_all()
                    .build()
                    .expect("descriptors for a reactor; raise `ulimit -n`")
            })
        };
        self.arbiters.entry(place.thread.clone()).or_insert_with(make).handle()
    }

    /// Gives a thread up: it ends when what runs on it lets it; the next actor of this place gets a new one.
    pub(super) fn abandon(&mut self, place: &Place) {
        if let Some(arbiter) = self.arbiters.remove(&place.thread) {
            arbiter.stop();
        }
    }

    /// Ends all threads.
    pub fn stop(&mut self) {
        for arbiter in std::mem::take(&mut self.arbiters).into_values() {
            arbiter.stop();
        }
    }
}
