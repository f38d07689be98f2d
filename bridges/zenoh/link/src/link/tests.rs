//! Tests of the rules, one host at a time.

use super::*;
use crate::packet::tests::packet;

const A: Ipv4Addr = Ipv4Addr::new(10, 99, 0, 1);
const B: Ipv4Addr = Ipv4Addr::new(10, 99, 0, 2);
const GROUP: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(239, 255, 83, 119), 6_910);
const NOW: Duration = Duration::from_secs(100);

fn link(address: Ipv4Addr) -> Link {
    let settings = Settings {
        project: "leg".to_owned(),
        address,
        prefix: 16,
        ports: BTreeSet::from([6_911, 6_912]),
        group: Some(GROUP),
        group_every: Duration::from_secs(1),
        key: ProjectKey::parse("17".repeat(32).as_bytes()),
    };
    Link::new(settings, Instance([address.octets()[3]; 16]))
}

fn header(source: (Ipv4Addr, u16), target: (Ipv4Addr, u16)) -> Header {
    let protocol = if target.0.is_multicast() { Protocol::Udp } else { Protocol::Tcp };
    Header {
        source: source.0,
        source_port: source.1,
        target: target.0,
        target_port: target.1,
        protocol,
        class: Class::Control,
    }
}

fn outputs(link: &mut Link) -> Vec<Output> {
    std::iter::from_fn(|| link.poll()).collect()
}

fn read(link: &mut Link, now: Duration, of: Header) -> Vec<Output> {
    link.handle(now, Input::PacketRead(&packet(of, b"payload")));
    outputs(link)
}

/// Returns the packets that `to` writes for a put of `from`.
fn carry(from: Ipv4Addr, to: &mut Link, put: &Output) -> Vec<Output> {
    let Output::Put { target, payload, .. } = put else { panic!("{put:?} is no put") };
    to.handle(NOW, Input::PutReceived { target: *target, source: from, payload });
    outputs(to)
}

// spec: ZLINK-1.1
#[test]
fn only_own_packets_leave_for_the_network() {
    let mut a = link(A);
    let put = read(&mut a, NOW, header((A, 6_912), (B, 6_912)));
    assert!(matches!(put[..], [Output::Put { target: Target::Host(B), class: Class::Control, .. }]));
    for (of, cause) in [
        (header((B, 6_912), (A, 6_912)), DropCause::ForeignSource),
        (header((A, 6_912), (A, 6_912)), DropCause::OutsideTarget),
        (header((A, 6_912), (Ipv4Addr::new(10, 98, 0, 2), 6_912)), DropCause::OutsideTarget),
        (header((A, 5_353), (Ipv4Addr::new(224, 0, 0, 251), 5_353)), DropCause::OutsideTarget),
    ] {
        let before = a.counts().dropped_for(cause);
        assert_eq!(read(&mut a, NOW, of), []);
        assert_eq!(a.counts().dropped_for(cause), before + 1, "{of:?}");
    }
}

// spec: ZLINK-2
#[test]
fn answers_come_back_and_other_ports_are_closed() {
    let (mut a, mut b) = (link(A), link(B));
    let request = header((A, 40_000), (B, 6_912));
    let put = read(&mut a, NOW, request);
    assert_eq!(carry(A, &mut b, &put[0]), [Output::Write(packet(request, b"payload"))]);
    let answer = header((B, 6_912), (A, 40_000));
    let put = read(&mut b, NOW, answer);
    assert_eq!(carry(B, &mut a, &put[0]), [Output::Write(packet(answer, b"payload"))]);
    for closed in [header((B, 6_912), (A, 22)), header((B, 6_911), (A, 40_000))] {
        let put = read(&mut b, NOW, closed);
        assert_eq!(carry(B, &mut a, &put[0]), [], "{closed:?}");
    }
    assert_eq!(a.counts().dropped_for(DropCause::ClosedPort), 2);
}

