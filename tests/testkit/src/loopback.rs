//! The network of one scenario: loopback addresses for its nodes, and a multicast group of its own.

use std::{
    net::SocketAddrV4,
    sync::atomic::{AtomicU8, Ordering},
};

use sinew::{NodeHandle, prelude::*};

use crate::{DEADLINE, own_group, until};

/// A network of one scenario.
#[derive(Debug)]
pub struct Loopback {
    /// The multicast group for discovery.
    pub group: SocketAddrV4,
    addresses: AtomicU8,
}

impl Default for Loopback {
    fn default() -> Self {
        Self::new()
    }
}

impl Loopback {
    /// An empty network. `RUST_LOG=sinew=debug` shows the log of its nodes.
    #[must_use]
    pub fn new() -> Self {
        if std::env::var_os("RUST_LOG").is_some() {
            let filter = tracing_subscriber::EnvFilter::from_default_env();
            // Another scenario of this process may have installed it.
            let _ = tracing_subscriber::fmt().with_env_filter(filter).with_test_writer().try_init();
        }
        Self { group: own_group(), addresses: AtomicU8::new(1) }
    }

    /// A node with the next free address, 127.0.0.1 first.
    #[must_use]
    pub fn node(&self, name: &str) -> NodeBuilder {
        let address = self.addresses.fetch_add(1, Ordering::Relaxed);
        Node::builder(name).address([127, 0, 0, address]).configure(|config| {
            config.ndl.multicast = Some(self.group);
            config.ndl.mdns_port = None;
            config.rt.probe = Duration::ZERO;
        })
    }
}

/// Waits until every application of these nodes runs.
///
/// # Panics
/// If one does not run in time; the message lists the unmet requirements.
#[track_caller]
pub fn all_run(nodes: &[&Node]) {
    for node in nodes {
        if let Err(error) = node.handle().wait_until_running(DEADLINE) {
            panic!("{node:?}: {error}");
        }
    }
}

/// Waits until `node` sees `other` as a member.
#[track_caller]
pub fn sees(node: &NodeHandle, other: NodeAddress) {
    until(&format!("{node:?} sees {other}"), || {
        node.members().iter().any(|member| member.node == other).then_some(())
    });
}

/// Waits until the actor called `name` has become ready `count` times.
#[track_caller]
pub fn ready_for(node: &NodeHandle, name: &str, count: u64) {
    until(&format!("{name} of {node:?} is ready for the {count}. time"), || {
        node.lives(name).filter(|lives| lives.readies >= count).map(drop)
    });
}
