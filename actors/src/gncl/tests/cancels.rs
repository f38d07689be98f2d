//! Requests to another node that nobody waits for any more: taken back wherever they wait, explained by the audit. spec: GNCL-15

use std::{
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use futures_util::task::noop_waker;
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    mailbox::{Mailbox, MailboxReader},
    outcome::Outcome,
    pending::{AppOutlet, Pending},
    router::LocalRoute,
    sender::{Directory, Reply, Sender},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, Flags, Kind, Message, Payload},
};

use super::bench::{ByHand, NINE, Node, introduction, pair, run, within};
use crate::{
    clocks::{ClockDrift, ClockOffset},
    gncl::core::{Introduction, Lane},
};

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

/// An application that asks, or is asked.
struct App {
    mailbox: Arc<Mailbox>,
    reader: MailboxReader,
    sender: Sender,
}

impl App {
    fn of(node: &Node, number: u32, capacity: usize) -> Self {
        let (tid, pending, mailbox) = (node.tid(number), Pending::new(64), Mailbox::new(capacity));
        let outlet = Arc::new(AppOutlet { pending: pending.clone(), inbox: mailbox.clone() });
        node.stores.router.set_local(tid.app, LocalRoute { outlet, events: Arc::new([]) });
        let sender = Sender::new(tid, node.stores.router.clone(), Arc::new(Nobody), pending, 1 << 20);
        Self { reader: mailbox.attach(), mailbox, sender }
    }

    fn ask(&self, to: Tid, number: u64, within: Duration) -> Reply<Number> {
        self.sender.message(to, &Number(number)).ask(within).expect("somebody takes it")
    }

    /// The number in the next message, which ends as delivered.
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

/// Messages of `from` that wait at `at` for an application that takes nothing.
fn in_lines_at(at: &Node, from: &Node) -> u64 {
    let peer = at.stores.gncl.peer(from.address()).expect("it is linked");
    peer.way(Lane::Control).expect("it has one").account().arrived.waiting
}

fn unconfirmed(at: &Node, to: &Node) -> usize {
    at.stores.gncl.peer(to.address()).expect("it is linked").unconfirmed()
}

#[test]
fn a_request_that_waits_in_a_mailbox_of_another_node_is_taken_back_when_nobody_waits_for_it() {
    run(async {
        let (a, b) = pair().await;
        let (asker, mut asked) = (App::of(&a, 1, 8), App::of(&b, 1, 8));
        let [_first, second, _third] = [1, 2, 3].map(|number| asker.ask(b.tid(1), number, LONG));
        asked.holds(3).await;
        drop(second);
        asked.holds(2).await;
        assert_eq!([asked.take().await, asked.take().await], [1, 3]);
        until("each to have its outcome", || unconfirmed(&a, &b) == 0).await;
        assert_eq!(asked.mailbox.tally(Class::Control).expired, 1);
    });
}

#[test]
fn a_request_that_waits_at_the_other_node_for_a_full_mailbox_is_taken_back() {
    run(async {
        let (a, b) = pair().await;
        let (asker, mut asked) = (App::of(&a, 1, 8), App::of(&b, 1, 1));
        let [first, second, third] = [1, 2, 3].map(|number| asker.ask(b.tid(1), number, LONG));
        asked.holds(1).await;
        until("two to be in a line", || in_lines_at(&b, &a) == 2).await;
        drop(third);
        until("one to be in a line", || in_lines_at(&b, &a) == 1).await;
        drop(second);
        until("none to be in a line", || in_lines_at(&b, &a) == 0).await;
        // It is not held any more: what comes now finds its way as soon as there is room.
        let fourth = asker.ask(b.tid(1), 4, LONG);
        assert_eq!([asked.take().await, asked.take().await], [1, 4]);
        let way = b.stores.gncl.peer(a.address()).expect("it is linked");
        assert_eq!(way.way(Lane::Control).expect("it has one").account().arrived.expired, 2);
        until("each to have its outcome", || unconfirmed(&a, &b) == 0).await;
        drop((first, fourth));
    });
}

#[test]
fn a_request_whose_time_is_over_is_not_handled_though_nobody_takes_it_back() {
    run(async {
        let (a, b) = pair().await;
        // Else it would count as sent when it came.
        b.stores.clocks.set(
            a.address(),
            a.stores.incarnation,
            ClockOffset {
                theirs_minus_ours_ns: 0,
                bound: Duration::ZERO,
                at: Time::now(),
                drift: ClockDrift { ppb: 0, bound_ppb: 0 },
            },
        );
        let (asker, mut asked) = (App::of(&a, 1, 8), App::of(&b, 1, 8));
        let mut within = Duration::from_millis(30);
        loop {
            // On a machine that has much to do its time may be over before it has come.
            let mut reply = asker.ask(b.tid(1), 1, within);
            tokio::select! {
                biased;
                () = asked.holds(1) => {
                    reply.await.expect_err("nobody replies");
                    break;
                }
                _ = &mut reply => within *= 2,
            }
        }
        let _second = asker.ask(b.tid(1), 2, LONG);
        asked.holds(2).await;
        let first = match asked.reader.poll_take(&mut Context::from_waker(&noop_waker())) {
            Poll::Ready(Some(first)) => first,
            none @ (Poll::Ready(None) | Poll::Pending) => panic!("the first request waits there: {none:?}"),
        };
        // As an application's drive does with what it takes out.
        assert!(first.header.is_expired(Time::now()));
    });
}

#[test]
fn whoever_does_not_know_how_to_take_a_request_back_is_not_told_and_whoever_does_is() {
    for knows in [false, true] {
        run(async {
            let mut node = Node::start(1).await;
            let features = if knows { vec!["cancel".to_owned()] } else { Vec::new() };
            let hello = Introduction { features, ..introduction(node.address()) };
            let mut peer = ByHand::greeting(&node, &hello).await;
            node.up().await;
            let asker = App::of(&node, 1, 8);
            let to = Tid::new(NINE, AppAddress::new(0x1001));
            let reply = asker.ask(to, 1, LONG);
            let asked = peer.hear().await;
            assert!(asked.header.flags.has(Flags::ASK));
            drop(reply);
            asker.sender.send(to, &Number(2)).expect("it is sent");
            if knows {
                let Message { header, payload, .. } = peer.hear().await;
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
            assert_eq!(peer.hear().await.decode::<Number>().expect("a number"), Number(2));
        });
    }
}
