//! A reference: a unix stream socket, blocking.

use std::{
    io::{Read, Write},
    os::unix::net::UnixStream,
};

use sinew_figures::Figures;

use crate::pace::Pace;

pub(crate) fn measure(mut socket: UnixStream, bytes: usize, pace: Pace) -> Figures {
    let mut buffer = vec![7; bytes];
    pace.time(|| {
        socket.write_all(&buffer).expect("the echo reads");
        socket.read_exact(&mut buffer).expect("the echo answers");
    })
}

pub(crate) fn echo(bytes: usize) {
    let socket = rustix::io::dup(rustix::stdio::stdin()).expect("the socket is the input");
    let (mut socket, mut buffer) = (UnixStream::from(socket), vec![0; bytes]);
    while socket.read_exact(&mut buffer).is_ok() {
        if socket.write_all(&buffer).is_err() {
            return;
        }
    }
}
