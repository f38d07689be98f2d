//! An access list at the receiving node: a rejected message has its outcome, and reaches no application, by any
//! transport.

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    wire::{Class, Flags, Message},
};

use super::{
    bench::{ByHand, NINE, Node, next, pair, run},
    classes::of_class,
};

const NOT_ALLOWED: Outcome = Outcome::Rejected(Rejection::NotAllowed);

fn from_nine(node: &Node, to: Tid, payload: &[u8]) -> Message {
    let mut message = node.message(to, payload);
    message.header.source.node = NINE;
    message
}

fn confirmed(mut message: Message, correlation: u64) -> Message {
    message.header.flags = Flags::CONFIRM;
    message.header.correlation = correlation;
    message
}

#[test]
fn disallowed_message_is_rejected_and_the_link_stays() {
    run(async {
        let mut node = Node::start(1).await;
        node.state
            .security
            .access_in_test(&node.state.ctx, "[[rule]]\nfrom = ['0.0.0.9/1001']\nto = ['*/1001']\n");
        let mut peer = ByHand::linked_to(&mut node).await;
        let (mut open, mut shut) = (node.app(1), node.app(2));
        peer.send(&confirmed(from_nine(&node, node.tid(2), b"closed"), 5)).await;
        let outcome = peer.receive().await;
        assert_eq!((outcome.header.correlation, &outcome.payload[..]), (5, &[NOT_ALLOWED.code()][..]));
        peer.send(&from_nine(&node, node.tid(2), b"unconfirmed")).await;
        peer.send(&from_nine(&node, node.tid(1), b"allowed")).await;
        assert_eq!(&next("the allowed message", &mut open).await.payload[..], b"allowed");
        assert_eq!(node.state.ctx.refusals.of("access list"), 2);
        assert!(futures_util::FutureExt::now_or_never(futures_util::StreamExt::next(&mut shut)).is_none());
    });
}

#[test]
fn group_and_broadcast_reach_allowed_members_only() {
    run(async {
        let mut node = Node::start(1).await;
        let rules = "[[rule]]\nfrom = ['*']\nto = ['*/1001']\n[[rule]]\nfrom = ['*']\ngroups = ['drives']\n";
        node.state.security.access_in_test(&node.state.ctx, rules);
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut inboxes = [node.app(1), node.app(2)];
        for group in ["drives", "others"] {
            for number in 1..=2 {
                let app = node.tid(number).app;
                node.state.ctx.router.set_member(Tid::group(group).app, app, true);
            }
        }
        peer.send(&from_nine(&node, Tid::group("drives"), b"both")).await;
        peer.send(&from_nine(&node, Tid::group("others"), b"the first")).await;
        peer.send(&from_nine(&node, Tid::BROADCAST, b"the first")).await;
        peer.send(&from_nine(&node, Tid::group("drives"), b"end")).await;
        for (inbox, expected) in
            inboxes.iter_mut().zip([&["both", "the first", "the first", "end"][..], &["both", "end"]])
        {
            for word in expected {
                assert_eq!(&next("a message to many", inbox).await.payload[..], word.as_bytes());
            }
        }
        assert_eq!(node.state.ctx.refusals.of("access list"), 2);
    });
}

#[test]
fn each_class_is_checked_against_the_present_list() {
    run(async {
        let (mut a, b) = pair().await;
        let mut inbox = b.app(1);
        let access = b
            .state
            .security
            .access_in_test(&b.state.ctx, "[[rule]]\nfrom = ['*']\nto = ['*']\nclasses = ['bulk']\n");
        let send = |a: &Node, class, correlation| {
            let message = of_class(class, a.confirmed(b.tid(1), correlation));
            a.state.ctx.router.send(message).expect("the peer takes it");
        };
        send(&a, Class::Control, 1);
        assert_eq!(next("the first outcome", &mut a.settled).await, (1, NOT_ALLOWED));
        send(&a, Class::Bulk, 2);
        next("what is allowed", &mut inbox).await.settle(Outcome::Delivered);
        assert_eq!(next("the second outcome", &mut a.settled).await, (2, Outcome::Delivered));
        access.replace_in_test("[[rule]]\nfrom = ['*']\nto = ['*']\nclasses = ['control']\n");
        send(&a, Class::Bulk, 3);
        assert_eq!(next("the third outcome", &mut a.settled).await, (3, NOT_ALLOWED));
        send(&a, Class::Control, 4);
        next("what is allowed now", &mut inbox).await.settle(Outcome::Delivered);
        assert_eq!(next("the fourth outcome", &mut a.settled).await, (4, Outcome::Delivered));
    });
}

#[test]
fn only_a_requested_reply_needs_no_permission() {
    run(async {
        // Given: an application that has sent a request to one of the peer
        let mut node = Node::start(1).await;
        node.state.security.access_in_test(&node.state.ctx, "");
        let mut peer = ByHand::linked_to(&mut node).await;
        let (mut inbox, mut other) = (node.app(2), node.app(3));
        let reply = |to, correlation, word: &'static [u8]| {
            let mut reply = from_nine(&node, to, word);
            (reply.header.flags, reply.header.correlation) = (Flags::REPLY, correlation);
            reply
        };
        let asked = reply(node.tid(2), 7, b"reply");
        let mut question = node.message(asked.header.source, b"question");
        (question.header.source, question.header.correlation) = (node.tid(2), 7);
        question.header.flags = Flags::ASK;
        node.state.ctx.router.send(question).expect("the peer takes it");
        assert_eq!(&peer.receive().await.payload[..], b"question");
        // When: unrequested replies arrive, to one and to all, and then the requested one
        peer.send(&reply(node.tid(2), 8, b"unasked")).await;
        peer.send(&reply(node.tid(3), 7, b"not its own")).await;
        node.state.ctx.router.set_member(Tid::group("drives").app, node.tid(3).app, true);
        peer.send(&reply(Tid::group("drives"), 7, b"to a group")).await;
        peer.send(&reply(Tid::BROADCAST, 7, b"to all")).await;
        peer.send(&asked).await;
        peer.send(&reply(node.tid(2), 7, b"a second time")).await;
        peer.send(&confirmed(from_nine(&node, node.tid(2), b"closed"), 5)).await;
        // Then: the requested one was delivered, and nothing else
        assert_eq!(&next("the reply", &mut inbox).await.payload[..], b"reply");
        assert_eq!(peer.receive().await.header.correlation, 5);
        for inbox in [&mut inbox, &mut other] {
            let more = futures_util::FutureExt::now_or_never(futures_util::StreamExt::next(inbox));
            assert!(more.is_none(), "{more:?}");
        }
        let to_many = node.message(Tid::group("drives"), b"mine");
        assert_eq!(node.state.ctx.router.send(to_many), Err(Rejection::NotAllowed));
        let own = node.message(node.tid(2), b"mine");
        assert_eq!(node.state.ctx.router.send(own), Err(Rejection::NotAllowed));
    });
}
