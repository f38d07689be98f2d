//! Descriptors with a close that blocks, for tests of the threads that close them.

#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::new_without_default,
    clippy::should_implement_trait,
    reason = "tools for tests: their names describe them, and a failure fails the test"
)]

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
pub fn pass(socket: impl AsFd, bytes: &[u8], descriptor: impl AsFd) -> Result<usize, Errno> {
    pass_by(SendFlags::empty(), socket, bytes, descriptor)
}

/// Passes a descriptor beside one urgent byte. A receiver that peeks at the data does not see this byte by
/// itself.
pub fn pass_urgent(socket: impl AsFd, descriptor: impl AsFd) -> Result<usize, Errno> {
    pass_by(SendFlags::OOB, socket, &[1], descriptor)
}

fn pass_by(flags: SendFlags, socket: impl AsFd, bytes: &[u8], descriptor: impl AsFd) -> Result<usize, Errno> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    let descriptors = [descriptor.as_fd()];
    assert!(control.push(SendAncillaryMessage::ScmRights(&descriptors)));
    sendmsg(socket, &[IoSlice::new(bytes)], &mut control, flags)
}

/// A connection with a last close that blocks until its peer has read the written data, or has gone.
pub struct SlowClose {
    pub ours: Option<TcpStream>,
    peer: TcpStream,
}

impl SlowClose {
    pub fn new() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a connection on loopback");
        set_socket_recv_buffer_size(&listener, 4_096).expect("a connection on loopback");
        let mut ours = TcpStream::connect(listener.local_addr().expect("a connection on loopback"))
            .expect("a connection on loopback");
        let (peer, _) = listener.accept().expect("a connection on loopback");
        ours.set_nonblocking(true).expect("a connection on loopback");
        // More than the peer can hold, however fast the system moves it between the buffers.
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

    /// Completes its close in any thread that waits for it.
    pub fn release(self) {
        drop(self.peer);
    }
}
