//! Where datagrams of peers arrive, and who looks at the time for all of them. Both are tasks of the IO thread.

use std::{
    cell::RefCell,
    io,
    net::UdpSocket,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use sinew_runtime::{time::Time, wakes, wire::Checksum};
use tokio::{sync::Notify, time::timeout};

use super::{
    channel,
    packet::{DATAGRAM_MAX, Prefix},
};
use crate::{
    gncl::{core::Lane, inbound::Inbound, lent::Lent, peer::Peer, spin::Spin},
    outlet::LinkNumber,
    stores::Stores,
    takeover::take_over,
};

/// Datagrams that are read before other tasks of the thread have their turn.
const DATAGRAMS_PER_WAKE: usize = 64;
/// How long nothing is read from a socket that has failed.
const BACK_OFF: Duration = Duration::from_millis(100);

/// Wakes [`keep_time`] for what is due earlier than it thinks.
#[derive(Debug, Default)]
pub(in crate::gncl) struct Alarm {
    /// When it looks next, in nanoseconds.
    set: AtomicU64,
    earlier: Notify,
}

impl Alarm {
    /// Something is due then.
    pub(super) fn set(&self, due: Option<Time>) {
        let Some(due) = due.map(Time::as_nanos) else { return };
        // SYNC: who looks says before he looks that he looks never again: what comes meanwhile is earlier than that.
        if due < self.set.load(Ordering::Acquire) && due < self.set.fetch_min(due, Ordering::AcqRel) {
            self.earlier.notify_one();
        }
    }
}

/// Looks at the time for all peers, whenever something is due.
pub(in crate::gncl) async fn keep_time(stores: Arc<Stores>) {
    let (store, alarm) = (&stores.gncl, &stores.gncl.alarm);
    take_over(&alarm.earlier);
    let mut peers = Vec::new();
    loop {
        alarm.set.store(u64::MAX, Ordering::Release);
        let now = Time::now();
        store.list_peers(&mut peers);
        // Nobody is kept while this waits.
        let due = peers.drain(..).filter_map(|peer| peer.look_at_the_time(now)).min();
        match due {
            None => alarm.earlier.notified().await,
            Some(due) => {
                alarm.set.fetch_min(due.as_nanos(), Ordering::AcqRel);
                // Whether somebody has something earlier or the time is over: it is looked.
                drop(timeout(due.since(Time::now()), alarm.earlier.notified()).await);
            }
        }
        // Whoever is told again and again takes no other task's turn.
        tokio::task::yield_now().await;
    }
}

/// Reads all sockets of the node.
pub(in crate::gncl) async fn read_all(stores: Arc<Stores>, spin: Arc<Spin>) {
    let sockets = stores.gncl.datagrams.all();
    let readers = sockets.into_iter().map(|door| Reader::new(&stores, &spin, &door.socket));
    let readers: Vec<_> =
        readers.filter_map(|reader| reader.inspect_err(|error| refuse(&stores, error)).ok()).collect();
    futures_util::future::join_all(readers.into_iter().map(Reader::run)).await;
}

fn refuse(stores: &Stores, error: &io::Error) {
    stores.gncl.refusals.count(Time::now(), "datagrams are not read", error);
}

struct Reader {
    stores: Arc<Stores>,
    spin: Arc<Spin>,
    socket: Lent<UdpSocket>,
    /// Whose datagrams came in this turn.
    met: Vec<Arc<Peer>>,
}

impl Reader {
    fn new(stores: &Arc<Stores>, spin: &Arc<Spin>, socket: &Arc<UdpSocket>) -> io::Result<Self> {
        let socket = Lent::of(socket)?;
        Ok(Self {
            stores: stores.clone(),
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
            if let Err(error) = read {
                refuse(&self.stores, &error);
                tokio::time::sleep(BACK_OFF).await;
            }
            tokio::task::yield_now().await;
        }
    }

    /// Takes what has come, up to a bound; then whoever has got something is woken, and what is to be said about it is said.
    fn turn(&mut self, buffer: &mut [u8]) -> io::Result<()> {
        let batch = wakes::Batch::begin();
        let now = Time::now();
        let mut result = Ok(());
        for _ in 0..DATAGRAMS_PER_WAKE {
            match self.socket.try_io(|socket| socket.recv_from(buffer)) {
                // One that fills it was cut off, and is none of ours.
                Ok((length, _)) => self.came(now, &buffer[..length]),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                // Of a datagram that was sent: nobody listens there. It is sent again.
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
        result
    }

    /// A datagram has arrived: the one place where all of them do. spec: DATAGRAM-1
    fn came(&mut self, now: Time, bytes: &[u8]) {
        let Some(prefix) = Prefix::read(bytes) else { return self.count(now, "datagram of somebody else") };
        let peer = self.stores.gncl.peer(prefix.node);
        let Some((peer, channel)) = peer.as_ref().and_then(|peer| Some((peer, peer.channel()?))) else {
            return self.count(now, "datagram of a stranger");
        };
        if !channel.knows(prefix) {
            return self.count(now, "datagram with another key");
        }
        let Some(content) = prefix.content(bytes).filter(|_| bytes.len() <= DATAGRAM_MAX) else {
            return self.count(now, "datagram malformed");
        };
        let value = match content.value.map(channel::value) {
            Some(None) => return self.count(now, "datagram malformed"),
            Some(value) => value,
            None => None,
        };
        // Before anything is kept of it: whoever may name any source could make flows at will. Nobody is told of it. spec: GNCL-11
        if value.as_ref().is_some_and(|value| value.header.source.node != peer.node) {
            return self.count(now, "forged source");
        }
        let Some(way) = peer.way(Lane::Stream) else { return };
        let hand = value.as_ref().map(|_| way.take_datagram());
        if matches!(hand, Some(None)) {
            // It is not acknowledged: nobody gets it. spec: DATAGRAM-4
            return self.count(now, "datagram of a life that is over");
        }
        if !self.met.iter().any(|met| Arc::ptr_eq(met, peer)) {
            peer.gives_a_sign(now);
            self.met.push(peer.clone());
        }
        let message = channel.came(now, prefix, &content, value);
        match (message, hand.flatten()) {
            (Some(message), Some(hand)) => self.inbound(peer).receive_datagram(now, message, way, hand),
            (None, Some(hand)) => hand.had_come(),
            (_, None) => {}
        }
    }

    fn inbound(&self, peer: &Arc<Peer>) -> Inbound {
        Inbound {
            stores: self.stores.clone(),
            peer: peer.clone(),
            spin: self.spin.clone(),
            lane: Lane::Stream,
            link: LinkNumber::default(),
            checksum: Checksum::Crc,
            outcomes: RefCell::default(),
        }
    }

    fn count(&self, now: Time, cause: &'static str) {
        self.stores.gncl.refusals.count(now, cause, &"it was dropped");
    }
}

#[cfg(test)]
mod tests {
    use std::pin::pin;

    use sinew_runtime::tid::Incarnation;

    use super::*;
    use crate::{config::NodeConfig, takeover::tests::waits};

    #[test]
    fn who_looks_at_the_time_is_told_what_is_due_earlier_whoever_looked_before() {
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let mut former = pin!(keep_time(stores.clone()));
        waits(former.as_mut());
        let mut present = pin!(keep_time(stores.clone()));
        let woken = waits(present.as_mut());
        stores.gncl.alarm.set(Some(Time::now()));
        assert!(woken.is());
    }
}
