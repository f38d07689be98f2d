//! The CPUs of the log's thread: those of the process at its start, whichever thread logs first.

use std::{fs, time::Duration};

use rustix::{
    process::{Pid, getpid},
    thread::{CpuSet, sched_getaffinity, sched_setaffinity},
};
use sinew_runtime::{log, supervision::Place};

use super::alone;

/// The CPUs that a thread may run on.
fn cpus(thread: Option<Pid>) -> Vec<usize> {
    let set = sched_getaffinity(thread).unwrap();
    (0..CpuSet::MAX_CPU).filter(|cpu| set.is_set(*cpu)).collect()
}

/// The ID of the thread of this process with this name.
fn thread(name: &str) -> Option<Pid> {
    let mut threads = fs::read_dir("/proc/self/task").unwrap().filter_map(|thread| Some(thread.ok()?.path()));
    let path =
        threads.find(|path| fs::read_to_string(path.join("comm")).is_ok_and(|comm| comm.trim() == name))?;
    Pid::from_raw(path.file_name()?.to_str()?.parse().ok()?)
}

#[test]
fn log_thread_keeps_the_cpus_of_the_process() {
    alone("log_cpus::log_thread_keeps_the_cpus_of_the_process", || {
        let all = cpus(None);
        let (Some(first), Some(last)) = (all.first(), all.last()) else { unreachable!("it runs somewhere") };
        // Given: a process that was started on one CPU, with a thread that is pinned to another.
        let mut set = CpuSet::new();
        set.set(*first);
        sched_setaffinity(Some(getpid()), &set).unwrap();
        let other = *last;
        let logging = std::thread::spawn(move || {
            Place::thread("control").on_cpu(other).prepare();
            log::begin();
            log::flush(Duration::from_secs(30));
        });
        logging.join().unwrap();
        // Then:
        let number = thread("log").expect("it was begun");
        assert_eq!(cpus(Some(number)), [*first]);
    });
}
