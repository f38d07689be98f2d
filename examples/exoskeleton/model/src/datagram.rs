//! The protocol between a joint's applications and its motor device: two small datagrams of fixed size.
//!
//! Little-endian; the last four bytes are the CRC-32 (IEEE) of all bytes before them.
//!
//! ```text
//! offset  0        3     4        5      6      7      8        12        20
//!         "SXD"    kind  version  joint  flags  state  seq u32  t_ns u64  numbers f64 ...  crc u32
//!
//! command  32 bytes  'W'  to the device    flags: 1 torque given, 2 released, 4 at its limit, 8 damp
//!                         state: of the drive; numbers: torque Nm
//! reading  64 bytes  'R'  from the device  flags: 1 the device's watchdog has taken over, 2 a sole is attached
//!                         numbers: angle rad, velocity rad/s, torque Nm, heel N, toe N
//! ```
//!
//! A command with neither torque nor damp only requests readings. A command with damp makes the
//! device act as its watchdog does, until the next torque: it goes to soft damping, no quicker than it may.

use thiserror::Error;

use crate::joint::Joint;
use crate::message::DriveState;
use crate::plant::{DeviceReading, FootReading};

/// Length of a command in bytes.
pub const COMMAND_BYTES: usize = 32;
/// Length of a reading in bytes.
pub const READING_BYTES: usize = 64;

const MAGIC: [u8; 3] = *b"SXD";
const VERSION: u8 = 2;
const NUMBERS_AT: usize = 20;
const CRC_BYTES: usize = 4;

/// A datagram from a drive or sensor to its device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CommandFrame {
    /// The joint.
    pub joint: Joint,
    /// Counts up by one with each command of a sender, wraps.
    pub seq: u32,
    /// Time of sending, ns of the sender's clock.
    pub t_ns: u64,
    /// The order for the device; `None`: no command, only a request for readings.
    pub order: Option<Order>,
    /// Whether walking is released by a command of central that counts; false while the drive accepts none.
    pub released: bool,
    /// Whether the torque law reached its limit.
    pub saturated: bool,
    /// State of the drive.
    pub state: DriveState,
}

/// An order for a device, valid until the next one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Order {
    /// Give this torque, Nm.
    Torque(f64),
    /// Damp softly by itself: the device's safe state, which needs no other process.
    Damp,
}

/// A datagram from a device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// The joint.
    pub joint: Joint,
    /// Counts up by one with each reading, wraps.
    pub seq: u32,
    /// Time of the measurement, ns of the device's clock.
    pub t_ns: u64,
    /// The device.
    pub device: DeviceReading,
    /// The sole; at the ankle only.
    pub foot: Option<FootReading>,
}

/// The reason why bytes are not one of these datagrams. Their sender is at fault; they are counted and
/// dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum DatagramError {
    /// Not of the fixed size, or its check sum is wrong.
    #[error("it is damaged")]
    Damaged,
    /// The first bytes are not those of a datagram of this version, or those of the other kind.
    #[error("it is no datagram of this kind and version")]
    Kind,
    /// There is no such joint, drive state or order.
    #[error("it names no joint, drive state or order")]
    Unknown,
    /// A number is infinite or NaN.
    #[error("a number in it is not finite")]
    NotFinite,
}

/// The part that both kinds share.
struct Head {
    kind: u8,
    joint: Joint,
    flags: u8,
    state: u8,
    seq: u32,
    t_ns: u64,
}

impl CommandFrame {
    const KIND: u8 = b'W';
    const TORQUE: u8 = 1;
    const RELEASED: u8 = 1 << 1;
    const SATURATED: u8 = 1 << 2;
    const DAMP: u8 = 1 << 3;

    /// Returns the encoded bytes.
    #[must_use]
    pub fn encode(&self) -> [u8; COMMAND_BYTES] {
        let (order, torque_nm) = match self.order {
            None => (0, 0.0),
            Some(Order::Torque(torque_nm)) => (Self::TORQUE, torque_nm),
            Some(Order::Damp) => (Self::DAMP, 0.0),
        };
        let flags = order | flag(self.released, Self::RELEASED) | flag(self.saturated, Self::SATURATED);
        let state = self.state.into();
        let head = Head { kind: Self::KIND, joint: self.joint, flags, state, seq: self.seq, t_ns: self.t_ns };
        write(&head, &[torque_nm])
    }

