//! The acknowledgements sent to a peer.

use std::sync::atomic::{AtomicBool, Ordering};

use sinew_runtime::wire::{Kind, Message};
use sinew_session::{Ack, Receiving};

use super::{Inbox, PeerSession};
use crate::{core::write, frame::frame};

/// Maximum number of further acknowledgements that one thread sends because a newer one was created
/// meanwhile. Each round requires another thread that created one at that very moment: more than two rounds
/// are unlikely.
const ROUNDS_MAX: u32 = 8;

/// An acknowledgement that is not sent yet.
struct Acknowledgement {
    number: u64,
    /// The epoch of the messages sent from here.
    epoch: u64,
    /// The latest connection at its creation; it is sent on no other.
    link: u64,
    message: Message,
}

/// The frames behind those that were read together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum FramesBehind {
    /// More bytes have probably arrived, and are read next.
    Likely,
    /// The reader waits for more.
    None,
}

/// Whether an acknowledgement must be sent after the frames that were read together. Written with the inbox locked.
/// SYNC: Relaxed; a reader without that lock asks for the marks of its own thread.
#[derive(Debug, Default)]
pub(super) struct AckMarks {
    is_due: AtomicBool,
    /// Whether it must be sent although more frames have arrived.
    is_overdue: AtomicBool,
}

impl AckMarks {
    /// Marks an acknowledgement as due.
    pub(super) fn set_due(&self, receiving: &Receiving) {
        self.is_due.store(true, Ordering::Relaxed);
        self.is_overdue.store(receiving.is_ack_overdue(), Ordering::Relaxed);
    }

    /// Records that an acknowledgement was created.
    fn clear(&self) {
        self.is_due.store(false, Ordering::Relaxed);
        self.is_overdue.store(false, Ordering::Relaxed);
    }
}

impl PeerSession {
    /// Sends an acknowledgement, if one is due after the frames read together were processed. In a flood it waits for
    /// the frames behind, up to a bound: each one wakes a thread of the peer.
    pub(crate) fn acknowledge_if_due(&self, behind: FramesBehind) {
        let mark = match behind {
            FramesBehind::Likely => &self.ack_marks.is_overdue,
            FramesBehind::None => &self.ack_marks.is_due,
        };
        // SYNC: Relaxed; this thread has processed the frames. The mark of another thread may be missed here: it
        // has requested a check.
        if mark.load(Ordering::Relaxed) {
            self.acknowledge();
        }
    }

    /// Sends an acknowledgement, if received messages are not acknowledged yet. Returns whether it was needed.
    pub(crate) fn acknowledge_pending(&self) -> bool {
        let is_pending = {
            let inbox = self.inbox();
            self.ack_marks.is_due.load(Ordering::Relaxed) || inbox.receiving.has_unacknowledged()
        };
        if is_pending {
            self.acknowledge();
        }
        is_pending
    }

    pub(super) fn acknowledge(&self) {
        self.send_ack(self.next_ack());
    }

    fn send_ack(&self, ack: Acknowledgement) {
        self.send_acks(ack, || self.next_ack());
    }

    /// Sends `ack`, and the acknowledgements created by `next` while that was not the last one, up to a bound.
    ///
    /// The bound is sufficient: the thread that created the newer one sends it, or an even newer one. If that
    /// was sent before this one, this one has replaced it, and the peer misses the rest. The acknowledgement
    /// is then marked as due, and the single checking task sends it within a period (1 s) of
    /// [`PeriodicChecks`](sinew_model::periodic_checks::PeriodicChecks).
    fn send_acks(&self, mut ack: Acknowledgement, mut next: impl FnMut() -> Acknowledgement) {
        for _ in 0..ROUNDS_MAX {
            let is_of_now = self.outlet.acknowledge(ack.message, ack.link, ack.epoch);
            // An acknowledgement of another thread may have been submitted before this one, which has
            // replaced it: only one waits in an outlet.
            if is_of_now && self.inbox().acks_made == ack.number {
                return;
            }
            ack = next();
        }
        // The acknowledgement at hand is not sent, because it may be older than one sent meanwhile.
        {
            let _inbox = self.inbox();
            self.ack_marks.is_due.store(true, Ordering::Relaxed);
        }
        self.notifiers.acks.request();
    }

