//! The supervised child process: started, read from, stopped, killed.

mod heartbeat;

use std::{
    io,
    pin::Pin,
    rc::Rc,
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use rustix::net::Shutdown;
use sinew_lncl::{
    self, Reader,
    session::{Order, Session},
    undelivered::{Entry, is_fault},
};
use sinew_protocol::payload;
use sinew_runtime::{
    outcome::{Rejection, Ticket},
    supervision::{self, ReadyGate, Reason, RunningActor},
    tid::Tid,
    time::Time,
    wire::{Flags, FrameError, Header, Kind, Message},
};
use sinew_session::outlet::LinkNumber;
use tokio::{
    net::UnixStream,
    sync::{Notify, watch},
    time::Instant,
};

use self::heartbeat::HeartbeatTimeout;
use super::{
    child_process::Process,
    link::{FinalRead, Link},
    names::KnownNames,
    protocol::{self, Beat, ExitReport, FRAME_BYTES_MAX, NameLookup, Names, Progress, Welcome},
    spawn::{self, Role, Started},
    variable,
};
use crate::NodeState;

/// Time in which a process must end after it has reported its end, or was killed.
const EXIT_TIMEOUT: Duration = Duration::from_secs(1);
/// Time in which a killed process must end while a thread that is itself ending waits for it. The end takes a
/// fraction of a millisecond; a longer one has much memory to release, or hangs in the kernel.
const KILL_TIMEOUT: Duration = Duration::from_millis(20);
/// Delay until names are sent again to a child with a full queue.
const NAMES_RETRY: Duration = Duration::from_millis(20);
/// Size of the range of wait numbers of each process of a TID: more than a process can use.
const WAITS_PER_PROCESS: u64 = 1 << 40;

/// An application that is hosted in its own process.
pub(super) struct Hosted {
    pub(super) state: Arc<NodeState>,
    pub(super) link: Arc<Link>,
    pub(super) tid: Tid,
    pub(super) name: String,
    pub(super) progress_within: Option<Duration>,
}

/// Returns one process of the application, for its supervisor.
pub(super) fn supervise_process(hosted: Arc<Hosted>, ready: ReadyGate) -> Box<dyn RunningActor> {
    let stop = Rc::new(Notify::new());
    Box::new(ProcessSupervision { run: Box::pin(run(hosted, ready, stop.clone())), stop })
}

struct ProcessSupervision {
    run: Pin<Box<dyn Future<Output = Reason>>>,
    stop: Rc<Notify>,
}

impl RunningActor for ProcessSupervision {
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Reason> {
        self.run.as_mut().poll(cx)
    }

    fn stop(&mut self) {
        self.stop.notify_one();
    }

    fn terminate(&mut self) {
        // Dropping this value kills the process; no code of the actor runs in this one.
    }
}

async fn run(hosted: Arc<Hosted>, ready: ReadyGate, stop: Rc<Notify>) -> Reason {
    // A stop does not wait for the end of the former process.
    let started = tokio::select! {
        started = hosted.start() => started,
        () = stop.notified() => return Reason::Shutdown,
    };
    let (group, socket, _) = match started {
        Ok(started) => started.keep(),
        Err(why) => return Reason::ProcessEnded(format!("it could not be started: {why}")),
    };
    let pid = group.leader();
    let process = match Process::new(group) {
        Ok(process) => process,
        Err(why) => return Reason::ProcessEnded(format!("it could not be watched: {why}")),
    };
    sinew_runtime::log::debug!(app = hosted.name, pid = pid.as_raw_nonzero(), "a process was started");
    match Child::new(hosted, Rc::new(process), ready, socket) {
        Ok(mut child) => child.run(&stop).await,
        Err(why) => Reason::ProcessEnded(format!("it could not be listened to: {why}")),
    }
}

impl Hosted {
    /// Starts the process after the former one has ended.
    async fn start(&self) -> Result<Started, String> {
        let variable = variable(&self.state, &self.name);
        spawn::start_next(Role::Host, variable, self.link.predecessor(), &self.name).await
    }
}

/// The node's end of the socket pair, as long as the process lives.
struct Child {
    hosted: Arc<Hosted>,
    process: Rc<Process>,
    is_disconnected: bool,
    ready: Option<ReadyGate>,
    stream: Arc<UnixStream>,
    reader: Reader,
    session: Session,
    names: KnownNames,
    /// Time at which names are sent again that found the queue full.
    names_retry_at: Option<Instant>,
    /// Whether the queue rejected the last frame to the child.
    is_queue_full: bool,
    /// Changes of the directory since the lookup of the names in the welcome.
    changes: watch::Receiver<u64>,
    number: LinkNumber,
    exit_reason: Option<Reason>,
    last_frame_at: Option<Instant>,
}

impl Drop for Child {
    fn drop(&mut self) {
        if self.is_disconnected {
            return;
        }
        self.process.kill();
        // A fenced supervisor does not wait for the end: the child was not ready, or did not stop, in time,
        // and its later frames are ignored. Other actors of this thread continue; the next process waits.
        let is_dead = !supervision::is_fenced() && self.process.wait_blocking(KILL_TIMEOUT);
        self.disconnect(is_dead);
    }
}

/// The reason for which reading ended.
enum Termination {
    /// The process has ended, with this status.
    Ended(String),
    /// It has closed its connection.
    Closed,
    /// It is at fault.
    Fault(Reason),
}

impl Child {
    fn new(
        hosted: Arc<Hosted>,
        process: Rc<Process>,
        ready: ReadyGate,
        socket: std::os::unix::net::UnixStream,
    ) -> io::Result<Self> {
        socket.set_nonblocking(true)?;
        let stream = Arc::new(UnixStream::from_std(socket)?);
        let (tid, node) = (hosted.tid, payload::lncl_of(hosted.tid.node));
        // Before the lookup of the names, so that a change in between is sent twice, not lost.
        let changes = hosted.state.ctx.directory_changes.subscribe();
        let directory = changes.clone();
        let sent = *directory.borrow();
        let mut names = KnownNames::default();
        let known = names.changes(&hosted.state).unwrap_or_default();
        let welcome = Welcome {
            tid: tid.bits(),
            first_wait: hosted.link.begin_process() * WAITS_PER_PROCESS,
            sequence: hosted.link.sequence(),
            beat_us: hosted.progress_within.map_or(0, |within| in_micros(within / 4).max(1)),
            names: known,
        };
        let welcome = protocol::frame(Kind::HOST_WELCOME, node, tid, &welcome);
        let number = hosted.link.connect(stream.clone(), welcome, (directory, sent), process.kill_flag());
        let mut session = Session::default();
        session.released(tid);
        let reader = Reader::new(hosted.state.ctx.config.payload_max.max(FRAME_BYTES_MAX));
        let ready = Some(ready);
        Ok(Self {
            hosted,
            process,
            is_disconnected: false,
            ready,
            stream,
            reader,
            session,
            names,
            names_retry_at: None,
            is_queue_full: false,
            changes,
            number,
            exit_reason: None,
            last_frame_at: None,
        })
    }

    /// Serves the process until it has ended. Returns the reason of its end.
    async fn run(&mut self, stop: &Notify) -> Reason {
        let process = self.process.clone();
        let termination = self.listen(&process, stop).await;
        let mut status = match &termination {
            Termination::Ended(status) => Some(status.clone()),
            Termination::Closed => process.wait_within(EXIT_TIMEOUT).await,
            Termination::Fault(_) => None,
        };
        if status.is_none() {
            process.kill();
            // The next process must find the devices and ports of this one free.
            status = process.wait_within(EXIT_TIMEOUT).await;
        }
        self.disconnect(status.is_some());
        let status = status.unwrap_or_else(|| "it was killed and has not ended yet".to_owned());
        match termination {
            Termination::Fault(reason) => reason,
            Termination::Ended(_) | Termination::Closed => {
                self.exit_reason.take().unwrap_or(Reason::ProcessEnded(status))
            }
        }
    }

    async fn listen(&mut self, process: &Process, stop: &Notify) -> Termination {
        let link = self.hosted.link.clone();
        let drain = link.drain(self.number);
        let ended = process.wait();
        tokio::pin!(drain, ended);
        let mut drained = false;
        let mut changes = self.changes.clone();
        let mut watch = HeartbeatTimeout::new(self.hosted.progress_within);
        loop {
            tokio::select! {
                frame = self.reader.next(&self.stream) => match frame {
                    Ok(Some(message)) => {
                        if let Err(fault) = self.handle_frame(message) {
                            return Termination::Fault(fault);
                        }
                    }
                    // A reset means that it died before it read all of our data.
                    Ok(None) | Err(FrameError::Io(_)) => return Termination::Closed,
                    Err(cause @ (FrameError::Header(_) | FrameError::TooLong { .. })) => {
                        return Termination::Fault(Reason::ProcessEnded(format!("it was killed: {cause}")));
                    }
                },
                // Its last frames have already arrived.
                _ = &mut drain, if !drained => drained = true,
                status = &mut ended => return Termination::Ended(status),
                () = stop.notified() => {
                    self.send(protocol::empty_frame(Kind::HOST_STOP, Tid::NONE, self.hosted.tid));
                }
                () = link.names_needed(self.number), if self.names_retry_at.is_none() => {
                    self.send_names();
                    self.hand_over_held();
                }
                () = changed(&mut changes) => {
                    self.send_names();
                    self.hand_over_held();
                }
                () = due(self.names_retry_at) => {
                    self.send_names();
                    self.hand_over_held();
                }
                now = watch.tick() => {
                    if let Some(reason) = watch.check(now, &mut self.last_frame_at) {
                        return Termination::Fault(reason);
                    }
                }
            }
        }
    }

    /// Disconnects the process, after handling the frames that it sent before its end.
    fn disconnect(&mut self, is_dead: bool) {
        self.is_disconnected = true;
        // A fenced child is already treated as dead. Its late frames would follow its last will, or mix with
        // its successor's.
        let final_read = if is_dead && !supervision::is_fenced() && self.drain() {
            FinalRead::Complete
        } else {
            FinalRead::Incomplete
        };
        self.hosted.link.disconnect(self.number, final_read);
    }

    /// Handles the remaining frames. Returns whether all of them could be read.
    fn drain(&mut self) -> bool {
        // Processes that the child started may hold the socket and write on; the shutdown drops their data,
        // so the loop ends. It fails if no other process holds the socket.
        let _ = rustix::net::shutdown(&self.stream, Shutdown::Read);
        loop {
            match self.reader.next_buffered(&self.stream) {
                Ok(None) => return true,
                Ok(Some(message)) => {
                    if self.handle_frame(message).is_err() {
                        return false;
                    }
                }
                Err(_) => return false,
            }
        }
    }

    fn handle_frame(&mut self, message: Message) -> Result<(), Reason> {
        self.last_frame_at = Some(Instant::now());
        let fault = |what: &dyn std::fmt::Display| Reason::ProcessEnded(format!("it was killed: {what}"));
        match message.header.kind {
            Kind::HOST_BEAT => {
                let Beat { stalled_since } =
                    payload::read(&message.payload).map_err(|error| fault(&error))?;
                self.hosted.link.set_stalled(self.number, stalled_since);
            }
            Kind::HOST_TURN => {
                let progress =
                    Progress::read(&message).ok_or_else(|| fault(&"it sent malformed progress"))?;
                self.hosted.link.handle_progress(self.number, progress).map_err(|error| fault(&error))?;
            }
            Kind::HOST_READY => {
                if let Some(ready) = self.ready.take() {
                    ready.reached();
                }
            }
            Kind::HOST_ENDED => {
                let ending: ExitReport = payload::read(&message.payload).map_err(|error| fault(&error))?;
                self.exit_reason = Some(ending.into());
            }
            Kind::HOST_HUNG => {
                let ending: ExitReport = payload::read(&message.payload).map_err(|error| fault(&error))?;
                return Err(ending.into());
            }
            Kind::HOST_LOOK => {
                let NameLookup { name } = payload::read(&message.payload).map_err(|error| fault(&error))?;
                let before = self.names.clone();
                let names = self.names.look_up(&self.hosted.state, name.clone());
                if !self.send_update(&names, before) {
                    self.names.mark_pending(name);
                    self.names_retry_at = Some(Instant::now() + NAMES_RETRY);
                }
            }
            // Not a Rust enum, but an open set of numbers.
            _ => return self.handle_client_frame(message).map_err(|what| fault(&what)),
        }
        Ok(())
    }

    /// Handles the frames that applications of other processes may send, too.
    fn handle_client_frame(&mut self, message: Message) -> Result<(), String> {
        let Hosted { state, tid, .. } = &*self.hosted;
        match self.session.handle(message) {
            Order::Route(message) if self.hosted.link.record_sent(&message.header) => self.route(message),
            Order::Route(message) => {
                return Err(format!("its message number {} is out of reach", message.header.sequence));
            }
            Order::SetMember { group, member, .. } => {
                sinew_lncl::set_member(&state.lncl, tid.app, group, member)
            }
            Order::RefuseMessage { message, why } => {
                let detail =
                    format!("{tid} sent {} to {}: {why}", message.header.kind, message.header.destination);
                state.ctx.refusals.count(Time::now(), "message of a hosted application", &detail);
            }
            Order::RefuseMembership { outcome, .. } => {
                state.ctx.refusals.count(
                    Time::now(),
                    "membership of a hosted application",
                    &format!("{tid}: {outcome:?}"),
                );
            }
            Order::End(violation) => return Err(violation.to_string()),
            Order::Register(_)
            | Order::Settle { .. }
            | Order::Resolve { .. }
            | Order::Introduce { .. }
            | Order::Switch { .. }
            | Order::DeclareType(_)
            | Order::Ready
            | Order::Observe(_)
            | Order::Unregister => {
                return Err("it sent a frame that only a client of LNCL may send".to_owned());
            }
        }
        Ok(())
    }

    fn route(&self, mut message: Message) {
        let Hosted { state, tid, link, .. } = &*self.hosted;
        let destination = state.ctx.router.absolute(message.header.destination);
        let is_confirmed = message.header.flags.has(Flags::CONFIRM);
        if is_confirmed {
            let correlation = message.header.correlation;
            message.receipt = Some(link.receipt(Ticket { source: *tid, destination, correlation }));
        }
        let header = Header { source: *tid, destination, ..message.header };
        if let Err(why) = state.ctx.router.send(message)
            && !is_confirmed
            && is_fault(destination, why)
        {
            // The sender of a confirmed message is notified by its outcome.
            let (detail, now) = (format!("from {tid} to {destination}: {why}"), Time::now());
            state.ctx.refusals.count(now, "unconfirmed message not taken", &detail);
            state.lncl.undelivered.count(now, Entry::of(&header, why, 1, now));
        }
    }

    /// Hands over the held message, except while names cannot be sent to the child. Repeated attempts would
    /// use up the thread's time.
    fn hand_over_held(&self) {
        if self.names_retry_at.is_none() {
            self.hosted.link.hand_over_held();
        }
    }

    /// Sends the child the changes of the directory. If its queue is full because it does not read, they are
    /// sent again after [`NAMES_RETRY`].
    fn send_names(&mut self) {
        let seen = *self.hosted.state.ctx.directory_changes.borrow();
        let before = self.names.clone();
        let is_sent = match self.names.changes(&self.hosted.state) {
            Some(changes) => self.send_update(&changes, before),
            None => true,
        };
        self.names_retry_at = (!is_sent).then(|| Instant::now() + NAMES_RETRY);
        if is_sent {
            self.hosted.link.directory_was_sent(self.number, seen);
        }
    }

    /// Sends names. Returns whether the frame was queued. If not, the child's known names are those of
    /// `before`.
    fn send_update(&mut self, names: &Names, before: KnownNames) -> bool {
        let node = payload::lncl_of(self.hosted.tid.node);
        let is_queued = self.send(protocol::frame(Kind::HOST_NAMES, node, self.hosted.tid, names));
        if !is_queued {
            self.names = before;
        }
        is_queued
    }

    /// Sends a frame. Returns whether it was queued, or the child is gone.
    fn send(&mut self, message: Message) -> bool {
        match self.hosted.link.send_to(self.number, message) {
            // Closed: the child is about to end.
            Ok(()) | Err(sinew_runtime::router::SubmitError { why: Rejection::Closed, .. }) => {
                self.is_queue_full = false;
                true
            }
            Err(refused) => {
                // Counted once until the next success, however often it is retried.
                if !std::mem::replace(&mut self.is_queue_full, true) {
                    let detail = format!("{} does not read its socket: {}", self.hosted.tid, refused.why);
                    let refusals = &self.hosted.state.ctx.refusals;
                    refusals.count(Time::now(), "hosted application does not listen", &detail);
                }
                false
            }
        }
    }
}

/// Resolves at this time, or never.
async fn due(at: Option<Instant>) {
    match at {
        Some(at) => tokio::time::sleep_until(at).await,
        None => std::future::pending().await,
    }
}

/// Resolves when the directory may have changed.
async fn changed(changes: &mut watch::Receiver<u64>) {
    if changes.changed().await.is_err() {
        // The sender outlives this child.
        std::future::pending().await
    }
}

fn in_micros(time: Duration) -> u64 {
    u64::try_from(time.as_micros()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests;
