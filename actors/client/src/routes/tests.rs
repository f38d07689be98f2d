//! When a link is requested, and how many destinations are remembered.

use sinew_runtime::tid::{AppAddress, NodeAddress};

use super::*;

const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);

fn tid(index: u32) -> Tid {
    Tid::new(NODE, AppAddress::new(0x1000 + index))
}

fn routes(direct_links: DirectLinks) -> Routes {
    Routes::new(tid(0), direct_links)
}

fn at(millis: u64) -> Time {
    Time::ZERO + Duration::from_millis(millis)
}

/// Sends a message through the node. Returns whether a link is requested.
fn send(routes: &mut Routes, to: Tid, now: Time) -> bool {
    let is_requested = match routes.route(to, now) {
        Route::ViaNode => false,
        Route::RequestLink => {
            routes.asked(to, 1, now);
            true
        }
        Route::Direct(number) => panic!("no link was established: {number:?}"),
    };
    routes.sent_through_node(to, now);
    is_requested
}

/// Sends messages at the given times, in ms. Returns the number of the message with a link request, from 1.
fn requested_at(routes: &mut Routes, to: Tid, millis: impl IntoIterator<Item = u64>) -> Option<usize> {
    millis.into_iter().position(|millis| send(routes, to, at(millis))).map(|index| index + 1)
}

#[test]
fn automatic_requests_link_at_eighth_message_within_a_second() {
    for millis in [0, 1, 142] {
        let mut routes = routes(DirectLinks::Automatic);
        assert_eq!(requested_at(&mut routes, tid(1), (0..20).map(|number| number * millis)), Some(8));
        assert!(routes.is_asking());
    }
}

#[test]
fn endpoint_with_an_output_makes_no_automatic_link() {
    for (links, is_made) in [(DirectLinks::Automatic, false), (DirectLinks::Always, true)] {
        let mut routes = routes(links);
        routes.keep_to_node();
        assert_eq!(requested_at(&mut routes, tid(1), 0..20).is_some(), is_made);
        assert_eq!(routes.on_introduction(tid(2)).is_ok(), is_made);
    }
}

#[test]
fn automatic_requests_no_link_for_seven_messages_per_second() {
    let even = |number: u64| number * 143;
    let burst = |number: u64| number / 7 * 1_000 + number % 7;
    let routes = &mut routes(DirectLinks::Automatic);
    assert_eq!(requested_at(routes, tid(1), (0..10_000).map(even)), None);
    assert_eq!(requested_at(routes, tid(2), (0..10_000).map(burst)), None);
}

#[test]
fn automatic_counts_each_destination_alone() {
    let mut routes = routes(DirectLinks::Automatic);
    for to in [1, 2, 3].map(tid) {
        assert_eq!(requested_at(&mut routes, to, 0..7), None);
    }
    assert!(!send(&mut routes, tid(4), at(7)));
    assert!(send(&mut routes, tid(2), at(7)));
}

#[test]
fn automatic_link_is_not_useful_among_many_frequent_peers() {
    let useful_among = |peers: u32, direct_links| {
        let mut routes = routes(direct_links);
        for peer in 1..=peers {
            requested_at(&mut routes, tid(peer), 0..7);
        }
        // Occasional ones do not count.
        for peer in 100..150 {
            send(&mut routes, tid(peer), at(7));
        }
        let is_useful = routes.is_link_useful(at(8));
        let asks = (1..=peers).any(|peer| send(&mut routes, tid(peer), at(9)));
        assert!(is_useful || !asks, "after that, none of them gets a link");
        is_useful
    };
    let most = u32::try_from(AUTOMATIC_LINKS_MAX).unwrap();
    assert!(useful_among(most, DirectLinks::Automatic));
    assert!(!useful_among(most + 1, DirectLinks::Automatic));
    assert!(useful_among(most + 1, DirectLinks::Always));
}

