//! One process, held by its pidfd: kills it, waits for its end, and describes its exit status.

use std::{
    io,
    os::fd::OwnedFd,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    process::{Signal, WaitIdStatus},
};
use sinew_runtime::supervision;
use tokio::{io::unix::AsyncFd, time::timeout};

use super::{group::Group, spawn};

/// Whether a process was killed. No message is handed over to it from then on, so that messages wait for the
/// next process. For messages at a killed process it may be unknown whether they were handled.
#[derive(Clone, Debug, Default)]
pub(super) struct KillFlag(Arc<AtomicBool>);

impl KillFlag {
    /// Marks the process; the killer calls this before the kill.
    pub(super) fn set(&self) {
        self.0.store(true, Ordering::Release);
    }

    pub(super) fn is_set(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// The process itself. Dropping it kills it, and the processes that it started.
pub(super) struct Process {
    group: Arc<Group>,
    kill_flag: KillFlag,
    pidfd: AsyncFd<Arc<OwnedFd>>,
}

impl Process {
    pub(super) fn new(group: Arc<Group>) -> io::Result<Self> {
        let failed = group.clone();
        let (fenced, kill_flag) = (group.clone(), KillFlag::default());
        let fenced_flag = kill_flag.clone();
        // Its supervisor does not wait for the thread that reads from it, since other actors may hang that
        // thread.
        supervision::at_fence(move || {
            fenced_flag.set();
            fenced.kill();
            spawn::reap(fenced);
        });
        #[expect(
            deprecated,
            reason = "sound for an OwnedFd, whose descriptor never changes; its successor is an unsafe fn, and unsafe code lives in sinew-shm and the C binding alone"
        )]
        AsyncFd::new(group.pidfd().clone()).map(|pidfd| Self { group, kill_flag, pidfd }).inspect_err(|_| {
            failed.kill();
            spawn::reap(failed);
        })
    }

    /// Asks it, and the processes that it started, to end (SIGTERM).
    pub(super) fn terminate(&self) {
        self.group.terminate();
    }

    /// Returns whether it has ended in order, with exit code 0.
    pub(super) fn has_succeeded(&self) -> bool {
        matches!(self.group.ending(), Ok(Some(status)) if status.exit_status() == Some(0))
    }

    pub(super) fn kill(&self) {
        self.kill_flag.set();
        self.group.kill();
    }

    pub(super) fn kill_flag(&self) -> KillFlag {
        self.kill_flag.clone()
    }

    /// Waits for its end, at most this time. It blocks, so the calling thread must have no other work: it is
    /// about to end.
    pub(super) fn wait_blocking(&self, within: Duration) -> bool {
        let within = Timespec { tv_sec: 0, tv_nsec: i64::from(within.subsec_nanos()) };
        let ended = poll(&mut [PollFd::new(self.group.pidfd(), PollFlags::IN)], Some(&within));
        ended == Ok(1) && !matches!(self.group.ending(), Ok(None))
    }

    /// Returns its exit status in words, if it ends in time.
    pub(super) async fn wait_within(&self, time: Duration) -> Option<String> {
        timeout(time, self.wait()).await.ok()
    }

    /// Resolves when it has ended. It is reaped when this is dropped.
    pub(super) async fn wait(&self) -> String {
        loop {
            // After an error of the reactor no readiness is signalled, so the status is queried.
            let guard = self.pidfd.readable().await;
            match self.group.ending() {
                Ok(Some(status)) => return describe(&status),
                Err(cause) => return format!("how is not known: {cause}; does the program ignore SIGCHLD?"),
                Ok(None) => {}
            }
            match guard {
                Ok(mut guard) => guard.clear_ready(),
                Err(cause) => return format!("it cannot be watched: {cause}"),
            }
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
        spawn::reap(self.group.clone());
    }
}

fn describe(status: &WaitIdStatus) -> String {
    if let Some(code) = status.exit_status() {
        return format!("exit code {code}");
    }
    let dumped = if status.dumped() { ", core dumped" } else { "" };
    match status.terminating_signal() {
        Some(number) => format!("killed by signal {number} ({}){dumped}", signal_name(number)),
        None => "with an unknown exit status".to_owned(),
    }
}

fn signal_name(number: i32) -> &'static str {
    match Signal::from_named_raw(number) {
        Some(Signal::KILL) => "SIGKILL",
        Some(Signal::SEGV) => "SIGSEGV",
        Some(Signal::ABORT) => "SIGABRT",
        Some(Signal::BUS) => "SIGBUS",
        Some(Signal::ILL) => "SIGILL",
        Some(Signal::FPE) => "SIGFPE",
        Some(Signal::TERM) => "SIGTERM",
        Some(Signal::INT) => "SIGINT",
        Some(Signal::HUP) => "SIGHUP",
        Some(Signal::QUIT) => "SIGQUIT",
        Some(Signal::TRAP) => "SIGTRAP",
        Some(Signal::SYS) => "SIGSYS",
        Some(Signal::XCPU) => "SIGXCPU",
        Some(_) | None => "see `kill -l`",
    }
}
