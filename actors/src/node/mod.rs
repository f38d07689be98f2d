//! The root of a node: starts its layers in order, then its applications, and stops all of it again.
//!
//! ```text
//! root thread   Root (actix actor)
//!                 |- layers: rest-for-one   LNCL, sync manager, GNCL, NDL   (the paper's order)
//!                 `- applications: one-for-one, each held until what it requires is ready
//!                      |- supervisors that the user declares, with applications and supervisors below them
//!                      `- applications
//! ```
//!
//! Stop runs backwards: applications are told first and may bring their outputs to a safe value, then the layers go.

mod absences;
mod apps;
mod asker;
mod audits;
mod builder;
mod closed;
mod commands;
mod directory;
#[cfg(feature = "fault-points")]
mod faults;
mod layers;
#[cfg(test)]
mod log_tests;
mod places;
mod progress;
mod root;
mod supervisor_spec;
mod tree;
mod wind_up;

pub use crate::{
    access::{AccessError, AccessSummary},
    lncl::RegisterError,
    outlet::OutletCounts,
    secured::{DenyListError, DenyListSummary},
};
use asker::Asker;
pub use audits::AuditError;
pub use builder::{NodeBuilder, StartError};
pub use commands::CommandError;
#[cfg(feature = "fault-points")]
pub(crate) use faults::arm_alone;
pub(crate) use progress::Stalls;
pub(crate) use root::{RootEvent, WAITS_MAX};
pub use supervisor_spec::SupervisorSpec;
pub use tree::{LifeState, MailboxState, Supervised, Supervises, SupervisionTree};

use std::{
    net::SocketAddr,
    path::Path,
    process::ExitCode,
    sync::{
        Arc,
        mpsc::{Receiver, RecvTimeoutError},
    },
    time::Duration,
};

use sinew_runtime::{
    outcome::Rejection,
    post::Post,
    sender::Directory,
    tid::{Incarnation, NodeAddress, Tid},
    time::Time,
};

use crate::{
    gncl::{self, Peer},
    log,
    ndl::{KnownNode, OwnStalls},
    secured::Denied,
    stores::{Stores, lock},
    sync::{BarrierStatus, DirectoryEntry, Waiting},
};

/// What is logged of the faults of a list, in characters: whoever asks for it to be read gets all of them.
const LOGGED_MAX: usize = 1_024;
/// Time at its end for what the node has logged to be written.
const LAST_WORDS: Duration = Duration::from_millis(500);

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
    /// It was told to stop, by its owner or by a signal.
    Stopped,
    /// It gave up; why.
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
    handle: NodeHandle,
    ended: Receiver<NodeEnd>,
    thread: Option<std::thread::JoinHandle<()>>,
}

/// What became of the messages to another node, from the link with its present life on. Nothing leaks: submitted =
/// sent + superseded + expired + lost + refused + waiting.
///
/// # Examples
///
/// ```no_run
/// use sinew::{NodeHandle, node::Traffic};
///
/// /// The nodes to which messages were lost.
/// fn with_losses(handle: &NodeHandle) -> Vec<Traffic> {
///     handle.traffic().into_iter().filter(|traffic| traffic.counts.lost > 0).collect()
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Traffic {
    /// The other node.
    pub node: NodeAddress,
    /// What became of them.
    pub counts: OutletCounts,
    /// Those that wait to be sent.
    pub waiting: usize,
    /// Confirmed ones whose outcome is not known yet.
    pub unconfirmed: usize,
}

/// What became of an order to the root.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Told {
    /// It will be read, unless the node ends before.
    Taken,
    /// So many wait already; the order was not given, which is logged.
    TooMany,
    /// The node has ended.
    HasEnded,
}

/// Asks about a running node and stops it, from any thread.
///
/// # Examples
///
/// ```
/// use sinew::NodeHandle;
///
/// /// A line for the operator's display.
/// fn status(handle: &NodeHandle) -> String {
///     match handle.waiting().first() {
///         Some(waiting) => waiting.to_string(), // as "hip has waited 3.1 s for knee (not there; ...)"
///         None => format!("{} nodes are there", handle.members().len()),
///     }
/// }
/// ```
#[derive(Clone)]
pub struct NodeHandle {
    stores: Arc<Stores>,
    root: Post<RootEvent>,
    /// There is no node: this process hosts an application of another one.
    is_bystander: bool,
}

