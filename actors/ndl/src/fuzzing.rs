//! Fuzz targets for discovery datagrams and for files of remembered peers, with the properties that they check.

use std::net::SocketAddr;

use sinew_model::{config::NodeConfig, leave_reason::LeaveReason, progress::Progress};
use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{HEADER_LEN, Header, MAGIC, VERSION},
};

use super::{
    core::{Core, Input, REMEMBERED_MAX, RememberedPeer, UNANSWERED_MAX},
    datagram::{
        Announcement, Answer, Body, Claim, DATAGRAM_MAX, Datagram, Leave, encode, maker_of, parse,
        peek_answer,
    },
    peers_file,
};

const HERE: NodeAddress = NodeAddress::new(5);

pub fn some_datagrams() -> Vec<Vec<u8>> {
    let announcement = Announcement {
        project: "exo".to_owned(),
        node: NodeAddress::new(2),
        name: "knee".to_owned(),
        incarnation: Incarnation(1),
        boot_nonce: 7,
        gncl_ip: 0x0a00_0002,
        gncl_port: 7_777,
        period_us: 500_000,
        gncl_further: vec![(0x0a00_0102, 7_777)],
        ndl: vec![(0x0a00_0002, 6_910), (0x0a00_0102, 6_910)],
        ndl6: Vec::new(),
        gncl_port6: 0,
        claim: Claim::Held,
    };
    let answer = Answer {
        announcement: announcement.clone(),
        query_sent_ns: 1,
        query_received_ns: 2,
        progress: Progress::default(),
    };
    // Both families, and IPv6 alone.
    let ndl6 = vec![(0xfe80 << 48, 2, 6_910), (0xfd00 << 48, 2, 6_910)];
    let both = Announcement { ndl6: ndl6.clone(), gncl_port6: 7_777, ..announcement.clone() };
    let (ndl, gncl_further) = (Vec::new(), Vec::new());
    let alone = Announcement { gncl_ip: 0, gncl_port: 0, gncl_further, ndl, ..both.clone() };
    let answer_of_both = Answer { announcement: both, ..answer.clone() };
    let bodies = [
        Body::Query(announcement.clone()),
        Body::Answer(answer),
        Body::Leave(announcement.clone().into()),
        Body::Leave(Leave { announcement, gave_up: Some(LeaveReason::of("applications: knee.drive")) }),
        Body::Answer(answer_of_both),
        Body::Query(alone),
    ];
    let written =
        bodies.map(|body| encode(&Datagram { correlation: 3, sent: Time::from_nanos(4), body }, HERE));
    written.map(|bytes| bytes.to_vec()).into()
}

pub fn discovery(bytes: &[u8]) -> bool {
    let is_read = read(bytes);
    let mut mended = bytes.to_vec();
    mend(&mut mended);
    read(&mended) || is_read
}

fn read(bytes: &[u8]) -> bool {
    // Both parsers get unchecked bytes.
    let _ = (peek_answer(bytes), maker_of(bytes));
    let Ok(read) = parse(HERE, bytes) else { return false };
    assert!(bytes.len() <= DATAGRAM_MAX);
    let announcement = read.body.announcement();
    assert!(
        announcement.node.is_single() && announcement.gncl_addresses(None, []).len() <= 16,
        "{announcement:?}"
    );
    assert_eq!(maker_of(bytes), Some(announcement.node));
    let again = encode(&read, HERE);
    if again.len() <= DATAGRAM_MAX {
        assert_eq!(parse(HERE, &again).expect("what was written can be read"), read);
    }
    true
}

/// Completes the input with fields that no fuzzer guesses: the start of a frame, its length and its checksum,
/// and half of the time its destination.
fn mend(bytes: &mut [u8]) {
    let Some(length) = bytes.len().checked_sub(HEADER_LEN) else { return };
    bytes[..2].copy_from_slice(&MAGIC);
    bytes[2..4].copy_from_slice(&[VERSION, HEADER_LEN as u8]);
    bytes[4..8].copy_from_slice(&(length as u32).to_le_bytes());
    if bytes[24] & 1 == 0 {
        bytes[24..32].copy_from_slice(&Tid::new(HERE, AppAddress::NDL).bits().to_le_bytes());
    }
    if bytes[16] & 1 == 0 {
        bytes[16..20].copy_from_slice(&AppAddress::NDL.bits().to_le_bytes());
    }
    let (head, payload) = bytes.split_at_mut(HEADER_LEN);
    let head: &mut [u8; HEADER_LEN] = head.try_into().expect("it was split there");
    // Keeps the header's fields, and corrects its checksum.
    if let Ok(header) = Header::decode_in_memory(head) {
        *head = header.encode(payload);
    }
}

pub fn some_peers() -> Vec<Vec<u8>> {
    let lines = "10.0.0.7:6911 10.0.0.7 0\n[fd00::9]:6911 10.0.0.9 3\n[fe80::9]:1 10.0.0.9 7\n";
    let full: String = (1..=80).map(|last| format!("10.0.0.{last}:1 10.0.0.{last} 0\n")).collect();
    // A valid line of each kind, and an invalid one.
    let damaged = format!("{lines}10.0.0.8:0 10.0.0.8 0\n");
    [lines, &full, &damaged].map(|lines| [peers_file::FIRST_LINE, "\n", lines].concat().into_bytes()).into()
}

pub fn peers(bytes: &[u8]) -> bool {
    let is_read = are_read(bytes);
    // No fuzzer guesses the first line of the file.
    are_read(&[peers_file::FIRST_LINE.as_bytes(), b"\n", bytes].concat()) || is_read
}

fn are_read(bytes: &[u8]) -> bool {
    let kept = peers_file::parse(bytes);
    assert!(kept.peers.len() <= REMEMBERED_MAX);
    assert!(kept.unreadable.is_none_or(|(count, first)| count > 0 && first > 0), "{:?}", kept.unreadable);
    for RememberedPeer { address, node, unanswered } in &kept.peers {
        assert!(node.is_single() && *unanswered < UNANSWERED_MAX, "{node} {unanswered}");
        assert!(address.port() != 0 && !address.ip().is_unspecified() && !address.ip().is_multicast());
    }
    let written = peers_file::text(&kept.peers);
    assert!(written.len() as u64 <= peers_file::BYTES_MAX, "what is written can be read");
    let again = peers_file::parse(written.as_bytes());
    assert!(again.peers == kept.peers && again.unreadable.is_none(), "{again:?}");
    are_taken(kept.peers)
}

/// Checks that a core accepts the peers within its bounds, and queries each of them at most once from its only address.
fn are_taken(peers: Vec<RememberedPeer>) -> bool {
    let is_any = !peers.is_empty();
    let ours = SocketAddr::from(([10, 0, 0, 1], 6_911));
    let mut core = Core::new(&NodeConfig::new("hip"), HERE, Incarnation(1), 1, 1);
    core.start(Time::ZERO, &[ours]);
    while core.poll().is_some() {}
    core.handle(Time::ZERO, Input::PeersRemembered(peers));
    let remembered = core.remembered();
    assert!(remembered.len() <= REMEMBERED_MAX);
    for peer in &remembered {
        let of_one = remembered.iter().filter(|other| other.node == peer.node).count();
        let at_one = remembered.iter().filter(|other| other.address == peer.address).count();
        assert!(of_one <= 2 && at_one == 1, "{remembered:?}");
    }
    let queried = std::iter::from_fn(|| core.poll()).count();
    assert!(queried <= remembered.len(), "{queried} {remembered:?}");
    is_any
}
