//! The thread that makes outputs safe, as the system sees it: it inherits nothing from the thread that made
//! the first guard.

use std::{fs, time::Duration};

use rustix::{
    process::{Pid, Resource, getrlimit},
    thread::{CpuSet, sched_getaffinity},
};
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    protection::{Guard, Protection, SAFE_OUTPUT_PRIORITY},
    supervision::Place,
    tid::{AppAddress, NodeAddress, Tid},
    wire::Payload,
};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

use super::alone;

#[derive(Serialize, Deserialize)]
struct Torque;

impl Payload for Torque {
    const NAME: &'static str = "test.torque";
    const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(20)));
}

/// The CPUs that a thread may run on.
fn cpus(thread: Option<Pid>) -> Vec<usize> {
    let set = sched_getaffinity(thread).unwrap();
    (0..CpuSet::MAX_CPU).filter(|cpu| set.is_set(*cpu)).collect()
}

/// Whether a thread of this process is granted this real-time priority.
fn is_granted(priority: u8) -> bool {
    let trial = move || {
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        let priority = ThreadPriority::Crossplatform(priority.try_into().unwrap());
        set_thread_priority_and_policy(thread_native_id(), priority, policy).is_ok()
    };
    std::thread::spawn(trial).join().unwrap()
}

/// The ID, and the real-time priority, of the thread of this process with this name.
fn thread(name: &str) -> (Pid, u8) {
    let threads = fs::read_dir("/proc/self/task").unwrap().filter_map(|thread| Some(thread.ok()?.path()));
    // Other threads may end meanwhile.
    let is_it = |path: &std::path::PathBuf| {
        fs::read_to_string(path.join("comm")).is_ok_and(|comm| comm.trim() == name)
    };
    let path = threads.into_iter().find(is_it).unwrap();
    let number = path.file_name().unwrap().to_str().unwrap().parse().unwrap();
    let stat = fs::read_to_string(path.join("stat")).unwrap();
    // After the name, which may contain any characters, `state` is the third field and `rt_priority` the
    // fortieth.
    let (_, fields) = stat.rsplit_once(") ").unwrap();
    (Pid::from_raw(number).unwrap(), fields.split(' ').nth(40 - 3).unwrap().parse().unwrap())
}

#[test]
fn safe_output_thread_inherits_no_cpu_and_no_priority() {
    alone("safe_output::safe_output_thread_inherits_no_cpu_and_no_priority", || {
        let all = cpus(None);
        let limit = getrlimit(Resource::Rtprio).current.map_or(99, |limit| limit.min(99) as u8);
        let granted = [SAFE_OUTPUT_PRIORITY, limit.min(SAFE_OUTPUT_PRIORITY)];
        let granted =
            granted.into_iter().find(|priority| *priority > 0 && is_granted(*priority)).unwrap_or(0);
        // Given: a control thread with one CPU, and a low priority where one is granted.
        let own_cpu = all[0];
        let control = std::thread::spawn(move || {
            Place::thread("control").on_cpu(own_cpu).realtime(2).prepare();
            assert_eq!(cpus(None), [own_cpu]);
            let tid = |app| Tid::new(NodeAddress::new(7), AppAddress::new(app));
            Guard::new::<Torque>(tid(1), tid(2), (), |(), _| {}).unwrap()
        });
        let _guard = control.join().unwrap();
        let (number, priority) = thread("safe-output");
        let its = cpus(Some(number));
        assert!(all.iter().all(|cpu| its.contains(cpu)), "{its:?} of {all:?}");
        assert_eq!(priority, granted);
    });
}
