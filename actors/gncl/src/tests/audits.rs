//! The audit's accounts of messages between two nodes, for any disposition.

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    time::Time,
    wire::Class,
};
use sinew_session::{counts::Account, place::Place};

use super::bench::{Node, next, pair, run, within};

/// Returns the account at `at` of messages from `from`, after `taken` of them were accepted and none is in hand.
async fn from(at: &Node, from: &Node, taken: u64) -> Account {
    let place = Place::FromNode { node: from.address(), class: Some(Class::Control) };
    within("all to have come", async {
        loop {
            let account = at.state.account(&place);
            if account.taken >= taken && account.unexplained() == 0 {
                return account;
            }
            tokio::task::yield_now().await;
        }
    })
    .await
}

/// Returns the account at `at` of messages to `to`, after none of them is in flight.
async fn to(at: &Node, to: &Node) -> Account {
    let place = Place::ToNode { node: to.address(), class: Some(Class::Control) };
    within("all to be acknowledged", async {
        loop {
            let account = at.state.account(&place);
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
fn both_ends_account_for_each_message() {
    run(async {
        // Given
        let (mut a, b) = pair().await;
        let mut inbox = b.app(1);
        // When: one message arrives, one has no destination, one is too old, and the node itself rejects a confirmed
        // one
        a.send(b.tid(1), b"arrives");
        next("the message", &mut inbox).await;
        a.send(b.tid(7), b"for nobody");
        let mut old = a.confirmed(b.tid(1), 1);
        old.header.sent = Time::from_nanos(1);
        old.header.time_to_live_us = 1;
        a.state.ctx.router.send(old).unwrap();
        a.state.ctx.router.send(a.confirmed(b.tid(7), 2)).unwrap();
        let outcomes = [next("an outcome", &mut a.settled).await, next("an outcome", &mut a.settled).await];
        assert_eq!(outcomes, [(1, Outcome::Expired), (2, Outcome::Rejected(Rejection::NoSuchApplication))]);
        // Then
        let (sent, came) = (to(&a, &b).await, from(&b, &a, 3).await);
        assert_eq!((sent.taken, sent.delivered, sent.expired), (4, 3, 1), "{sent:?}");
        assert_eq!((came.taken, came.handed_on, came.rejected), (3, 1, 2), "{came:?}");
        let (said, received) = (to(&b, &a).await, from(&a, &b, 1).await);
        assert_eq!((said.taken, said.own, said.delivered), (1, 1, 1), "the outcome: {said:?}");
        assert_eq!((received.taken, received.delivered, received.handed_on), (1, 1, 0), "{received:?}");
    });
}

#[test]
fn messages_of_a_lost_node_stay_accounted_for() {
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
                let account = a.state.account(&Place::ToFormerNodes);
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
