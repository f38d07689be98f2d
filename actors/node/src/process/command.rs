//! The supervised process of a command: started, watched, stopped, killed. It registers its name at the node's
//! socket by itself.

mod launch;
mod output;
mod progress;

use std::{
    io,
    pin::{Pin, pin},
    rc::Rc,
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use sinew_lncl::{CommandPort, Presence};
use sinew_runtime::{
    app::{CommandReadiness, DownPolicy, DynApp},
    supervision::{Launch, ReadyGate, Reason, RunningActor},
    tid::Tid,
};
use tokio::{
    sync::{Notify, watch},
    time::{Instant, timeout},
};

use self::{
    launch::LaunchReport,
    output::OutputReader,
    progress::{ProgressTimeout, Verdict},
};
use super::{
    child_process::Process,
    predecessor::Predecessor,
    spawn::{self, Output, Role, Started},
    variable,
};
use crate::NodeState;

/// Deadline for the frames that a process sent before its end. LNCL takes at most 100 ms for them.
const LAST_FRAMES_TIMEOUT: Duration = Duration::from_millis(150);

/// A command of the node, for each of its processes.
pub(crate) struct Command {
    state: Arc<NodeState>,
    port: Arc<CommandPort>,
    tid: Tid,
    name: String,
    readiness: CommandReadiness,
    /// Whether messages are rejected while no process is registered.
    drops: bool,
    start_within: Duration,
    progress_within: Option<Duration>,
    predecessor: Arc<Predecessor>,
}

impl Command {
    /// Returns the launch of the command's process, for each start.
    pub(crate) fn launch(
        state: &Arc<NodeState>,
        port: Arc<CommandPort>,
        tid: Tid,
        readiness: CommandReadiness,
        app: &DynApp,
    ) -> Launch {
        let policy = app.policy();
        let command = Arc::new(Self {
            state: state.clone(),
            port,
            tid,
            name: app.name().to_owned(),
            readiness,
            drops: app.down_policy() == DownPolicy::Drop,
            start_within: policy.start_within,
            progress_within: policy.progress_within,
            predecessor: Arc::default(),
        });
        Arc::new(move |ready| supervise(command.clone(), ready))
    }

    /// Starts the process after the former one has ended.
    async fn start(&self) -> Result<Started, String> {
        let variable = variable(&self.state, &self.name);
        spawn::start_next(Role::Command, variable, &self.predecessor, &self.name).await
    }
}

/// Returns one process of the command, for its supervisor.
fn supervise(command: Arc<Command>, ready: ReadyGate) -> Box<dyn RunningActor> {
    let stop = Rc::new(Notify::new());
    Box::new(CommandSupervision { run: Box::pin(run(command, ready, stop.clone())), stop })
}

struct CommandSupervision {
    run: Pin<Box<dyn Future<Output = Reason>>>,
    stop: Rc<Notify>,
}

impl RunningActor for CommandSupervision {
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Reason> {
        self.run.as_mut().poll(cx)
    }

    fn stop(&mut self) {
        self.stop.notify_one();
    }

    fn terminate(&mut self) {
        // Dropping this value kills the process; no code of the program runs in this one.
    }
}

async fn run(command: Arc<Command>, ready: ReadyGate, stop: Rc<Notify>) -> Reason {
    // A stop does not wait for the end of the former process.
    let started = tokio::select! {
        started = command.start() => started,
        () = stop.notified() => return Reason::Shutdown,
    };
    let (group, socket, output) = match started {
        Ok(started) => started.keep(),
        Err(why) => return Reason::ProcessEnded(format!("it could not be started: {why}")),
    };
    let leader = group.leader().as_raw_nonzero().get();
    let process = match Process::new(group) {
        Ok(process) => process,
        Err(why) => return Reason::ProcessEnded(format!("it could not be watched: {why}")),
    };
    sinew_runtime::log::debug!(app = command.name, pid = leader, "a process was started");
    match Child::new(command, Rc::new(process), leader, ready, (socket, output)) {
        Ok(child) => child.run(&stop).await,
        Err(why) => Reason::ProcessEnded(format!("it could not be listened to: {why}")),
    }
}

/// The process of a command, as long as it lives.
struct Child {
    command: Arc<Command>,
    process: Rc<Process>,
    /// The number of the process at its port.
    number: u64,
    presence: watch::Receiver<Presence>,
    ready: Option<ReadyGate>,
    launch: LaunchReport,
    output: OutputReader,
    progress: ProgressTimeout,
    /// The deadline for the registration of a program that was registered before.
    register_until: Option<Instant>,
    is_stopping: bool,
}

impl Drop for Child {
    fn drop(&mut self) {
        // Killed before its connection is ended: it handles no message that gets another outcome there.
        self.process.kill();
        self.command.port.end(self.number);
    }
}

impl Child {
    fn new(
        command: Arc<Command>,
        process: Rc<Process>,
        leader: i32,
        ready: ReadyGate,
        (socket, output): (std::os::unix::net::UnixStream, Option<Output>),
    ) -> io::Result<Self> {
        let launch = LaunchReport::new(socket)?;
        let output = OutputReader::new(&command.name, output)?;
        let progress = ProgressTimeout::new(command.progress_within, Instant::now());
        let number = command.port.begin(leader);
        let presence = command.port.presence();
        launch.allow();
        let (ready, register_until, is_stopping) = (Some(ready), None, false);
        Ok(Self {
            command,
            process,
            number,
            presence,
            ready,
            launch,
            output,
            progress,
            register_until,
            is_stopping,
        })
    }

    /// Serves the process to its end. Returns the reason when all that it sent is handled: its last wills follow that.
    async fn run(mut self, stop: &Notify) -> Reason {
        let reason = self.serve(stop).await;
        self.process.kill();
        // A deadline, since LNCL itself may hang. What is left then is handled later.
        let _ = timeout(LAST_FRAMES_TIMEOUT, self.command.port.retire(self.number)).await;
        reason
    }

    /// Serves the process until it has ended, or is to be killed. Returns the reason.
    async fn serve(&mut self, stop: &Notify) -> Reason {
        let process = self.process.clone();
        let mut ended = pin!(process.wait());
        let status = loop {
            tokio::select! {
                status = &mut ended => break status,
                () = stop.notified() => {
                    self.is_stopping = true;
                    process.terminate();
                }
                () = changed(&mut self.presence) => self.on_presence(),
                () = self.launch.read() => {}
                () = self.output.forward() => {}
                () = due(self.register_until) => return self.unregistered(),
                now = self.progress.tick() => {
                    if let Some(reason) = self.check_progress(now) {
                        return reason;
                    }
                }
            }
        };
        self.output.finish();
        if let Some(why) = self.launch.finish() {
            return Reason::ProcessEnded(format!("it could not be started: {why}"));
        }
        match (self.is_stopping, process.has_succeeded()) {
            (true, _) => Reason::Shutdown,
            (false, true) => Reason::Normal,
            (false, false) => Reason::ProcessEnded(status),
        }
    }

    fn on_presence(&mut self) {
        let presence = *self.presence.borrow_and_update();
        if self.ready.is_none() && self.command.drops {
            // From its end on, and until its next readiness, its supervisor does this.
            self.command.port.set_refusing(presence == Presence::Absent);
        }
        if presence == Presence::Absent {
            // Before its readiness the supervisor has the same deadline.
            if self.ready.is_none() && self.register_until.is_none() {
                self.register_until = Some(Instant::now() + self.command.start_within);
            }
            return;
        }
        self.register_until = None;
        if presence == Presence::Ready || self.command.readiness == CommandReadiness::Registered {
            self.ready.take().into_iter().for_each(ReadyGate::reached);
        }
    }

    fn unregistered(&self) -> Reason {
        let within = self.command.start_within;
        Reason::ProcessEnded(format!(
            "it was killed: it ended its connection with its node, and did not register again within {within:?}"
        ))
    }

    fn check_progress(&mut self, now: Instant) -> Option<Reason> {
        // A program that is not ready has another deadline, and so has one that is told to stop.
        let is_watched = self.ready.is_none() && !self.is_stopping;
        let signs = self.command.port.signs().filter(|_| is_watched);
        match self.progress.check(now, signs) {
            Verdict::Alive => {}
            Verdict::Idle => self.command.port.probe(self.command.tid),
            Verdict::Hung(silent) => {
                let silent = silent.as_millis();
                return Some(Reason::Hung(format!(
                    "its program has read nothing and sent nothing for {silent} ms: it does not return to its endpoint, was stopped, or has no CPU"
                )));
            }
        }
        None
    }
}

/// Resolves at this time, or never.
async fn due(at: Option<Instant>) {
    match at {
        Some(at) => tokio::time::sleep_until(at).await,
        None => std::future::pending().await,
    }
}

/// Resolves when the registration may have changed.
async fn changed(presence: &mut watch::Receiver<Presence>) {
    if presence.changed().await.is_err() {
        // The sender outlives this child.
        std::future::pending().await
    }
}
