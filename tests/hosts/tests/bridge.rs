//! What the network between hosts lets through.

use std::{
    net::{Ipv4Addr, UdpSocket},
    time::Duration,
};

use sinew_hosts::Hosts;

/// Nothing that arrives takes longer.
const PATIENCE: Duration = Duration::from_secs(60);
/// What is swallowed is not waited for longer.
const SILENCE: Duration = Duration::from_millis(300);

#[test]
fn what_the_network_swallows_does_not_arrive_in_either_direction_and_later_all_does() {
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
    // Each knows where the other is, so that nothing waits for that.
    assert!(arrives(&one, &other, PATIENCE) && arrives(&other, &one, PATIENCE));
    // When
    hosts.swallow(1);
    // Then
    assert!(!arrives(&one, &other, SILENCE) && !arrives(&other, &one, SILENCE));
    hosts.carry(1);
    assert!(arrives(&one, &other, PATIENCE) && arrives(&other, &one, PATIENCE));
}
