//! Who of this host may register what, and what its processes may send.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::AppAddress,
    wire::Kind,
};

use super::{Angle, confirmed, named, outcome_of};
use crate::{
    accept_pace::{REST, SAVED_MAX},
    api::{NodeApi, Registration},
    lncl::{
        AppFact,
        payload::{self, Register, Switch},
        testing::{RawClient, TestNode, WATCHDOG},
    },
    stores::lock,
};

#[test]
fn what_a_client_sends_is_judged_as_what_comes_from_elsewhere() {
    let node = TestNode::start_guarded("[[rule]]\nfrom = ['gait']\nto = ['*/1001']\n");
    let (open, shut) = (node.local(1), node.local(2));
    let (mut gait, tid) = RawClient::register(&node, &named("gait"));
    gait.send(&confirmed(tid, shut.tid, 1));
    assert_eq!(outcome_of(&gait.next().unwrap()), (1, Outcome::Rejected(Rejection::NotAllowed)));
    gait.send(&confirmed(tid, open.tid, 2));
    open.next().settle(Outcome::Delivered);
    assert_eq!(outcome_of(&gait.next().unwrap()), (2, Outcome::Delivered));
    let (mut other, tid) = RawClient::register(&node, &named("log"));
    other.send(&confirmed(tid, open.tid, 3));
    assert_eq!(outcome_of(&other.next().unwrap()), (3, Outcome::Rejected(Rejection::NotAllowed)));
    assert_eq!(node.refused("access list"), 2);
}

#[test]
fn what_two_processes_say_to_each_other_stays_where_the_list_sees_it() {
    // Given: two that both want a direct link, and a list that lets them say everything
    let node = TestNode::start_guarded("[[rule]]\nfrom = ['*']\nto = ['*']\n");
    let api = NodeApi::connect(node.path()).unwrap();
    let register =
        || api.register_transport_address(Registration::new().direct(true).deadline(WATCHDOG)).unwrap();
    let (mut taker, mut asker) = (register(), register());
    let to = taker.tid();
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !is_over.load(Ordering::Relaxed) {
                if let Some(received) = taker.receive(Duration::from_millis(10)).unwrap() {
                    received.settle(Outcome::Delivered);
                }
            }
        });
        let mut send = || asker.send_confirmed(to, &Angle { degrees: 1.0 }, WATCHDOG).unwrap();
        // When: they have said enough for an introduction
        let said: Vec<_> = (0..ENOUGH).map(|_| send()).collect();
        // Then: another list counts for the next thing that they say
        node.stores.access.get().expect("it has a list").replace_in_test("");
        let after = send();
        is_over.store(true, Ordering::Relaxed);
        assert_eq!(said, vec![Outcome::Delivered; ENOUGH]);
        assert_eq!(after, Outcome::Rejected(Rejection::NotAllowed));
    });
}

#[test]
fn nobody_gets_the_address_of_somebody_elses_that_other_nodes_may_still_call_by_its_name() {
    let mut node = TestNode::start_guarded("[[rule]]\nfrom = ['*']\nto = ['*']\n");
    let (gait, tid) = RawClient::register(&node, &named("gait"));
    let again =
        |node: &TestNode, name| RawClient::register(node, &Register { former: Some(tid.app), ..named(name) });
    drop(gait);
    while !matches!(node.fact(), AppFact::Unregistered { app } if app == tid.app) {}
    let (guest, its) = again(&node, "guest");
    assert_ne!(its, tid);
    let (_gait, its) = again(&node, "gait");
    assert_eq!(its, tid);
    drop(guest);
}

#[test]
fn nobody_turns_to_a_direct_link_where_there_is_a_list() {
    let node = TestNode::start_guarded("");
    let (_other, to) = RawClient::register(&node, &named("gait"));
    let (mut guest, tid) = RawClient::register(&node, &named("guest"));
    let mut switch = payload::frame(
        Kind::LNCL_SWITCH,
        tid,
        payload::lncl_of(tid.node),
        &Switch { peer: to.bits(), number: 1 },
    );
    switch.header.correlation = 3;
    guest.send(&switch);
    assert_eq!(outcome_of(&guest.next().unwrap()), (3, Outcome::Rejected(Rejection::Unsupported)));
}

/// Messages after which two that may are introduced.
const ENOUGH: usize = 200;

/// A user that is neither root nor the node's, and a group of that number; no account needs to have it.
const STRANGER: u32 = 54_321;

