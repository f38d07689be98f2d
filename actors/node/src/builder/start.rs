//! Starts a declared node: checks the declaration, prepares the process, and waits for the layers.

use std::{
    process::ExitCode,
    sync::{
        Arc,
        mpsc::{RecvTimeoutError, sync_channel},
    },
    time::SystemTime,
};

use sinew_model::config::{ConfigError, ConfigFault, LogLevel};
use sinew_runtime::{
    log,
    log::tracing::level_filters::LevelFilter,
    supervision::{Flags, UNWINDS},
    tid::Incarnation,
};
use sinew_security::node_security::NodeSecurity;

use super::{NodeBuilder, StartError};
use crate::{
    Node, NodeHandle, NodeState, SupervisorSpec, inspect, kept_parameters,
    node::LAST_WORDS,
    play_check, process,
    root::{self, RootEvent},
    security_setup, stop, types,
};

/// Maximum number of waiting applications in the log line of the start.
const WAITING_SHOWN_MAX: usize = 8;

impl NodeBuilder {
    /// Starts the node and runs it until it ends: the complete `main` of a node's program. Returns the exit
    /// code: 0 after an orderly stop, 1 if it did not start or gave up; the reason is logged and written to
    /// the standard error.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::Node;
    ///
    /// fn main() -> std::process::ExitCode {
    ///     Node::from_file("/etc/sinew/knee.toml").run()
    /// }
    /// ```
    pub fn run(self) -> ExitCode {
        match self.heed_signals().start() {
            Ok(node) => node.run(),
            // It was stopped in order by a signal that came while it started.
            Err(StartError::Ended) => ExitCode::SUCCESS,
            Err(error) => {
                log::error!(%error, "the node did not start");
                log::print(error.to_string());
                log::flush(LAST_WORDS);
                ExitCode::FAILURE
            }
        }
    }

