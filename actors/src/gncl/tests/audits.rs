//! What the audit says of messages between two nodes, whatever becomes of them.

use std::{collections::BTreeSet, time::Duration};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    time::Time,
    wire::Class,
};

use super::bench::{ByHand, NINE, Node, next, pair, run, within};
use crate::audit::{self, Account, Place};

/// What `at` says of what `from` has brought, once as much of it has come as `taken` says and none is in hand.
async fn from(at: &Node, from: &Node, taken: u64) -> Account {
    let place = Place::FromNode { node: from.address(), class: Some(Class::Control) };
    within("all to have come", async {
        loop {
            let account = audit::read(&at.stores).account(&place);
            if account.taken >= taken && account.unexplained() == 0 {
                return account;
            }
            tokio::task::yield_now().await;
        }
    })
    .await
}

/// What `at` says of what goes to `to`, once nothing of it is under way.
async fn to(at: &Node, to: &Node) -> Account {
    let place = Place::ToNode { node: to.address(), class: Some(Class::Control) };
    within("all to be acknowledged", async {
        loop {
            let account = audit::read(&at.stores).account(&place);
            assert_eq!(account.unexplained(), 0, "{account:?}");
            if account.waiting + account.unacknowledged == 0 {
                return account;
            }
            tokio::task::yield_now().await;
        }
    })
    .await
}

#[test]
fn each_message_between_two_nodes_is_counted_where_it_ends_and_both_ends_agree() {
    run(async {
        // Given
        let (mut a, b) = pair().await;
        let mut inbox = b.app(1);
        // When: one arrives, one is for nobody, one is too old, and a confirmed one is refused by the node itself
        a.send(b.tid(1), b"arrives");
        next("the message", &mut inbox).await;
        a.send(b.tid(7), b"for nobody");
        let mut old = a.confirmed(b.tid(1), 1);
        old.header.sent = Time::from_nanos(1);
        old.header.time_to_live_us = 1;
        a.stores.router.send(old).unwrap();
        a.stores.router.send(a.confirmed(b.tid(7), 2)).unwrap();
        let told = [next("an outcome", &mut a.settled).await, next("an outcome", &mut a.settled).await];
        assert_eq!(told, [(1, Outcome::Expired), (2, Outcome::Rejected(Rejection::NoSuchApplication))]);
        // Then
        let (sent, came) = (to(&a, &b).await, from(&b, &a, 3).await);
        assert_eq!((sent.taken, sent.delivered, sent.expired), (4, 3, 1), "{sent:?}");
        assert_eq!((came.taken, came.handed_on, came.rejected), (3, 1, 2), "{came:?}");
        let (said, heard) = (to(&b, &a).await, from(&a, &b, 1).await);
        assert_eq!((said.taken, said.own, said.delivered), (1, 1, 1), "the outcome: {said:?}");
        assert_eq!((heard.taken, heard.delivered, heard.handed_on), (1, 1, 0), "{heard:?}");
    });
}

#[test]
fn of_a_node_that_is_lost_it_is_still_known_what_became_of_its_messages() {
    run(async {
        let (mut a, b) = pair().await;
        let mut inbox = b.app(1);
        a.send(b.tid(1), b"arrives");
        next("the message", &mut inbox).await;
        let sent = to(&a, &b).await;
        a.lose(b.address());
        a.broken().await;
        let former = within("the peer to be gone", async {
            loop {
                let account = audit::read(&a.stores).account(&Place::ToFormerNodes);
                if account.taken > 0 {
                    return account;
                }
                tokio::task::yield_now().await;
            }
        })
        .await;
        assert_eq!((former.taken, former.delivered, former.unexplained()), (sent.taken, sent.delivered, 0));
    });
}

#[test]
fn a_peer_that_does_not_know_the_question_is_said_not_to_have_answered() {
    run(async {
        let mut node = Node::start(1).await;
        let _old = ByHand::linked_to(&mut node).await;
        let stores = node.stores.clone();
        let asked = tokio::task::spawn_blocking(move || {
            audit::audit(&stores, &BTreeSet::from([NINE]), Duration::from_millis(20)).unwrap()
        });
        let audit = within("the audit", asked).await.unwrap();
        assert_eq!((audit.silent, audit.nodes.len()), (vec![NINE], 1));
        assert_eq!(audit.unexplained, []);
    });
}
