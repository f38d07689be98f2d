//! One process, held by its descriptor: killed, waited for, and how it ended in words.

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

/// Whether a process has been killed. Nothing is handed over to it from then on, so that it waits for the next one: of what a killed process
/// has been handed over nobody may be able to say whether it was handled.
#[derive(Clone, Debug, Default)]
pub(super) struct Doom(Arc<AtomicBool>);

impl Doom {
    /// Said before the process is killed, by whoever kills it.
    pub(super) fn comes(&self) {
        self.0.store(true, Ordering::Release);
    }

    pub(super) fn has_come(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// The process itself. Dropping it kills it, and what it has started.
pub(super) struct Process {
    group: Arc<Group>,
    doom: Doom,
    pidfd: AsyncFd<Arc<OwnedFd>>,
}

impl Process {
    pub(super) fn new(group: Arc<Group>) -> io::Result<Self> {
        let doomed = group.clone();
        let (fenced, doom) = (group.clone(), Doom::default());
        let said = doom.clone();
        // Its supervisor does not wait for the thread that listens to it: that may hang on somebody else's account.
        supervision::at_fence(move || {
            said.comes();
            fenced.kill();
            spawn::reap(fenced);
        });
        #[expect(
            deprecated,
            reason = "sound for an OwnedFd, whose descriptor never changes; its successor is an unsafe fn, and unsafe code lives in sinew-shm and the C binding alone"
        )]
        AsyncFd::new(group.pidfd().clone()).map(|pidfd| Self { group, doom, pidfd }).inspect_err(|_| {
            doomed.kill();
            spawn::reap(doomed);
        })
    }

    pub(super) fn kill(&self) {
        self.doom.comes();
        self.group.kill();
    }

    pub(super) fn doom(&self) -> Doom {
        self.doom.clone()
    }

    /// Waits for its end, for this time at most, on a thread that has nobody else to care for: it ends.
    pub(super) fn ends_at_once(&self, within: Duration) -> bool {
        let within = Timespec { tv_sec: 0, tv_nsec: i64::from(within.subsec_nanos()) };
        let ended = poll(&mut [PollFd::new(self.group.pidfd(), PollFlags::IN)], Some(&within));
        ended == Ok(1) && !matches!(self.group.ending(), Ok(None))
    }

    /// How it has ended, if it does so in time.
    pub(super) async fn ends_within(&self, time: Duration) -> Option<String> {
        timeout(time, self.ended()).await.ok()
    }

    /// Resolves when it has ended. It is reaped when this is dropped.
    pub(super) async fn ended(&self) -> String {
        loop {
            // An error of the reactor's means that nothing will be told by it: what can be known is asked for.
            let guard = self.pidfd.readable().await;
            match self.group.ending() {
                Ok(Some(status)) => return in_words(&status),
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

fn in_words(status: &WaitIdStatus) -> String {
    if let Some(code) = status.exit_status() {
        return format!("exit code {code}");
    }
    let dumped = if status.dumped() { ", core dumped" } else { "" };
    match status.terminating_signal() {
        Some(number) => format!("killed by signal {number} ({}){dumped}", signal_name(number)),
        None => "nobody knows how".to_owned(),
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
