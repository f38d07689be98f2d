//! Queries a running node and stops it, from any thread.

mod reload;

use std::{
    net::SocketAddr,
    sync::{Arc, mpsc::RecvTimeoutError},
    time::Duration,
};

use sinew_model::{
    barrier::BarrierStatus,
    directory::{DirectoryEntry, Waiting},
};
use sinew_ndl::{KnownNode, OwnStalls};
use sinew_runtime::{
    event_queue::EventQueue,
    lock, log,
    outcome::Rejection,
    sender::Directory as _,
    tid::{Incarnation, NodeAddress, Tid},
    time::Time,
};

use super::{NodeState, RootEvent, StartError, directory, reply_waiters::ReplySender};

/// The result of an order to the root.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum OrderStatus {
    /// The order will be executed, unless the node ends before.
    Queued,
    /// The order queue is full; the order was dropped, which is logged.
    QueueFull,
    /// The node has ended.
    NodeEnded,
}

/// Queries a running node and stops it, from any thread.
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
    pub(super) state: Arc<NodeState>,
    pub(super) root: EventQueue<RootEvent>,
    /// There is no node: this process hosts an application of another one.
    pub(super) hosts_other_node: bool,
}

impl std::fmt::Debug for NodeHandle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "NodeHandle({} {})", self.state.ctx.config.name, self.state.ctx.node)
    }
}

impl NodeHandle {
    /// Returns a handle of the node with this state.
    pub(crate) fn of(state: Arc<NodeState>) -> Self {
        Self { root: state.root.clone(), state, hosts_other_node: false }
    }

    /// Returns the node's address.
    #[must_use]
    pub fn address(&self) -> NodeAddress {
        self.state.ctx.node
    }

    /// Returns the node's incarnation.
    #[must_use]
    pub fn incarnation(&self) -> Incarnation {
        self.state.ctx.incarnation
    }

    /// Returns the TID of the application that has `name` now, on any node.
    #[must_use]
    pub fn resolve(&self, name: &str) -> Option<Tid> {
        directory::NodeDirectory(self.state.clone()).resolve(name)
    }

