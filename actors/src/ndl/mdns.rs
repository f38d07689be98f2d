//! Discovery through multicast DNS (RFC 6762, RFC 6763): the node's service is published, those of others are found.
//!
//! What mDNS says is a hint where to ask, never a membership: records outlive the process that published them.
//! mdns-sd has a thread of its own, which ends when [`Mdns`] is dropped.

use std::{
    collections::HashMap,
    net::{IpAddr, SocketAddr},
};

use mdns_sd::{
    DaemonEvent, IfKind, Receiver, ResolvedService, ScopedIp, ServiceDaemon, ServiceEvent, ServiceInfo,
};
use sinew_runtime::wire::fnv1a;

use super::{address::seen_from, datagram::Announcement};

/// The type of Sinew's service.
const SERVICE: &str = "_sinew._udp.local.";
/// Addresses of one service that are asked, at most.
const ADDRESSES_MAX: usize = 4;
/// Bytes of a node's name in the service's instance name, which has 63 at most.
const NAME_MAX: usize = 40;

/// The node's presence in multicast DNS; ends when dropped.
pub(super) struct Mdns {
    daemon: ServiceDaemon,
    fullname: String,
    project: String,
    /// Our address, where the service is published.
    here: SocketAddr,
}

/// Why multicast DNS did not start.
pub(super) type MdnsError = mdns_sd::Error;

impl Mdns {
    /// Publishes the node's service at `udp` and no other interface, through the given mDNS port.
    pub(super) fn start(port: u16, udp: SocketAddr, me: &Announcement) -> Result<Self, MdnsError> {
        let service = service(udp, me)?;
        let daemon = ServiceDaemon::new_with_port(port)?;
        let (fullname, project) = (service.get_fullname().to_owned(), me.project.clone());
        let mdns = Self { daemon, fullname, project, here: udp };
        // Commands are obeyed in order: nothing leaves by another interface.
        mdns.daemon.disable_interface(IfKind::All)?;
        mdns.daemon.enable_interface(interface(udp.ip()))?;
        mdns.daemon.register(service)?;
        Ok(mdns)
    }

    /// Begins to look for others. The receiver ends if nobody reads it for long; then look again.
    pub(super) fn browse(&self) -> Result<Receiver<ServiceEvent>, MdnsError> {
        self.daemon.browse(SERVICE)
    }

    /// What the daemon has to say about itself.
    pub(super) fn monitor(&self) -> Result<Receiver<DaemonEvent>, MdnsError> {
        self.daemon.monitor()
    }

    /// Where the node of a resolved service can be asked, by the family in which it was looked for; nothing if it is our own or of another
    /// project.
    pub(super) fn addresses(&self, service: &ResolvedService) -> Vec<SocketAddr> {
        let is_own = service.get_fullname().eq_ignore_ascii_case(&self.fullname);
        if is_own || service.get_property_val_str("project") != Some(self.project.as_str()) {
            return Vec::new();
        }
        let mut addresses: Vec<IpAddr> = service.get_addresses().iter().map(ScopedIp::to_ip_addr).collect();
        addresses.retain(|ip| ip.is_ipv4() == self.here.is_ipv4());
        // From a hash set: in an order that a failure can be repeated with.
        addresses.sort_unstable();
        addresses.truncate(ADDRESSES_MAX);
        let at = |ip| seen_from(self.here, (ip, service.get_port()).into());
        addresses.into_iter().map(at).collect()
    }
}

impl Drop for Mdns {
    fn drop(&mut self) {
        // A daemon whose queue of a hundred commands is full, or that is gone, cannot be told; nothing else is left.
        let _ = self.daemon.unregister(&self.fullname);
        let _ = self.daemon.shutdown();
    }
}

/// 127.0.0.0/8 is one interface with one address, whichever of its addresses the node has.
fn interface(ip: IpAddr) -> IfKind {
    match ip {
        IpAddr::V4(ip) if ip.is_loopback() => IfKind::LoopbackV4,
        IpAddr::V6(ip) if ip.is_loopback() => IfKind::LoopbackV6,
        ip @ (IpAddr::V4(_) | IpAddr::V6(_)) => IfKind::Addr(ip),
    }
}

fn service(udp: SocketAddr, me: &Announcement) -> Result<ServiceInfo, MdnsError> {
    let cut = (0..=NAME_MAX.min(me.name.len())).rev().find(|at| me.name.is_char_boundary(*at)).unwrap_or(0);
    // Node addresses are unique in a project; its hash keeps projects apart.
    let unique = format!("{:08x}{:08x}", me.node.bits(), fnv1a(me.project.as_bytes()));
    let properties = HashMap::from([
        ("project".to_owned(), me.project.clone()),
        ("node".to_owned(), me.node.to_string()),
        ("incarnation".to_owned(), me.incarnation.to_string()),
    ]);
    let instance = format!("{} {unique}", &me.name[..cut]);
    let host = format!("sinew-{unique}.local.");
    let mut service = ServiceInfo::new(SERVICE, &instance, &host, udp.ip(), udp.port(), properties)?;
    // The name is unique already; probing for it would take 0.9 s.
    service.set_requires_probe(false);
    Ok(service)
}

#[cfg(test)]
mod tests {
    use std::{net::UdpSocket, time::Duration};

    use sinew_runtime::tid::{Incarnation, NodeAddress};

    use super::*;

    #[test]
    fn the_daemons_thread_ends_when_its_owner_does() {
        // given
        let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let me = Announcement {
            project: "sinew".to_owned(),
            node: NodeAddress::new(1),
            // Cut to its 40 bytes within a character.
            name: "x".to_owned() + &"ä".repeat(31),
            incarnation: Incarnation(1),
            boot_nonce: 1,
            gncl_ip: 0,
            gncl_port: 0,
            period_us: 0,
            gncl_further: Vec::new(),
            ndl: Vec::new(),
            ndl6: Vec::new(),
            gncl_port6: 0,
            claim: crate::ndl::datagram::Claim::Held,
        };
        let mdns = Mdns::start(port, "127.0.0.1:9".parse().unwrap(), &me).unwrap();
        let events = mdns.monitor().unwrap();
        // when
        drop(mdns);
        // then
        while let Ok(event) = events.recv_timeout(Duration::from_secs(10)) {
            assert!(!matches!(event, DaemonEvent::Error(_)), "{event:?}");
        }
        assert!(events.is_disconnected(), "waited 10 s for the daemon to end");
    }
}