    fn next_ack(&self) -> Acknowledgement {
        let epoch = self.outlet.epoch();
        let (ack, number, link) = {
            let Inbox { receiving, backlog, acks_made, .. } = &mut *self.inbox();
            self.ack_marks.clear();
            *acks_made += 1;
            let room = backlog.room(self.window, self.longest);
            let ack = receiving.ack(epoch, Some(room));
            (Ack { change: backlog.change(), held: backlog.held(), ..ack }, *acks_made, receiving.link())
        };
        Acknowledgement {
            number,
            epoch,
            link,
            message: frame(self.parameters.here, self.parameters.node, Kind::GNCL_ACK, write(&ack)),
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::{Bytes, BytesMut};
    use sinew_runtime::{
        tid::NodeAddress,
        time::Time,
        wire::{Checksum, Class, FrameCodec},
    };
    use tokio::{
        io::AsyncReadExt,
        net::{TcpListener, TcpStream},
    };
    use tokio_util::codec::Decoder;

    use super::{
        super::{SessionNotifiers, SessionParameters},
        *,
    };
    use crate::{core::read, transport::Transport};
    use sinew_model::config::NodeConfig;
    use sinew_session::outlet::Gathering;

    const HERE: NodeAddress = NodeAddress::new(1);
    const NODE: NodeAddress = NodeAddress::new(2);

    fn session() -> PeerSession {
        let parameters = SessionParameters {
            here: HERE,
            node: NODE,
            outcomes_kind: Some(Kind::GNCL_OUTCOME_RUNS),
            peer_answers_max: 100,
            peer_payload_max: usize::MAX,
            sessions: 1,
        };
        PeerSession::new(Time::now(), parameters, &NodeConfig::new("hip"), &SessionNotifiers::default())
    }

    #[test]
    fn overtaken_acknowledger_leaves_it_to_the_periodic_check() {
        // Given: each time that one is sent, another thread has made a newer one.
        let session = session();
        let mut rounds = 0;
        let mut outrun = || {
            rounds += 1;
            assert!(rounds <= 1_000, "it never ends");
            let ack = session.next_ack();
            session.next_ack();
            ack
        };
        // When
        let first = outrun();
        session.send_acks(first, &mut outrun);
        // Then
        assert!(session.acknowledge_pending(), "the last word is still to be said");
        assert!(!session.acknowledge_pending(), "it is");
    }

    // spec: SESSION-3
    #[tokio::test]
    async fn stale_acknowledgement_is_not_first_on_a_connection() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("it is bound");
        let session = session();
        // Given: a thread has made one, and is stalled before it sends it.
        let older = session.next_ack();
        // When: the next connection is up, and the thread continues before the first frame on it.
        let (ours, theirs) = tokio::join!(TcpStream::connect(address), listener.accept());
        let (ours, mut theirs) = (ours.expect("it listens"), theirs.expect("it dials").0);
        ours.writable().await.expect("it takes something");
        let link =
            session.outlet.connect(Gathering::new(Transport::plain(ours), Checksum::Crc), 1 << 16, None);
        session.send_ack(older);
        let mut held = frame(NODE, HERE, Kind::named("held"), Bytes::new());
        held.header.class = Class::Bulk;
        session.inbox().backlog.put(7, held, 100).expect("there is room");
        session.attach(link);
        // Then: the first acknowledgement that the peer reads covers all accepted messages. An older one would restart
        // the session.
        let (mut codec, mut bytes) = (FrameCodec::new(1 << 16), BytesMut::new());
        let first = loop {
            if let Some(message) = codec.decode(&mut bytes).expect("a frame") {
                break message;
            }
            theirs.read_buf(&mut bytes).await.expect("it is on its way");
        };
        let first: Ack = read(&first.payload).expect("an acknowledgement");
        assert_eq!(first.held, [7]);
    }

    // spec: CREDIT-2
    #[tokio::test]
    async fn older_of_two_concurrent_acknowledgements_is_not_last() {
        // Given: a connection that accepts no data.
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("it is bound");
        let (ours, theirs) = tokio::join!(TcpStream::connect(address), listener.accept());
        let (ours, mut theirs) = (ours.expect("it listens"), theirs.expect("it dials").0);
        ours.writable().await.expect("it takes something");
        let mut filled = 0;
        while let Ok(count) = ours.try_write(&[0; 65_536]) {
            filled += count;
        }
        let session = session();
        let link =
            session.outlet.connect(Gathering::new(Transport::plain(ours), Checksum::Crc), 1 << 16, None);
        session.attach(link);
        // When: one thread has made an acknowledgement, another one makes and sends a newer one, and the first one
        // continues.
        let older = session.next_ack();
        let mut held = frame(NODE, HERE, Kind::named("held"), Bytes::new());
        held.header.class = Class::Bulk;
        session.inbox().backlog.put(7, held, 100).expect("there is room");
        session.acknowledge();
        session.send_ack(older);
        // Then: the last acknowledgement that the peer reads contains the held destinations.
        let reading = async {
            let mut filler = vec![0; filled];
            theirs.read_exact(&mut filler).await.expect("it is on its way");
            let (mut codec, mut bytes, mut acks) = (FrameCodec::new(1 << 16), BytesMut::new(), Vec::new());
            // The first one was made when the connection came up, and its write had started.
            while acks.len() < 2 {
                theirs.read_buf(&mut bytes).await.expect("it is on its way");
                while let Some(message) = codec.decode(&mut bytes).expect("a frame") {
                    assert_eq!(message.header.kind, Kind::GNCL_ACK);
                    acks.push(read::<Ack>(&message.payload).expect("an acknowledgement"));
                }
            }
            acks
        };
        let acks = tokio::select! {
            acks = reading => acks,
            cause = session.outlet.drain(link) => panic!("{cause}"),
        };
        assert_eq!(acks.last().map(|ack| ack.held.len()), Some(1), "{acks:?}");
    }
}
