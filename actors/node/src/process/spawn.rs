//! Starts processes, and reaps those that have no other waiter.
//!
//! One thread does both, for the lifetime of this program. The kernel treats the thread that starts a process
//! as its parent: when that thread ends, it kills the process (`PR_SET_PDEATHSIG`). A node abandons its own
//! threads if they hang; this thread runs no code of any actor.

use std::{
    ffi::OsString,
    io,
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

use rustix::{
    io::Errno,
    process::{
        Pid, PidfdFlags, Signal, WaitId, WaitIdOptions, getpid, kill_process_group, pidfd_open, waitid,
    },
};
use sinew_runtime::remedy::{Wanted, is_permanent, remedy};
use tokio::sync::oneshot;

use super::{group::Group, predecessor::Predecessor, protocol::VARIABLE};

/// Maximum number of orders that wait for the thread. If the queue is full, a start fails and is retried, and
/// an ended process stays in the kernel's table.
const ORDERS_MAX: usize = 1_024;
/// Interval between checks on killed processes that have not ended: the first one, doubled up to the last.
const REAPING_MIN: Duration = Duration::from_millis(2);
const REAPING_MAX: Duration = Duration::from_millis(256);

/// A process that has just been started. Dropping it kills the process: its requester may be gone by then.
pub(super) struct Started {
    process: NewProcess,
    socket: UnixStream,
    output: Option<Output>,
}

/// What a started process does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    /// It hosts an application of this program.
    Host,
    /// It becomes the program of a command.
    Command,
}

/// The ends of the pipes of a command's standard output and standard error.
pub(super) struct Output {
    pub(super) stdout: OwnedFd,
    pub(super) stderr: OwnedFd,
}

struct NewProcess {
    group: Arc<Group>,
    is_kept: bool,
}

impl Started {
    fn new(group: Arc<Group>, socket: UnixStream, output: Option<Output>) -> Self {
        Self { process: NewProcess { group, is_kept: false }, socket, output }
    }

    /// Returns the process, the other end of its standard input, and those of its output if it is a command. The caller
    /// must kill it, and pass it to [`reap`].
    pub(super) fn keep(mut self) -> (Arc<Group>, UnixStream, Option<Output>) {
        self.process.is_kept = true;
        (self.process.group.clone(), self.socket, self.output)
    }
}

impl Drop for NewProcess {
    fn drop(&mut self) {
        if !self.is_kept {
            self.group.kill();
            reap(self.group.clone());
        }
    }
}

enum Order {
    /// Starts this program again with this value of the variable, and registers it as the predecessor of the
    /// next one.
    Start {
        role: Role,
        variable: String,
        predecessor: Arc<Predecessor>,
        answer: oneshot::Sender<Result<Started, String>>,
    },
    Reap(Arc<Group>),
}

/// Starts the thread, so that processes inherit priority and CPUs of the calling thread and not of one of the
/// node's.
pub(super) fn begin_spawning() {
    // An error is reported when a process is started.
    let _ = thread();
}

/// Tests on this process the calls that watch another one. A temporary shortage is no error.
///
/// # Errors
/// The missing call and its Linux version, in words; it stays missing.
pub(crate) fn check_kernel() -> Result<(), String> {
    let missing = |call: &str, since: &str, cause: io::Error| {
        let cannot = "an application cannot have a process of its own here (`own_process`)";
        format!(
            "{cannot}: {call} fails: {cause}; it needs Linux {since} or newer, and a seccomp profile that allows this call"
        )
    };
    let pidfd = match pidfd_open(getpid(), PidfdFlags::empty()).map_err(io::Error::from) {
        Ok(pidfd) => pidfd,
        Err(cause) if is_permanent(&cause) => return Err(missing("pidfd_open", "5.3", cause)),
        Err(_) => return Ok(()),
    };
    match waitid(WaitId::PidFd(pidfd.as_fd()), WaitIdOptions::EXITED | WaitIdOptions::NOHANG) {
        // This process is not its own child.
        Ok(_) | Err(Errno::CHILD) => Ok(()),
        Err(cause) if is_permanent(&cause.into()) => Err(missing("waitid with P_PIDFD", "5.4", cause.into())),
        Err(_) => Ok(()),
    }
}

/// Starts this program again, in this role. It becomes the `predecessor` of the next one, even if the requester
/// is gone.
async fn start(role: Role, variable: String, predecessor: Arc<Predecessor>) -> Result<Started, String> {
    let (answer, started) = oneshot::channel();
    order(Order::Start { role, variable, predecessor, answer })?;
    started.await.map_err(|_| "the thread that starts processes has ended".to_owned())?
}

