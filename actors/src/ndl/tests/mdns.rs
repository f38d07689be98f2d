//! What a node says by multicast DNS.

use std::{
    collections::BTreeSet,
    net::{IpAddr, Ipv4Addr},
};

use mdns_sd::{IfKind, ScopedIp, ServiceDaemon, ServiceEvent};

use super::{LOOPBACK, Node, free_port, run, within};
use crate::{config::Interface, ndl::mdns::SERVICE};

#[test]
fn a_node_is_published_at_each_of_its_addresses() {
    run(async {
        // given
        let (port, second) = (free_port(), Ipv4Addr::new(127, 0, 0, 2));
        let node = Node::start(1, |ndl| {
            ndl.mdns_port = Some(port);
            ndl.interface = [LOOPBACK, second].map(Interface::Address).to_vec().into();
        });
        let _node = node.await;
        // when
        let daemon = ServiceDaemon::new_with_port(port).unwrap();
        daemon.disable_interface(IfKind::All).unwrap();
        daemon.enable_interface(IfKind::LoopbackV4).unwrap();
        let events = daemon.browse(SERVICE).unwrap();
        // then
        let expected = BTreeSet::from([LOOPBACK, second].map(IpAddr::from));
        let mut heard = BTreeSet::new();
        within("both addresses", async {
            while heard != expected {
                let event = events.recv_async().await.expect("the daemon runs");
                if let ServiceEvent::ServiceResolved(service) = event {
                    heard.extend(service.get_addresses().iter().map(ScopedIp::to_ip_addr));
                }
            }
        })
        .await;
        // It has been told to end; what it says of that is of no interest.
        drop(daemon.shutdown());
    });
}