    /// Decodes bytes.
    ///
    /// # Errors
    /// They are no command.
    pub fn decode(bytes: &[u8]) -> Result<Self, DatagramError> {
        let (head, [torque_nm]) = read::<COMMAND_BYTES, 1>(bytes, Self::KIND)?;
        let order = match (head.flags & Self::TORQUE != 0, head.flags & Self::DAMP != 0) {
            (false, false) => None,
            (true, false) => Some(Order::Torque(torque_nm)),
            (false, true) => Some(Order::Damp),
            (true, true) => return Err(DatagramError::Unknown),
        };
        Ok(Self {
            joint: head.joint,
            seq: head.seq,
            t_ns: head.t_ns,
            order,
            released: head.flags & Self::RELEASED != 0,
            saturated: head.flags & Self::SATURATED != 0,
            state: DriveState::try_from(head.state).map_err(|_| DatagramError::Unknown)?,
        })
    }
}

impl Reading {
    const KIND: u8 = b'R';
    const WATCHDOG: u8 = 1;
    const SOLE: u8 = 1 << 1;

    /// Returns the encoded bytes.
    #[must_use]
    pub fn encode(&self) -> [u8; READING_BYTES] {
        let flags = flag(self.device.watchdog_active, Self::WATCHDOG) | flag(self.foot.is_some(), Self::SOLE);
        let head =
            Head { kind: Self::KIND, joint: self.joint, flags, state: 0, seq: self.seq, t_ns: self.t_ns };
        let foot = self.foot.unwrap_or_default();
        let device = &self.device;
        write(&head, &[device.angle_rad, device.velocity_rad_s, device.torque_nm, foot.heel_n, foot.toe_n])
    }

    /// Decodes bytes.
    ///
    /// # Errors
    /// They are no reading.
    pub fn decode(bytes: &[u8]) -> Result<Self, DatagramError> {
        let (head, [angle_rad, velocity_rad_s, torque_nm, heel_n, toe_n]) =
            read::<READING_BYTES, 5>(bytes, Self::KIND)?;
        let watchdog_active = head.flags & Self::WATCHDOG != 0;
        Ok(Self {
            joint: head.joint,
            seq: head.seq,
            t_ns: head.t_ns,
            device: DeviceReading { angle_rad, velocity_rad_s, torque_nm, watchdog_active },
            foot: (head.flags & Self::SOLE != 0).then_some(FootReading { heel_n, toe_n }),
        })
    }
}

const fn flag(set: bool, bit: u8) -> u8 {
    if set { bit } else { 0 }
}

fn write<const BYTES: usize>(head: &Head, numbers: &[f64]) -> [u8; BYTES] {
    let mut bytes = [0; BYTES];
    bytes[..3].copy_from_slice(&MAGIC);
    bytes[3] = head.kind;
    bytes[4] = VERSION;
    bytes[5] = head.joint.index() as u8;
    bytes[6] = head.flags;
    bytes[7] = head.state;
    bytes[8..12].copy_from_slice(&head.seq.to_le_bytes());
    bytes[12..NUMBERS_AT].copy_from_slice(&head.t_ns.to_le_bytes());
    for (place, number) in bytes[NUMBERS_AT..BYTES - CRC_BYTES].chunks_exact_mut(8).zip(numbers) {
        place.copy_from_slice(&number.to_le_bytes());
    }
    let crc = crc32fast::hash(&bytes[..BYTES - CRC_BYTES]);
    bytes[BYTES - CRC_BYTES..].copy_from_slice(&crc.to_le_bytes());
    bytes
}