/// Does this as that user; `None` where this test may not.
fn as_stranger<T: Send>(act: impl FnOnce() -> T + Send) -> Option<T> {
    if !rustix::process::geteuid().is_root() {
        println!("skipped: only root can act as another user");
        return None;
    }
    // Only this one thread becomes somebody else.
    let thread = || {
        rustix::thread::set_thread_gid(rustix::process::Gid::from_raw(STRANGER)).expect("root may");
        rustix::thread::set_thread_uid(rustix::process::Uid::from_raw(STRANGER)).expect("root may");
        act()
    };
    std::thread::scope(|scope| Some(scope.spawn(thread).join().expect("no panic")))
}

#[test]
fn another_user_registers_what_its_rule_lets_it_and_is_told_the_rule_otherwise() {
    let list = format!("[[client]]\nuid = {STRANGER}\nnames = ['guest.*']\naddresses = ['1002']\n");
    let node = TestNode::start_guarded(&list);
    let wants = |name: &str, address| Register {
        name: Some(name.to_owned()),
        address: AppAddress::fixed(address),
        ..Register::default()
    };
    let refused = |register: Register| {
        as_stranger(|| {
            let mut client = RawClient::connect(&node);
            client.ask_for_address(&register);
            client.expect_refusal()
        })
    };
    if let Some(why) = refused(wants("gait", 2)) {
        assert!(why.contains("'gait'") && why.contains("line 1") && why.contains("54321"), "{why}");
    }
    if let Some(why) = refused(wants("guest.1", 3)) {
        assert!(why.contains("1003") && why.contains("line 1"), "{why}");
    }
    if let Some((_client, tid)) = as_stranger(|| RawClient::register(&node, &wants("guest.1", 2))) {
        assert_eq!(Some(tid.app), AppAddress::fixed(2));
    }
    // The node's own user is as free as before.
    RawClient::register(&node, &wants("gait", 3));
}

#[test]
fn another_user_of_whom_no_rule_speaks_is_not_let_in() {
    let node = TestNode::start_guarded("[[client]]\nuid = 12345\n");
    let refusal = as_stranger(|| RawClient::connect(&node).expect_refusal());
    if let Some(why) = refusal {
        assert!(why.contains("54321") && why.contains("[[client]]"), "{why}");
    }
}

#[test]
fn another_user_who_comes_again_as_soon_as_he_is_refused_is_refused_once_a_millisecond() {
    const TIMES: u32 = SAVED_MAX + 200;
    let node = TestNode::start_guarded("[[client]]\nuid = 12345\n");
    let began = Instant::now();
    let came = as_stranger(|| (0..TIMES).for_each(|_| drop(RawClient::connect(&node).expect_refusal())));
    if came.is_some() {
        let took = began.elapsed();
        assert!(took >= REST * (TIMES - SAVED_MAX - 1), "{TIMES} were refused in {took:?}");
        // The node's own come in after it.
        RawClient::register(&node, &Register::default());
    }
}

#[test]
fn another_user_has_half_of_the_places_at_most() {
    let list = format!("[[client]]\nuid = {STRANGER}\n");
    let node = TestNode::start_guarded_with(&list, |config| config.lncl.clients_max = 4);
    let why = as_stranger(|| {
        let _two = [(); 2].map(|()| RawClient::register(&node, &Register::default()));
        let mut third = RawClient::connect(&node);
        third.ask_for_address(&Register::default());
        third.expect_refusal()
    });
    assert!(why.is_none_or(|why| why.contains("54321") && why.contains("`lncl.clients_max`")));
    // The node's own user is not bound so.
    (0..2).for_each(|_| drop(RawClient::register(&node, &Register::default())));
}

// spec: LNCL-8
#[test]
fn another_user_who_names_types_with_the_ids_of_the_robots_own_bars_none_of_these() {
    // These two have one id.
    let (own, theirs) = (Kind::named("liquid"), Kind::named("costarring"));
    assert_eq!(own, theirs);
    let node = TestNode::start_guarded(&format!("[[client]]\nuid = {STRANGER}\n"));
    let naming = |kind: &str| Register { kinds: vec![kind.to_owned()], ..Register::default() };
    // Given: another user was here first, and one of its applications has gone.
    let Some((guest, _)) = as_stranger(|| {
        drop(RawClient::register(&node, &naming("costarring")));
        RawClient::register(&node, &naming("costarring"))
    }) else {
        return;
    };
    // When, then: the robot's own is registered, and what it says counts.
    RawClient::register(&node, &naming("liquid"));
    assert_eq!(lock(&node.stores.registry).kind_name(theirs), Some("liquid"));
    drop(guest);
    RawClient::register(&node, &naming("liquid"));
}
