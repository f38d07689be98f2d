//! The ends of links come over the socket to the node: the link's number, and one descriptor beside it.

use std::{
    io::IoSliceMut,
    mem::MaybeUninit,
    os::{fd::OwnedFd, unix::net::UnixStream},
};

use rustix::{
    io::Errno,
    net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, recv, recvmsg},
};

use super::foreign::LinkEnd;
use crate::client::routes::LinkNumber;

/// Ends that one look takes at most: so many are on their way to a client, and as many for links that it has asked for.
const ENDS_A_LOOK: usize = 128;

/// The end of the link `number`, if it is there. Ends that come before it were for links that nobody wants any more; they are
/// closed.
pub(super) fn take(socket: &UnixStream, number: LinkNumber) -> Option<LinkEnd> {
    for _ in 0..ENDS_A_LOOK {
        let (found, end) = receive(socket).ok()?;
        if found == number {
            return end;
        }
    }
    None
}

/// Whether there is something to be read, so that the peer has not gone before it offered anything.
pub(super) fn holds_something(socket: &UnixStream) -> bool {
    recv(socket, &mut [0; 1][..], RecvFlags::DONTWAIT | RecvFlags::PEEK).is_ok_and(|(count, _)| count > 0)
}

fn receive(socket: &UnixStream) -> Result<(LinkNumber, Option<LinkEnd>), Errno> {
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
    // What is not taken out here is closed.
    let end: Option<OwnedFd> = control.drain().find_map(|message| {
        if let RecvAncillaryMessage::ScmRights(mut ends) = message { ends.next() } else { None }
    });
    let end = end.map(|end| LinkEnd::new(end.into()));
    if got.bytes != number.len() {
        // The node writes the number as a whole; it has gone, perhaps with a last word that is for others to read.
        return Err(Errno::CONNRESET);
    }
    Ok((LinkNumber(u64::from_le_bytes(number)), end))
}
