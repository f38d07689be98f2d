//! The thread of an application: its own, one that several name, or the node's.

use std::collections::BTreeSet;

use sinew::{node::CommandError, prelude::*};
use sinew_testkit::{
    Log, Loopback, all_run,
    scripted::{Script, ScriptedApp},
    until,
};

/// A scripted application that records its name and its thread ID.
fn dweller(name: &'static str, threads: &Log<(&'static str, i32)>) -> AppSpec<ScriptedApp> {
    let threads = threads.clone();
    let here = || rustix::thread::gettid().as_raw_nonzero().get();
    Script::new().started(move |_, _| threads.write((name, here()))).app(name).0
}

/// The names of this process's threads.
fn threads() -> Vec<String> {
    let tasks = std::fs::read_dir("/proc/self/task").expect("it is always there");
    // A thread may end between the listing and the read.
    let name = |task: std::fs::DirEntry| std::fs::read_to_string(task.path().join("comm")).ok();
    tasks.filter_map(|task| name(task.ok()?)).map(|name| name.trim().to_owned()).collect()
}

#[test]
fn app_named_like_a_node_thread_gets_its_own() {
    let log = Log::default();
    let mut node = Loopback::new().node("node").app(dweller("reader", &log).on_io_thread());
    node = node.app(dweller("ordinary", &log).place(Place::thread("apps")));
    node = node.app(dweller("guest", &log).place(Place::thread("sync")));
    for name in ["io", "sync", "ndl", "apps", "root", "watchdog"] {
        node = node.app(dweller(name, &log));
    }
    let node = node.start().expect("a node");
    all_run(&[&node]);
    let seen = log.all();
    let numbers: BTreeSet<i32> = seen.iter().map(|(_, number)| *number).collect();
    assert_eq!((seen.len(), numbers.len()), (9, 9), "two live on one thread: {seen:?}");
    for layer in ["LNCL", "sync manager", "GNCL", "NDL"] {
        assert!(node.handle().lives(layer).is_some_and(|lives| lives.readies == 1), "{layer} was not moved");
    }
}

#[test]
fn conflicting_priorities_of_one_thread_are_rejected() {
    let log = Log::default();
    let at = |priority| Place::thread("leg").realtime(priority);
    let node = Loopback::new().node("node");
    let node = node.app(dweller("knee", &log).place(at(50))).app(dweller("hip", &log).place(at(40)));
    let words = node.start().expect_err("one of them would have been lost").to_string();
    for part in
        ["'hip'", "'knee'", "'leg'", "real-time priority 50", "real-time priority 40", "another thread"]
    {
        assert!(words.contains(part), "{part} is not in: {words}");
    }
    assert!(log.all().is_empty());
}

#[test]
fn later_app_with_a_conflicting_thread_is_rejected() {
    let log = Log::default();
    let at = |cpu| Place::thread("late-leg").on_cpu(cpu);
    let node = Loopback::new().node("node").app(dweller("knee", &log).place(at(0))).start().expect("a node");
    all_run(&[&node]);
    let hip = || dweller("hip", &log).place(at(usize::MAX));
    let refused = node.handle().add_app(hip(), None).expect_err("the thread has a CPU");
    assert!(matches!(refused, CommandError::Start(_)), "{refused}");
    assert!(refused.to_string().contains("on CPU 0"), "{refused}");
    node.handle().stop_app("knee").expect("it stops");
    node.handle().remove_app("knee").expect("it is removed");
    until("the thread of nobody ends", || (!threads().contains(&"late-leg".to_owned())).then_some(()));
    node.handle().add_app(hip(), None).expect("the name is free, and the thread too");
    all_run(&[&node]);
    let [(_, first), (_, second)] = log.all()[..] else { panic!("{:?}", log.all()) };
    assert_ne!(first, second, "a thread is not another one's");
}
