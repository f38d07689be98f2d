//! What a task watches of its direct links: the bell of each one's ring, and the socket that hangs up with its peer.

use std::{
    io,
    os::fd::AsFd,
    task::{Context, Poll},
};

use tokio::{io::Interest, net::UnixStream};

use super::watch;
use crate::api::{direct::Standing, link::socket, routes::LinkNumber};

/// The links that are watched.
#[derive(Default)]
pub(super) struct Links(Vec<Watched>);

struct Watched {
    number: LinkNumber,
    message: UnixStream,
    socket: UnixStream,
    /// Seen once; what it leaves is read before the link ends.
    has_hung_up: bool,
}

/// What has come on a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Heard {
    Bell,
    HungUp,
}

impl Links {
    /// Watches these links, and no others.
    pub(super) fn follow(&mut self, open: &[Standing]) {
        self.0.retain(|watched| open.iter().any(|link| link.number == watched.number));
        for link in open {
            if !self.0.iter().any(|watched| watched.number == link.number) {
                // One that cannot be watched is looked at each nap, as all are.
                self.0.extend(Watched::of(link));
            }
        }
    }

    /// Ready when something has come on one of them.
    pub(super) fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Heard> {
        let mut heard = Poll::Pending;
        for link in &mut self.0 {
            if link.message.poll_read_ready(cx).is_ready() {
                forget(&link.message);
                heard = Poll::Ready(Heard::Bell);
            }
            while !link.has_hung_up && link.socket.poll_read_ready(cx).is_ready() {
                link.has_hung_up = socket::hangs_up(&link.socket);
                if link.has_hung_up {
                    return Poll::Ready(Heard::HungUp);
                }
                forget(&link.socket);
            }
        }
        heard
    }
}

impl Watched {
    fn of(link: &Standing) -> io::Result<Self> {
        let bell = link.bell().ok_or(io::ErrorKind::Unsupported)?;
        let (message, socket) = (watch(bell)?, watch(link.socket().as_fd())?);
        Ok(Self { number: link.number, message, socket, has_hung_up: false })
    }
}

/// Has the reactor say it again when more comes.
pub(super) fn forget(socket: &UnixStream) {
    let _ = socket.try_io(Interest::READABLE, || Err::<(), _>(io::ErrorKind::WouldBlock.into()));
}