/// Starts this program again after the former process of `app` has ended.
pub(super) async fn start_next(
    role: Role,
    variable: String,
    predecessor: &Arc<Predecessor>,
    app: &str,
) -> Result<Started, String> {
    let ended = predecessor.has_ended(app).await;
    ended.map_err(|cause| format!("it is unknown whether its former process has ended: {cause}"))?;
    start(role, variable, predecessor.clone()).await
}

/// Reaps a process that has ended or was killed, on another thread. The kernel may take longer to clean up
/// the process than a thread of the node may block.
pub(super) fn reap(group: Arc<Group>) {
    if let Err(why) = order(Order::Reap(group)) {
        sinew_runtime::log::error!(why, "a process that has ended is not reaped");
    }
}

fn order(order: Order) -> Result<(), String> {
    match thread().as_ref().map(|orders| orders.try_send(order)) {
        Ok(Ok(())) => Ok(()),
        Ok(Err(TrySendError::Full(_))) => Err("too many processes are to be started at once".to_owned()),
        Ok(Err(TrySendError::Disconnected(_))) => Err("the thread for it has ended".to_owned()),
        Err(why) => Err(format!("there is no thread for it: {why}; {}", remedy(Wanted::Thread, why))),
    }
}

fn thread() -> &'static io::Result<SyncSender<Order>> {
    static THREAD: OnceLock<io::Result<SyncSender<Order>>> = OnceLock::new();
    THREAD.get_or_init(|| {
        let (orders, inbox) = sync_channel(ORDERS_MAX);
        let thread = std::thread::Builder::new().name("processes".to_owned());
        thread.spawn(move || run(&inbox)).map(|_| orders)
    })
}

fn run(inbox: &Receiver<Order>) {
    let mut unreaped: Vec<Arc<Group>> = Vec::new();
    let mut pause = REAPING_MIN;
    loop {
        let order = if unreaped.is_empty() {
            inbox.recv().map_err(RecvTimeoutError::from)
        } else {
            inbox.recv_timeout(pause)
        };
        pause = if order.is_ok() { REAPING_MIN } else { (pause * 2).min(REAPING_MAX) };
        match order {
            // The requester is gone: it was stopped, or failed.
            Ok(Order::Start { answer, .. }) if answer.is_closed() => {}
            Ok(Order::Start { role, variable, predecessor, answer }) => {
                // Processes of an earlier group must not hold resources that the next process needs.
                unreaped.retain(|group| !group.has_been_reaped());
                let started = start_now(role, &variable)
                    .inspect(|started| predecessor.set(started.process.group.pidfd().clone()));
                // If the requester is gone by now, the process is dropped and killed.
                drop(answer.send(started));
            }
            Ok(Order::Reap(group)) => unreaped.push(group),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
        unreaped.retain(|group| !group.has_been_reaped());
    }
}

fn start_now(role: Role, variable: &str) -> Result<Started, String> {
    let fault = |wanted, doing: &'static str| {
        move |cause: io::Error| format!("{doing}: {cause}; {}", remedy(wanted, &cause))
    };
    let (socket, theirs) = UnixStream::pair().map_err(fault(Wanted::Descriptor, "no pair of sockets"))?;
    let mut arguments = std::env::args_os();
    // Not by its path, since that file may have been replaced.
    let mut command = Command::new("/proc/self/exe");
    command
        .arg0(arguments.next().unwrap_or_else(|| OsString::from("sinew")))
        .args(arguments)
        .env(VARIABLE, variable)
        .stdin(Stdio::from(OwnedFd::from(theirs)));
    match role {
        // Ctrl-C concerns only the node, which then stops its applications in order. The group also ends the
        // processes that the child starts.
        Role::Host => command.process_group(0),
        // It begins a session of its own, which the leader of a group cannot do.
        Role::Command => command.stdout(Stdio::piped()).stderr(Stdio::piped()),
    };
    let mut child =
        command.spawn().map_err(fault(Wanted::Process, "this program cannot be started again"))?;
    let pid = Pid::from_child(&child);
    let output = child.stdout.take().zip(child.stderr.take());
    let output = output.map(|(out, err)| Output { stdout: out.into(), stderr: err.into() });
    // It is our unreaped child, so its pid is not reused.
    match pidfd_open(pid, PidfdFlags::empty()) {
        Ok(pidfd) => Ok(Started::new(Arc::new(Group::new(pid, pidfd)), socket, output)),
        Err(cause) => {
            let _ = kill_process_group(pid, Signal::KILL);
            let _ = child.kill();
            let _ = child.wait();
            Err(fault(Wanted::Descriptor, "no descriptor for the process (pidfd_open)")(cause.into()))
        }
    }
}
