//! Receives the ends of links over the socket to the node: the link's number together with one descriptor.

use std::{
    io::IoSliceMut,
    mem::MaybeUninit,
    os::{fd::OwnedFd, unix::net::UnixStream},
};

use rustix::{
    io::Errno,
    net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, recv, recvmsg},
};

use super::peer_fd::PeerSocket;
use crate::routes::LinkNumber;

/// Maximum number of link ends per read: at most this many are in transit to a client, including those that
/// it has requested.
const ENDS_PER_READ: usize = 128;

/// Returns the end of the link `number`, if it has arrived. Ends that arrive before it were for abandoned
/// links; they are closed.
pub(super) fn take(socket: &UnixStream, number: LinkNumber) -> Option<PeerSocket> {
    for _ in 0..ENDS_PER_READ {
        let (found, end) = receive(socket).ok()?;
        if found == number {
            return end;
        }
    }
    None
}

/// Returns whether the socket holds data, so that a peer that closed it had sent its offer before.
pub(super) fn holds_data(socket: &UnixStream) -> bool {
    recv(socket, &mut [0; 1][..], RecvFlags::DONTWAIT | RecvFlags::PEEK).is_ok_and(|(count, _)| count > 0)
}

fn receive(socket: &UnixStream) -> Result<(LinkNumber, Option<PeerSocket>), Errno> {
    let mut number = [0; 8];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut control = RecvAncillaryBuffer::new(&mut space);
    let mut parts = [IoSliceMut::new(&mut number)];
    let flags = RecvFlags::DONTWAIT | RecvFlags::CMSG_CLOEXEC;
    let got = loop {
        match recvmsg(socket, &mut parts, &mut control, flags) {
            Err(Errno::INTR) => {}
            other => break other?,
        }
    };
    // Descriptors that are not taken out here are closed.
    let end: Option<OwnedFd> = control.drain().find_map(|message| {
        if let RecvAncillaryMessage::ScmRights(mut ends) = message { ends.next() } else { None }
    });
    let end = end.map(|end| PeerSocket::new(end.into()));
    if got.bytes != number.len() {
        // The node writes the number as a whole. The connection is closed, perhaps with a final frame that
        // another reader handles.
        return Err(Errno::CONNRESET);
    }
    Ok((LinkNumber(u64::from_le_bytes(number)), end))
}
