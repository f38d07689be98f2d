//! The receivers of messages to a group, and the cost of a join.

use bytes::Bytes;

use super::*;
use crate::wire::Header;

const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
const PEER: NodeAddress = NodeAddress::new(0x7f00_0002);
const OTHER: NodeAddress = NodeAddress::new(0x7f00_0003);
const DRIVES: AppAddress = AppAddress::group("drives");
const LEGS: AppAddress = AppAddress::group("legs");

/// Counts its messages.
#[derive(Default)]
struct Sink(AtomicU64);

impl MessageSink for Sink {
    fn submit(&self, _: Message) -> Result<(), SubmitError> {
        self.0.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }
}

fn app(number: u32) -> AppAddress {
    AppAddress::new(0x1000 + number)
}

/// A router with this many applications, each with its sink.
fn router(apps: u32) -> (Router, Vec<Arc<Sink>>) {
    let router = Router::new(NODE);
    let sinks: Vec<_> = (0..apps).map(|_| Arc::new(Sink::default())).collect();
    for (number, sink) in (0..).zip(&sinks) {
        router.set_local(app(number), LocalRoute { sink: sink.clone(), events: Arc::new([]) });
    }
    (router, sinks)
}

fn to(group: AppAddress) -> Message {
    let header = Header::new(Kind::named("test.word"), Tid::NONE, Tid::new(NodeAddress::ALL, group));
    Message::new(header, Bytes::new())
}

fn got(sinks: &[Arc<Sink>]) -> Vec<u64> {
    sinks.iter().map(|sink| sink.0.swap(0, Ordering::Relaxed)).collect()
}

#[test]
fn join_and_leave_copy_only_their_group() {
    // Given
    let (router, _) = router(3);
    router.set_member(LEGS, app(0), true);
    let (routes, legs) = (router.snapshot.load().table.clone(), router.groups_with_members());
    // When
    assert!(router.set_member(DRIVES, app(1), true) && router.set_member(DRIVES, app(1), false));
    router.set_remote_groups(PEER, &[DRIVES, LEGS]);
    // Then
    assert!(Arc::ptr_eq(&routes, &router.snapshot.load().table));
    assert!(Arc::ptr_eq(&legs[0].1, &router.groups_with_members()[0].1));
    // And: a change without effect replaces nothing
    let members = router.snapshot.load_full();
    assert!(!router.set_member(LEGS, app(0), true) && !router.set_member(DRIVES, app(0), false));
    router.set_remote_groups(PEER, &[LEGS, DRIVES]);
    assert!(Arc::ptr_eq(&members, &router.snapshot.load_full()));
}

#[test]
fn group_reaches_present_members_here_and_elsewhere() {
    let (router, sinks) = router(3);
    let peers = [PEER, OTHER].map(|node| {
        let sink = Arc::new(Sink::default());
        router.set_peer(node, sink.clone());
        sink
    });
    [2, 0].into_iter().for_each(|number| assert!(router.set_member(DRIVES, app(number), true)));
    router.set_remote_groups(PEER, &[DRIVES, LEGS]);
    router.set_remote_groups(OTHER, &[DRIVES]);
    assert_eq!(router.send(to(DRIVES)), Ok(()));
    assert_eq!((got(&sinks), got(&peers)), (vec![1, 0, 1], vec![1, 1]));
    assert_eq!(router.send(to(LEGS)), Ok(()));
    assert_eq!((got(&sinks), got(&peers)), (vec![0, 0, 0], vec![1, 0]));
    // A copy from elsewhere stays here.
    assert_eq!(router.deliver(to(DRIVES)), Ok(()));
    assert_eq!((got(&sinks), got(&peers)), (vec![1, 0, 1], vec![0, 0]));
    router.set_member(DRIVES, app(0), false);
    router.set_remote_groups(OTHER, &[LEGS]);
    assert_eq!(router.send(to(DRIVES)), Ok(()));
    assert_eq!((got(&sinks), got(&peers)), (vec![0, 0, 1], vec![1, 0]));
    router.set_remote_groups(PEER, &[]);
    router.remove_local(app(2));
    assert_eq!((router.send(to(DRIVES)), got(&peers)), (Ok(()), vec![0, 0]));
}

#[test]
fn reach_of_a_message_is_known_before_sending() {
    let (router, _) = router(3);
    for peer in [PEER, OTHER] {
        router.set_peer(peer, Arc::new(Sink::default()));
    }
    (0..2).for_each(|number| _ = router.set_member(LEGS, app(number), true));
    router.set_remote_groups(PEER, &[LEGS]);
    for (node, to, here, elsewhere) in [
        (NODE, app(0), 1, 0),
        (NodeAddress::HERE, app(0), 1, 0),
        (PEER, app(0), 0, 1),
        (NodeAddress::ALL, LEGS, 2, 1),
        (NODE, LEGS, 2, 0),
        (PEER, LEGS, 0, 1),
        (NodeAddress::ALL, AppAddress::ALL, 3, 2),
        (NodeAddress::ALL, app(0), 1, 2),
        (NodeAddress::ALL, DRIVES, 0, 0),
    ] {
        assert_eq!(router.reach(Tid::new(node, to)), Reach { here, elsewhere }, "{node}/{to}");
    }
}

#[test]
fn reused_address_is_in_no_group_of_its_predecessor() {
    let (router, sinks) = router(1);
    [DRIVES, LEGS].into_iter().for_each(|group| assert!(router.set_member(group, app(0), true)));
    assert_eq!(router.memberships(), 2);
    router.remove_local(app(0));
    assert_eq!((router.groups(), router.memberships()), (Vec::new(), 0));
    router.set_local(app(0), LocalRoute { sink: sinks[0].clone(), events: Arc::new([]) });
    assert_eq!(router.send(to(DRIVES)), Ok(()));
    assert_eq!(got(&sinks), [0]);
    assert!(!router.is_member(DRIVES, app(0)));
}

#[test]
fn members_are_listed_as_a_message_reaches_them() {
    let (router, _) = router(3);
    let layer = LocalRoute { sink: Arc::new(Sink::default()), events: Arc::new([]) };
    router.set_local(AppAddress::SYNC, layer);
    [2, 0, 9].into_iter().for_each(|number| assert!(router.set_member(DRIVES, app(number), true)));
    assert_eq!(router.members(DRIVES), [app(0), app(2)], "one that is not there gets nothing");
    assert_eq!(router.members(AppAddress::ALL), [app(0), app(1), app(2)]);
    assert_eq!(router.members(app(1)), [app(1)]);
    assert_eq!((router.members(LEGS), router.members(app(9))), (Vec::new(), Vec::new()));
    assert!(router.is_member(DRIVES, app(2)) && !router.is_member(DRIVES, app(1)));
}

/// One member hands over to another, again and again, and a sender never finds the group empty.
#[test]
fn send_during_member_changes_reaches_a_member() {
    let router = Arc::new(Router::new(NODE));
    let sink: Arc<dyn MessageSink> = Arc::new(Sink::default());
    let route = || LocalRoute { sink: sink.clone(), events: Arc::new([]) };
    router.set_local(app(0), route());
    router.set_member(LEGS, app(0), true);
    let sender = std::thread::spawn({
        let router = router.clone();
        move || {
            let sent = (0..200_000).map(|_| router.send(to(LEGS)));
            sent.filter(Result::is_err).count()
        }
    });
    let mut last = 0;
    while !sender.is_finished() {
        let next = 1 - last;
        router.set_local(app(next), route());
        router.set_member(LEGS, app(next), true);
        router.remove_local(app(last));
        last = next;
    }
    assert_eq!(sender.join().unwrap(), 0);
}
