//! Where the nodes of one scenario live: addresses on loopback, and a multicast group that nobody else has.

use std::{
    net::SocketAddrV4,
    sync::atomic::{AtomicU8, Ordering},
};

use sinew::{NodeHandle, prelude::*};

use crate::{DEADLINE, own_group, until};

/// A network of a scenario's own.
#[derive(Debug)]
pub struct Ground {
    /// The group in which its nodes find each other.
    pub group: SocketAddrV4,
    addresses: AtomicU8,
}

impl Default for Ground {
    fn default() -> Self {
        Self::new()
    }
}

impl Ground {
    /// An empty network. What its nodes log is shown with `RUST_LOG=sinew=debug`.
    #[must_use]
    pub fn new() -> Self {
        if std::env::var_os("RUST_LOG").is_some() {
            let filter = tracing_subscriber::EnvFilter::from_default_env();
            // Another scenario of this process may have done it.
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
        })
    }
}

/// Waits until every application of these nodes runs.
///
/// # Panics
/// If one does not in time, with who waits for whom.
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

/// Waits until the actor called `name` has said so often that it is ready.
#[track_caller]
pub fn ready_for(node: &NodeHandle, name: &str, count: u64) {
    until(&format!("{name} of {node:?} is ready for the {count}. time"), || {
        node.lives(name).filter(|lives| lives.readies >= count).map(drop)
    });
}
