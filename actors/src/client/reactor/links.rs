//! What a task watches of its direct links: the bell of each one's ring, and the socket that hangs up with its peer.

use std::{
    future::Future,
    io,
    os::fd::{AsFd, BorrowedFd},
    pin::pin,
    task::{Context, Poll, ready},
};

use tokio::{io::Interest, net::UnixStream};

use super::watch;
use crate::client::{
    direct::{Direct, Room, Standing},
    link::socket,
    routes::LinkNumber,
};

/// The links that are watched.
#[derive(Default)]
pub(super) struct Links {
    open: Vec<Watched>,
    /// The bell for room that a sender waited for last.
    room: Option<(LinkNumber, Bell)>,
}

/// A bell that is watched; nothing once its peer has closed it, which costs that peer a nap for each message.
struct Bell(Option<UnixStream>);

struct Watched {
    number: LinkNumber,
    message: Bell,
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
    /// Watches the open links and no others, and the bell for the room that is waited for.
    pub(super) fn follow(&mut self, direct: &mut Direct, room: Option<Room>) {
        self.open.retain(|watched| direct.open.iter().any(|link| link.number == watched.number));
        for link in &direct.open {
            if !self.open.iter().any(|watched| watched.number == link.number) {
                // One that cannot be watched is looked at each nap, as all are.
                self.open.extend(Watched::of(link));
            }
        }
        if let Some(Room { link, .. }) = room
            && self.room.as_ref().is_none_or(|(number, _)| *number != link)
        {
            self.room = direct.with_room_bell(link, |bell| Some((link, Bell::of(bell?).ok()?)));
        }
    }

    /// Ready when something has come on one of them.
    pub(super) fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Heard> {
        let mut heard = self.poll_room(cx).map(|()| Heard::Bell);
        for link in &mut self.open {
            if link.message.poll(cx).is_ready() {
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

    /// Ready when the peer that a sender waits for has taken something.
    pub(super) fn poll_room(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        self.room.as_mut().map_or(Poll::Pending, |(_, bell)| bell.poll(cx))
    }
}

impl Bell {
    fn of(bell: BorrowedFd<'_>) -> io::Result<Self> {
        watch(bell).map(|bell| Self(Some(bell)))
    }

    /// Ready when it was rung since it was last said to be.
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        let Some(bell) = &self.0 else { return Poll::Pending };
        // An error is an end.
        let _ = ready!(bell.poll_read_ready(cx));
        // It is ready, so this is at once. The reactor never forgets a closed one, at which a task would go round and round.
        let is_closed = match pin!(bell.ready(Interest::READABLE)).poll(cx) {
            Poll::Ready(Ok(ready)) => ready.is_read_closed(),
            Poll::Ready(Err(_)) => true,
            Poll::Pending => false,
        };
        forget(bell);
        if is_closed {
            self.0 = None;
        }
        Poll::Ready(())
    }
}

impl Watched {
    fn of(link: &Standing) -> io::Result<Self> {
        let bell = link.bell().ok_or(io::ErrorKind::Unsupported)?;
        let (message, socket) = (Bell::of(bell)?, watch(link.socket().as_fd())?);
        Ok(Self { number: link.number, message, socket, has_hung_up: false })
    }
}

/// Has the reactor say it again when more comes.
pub(super) fn forget(socket: &UnixStream) {
    let _ = socket.try_io(Interest::READABLE, || Err::<(), _>(io::ErrorKind::WouldBlock.into()));
}

#[cfg(test)]
mod tests {
    use std::{future::poll_fn, io::Write, os::unix::net};

    use futures_util::poll;
    use tokio::{runtime::Builder, time::timeout};

    use super::*;
    use crate::lncl::testing::WATCHDOG;

    #[test]
    fn a_bell_that_its_peer_has_closed_is_heard_once_and_never_again() {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let pair = || net::UnixStream::pair().unwrap();
            let ((ear, mut button), (socket, _peer)) = (pair(), pair());
            let (message, socket) = (Bell::of(ear.as_fd()).unwrap(), watch(socket.as_fd()).unwrap());
            let open = vec![Watched { number: LinkNumber(1), message, socket, has_hung_up: false }];
            let mut links = Links { open, room: None };
            // given: rung, it is heard, and then silent
            button.write_all(&[1]).unwrap();
            let heard = timeout(WATCHDOG, poll_fn(|cx| links.poll(cx))).await.expect("the ring");
            assert_eq!(heard, Heard::Bell);
            assert!(poll!(poll_fn(|cx| links.poll(cx))).is_pending());
            // when
            drop(button);
            // then
            timeout(WATCHDOG, poll_fn(|cx| links.poll(cx))).await.expect("its end");
            assert!(poll!(poll_fn(|cx| links.poll(cx))).is_pending(), "a task would go round and round");
        });
    }
}
