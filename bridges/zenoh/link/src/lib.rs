//! The rules of Sinew's WAN link over Zenoh: a virtual IPv4 network that sends each packet as a put.
//!
//! Each host has one address in this network, on a TUN device. The nodes of the host use that address like one
//! of an Ethernet interface. So discovery, TLS, sessions, acknowledgements and the fencing of incarnations run
//! between the nodes themselves, from end to end. Zenoh may drop, repeat and reorder puts: TCP and discovery
//! tolerate that of any IP network.
//!
//! [`Link`] is pure: packets, puts and time come in as [`Input`], and puts, packets and facts go out as
//! [`Output`]. After each input the caller takes [`Link::poll`] until it is empty.
//!
//! | rule | |
//! | --- | --- |
//! | ZLINK-1 | Only whole IPv4 packets with TCP or UDP are carried, each as one put. |
//! | ZLINK-1.1 | Outgoing: from the host's own address, to another one in the network, or to the discovery group. |
//! | ZLINK-1.2 | Incoming: from the address that the put's key names, to the own address or the discovery group. |
//! | ZLINK-2 | An incoming packet is written only to a port in `ports`, or in a flow that this host began. |
//! | ZLINK-2.1 | At most [`FLOWS_MAX`] flows are known; a further one replaces the one that was used longest ago. |
//! | ZLINK-3 | A packet to the discovery group goes to all hosts, at most once in `group_every` from each port. |
//! | ZLINK-3.1 | A host that appears gets the last such packets at once, if they are at most [`GROUP_KEPT`] old. |
//! | ZLINK-4 | With a project key each packet is encrypted and authenticated from end to end, with its addresses. |
//! | ZLINK-4.1 | Each packet counts once, and only within [`ReplayWindow::SPAN`] numbers of the newest one. |
//! | ZLINK-4.2 | With a project key a plain put is dropped; without one, an encrypted put is dropped. |
//! | ZLINK-5 | The class of a packet is that of its DSCP mark. |
//! | ZLINK-6 | A host announces itself by a liveliness token. A token makes no member: only discovery does. |
//!
//! Each rejected packet or put is counted by its cause ([`Link::counts`]).

mod counts;
mod flows;
mod group;
pub mod key;
mod link;
mod packet;
mod presence;
mod seal;
mod window;

pub use self::{
    counts::{Counts, DropCause},
    flows::FLOWS_MAX,
    group::GROUP_KEPT,
    link::{Input, Link, Output, Settings, Target},
    packet::{Class, Header, PacketError, Protocol},
    presence::{HOSTS_MAX, HostFact, Instance},
    seal::{ProjectKey, SEAL_BYTES},
    window::ReplayWindow,
};
