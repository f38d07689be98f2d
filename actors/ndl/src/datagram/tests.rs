//! Encoded datagrams decode to the same, and nothing else decodes.

use proptest::prelude::*;
use sinew_model::{
    facts::Trouble,
    progress::{IdleClient, Part, TroubleCode},
};

use super::*;

fn any_announcement() -> impl Strategy<Value = Announcement> {
    let names = ("[a-zäöü ]{1,30}", "[a-z.-]{1,63}");
    let place = || (1..0xe000_0000_u32, 1..u16::MAX);
    let further = proptest::collection::vec(place(), 0..=FURTHER_MAX);
    let ndl = proptest::collection::vec(place(), 0..=PATHS_MAX);
    // Global addresses, link-local ones, and a loopback one.
    let place6 =
        (prop_oneof![0x2000_u64 << 48..0x4000 << 48, Just(0xfe80_u64 << 48)], 1..u64::MAX, 1..u16::MAX);
    let place6 = prop_oneof![place6, (Just(0_u64), Just(1_u64), 1..u16::MAX)];
    let ndl6 = proptest::collection::vec(place6, 0..=PATHS_MAX);
    let ports6 = (any::<bool>(), 1..u16::MAX);
    (names, 1..u32::MAX, any::<[u64; 2]>(), place(), further, (ndl, ndl6, ports6), any::<u32>(), 0..3u8)
        .prop_map(
            |(
                (name, project),
                node,
                [incarnation, boot_nonce],
                (gncl_ip, gncl_port),
                gncl_further,
                (mut ndl, mut ndl6, (is_ipv6_alone, port6)),
                period_us,
                claim,
            )| {
                ndl6.truncate(PATHS_MAX);
                ndl.truncate(PATHS_MAX - ndl6.len());
                let gncl_port6 = if ndl6.is_empty() { 0 } else { port6 };
                let is_ipv6_alone = is_ipv6_alone && gncl_port6 != 0;
                let (gncl_ip, gncl_port) = if is_ipv6_alone { (0, 0) } else { (gncl_ip, gncl_port) };
                let gncl_further = if is_ipv6_alone { Vec::new() } else { gncl_further };
                Announcement {
                    project,
                    node: NodeAddress::new(node),
                    name,
                    incarnation: Incarnation(incarnation),
                    boot_nonce,
                    gncl_ip,
                    gncl_port,
                    period_us,
                    gncl_further,
                    ndl,
                    ndl6,
                    gncl_port6,
                    claim: Claim::from(claim),
                }
            },
        )
}

/// Returns `number` parts, with the longest names.
fn any_progress(number: u64) -> Progress {
    let part = |at| Part {
        app: AppAddress::new(0xffff_0000 + at),
        name: "x".repeat(63),
        trouble: TroubleCode(Trouble::GivenUp),
        since_ms: u32::MAX,
    };
    let client =
        |at| IdleClient { app: AppAddress::new(0xffff_0000 + at), name: "x".repeat(63), since_ms: u32::MAX };
    let clients = (0..(number / 7 % 4) as u32).map(client).collect();
    Progress::of((0..(number % 7) as u32).map(part).collect()).with_clients(clients)
}

fn any_datagram() -> impl Strategy<Value = Datagram> {
    (any_announcement(), 0..3, any::<[u64; 4]>()).prop_map(
        |(announcement, kind, [correlation, sent, a, b])| {
            let body = match kind {
                0 => Body::Query(announcement),
                1 => {
                    let gave_up =
                        a.is_multiple_of(2).then(|| LeaveReason::of(&"ö\n".repeat((b % 120) as usize)));
                    Body::Leave(Leave { announcement, gave_up })
                }
                _ => Body::Answer(Answer {
                    announcement,
                    query_sent_ns: a,
                    query_received_ns: b,
                    progress: any_progress(a),
                }),
            };
            Datagram { correlation, sent: Time::from_nanos(sent), body }
        },
    )
}

const HERE: NodeAddress = NodeAddress::new(7);

