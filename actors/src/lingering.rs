//! Descriptors that take for ever to close, for tests of who closes them.

use std::{
    io::{ErrorKind, IoSlice, Write},
    mem::MaybeUninit,
    net::{TcpListener, TcpStream},
    os::fd::AsFd,
    time::Duration,
};

use rustix::{
    io::Errno,
    net::{
        SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg,
        sockopt::{set_socket_linger, set_socket_recv_buffer_size},
    },
};

/// Passes a descriptor beside these bytes.
pub(crate) fn pass(socket: impl AsFd, bytes: &[u8], descriptor: impl AsFd) -> Result<usize, Errno> {
    pass_by(SendFlags::empty(), socket, bytes, descriptor)
}

/// Passes a descriptor beside one byte that is urgent, which who looks at what is there does not see by itself.
pub(crate) fn pass_urgent(socket: impl AsFd, descriptor: impl AsFd) -> Result<usize, Errno> {
    pass_by(SendFlags::OOB, socket, &[1], descriptor)
}

fn pass_by(flags: SendFlags, socket: impl AsFd, bytes: &[u8], descriptor: impl AsFd) -> Result<usize, Errno> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    let descriptors = [descriptor.as_fd()];
    assert!(control.push(SendAncillaryMessage::ScmRights(&descriptors)));
    sendmsg(socket, &[IoSlice::new(bytes)], &mut control, flags)
}

/// A connection whose last close waits until its peer has taken what is written, or has gone.
pub(crate) struct Lingering {
    pub(crate) ours: Option<TcpStream>,
    peer: TcpStream,
}

impl Lingering {
    pub(crate) fn new() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a connection on loopback");
        set_socket_recv_buffer_size(&listener, 4_096).expect("a connection on loopback");
        let mut ours = TcpStream::connect(listener.local_addr().expect("a connection on loopback"))
            .expect("a connection on loopback");
        let (peer, _) = listener.accept().expect("a connection on loopback");
        ours.set_nonblocking(true).expect("a connection on loopback");
        // So much that it is not all taken, however fast the system moves it from one buffer to the other.
        let chunk = vec![0; 1 << 16];
        loop {
            match ours.write(&chunk) {
                Ok(_) => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(error) => panic!("filling a connection: {error}"),
            }
        }
        set_socket_linger(&ours, Some(Duration::from_secs(3_600))).expect("a connection on loopback");
        Self { ours: Some(ours), peer }
    }

    /// Ends its close, wherever somebody waits for it.
    pub(crate) fn let_go(self) {
        drop(self.peer);
    }
}