    /// Starts the node. Returns when its layers are ready; its applications start when their requirements are
    /// ready.
    ///
    /// An application of the node that has a [process of its own](sinew_runtime::app::AppSpec::own_process)
    /// runs this program again with the same arguments. In that process this function does not return but
    /// runs the application, and the builders of other nodes start nothing. Code before this line runs in
    /// that process too, so keep it short, and do not read the standard input.
    ///
    /// In a process that `sinew play --check` has started this function runs the applications in virtual time,
    /// reports to the command, and does not return.
    ///
    /// Signals are not handled: SIGINT and SIGTERM end the process at once, without an ordered stop. Call
    /// [`heed_signals`](Self::heed_signals) before, or [`run`](Self::run) instead.
    ///
    /// # Errors
    /// The configuration has faults, or enables security and the keys cannot be used; `lncl.socket` cannot be
    /// opened, an application cannot be registered, a layer did not become ready, or another process with the
    /// node's address was found. If such a process is found later, the node ends with the same text.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::prelude::*;
    ///
    /// struct Knee;
    /// # impl Actor for Knee { type Context = AppContext<Self>; }
    ///
    /// let node = Node::builder("knee").app(AppSpec::new("knee.drive", || Knee)).start()?;
    /// node.handle().wait_until_running(Duration::from_secs(10))?;
    /// // The node lives as long as `node`.
    /// node.stop();
    /// # Ok::<(), StartError>(())
    /// ```
    pub fn start(mut self) -> Result<Node, StartError> {
        // Here, on a thread like any other.
        log::begin();
        log::set_level(level(self.config.log.level));
        self.check_config()?;
        check_panics(UNWINDS, self.accept_abort_on_panic)?;
        #[cfg(feature = "fault-points")]
        let planned = crate::faults::read(&self.faults, &mut self.tree)?;
        let hosts_other_node = play_check::takes_over(&self.config, &mut self.tree)?
            || process::hosts_other_node(&self.config, &mut self.tree);
        let auto_shutdown = self.tree.flags.auto_shutdown;
        self.tree.flags = Flags { auto_shutdown, ..self.config.supervision.apps() };
        self.tree.check()?;
        let start_timeout = self.config.sync.layer_deadline * 4;
        let incarnation = self.incarnation.unwrap_or_else(wall_clock);
        let secured = if hosts_other_node { None } else { NodeSecurity::load(&self.config, incarnation)? };
        let list = if hosts_other_node { None } else { security_setup::read_access_list(&self.config)? };
        let state = NodeState::new(self.config, incarnation);
        if !hosts_other_node {
            security_setup::set_credentials(&state, secured);
            security_setup::warn_loopback_only(&state.ctx.config);
            security_setup::set_access_list(&state, list);
            security_setup::set_parameter_right(&state);
            kept_parameters::keep(&state.ctx, &self.tree.apps());
        }
        #[cfg(feature = "fault-points")]
        crate::faults::keep(&state, &planned)?;
        #[cfg(not(feature = "fault-points"))]
        if std::env::var_os("SINEW_FAULTS").is_some() {
            log::warn!("SINEW_FAULTS is ignored: this program was built without the feature `fault-points`");
        }
        let handle = NodeHandle { root: state.root.clone(), state: state.clone(), hosts_other_node };
        let (start_sender, started) = sync_channel(1);
        let (end_sender, ended) = sync_channel(1);
        if hosts_other_node {
            return Ok(Node { handle, ended, thread: None });
        }
        // Before any layer: an application that cannot have it would fail repeatedly, with the same text.
        if self.tree.apps().iter().any(|app| app.place().own_process) {
            process::check_kernel().map_err(StartError::OwnProcess)?;
        }
        open_client_socket(&state)?;
        stop::begin(&state)?;
        inspect::begin(&state)?;
        types::begin(&state)?;
        begin_recording(&state, self.writes_recording)?;
        let (tree, heed_signals) = (self.tree, self.heed_signals);
        if heed_signals && handle.root.post(RootEvent::HeedSignals).is_err() {
            return Err(StartError::Layers("the root's event queue was full before it was read".to_owned()));
        }
        let thread = std::thread::Builder::new()
            .name("root".to_owned())
            .spawn(move || root::run(state, tree, start_sender, end_sender))?;
        let node = Node { handle, ended, thread: Some(thread) };
        match started.recv_timeout(start_timeout) {
            Ok(Ok(())) => {
                log_start(&node.handle);
                begin_real_time(&node.handle.state);
                Ok(node)
            }
            // Dropping the node stops all that was started.
            Ok(Err(error)) => Err(error),
            Err(RecvTimeoutError::Timeout) => Err(StartError::Layers(format!(
                "they were not ready within {start_timeout:?}, which is four times `sync.layer_deadline_ms`"
            ))),
            Err(RecvTimeoutError::Disconnected) => {
                Err(StartError::Layers("the node's first thread ended in a panic: see the log".to_owned()))
            }
        }
    }

    /// Reads the settings of applications, and checks the whole configuration.
    fn check_config(&mut self) -> Result<(), ConfigError> {
        let mut faults = std::mem::take(&mut self.file_faults);
        let is_new =
            |faults: &[ConfigFault], fault: &ConfigFault| faults.iter().all(|other| other.key != fault.key);
        for found in self.config.validate().err().map(ConfigError::into_vec).unwrap_or_default() {
            if is_new(&faults, &found) {
                faults.push(found);
            }
        }
        for make in std::mem::take(&mut self.configured) {
            match make(&self.config) {
                Ok(app) => self.tree = std::mem::replace(&mut self.tree, SupervisorSpec::new("")).app(app),
                Err(found) => faults.extend(found.into_vec()),
            }
        }
        for command in &self.config.commands {
            self.tree = std::mem::replace(&mut self.tree, SupervisorSpec::new("")).app(command);
        }
        faults.extend(self.config.unclaimed_settings());
        ConfigError::check(faults)
    }
}

