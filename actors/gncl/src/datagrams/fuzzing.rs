//! Fuzzing of the datagrams: arbitrary datagrams for values of class Stream, and arbitrary sequences of them.

use sinew_runtime::{tid::NodeAddress, time::Time, wire::decode_datagram};

use super::{
    core::Core,
    lengths::SHORTEST,
    packet::{Packet, Prefix, RANGES_MAX},
};

/// Offset of the checksum of the bytes before the value.
const CRC_AT: usize = 20;

pub fn some_datagrams() -> Vec<Vec<u8>> {
    let packet = || Packet::new(NodeAddress::new(2), 7, 9);
    let mut probe = packet();
    probe.probe(7, SHORTEST);
    let mut value = packet();
    value.value(b"a frame's header", b"and its payload");
    let mut core = Core::<u64, u64>::new(1);
    assert!(core.incoming.on_value(Time::ZERO, 3, 1, 5));
    let ack = core.incoming.take(Time::ZERO, RANGES_MAX).expect("something has come");
    let mut acknowledgement = packet();
    acknowledgement.acknowledge(&ack);
    [probe, value, acknowledgement].map(|mut packet| [&[0][..], packet.bytes()].concat()).into()
}

/// Passes datagrams in sequence to a core with values in flight. A byte before each datagram is its length
/// (0: to the end).
pub fn datagrams(bytes: &[u8]) -> bool {
    let mut core = Core::<u64, u64>::new(1);
    core.announced(Time::ZERO);
    let (mut rest, mut now, mut is_understood) = (bytes, Time::from_nanos(1_000_000), false);
    while let Some((length, behind)) = rest.split_first() {
        let length = if *length == 0 { behind.len() } else { behind.len().min((*length).into()) };
        let (datagram, behind) = behind.split_at(length);
        rest = behind;
        is_understood |= come(&mut core, now, &mut datagram.to_vec());
        now = now + std::time::Duration::from_millis(1);
        // The value is refused while datagrams do not get through.
        let _ = core.submit(u64::from(length as u8 & 3), 0, 100, Time::MAX);
        core.tick(now, Time::ZERO);
        // One datagram may release all values in flight.
        for _ in 0..512 {
            if core.poll(now).is_none() {
                break;
            }
            if core.incoming.is_due(now) {
                let ack = core.incoming.take(now, RANGES_MAX);
                assert!(ack.is_none_or(|ack| ack.ranges().len() <= RANGES_MAX));
            }
        }
    }
    is_understood
}

fn come(core: &mut Core<u64, u64>, now: Time, datagram: &mut [u8]) -> bool {
    // The datagram is processed unchanged, then with a correct checksum, which a fuzzer cannot guess.
    for _ in 0..2 {
        if let Some((prefix, content)) = Prefix::read(datagram).and_then(|p| Some((p, p.content(datagram)?)))
        {
            if let Some(ack) = &content.acknowledgement {
                assert!(ack.ranges().len() <= RANGES_MAX);
                core.acknowledged(now, ack);
            }
            if let Some(number) = content.probe {
                core.on_probe(now, prefix.stamp, number);
            }
            if let Some(frame) = content.value {
                let number =
                    decode_datagram(frame).map_or_else(|_| frame.len() as u64, |read| read.header.sequence);
                core.incoming.on_value(now, prefix.stamp, number & 7, number);
            }
            return true;
        }
        mend(datagram);
    }
    false
}

fn mend(datagram: &mut [u8]) {
    const HEAD_MIN: usize = CRC_AT + 4;
    if datagram.len() < HEAD_MIN {
        return;
    }
    datagram[0] = 1;
    datagram[1] &= 7;
    datagram[2..4].fill(0);
    let mut head = HEAD_MIN;
    if datagram[1] & 1 == 1 {
        let Some([count, zeros @ ..]) = datagram.get_mut(HEAD_MIN + 16..HEAD_MIN + 20) else { return };
        *count %= RANGES_MAX as u8 + 1;
        zeros.fill(0);
        head += 20 + 12 * usize::from(*count);
    }
    let Some(checked) = datagram.get(HEAD_MIN..head) else { return };
    let mut crc = crc32fast::Hasher::new();
    crc.update(&datagram[..CRC_AT]);
    crc.update(checked);
    datagram[CRC_AT..HEAD_MIN].copy_from_slice(&crc.finalize().to_le_bytes());
}
