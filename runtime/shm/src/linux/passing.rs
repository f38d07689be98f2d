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
        SendAncillaryMessage, SendFlags, recvmsg, sendmsg,
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

/// Descriptors that one message can carry: SCM_MAX_FD of the kernel.
const MESSAGE_DESCRIPTORS_MAX: usize = 253;

pub(crate) fn receive(socket: BorrowedFd<'_>) -> Result<Received, PassError> {
    let mut bytes = [0; OFFER_BYTES];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(MESSAGE_DESCRIPTORS_MAX))];
    let mut control = RecvAncillaryBuffer::new(&mut space);
    let got = retried(|| {
        recvmsg(socket, &mut [IoSliceMut::new(&mut bytes)], &mut control, RecvFlags::CMSG_CLOEXEC)
    })?;
    let cut = got.flags.intersects(ReturnFlags::CTRUNC | ReturnFlags::TRUNC);
    let descriptors = taken(&mut control);
    if got.bytes == 0 && descriptors.is_empty() {
        return Err(PassError::Closed);
    }
    Ok(Received { bytes, count: got.bytes, cut, descriptors })
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
