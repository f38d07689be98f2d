//! Where the log's thread runs: on the CPUs that the process was started with, whoever logs first. A process of its own, as there is one such
//! thread of a process.

#![cfg(target_os = "linux")]
#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

use std::{fs, time::Duration};

use rustix::{
    process::{Pid, getpid},
    thread::{CpuSet, sched_getaffinity, sched_setaffinity},
};
use sinew_runtime::{log, supervision::Place};

/// Those that a thread may run on.
fn cpus(thread: Option<Pid>) -> Vec<usize> {
    let set = sched_getaffinity(thread).unwrap();
    (0..CpuSet::MAX_CPU).filter(|cpu| set.is_set(*cpu)).collect()
}

/// The number of the thread of this process that is called so.
fn thread(name: &str) -> Option<Pid> {
    let mut threads = fs::read_dir("/proc/self/task").unwrap().filter_map(|thread| Some(thread.ok()?.path()));
    let path =
        threads.find(|path| fs::read_to_string(path.join("comm")).is_ok_and(|comm| comm.trim() == name))?;
    Pid::from_raw(path.file_name()?.to_str()?.parse().ok()?)
}

#[test]
fn the_logs_thread_stays_where_the_process_was_started_and_not_where_who_logs_first_is_kept() {
    let all = cpus(None);
    let (Some(first), Some(last)) = (all.first(), all.last()) else { unreachable!("it runs somewhere") };
    // Given: a process that was started on one CPU, and a thread of it that is kept on another.
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
}
