//! Packets that the bridge between hosts forwards or drops.

use std::{
    net::{Ipv4Addr, UdpSocket},
    time::Duration,
};

use sinew_testkit::Hosts;

/// Maximum wait for a datagram that is to arrive.
const PATIENCE: Duration = Duration::from_secs(60);
/// Wait for a datagram that is to be dropped.
const SILENCE: Duration = Duration::from_millis(300);

#[test]
fn swallowed_host_gets_no_packets_until_carried() {
    let hosts = match Hosts::new(2) {
        Ok(hosts) => hosts,
        Err(why) => {
            println!("skipped: no hosts can be made here: {why}");
            return;
        }
    };
    let bind = |address: Ipv4Addr| UdpSocket::bind((address, 0)).unwrap();
    let [one, other] = [0, 1].map(|host| hosts.all()[host].run(|| bind(hosts.all()[host].address)));
    let arrives = |from: &UdpSocket, to: &UdpSocket, within: Duration| {
        to.set_read_timeout(Some(within)).unwrap();
        from.send_to(&[7], to.local_addr().unwrap()).unwrap();
        to.recv(&mut [0]).is_ok()
    };
    // Both hosts know each other's MAC address now, so that later packets do not wait for it.
    assert!(arrives(&one, &other, PATIENCE) && arrives(&other, &one, PATIENCE));
    // When
    hosts.swallow(1);
    // Then
    assert!(!arrives(&one, &other, SILENCE) && !arrives(&other, &one, SILENCE));
    hosts.carry(1);
    assert!(arrives(&one, &other, PATIENCE) && arrives(&other, &one, PATIENCE));
}
