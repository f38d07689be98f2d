//! The mDNS records of a node.

use std::{
    collections::BTreeSet,
    net::{IpAddr, Ipv4Addr},
    time::Duration,
};

use mdns_sd::{IfKind, ScopedIp, ServiceDaemon, ServiceEvent, ServiceInfo};
use sinew_model::config::Interface;

use super::{LOOPBACK, Node, free_port, run, within};
use crate::mdns::SERVICE;

#[test]
fn mdns_finds_nodes_after_a_cache_flood() {
    run(async {
        // given
        let port = free_port();
        let mut first = Node::start(1, |ndl| {
            ndl.mdns_port = Some(port);
            ndl.nodes_max = 1;
        })
        .await;
        // when: more services are announced than there may be nodes
        let daemon = ServiceDaemon::new_with_port(port).unwrap();
        daemon.disable_interface(IfKind::All).unwrap();
        daemon.enable_interface(IfKind::LoopbackV4).unwrap();
        for number in 0..100 {
            let (instance, host) = (format!("forged {number}"), format!("forged-{number}.local."));
            let mut forged =
                ServiceInfo::new(SERVICE, &instance, &host, "127.0.0.1", 9, &[("a", "b")][..]).unwrap();
            forged.set_requires_probe(false);
            // Its queue has room for a hundred commands.
            while daemon.register(forged.clone()).is_err() {
                tokio::task::yield_now().await;
            }
        }
        // then: the limit of records is exceeded
        within("the records to be too many", async {
            while first.state.ctx.refusals.of("more records of mDNS than are kept") == 0 {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        })
        .await;
        drop(daemon.shutdown());
        let second = Node::start(2, |ndl| ndl.mdns_port = Some(port)).await;
        first.finds(&second).await;
    });
}

#[test]
fn node_is_published_at_each_of_its_addresses() {
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
        let mut received = BTreeSet::new();
        within("both addresses", async {
            while received != expected {
                let event = events.recv_async().await.expect("the daemon runs");
                if let ServiceEvent::ServiceResolved(service) = event {
                    received.extend(service.get_addresses().iter().map(ScopedIp::to_ip_addr));
                }
            }
        })
        .await;
        // It was requested to end; its answer is ignored.
        drop(daemon.shutdown());
    });
}
