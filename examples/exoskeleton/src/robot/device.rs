//! The seam to the hardware: what a sensor and a drive need of their joint's device, and the device behind UDP.
//!
//! A real motor on CAN or EtherCAT implements [`JointDevice`]; nothing above this file changes.

use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use sinew::Time;

use super::datagram::{Order, READING_BYTES, Reading, Word};
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

    /// Who says [`Damper::damp`] to this device, whatever becomes of the thread that has the device.
    fn damper(&self) -> Box<dyn Damper>;
}

/// Takes a device its torque away, from any thread.
pub trait Damper: Send {
    /// Has the device damp softly by itself, until it is given a torque again; `state` is the drive's. It neither waits nor takes a lock: it is
    /// called by the thread that makes outputs safe, for which all outputs of the process wait.
    fn damp(&self, now: Time, state: DriveState);
}

/// The device of a joint, behind the plant's UDP address.
#[derive(Debug)]
pub struct UdpDevice {
    mouth: Mouth,
    wished_at: Option<Time>,
    refused: u64,
}

/// What speaks to the device. Its clones count their words together, as the device takes none that is older than the last.
#[derive(Debug, Clone)]
struct Mouth {
    joint: Joint,
    socket: Arc<UdpSocket>,
    seq: Arc<AtomicU32>,
}

impl Mouth {
    /// Says `word`, whose joint, number and time are filled in here.
    fn say(&self, now: Time, word: Word) {
        // SYNC: Relaxed, the number stands for itself.
        let seq = self.seq.fetch_add(1, Ordering::Relaxed).wrapping_add(1);
        let word = Word { joint: self.joint, seq, t_ns: now.as_nanos(), ..word };
        // No plant yet, or a full queue: the next word comes in a millisecond, and silence is the plant's to notice.
        let _ = self.socket.send(&word.encode());
    }

    /// A word that says nothing.
    const fn word(&self) -> Word {
        Word {
            joint: self.joint,
            seq: 0,
            t_ns: 0,
            order: None,
            released: false,
            saturated: false,
            state: DriveState::Init,
        }
    }
}

impl Damper for Mouth {
    fn damp(&self, now: Time, state: DriveState) {
        self.say(now, Word { order: Some(Order::Damp), state, ..self.word() });
    }
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
        let mouth = Mouth { joint, socket: Arc::new(socket), seq: Arc::default() };
        Ok(Self { mouth, wished_at: None, refused: 0 })
    }

    /// Datagrams that were no readings of this joint.
    #[must_use]
    pub const fn refused(&self) -> u64 {
        self.refused
    }

    /// The device forgets who wants its readings when it is restarted, so it is told now and then.
    fn wish_for_readings(&mut self, now: Time) {
        let due = self.wished_at.is_none_or(|at| now.since(at).as_nanos() >= u128::from(WISH_PERIOD_NS));
        if due {
            self.wished_at = Some(now);
            self.mouth.say(now, self.mouth.word());
        }
    }
}

impl JointDevice for UdpDevice {
    fn read_newest(&mut self, now: Time) -> Option<Reading> {
        self.wish_for_readings(now);
        let mut newest = None;
        let mut buffer = [0; READING_BYTES + 1];
        for _ in 0..READS_MAX {
            match self.mouth.socket.recv(&mut buffer) {
                Ok(length) => match Reading::decode(&buffer[..length]) {
                    // All that wait are read: after a pause the first of them are old.
                    Ok(reading) if reading.joint == self.mouth.joint => newest = Some(reading),
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
        let DriveCommand { torque_nm, released, saturated, state } = *command;
        let order = Some(Order::Torque(torque_nm));
        self.mouth.say(now, Word { order, released, saturated, state, ..self.mouth.word() });
    }

    fn damper(&self) -> Box<dyn Damper> {
        Box::new(self.mouth.clone())
    }
}
