//! The receiving of datagrams, and the timer of all peers' channels. Both are tasks of the IO thread.

use std::{
    cell::{Cell, RefCell},
    future::poll_fn,
    io,
    net::UdpSocket,
    pin::pin,
    sync::Arc,
    task::Poll,
    time::Duration,
};

use sinew_runtime::{time::Time, wakes, wire::Checksum};
use sinew_session::outlet::LinkNumber;

use crate::{
    State,
    core::Lane,
    datagrams::{DATAGRAM_MAX, Prefix, read_value},
    inbound::Inbound,
    peer::Peer,
    shared_socket::SharedSocket,
    spin::Spin,
};

/// Datagrams read before other tasks of the thread run.
const DATAGRAMS_PER_WAKE: usize = 64;
/// Delay before a failed socket is read again.
const BACK_OFF: Duration = Duration::from_millis(100);

/// Runs the due actions of all peers.
pub(crate) async fn keep_time(state: Arc<State>) {
    let (store, alarm) = (&state.store, &state.store.alarm);
    alarm.claim();
    let mut peers = Vec::new();
    loop {
        alarm.clear();
        let now = Time::now();
        store.list_peers(&mut peers);
        // No reference to a peer is kept while this task waits.
        let due = peers.drain(..).filter_map(|peer| peer.tick(now)).min();
        let mut reached = pin!(alarm.reached(due));
        let is_pending = poll_fn(|cx| Poll::Ready(reached.as_mut().poll(cx).is_pending())).await;
        if is_pending {
            reached.await;
        } else {
            // Repeated notifications must not block other tasks. After a wait they have had their turn; another
            // one would cost a look at the reactor each time.
            tokio::task::yield_now().await;
        }
    }
}

/// Reads all sockets of the node.
pub(crate) async fn read_all(state: Arc<State>, spin: Arc<Spin>) {
    let sockets = state.store.datagrams.all();
    let readers = sockets.into_iter().map(|bound| Reader::new(&state, &spin, &bound.socket));
    let readers: Vec<_> =
        readers.filter_map(|reader| reader.inspect_err(|error| refuse(&state, error)).ok()).collect();
    futures_util::future::join_all(readers.into_iter().map(Reader::run)).await;
}

fn refuse(state: &State, error: &io::Error) {
    state.store.refusals.count(Time::now(), "datagrams are not read", error);
}

/// What a turn has left in its socket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SocketState {
    Empty,
    /// Datagrams may be left.
    Readable,
}

struct Reader {
    state: Arc<State>,
    spin: Arc<Spin>,
    socket: SharedSocket<UdpSocket>,
    /// Peers with datagrams received in this turn.
    met: Vec<Arc<Peer>>,
}

impl Reader {
    fn new(state: &Arc<State>, spin: &Arc<Spin>, socket: &Arc<UdpSocket>) -> io::Result<Self> {
        let socket = SharedSocket::register(socket)?;
        Ok(Self {
            state: state.clone(),
            spin: spin.clone(),
            socket,
            met: Vec::with_capacity(DATAGRAMS_PER_WAKE),
        })
    }

    async fn run(mut self) {
        let mut buffer = [0; DATAGRAM_MAX + 1];
        loop {
            let read = match self.socket.readable().await {
                Ok(()) => self.turn(&mut buffer),
                Err(error) => Err(error),
            };
            match read {
                // The next wait lets other tasks run: the socket is empty.
                Ok(SocketState::Empty) => {}
                Ok(SocketState::Readable) => tokio::task::yield_now().await,
                Err(error) => {
                    refuse(&self.state, &error);
                    tokio::time::sleep(BACK_OFF).await;
                }
            }
        }
    }

