//! Declares a node and starts it.

use std::{
    path::{Path, PathBuf},
    process::ExitCode,
    sync::mpsc::sync_channel,
    time::{Duration, SystemTime},
};

use serde::de::DeserializeOwned;
use sinew_runtime::{
    app::DynApp,
    log::tracing::level_filters::LevelFilter,
    name::NameError,
    remedy::{Wanted, remedy},
    supervision::{AutoShutdown, Flags, UNWINDS},
    tid::{Incarnation, NodeAddress},
};

use super::{
    LAST_WORDS, Node, NodeHandle, closed,
    root::{self, RootEvent},
    supervisor_spec::SupervisorSpec,
};
use crate::{
    config::{ConfigFault, ConfigFaults, LogLevel, NodeConfig},
    inspect, log, process,
    secured::{KeyFault, Secured},
    stores::Stores,
    sync::Waiting,
};

/// Applications of which the log says at the start that they wait.
const WAITING_SHOWN_MAX: usize = 8;

/// Makes an application of its settings.
type Configured = Box<dyn FnOnce(&NodeConfig) -> Result<DynApp, ConfigFaults> + Send>;

/// Declares a node: its configuration and its applications.
///
/// # Examples
///
/// ```no_run
/// use sinew::prelude::*;
///
/// struct Knee;
/// # impl Actor for Knee { type Context = AppContext<Self>; }
///
/// fn main() -> std::process::ExitCode {
///     Node::builder("knee")
///         .configure(|config| config.ndl.interface = [10, 0, 0, 3].into()) // the default is loopback
///         .app(AppSpec::new("knee.drive", || Knee).requires(["hip"]))
///         .run() // until SIGINT or SIGTERM
/// }
/// ```
pub struct NodeBuilder {
    config: NodeConfig,
    tree: SupervisorSpec,
    incarnation: Option<Incarnation>,
    heed_signals: bool,
    accept_abort_on_panic: bool,
    /// Applications that are made of settings, when the node starts.
    configured: Vec<Configured>,
    /// What is wrong with the file that it is made from.
    file_faults: Vec<ConfigFault>,
    #[cfg(feature = "fault-points")]
    pub(super) faults: Vec<String>,
}

impl std::fmt::Debug for NodeBuilder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "NodeBuilder({}, {} applications)", self.config.name, self.tree.apps().len())
    }
}