/// Logs the node's identity, and its waiting applications.
fn log_start(handle: &NodeHandle) {
    let config = &handle.state.ctx.config;
    let (interface, socket) = (&config.ndl.interface, config.lncl.socket.as_ref());
    let socket = socket.map(|path| path.display().to_string());
    let is_chosen = !interface.are_default();
    let place = if is_chosen { "" } else { ", on its own host alone: no `interface` under [ndl] is set" };
    log::info!(
        node = config.name, address = %handle.address(), project = config.project, %interface, socket, "the node has started{place}"
    );
    for waiting in handle.waiting().into_iter().take(WAITING_SHOWN_MAX) {
        let missing: Vec<_> = waiting.missing.iter().map(|absence| &*absence.name).collect();
        log::info!(application = waiting.application, "waits for {}", missing.join(", "));
    }
}

const fn level(level: LogLevel) -> LevelFilter {
    match level {
        LogLevel::Off => LevelFilter::OFF,
        LogLevel::Error => LevelFilter::ERROR,
        LogLevel::Warn => LevelFilter::WARN,
        LogLevel::Info => LevelFilter::INFO,
        LogLevel::Debug => LevelFilter::DEBUG,
        LogLevel::Trace => LevelFilter::TRACE,
    }
}

/// Opens the socket for other processes, if it is configured. LNCL serves it later.
fn open_client_socket(state: &NodeState) -> Result<(), StartError> {
    let Some(path) = &state.ctx.config.lncl.socket else { return Ok(()) };
    state.lncl.open_client_socket(path).map(drop).map_err(|why| StartError::Socket(why.to_string()))
}

/// Begins the recording that the configuration asks for. The program has to write its file, if there is one.
fn begin_recording(state: &Arc<NodeState>, writes_recording: bool) -> Result<(), StartError> {
    if state.ctx.config.record.file.is_some() && !writes_recording {
        let why = "this program does not write record.file; run sinew-node, or call NodeBuilder::writes_recording and \
                   sinew_recorder::Recording::configured in the program, or remove the key";
        return Err(StartError::Record(why.to_owned()));
    }
    state.recording.begin_configured(state).map_err(|why| StartError::Record(why.to_string()))
}

/// Begins the proof of real time. A node runs without it, too.
fn begin_real_time(state: &NodeState) {
    if let Err(error) = state.real_time.begin(state.ctx.config.rt.probe) {
        log::warn!(%error, "the node does not measure its lateness: the system starts no further thread; raise its limit of threads");
    }
}

/// Returns a number that grows from one start of a host's node to the next, as long as the host's clock does
/// not go back.
#[expect(
    clippy::disallowed_methods,
    reason = "read once, at the start: a later incarnation needs a larger number"
)]
fn wall_clock() -> Incarnation {
    let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    Incarnation(u64::try_from(since_1970.as_micros()).unwrap_or(u64::MAX))
}

/// Refuses a program in which supervisors cannot catch panics, unless its owner accepts that.
fn check_panics(unwinds: bool, accepted: bool) -> Result<(), StartError> {
    if unwinds {
        return Ok(());
    }
    if accepted {
        log::warn!("this program ends with its first panic: no supervisor of this node restarts what panics");
        return Ok(());
    }
    Err(StartError::AbortsOnPanic)
}

#[cfg(test)]
mod tests {
    use sinew_model::config::NodeConfig;

    use super::*;

    #[test]
    fn aborting_program_needs_explicit_permission() {
        assert!(matches!(check_panics(false, false), Err(StartError::AbortsOnPanic)));
        assert!(check_panics(false, true).is_ok() && check_panics(true, false).is_ok());
    }

    #[test]
    fn secured_node_without_keys_does_not_start() {
        let secured = |config: &mut NodeConfig| config.security.keys = Some("/there/are/no/keys".into());
        let refused = Node::builder("hip").configure(secured).start();
        let words = refused.expect_err("there are no keys").to_string();
        assert!(words.contains("security.keys") && words.contains("/there/are/no/keys"), "{words}");
    }

    #[test]
    fn unwinding_program_is_detected() {
        // Tests are always built so; a program with `panic = "abort"` was tried by hand
        // (docs/decisions/0011).
        const { assert!(UNWINDS) };
    }
}
