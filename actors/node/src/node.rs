//! A running node: its owner waits for its end or stops it.

use std::{path::Path, process::ExitCode, sync::mpsc::Receiver, time::Duration};

use sinew_runtime::{log, tid::NodeAddress};

use super::{NodeBuilder, NodeHandle, RootEvent, play_check};

/// Time limit at the node's end for writing its log.
pub(super) const LAST_WORDS: Duration = Duration::from_millis(500);

/// How a node ended.
///
/// # Examples
///
/// ```no_run
/// use sinew::{node::NodeEnd, prelude::*};
///
/// let node = Node::builder("knee").start()?;
/// match node.wait_for_end() {
///     NodeEnd::Stopped => println!("stopped in order"),
///     NodeEnd::GaveUp(why) => eprintln!("the node gave up: {why}"),
/// }
/// # Ok::<(), StartError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NodeEnd {
    /// It was stopped by its owner or by a signal.
    Stopped,
    /// It gave up, for this reason.
    GaveUp(String),
}

/// A running node. Dropping it stops it; dropped by a panic, it gives up.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Hip;
/// # impl Actor for Hip { type Context = AppContext<Self>; }
///
/// # let alone = |config: &mut NodeConfig| (config.ndl.multicast, config.ndl.mdns_port) = (None, None);
/// let node = Node::builder("thigh").app(AppSpec::new("hip", || Hip))
/// #   .configure(|config| { alone(config); })
///     .start()?;
/// node.handle().wait_until_running(Duration::from_secs(10))?;
/// assert!(node.handle().resolve("hip").is_some());
/// node.stop();
/// # Ok::<(), StartError>(())
/// ```
#[derive(Debug)]
pub struct Node {
    pub(super) handle: NodeHandle,
    pub(super) ended: Receiver<NodeEnd>,
    pub(super) thread: Option<std::thread::JoinHandle<()>>,
}

impl Node {
    /// Starts the declaration of a node called `name`.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::Node;
    ///
    /// let node = Node::builder("knee").start()?;
    /// println!("{}", node.address());
    /// # Ok::<(), sinew::StartError>(())
    /// ```
    #[must_use]
    pub fn builder(name: impl Into<String>) -> NodeBuilder {
        NodeBuilder::new(name.into())
    }

    /// Returns a builder with the configuration of the TOML file at `path`. [`NodeBuilder::start`] reports
    /// the faults of the file, together with all other faults.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::Node;
    ///
    /// let node = Node::from_file("/etc/sinew/knee.toml").start()?;
    /// # Ok::<(), sinew::StartError>(())
    /// ```
    #[must_use]
    pub fn from_file(path: impl AsRef<Path>) -> NodeBuilder {
        NodeBuilder::from_file(path.as_ref())
    }

    /// Returns a handle to query and stop the node, from any thread.
    #[must_use]
    pub fn handle(&self) -> NodeHandle {
        self.handle.clone()
    }

    /// Returns the node's address.
    #[must_use]
    pub fn address(&self) -> NodeAddress {
        self.handle.address()
    }

    /// Stops the node: applications are notified, and layers stop in reverse order. Returns when all have
    /// ended or were abandoned, each after its own deadline.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::{Node, node::NodeEnd};
    ///
    /// let node = Node::builder("knee").start()?;
    /// assert_eq!(node.stop(), NodeEnd::Stopped);
    /// # Ok::<(), sinew::StartError>(())
    /// ```
    pub fn stop(mut self) -> NodeEnd {
        self.handle.stop();
        self.wait()
    }

    /// Waits until the node ends or is stopped through a handle. Returns how it ended.
    pub fn wait_for_end(mut self) -> NodeEnd {
        self.wait()
    }

    /// Runs until SIGINT, SIGTERM or SIGHUP ([`signals`](crate::signals)), or until the node gives up; then
    /// stops in order. Returns the exit code for `main`: 0 after an orderly stop, 1 after giving up.
    ///
    /// If systemd has started the process, it is notified that the node is ready, makes progress, or stops
    /// (`Type=notify`, `WatchdogSec=`).
    pub fn run(mut self) -> ExitCode {
        if self.handle.hosts_other_node {
            if play_check::is_asked() {
                // The recording has no application of this program, which the command reports.
                return ExitCode::FAILURE;
            }
            wait_for_ever();
        }
        let _ = self.handle.send_to_root(RootEvent::HeedSignals);
        let _ = self.handle.send_to_root(RootEvent::RunsAlone);
        match self.wait() {
            NodeEnd::Stopped => ExitCode::SUCCESS,
            NodeEnd::GaveUp(why) => {
                let name = &self.handle.state.ctx.config.name;
                log::error!(node = name, why, "the node gave up");
                log::print(format!("node {name} gave up: {why}"));
                log::flush(LAST_WORDS);
                ExitCode::FAILURE
            }
        }
    }

    fn wait(&mut self) -> NodeEnd {
        if self.handle.hosts_other_node {
            return NodeEnd::Stopped;
        }
        let lost = || NodeEnd::GaveUp("the root's thread ended without a word".to_owned());
        let end = self.ended.recv().unwrap_or_else(|_| lost());
        if let Some(thread) = self.thread.take() {
            // It has sent its last answer; only the end of its function is left.
            let _ = thread.join();
        }
        log::flush(LAST_WORDS);
        end
    }
}

/// Another builder of this program hosts an application; the process ends with it.
fn wait_for_ever() -> ! {
    loop {
        std::thread::park();
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        if self.thread.is_some() {
            if std::thread::panicking() {
                // Peers must not take this for an orderly stop.
                let _ = self.handle.send_to_root(RootEvent::OwnerPanicked);
            } else {
                self.handle.stop();
            }
            self.wait();
        }
    }
}