#[test]
fn automatic_accepts_few_links() {
    let mut routes = routes(DirectLinks::Automatic);
    for number in 1..=AUTOMATIC_LINKS_MAX as u32 {
        assert_eq!(routes.on_introduction(tid(number)), Ok(()));
        routes.offered(tid(number), LinkNumber(number.into()));
    }
    assert_eq!(routes.on_introduction(tid(100)), Err(Rejection::QueueFull));
}

#[test]
fn automatic_accepts_introductions() {
    let mut routes = routes(DirectLinks::Automatic);
    assert_eq!(routes.on_introduction(tid(1)), Ok(()));
    // The same for a peer with counted messages.
    send(&mut routes, tid(1), at(0));
    assert_eq!(routes.on_introduction(tid(1)), Ok(()));
    routes.offered(tid(1), LinkNumber(1));
    assert_eq!(requested_at(&mut routes, tid(1), 0..20), None, "this side waits for the peer");
    routes.connected(tid(1), LinkNumber(1), Some(2), at(20));
    assert_eq!(routes.route(tid(1), at(20)), Route::Direct(LinkNumber(1)));
    assert_eq!(routes.written_link(tid(1)), Some(LinkNumber(1)));
}

#[test]
fn refused_request_is_repeated_only_after_frequent_messages() {
    let mut routes = routes(DirectLinks::Automatic);
    assert_eq!(requested_at(&mut routes, tid(1), 0..20), Some(8));
    routes.on_outcome(1, Outcome::Rejected(Rejection::Unsupported), at(20));
    assert_eq!(requested_at(&mut routes, tid(1), 21..1_000), None);
    // The refusal has ended.
    assert_eq!(requested_at(&mut routes, tid(1), (0..100).map(|number| 10_020 + number * 200)), None);
    assert_eq!(requested_at(&mut routes, tid(1), 40_000..40_020), Some(8));
}

#[test]
fn counted_destinations_are_bounded() {
    let mut routes = routes(DirectLinks::Automatic);
    for index in 1..=2_000 {
        assert!(!send(&mut routes, tid(index), at(u64::from(index))));
        assert!(routes.peers.len() <= UNLINKED_MAX);
    }
    assert_eq!(routes.peers.len(), UNLINKED_MAX);
    assert!(!routes.peers.contains_key(&tid(1)), "the oldest is replaced");
    assert_eq!(requested_at(&mut routes, tid(1), 2_001..2_020), Some(8));
}

#[test]
fn destination_is_counted_while_many_others_are_refused() {
    let mut routes = routes(DirectLinks::Automatic);
    for index in 1..=2_000 {
        routes.no_room(tid(index), at(0));
    }
    assert_eq!(routes.peers.len(), UNLINKED_MAX);
    assert_eq!(requested_at(&mut routes, tid(2_001), 0..20), Some(8));
}

#[test]
fn destination_that_never_has_a_link_is_not_remembered() {
    let mut routes = routes(DirectLinks::Automatic);
    let elsewhere = Tid::new(NodeAddress::new(0x7f00_0002), tid(1).app);
    let layer = Tid::new(NODE, AppAddress::LNCL);
    let group = Tid::new(NODE, AppAddress::group("drives"));
    for to in [tid(0), elsewhere, layer, group, Tid::BROADCAST] {
        assert_eq!(requested_at(&mut routes, to, 0..20), None);
    }
    assert!(routes.peers.is_empty());
}

#[test]
fn always_requests_link_at_first_message() {
    let mut routes = routes(DirectLinks::Always);
    assert_eq!(requested_at(&mut routes, tid(1), 0..20), Some(1));
    routes.on_outcome(1, Outcome::Rejected(Rejection::QueueFull), at(20));
    assert_eq!(requested_at(&mut routes, tid(1), 120..140), Some(1), "again when the refusal has ended");
    assert_eq!(routes.on_introduction(tid(2)), Ok(()));
}

#[test]
fn never_requests_no_link_and_refuses_introductions() {
    let mut routes = routes(DirectLinks::Never);
    assert_eq!(requested_at(&mut routes, tid(1), 0..20), None);
    assert_eq!(routes.on_introduction(tid(1)), Err(Rejection::Unsupported));
    assert!(routes.peers.is_empty());
}
