//! Controls whether descriptors may arrive over a unix socket, and whether they are seen; opens a descriptor
//! of the process at the other end. The only unsafe code of this package beside that about memory
//! (`mapping`): three calls.

use std::{
    io,
    os::fd::{AsRawFd, BorrowedFd, FromRawFd, OwnedFd},
};

use rustix::net::sockopt;

use crate::offer::Descriptors;

/// `SO_PASSRIGHTS` of `asm/socket.h`, since Linux 6.16.
const SO_PASSRIGHTS: libc::c_int =
    if cfg!(any(target_arch = "sparc", target_arch = "sparc64")) { 92 } else { 83 };

/// `SO_PEERPIDFD` of `asm/socket.h`, since Linux 6.5.
const SO_PEERPIDFD: libc::c_int =
    if cfg!(any(target_arch = "sparc", target_arch = "sparc64")) { 86 } else { 77 };

pub(crate) fn peer_pidfd(socket: BorrowedFd<'_>) -> io::Result<OwnedFd> {
    let mut descriptor: libc::c_int = -1;
    let mut length = size_of_val(&descriptor) as libc::socklen_t;
    let place = (&raw mut descriptor).cast();
    let socket = socket.as_raw_fd();
    // SAFETY: `place` is that of `descriptor`, which has `length` bytes; both live longer than the call,
    // which writes no more than that.
    let got = unsafe { libc::getsockopt(socket, libc::SOL_SOCKET, SO_PEERPIDFD, place, &raw mut length) };
    if got != 0 {
        return Err(io::Error::last_os_error());
    }
    if descriptor < 0 {
        return Err(io::ErrorKind::InvalidData.into());
    }
    // SAFETY: the kernel has just created this descriptor for this call, so it has no other owner.
    Ok(unsafe { OwnedFd::from_raw_fd(descriptor) })
}

pub(crate) fn set_descriptors(socket: BorrowedFd<'_>, which: Descriptors) -> io::Result<()> {
    let value = libc::c_int::from(which == Descriptors::Taken);
    let length = size_of_val(&value) as libc::socklen_t;
    let place = (&raw const value).cast();
    // SAFETY: `place` is that of `value`, which has this many bytes and lives longer than the call; the
    // kernel only reads it.
    let set = unsafe { libc::setsockopt(socket.as_raw_fd(), libc::SOL_SOCKET, SO_PASSRIGHTS, place, length) };
    if set == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

pub(crate) fn keep_urgent_in_line(socket: BorrowedFd<'_>) -> io::Result<()> {
    Ok(sockopt::set_socket_oobinline(socket, true)?)
}