/// Why a node does not run.
///
/// # Examples
///
/// ```no_run
/// use sinew::prelude::*;
///
/// match Node::from_file("/etc/sinew/knee.toml").start() {
///     Ok(node) => println!("the node has the address {}", node.address()),
///     Err(StartError::Config(faults)) => {
///         // All of them at once: an editor can jump to each line.
///         faults.faults().iter().for_each(|fault| eprintln!("{:?}: {fault}", fault.line));
///     }
///     Err(StartError::AddressTaken(words)) => eprintln!("is this node started twice? {words}"),
///     Err(other) => eprintln!("{other}"),
/// }
/// ```
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// The configuration has faults; all of them are listed.
    #[error(transparent)]
    Config(#[from] ConfigFaults),
    /// Two children of the node have the same name.
    #[error("two applications or supervisors of this node are called '{0}'; names are unique on a node")]
    SameName(String),
    /// The name of a child of the node breaks the grammar of [names](sinew_runtime::name).
    #[error("the application or supervisor '{name}' cannot have this name: {why}")]
    BadName {
        /// The name, its odd characters escaped.
        name: String,
        /// Which rule it breaks.
        why: NameError,
    },
    /// An application could not be registered.
    #[error("application '{name}' cannot be registered: {why}")]
    Application {
        /// Its name.
        name: String,
        /// Why.
        why: String,
    },
    /// `lncl.socket` cannot be had: another node has it, or the place cannot be written to. No layer was started.
    #[error("the door for applications of other processes cannot be opened: {0}")]
    Door(String),
    /// The configuration turns security on, and the node's keys cannot be used. Nothing was started.
    #[error("security.keys is set, and the node does not start without them:\n{0}")]
    Keys(#[from] KeyFault),
    /// The configuration names an access list, and it cannot be used. Nothing was started.
    #[error("security.access is set, and the node does not start without the list in {path:?}:\n{faults}")]
    Access {
        /// The file.
        path: PathBuf,
        /// All that is wrong with it.
        faults: ConfigFaults,
    },
    /// A layer did not become ready.
    #[error("the layers did not start: {0}")]
    Layers(String),
    /// Another living process has the node's address: the words say which one. Nothing is tried again.
    #[error("{0}")]
    AddressTaken(String),
    /// Applications require each other in a circle: none of them can be the first.
    ///
    /// The first one again at the end; of an application of another node with its node's name.
    #[error("these applications require each other in a circle, so that none of them can start: {}; take one of these requirements out", .0.join(" requires "))]
    Cycle(Vec<String>),
    /// Applications wait for each other, some because their supervisor starts them in order.
    #[error("these applications wait for each other in a circle, by the order of their start and by what they require: {}; change the order, or take a requirement out", .0.join(" -> "))]
    OrderCycle(Vec<String>),
    /// A child is significant and permanent.
    #[error("'{0}' is significant, but permanent: it never ends for good; make it transient or temporary")]
    PermanentSignificant(String),
    /// A child is significant for a supervisor that does not end with it.
    #[error(
        "'{child}' is significant, but its supervisor '{supervisor}' never ends with its children; set `auto_shutdown`"
    )]
    SignificantForNobody {
        /// The child.
        child: String,
        /// Its supervisor.
        supervisor: String,
    },
    /// Applications wait for what they require.
    #[error("after {within:?} these still wait:{}", list(.waiting))]
    Waiting {
        /// Who waits for whom.
        waiting: Vec<Waiting>,
        /// The time that was given.
        within: Duration,
    },
    /// The node ends, or has ended.
    #[error("the node ends, or has ended; `Node::wait_for_end` says how")]
    Ended,
    /// The node's root has more orders than it can keep. Nothing was asked.
    #[error("the node's root has more orders waiting than it can keep; ask again, and not so often")]
    Busy,
    /// A fault that was to strike on purpose cannot.
    #[cfg(feature = "fault-points")]
    #[error(transparent)]
    Fault(#[from] sinew_runtime::supervision::fault::FaultError),
    /// The program was built with `panic = "abort"`: its first panic ends the process, whatever supervisors there are.
    #[error(
        "this program ends with its first panic, and no supervisor can help: take `panic = \"abort\"` out of its Cargo \
         profile, or say `accept_abort_on_panic()` where that is what you want"
    )]
    AbortsOnPanic,
    /// An application is to have a process of its own, and the system lacks what watches one: the words say what is missing. Nothing was started.
    #[error("{0}")]
    OwnProcess(String),
    /// The operating system gives no thread.
    #[error("no thread for the node's root: {0}; {remedy}", remedy = remedy(Wanted::Thread, .0))]
    Thread(#[from] std::io::Error),
}

fn list(waiting: &[Waiting]) -> String {
    waiting.iter().map(|waiting| format!("\n  {waiting}")).collect()
}

impl NodeBuilder {
    pub(super) fn new(name: String) -> Self {
        Self {
            config: NodeConfig::new(name),
            tree: SupervisorSpec::new("applications"),
            incarnation: None,
            heed_signals: false,
            accept_abort_on_panic: false,
            configured: Vec::new(),
            file_faults: Vec::new(),
            #[cfg(feature = "fault-points")]
            faults: Vec::new(),
        }
    }

    pub(super) fn from_file(path: &Path) -> Self {
        let mut builder = Self::new(String::new());
        (builder.config, builder.file_faults) = NodeConfig::read_file(path);
        builder
    }

    /// Adds an application that is made of its settings: the table `[app.NAME]` of the node's file, read by serde. What is wrong with them is
    /// found by [`start`](Self::start), together with all else that is wrong with the configuration.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::prelude::*;
    ///
    /// #[derive(Clone, serde::Deserialize)]
    /// struct DriveSettings { kp: f64 }
    /// struct Drive(DriveSettings);
    /// impl Actor for Drive { type Context = AppContext<Self>; }
    ///
    /// fn main() -> std::process::ExitCode {
    ///     Node::from_file("knee.toml")
    ///         .configured_app("knee.drive", |settings: DriveSettings| {
    ///             AppSpec::new("knee.drive", move || Drive(settings.clone()))
    ///         })
    ///         .run()
    /// }
    /// ```
    #[must_use]
    pub fn configured_app<T: DeserializeOwned, A: Into<DynApp>>(
        mut self,
        name: impl Into<String>,
        make: impl FnOnce(T) -> A + Send + 'static,
    ) -> Self {
        let name = name.into();
        self.configured.push(Box::new(move |config| config.app(&name).map(|settings| make(settings).into())));
        self
    }

