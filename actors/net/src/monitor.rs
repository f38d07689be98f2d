//! The subscription to the kernel's reports. It never blocks, except in the functions with a time limit.
//!
//! A request may wait for a lock that the kernel holds while an interface is configured.

use std::{
    io,
    net::SocketAddr,
    os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd},
    time::{Duration, Instant},
};

use rustix::{
    event::{PollFd, PollFlags, poll},
    io::Errno,
    net::{
        AddressFamily, RecvFlags, SendFlags, SocketFlags, SocketType, bind, netlink::SocketAddrNetlink, recv,
        send, socket_with,
    },
};

use crate::{
    report::Dump,
    table::{InterfaceAddress, Received, Table},
};

/// Receive buffer, larger than one report of the kernel, and as large as the largest part of a dump.
const BUFFER_LEN: usize = 32 << 10;
/// The reports of changed interfaces and addresses.
const GROUPS: u32 = (libc::RTMGRP_LINK | libc::RTMGRP_IPV4_IFADDR | libc::RTMGRP_IPV6_IFADDR) as u32;
/// Maximum number of reads that make one step of [`InterfaceMonitor::wait`], so that a flapping interface
/// ends it.
const READS_MAX: usize = 4_096;

/// Watches the interfaces of the network namespace in which it was made.
#[derive(Debug)]
pub struct InterfaceMonitor {
    socket: OwnedFd,
    table: Table,
    buffer: Vec<u8>,
    is_subscribed: bool,
    /// Whether the kernel's buffer has overflowed. The kernel sends nothing new before its buffered messages
    /// are read, and does not report the overflow again.
    has_overflowed: bool,
}

impl InterfaceMonitor {
    /// Subscribes to the kernel's reports.
    ///
    /// # Errors
    /// The process has no descriptor left, or the system does not permit it.
    pub fn subscribe() -> io::Result<Self> {
        Self::open(GROUPS)
    }

    /// Creates a monitor without reports, which only lists the present addresses.
    ///
    /// # Errors
    /// The process has no descriptor left, or the system does not permit it.
    pub fn without_reports() -> io::Result<Self> {
        Self::open(0)
    }

    fn open(groups: u32) -> io::Result<Self> {
        let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
        let socket = socket_with(AddressFamily::NETLINK, SocketType::RAW, flags, None)?;
        bind(&socket, &SocketAddrNetlink::new(0, groups))?;
        let (table, buffer) = (Table::default(), vec![0; BUFFER_LEN]);
        Ok(Self { socket, table, buffer, is_subscribed: groups != 0, has_overflowed: false })
    }

    /// Returns whether the kernel reports changes to this monitor.
    #[must_use]
    pub const fn is_subscribed(&self) -> bool {
        self.is_subscribed
    }

    /// Requests the present addresses. Only those that are known can be reported lost by the state of an
    /// interface.
    ///
    /// # Errors
    /// The error of the system.
    pub fn request_addresses(&mut self) -> io::Result<()> {
        let dump = self.table.begin();
        self.request(Some(dump))
    }

    /// Processes the kernel's next messages. Returns the lost addresses.
    ///
    /// # Errors
    /// `WouldBlock` if there are no messages. Any other error of the system is permanent.
    pub fn receive_lost(&mut self) -> io::Result<Vec<SocketAddr>> {
        self.receive().map(|received| received.lost)
    }

    /// Waits until the kernel reports a change, for `within` at most. Returns whether it did.
    ///
    /// # Errors
    /// The error of the system, which is permanent.
    pub fn wait(&mut self, within: Duration) -> io::Result<bool> {
        if !self.is_readable(within)? {
            return Ok(false);
        }
        let mut has_changed = false;
        for _ in 0..READS_MAX {
            match self.receive() {
                Ok(received) => has_changed |= received.has_changed,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(error) => return Err(error),
            }
        }
        // After an overflow a dump is running: its content is a change.
        Ok(has_changed || self.table.is_listing())
    }

