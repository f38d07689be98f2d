//! What a client is owed that does not read for a while.

use std::collections::BTreeMap;

use super::*;

/// The outcomes of the messages 1 to `count`, when the client reads all that there is.
fn outcomes(client: &mut RawClient, count: u64) -> BTreeMap<u64, Outcome> {
    let mut outcomes = BTreeMap::new();
    while outcomes.len() < count as usize {
        let message = client.next().expect("an outcome is missing");
        if message.header.kind == Kind::OUTCOME {
            let (correlation, outcome) = outcome_of(&message);
            assert_eq!(outcomes.insert(correlation, outcome), None, "{correlation} ends once");
        }
    }
    outcomes
}

/// Fills the queue of a client that does not read with what is urgent.
fn fill(node: &TestNode, source: Tid, client: Tid) {
    let filler = || {
        let mut filler = filler(source, client);
        filler.header.class = Class::Control;
        filler
    };
    while node.stores.router.send(filler()).is_ok() {}
}

// spec: LNCL-16
#[test]
fn who_does_not_read_for_a_while_hears_of_each_of_its_messages_all_the_same() {
    // Given: a client whose queue is full of Control.
    let node = TestNode::start_with(|config| config.mailbox_capacity = 16);
    let app = node.local(1);
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    fill(&node, app.tid, tid);

    // When: it has something confirmed, for somebody and for nobody.
    let nobody = Tid::new(node.address(), AppAddress::fixed(9).unwrap());
    for correlation in 1..=8 {
        client.send(&confirmed(tid, if correlation % 2 == 0 { app.tid } else { nobody }, correlation));
    }
    for _ in 0..4 {
        app.next().settle(Outcome::Delivered);
    }

    // Then: it reads what became of each.
    let outcomes = outcomes(&mut client, 8);
    for (correlation, outcome) in outcomes {
        let none = Outcome::Rejected(Rejection::NoSuchApplication);
        assert_eq!(outcome, if correlation % 2 == 0 { Outcome::Delivered } else { none }, "{correlation}");
    }
}

// spec: LNCL-16
#[test]
fn who_takes_no_outcomes_is_read_no_more_until_it_takes_them() {
    // So many are never read of one who takes nothing.
    const FAR_TOO_MANY: u64 = 200_000;
    let node = TestNode::start_with(|config| config.mailbox_capacity = 4);
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    let nobody = Tid::new(node.address(), AppAddress::fixed(9).unwrap());

    // When: a client sends as long as the node takes it, and reads nothing.
    let sent = (1..FAR_TOO_MANY)
        .take_while(|correlation| client.takes_at_once(&confirmed(tid, nobody, *correlation)))
        .count() as u64;

    // Then: the node has stopped taking it, and when the client reads, each of its messages has its outcome.
    assert!(sent < FAR_TOO_MANY - 1, "the node keeps on reading");
    let outcomes = outcomes(&mut client, sent);
    let expected = Outcome::Rejected(Rejection::NoSuchApplication);
    assert!(outcomes.values().all(|outcome| *outcome == expected), "{outcomes:?}");
}

// spec: LNCL-16
#[test]
fn a_client_may_have_so_many_messages_without_an_outcome_and_one_more_is_refused() {
    // Given: a client with as many as it may have, at one that says nothing of them.
    const PENDING: u64 = 8 * 16;
    let node = TestNode::start_with(|config| config.mailbox_capacity = 16);
    let app = node.local(1);
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    let send = |client: &mut RawClient, correlations: std::ops::RangeInclusive<u64>| {
        correlations.for_each(|correlation| client.send(&confirmed(tid, app.tid, correlation)));
    };
    send(&mut client, 1..=PENDING);
    let held: Vec<_> = (0..PENDING).map(|_| app.next()).collect();

    // When: it sends one more, then: that one is refused.
    send(&mut client, PENDING + 1..=PENDING + 1);
    let refused = (PENDING + 1, Outcome::Rejected(Rejection::QueueFull));
    assert_eq!(outcome_of(&client.next().unwrap()), refused);

    // And when something is said of the others, the next one is taken.
    held.into_iter().for_each(|mut message| message.settle(Outcome::Delivered));
    outcomes(&mut client, PENDING);
    send(&mut client, PENDING + 2..=PENDING + 2);
    app.next().settle(Outcome::Delivered);
    assert_eq!(outcome_of(&client.next().unwrap()), (PENDING + 2, Outcome::Delivered));
}
