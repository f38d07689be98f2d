//! An access list at the node that receives: what it refuses has its outcome, and reaches nobody, whichever way it comes.

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    wire::{Class, Flags, Message},
};

use super::{
    bench::{ByHand, NINE, Node, next, pair, run},
    classes::of_class,
};
use crate::access::Access;

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
fn what_the_list_does_not_allow_is_rejected_with_that_reason_and_the_link_stays() {
    run(async {
        let mut node = Node::start(1).await;
        Access::in_test(&node.stores, "[[rule]]\nfrom = ['0.0.0.9/1001']\nto = ['*/1001']\n");
        let mut peer = ByHand::linked_to(&mut node).await;
        let (mut open, mut shut) = (node.app(1), node.app(2));
        peer.say(&confirmed(from_nine(&node, node.tid(2), b"closed"), 5)).await;
        let outcome = peer.hear().await;
        assert_eq!((outcome.header.correlation, &outcome.payload[..]), (5, &[NOT_ALLOWED.code()][..]));
        peer.say(&from_nine(&node, node.tid(2), b"unconfirmed")).await;
        peer.say(&from_nine(&node, node.tid(1), b"allowed")).await;
        assert_eq!(&next("the allowed message", &mut open).await.payload[..], b"allowed");
        assert_eq!(node.stores.refusals.of("access list"), 2);
        assert!(futures_util::FutureExt::now_or_never(futures_util::StreamExt::next(&mut shut)).is_none());
    });
}

#[test]
fn of_a_group_and_of_all_only_those_get_it_whom_the_list_lets() {
    run(async {
        let mut node = Node::start(1).await;
        let rules = "[[rule]]\nfrom = ['*']\nto = ['*/1001']\n[[rule]]\nfrom = ['*']\ngroups = ['drives']\n";
        Access::in_test(&node.stores, rules);
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut inboxes = [node.app(1), node.app(2)];
        for group in ["drives", "others"] {
            for number in 1..=2 {
                let app = node.tid(number).app;
                node.stores.router.set_member(Tid::group(group).app, app, true);
            }
        }
        peer.say(&from_nine(&node, Tid::group("drives"), b"both")).await;
        peer.say(&from_nine(&node, Tid::group("others"), b"the first")).await;
        peer.say(&from_nine(&node, Tid::BROADCAST, b"the first")).await;
        peer.say(&from_nine(&node, Tid::group("drives"), b"end")).await;
        for (inbox, expected) in
            inboxes.iter_mut().zip([&["both", "the first", "the first", "end"][..], &["both", "end"]])
        {
            for word in expected {
                assert_eq!(&next("a message to many", inbox).await.payload[..], word.as_bytes());
            }
        }
        assert_eq!(node.stores.refusals.of("access list"), 2);
    });
}

#[test]
fn each_class_is_let_through_by_itself_and_another_list_counts_from_the_next_message_on() {
    run(async {
        let (mut a, b) = pair().await;
        let mut inbox = b.app(1);
        let access = Access::in_test(&b.stores, "[[rule]]\nfrom = ['*']\nto = ['*']\nclasses = ['bulk']\n");
        let send = |a: &Node, class, correlation| {
            let message = of_class(class, a.confirmed(b.tid(1), correlation));
            a.stores.router.send(message).expect("the peer takes it");
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
fn a_reply_needs_no_leave_and_an_application_of_the_node_itself_does() {
    run(async {
        let mut node = Node::start(1).await;
        Access::in_test(&node.stores, "");
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut inbox = node.app(2);
        let mut reply = from_nine(&node, node.tid(2), b"reply");
        reply.header.flags = Flags::REPLY;
        peer.say(&reply).await;
        assert_eq!(&next("the reply", &mut inbox).await.payload[..], b"reply");
        let own = node.message(node.tid(2), b"mine");
        assert_eq!(node.stores.router.send(own), Err(Rejection::NotAllowed));
    });
}
