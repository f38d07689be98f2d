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

/// Looks at it first: the kernel installs a copy of each descriptor then, and keeps its own in the queue, so that nothing that is closed
/// before the bytes are taken is the last one. What is more than an offer, or less, is left where it is.
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
    // The space is aligned, and has room for a few more than was asked for.
    let cut = cut || descriptors.len() > Offer::DESCRIPTORS_MAX;
    if cut || seen.bytes != OFFER_BYTES {
        return Err(PassError::Broken { bytes: seen.bytes, descriptors: descriptors.len(), cut });
    }
    let copies = descriptors.iter().map(OwnedFd::try_clone).collect::<Result<_, _>>();
    let copies = copies.map_err(PassError::System)?;
    // Without room for descriptors: the kernel lets go of its own.
    retried(|| recv(socket, &mut bytes[..], RecvFlags::DONTWAIT))?;
    Ok(Received { bytes, descriptors, copies })
}

fn taken(control: &mut RecvAncillaryBuffer<'_>) -> Vec<OwnedFd> {
    control
        .drain()
        .filter_map(|message| {
            // Other kinds come only to sockets that ask for them.
            if let RecvAncillaryMessage::ScmRights(rights) = message { Some(rights) } else { None }
        })
        .flatten()
        .collect()
}

/// A signal is no reason to give up.
fn retried<T>(mut call: impl FnMut() -> Result<T, Errno>) -> Result<T, PassError> {
    loop {
        match call() {
            Err(Errno::INTR) => {}
            other => return other.map_err(|errno| PassError::System(errno.into())),
        }
    }
}