    /// Lists the present addresses, in the kernel's order, and waits for the answer, for `within` at most.
    ///
    /// # Errors
    /// `TimedOut` if the kernel does not answer in time, or changes too often. Any other error of the system.
    pub fn read_all(&mut self, within: Duration) -> io::Result<Vec<InterfaceAddress>> {
        let end = Instant::now() + within;
        let dump = self.table.on_missed_reports();
        self.request(dump)?;
        while self.table.is_listing() {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(io::ErrorKind::TimedOut.into());
            }
            if !self.is_readable(left)? {
                continue;
            }
            match self.receive() {
                Ok(Received { refused: Some(code), .. }) => return Err(io::Error::from_raw_os_error(code)),
                Ok(_) => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => return Err(error),
            }
        }
        Ok(self.table.addresses())
    }

    fn receive(&mut self) -> io::Result<Received> {
        loop {
            match recv(&self.socket, &mut self.buffer[..], RecvFlags::empty()) {
                Ok((length, _)) => {
                    let received = self.table.receive(&self.buffer[..length.min(BUFFER_LEN)]);
                    self.request(received.request)?;
                    return Ok(received);
                }
                Err(Errno::NOBUFS) => self.has_overflowed = true,
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => {
                    // A dump requested before all messages are read would miss the changes until then.
                    if std::mem::take(&mut self.has_overflowed) {
                        let dump = self.table.on_missed_reports();
                        self.request(dump)?;
                    }
                    return Err(io::ErrorKind::WouldBlock.into());
                }
                Err(error) => return Err(error.into()),
            }
        }
    }

    fn request(&self, dump: Option<Dump>) -> io::Result<()> {
        let Some(dump) = dump else { return Ok(()) };
        send(&self.socket, &dump.request(), SendFlags::empty())?;
        Ok(())
    }

    /// Waits until there are messages, for `within` at most.
    fn is_readable(&self, within: Duration) -> io::Result<bool> {
        let within = within.try_into().map_err(io::Error::other)?;
        match poll(&mut [PollFd::new(&self.socket, PollFlags::IN)], Some(&within)) {
            Ok(ready) => Ok(ready > 0),
            Err(Errno::INTR) => Ok(false),
            Err(error) => Err(error.into()),
        }
    }
}

impl AsFd for InterfaceMonitor {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

impl AsRawFd for InterfaceMonitor {
    fn as_raw_fd(&self) -> RawFd {
        self.socket.as_raw_fd()
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;
    use crate::table::tests::address;

    #[test]
    fn kernel_lists_the_present_addresses() {
        let mut monitor = InterfaceMonitor::without_reports().expect("any process may open one");
        let all = monitor.read_all(Duration::from_secs(10)).expect("the kernel answers");
        let loopback = all.iter().find(|address| address.ip.is_loopback()).expect("loopback has an address");
        assert!(loopback.name == "lo" && loopback.index > 0, "{loopback:?}");
        assert!(!monitor.wait(Duration::ZERO).expect("the socket is good"), "nothing is reported");
    }

    #[test]
    fn address_unknown_to_the_kernel_is_reported_lost() {
        let mut monitor = InterfaceMonitor::subscribe().expect("any process may listen");
        monitor.request_addresses().expect("it can be asked");
        monitor.read_all(Duration::from_secs(10)).expect("the kernel answers");
        let unknown = Ipv4Addr::new(10, 77, 0, 1);
        monitor.table.receive(&address(1, unknown));
        monitor.has_overflowed = true;
        let mut lost_addresses = Vec::new();
        while !lost_addresses.contains(&(unknown, 0).into()) {
            match monitor.receive_lost() {
                Ok(lost) => lost_addresses.extend(lost),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    assert!(monitor.is_readable(Duration::from_secs(10)).expect("the socket is good"));
                }
                Err(error) => panic!("{error}"),
            }
        }
    }
}