proptest! {
    #[test]
    fn encoded_datagrams_decode_to_the_same_and_fit(datagram in any_datagram(), to_all: bool) {
        let bytes = encode(&datagram, if to_all { NodeAddress::ALL } else { HERE });
        prop_assert!(bytes.len() <= DATAGRAM_MAX);
        prop_assert_eq!(parse(HERE, &bytes).unwrap(), datagram);
    }

    #[test]
    fn any_bytes_are_a_datagram_or_an_error(bytes in proptest::collection::vec(any::<u8>(), 0..1_400)) {
        prop_assert!(parse(HERE, &bytes).is_err());
        let _ = peek_answer(&bytes);
    }

    #[test]
    fn any_payload_decodes_or_is_an_error(
        payload in proptest::collection::vec(any::<u8>(), 0..1_100),
        kind in 0x20u32..0x24,
    ) {
        let _ = parse(HERE, &frame(Kind::from_bits(kind), &payload));
    }

    #[test]
    fn truncated_or_flipped_datagram_is_refused(datagram in any_datagram(), keep in 0.0f64..1.0, bit in 0usize..800) {
        let whole = encode(&datagram, HERE);
        prop_assert!(parse(HERE, &whole[..(whole.len() as f64 * keep) as usize]).is_err());
        let mut flipped = whole.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        prop_assert!(parse(HERE, &flipped).is_err());
    }

    #[test]
    fn datagram_for_another_node_is_refused(datagram in any_datagram(), other in 8..u32::MAX) {
        let error = parse(HERE, &encode(&datagram, NodeAddress::new(other))).unwrap_err();
        prop_assert!(matches!(error, DatagramError::Misdirected(_)));
    }
}

fn frame(kind: Kind, payload: &[u8]) -> BytesMut {
    let mut bytes = BytesMut::new();
    let ndl = |node| Tid::new(NodeAddress::new(node), AppAddress::NDL);
    encode_frame(&Header::new(kind, ndl(9), ndl(7)), payload, &mut bytes);
    bytes
}

fn sound() -> Announcement {
    Announcement {
        project: "p".to_owned(),
        node: NodeAddress::new(9),
        name: "knee".to_owned(),
        incarnation: Incarnation(1),
        boot_nonce: 2,
        gncl_ip: 0x7f00_0001,
        gncl_port: 4,
        period_us: 5,
        gncl_further: Vec::new(),
        ndl: Vec::new(),
        ndl6: Vec::new(),
        gncl_port6: 0,
        claim: Claim::Held,
    }
}

#[test]
fn longest_answer_fits() {
    let longest = Announcement {
        project: "p".repeat(63),
        node: NodeAddress::new(u32::MAX - 1),
        name: "n".repeat(63),
        incarnation: Incarnation(u64::MAX),
        boot_nonce: u64::MAX,
        gncl_ip: 0xdfff_ffff,
        gncl_port: u16::MAX,
        period_us: u32::MAX,
        gncl_further: vec![(0xdfff_ffff, u16::MAX); FURTHER_MAX],
        // Addresses of IPv6 are longer, and there are at most eight of both.
        ndl: Vec::new(),
        ndl6: vec![(0xfe80 << 48, u64::MAX, u16::MAX); PATHS_MAX],
        gncl_port6: u16::MAX,
        claim: Claim::Settling,
    };
    // The maximum number of all parts.
    let progress = any_progress(6 + 7 * 3);
    let (query_sent_ns, query_received_ns) = (u64::MAX, u64::MAX);
    let body = Body::Answer(Answer { announcement: longest, query_sent_ns, query_received_ns, progress });
    let answer = Datagram { correlation: u64::MAX, sent: Time::from_nanos(u64::MAX), body };
    let bytes = encode(&answer, HERE);
    assert!(bytes.len() <= DATAGRAM_MAX, "{} bytes", bytes.len());
    assert_eq!(parse(HERE, &bytes).expect("it is sound"), answer);
}

/// The format of an answer for a node that does not know clients.
#[derive(Debug, PartialEq, Deserialize)]
struct FormerProgress {
    troubled: u32,
    parts: Vec<Part>,
}

