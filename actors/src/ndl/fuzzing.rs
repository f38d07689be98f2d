//! Any datagram of discovery, against what is promised.

use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{HEADER_LEN, Header, MAGIC, VERSION},
};

use super::Progress;
use super::datagram::{
    Announcement, Answer, Body, Claim, DATAGRAM_MAX, Datagram, encode, maker_of, parse, peek_answer,
};

const HERE: NodeAddress = NodeAddress::new(5);

pub(crate) fn some_datagrams() -> Vec<Vec<u8>> {
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
    // Of both families, and of IPv6 alone.
    let ndl6 = vec![(0xfe80 << 48, 2, 6_910), (0xfd00 << 48, 2, 6_910)];
    let both = Announcement { ndl6: ndl6.clone(), gncl_port6: 7_777, ..announcement.clone() };
    let (ndl, gncl_further) = (Vec::new(), Vec::new());
    let alone = Announcement { gncl_ip: 0, gncl_port: 0, gncl_further, ndl, ..both.clone() };
    let answer_of_both = Answer { announcement: both, ..answer.clone() };
    let bodies = [
        Body::Query(announcement.clone()),
        Body::Answer(answer),
        Body::Leave(announcement),
        Body::Answer(answer_of_both),
        Body::Query(alone),
    ];
    let written =
        bodies.map(|body| encode(&Datagram { correlation: 3, sent: Time::from_nanos(4), body }, HERE));
    written.map(|bytes| bytes.to_vec()).into()
}

pub(crate) fn discovery(bytes: &[u8]) -> bool {
    let is_read = read(bytes);
    let mut mended = bytes.to_vec();
    mend(&mut mended);
    read(&mended) || is_read
}

fn read(bytes: &[u8]) -> bool {
    // Both look at bytes of which nothing was checked.
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

/// Gives it what no fuzzer guesses: how frames start, its length, its checksum; whom it is for, half of the time.
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
    // What the header says is kept, and its checksum made right.
    if let Ok(header) = Header::decode_in_memory(head) {
        *head = header.encode(payload);
    }
}
