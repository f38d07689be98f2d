//! The orders and facts that the core gives to its shell.

use std::{net::SocketAddr, time::Duration};

use sinew_model::{
    clocks::ClockOffset,
    facts::{MembershipFact, NodeEvent},
};
use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};

use super::{Place, address_conflict::Claimant};

/// An order or a fact.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Output {
    SendQuery {
        to: Place,
        correlation: u64,
    },
    /// Send from each of these local addresses.
    SendMulticastQuery {
        from: Vec<SocketAddr>,
        correlation: u64,
    },
    SendAnswer {
        to: Place,
        node: NodeAddress,
        correlation: u64,
        query_sent: Time,
        query_received: Time,
    },
    SendLeave {
        to: Place,
        node: NodeAddress,
    },
    /// Try to connect to the host of this node at these addresses of its GNCL, and report the
    /// [result](super::Host::by) within this time. Request a liveness hint from its GNCL on the established
    /// connections.
    Probe {
        node: NodeAddress,
        incarnation: Incarnation,
        to: Vec<SocketAddr>,
        within: Duration,
        requested: Time,
    },
    /// Request a liveness hint from the GNCL of this incarnation of a node on the established connections.
    RequestLiveness {
        node: NodeAddress,
        incarnation: Incarnation,
    },
    /// A fact for GNCL and the sync manager.
    Fact(MembershipFact),
    /// For GNCL: a member listens at other addresses now, its preferred address first.
    Moved {
        node: NodeAddress,
        incarnation: Incarnation,
        gncl: Vec<SocketAddr>,
    },
    /// For GNCL: an earlier incarnation than this one is about to be found, and is not barred any more.
    Forgotten {
        node: NodeAddress,
        incarnation: Incarnation,
    },
    /// An event for this application.
    Event {
        to: AppAddress,
        event: NodeEvent,
    },
    /// The measured clock offset of this incarnation of a node.
    ClockMeasured {
        node: NodeAddress,
        incarnation: Incarnation,
        offset: ClockOffset,
    },
    /// Two live processes have one node address. The newcomer is no member, or not any more.
    Collision {
        node: NodeAddress,
        holder: Claimant,
        newcomer: Claimant,
    },
    /// Another process holds this node's own address. This node must not go on.
    AddressTaken {
        holder: Claimant,
    },
    /// The local timer was this late. No node was counted as silent, unless the timer has been late for long.
    Stalled {
        late: Duration,
    },
}
