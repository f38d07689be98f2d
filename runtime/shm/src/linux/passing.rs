//! Passing an offer over a unix socket: one message with its descriptors beside it.

use std::{
    io::{IoSlice, IoSliceMut},
    mem::MaybeUninit,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
};

use rustix::{
    io::Errno,
    net::{
        RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, ReturnFlags, SendAncillaryBuffer,
        SendAncillaryMessage, SendFlags, recv, recvmsg, sendmsg,
    },
};

use crate::{
    error::PassError,
    offer::{OFFER_BYTES, Offer, Received},
};

pub(crate) fn send(offer: &Offer, socket: BorrowedFd<'_>) -> Result<(), PassError> {
    let bytes = offer.to_bytes();
    let descriptors: Vec<BorrowedFd<'_>> = offer.descriptors().iter().map(AsFd::as_fd).collect();
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(Offer::DESCRIPTORS_MAX))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    let pushed = control.push(SendAncillaryMessage::ScmRights(&descriptors));
    assert!(pushed, "the space is for as many descriptors as an offer can have");
    let sent = retried(|| sendmsg(socket, &[IoSlice::new(&bytes)], &mut control, SendFlags::NOSIGNAL))?;
    if sent == OFFER_BYTES {
        Ok(())
    } else {
        Err(PassError::Broken { bytes: sent, descriptors: 0, cut: true })
    }
}

/// Peeks first. The kernel then installs a copy of each descriptor and keeps its own in the queue. So no
/// close before the bytes are read is the last one. A message with more than an offer, or less, is left in
/// the socket.
pub(crate) fn receive(socket: BorrowedFd<'_>) -> Result<Received, PassError> {
    let mut bytes = [0; OFFER_BYTES];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(Offer::DESCRIPTORS_MAX))];
    let mut control = RecvAncillaryBuffer::new(&mut space);
    let flags = RecvFlags::CMSG_CLOEXEC | RecvFlags::PEEK;
    let seen = retried(|| recvmsg(socket, &mut [IoSliceMut::new(&mut bytes)], &mut control, flags))?;
    let cut = seen.flags.intersects(ReturnFlags::CTRUNC | ReturnFlags::TRUNC);
    let descriptors = taken(&mut control);
    if seen.bytes == 0 {
        return Err(PassError::Closed);
    }
    if cut && descriptors.len() < Offer::DESCRIPTORS_MAX {
        return Err(PassError::System(Errno::MFILE.into()));
    }
    // The space is aligned, and has room for a few more than requested.
    let cut = cut || descriptors.len() > Offer::DESCRIPTORS_MAX;
    if cut || seen.bytes != OFFER_BYTES {
        return Err(PassError::Broken { bytes: seen.bytes, descriptors: descriptors.len(), cut });
    }
    let copies = descriptors.iter().map(OwnedFd::try_clone).collect::<Result<_, _>>();
    let copies = copies.map_err(PassError::System)?;
    // Without space for descriptors: the kernel drops its own.
    retried(|| recv(socket, &mut bytes[..], RecvFlags::DONTWAIT))?;
    Ok(Received { bytes, descriptors, copies })
}

fn taken(control: &mut RecvAncillaryBuffer<'_>) -> Vec<OwnedFd> {
    control
        .drain()
        .filter_map(|message| {
            // Other kinds arrive only at sockets that request them.
            if let RecvAncillaryMessage::ScmRights(rights) = message { Some(rights) } else { None }
        })
        .flatten()
        .collect()
}

/// Retries after an interruption by a signal.
fn retried<T>(mut call: impl FnMut() -> Result<T, Errno>) -> Result<T, PassError> {
    loop {
        match call() {
            Err(Errno::INTR) => {}
            other => return other.map_err(|errno| PassError::System(errno.into())),
        }
    }
}