#[test]
fn answers_with_and_without_clients_are_compatible() {
    let clients = |progress: &Progress| rmp_serde::to_vec_named(progress).expect("strings and numbers");
    let reported = any_progress(2 + 7 * 3);
    let former: FormerProgress = rmp_serde::from_slice(&clients(&reported)).expect("it skips unknown fields");
    assert_eq!(former, FormerProgress { troubled: 2, parts: reported.parts });
    let without = any_progress(2);
    let bytes = clients(&without);
    assert!(!bytes.windows(4).any(|word| word == b"idle"), "left out");
    assert_eq!(rmp_serde::from_slice::<Progress>(&bytes).expect("as before"), without);
}

#[test]
fn answer_with_impossible_clients_is_refused() {
    let answer = |idle| {
        let progress = Progress { idle, ..any_progress(7 * 3) };
        let (query_sent_ns, query_received_ns) = (1, 2);
        let reported = Answer { announcement: sound(), query_sent_ns, query_received_ns, progress };
        parse(
            HERE,
            &frame(Kind::NDL_ANSWER, &rmp_serde::to_vec_named(&reported).expect("strings and numbers")),
        )
    };
    assert!(answer(3).is_ok());
    assert!(matches!(answer(1), Err(DatagramError::Announcement(_))));
}

fn refusal(announcement: &Announcement) -> DatagramError {
    let payload = rmp_serde::to_vec_named(announcement).unwrap();
    parse(HERE, &frame(Kind::NDL_QUERY, &payload)).unwrap_err()
}

#[test]
fn unusable_announcement_is_refused() {
    let unfit = [
        Announcement { name: String::new(), ..sound() },
        Announcement { name: "x".repeat(64), ..sound() },
        Announcement { project: "two\nlines".to_owned(), ..sound() },
        Announcement { node: NodeAddress::ALL, ..sound() },
        Announcement { gncl_port: 0, ..sound() },
        Announcement { gncl_ip: 0xe000_0001, ..sound() },
        Announcement { gncl_further: vec![(0x7f00_0002, 4), (0x7f00_0003, 0)], ..sound() },
        Announcement { gncl_further: vec![(0, 4)], ..sound() },
        Announcement { gncl_further: vec![(0x7f00_0002, 4); FURTHER_MAX + 1], ..sound() },
        Announcement { ndl: vec![(0x7f00_0002, 4); PATHS_MAX + 1], ..sound() },
        Announcement { ndl: vec![(0x7f00_0002, 0)], ..sound() },
        Announcement { ndl: vec![(0xe000_0001, 4)], ..sound() },
        Announcement { ndl6: vec![(0xfe80 << 48, 1, 0)], ..sound() },
        Announcement { ndl6: vec![(0, 0, 4)], ..sound() },
        Announcement { ndl6: vec![(0xff02 << 48, 1, 4)], ..sound() },
        // ::ffff:10.0.0.7
        Announcement { ndl6: vec![(0, 0xffff_0a00_0007, 4)], ..sound() },
        Announcement { ndl6: vec![(0xfd00 << 48, 1, 4); PATHS_MAX + 1], ..sound() },
        Announcement { ndl6: vec![(0xfd00 << 48, 1, 4)], ndl: vec![(0x7f00_0001, 4); PATHS_MAX], ..sound() },
        Announcement { gncl_ip: 0, gncl_port: 0, ..sound() },
        Announcement { gncl_ip: 0, gncl_port: 0, gncl_port6: 4, ..sound() },
        Announcement { gncl_ip: 0, gncl_port: 0, ndl6: vec![(0xfd00 << 48, 1, 4)], ..sound() },
        Announcement { gncl_ip: 0, gncl_port6: 4, ndl6: vec![(0xfd00 << 48, 1, 4)], ..sound() },
    ];
    for announcement in unfit {
        assert!(matches!(refusal(&announcement), DatagramError::Announcement(_)), "{announcement:?}");
    }
}

#[test]
fn seal_is_checked_only_with_a_plausible_maker() {
    let datagram = Datagram { correlation: 1, sent: Time::ZERO, body: Body::Query(sound()) };
    let mut bytes = encode(&datagram, NodeAddress::ALL);
    assert_eq!(maker_of(&bytes), Some(sound().node));
    // The same for noise: one in 2^32 passes this check.
    bytes[16] ^= 1;
    assert_eq!(maker_of(&bytes), None);
    assert_eq!(maker_of(&bytes[..23]), None);
}

