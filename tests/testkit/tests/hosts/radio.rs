//! Effect of loss and delay in the network on datagrams.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

use std::{
    net::{Ipv4Addr, UdpSocket},
    time::{Duration, Instant},
};

use sinew_testkit::{Hosts, Weather};

/// Number of datagrams that fit in a socket buffer, for a receiver that reads later.
const SENT: u32 = 200;
/// Maximum wait for a datagram that is to arrive.
const PATIENCE: Duration = Duration::from_secs(60);
/// Wait for datagrams that may be lost. A datagram that is not lost arrives in this time even if the radio
/// thread gets no CPU for a while.
const SILENCE: Duration = Duration::from_secs(2);

fn hosts() -> Option<Hosts> {
    Hosts::on_radio(2, 7).inspect_err(|why| println!("skipped: no hosts can be made here, {why}")).ok()
}

/// Lets the hosts learn each other's MAC addresses: a host queues only a few packets for an unknown
/// neighbour.
fn introduce(hosts: &Hosts) {
    let Some((first, others)) = hosts.all().split_first() else { return };
    for other in others {
        let receiver = other.run(|| UdpSocket::bind((other.address, 0)).unwrap());
        receiver.set_read_timeout(Some(PATIENCE)).unwrap();
        let sender = first.run(|| UdpSocket::bind((first.address, 0)).unwrap());
        sender.send_to(&[0], receiver.local_addr().unwrap()).unwrap();
        receiver.recv(&mut [0]).unwrap();
    }
}

/// Sends numbered datagrams from the first host to the second. Returns those that arrived, in order of
/// arrival, and the arrival time of the last one.
fn carry(hosts: &Hosts, patience: Duration) -> (Vec<u32>, Duration) {
    let [from, to] = hosts.all() else { panic!("there are two") };
    let bind = |address: Ipv4Addr| UdpSocket::bind((address, 0)).unwrap();
    let receiver = to.run(|| bind(to.address));
    let sender = from.run(|| bind(from.address));
    receiver.set_read_timeout(Some(patience)).unwrap();
    let address = receiver.local_addr().unwrap();
    let began = Instant::now();
    for number in 0..SENT {
        sender.send_to(&number.to_le_bytes(), address).unwrap();
    }
    let (mut arrived, mut last) = (Vec::new(), Duration::ZERO);
    let mut bytes = [0; 4];
    while arrived.len() < SENT as usize && receiver.recv(&mut bytes).is_ok() {
        arrived.push(u32::from_le_bytes(bytes));
        last = began.elapsed();
    }
    (arrived, last)
}

#[test]
fn a_clear_network_carries_everything_in_order() {
    let Some(hosts) = hosts() else { return };
    introduce(&hosts);
    let (arrived, _) = carry(&hosts, PATIENCE);
    assert_eq!(arrived, (0..SENT).collect::<Vec<_>>());
}

#[test]
fn network_without_multicast_carries_unicast() {
    let Some(hosts) = hosts() else { return };
    introduce(&hosts);
    let [from, to] = hosts.all() else { panic!("there are two") };
    let group = Ipv4Addr::new(239, 255, 1, 9);
    let listener = to.run(|| UdpSocket::bind((group, 0)).unwrap());
    listener.join_multicast_v4(&group, &to.address).unwrap();
    listener.set_read_timeout(Some(PATIENCE)).unwrap();
    let port = listener.local_addr().unwrap().port();
    let sender = from.run(|| UdpSocket::bind((from.address, 0)).unwrap());
    sender.send_to(b"carried", (group, port)).unwrap();
    assert_eq!(listener.recv(&mut [0; 9]).unwrap(), 7);
    hosts.drop_multicast();
    sender.send_to(b"not", (group, port)).unwrap();
    assert_eq!(carry(&hosts, PATIENCE).0, (0..SENT).collect::<Vec<_>>());
    listener.set_read_timeout(Some(SILENCE)).unwrap();
    listener.recv(&mut [0; 9]).unwrap_err();
}

#[test]
fn rough_network_loses_and_delays_packets() {
    let Some(hosts) = hosts() else { return };
    introduce(&hosts);
    let (delay, jitter) = (Duration::from_millis(20), Duration::from_millis(10));
    hosts.set_weather(Weather { loss: 0.3, delay, jitter });
    let (arrived, last) = carry(&hosts, SILENCE);
    assert!((100..180).contains(&arrived.len()), "{} of {SENT} arrived", arrived.len());
    assert!(last >= delay - jitter, "the last one came after {last:?}");
    assert!(!arrived.is_sorted(), "they overtake each other");
    assert!(
        hosts.set_weather(Weather { loss: 1.0, ..Weather::default() }).lost
            >= u64::from(SENT) - arrived.len() as u64
    );
    assert!(carry(&hosts, SILENCE).0.is_empty());
}
