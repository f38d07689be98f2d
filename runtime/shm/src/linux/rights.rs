//! Whether descriptors may come over a unix socket, and whether they are seen. The only unsafe code of this package beside that about memory (`mapping`): one block.

use std::{
    io,
    os::fd::{AsRawFd, BorrowedFd},
};

use rustix::net::sockopt;

use crate::offer::Descriptors;

/// `SO_PASSRIGHTS` of `asm/socket.h`, since Linux 6.16.
const SO_PASSRIGHTS: libc::c_int =
    if cfg!(any(target_arch = "sparc", target_arch = "sparc64")) { 92 } else { 83 };

pub(crate) fn set_descriptors(socket: BorrowedFd<'_>, which: Descriptors) -> io::Result<()> {
    let value = libc::c_int::from(which == Descriptors::Taken);
    let length = size_of_val(&value) as libc::socklen_t;
    let place = (&raw const value).cast();
    // SAFETY: `place` is that of `value`, which has so many bytes and lives beyond the call; the kernel only reads it.
    let set = unsafe { libc::setsockopt(socket.as_raw_fd(), libc::SOL_SOCKET, SO_PASSRIGHTS, place, length) };
    if set == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

pub(crate) fn keep_urgent_in_line(socket: BorrowedFd<'_>) -> io::Result<()> {
    Ok(sockopt::set_socket_oobinline(socket, true)?)
}
