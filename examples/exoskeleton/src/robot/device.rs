//! The hardware interface: the device that a joint's sensor and drive use, and its implementation over UDP.
//!
//! A real motor on CAN or EtherCAT implements [`JointDevice`]; nothing above this file changes.

use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use exoskeleton_model::datagram::{CommandFrame, Order, READING_BYTES, Reading};
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::DriveState;
use sinew::Time;

/// Time between two requests for readings, ns.
const REQUEST_PERIOD_NS: u64 = 100_000_000;
/// Datagrams read in one call: more than the socket's buffer holds after any pause, but still a bound.
const READS_MAX: usize = 4_096;

/// The command of a drive to its device, each millisecond.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveCommand {
    /// Torque to apply, Nm.
    pub torque_nm: f64,
    /// Whether walking is released.
    pub released: bool,
    /// Whether the torque law reached its limit.
    pub saturated: bool,
    /// State of the drive.
    pub state: DriveState,
}

/// The motor device of one joint. No method blocks.
pub trait JointDevice {
    /// Returns the newest reading since the last call; `None` if there is none.
    fn read_newest(&mut self, now: Time) -> Option<Reading>;

    /// Sends a command. The next one replaces a lost one; a device that receives none holds its last torque.
    fn command(&mut self, now: Time, command: &DriveCommand);

    /// Returns a sender of [`Damper::damp`] to this device that works even if the thread that owns the device
    /// hangs.
    fn damper(&self) -> Box<dyn Damper>;
}

/// Removes the torque of a device, from any thread.
pub trait Damper: Send {
    /// Orders the device to damp softly by itself until its next torque; `state` is the drive's. It neither
    /// waits nor takes a lock: the thread that makes outputs safe calls it, and all outputs of the process
    /// wait for that thread.
    fn damp(&self, now: Time, state: DriveState);
}

/// The device of a joint, behind the plant's UDP address.
#[derive(Debug)]
pub struct UdpDevice {
    sender: DeviceSender,
    requested_at: Option<Time>,
}

/// The sender to the device. Its clones share one counter, because the device accepts no frame older than the
/// last.
#[derive(Debug, Clone)]
struct DeviceSender {
    joint: Joint,
    socket: Arc<UdpSocket>,
    seq: Arc<AtomicU32>,
}

impl DeviceSender {
    /// Sends `frame`; fills in its joint, number and time.
    fn send(&self, now: Time, frame: CommandFrame) {
        // SYNC: Relaxed, no other data depends on the number.
        let seq = self.seq.fetch_add(1, Ordering::Relaxed).wrapping_add(1);
        let frame = CommandFrame { joint: self.joint, seq, t_ns: now.as_nanos(), ..frame };
        // There is no plant yet, or a full queue: the next frame follows in a millisecond, and the plant
        // detects silence.
        let _ = self.socket.send(&frame.encode());
    }

    /// Creates a frame without an order.
    const fn frame(&self) -> CommandFrame {
        CommandFrame {
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

impl Damper for DeviceSender {
    fn damp(&self, now: Time, state: DriveState) {
        self.send(now, CommandFrame { order: Some(Order::Damp), state, ..self.frame() });
    }
}

impl UdpDevice {
    /// Creates the connection to the device; sends nothing yet.
    ///
    /// # Errors
    /// The system provides no socket, or the address cannot be reached from here.
    pub fn connect(joint: Joint, plant: SocketAddr) -> io::Result<Self> {
        let socket = match plant {
            SocketAddr::V4(_) => UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?,
            SocketAddr::V6(_) => UdpSocket::bind((Ipv6Addr::UNSPECIFIED, 0))?,
        };
        // From now on the kernel drops datagrams from all other senders.
        socket.connect(plant)?;
        socket.set_nonblocking(true)?;
        let sender = DeviceSender { joint, socket: Arc::new(socket), seq: Arc::default() };
        Ok(Self { sender, requested_at: None })
    }

    /// Requests readings at intervals, since a restarted device forgets its listeners.
    fn request_readings(&mut self, now: Time) {
        let due =
            self.requested_at.is_none_or(|at| now.since(at).as_nanos() >= u128::from(REQUEST_PERIOD_NS));
        if due {
            self.requested_at = Some(now);
            self.sender.send(now, self.sender.frame());
        }
    }
}

impl JointDevice for UdpDevice {
    fn read_newest(&mut self, now: Time) -> Option<Reading> {
        self.request_readings(now);
        let mut newest = None;
        let mut buffer = [0; READING_BYTES + 1];
        for _ in 0..READS_MAX {
            match self.sender.socket.recv(&mut buffer) {
                Ok(length) => {
                    // Reads all that wait: after a pause the first of them are old. Others are dropped.
                    let reading = Reading::decode(&buffer[..length]).ok();
                    newest = reading.filter(|reading| reading.joint == self.sender.joint).or(newest);
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                // The plant's port is closed: it is not open yet, or not any more.
                Err(_) => {}
            }
        }
        newest
    }

    fn command(&mut self, now: Time, command: &DriveCommand) {
        let DriveCommand { torque_nm, released, saturated, state } = *command;
        let order = Some(Order::Torque(torque_nm));
        self.sender.send(now, CommandFrame { order, released, saturated, state, ..self.sender.frame() });
    }

    fn damper(&self) -> Box<dyn Damper> {
        Box::new(self.sender.clone())
    }
}
