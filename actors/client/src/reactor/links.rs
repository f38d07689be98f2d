//! The descriptors of direct links that a task watches: the wake-up socket of each ring, and the socket that
//! closes with its peer.

use std::{
    future::Future,
    io,
    os::fd::{AsFd, BorrowedFd},
    pin::pin,
    task::{Context, Poll, ready},
};

use tokio::{io::Interest, net::UnixStream};

use super::watch;
use crate::{
    direct::{Direct, EstablishedLink, Room},
    link::socket,
    routes::LinkNumber,
};

/// The watched links.
#[derive(Default)]
pub(super) struct Links {
    open: Vec<Watched>,
    /// The room signal for which a sender waited last.
    room: Option<(LinkNumber, Bell)>,
}

/// A watched wake-up socket; `None` once its peer has closed it, which delays each message of that peer by up
/// to one `CHECK_INTERVAL`.
struct Bell(Option<UnixStream>);

struct Watched {
    number: LinkNumber,
    message: Bell,
    socket: UnixStream,
    /// Reported once; the remaining messages are read before the link ends.
    has_hung_up: bool,
}

/// The event on a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LinkEvent {
    Bell,
    HungUp,
}

impl Links {
    /// Watches exactly the open links, and the room signal that is waited for.
    pub(super) fn follow(&mut self, direct: &mut Direct, room: Option<Room>) {
        self.open.retain(|watched| direct.open.iter().any(|link| link.number == watched.number));
        for link in &direct.open {
            if !self.open.iter().any(|watched| watched.number == link.number) {
                // A link that cannot be watched is polled each `CHECK_INTERVAL`, as all are.
                self.open.extend(Watched::of(link));
            }
        }
        if let Some(Room { link, .. }) = room
            && self.room.as_ref().is_none_or(|(number, _)| *number != link)
        {
            self.room = direct.with_room_bell(link, |bell| Some((link, Bell::of(bell?).ok()?)));
        }
    }

    /// Ready when an event has arrived on one of them.
    pub(super) fn poll(&mut self, cx: &mut Context<'_>) -> Poll<LinkEvent> {
        let mut event = self.poll_room(cx).map(|()| LinkEvent::Bell);
        for link in &mut self.open {
            if link.message.poll(cx).is_ready() {
                event = Poll::Ready(LinkEvent::Bell);
            }
            while !link.has_hung_up
                && let Poll::Ready(state) = link.socket.poll_read_ready(cx)
            {
                // An error is the end of the reactor, and stays.
                link.has_hung_up = state.is_err() || socket::hangs_up(&link.socket);
                if link.has_hung_up {
                    return Poll::Ready(LinkEvent::HungUp);
                }
                forget(&link.socket);
            }
        }
        event
    }

    /// Ready when the peer for which a sender waits has read something.
    pub(super) fn poll_room(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        self.room.as_mut().map_or(Poll::Pending, |(_, bell)| bell.poll(cx))
    }
}

impl Bell {
    fn of(bell: BorrowedFd<'_>) -> io::Result<Self> {
        watch(bell).map(|bell| Self(Some(bell)))
    }

    /// Ready when it was signalled since it was last reported.
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        let Some(bell) = &self.0 else { return Poll::Pending };
        // An error is an end.
        let _ = ready!(bell.poll_read_ready(cx));
        // It is ready, so this completes at once. The reactor always reports a closed one as ready, so that a
        // task would loop.
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
    fn of(link: &EstablishedLink) -> io::Result<Self> {
        let bell = link.bell().ok_or(io::ErrorKind::Unsupported)?;
        let (message, socket) = (Bell::of(bell)?, watch(link.socket().as_fd())?);
        Ok(Self { number: link.number, message, socket, has_hung_up: false })
    }
}

/// Makes the reactor report it again when more arrives.
pub(super) fn forget(socket: &UnixStream) {
    let _ = socket.try_io(Interest::READABLE, || Err::<(), _>(io::ErrorKind::WouldBlock.into()));
}

#[cfg(test)]
mod tests {
    use std::{future::poll_fn, io::Write, os::unix::net};

    use futures_util::poll;
    use tokio::{runtime::Builder, time::timeout};

    use super::*;
    use sinew_lncl::testing::WATCHDOG;

    #[test]
    fn closed_bell_is_reported_only_once() {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let pair = || net::UnixStream::pair().unwrap();
            let ((listening, mut button), (socket, _peer)) = (pair(), pair());
            let (message, socket) = (Bell::of(listening.as_fd()).unwrap(), watch(socket.as_fd()).unwrap());
            let open = vec![Watched { number: LinkNumber(1), message, socket, has_hung_up: false }];
            let mut links = Links { open, room: None };
            // given: a wake-up is received, and then there is none
            button.write_all(&[1]).unwrap();
            let event = timeout(WATCHDOG, poll_fn(|cx| links.poll(cx))).await.expect("the ring");
            assert_eq!(event, LinkEvent::Bell);
            assert!(poll!(poll_fn(|cx| links.poll(cx))).is_pending());
            // when
            drop(button);
            // then
            timeout(WATCHDOG, poll_fn(|cx| links.poll(cx))).await.expect("its end");
            assert!(poll!(poll_fn(|cx| links.poll(cx))).is_pending(), "a task would go round and round");
        });
    }
}
