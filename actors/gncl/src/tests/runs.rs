//! Messages of one batch for one application, which are handed over together.

use std::{
    future::poll_fn,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use futures_util::{FutureExt, StreamExt};
use sinew_runtime::{
    event_queue::EventQueue,
    mailbox::Mailbox,
    outcome::Outcome,
    router::{LocalRoute, MessageSink, SubmitError},
    tid::AppAddress,
    time::Time,
    wire::{Checksum, Class, Flags, Header, Kind, Message},
};
use sinew_session::{Ack, outlet::LinkNumber};

use super::bench::{ByHand, NINE, Node, next, run, within};
use crate::{
    core::Lane,
    inbound::{Behind, Collected, Inbound},
};

/// Returns a node, its handwritten peer, and a connection of that peer from which messages are accepted from now on.
async fn receiving() -> (Node, ByHand, Inbound) {
    let mut node = Node::start(1).await;
    let by_hand = ByHand::linked_to(&mut node).await;
    let (state, peer) = (node.state.clone(), node.state.store.peer(NINE).expect("it is linked"));
    let (lane, link) = (Lane::Control, LinkNumber::default());
    let session = peer.session(lane).expect("it has one");
    session.attach(link);
    let (receiver_id, epoch, held) = (1, u64::MAX, Vec::new());
    let ack = Ack { receiver_id, epoch, peer_epoch: 0, next: 1, change: 0, held, room: None };
    session.on_ack(link, &ack, Time::now());
    let (spin, checksum, collected) = (Arc::default(), Checksum::Crc, Collected::default());
    (node, by_hand, Inbound { state, peer, spin, lane, link, checksum, collected })
}

/// Receives a message with this number for an application, with others behind it.
fn receive(node: &Node, inbound: &Inbound, app: u32, number: u16) {
    receive_set(node, inbound, (app, number), |_| {});
}

/// The same with a header that `set` changes.
fn receive_set(node: &Node, inbound: &Inbound, (app, number): (u32, u16), set: impl FnOnce(&mut Header)) {
    let mut message = node.message(node.tid(app), &number.to_le_bytes());
    message.header.source.node = NINE;
    message.header.number = number;
    set(&mut message.header);
    inbound.receive(message.header.sent, message, Behind::More).expect("it has the next number");
}

/// Passes on the numbers of its messages, and panics once, at this one.
struct Breaking {
    taken: EventQueue<u16>,
    breaks_at: u16,
    has_broken: AtomicBool,
}

impl MessageSink for Breaking {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        let number = message.header.number;
        let breaks = number == self.breaks_at && !self.has_broken.swap(true, Ordering::Relaxed);
        assert!(!breaks, "it breaks once");
        self.taken.post(number).expect("the test has room for all of them");
        Ok(())
    }
}

