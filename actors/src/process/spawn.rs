//! Starts processes, and reaps those that nobody waits for.
//!
//! One thread does both, for as long as this program runs. The kernel counts the thread that starts a process as its
//! parent: when that thread ends, the process is killed (`PR_SET_PDEATHSIG`). A node's own threads are given up when they
//! hang; this one runs no code of any actor.

use std::{
    ffi::OsString,
    os::{
        fd::{AsFd, OwnedFd},
        unix::{net::UnixStream, process::CommandExt},
    },
    process::{Command, Stdio},
    sync::{
        Arc, OnceLock,
        mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel},
    },
    time::Duration,
};

use rustix::process::{
    Pid, PidfdFlags, Signal, WaitId, WaitIdOptions, WaitIdStatus, pidfd_open, pidfd_send_signal, waitid,
};
use tokio::sync::oneshot;

use super::words::VARIABLE;

/// Orders that wait for the thread at most. When full: a start fails and is tried again, and a process that has ended
/// stays in the kernel's table.
const ORDERS_MAX: usize = 1_024;
/// Time between two looks at processes that were killed and have not ended: the first one, doubled up to the last.
const REAPING_MIN: Duration = Duration::from_millis(2);
const REAPING_MAX: Duration = Duration::from_millis(256);

/// A process that has just been started.
pub(super) struct Started {
    pub(super) pid: Pid,
    /// It owns the process: whoever drops it hands it to [`reap`].
    pub(super) pidfd: Arc<OwnedFd>,
    pub(super) socket: UnixStream,
}

enum Order {
    /// Start this program again with this value of the variable.
    Start {
        variable: String,
        answer: oneshot::Sender<Result<Started, String>>,
    },
    Reap(Arc<OwnedFd>),
}

/// Begins the thread, so that processes inherit priority and CPUs of the calling one and not of one of the node's.
pub(super) fn begin_spawning() {
    // What is wrong is said when a process is to be started.
    let _ = thread();
}

/// Starts this program again, as a host.
pub(super) async fn start(variable: String) -> Result<Started, String> {
    let (answer, started) = oneshot::channel();
    order(Order::Start { variable, answer })?;
    started.await.map_err(|_| "the thread that starts processes has ended".to_owned())?
}

/// Reaps a process that has ended, or was killed. Not on the calling thread: the kernel may take its time to clear away what
/// it knows of the process, longer than a thread of the node's may stand still.
pub(super) fn reap(pidfd: Arc<OwnedFd>) {
    if let Err(why) = order(Order::Reap(pidfd)) {
        crate::log::error!(why, "a process that has ended is not reaped");
    }
}

/// How a process has ended; `None` if it has not, or if that cannot be known. It is left to be reaped.
pub(super) fn ending_of(pidfd: &OwnedFd) -> rustix::io::Result<Option<WaitIdStatus>> {
    let look = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
    waitid(WaitId::PidFd(pidfd.as_fd()), look)
}

fn order(order: Order) -> Result<(), String> {
    match thread().as_ref().map(|orders| orders.try_send(order)) {
        Ok(Ok(())) => Ok(()),
        Ok(Err(TrySendError::Full(_))) => Err("too many processes are to be started at once".to_owned()),
        Ok(Err(TrySendError::Disconnected(_))) => Err("the thread for it has ended".to_owned()),
        Err(why) => Err(format!("there is no thread for it: {why}; raise `ulimit -u`")),
    }
}

fn thread() -> &'static std::io::Result<SyncSender<Order>> {
    static THREAD: OnceLock<std::io::Result<SyncSender<Order>>> = OnceLock::new();
    THREAD.get_or_init(|| {
        let (orders, inbox) = sync_channel(ORDERS_MAX);
        let thread = std::thread::Builder::new().name("processes".to_owned());
        thread.spawn(move || run(&inbox)).map(|_| orders)
    })
}

fn run(inbox: &Receiver<Order>) {
    let mut doomed: Vec<Arc<OwnedFd>> = Vec::new();
    let mut pause = REAPING_MIN;
    loop {
        let order = if doomed.is_empty() {
            inbox.recv().map_err(RecvTimeoutError::from)
        } else {
            inbox.recv_timeout(pause)
        };
        pause = if order.is_ok() { REAPING_MIN } else { (pause * 2).min(REAPING_MAX) };
        match order {
            Ok(Order::Start { variable, answer }) => {
                if let Err(Ok(unwanted)) = answer.send(start_now(&variable)) {
                    // Who ordered it is gone: it was told to stop, or failed.
                    let _ = pidfd_send_signal(&unwanted.pidfd, Signal::KILL);
                    doomed.push(unwanted.pidfd);
                }
            }
            Ok(Order::Reap(pidfd)) => doomed.push(pidfd),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
        doomed.retain(|pidfd| !has_been_reaped(pidfd));
    }
}

fn has_been_reaped(pidfd: &OwnedFd) -> bool {
    let reaped = waitid(WaitId::PidFd(pidfd.as_fd()), WaitIdOptions::EXITED | WaitIdOptions::NOHANG);
    // An error says that it is nobody's child any more.
    !matches!(reaped, Ok(None))
}

fn start_now(variable: &str) -> Result<Started, String> {
    let fault = |doing: &'static str| move |cause: std::io::Error| format!("{doing}: {cause}");
    let (socket, theirs) = UnixStream::pair().map_err(fault("no pair of sockets; raise `ulimit -n`"))?;
    let mut arguments = std::env::args_os();
    // Not by its path: the file there may be another one by now.
    let mut command = Command::new("/proc/self/exe");
    let child = command
        .arg0(arguments.next().unwrap_or_else(|| OsString::from("sinew")))
        .args(arguments)
        .env(VARIABLE, variable)
        .stdin(Stdio::from(OwnedFd::from(theirs)))
        // Ctrl-C is for the node, which then stops its applications in order.
        .process_group(0)
        .spawn()
        .map_err(fault("this program cannot be started again"))?;
    let pid = Pid::from_child(&child);
    // It is our child and has not been waited for, so nobody else has its id.
    match pidfd_open(pid, PidfdFlags::empty()) {
        Ok(pidfd) => Ok(Started { pid, pidfd: Arc::new(pidfd), socket }),
        Err(cause) => {
            let mut child = child;
            let _ = child.kill();
            let _ = child.wait();
            Err(format!("no descriptor for the process: {cause}; raise `ulimit -n`"))
        }
    }
}

#[cfg(test)]
mod tests {
    use rustix::event::{PollFd, PollFlags, poll};

    use super::*;

    #[test]
    #[expect(clippy::zombie_processes, reason = "reaping it is what is tried")]
    fn who_looks_how_a_process_has_ended_leaves_it_to_be_reaped() {
        let child = Command::new("true").spawn().expect("a program that every system has");
        let pid = Pid::from_child(&child);
        let pidfd = pidfd_open(pid, PidfdFlags::empty()).expect("it is a child of ours");
        poll(&mut [PollFd::new(&pidfd, PollFlags::IN)], None).expect("it ends");
        for _ in 0..2 {
            let status = ending_of(&pidfd).expect("it is not reaped yet").expect("it has ended");
            assert_eq!(status.exit_status(), Some(0));
        }
        assert!(has_been_reaped(&pidfd));
        assert!(ending_of(&pidfd).is_err(), "there is nothing left of it");
    }
}