impl std::fmt::Debug for NodeHandle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "NodeHandle({} {})", self.stores.config.name, self.stores.node)
    }
}

impl Node {
    /// Begins the declaration of a node called `name`.
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

    /// Returns a builder with the configuration of the TOML file at `path`. [`NodeBuilder::start`] reports the faults of the file, together
    /// with all other faults.
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

    /// Asks and stops, from any thread.
    #[must_use]
    pub fn handle(&self) -> NodeHandle {
        self.handle.clone()
    }

    /// The node's address.
    #[must_use]
    pub fn address(&self) -> NodeAddress {
        self.handle.address()
    }

    /// Stops the node: applications are told, layers go down in reverse order. Returns when all have ended or were
    /// abandoned, each after its own deadline.
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

    /// Waits until the node ends by itself or is stopped through a handle; returns how it ended.
    pub fn wait_for_end(mut self) -> NodeEnd {
        self.wait()
    }

    /// Runs until SIGINT, SIGTERM or SIGHUP ([`signals`](crate::signals)), or until the node gives up; then stops in order. Returns the exit code for `main`:
    /// 0 after an orderly stop, 1 after giving up.
    pub fn run(mut self) -> ExitCode {
        if self.handle.is_bystander {
            wait_for_ever();
        }
        let _ = self.handle.tell(RootEvent::HeedSignals);
        let _ = self.handle.tell(RootEvent::RunsAlone);
        match self.wait() {
            NodeEnd::Stopped => ExitCode::SUCCESS,
            NodeEnd::GaveUp(why) => {
                let name = &self.handle.stores.config.name;
                log::error!(node = name, why, "the node gave up");
                log::print(format!("node {name} gave up: {why}"));
                log::flush(LAST_WORDS);
                ExitCode::FAILURE
            }
        }
    }

    fn wait(&mut self) -> NodeEnd {
        if self.handle.is_bystander {
            return NodeEnd::Stopped;
        }
        let lost = || NodeEnd::GaveUp("the root's thread ended without a word".to_owned());
        let end = self.ended.recv().unwrap_or_else(|_| lost());
        if let Some(thread) = self.thread.take() {
            // It has said its last word; what is left of it is the end of its function.
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
                let _ = self.handle.tell(RootEvent::OwnerPanicked);
            } else {
                self.handle.stop();
            }
            self.wait();
        }
    }
}

impl NodeHandle {
    /// A handle of the node that has these stores.
    pub(crate) fn of(stores: Arc<Stores>) -> Self {
        Self { root: stores.posts.root.clone(), stores, is_bystander: false }
    }

    /// The node's address.
    #[must_use]
    pub fn address(&self) -> NodeAddress {
        self.stores.node
    }

    /// Which life of the node this is.
    #[must_use]
    pub fn incarnation(&self) -> Incarnation {
        self.stores.incarnation
    }

    /// The TID that has `name` now, on any node.
    #[must_use]
    pub fn resolve(&self, name: &str) -> Option<Tid> {
        directory::NodeDirectory(self.stores.clone()).resolve(name)
    }

    /// Who waits at the start-up barrier on this node, for whom, and since when.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::NodeHandle;
    ///
    /// /// Shows which applications wait, and for which others.
    /// fn explain(handle: &NodeHandle) {
    ///     handle.waiting().iter().for_each(|waiting| println!("{waiting}"));
    /// }
    /// ```
    #[must_use]
    pub fn waiting(&self) -> Vec<Waiting> {
        lock(&self.stores.sync).waiting(Time::now())
    }

    /// The run-time barriers at which applications of this node wait, and who is missing at each.
    #[must_use]
    pub fn barriers(&self) -> Vec<BarrierStatus> {
        lock(&self.stores.sync).barriers(Time::now())
    }

    /// The nodes that are there, as this node's NDL sees them, in the order of their addresses.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::NodeHandle;
    ///
    /// fn show_clocks(handle: &NodeHandle) {
    ///     for node in handle.members() {
    ///         let clock = node.offset.map(|offset| (offset.theirs_minus_ours_ns, offset.bound));
    ///         println!("{} at {}: clock {clock:?}", node.name, node.node);
    ///     }
    /// }
    /// ```
    #[must_use]
    pub fn members(&self) -> Vec<KnownNode> {
        lock(&self.stores.ndl).members(Time::now())
    }