    /// Returns the applications that wait at the start-up barrier on this node, their missing requirements,
    /// and since when.
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
        lock(&self.state.sync.core).waiting(Time::now())
    }

    /// Returns the run-time barriers at which applications of this node wait, and the missing parties of each.
    #[must_use]
    pub fn barriers(&self) -> Vec<BarrierStatus> {
        lock(&self.state.sync.core).barriers(Time::now())
    }

    /// Returns the known nodes, as seen by this node's NDL, in the order of their addresses.
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
        lock(&self.state.ndl.core).members(Time::now())
    }

    /// Returns how often this node's own NDL got no CPU, so that it counted no node as silent and detected
    /// losses later.
    #[must_use]
    pub fn own_stalls(&self) -> OwnStalls {
        lock(&self.state.ndl.core).own_stalls()
    }

    /// Returns every application that has a name, on any known node.
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
        lock(&self.state.sync.core).directory()
    }

    /// Returns the address at which GNCL listens, once it does.
    #[must_use]
    pub fn gncl_address(&self) -> Option<SocketAddr> {
        self.state.ctx.listens.first.get().copied()
    }

    /// Returns the address at which NDL accepts queries and answers, once it does.
    #[must_use]
    pub fn ndl_address(&self) -> Option<SocketAddr> {
        lock(&self.state.ndl.core).paths().first().copied()
    }

    /// Returns how often an input from outside was refused, or a message had no receiver.
    #[must_use]
    pub fn refused(&self) -> u64 {
        let NodeState { ctx, gncl, ndl, .. } = &*self.state;
        // The refusals include those of the access list already, also those for which the router has no
        // reason, such as one of many receivers.
        let undelivered =
            ctx.router.refused_because().into_iter().filter(|(why, _)| *why != Rejection::NotAllowed);
        let undelivered: u64 = undelivered.map(|(_, count)| count).sum();
        ctx.refusals.total() + gncl.store.refusals.total() + lock(&ndl.core).refusals().total() + undelivered
    }

    /// Orders the node to stop; returns at once.
    pub fn stop(&self) {
        // A node that has ended is stopped.
        let _ = self.send_to_root(RootEvent::StopOrdered);
    }

    /// Waits until every application of this node runs.
    ///
    /// # Errors
    /// The applications that are not ready after `within`, with their missing requirements or the reason why
    /// their starts fail; or the node ends, or accepts no order.
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
        if self.hosts_other_node {
            return Ok(());
        }
        let (sender, reply) = ReplySender::new();
        match self.send_to_root(RootEvent::NotifyWhenRunning(sender)) {
            OrderStatus::Queued => {}
            OrderStatus::QueueFull => return Err(StartError::Busy),
            OrderStatus::NodeEnded => return Err(StartError::Ended),
        }
        match reply.receiver.recv_timeout(within) {
            Ok(answer) => answer,
            Err(RecvTimeoutError::Disconnected) => Err(StartError::Ended),
            Err(RecvTimeoutError::Timeout) => {
                Err(StartError::Waiting { waiting: self.waiting(), starting: self.starting(), within })
            }
        }
    }

    pub(super) fn send_to_root(&self, event: RootEvent) -> OrderStatus {
        match self.root.post(event) {
            Ok(()) => OrderStatus::Queued,
            Err(_) if self.root.is_closed() => OrderStatus::NodeEnded,
            Err(_) => {
                log::error!(
                    node = self.state.ctx.config.name,
                    "the root's event queue is full: the order was dropped"
                );
                OrderStatus::QueueFull
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use actix::Actor;
    use sinew_runtime::app::{AppContext, AppSpec};

    use sinew_model::{config::NodeConfig, events::LayerReport};

    use super::*;
    use crate::{Node, NodeEnd};

    struct Idle;

    impl Actor for Idle {
        type Context = AppContext<Self>;
    }

    #[test]
    fn address_conflict_ends_node_and_waiters_with_reason() {
        // Given: a node with an application that waits for another one
        let alone = |config: &mut NodeConfig| (config.ndl.multicast, config.ndl.mdns_port) = (None, None);
        let waits = AppSpec::new("waits", || Idle).requires(["nobody"]);
        let node = Node::builder("knee").address([127, 0, 0, 77]).configure(alone).app(waits);
        let node = node.start().expect("its layers start");
        let (sender, reply) = ReplySender::new();
        let asked = node.handle.send_to_root(RootEvent::NotifyWhenRunning(sender));
        assert_eq!(asked, OrderStatus::Queued);
        // When
        let words = "it is used already by 'hip'".to_owned();
        assert_eq!(
            node.handle.send_to_root(RootEvent::Layer(LayerReport::AddressTaken(words.clone()))),
            OrderStatus::Queued
        );
        // Then
        let answer = reply.receiver.recv_timeout(Duration::from_secs(60)).expect("it is answered");
        assert!(matches!(answer, Err(StartError::AddressTaken(why)) if why == words));
        assert_eq!(node.wait_for_end(), NodeEnd::GaveUp(words));
    }

    #[test]
    fn busy_root_is_reported_as_such() {
        // Given: a root that never handles its requests
        let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
        let handle = NodeHandle { root: state.root.clone(), state, hosts_other_node: false };
        let short = Duration::from_millis(1);
        assert!(matches!(handle.wait_until_running(short), Err(StartError::Waiting { .. })));
        while handle.send_to_root(RootEvent::HeedSignals) == OrderStatus::Queued {}
        // When, then
        assert!(matches!(handle.wait_until_running(short), Err(StartError::Busy)));
        drop(handle.root.close());
        assert!(matches!(handle.wait_until_running(short), Err(StartError::Ended)));
    }
}