// spec: ZLINK-1.2
#[test]
fn packet_with_other_addresses_than_its_put_is_dropped() {
    let (mut a, mut b) = (link(A), link(B));
    b.settings.key = None;
    b.seal = Seal::new("leg", B, b.instance, None);
    let forged = packet(header((Ipv4Addr::new(10, 99, 0, 3), 6_912), (B, 6_912)), b"payload");
    let payload = [&[0][..], &forged].concat();
    b.handle(NOW, Input::PutReceived { target: Target::Host(B), source: A, payload: &payload });
    assert_eq!(b.counts().dropped_for(DropCause::ForgedAddress), 1);
    let own = [&[0][..], &packet(header((B, 6_912), (B, 6_912)), b"payload")].concat();
    b.handle(NOW, Input::PutReceived { target: Target::Host(B), source: B, payload: &own });
    assert_eq!(b.counts().dropped_for(DropCause::ForgedAddress), 2, "in the own name");
    let put = read(&mut a, NOW, header((A, 6_912), (B, 6_912)));
    assert_eq!(carry(A, &mut b, &put[0]), []);
    assert_eq!(b.counts().dropped_for(DropCause::OtherMode), 1);
}

// spec: ZLINK-3
#[test]
fn group_query_goes_to_all_at_its_pace() {
    let (mut a, mut b) = (link(A), link(B));
    let query = header((A, 6_911), (*GROUP.ip(), GROUP.port()));
    let put = read(&mut a, NOW, query);
    assert!(matches!(put[..], [Output::Put { target: Target::All, .. }]));
    assert_eq!(carry(A, &mut b, &put[0]), [Output::Write(packet(query, b"payload"))]);
    assert_eq!(read(&mut a, NOW + Duration::from_millis(500), query), []);
    assert_eq!(read(&mut a, NOW + Duration::from_secs(1), query).len(), 1);
    assert_eq!(a.counts().dropped_for(DropCause::GroupPace), 1);
    assert!(a.counts().dropped.keys().all(|cause| cause.is_expected()));
}

// spec: ZLINK-3.1
#[test]
fn host_that_appears_gets_the_last_query() {
    let (mut a, mut b) = (link(A), link(B));
    let query = header((A, 6_911), (*GROUP.ip(), GROUP.port()));
    read(&mut a, NOW, query);
    a.handle(NOW, Input::HostAppeared(B, b.instance));
    let found = outputs(&mut a);
    assert_eq!(found[0], Output::Host(HostFact::Appeared(B)));
    assert!(matches!(found[1], Output::Put { target: Target::Host(B), class: Class::Discovery, .. }));
    assert_eq!(carry(A, &mut b, &found[1]), [Output::Write(packet(query, b"payload"))]);
    a.handle(NOW, Input::HostAppeared(B, b.instance));
    assert_eq!(outputs(&mut a), [], "its token was known");
    a.handle(NOW, Input::HostAppeared(B, Instance([77; 16])));
    assert_eq!(outputs(&mut a).len(), 1, "its program has restarted");
    a.handle(NOW, Input::HostDisappeared(B, b.instance));
    a.handle(NOW, Input::HostDisappeared(B, Instance([77; 16])));
    assert_eq!(outputs(&mut a), [Output::Host(HostFact::Disappeared(B))]);
}

// spec: ZLINK-6
#[test]
fn own_token_is_no_other_host() {
    let mut a = link(A);
    a.handle(NOW, Input::HostAppeared(A, a.instance));
    assert_eq!(outputs(&mut a), []);
    let other = Instance([5; 16]);
    a.handle(NOW, Input::HostAppeared(A, other));
    assert_eq!(outputs(&mut a), [Output::Host(HostFact::AddressTaken(other))]);
    assert_eq!(a.hosts().count(), 0);
}

#[test]
fn network_is_as_long_as_its_prefix() {
    let mut a = link(A);
    for (prefix, last_inside, first_outside) in [
        (0, Ipv4Addr::new(255, 0, 0, 1), None),
        (24, Ipv4Addr::new(10, 99, 0, 255), Some(Ipv4Addr::new(10, 99, 1, 0))),
        (32, A, Some(Ipv4Addr::new(10, 99, 0, 0))),
    ] {
        a.settings.prefix = prefix;
        assert!(a.is_inside(last_inside), "{prefix}");
        assert!(first_outside.is_none_or(|address| !a.is_inside(address)), "{prefix}");
    }
}