fn read<const BYTES: usize, const NUMBERS: usize>(
    bytes: &[u8],
    kind: u8,
) -> Result<(Head, [f64; NUMBERS]), DatagramError> {
    let bytes: &[u8; BYTES] = bytes.try_into().map_err(|_| DatagramError::Damaged)?;
    if bytes[..3] != MAGIC || bytes[3] != kind || bytes[4] != VERSION {
        return Err(DatagramError::Kind);
    }
    let (checked, crc) = bytes.split_at(BYTES - CRC_BYTES);
    if crc32fast::hash(checked).to_le_bytes() != *crc {
        return Err(DatagramError::Damaged);
    }
    let joint = *Joint::ALL.get(usize::from(bytes[5])).ok_or(DatagramError::Unknown)?;
    let numbers: [f64; NUMBERS] = std::array::from_fn(|i| {
        f64::from_le_bytes(eight(&bytes[NUMBERS_AT + 8 * i..NUMBERS_AT + 8 * i + 8]))
    });
    if !numbers.iter().all(|number| number.is_finite()) {
        return Err(DatagramError::NotFinite);
    }
    let seq = u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]);
    let t_ns = u64::from_le_bytes(eight(&bytes[12..NUMBERS_AT]));
    Ok((Head { kind, joint, flags: bytes[6], state: bytes[7], seq, t_ns }, numbers))
}

fn eight(bytes: &[u8]) -> [u8; 8] {
    bytes.try_into().expect("every caller cuts eight bytes")
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn command(seq: u32, t_ns: u64, order: Option<Order>, state: u8) -> CommandFrame {
        let state = DriveState::try_from(state).unwrap();
        CommandFrame {
            joint: Joint::Knee,
            seq,
            t_ns,
            order,
            released: seq.is_multiple_of(2),
            saturated: seq.is_multiple_of(3),
            state,
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_a_datagram_or_a_fault(bytes in prop::collection::vec(any::<u8>(), 0..100)) {
            let _ = CommandFrame::decode(&bytes);
            let _ = Reading::decode(&bytes);
        }

        #[test]
        fn bytes_with_a_valid_crc_decode_or_fail(bytes: [u8; COMMAND_BYTES]) {
            let mut bytes = bytes;
            bytes[..5].copy_from_slice(&[b'S', b'X', b'D', b'W', VERSION]);
            let crc = crc32fast::hash(&bytes[..COMMAND_BYTES - CRC_BYTES]);
            bytes[COMMAND_BYTES - CRC_BYTES..].copy_from_slice(&crc.to_le_bytes());
            if let Ok(command) = CommandFrame::decode(&bytes) {
                prop_assert!(!matches!(command.order, Some(Order::Torque(torque_nm)) if !torque_nm.is_finite()));
            }
        }

        #[test]
        fn command_reads_back(seq: u32, t_ns: u64, torque_nm in -500.0..500.0, order in 0..3, state in 0u8..5) {
            let order = [None, Some(Order::Damp), Some(Order::Torque(torque_nm))][order as usize];
            let command = command(seq, t_ns, order, state);
            prop_assert_eq!(CommandFrame::decode(&command.encode()), Ok(command));
        }

        #[test]
        fn one_damaged_byte_is_detected(at in 0..COMMAND_BYTES, by in 1u8..=255) {
            let mut bytes = command(1, 2, Some(Order::Torque(3.0)), 2).encode();
            bytes[at] ^= by;
            prop_assert!(CommandFrame::decode(&bytes).is_err());
        }
    }

    #[test]
    fn reading_reads_back_with_and_without_a_sole() {
        let device =
            DeviceReading { angle_rad: 0.1, velocity_rad_s: -2.0, torque_nm: 3.5, watchdog_active: true };
        for foot in [None, Some(FootReading { heel_n: 400.0, toe_n: 0.5 })] {
            let reading = Reading { joint: Joint::Ankle, seq: u32::MAX, t_ns: 7, device, foot };
            assert_eq!(Reading::decode(&reading.encode()), Ok(reading));
        }
    }

    #[test]
    fn nan_torque_is_rejected() {
        let bytes = command(1, 2, Some(Order::Torque(f64::NAN)), 1).encode();
        assert_eq!(CommandFrame::decode(&bytes), Err(DatagramError::NotFinite));
    }

    #[test]
    fn reading_is_not_decoded_as_command() {
        let reading =
            Reading { joint: Joint::Hip, seq: 1, t_ns: 2, device: DeviceReading::default(), foot: None };
        assert_eq!(CommandFrame::decode(&reading.encode()[..COMMAND_BYTES]), Err(DatagramError::Kind));
    }
}