    /// Reads the received datagrams, up to a bound. Then wakes the receivers of their messages, and sends
    /// acknowledgements.
    fn turn(&mut self, buffer: &mut [u8]) -> io::Result<SocketState> {
        let batch = wakes::Batch::begin();
        let now = Time::now();
        let mut result = Ok(SocketState::Readable);
        for _ in 0..DATAGRAMS_PER_WAKE {
            match self.socket.try_io(|socket| socket.recv_from(buffer)) {
                // A datagram that fills the buffer was truncated, and is not of this protocol.
                Ok((length, _)) => self.on_datagram(now, &buffer[..length]),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    result = Ok(SocketState::Empty);
                    break;
                }
                // The error is about a sent datagram: no socket listens there. The datagram is sent again.
                Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {}
                Err(error) => {
                    result = Err(error);
                    break;
                }
            }
        }
        drop(batch);
        let now = Time::now();
        for peer in self.met.drain(..) {
            peer.channel().iter().for_each(|channel| channel.flush(now));
        }
        self.state.store.alarm.review(now);
        result
    }

    /// Processes a received datagram. All of them pass here. spec: DATAGRAM-1
    fn on_datagram(&mut self, now: Time, bytes: &[u8]) {
        let Some(prefix) = Prefix::read(bytes) else { return self.count(now, "datagram of somebody else") };
        let peer = self.state.store.peer(prefix.node);
        let Some((peer, channel)) = peer.as_ref().and_then(|peer| Some((peer, peer.channel()?))) else {
            return self.count(now, "datagram of a stranger");
        };
        if !channel.has_key(prefix) {
            return self.count(now, "datagram with another key");
        }
        let Some(content) = prefix.content(bytes).filter(|_| bytes.len() <= DATAGRAM_MAX) else {
            return self.count(now, "datagram malformed");
        };
        let value = match content.value.map(read_value) {
            Some(None) => return self.count(now, "datagram malformed"),
            Some(value) => value,
            None => None,
        };
        // The check precedes any stored state: a sender with arbitrary sources could create any number of
        // flows. No event is reported. spec: GNCL-11
        if value.as_ref().is_some_and(|value| value.header.source.node != peer.node) {
            return self.count(now, "forged source");
        }
        let Some(session) = peer.session(Lane::Stream) else { return };
        let guard = value.as_ref().map(|_| session.on_datagram());
        if matches!(guard, Some(None)) {
            // The datagram is not acknowledged, because its value is not delivered. spec: DATAGRAM-4
            return self.count(now, "datagram of a former incarnation");
        }
        if !self.met.iter().any(|met| Arc::ptr_eq(met, peer)) {
            peer.mark_alive(now);
            self.met.push(peer.clone());
        }
        let message = channel.on_datagram(now, prefix, &content, value);
        match (message, guard.flatten()) {
            (Some(message), Some(guard)) => self.inbound(peer).receive_datagram(now, message, session, guard),
            (None, Some(guard)) => guard.drop_duplicate(),
            (_, None) => {}
        }
    }

    fn inbound(&self, peer: &Arc<Peer>) -> Inbound {
        Inbound {
            state: self.state.clone(),
            peer: peer.clone(),
            spin: self.spin.clone(),
            lane: Lane::Stream,
            link: LinkNumber::default(),
            checksum: Checksum::Crc,
            outcomes: RefCell::default(),
            conversion: Cell::default(),
            former: Cell::default(),
        }
    }

    fn count(&self, now: Time, cause: &'static str) {
        self.state.store.refusals.count(now, cause, &"it was dropped");
    }
}

#[cfg(test)]
mod tests {
    use std::pin::pin;

    use sinew_runtime::tid::Incarnation;

    use super::*;
    use sinew_model::{config::NodeConfig, notifications::testing::waits};

    #[test]
    fn earlier_deadline_wakes_the_present_timer_task() {
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let mut former = pin!(keep_time(state.clone()));
        waits(former.as_mut());
        let mut present = pin!(keep_time(state.clone()));
        let woken = waits(present.as_mut());
        state.store.alarm.set(Some(Time::now()));
        assert!(woken.is());
    }
}
