//! The seam to the hardware: what a sensor and a drive need of their joint's device, and the device behind UDP.
//!
//! A real motor on CAN or EtherCAT implements [`JointDevice`]; nothing above this file changes.

use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};

use sinew::Time;

use super::datagram::{READING_BYTES, Reading, Word};
use crate::joint::Joint;
use crate::message::DriveState;

/// Time between two wishes for readings, ns.
const WISH_PERIOD_NS: u64 = 100_000_000;
/// Datagrams looked at in one call: more than the socket's buffer holds after any pause, and still a bound.
const READS_MAX: usize = 4_096;

/// What a drive says to its device each millisecond.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveCommand {
    /// Torque to give, Nm.
    pub torque_nm: f64,
    /// Whether walking is released.
    pub released: bool,
    /// Whether the torque law met its limit.
    pub saturated: bool,
    /// State of the drive, as a status word.
    pub state: DriveState,
}

/// The motor device of one joint. Nothing here waits.
pub trait JointDevice {
    /// The newest reading since the last call; `None` when there is none.
    fn read_newest(&mut self, now: Time) -> Option<Reading>;

    /// Gives a command. One that is lost is made good by the next; a device that hears none holds its last torque.
    fn command(&mut self, now: Time, command: &DriveCommand);
}

/// The device of a joint, behind the plant's UDP address.
#[derive(Debug)]
pub struct UdpDevice {
    joint: Joint,
    socket: UdpSocket,
    seq: u32,
    wished_at: Option<Time>,
    refused: u64,
}

impl UdpDevice {
    /// The way to the device; nothing is sent yet.
    ///
    /// # Errors
    /// The system gives no socket, or the address cannot be reached from here.
    pub fn connect(joint: Joint, plant: SocketAddr) -> io::Result<Self> {
        let socket = match plant {
            SocketAddr::V4(_) => UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?,
            SocketAddr::V6(_) => UdpSocket::bind((Ipv6Addr::UNSPECIFIED, 0))?,
        };
        // From now on the kernel drops what comes from anybody else.
        socket.connect(plant)?;
        socket.set_nonblocking(true)?;
        Ok(Self { joint, socket, seq: 0, wished_at: None, refused: 0 })
    }

    /// Datagrams that were no readings of this joint.
    #[must_use]
    pub const fn refused(&self) -> u64 {
        self.refused
    }

    fn say(&mut self, now: Time, command: Option<&DriveCommand>) {
        self.seq = self.seq.wrapping_add(1);
        let word = Word {
            joint: self.joint,
            seq: self.seq,
            t_ns: now.as_nanos(),
            torque_nm: command.map(|command| command.torque_nm),
            released: command.is_some_and(|command| command.released),
            saturated: command.is_some_and(|command| command.saturated),
            state: command.map_or(DriveState::Init, |command| command.state),
        };
        // No plant yet, or a full queue: the next word comes in a millisecond, and silence is the plant's to notice.
        let _ = self.socket.send(&word.encode());
    }

    /// The device forgets who wants its readings when it is restarted, so it is told now and then.
    fn wish_for_readings(&mut self, now: Time) {
        let due = self.wished_at.is_none_or(|at| now.since(at).as_nanos() >= u128::from(WISH_PERIOD_NS));
        if due {
            self.wished_at = Some(now);
            self.say(now, None);
        }
    }
}

impl JointDevice for UdpDevice {
    fn read_newest(&mut self, now: Time) -> Option<Reading> {
        self.wish_for_readings(now);
        let mut newest = None;
        let mut buffer = [0; READING_BYTES + 1];
        for _ in 0..READS_MAX {
            match self.socket.recv(&mut buffer) {
                Ok(length) => match Reading::decode(&buffer[..length]) {
                    // All that wait are read: after a pause the first of them are old.
                    Ok(reading) if reading.joint == self.joint => newest = Some(reading),
                    Ok(_) | Err(_) => self.refused += 1,
                },
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                // The plant's port is closed: it is not there yet, or not any more.
                Err(_) => {}
            }
        }
        newest
    }

    fn command(&mut self, now: Time, command: &DriveCommand) {
        self.say(now, Some(command));
    }
}