#[test]
fn message_behind_a_panicking_one_is_not_lost() {
    run(async {
        // Given
        let (node, _by_hand, inbound) = receiving().await;
        let taken = EventQueue::new(100);
        let sink =
            Arc::new(Breaking { taken: taken.clone(), breaks_at: 2, has_broken: AtomicBool::new(false) });
        node.state.ctx.router.set_local(AppAddress::new(0x1001), LocalRoute { sink, events: Arc::new([]) });
        let mut taken = taken.attach();
        // When
        let batch = inbound.batch(Time::now());
        (1..=4).for_each(|number| receive(&node, &inbound, 1, number));
        assert!(catch_unwind(AssertUnwindSafe(|| drop(batch))).is_err());
        // Then
        for number in [1, 3, 4] {
            assert_eq!(next("a message", &mut taken).await, number);
        }
        let arrived = || inbound.peer.accounts()[Lane::Control as usize].arrived;
        within("all messages to be counted", async {
            while arrived().waiting > 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
        assert_eq!((arrived().taken, arrived().forwarded, arrived().failed), (4, 3, 1), "{:?}", arrived());
    });
}

#[test]
fn batch_beyond_a_mailbox_arrives_whole_and_in_order() {
    const COUNT: u16 = 300;
    run(async {
        // Given
        let (node, _by_hand, inbound) = receiving().await;
        let mailbox = Mailbox::new(8);
        let route = LocalRoute { sink: mailbox.clone(), events: Arc::new([]) };
        node.state.ctx.router.set_local(AppAddress::new(0x1001), route);
        let mut quick = node.app(2);
        // When: runs of different lengths, for two applications.
        let is_for_quick = |number: u16| number % 50 < 7;
        let batch = inbound.batch(Time::now());
        for number in 1..=COUNT {
            receive(&node, &inbound, if is_for_quick(number) { 2 } else { 1 }, number);
        }
        drop(batch);
        // Then
        let mut reader = mailbox.attach();
        for number in 1..=COUNT {
            let message = if is_for_quick(number) {
                next("a message for the quick one", &mut quick).await
            } else {
                let taken = within("a message", poll_fn(|cx| reader.poll_take(cx))).await;
                reader.finish(Outcome::Delivered);
                taken.expect("nobody else reads it")
            };
            assert_eq!(message.payload[..], number.to_le_bytes());
        }
    });
}

#[test]
fn application_that_ends_in_a_batch_gets_nothing_more() {
    run(async {
        let (node, _by_hand, inbound) = receiving().await;
        let mut former = node.app(1);
        let mut other = node.app(2);
        let batch = inbound.batch(Time::now());
        receive(&node, &inbound, 1, 1);
        receive(&node, &inbound, 2, 2);
        node.state.ctx.router.remove_local(AppAddress::new(0x1001));
        receive(&node, &inbound, 1, 3);
        receive(&node, &inbound, 2, 4);
        let mut present = node.app(1);
        receive(&node, &inbound, 1, 5);
        drop(batch);
        let of = |number: u16| number.to_le_bytes();
        assert_eq!(next("the first", &mut former).await.payload[..], of(1));
        assert_eq!(next("the fifth", &mut present).await.payload[..], of(5));
        for number in [2, 4] {
            assert_eq!(next("one of the other", &mut other).await.payload[..], of(number));
        }
        let arrived = inbound.peer.accounts()[Lane::Control as usize].arrived;
        assert_eq!((arrived.taken, arrived.forwarded, arrived.refused), (5, 4, 1), "{arrived:?}");
    });
}

#[test]
fn cancel_finds_a_collected_request() {
    run(async {
        // Given
        let (node, _by_hand, inbound) = receiving().await;
        let mailbox = Mailbox::new(8);
        let route = LocalRoute { sink: mailbox.clone(), events: Arc::new([]) };
        node.state.ctx.router.set_local(AppAddress::new(0x1001), route);
        // When: the request is behind a message, and its cancellation behind both.
        let batch = inbound.batch(Time::now());
        receive(&node, &inbound, 1, 1);
        let ask = |header: &mut Header| (header.flags, header.correlation) = (Flags::ASK, 7);
        receive_set(&node, &inbound, (1, 2), ask);
        let cancel = |header: &mut Header| (header.kind, header.correlation) = (Kind::CANCEL, 7);
        receive_set(&node, &inbound, (1, 3), cancel);
        receive(&node, &inbound, 1, 4);
        drop(batch);
        // Then
        let mut reader = mailbox.attach();
        for number in [1_u16, 4] {
            let taken = within("a message", poll_fn(|cx| reader.poll_take(cx))).await;
            reader.finish(Outcome::Delivered);
            assert_eq!(taken.expect("nobody else reads it").payload[..], number.to_le_bytes());
        }
        assert_eq!(mailbox.tally(Class::Control).expired, 1);
    });
}

#[test]
fn reply_and_report_do_not_overtake_collected_messages() {
    run(async {
        // Given
        let (node, _by_hand, inbound) = receiving().await;
        let taken = EventQueue::new(100);
        let never = AtomicBool::new(true);
        let sink = Arc::new(Breaking { taken: taken.clone(), breaks_at: 0, has_broken: never });
        node.state.ctx.router.set_local(AppAddress::new(0x1001), LocalRoute { sink, events: Arc::new([]) });
        let mut taken = taken.attach();
        // When
        let batch = inbound.batch(Time::now());
        (1..=2).for_each(|number| receive(&node, &inbound, 1, number));
        receive_set(&node, &inbound, (1, 3), |header| header.flags = Flags::REPLY);
        (4..=5).for_each(|number| receive(&node, &inbound, 1, number));
        let members = |header: &mut Header| (header.kind, header.flags) = (Kind::MEMBERS, Flags::OUTCOME);
        receive_set(&node, &inbound, (1, 6), members);
        // Then: the application has all of them while the batch goes on.
        for number in 1..=5 {
            let next = taken.next().now_or_never().flatten();
            assert_eq!(next, Some(number), "before the end of the batch");
        }
        drop(batch);
    });
}