    /// Reads the settings of applications, and checks all of the configuration.
    fn check_config(&mut self) -> Result<(), ConfigFaults> {
        let mut faults = std::mem::take(&mut self.file_faults);
        let is_new =
            |faults: &[ConfigFault], fault: &ConfigFault| faults.iter().all(|other| other.key != fault.key);
        for found in self.config.validate().err().map(ConfigFaults::into_vec).unwrap_or_default() {
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
        faults.extend(self.config.unclaimed_settings());
        ConfigFaults::check(faults)
    }

    /// Replaces the whole configuration: one read from a file, for instance.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::prelude::*;
    ///
    /// let mut config = NodeConfig::from_file("/etc/sinew/knee.toml")?;
    /// config.project = "left-leg".to_owned();
    /// let node = Node::builder("").config(config).start()?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[must_use]
    pub fn config(mut self, config: NodeConfig) -> Self {
        self.config = config;
        self
    }

    /// Changes the configuration in place.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::prelude::*;
    ///
    /// let knee = Node::builder("knee").configure(|config| {
    ///     config.ndl.interface = [10, 0, 0, 3].into();
    ///     config.ndl.period = Duration::from_millis(100); // a loss is known after 400 ms
    ///     config.lncl.socket = Some("/run/sinew/knee.sock".into());
    /// });
    /// ```
    #[must_use]
    pub fn configure(mut self, change: impl FnOnce(&mut NodeConfig)) -> Self {
        change(&mut self.config);
        self
    }

    /// Sets the node's address. Needed where several nodes share a host.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::prelude::*;
    ///
    /// // Two nodes of one host, for a test of both.
    /// let thigh = Node::builder("thigh").address([127, 0, 0, 1]).start()?;
    /// let shank = Node::builder("shank").address([127, 0, 0, 2]).start()?;
    /// # Ok::<(), StartError>(())
    /// ```
    #[must_use]
    pub fn address(mut self, address: impl Into<NodeAddress>) -> Self {
        self.config.address = Some(address.into());
        self
    }

    /// Sets which life of the node this is, larger than any before it. Default: the wall clock in microseconds.
    #[must_use]
    pub const fn incarnation(mut self, incarnation: Incarnation) -> Self {
        self.incarnation = Some(incarnation);
        self
    }

    /// SIGINT, SIGTERM and SIGHUP stop the node in order ([`signals`](crate::signals)), from before its first application starts. For a process that is this
    /// node; what `run` does too, but only from when it is called.
    #[must_use]
    pub const fn heed_signals(mut self) -> Self {
        self.heed_signals = true;
        self
    }

    /// Starts even in a program that was built with `panic = "abort"`. Its first panic, in any actor, then ends the whole node
    /// at once: nothing is restarted, nobody is told, and what the outputs do is the devices' business.
    #[must_use]
    pub const fn accept_abort_on_panic(mut self) -> Self {
        self.accept_abort_on_panic = true;
        self
    }

    /// Starts the node and runs it until it ends: all that the `main` of a node's program has to do. Returns the exit
    /// code: 0 after an orderly stop, 1 if it did not start or gave up; the reason is logged and written to the standard
    /// error.
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
            Err(error) => {
                log::error!(%error, "the node did not start");
                log::print(error.to_string());
                log::flush(LAST_WORDS);
                ExitCode::FAILURE
            }
        }
    }

    /// Adds an application.
    #[must_use]
    pub fn app(mut self, app: impl Into<DynApp>) -> Self {
        self.tree = self.tree.app(app);
        self
    }

    /// Adds a supervisor with children of its own, beside the applications that are added here: to the node's own supervisor
    /// it is one child more.
    #[must_use]
    pub fn supervisor(mut self, spec: SupervisorSpec) -> Self {
        self.tree = self.tree.supervisor(spec);
        self
    }

    /// Whether the node stops, in order, when the significant ones of the children added here have done their work. Default:
    /// never.
    #[must_use]
    pub fn auto_shutdown(mut self, auto_shutdown: AutoShutdown) -> Self {
        self.tree = self.tree.auto_shutdown(auto_shutdown);
        self
    }

    /// Starts the node. Returns when its layers are ready; its applications start when what they require is ready.
    ///
    /// An application of the node that has a [process of its own](sinew_runtime::app::AppSpec::own_process) is this
    /// program, started again with the same arguments: there this function does not return but runs the application, and
    /// the builders of other nodes start nothing. What the program does before this line it does in that process too, so
    /// keep it short there, and do not read the standard input.
    ///
    /// # Errors
    /// The configuration has faults, or turns security on and the keys cannot be used; `lncl.socket` cannot be had, an application cannot be registered, a layer did not
    /// become ready, or another process was found by then that has the node's address. One that is found later ends the node in the same words.
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
        let planned = super::faults::read(&self.faults, &mut self.tree)?;
        let is_bystander = process::is_bystander(&self.config, &mut self.tree);
        let auto_shutdown = self.tree.flags.auto_shutdown;
        self.tree.flags = Flags { auto_shutdown, ..self.config.supervision.apps() };
        self.tree.check()?;
        let patience = self.config.sync.layer_deadline * 4;
        let incarnation = self.incarnation.unwrap_or_else(wall_clock);
        let secured = if is_bystander { None } else { Secured::load(&self.config, incarnation)? };
        let list = if is_bystander { None } else { closed::access_list(&self.config)? };
        let stores = Stores::new(self.config, incarnation);
        if !is_bystander {
            closed::secure(&stores, secured);
            closed::say_deaf(&stores.config);
            closed::guard(&stores, list);
        }
        #[cfg(feature = "fault-points")]
        super::faults::keep(&stores, &planned)?;
        #[cfg(not(feature = "fault-points"))]
        if std::env::var_os("SINEW_FAULTS").is_some() {
            log::warn!("SINEW_FAULTS is ignored: this program was built without the feature `fault-points`");
        }
        let handle = NodeHandle { root: stores.posts.root.clone(), stores: stores.clone(), is_bystander };
        let (say_started, started) = sync_channel(1);
        let (say_ended, ended) = sync_channel(1);
        if is_bystander {
            return Ok(Node { handle, ended, thread: None });
        }
        // Before any layer: one that cannot have it would fail again and again, with the same words.
        if self.tree.apps().iter().any(|app| app.place().own_process) {
            process::check_kernel().map_err(StartError::OwnProcess)?;
        }
        open_door(&stores)?;
        inspect::begin(&stores)?;
        let (tree, heed_signals) = (self.tree, self.heed_signals);
        if heed_signals && handle.root.post(RootEvent::HeedSignals).is_err() {
            return Err(StartError::Layers("the root's post is full before it was read".to_owned()));
        }
        let thread = std::thread::Builder::new()
            .name("root".to_owned())
            .spawn(move || root::run(stores, tree, say_started, say_ended))?;
        let node = Node { handle, ended, thread: Some(thread) };
        match started.recv_timeout(patience) {
            Ok(Ok(())) => {
                log_start(&node.handle);
                Ok(node)
            }
            // Dropping the node stops what has started.
            Ok(Err(error)) => Err(error),
            Err(_) => Err(StartError::Layers(format!("no word from the root in {patience:?}"))),
        }
    }
}

