//! Declares a node: its configuration and its applications.

mod start;
mod start_error;

use std::{fmt, path::Path};

use serde::de::DeserializeOwned;
use sinew_model::config::{ConfigError, ConfigFault, NodeConfig};
use sinew_runtime::{
    app::DynApp,
    supervision::AutoShutdown,
    tid::{Incarnation, NodeAddress},
};

use super::supervisor_spec::SupervisorSpec;
pub use start_error::StartError;

/// Creates an application from its settings.
type Configured = Box<dyn FnOnce(&NodeConfig) -> Result<DynApp, ConfigError> + Send>;

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
    writes_recording: bool,
    /// Applications that are created from settings when the node starts.
    configured: Vec<Configured>,
    /// The faults of the configuration file.
    file_faults: Vec<ConfigFault>,
    #[cfg(feature = "fault-points")]
    pub(super) faults: Vec<String>,
}

impl fmt::Debug for NodeBuilder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "NodeBuilder({}, {} applications)", self.config.name, self.tree.apps().len())
    }
}

impl NodeBuilder {
    pub(super) fn new(name: String) -> Self {
        Self {
            config: NodeConfig::new(name),
            tree: SupervisorSpec::new("applications"),
            incarnation: None,
            heed_signals: false,
            accept_abort_on_panic: false,
            writes_recording: false,
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

    /// Adds an application that is created from its settings: the table `[app.NAME]` of the node's file, read
    /// by serde. [`start`](Self::start) reports the faults of the settings, together with all other faults of
    /// the configuration.
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

    /// Replaces the whole configuration, for example by one read from a file.
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

    /// Sets the incarnation of the node, larger than any before it. Default: the wall clock in microseconds.
    #[must_use]
    pub const fn incarnation(mut self, incarnation: Incarnation) -> Self {
        self.incarnation = Some(incarnation);
        self
    }

    /// Makes SIGINT, SIGTERM and SIGHUP stop the node in order ([`signals`](crate::signals)), from before its
    /// first application starts. For a process that runs only this node. `run` does this too, but only from
    /// its call on.
    #[must_use]
    pub const fn heed_signals(mut self) -> Self {
        self.heed_signals = true;
        self
    }

    /// Allows a program that was built with `panic = "abort"`. Its first panic, in any actor, then ends the
    /// whole node at once: nothing is restarted, peers are not notified, and the devices alone determine the
    /// outputs.
    #[must_use]
    pub const fn accept_abort_on_panic(mut self) -> Self {
        self.accept_abort_on_panic = true;
        self
    }

    /// Adds an application.
    #[must_use]
    pub fn app(mut self, app: impl Into<DynApp>) -> Self {
        self.tree = self.tree.app(app);
        self
    }

    /// Adds a supervisor with children of its own, next to the applications that are added here: for the
    /// node's own supervisor it is one more child.
    #[must_use]
    pub fn supervisor(mut self, spec: SupervisorSpec) -> Self {
        self.tree = self.tree.supervisor(spec);
        self
    }

    /// States that this program writes the file of `record.file`, by `sinew_recorder::Recording::configured` after the
    /// start. Otherwise a node with this key does not start: it would record into no file.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::Node;
    ///
    /// let node = Node::from_file("/etc/sinew/knee.toml").writes_recording().start()?;
    /// // let recording = sinew_recorder::Recording::configured(&config)?;
    /// # Ok::<(), sinew::StartError>(())
    /// ```
    #[must_use]
    pub const fn writes_recording(mut self) -> Self {
        self.writes_recording = true;
        self
    }

    /// Sets whether the node stops, in order, when the significant children added here have finished. Default: never.
    #[must_use]
    pub fn auto_shutdown(mut self, auto_shutdown: AutoShutdown) -> Self {
        self.tree = self.tree.auto_shutdown(auto_shutdown);
        self
    }
}