    /// How often this node's own NDL got no processor, so that it counted nobody as silent and told losses later.
    #[must_use]
    pub fn own_stalls(&self) -> OwnStalls {
        lock(&self.stores.ndl).own_stalls()
    }

    /// Every application that has a name, on any node that is known.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::NodeHandle;
    ///
    /// /// The drives of the robot that are ready.
    /// fn drives(handle: &NodeHandle) -> Vec<String> {
    ///     let ready = handle.directory().into_iter().filter(|entry| entry.ready);
    ///     ready.map(|entry| entry.name).filter(|name| name.ends_with(".drive")).collect()
    /// }
    /// ```
    #[must_use]
    pub fn directory(&self) -> Vec<DirectoryEntry> {
        lock(&self.stores.sync).directory()
    }

    /// What became of the messages to each node that is linked or expected back.
    #[must_use]
    pub fn traffic(&self) -> Vec<Traffic> {
        let traffic = |peer: Arc<Peer>| Traffic {
            node: peer.node,
            counts: peer.counts(),
            waiting: peer.waiting(),
            unconfirmed: peer.unconfirmed(),
        };
        self.stores.gncl.peers().into_iter().map(traffic).collect()
    }

    /// Where GNCL listens, once it does.
    #[must_use]
    pub fn gncl_address(&self) -> Option<SocketAddr> {
        self.stores.gncl_listen.get().copied()
    }

    /// Where NDL takes queries and answers, once it does.
    #[must_use]
    pub fn ndl_address(&self) -> Option<SocketAddr> {
        lock(&self.stores.ndl).paths().first().copied()
    }

    /// How often something that came from outside was refused, or a message was taken by nobody.
    #[must_use]
    pub fn refused(&self) -> u64 {
        let Stores { refusals, gncl, router, ndl, .. } = &*self.stores;
        // What the access list refuses stands among the refusals already, also what the router has no reason for: one of many.
        let not_taken = router.refused_because().into_iter().filter(|(why, _)| *why != Rejection::NotAllowed);
        let not_taken: u64 = not_taken.map(|(_, count)| count).sum();
        refusals.total() + gncl.refusals.total() + lock(ndl).refusals().total() + not_taken
    }

    /// Reads the node's access list again and puts it in force: for every message that is delivered from now on, for every application of
    /// another process that registers from now on. What has reached an application's mailbox, and who is registered, stays.
    ///
    /// # Errors
    /// The node was started without a list, or the file cannot be used: the list in force stays, which is logged too.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::NodeHandle;
    ///
    /// fn reload(handle: &NodeHandle) {
    ///     match handle.reload_access() {
    ///         Ok(list) => println!("{} rules are in force", list.rules),
    ///         Err(why) => eprintln!("the former list stays in force: {why}"),
    ///     }
    /// }
    /// ```
    pub fn reload_access(&self) -> Result<AccessSummary, AccessError> {
        let access = self.stores.access.get().ok_or(AccessError::None)?;
        let read = access.reload();
        match &read {
            Ok(AccessSummary { rules, clients }) => {
                log::info!(rules, clients, "another access list is in force");
                closed::say_without_groups(access);
            }
            Err(why) => {
                let why: String = why.to_string().chars().take(LOGGED_MAX).collect();
                log::error!(why, "the access list was not replaced");
            }
        }
        read
    }

    /// Reads the node's deny list again and puts it in force: connections that stand with nodes whose certificates are on it end, in words,
    /// and none is made. Such a node is lost when it is silent; what is sent to it waits, and expires.
    ///
    /// Blocks: a file of up to 8 MiB is read and looked through on the caller's thread, which is to be none that a control loop or an actor
    /// runs on. Whoever else has the list read waits for that long.
    ///
    /// # Errors
    /// The node was started without keys, the file cannot be used, or there is more to do: each says what is in force. It is logged too.
    pub fn reload_deny_list(&self) -> Result<DenyListSummary, DenyListError> {
        let secured = self.stores.secured.get().ok_or(DenyListError::None)?;
        let read =
            secured.reload_deny_list().map_err(DenyListError::from).and_then(|Denied { summary, own }| {
                // After the list is in force: who comes meanwhile is judged by it.
                let told = self.stores.posts.gncl.post(gncl::Event::DenyListChanged);
                told.map_err(|_| DenyListError::NotTold { summary })?;
                own.map_or(Ok(summary), |serial| Err(DenyListError::Own { serial, summary }))
            });
        match &read {
            Ok(DenyListSummary { denied, readmitted }) => {
                log::info!(denied, readmitted, "another deny list is in force")
            }
            Err(why) => {
                let why: String = why.to_string().chars().take(LOGGED_MAX).collect();
                log::error!(why, "the deny list was read again");
            }
        }
        read
    }

