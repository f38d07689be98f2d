//! The order in which remembered addresses are evicted, and the changes that count.

use super::*;

fn at(last: u8) -> SocketAddr {
    ([10, 0, 0, last], 6911).into()
}

fn node(last: u8) -> NodeAddress {
    NodeAddress::from([10, 0, 0, last])
}

fn peer(last: u8, unanswered: u32) -> RememberedPeer {
    RememberedPeer { address: at(last), node: node(last), unanswered }
}

fn kept(remembered: &Remembered) -> Vec<SocketAddr> {
    remembered.entries.iter().map(|entry| entry.peer.address).collect()
}

fn has(remembered: &Remembered, last: u8) -> bool {
    kept(remembered).contains(&at(last))
}

fn here(_: &RememberedPeer) -> Presence {
    Presence::Here
}

fn absent(_: &RememberedPeer) -> Presence {
    Presence::Absent
}

#[test]
fn node_met_longest_ago_is_evicted() {
    let mut remembered = Remembered::default();
    (1..=64).for_each(|last| remembered.met(node(last), at(last), here));
    remembered.met(node(1), at(1), here);
    remembered.met(node(65), at(65), absent);
    assert_eq!(kept(&remembered).len(), REMEMBERED_MAX);
    assert!(has(&remembered, 1) && !has(&remembered, 2) && has(&remembered, 65));
}

#[test]
fn members_stay_and_the_oldest_former_member_is_evicted() {
    let mut remembered = Remembered::default();
    (1..=64).for_each(|last| remembered.met(node(last), at(last), here));
    // All but 1, 2 and 64 are members. 64 is a member at no remembered address; 1 was a member for longer than 2.
    remembered.refresh(node(2));
    remembered.refresh(node(1));
    let presence = |peer: &RememberedPeer| match peer.node {
        other if [node(1), node(2)].contains(&other) => Presence::Absent,
        other if other == node(64) => Presence::Elsewhere,
        _ => Presence::Here,
    };
    for (last, left) in [(65, 2), (66, 1), (67, 64)] {
        assert!(has(&remembered, left));
        remembered.met(node(last), at(last), presence);
        assert!(!has(&remembered, left) && has(&remembered, last), "{left} makes room for {last}");
    }
    let (before, changes) = (kept(&remembered), remembered.changes);
    remembered.met(node(68), at(68), presence);
    assert_eq!((kept(&remembered), remembered.changes), (before, changes), "a member answers at each");
}

#[test]
fn many_addresses_of_one_node_leave_room() {
    let mut remembered = Remembered::default();
    (1..=8).for_each(|last| remembered.met(node(1), at(last), here));
    assert_eq!(kept(&remembered), [at(1), at(2)]);
    let before = remembered.changes;
    remembered.met(node(1), at(3), here);
    assert_eq!(remembered.changes, before, "nothing was kept, so nothing has changed");
    // It has moved.
    let moved =
        |peer: &RememberedPeer| if peer.address == at(1) { Presence::Elsewhere } else { Presence::Here };
    remembered.met(node(1), at(9), moved);
    assert_eq!(kept(&remembered), [at(2), at(9)]);
}

#[test]
fn second_address_of_a_node_yields_first() {
    let mut remembered = Remembered::default();
    for last in 1..=32 {
        remembered.met(node(last), at(last), here);
        remembered.met(node(last), at(last + 100), here);
    }
    remembered.met(node(33), at(33), here);
    assert_eq!(kept(&remembered).len(), REMEMBERED_MAX);
    assert!(has(&remembered, 33) && has(&remembered, 1) && !has(&remembered, 101) && has(&remembered, 102));
    let before = kept(&remembered);
    remembered.met(node(33), at(133), here);
    remembered.met(node(1), at(101), here);
    assert_eq!(kept(&remembered), before, "each has one");
}

#[test]
fn nodes_met_in_this_incarnation_come_first() {
    let mut remembered = Remembered::default();
    remembered.met(node(1), at(1), here);
    remembered.load(Time::ZERO, (1..=80).map(|last| peer(last, 3)).collect());
    let kept = kept(&remembered);
    assert_eq!((kept.len(), kept.last()), (REMEMBERED_MAX, Some(&at(1))));
    assert_eq!(kept[0], at(18), "the newest of the earlier ones are kept");
    assert_eq!(remembered.entries.last().map(|entry| entry.peer), Some(peer(1, 0)));
}

#[test]
fn only_persistent_state_counts_as_a_change() {
    let mut remembered = Remembered::default();
    remembered.load(Time::ZERO, vec![peer(1, 0), peer(2, 3)]);
    assert_eq!(remembered.changes, 0);
    remembered.met(node(1), at(1), here);
    assert_eq!(remembered.changes, 0, "it was there already");
    remembered.met(node(2), at(2), here);
    assert_eq!(remembered.changes, 1, "it answers again");
    remembered.met(node(3), at(2), here);
    assert_eq!(remembered.changes, 2, "another node has its address");
}
