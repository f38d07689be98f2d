//! Who of this host may register what, and what its processes may send.

use std::{
    collections::VecDeque,
    io::Write as _,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    router::{LocalRoute, Outlet, Refused},
    tid::{AppAddress, Tid},
    wire::{Flags, Kind, Message},
};

use super::{Angle, confirmed, named, outcome_of};
use crate::{
    accept_pace::{IN_A_ROW_MAX, REST},
    client::{NodeApi, Registration},
    lncl::{
        AppFact, OF_USER_AT_SYNC,
        guests::{EACH, SAVED_MAX},
        payload::{self, Group, Register, Switch},
        registrar,
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
        let mut send = || asker.message(to, &Angle { degrees: 1.0 }).confirmed(WATCHDOG).unwrap();
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
        // Past what keeps the words of a test that passes: nobody shall take this for one that was made.
        let test = std::thread::current().name().unwrap_or("a test").to_owned();
        let told = format!("\nUNTESTED: {test}: only root can act as another user\n");
        std::io::stderr().write_all(told.as_bytes()).expect("standard error is open");
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
fn another_user_who_comes_again_as_soon_as_he_is_refused_is_refused_four_times_a_millisecond() {
    const ROWS: u32 = 50;
    let node = TestNode::start_guarded("[[client]]\nuid = 12345\n");
    let began = Instant::now();
    let came = as_stranger(|| {
        (0..ROWS * IN_A_ROW_MAX).for_each(|_| drop(RawClient::connect(&node).expect_refusal()));
    });
    if came.is_some() {
        let took = began.elapsed();
        assert!(took >= REST * (ROWS - 1), "{ROWS} rows were refused in {took:?}");
        // The node's own come in after it.
        RawClient::register(&node, &Register::default());
    }
}

// spec: LNCL-13
#[test]
fn another_user_who_registers_and_leaves_without_end_comes_in_at_the_pace_and_keeps_nobody_out() {
    const TIMES: u32 = 3 * SAVED_MAX;
    let node = TestNode::start_guarded(&format!("[[client]]\nuid = {STRANGER}\n"));
    let began = Instant::now();
    let came_in = as_stranger(|| {
        let comes_in = || {
            let mut client = RawClient::connect(&node);
            client.ask_for_address(&Register::default());
            client.next().expect("an answer").header.kind == Kind::LNCL_REGISTERED
        };
        (0..TIMES).map(|_| u32::from(comes_in())).sum::<u32>()
    });
    let Some(came_in) = came_in else { return };
    let saved_up = u32::try_from(began.elapsed().as_nanos() / EACH.as_nanos()).unwrap();
    assert!((SAVED_MAX..=SAVED_MAX + saved_up + 1).contains(&came_in), "{came_in} of {TIMES}");
    assert_eq!(node.refused("too many connections of a guest"), u64::from(TIMES - came_in));
    // It has no pace that others have, too.
    (0..4).for_each(|_| drop(RawClient::register(&node, &Register::default())));
}

// spec: LNCL-13
#[test]
fn what_another_user_sends_is_read_at_a_pace_so_that_none_of_the_robots_own_waits_behind_it() {
    const SENT: u64 = 200;
    let list = format!("[[client]]\nuid = {STRANGER}\n[[rule]]\nfrom = ['*']\nto = ['*']\n");
    let node = TestNode::start_guarded_with(&list, |config| config.lncl.guest_frames_per_s = 100);
    let (app, (mut own, own_tid)) = (node.local(1), RawClient::register(&node, &Register::default()));
    // Given: a guest that has sent what takes four seconds at that pace
    let guest = as_stranger(|| {
        let (mut guest, tid) = RawClient::register(&node, &Register::default());
        (0..SENT).for_each(|number| guest.send(&confirmed(tid, app.tid, number)));
        guest
    });
    let Some(_guest) = guest else { return };
    // When
    own.send(&confirmed(own_tid, app.tid, 0));
    // Then: it comes before most of these, and they all come in their order
    let (mut before, mut of_guest) = (None, 0);
    while of_guest < SENT {
        let message = app.next();
        if message.header.source == own_tid {
            before = Some(of_guest);
        } else {
            assert_eq!(message.header.correlation, of_guest);
            of_guest += 1;
        }
    }
    assert!(before.is_some_and(|before| before < 60), "{before:?} of {SENT}");
    assert!(node.refused("guest too fast") > 0);
}

// spec: LNCL-13
#[test]
fn another_user_has_a_quarter_of_the_places_at_most() {
    let list = format!("[[client]]\nuid = {STRANGER}\n");
    let node = TestNode::start_guarded_with(&list, |config| config.lncl.clients_max = 8);
    let why = as_stranger(|| {
        let _two = [(); 2].map(|()| RawClient::register(&node, &Register::default()));
        let mut third = RawClient::connect(&node);
        third.ask_for_address(&Register::default());
        third.expect_refusal()
    });
    if let Some(why) = why {
        assert!(why.contains("54321") && why.contains("a quarter of `lncl.clients_max`"), "{why}");
        assert_eq!(node.refused("registration"), 1);
    }
    // The node's own user is not bound so.
    let _own = [(); 4].map(|()| RawClient::register(&node, &Register::default()));
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

/// Asks to be in this group, or not any more, and returns what became of that.
fn asks(client: &mut RawClient, tid: Tid, group: AppAddress, member: bool) -> Outcome {
    let mut asked =
        payload::frame(Kind::LNCL_GROUP, tid, payload::lncl_of(tid.node), &Group { group, member });
    asked.header.flags = Flags::CONFIRM;
    asked.header.correlation = 5;
    client.send(&asked);
    outcome_of(&client.next().unwrap()).1
}

#[test]
fn a_group_beyond_a_clients_bound_and_what_is_no_group_are_refused_counted_and_told_in_words() {
    // Given: a client in as many groups as one may be in
    let node = TestNode::start();
    let (mut client, tid) = RawClient::register(&node, &named("gait"));
    let group = |number: u32| AppAddress::new(0xf000_0000 + number);
    (0..256).for_each(|number| {
        assert_eq!(asks(&mut client, tid, group(number), true), Outcome::Delivered);
    });
    assert_eq!(node.refused("membership"), 0);
    // When, then
    assert_eq!(asks(&mut client, tid, group(256), true), Outcome::Rejected(Rejection::QueueFull));
    assert_eq!(node.refused("membership"), 1);
    let told = node.stores.refusals.told();
    let words = &told.iter().find(|told| told.cause == "membership").expect("it is counted").detail;
    for word in ["gait", "256 groups", &group(256).to_string(), "leave one"] {
        assert!(words.contains(word), "{words}");
    }
    assert_eq!(asks(&mut client, tid, AppAddress::LNCL, true), Outcome::Rejected(Rejection::Unsupported));
    assert_eq!((node.refused("membership"), node.stores.router.memberships()), (2, 256));
}

#[test]
fn a_client_whose_address_was_taken_back_joins_nothing() {
    // Given: a client of a life of LNCL that hung, from which a later one has taken its address back
    let node = TestNode::start();
    let (mut client, tid) = RawClient::register(&node, &named("gait"));
    registrar::forget_former_clients(&node.stores);
    // When, then
    let refused = Outcome::Rejected(Rejection::NoSuchApplication);
    let group = AppAddress::group("telemetry");
    assert_eq!(asks(&mut client, tid, group, true), refused);
    assert_eq!(asks(&mut client, tid, group, false), refused);
    assert_eq!((node.stores.router.memberships(), node.refused("membership")), (0, 1));
}

#[test]
fn another_user_joins_the_groups_of_its_rule_and_stays_in_them_when_the_list_is_read_again() {
    // Given
    let list = format!("[[client]]\nuid = {STRANGER}\ngroups = ['telemetry']\n");
    let node = TestNode::start_guarded(&list);
    let [telemetry, stop] = ["telemetry", "stop"].map(AppAddress::group);
    let refused = Outcome::Rejected(Rejection::NotAllowed);
    let Some((mut guest, tid)) = as_stranger(|| RawClient::register(&node, &Register::default())) else {
        return;
    };
    // When, then: it joins what it may, and is told what it may not, in words in the log
    assert_eq!(asks(&mut guest, tid, stop, true), refused);
    assert_eq!(asks(&mut guest, tid, telemetry, true), Outcome::Delivered);
    assert_eq!((node.refused("membership"), node.stores.router.groups()), (1, vec![telemetry]));
    let told = node.stores.refusals.told();
    let words = &told.iter().find(|told| told.cause == "membership").expect("it is counted").detail;
    for word in ["line 1 ", "`groups`", &STRANGER.to_string(), &stop.to_string()] {
        assert!(words.contains(word), "{words}");
    }
    // And: another list counts for what is joined from then on
    let access = node.stores.access.get().expect("it has a list");
    access.replace_in_test(&list.replace("telemetry", "stop"));
    assert!(node.stores.router.is_member(telemetry, tid.app));
    assert_eq!(asks(&mut guest, tid, telemetry, true), Outcome::Delivered, "it is in it already");
    assert_eq!(asks(&mut guest, tid, stop, true), Outcome::Delivered);
    assert_eq!(asks(&mut guest, tid, telemetry, false), Outcome::Delivered);
    assert_eq!(asks(&mut guest, tid, telemetry, true), refused);
    // The node's own user joins what it likes.
    let (mut own, tid) = RawClient::register(&node, &Register::default());
    assert_eq!(asks(&mut own, tid, telemetry, true), Outcome::Delivered);
}

#[test]
fn another_user_has_a_share_of_memberships_with_all_its_connections() {
    let node = TestNode::start_guarded(&format!("[[client]]\nuid = {STRANGER}\ngroups = ['*']\n"));
    let register = || [(); 3].map(|()| RawClient::register(&node, &Register::default()));
    let Some([first, second, mut third]) = as_stranger(register) else { return };
    let group = |number: u32| AppAddress::new(0xf000_0000 + number);
    let mut both = [first, second];
    for (client, tid) in &mut both {
        (0..256).for_each(|number| assert_eq!(asks(client, *tid, group(number), true), Outcome::Delivered));
    }
    let full = Outcome::Rejected(Rejection::QueueFull);
    assert_eq!(asks(&mut third.0, third.1, group(0), true), full);
    let [(client, tid), _] = &mut both;
    assert_eq!(asks(client, *tid, group(7), false), Outcome::Delivered);
    assert_eq!(asks(&mut third.0, third.1, group(0), true), Outcome::Delivered);
    assert_eq!(asks(&mut third.0, third.1, group(1), true), full);
    // The node's own user has no such share.
    let (mut own, tid) = RawClient::register(&node, &Register::default());
    assert_eq!(asks(&mut own, tid, group(0), true), Outcome::Delivered);
}

/// A sync manager that reads when the test does.
#[derive(Default)]
struct Slow(Mutex<VecDeque<Message>>);

impl Outlet for Slow {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        lock(&self.0).push_back(message);
        Ok(())
    }
}

#[test]
fn another_user_has_a_share_of_what_waits_for_the_sync_manager_and_the_nodes_own_has_all_of_it() {
    const SHARE: u64 = OF_USER_AT_SYNC as u64;
    let node = TestNode::start_guarded(&format!("[[client]]\nuid = {STRANGER}\n"));
    let slow = Arc::new(Slow::default());
    let route = LocalRoute { outlet: slow.clone(), events: Arc::new([]) };
    node.stores.router.set_local(AppAddress::SYNC, route);
    let sync = Tid::new(node.address(), AppAddress::SYNC);
    let Some((mut guest, tid)) = as_stranger(|| RawClient::register(&node, &Register::default())) else {
        return;
    };
    // When, then: one too many is refused, and what becomes of the others it hears when they are read
    (1..=SHARE + 1).for_each(|correlation| guest.send(&confirmed(tid, sync, correlation)));
    let full = Outcome::Rejected(Rejection::QueueFull);
    assert_eq!(outcome_of(&guest.next().unwrap()), (SHARE + 1, full));
    let first = lock(&slow.0).pop_front();
    first.expect("it waits").settle(Outcome::Delivered);
    assert_eq!(outcome_of(&guest.next().unwrap()), (1, Outcome::Delivered));
    // And: there is room for one again
    (SHARE + 2..=SHARE + 3).for_each(|correlation| guest.send(&confirmed(tid, sync, correlation)));
    assert_eq!(outcome_of(&guest.next().unwrap()), (SHARE + 3, full));
    assert_eq!(lock(&slow.0).len() as u64, SHARE);
    // And: the node's own user has no such share. Of its messages the last one is the first that ends.
    let (mut own, tid) = RawClient::register(&node, &Register::default());
    (1..=2 * SHARE).for_each(|correlation| own.send(&confirmed(tid, sync, correlation)));
    let nobody = Tid::new(node.address(), AppAddress::fixed(9).unwrap());
    own.send(&confirmed(tid, nobody, 0));
    let none = Outcome::Rejected(Rejection::NoSuchApplication);
    assert_eq!(outcome_of(&own.next().unwrap()), (0, none));
    assert_eq!(lock(&slow.0).len() as u64, 3 * SHARE);
}
