//! Requests to another node without a waiting requester: cancelled wherever they are queued, and accounted for by the
//! audit. spec: GNCL-15

use std::{
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use futures_util::task::noop_waker;
use serde::{Deserialize, Serialize};
use sinew_model::clocks::{ClockDrift, ClockOffset};
use sinew_runtime::{
    mailbox::{Mailbox, MailboxReader},
    outcome::Outcome,
    pending::{AppSink, Pending},
    router::LocalRoute,
    sender::{Directory, Reply, Sender},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, Flags, Kind, Message, Payload},
};

use super::bench::{ByHand, NINE, Node, introduction, pair, run, within};
use crate::core::{Introduction, Lane};

/// Longer than any test.
const LONG: Duration = Duration::from_secs(60);

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Number(u64);

impl Payload for Number {
    const NAME: &'static str = "cancels.number";
}

struct Nobody;

impl Directory for Nobody {
    fn resolve(&self, _: &str) -> Option<Tid> {
        None
    }

    fn set_member(&self, _: AppAddress, _: AppAddress, _: bool) {}
}

/// An application that sends or receives requests.
struct App {
    mailbox: Arc<Mailbox>,
    reader: MailboxReader,
    sender: Sender,
}

impl App {
    fn of(node: &Node, number: u32, capacity: usize) -> Self {
        let (tid, pending, mailbox) = (node.tid(number), Pending::new(64), Mailbox::new(capacity));
        let sink = Arc::new(AppSink { pending: pending.clone(), inbox: mailbox.clone() });
        node.state.ctx.router.set_local(tid.app, LocalRoute { sink, events: Arc::new([]) });
        let sender = Sender::new(tid, node.state.ctx.router.clone(), Arc::new(Nobody), pending, 1 << 20);
        Self { reader: mailbox.attach(), mailbox, sender }
    }

    fn ask(&self, to: Tid, number: u64, within: Duration) -> Reply<Number> {
        self.sender.message(to, &Number(number)).ask(within).expect("somebody takes it")
    }

    /// Returns the number in the next message, which ends as delivered.
    async fn take(&mut self) -> u64 {
        let mut message = within("a message", async {
            loop {
                if let Poll::Ready(message) = self.reader.poll_take(&mut Context::from_waker(&noop_waker())) {
                    break message.expect("nobody else reads it");
                }
                tokio::task::yield_now().await;
            }
        })
        .await;
        self.reader.finish(Outcome::Delivered);
        message.settle(Outcome::Delivered);
        message.decode::<Number>().expect("a number").0
    }

    async fn holds(&self, count: usize) {
        until("so many to be in the mailbox", || self.mailbox.depth() == count).await;
    }
}

async fn until(what: &str, is_so: impl Fn() -> bool) {
    within(what, async {
        while !is_so() {
            tokio::task::yield_now().await;
        }
    })
    .await;
}

/// Returns the messages of `from` that wait at `at` for an application that reads nothing.
fn in_lines_at(at: &Node, from: &Node) -> u64 {
    let peer = at.state.store.peer(from.address()).expect("it is linked");
    peer.session(Lane::Control).expect("it has one").account().arrived.waiting
}

fn unconfirmed(at: &Node, to: &Node) -> usize {
    at.state.store.peer(to.address()).expect("it is linked").unconfirmed()
}

#[test]
fn abandoned_request_in_a_remote_mailbox_is_cancelled() {
    run(async {
        let (a, b) = pair().await;
        let (requester, mut asked) = (App::of(&a, 1, 8), App::of(&b, 1, 8));
        let [_first, second, _third] = [1, 2, 3].map(|number| requester.ask(b.tid(1), number, LONG));
        asked.holds(3).await;
        drop(second);
        asked.holds(2).await;
        assert_eq!([asked.take().await, asked.take().await], [1, 3]);
        until("each to have its outcome", || unconfirmed(&a, &b) == 0).await;
        assert_eq!(asked.mailbox.tally(Class::Control).expired, 1);
    });
}