#[test]
fn source_other_than_the_announced_node_is_refused() {
    let forged = refusal(&Announcement { node: NodeAddress::new(10), ..sound() });
    assert!(matches!(forged, DatagramError::Forged { .. }));
}

#[test]
fn deep_nesting_is_an_error_without_stack_overflow() {
    let nested = [0x91; 1_100];
    assert!(matches!(parse(HERE, &frame(Kind::NDL_QUERY, &nested)), Err(DatagramError::Payload(_))));
    // An unknown field is skipped, at any depth of nesting.
    let mut unknown = vec![0x81, 0xa1, b'x'];
    unknown.extend([0x91; 1_090]);
    assert!(matches!(parse(HERE, &frame(Kind::NDL_QUERY, &unknown)), Err(DatagramError::Payload(_))));
}

#[test]
fn only_a_seal_is_reported_as_a_trailing_seal() {
    let datagram = Datagram { correlation: 1, sent: Time::ZERO, body: Body::Query(sound()) };
    let bytes = encode(&datagram, NodeAddress::ALL);
    let with_behind = |count: usize| [&bytes[..], &vec![7; count]].concat();
    let error = parse(HERE, &with_behind(SEAL_LEN)).unwrap_err();
    assert_eq!(error.cause(), "sealed NDL datagram at a node without keys");
    assert!(error.to_string().contains("security.keys"), "{error}");
    for count in [1, SEAL_LEN - 1, SEAL_LEN + 1] {
        assert_eq!(parse(HERE, &with_behind(count)).unwrap_err().cause(), "NDL datagram is not a frame");
    }
    // The longest one is longer than any frame of NDL, and a damaged one is not recognized.
    let longest = frame(Kind::NDL_QUERY, &[0; DATAGRAM_MAX - HEADER_LEN]);
    let longest = [&longest[..], &[7; SEAL_LEN]].concat();
    assert!(matches!(parse(HERE, &longest), Err(DatagramError::Sealed)));
    let mut damaged = with_behind(SEAL_LEN);
    damaged[HEADER_LEN] ^= 1;
    assert_eq!(parse(HERE, &damaged).unwrap_err().cause(), "NDL datagram is not a frame");
    assert!(is_frame(&bytes) && !is_frame(&with_behind(SEAL_LEN)) && !is_frame(&bytes[..7]));
}

#[test]
fn other_version_is_refused_with_a_reason() {
    let mut bytes = frame(Kind::NDL_QUERY, &[]);
    bytes[2] = 2;
    let error = parse(HERE, &bytes).unwrap_err();
    assert_eq!(error.cause(), "NDL datagram of another protocol version");
    assert!(error.to_string().contains("speaks version 2"), "{error}");
}

/// The example of `docs/protocol/ndl.md`.
#[test]
fn documented_example_is_sent() {
    let query = Datagram { correlation: 0x1122, sent: Time::from_nanos(0x3344), body: Body::Query(sound()) };
    let bytes = encode(&query, NodeAddress::ALL);
    let hex: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    let example: Vec<&str> = include_str!("../../../../docs/protocol/ndl.md")
        .split("```hex")
        .nth(1)
        .and_then(|rest| rest.split("```").next())
        .unwrap()
        .split_whitespace()
        .collect();
    assert_eq!(hex, example);
}

/// A node at these addresses, with a GNCL that listens at one of IPv4 and at those of IPv6.
fn at(paths: &[&str]) -> Announcement {
    let mut announcement = Announcement { gncl_ip: 0x0a00_0001, gncl_port6: 5, ..sound() };
    announcement.announce_ndl(&paths.iter().map(|path| path.parse().unwrap()).collect::<Vec<_>>());
    announcement
}