/// Says which node this is, and which of its applications wait.
fn log_start(handle: &NodeHandle) {
    let config = &handle.stores.config;
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

/// Opens the door for other processes, if there is to be one. LNCL serves it later.
fn open_door(stores: &Stores) -> Result<(), StartError> {
    let Some(path) = &stores.config.lncl.socket else { return Ok(()) };
    stores.open_door(path).map(drop).map_err(|why| StartError::Door(why.to_string()))
}

/// A number that grows from one start of a host's node to the next, as long as the host's clock does not go back.
#[expect(clippy::disallowed_methods, reason = "read once, at the start: a later life needs a larger number")]
fn wall_clock() -> Incarnation {
    let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    Incarnation(u64::try_from(since_1970.as_micros()).unwrap_or(u64::MAX))
}

/// Refuses a program that no supervisor can help, unless its owner wants it so.
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
    use super::*;

    #[test]
    fn a_program_that_aborts_on_panic_has_no_node_unless_that_is_accepted() {
        assert!(matches!(check_panics(false, false), Err(StartError::AbortsOnPanic)));
        assert!(check_panics(false, true).is_ok() && check_panics(true, false).is_ok());
    }

    #[test]
    fn a_node_that_is_to_be_secured_and_has_no_keys_does_not_start() {
        let secured = |config: &mut NodeConfig| config.security.keys = Some("/there/are/no/keys".into());
        let refused = Node::builder("hip").configure(secured).start();
        let words = refused.expect_err("there are no keys").to_string();
        assert!(words.contains("security.keys") && words.contains("/there/are/no/keys"), "{words}");
    }

    #[test]
    fn a_program_that_unwinds_is_known_as_one() {
        // Tests are always built so; a program with `panic = "abort"` was tried by hand (docs/decisions/0011).
        const { assert!(UNWINDS) };
    }
}
