//! What a peer is told of what was taken of it.

use sinew_runtime::wire::{Kind, Message};

use super::{Inbox, Way};
use crate::{
    gncl::{core::write, peer::frame},
    session::Ack,
};

/// Rounds in which one thread at most makes another acknowledgement because a newer one was made while it said its own. Each round takes
/// another thread that made one at that very moment: more than two hardly follow each other.
const ROUNDS_MAX: u32 = 8;

/// One that is not said yet.
struct Acknowledgement {
    number: u64,
    /// That in which the peer's messages from here are counted.
    epoch: u64,
    /// The latest connection when it was made: it is said on no other.
    link: u64,
    message: Message,
}

impl Way {
    /// All that came at once has been taken: tells the peer so, if there was much since it was told.
    pub(in crate::gncl) fn acknowledge_if_due(&self) {
        let is_due = self.inbox().ack_is_due;
        if is_due {
            self.acknowledge();
        }
    }

    /// Tells the peer what was taken, if it does not know. Returns whether it did not.
    pub(in crate::gncl) fn acknowledge_if_owed(&self) -> bool {
        let owes = {
            let inbox = self.inbox();
            inbox.ack_is_due || inbox.receiving.owes_ack()
        };
        if owes {
            self.acknowledge();
        }
        owes
    }

    pub(super) fn acknowledge(&self) {
        self.say_ack(self.next_ack());
    }

    fn say_ack(&self, ack: Acknowledgement) {
        self.say_acks(ack, || self.next_ack());
    }

    /// Says `ack`, and what is made `next` as long as that was not the last one, up to a bound.
    ///
    /// The bound is enough: whoever made the newer one says it, or one that is newer still. Only if that came before this one, which has taken its
    /// place then, the peer does not know the rest; so it is owed, and said within a period (1 s) of [`Ticks`](super::super::ticks::Ticks) by who looks for
    /// what is owed, who is one thread.
    fn say_acks(&self, mut ack: Acknowledgement, mut next: impl FnMut() -> Acknowledgement) {
        for _ in 0..ROUNDS_MAX {
            let is_of_now = self.outlet.acknowledge(ack.message, ack.link, ack.epoch);
            // What another thread has made meanwhile may have been said before this one, which has taken its place then: in an outlet one waits.
            if is_of_now && self.inbox().acks_made == ack.number {
                return;
            }
            ack = next();
        }
        // Not the one in hand, which may be older than what was said meanwhile.
        self.inbox().ack_is_due = true;
        self.told.acks.want();
    }

    fn next_ack(&self) -> Acknowledgement {
        let epoch = self.outlet.epoch();
        let (ack, number, link) = {
            let Inbox { receiving, shelf, ack_is_due, acks_made, .. } = &mut *self.inbox();
            *ack_is_due = false;
            *acks_made += 1;
            let room = shelf.room(self.window, self.longest);
            let ack = receiving.ack(epoch, Some(room));
            (Ack { change: shelf.change(), held: shelf.held(), ..ack }, *acks_made, receiving.link())
        };
        Acknowledgement {
            number,
            epoch,
            link,
            message: frame(self.ends.here, self.ends.node, Kind::GNCL_ACK, write(&ack)),
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
        super::{Ends, Told},
        *,
    };
    use crate::{
        config::NodeConfig,
        gncl::{core::read, transport::Transport},
        outlet::Gathering,
    };

    const HERE: NodeAddress = NodeAddress::new(1);
    const NODE: NodeAddress = NodeAddress::new(2);

    fn way() -> Way {
        let ends = Ends {
            here: HERE,
            node: NODE,
            takes_outcomes: true,
            answers_there: 100,
            payload_max_there: usize::MAX,
            ways: 1,
        };
        Way::new(Time::now(), ends, &NodeConfig::new("hip"), &Told::default())
    }

    #[test]
    fn who_is_always_outrun_by_another_thread_leaves_it_to_who_looks_for_what_is_owed() {
        // Given: each time that one is said, another thread has made a newer one.
        let way = way();
        let mut rounds = 0;
        let mut outrun = || {
            rounds += 1;
            assert!(rounds <= 1_000, "it goes on for ever");
            let ack = way.next_ack();
            way.next_ack();
            ack
        };
        // When
        let first = outrun();
        way.say_acks(first, &mut outrun);
        // Then
        assert!(way.acknowledge_if_owed(), "the last word is still to be said");
        assert!(!way.acknowledge_if_owed(), "it is");
    }

    // spec: SESSION-3
    #[tokio::test]
    async fn one_that_was_made_for_a_connection_that_has_ended_is_not_the_first_word_on_the_next() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("it is bound");
        let way = way();
        // Given: a thread has made one, and is held up before it says it.
        let older = way.next_ack();
        // When: the next connection is there, and the thread goes on before that one has its first word.
        let (ours, theirs) = tokio::join!(TcpStream::connect(address), listener.accept());
        let (ours, mut theirs) = (ours.expect("it listens"), theirs.expect("it dials").0);
        ours.writable().await.expect("it takes something");
        let link = way.outlet.connect(Gathering::new(Transport::open(ours), Checksum::Crc), 1 << 16, None);
        way.say_ack(older);
        let mut held = frame(NODE, HERE, Kind::named("held"), Bytes::new());
        held.header.class = Class::Bulk;
        way.inbox().shelf.put(7, held, 100).expect("there is room");
        way.attach(link);
        // Then: what the peer reads first knows all that was taken. An older word would have it begin anew.
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
    async fn of_two_that_are_made_at_once_the_older_one_does_not_have_the_last_word() {
        // Given: a connection that takes nothing.
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("it is bound");
        let (ours, theirs) = tokio::join!(TcpStream::connect(address), listener.accept());
        let (ours, mut theirs) = (ours.expect("it listens"), theirs.expect("it dials").0);
        ours.writable().await.expect("it takes something");
        let mut filled = 0;
        while let Ok(count) = ours.try_write(&[0; 65_536]) {
            filled += count;
        }
        let way = way();
        let link = way.outlet.connect(Gathering::new(Transport::open(ours), Checksum::Crc), 1 << 16, None);
        way.attach(link);
        // When: one thread has made an acknowledgement, another one makes and says a newer one, and the first one goes on.
        let older = way.next_ack();
        let mut held = frame(NODE, HERE, Kind::named("held"), Bytes::new());
        held.header.class = Class::Bulk;
        way.inbox().shelf.put(7, held, 100).expect("there is room");
        way.acknowledge();
        way.say_ack(older);
        // Then: what the peer reads last says what is held.
        let reading = async {
            let mut filler = vec![0; filled];
            theirs.read_exact(&mut filler).await.expect("it is on its way");
            let (mut codec, mut bytes, mut acks) = (FrameCodec::new(1 << 16), BytesMut::new(), Vec::new());
            // The first one was made when the connection was there, and had begun to be written.
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
            cause = way.outlet.drain(link) => panic!("{cause}"),
        };
        assert_eq!(acks.last().map(|ack| ack.held.len()), Some(1), "{acks:?}");
    }
}