// spec: NDL-3.5
#[test]
fn ipv6_listener_has_ndls_address_and_link() {
    let gncl = |announcement: &Announcement, routes: &[(&str, &str)]| {
        let routes: Vec<(SocketAddr, SocketAddr)> =
            routes.iter().map(|(here, there)| (here.parse().unwrap(), there.parse().unwrap())).collect();
        let all = announcement.gncl_addresses(None, routes);
        all.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ")
    };
    let all = at(&["10.0.0.1:7", "[fe80::1%3]:7", "[fd00::1]:8", "[::1]:9"]);
    assert_eq!(gncl(&all, &[]), "10.0.0.1:4 [fd00::1]:5");
    let met = [
        ("[fe80::9%2]:1", "[fe80::1%2]:7"),
        ("[fe80::8%6]:1", "[fe80::1%6]:7"),
        ("10.0.0.2:1", "10.0.0.1:7"),
    ];
    assert_eq!(gncl(&all, &met), "10.0.0.1:4 [fe80::1%2]:5 [fe80::1%6]:5 [fd00::1]:5");
    let elsewhere = [("[fe80::9%2]:1", "[fe80::66%2]:7")];
    assert_eq!(gncl(&all, &elsewhere), "10.0.0.1:4 [fd00::1]:5", "at an unannounced address");
    let alone = Announcement { gncl_ip: 0, gncl_port: 0, ..at(&["[::1]:9"]) };
    assert_eq!(gncl(&alone, &[]), "[::1]:5");
    assert_eq!(gncl(&Announcement { gncl_port6: 0, ..all }, &met), "10.0.0.1:4");
}

// spec: NDL-3.5
#[test]
fn families_alternate_after_the_preferred_and_met_addresses() {
    let further = vec![(0x0a00_0002, 4), (0x0a00_0003, 4)];
    let mut all = at(&["10.0.0.1:7", "[fd00::1]:7", "[fd00::2]:7", "[fd00::3]:7"]);
    all.gncl_further = further;
    let ordered = |met: Option<&str>| {
        let met = met.map(|met| met.parse().unwrap());
        let all = all.gncl_addresses(met, []);
        all.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ")
    };
    let v6_first = "10.0.0.1:4 [fd00::1]:5 10.0.0.2:4 [fd00::2]:5 10.0.0.3:4 [fd00::3]:5";
    assert_eq!(ordered(None), v6_first);
    assert_eq!(ordered(Some("10.0.0.1:7")), v6_first, "it prefers that one");
    assert_eq!(
        ordered(Some("10.0.0.3:7")),
        "10.0.0.1:4 10.0.0.3:4 [fd00::1]:5 10.0.0.2:4 [fd00::2]:5 [fd00::3]:5"
    );
    assert_eq!(
        ordered(Some("[fd00::2]:7")),
        "10.0.0.1:4 [fd00::2]:5 10.0.0.2:4 [fd00::1]:5 10.0.0.3:4 [fd00::3]:5"
    );
    assert_eq!(ordered(Some("10.9.9.9:7")), v6_first, "its GNCL is not where it was met");
}

#[test]
fn addresses_of_a_node_are_bounded_for_any_routes() {
    let paths: Vec<_> = (1..=PATHS_MAX).map(|path| format!("[fe80::{path}]:7")).collect();
    let mut all = at(&paths.iter().map(String::as_str).collect::<Vec<_>>());
    all.gncl_further = (1..=FURTHER_MAX as u32).map(|further| (0x0a00_0100 + further, 4)).collect();
    let routes = (1..100_u32).map(|link| {
        let scoped = |ip: &str| format!("[{ip}%{link}]:7").parse::<SocketAddr>().unwrap();
        (scoped("fe80::99"), scoped("fe80::1"))
    });
    let all = all.gncl_addresses(None, routes).len();
    assert!((1 + FURTHER_MAX + PATHS_MAX..=GNCL_ADDRESSES_MAX).contains(&all), "{all}");
}

#[test]
fn node_without_ipv6_sends_the_old_format() {
    let bytes =
        encode(&Datagram { correlation: 1, sent: Time::ZERO, body: Body::Query(sound()) }, NodeAddress::ALL);
    let contains = |text: &[u8]| bytes.windows(text.len()).any(|part| part == text);
    assert!(contains(b"gncl_port") && !contains(b"ndl6") && !contains(b"gncl_port6"));
    let one = at(&["10.0.0.1:7"]);
    assert!(one.ndl.is_empty() && one.ndl6.is_empty(), "the querying node has that address already");
    let alone = at(&["[fd00::1]:7"]);
    assert_eq!((alone.ndl.len(), &alone.ndl6[..]), (0, &[(0xfd00 << 48, 1, 7)][..]));
}