#[test]
fn abandoned_request_for_a_full_remote_mailbox_is_cancelled() {
    run(async {
        let (a, b) = pair().await;
        let (requester, mut asked) = (App::of(&a, 1, 8), App::of(&b, 1, 1));
        let [first, second, third] = [1, 2, 3].map(|number| requester.ask(b.tid(1), number, LONG));
        asked.holds(1).await;
        until("two to be in a line", || in_lines_at(&b, &a) == 2).await;
        drop(third);
        until("one to be in a line", || in_lines_at(&b, &a) == 1).await;
        drop(second);
        until("none to be in a line", || in_lines_at(&b, &a) == 0).await;
        // The destination is no longer held: a new message is delivered as soon as there is room.
        let fourth = requester.ask(b.tid(1), 4, LONG);
        assert_eq!([asked.take().await, asked.take().await], [1, 4]);
        let peer = b.state.store.peer(a.address()).expect("it is linked");
        assert_eq!(peer.session(Lane::Control).expect("it has one").account().arrived.expired, 2);
        until("each to have its outcome", || unconfirmed(&a, &b) == 0).await;
        drop((first, fourth));
    });
}

#[test]
fn expired_request_is_not_handled_even_without_a_cancel() {
    run(async {
        let (a, b) = pair().await;
        // Otherwise its send time would be the arrival time.
        b.state.ctx.clocks.set(
            a.address(),
            a.state.ctx.incarnation,
            ClockOffset {
                theirs_minus_ours_ns: 0,
                bound: Duration::ZERO,
                at: Time::now(),
                drift: ClockDrift { ppb: 0, bound_ppb: 0 },
            },
        );
        let (requester, mut asked) = (App::of(&a, 1, 8), App::of(&b, 1, 8));
        let mut within = Duration::from_millis(30);
        loop {
            // On a busy machine its time may be over before it arrives.
            let mut reply = requester.ask(b.tid(1), 1, within);
            tokio::select! {
                biased;
                () = asked.holds(1) => {
                    reply.await.expect_err("nobody replies");
                    break;
                }
                _ = &mut reply => within *= 2,
            }
        }
        let _second = requester.ask(b.tid(1), 2, LONG);
        asked.holds(2).await;
        let first = match asked.reader.poll_take(&mut Context::from_waker(&noop_waker())) {
            Poll::Ready(Some(first)) => first,
            none @ (Poll::Ready(None) | Poll::Pending) => panic!("the first request waits there: {none:?}"),
        };
        // As an application's drive does with each received message.
        assert!(first.header.is_expired(Time::now()));
    });
}

#[test]
fn cancel_is_sent_only_to_peers_that_support_it() {
    for knows in [false, true] {
        run(async {
            let mut node = Node::start(1).await;
            let features = if knows { vec!["cancel".to_owned()] } else { Vec::new() };
            let hello = Introduction { features, ..introduction(node.address()) };
            let mut peer = ByHand::greeting(&node, &hello).await;
            node.up().await;
            let requester = App::of(&node, 1, 8);
            let to = Tid::new(NINE, AppAddress::new(0x1001));
            let reply = requester.ask(to, 1, LONG);
            let asked = peer.receive().await;
            assert!(asked.header.flags.has(Flags::ASK));
            drop(reply);
            requester.sender.send(to, &Number(2)).expect("it is sent");
            if knows {
                let Message { header, payload, .. } = peer.receive().await;
                assert_eq!(
                    (header.kind, header.class, header.flags),
                    (Kind::CANCEL, Class::Control, Flags::NONE)
                );
                assert_eq!(
                    (header.source, header.destination),
                    (asked.header.source, asked.header.destination)
                );
                assert_eq!((header.correlation, payload.len()), (asked.header.correlation, 0));
            }
            assert_eq!(peer.receive().await.decode::<Number>().expect("a number"), Number(2));
        });
    }
}