    /// Tells the node to stop; returns at once.
    pub fn stop(&self) {
        // One that has ended is stopped.
        let _ = self.tell(RootEvent::StopOrdered);
    }

    /// Waits until every application of this node runs.
    ///
    /// # Errors
    /// Who still waits after `within`, and for whom; or that the node ends, or takes no order.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::prelude::*;
    ///
    /// let node = Node::from_file("/etc/sinew/knee.toml").start()?;
    /// if let Err(StartError::Waiting { waiting, .. }) = node.handle().wait_until_running(Duration::from_secs(10)) {
    ///     waiting.iter().for_each(|waiting| eprintln!("{waiting}"));
    /// }
    /// # Ok::<(), StartError>(())
    /// ```
    pub fn wait_until_running(&self, within: Duration) -> Result<(), StartError> {
        if self.is_bystander {
            return Ok(());
        }
        let (asker, question) = Asker::new();
        match self.tell(RootEvent::TellWhenRunning(asker)) {
            Told::Taken => {}
            Told::TooMany => return Err(StartError::Busy),
            Told::HasEnded => return Err(StartError::Ended),
        }
        match question.heard.recv_timeout(within) {
            Ok(answer) => answer,
            Err(RecvTimeoutError::Disconnected) => Err(StartError::Ended),
            Err(RecvTimeoutError::Timeout) => Err(StartError::Waiting { waiting: self.waiting(), within }),
        }
    }

    fn tell(&self, event: RootEvent) -> Told {
        match self.root.post(event) {
            Ok(()) => Told::Taken,
            Err(_) if self.root.is_closed() => Told::HasEnded,
            Err(_) => {
                log::error!(
                    node = self.stores.config.name,
                    "the root's post is full; the order was not given"
                );
                Told::TooMany
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use actix::Actor;
    use sinew_runtime::app::{AppContext, AppSpec};

    use super::*;
    use crate::config::NodeConfig;

    struct Idle;

    impl Actor for Idle {
        type Context = AppContext<Self>;
    }

    #[test]
    fn a_node_whose_address_is_taken_ends_in_these_words_and_so_hears_who_waits_for_its_applications() {
        // Given: a node with an application that waits for another one
        let alone = |config: &mut NodeConfig| (config.ndl.multicast, config.ndl.mdns_port) = (None, None);
        let waits = AppSpec::new("waits", || Idle).requires(["nobody"]);
        let node = Node::builder("knee").address([127, 0, 0, 77]).configure(alone).app(waits);
        let node = node.start().expect("its layers start");
        let (asker, question) = Asker::new();
        let asked = node.handle.tell(RootEvent::TellWhenRunning(asker));
        assert_eq!(asked, Told::Taken);
        // When
        let words = "it is used already by 'hip'".to_owned();
        assert_eq!(node.handle.tell(RootEvent::AddressTaken(words.clone())), Told::Taken);
        // Then
        let heard = question.heard.recv_timeout(Duration::from_secs(60)).expect("it is answered");
        assert!(matches!(heard, Err(StartError::AddressTaken(said)) if said == words));
        assert_eq!(node.wait_for_end(), NodeEnd::GaveUp(words));
    }

    #[test]
    fn who_asks_a_root_that_takes_no_more_orders_is_told_so_and_not_that_nobody_waits() {
        // Given: a root that never comes to its orders
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let handle = NodeHandle { root: stores.posts.root.clone(), stores, is_bystander: false };
        let short = Duration::from_millis(1);
        assert!(matches!(handle.wait_until_running(short), Err(StartError::Waiting { .. })));
        while handle.tell(RootEvent::HeedSignals) == Told::Taken {}
        // When, then
        assert!(matches!(handle.wait_until_running(short), Err(StartError::Busy)));
        drop(handle.root.close());
        assert!(matches!(handle.wait_until_running(short), Err(StartError::Ended)));
    }
}
