//! Access of other users of this host: allowed registrations, and allowed messages of their processes.

use std::{
    collections::VecDeque,
    io::Write as _,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use sinew_client::{DirectLinks, NodeApi, Registration};
use sinew_model::{
    accept_limiter::{IN_A_ROW_MAX, PAUSE},
    facts::AppFact,
    guest_quotas::OF_USER_AT_SYNC,
};
use sinew_protocol::payload::{self, Group, Register, Switch};
use sinew_runtime::{
    lock,
    outcome::{Outcome, Rejection},
    router::{LocalRoute, MessageSink, SubmitError},
    tid::{AppAddress, Tid},
    wire::{Flags, Kind, Message},
};

use super::{Angle, confirmed, named, outcome_of};
use crate::{
    guest_connections::{BURST_MAX, EACH},
    registrar,
    testing::{RawClient, TestNode, WATCHDOG},
};

#[test]
fn messages_of_a_client_are_checked_like_remote_ones() {
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
fn messages_of_two_processes_stay_under_the_access_list() {
    // Given: two clients that both request a direct link, and a list that allows all their messages
    let node = TestNode::start_guarded("[[rule]]\nfrom = ['*']\nto = ['*']\n");
    let api = NodeApi::connect(node.path()).unwrap();
    let registration = Registration::new().direct(DirectLinks::Always).deadline(WATCHDOG);
    let register = || api.register_transport_address(registration.clone()).unwrap();
    let (mut taker, mut requester) = (register(), register());
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
        let mut send = || requester.message(to, &Angle { degrees: 1.0 }).confirmed(WATCHDOG).unwrap();
        // When: they have sent enough messages for an introduction
        let outcomes: Vec<_> = (0..ENOUGH).map(|_| send()).collect();
        // Then: another list counts for their next message
        node.state.security.access.get().expect("it has a list").replace_in_test("");
        let after = send();
        is_over.store(true, Ordering::Relaxed);
        assert_eq!(outcomes, vec![Outcome::Delivered; ENOUGH]);
        assert_eq!(after, Outcome::Rejected(Rejection::NotAllowed));
    });
}

#[test]
fn callable_address_is_not_reassigned_to_another_name() {
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
fn direct_links_are_unsupported_with_an_access_list() {
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

/// Number of messages after which two permitted clients are introduced.
const ENOUGH: usize = 200;

/// A user that is neither root nor the node's, and a group of that number; no account needs to have it.
const OTHER_USER: u32 = 54_321;

/// Runs this as that user; `None` if this test lacks the permission.
fn as_other_user<T: Send>(act: impl FnOnce() -> T + Send) -> Option<T> {
    if !rustix::process::geteuid().is_root() {
        // Written past the capture of a passing test's output, so the test is not mistaken for one that ran.
        let test = std::thread::current().name().unwrap_or("a test").to_owned();
        let text = format!("\nUNTESTED: {test}: only root can act as another user\n");
        std::io::stderr().write_all(text.as_bytes()).expect("standard error is open");
        return None;
    }
    // Only this one thread changes its user.
    let thread = || {
        rustix::thread::set_thread_gid(rustix::process::Gid::from_raw(OTHER_USER)).expect("root may");
        rustix::thread::set_thread_uid(rustix::process::Uid::from_raw(OTHER_USER)).expect("root may");
        act()
    };
    std::thread::scope(|scope| Some(scope.spawn(thread).join().expect("no panic")))
}

#[test]
fn other_user_registers_by_its_rule() {
    let list = format!("[[client]]\nuid = {OTHER_USER}\nnames = ['guest.*']\naddresses = ['1002']\n");
    let node = TestNode::start_guarded(&list);
    let wants = |name: &str, address| Register {
        name: Some(name.to_owned()),
        address: AppAddress::fixed(address),
        ..Register::default()
    };
    let refused = |register: Register| {
        as_other_user(|| {
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
    if let Some((_client, tid)) = as_other_user(|| RawClient::register(&node, &wants("guest.1", 2))) {
        assert_eq!(Some(tid.app), AppAddress::fixed(2));
    }
    // The node's own user is not restricted.
    RawClient::register(&node, &wants("gait", 3));
}

#[test]
fn other_user_without_a_rule_is_not_admitted() {
    let node = TestNode::start_guarded("[[client]]\nuid = 12345\n");
    let refusal = as_other_user(|| RawClient::connect(&node).expect_refusal());
    if let Some(why) = refusal {
        assert!(why.contains("54321") && why.contains("[[client]]"), "{why}");
    }
}

#[test]
fn refused_reconnects_of_another_user_are_limited() {
    const ROWS: u32 = 50;
    let node = TestNode::start_guarded("[[client]]\nuid = 12345\n");
    let started = Instant::now();
    let done = as_other_user(|| {
        (0..ROWS * IN_A_ROW_MAX).for_each(|_| drop(RawClient::connect(&node).expect_refusal()));
    });
    if done.is_some() {
        let took = started.elapsed();
        assert!(took >= PAUSE * (ROWS - 1), "{ROWS} rows were refused in {took:?}");
        // The node's own clients are admitted after it.
        RawClient::register(&node, &Register::default());
    }
}

// spec: LNCL-13
#[test]
fn registrations_of_another_user_are_paced() {
    const TIMES: u32 = 3 * BURST_MAX;
    let node = TestNode::start_guarded(&format!("[[client]]\nuid = {OTHER_USER}\n"));
    let started = Instant::now();
    let admitted = as_other_user(|| {
        let is_admitted = || {
            let mut client = RawClient::connect(&node);
            client.ask_for_address(&Register::default());
            client.next().expect("an answer").header.kind == Kind::LNCL_REGISTERED
        };
        (0..TIMES).map(|_| u32::from(is_admitted())).sum::<u32>()
    });
    let Some(admitted) = admitted else { return };
    let saved_up = u32::try_from(started.elapsed().as_nanos() / EACH.as_nanos()).unwrap();
    assert!((BURST_MAX..=BURST_MAX + saved_up + 1).contains(&admitted), "{admitted} of {TIMES}");
    assert_eq!(node.refused("too many connections of a guest"), u64::from(TIMES - admitted));
    // The node's own user has no common pace with others.
    (0..4).for_each(|_| drop(RawClient::register(&node, &Register::default())));
}

// spec: LNCL-13
#[test]
fn messages_of_another_user_are_paced() {
    const SENT: u64 = 200;
    let list = format!("[[client]]\nuid = {OTHER_USER}\n[[rule]]\nfrom = ['*']\nto = ['*']\n");
    let node = TestNode::start_guarded_with(&list, |config| config.lncl.guest_frames_per_s = 100);
    let (app, (mut own, own_tid)) = (node.local(1), RawClient::register(&node, &Register::default()));
    // Given: a guest that has sent as much as takes four seconds at that pace
    let guest = as_other_user(|| {
        let (mut guest, tid) = RawClient::register(&node, &Register::default());
        (0..SENT).for_each(|number| guest.send(&confirmed(tid, app.tid, number)));
        guest
    });
    let Some(_guest) = guest else { return };
    // When
    own.send(&confirmed(own_tid, app.tid, 0));
    // Then: the own message is delivered before most of these, and they are all delivered in their order
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
fn other_user_has_at_most_a_quarter_of_slots() {
    let list = format!("[[client]]\nuid = {OTHER_USER}\n");
    let node = TestNode::start_guarded_with(&list, |config| config.lncl.clients_max = 8);
    let why = as_other_user(|| {
        let _two = [(); 2].map(|()| RawClient::register(&node, &Register::default()));
        let mut third = RawClient::connect(&node);
        third.ask_for_address(&Register::default());
        third.expect_refusal()
    });
    if let Some(why) = why {
        assert!(why.contains("54321") && why.contains("a quarter of `lncl.clients_max`"), "{why}");
        assert_eq!(node.refused("registration"), 1);
    }
    // The node's own user does not have this limit.
    let _own = [(); 4].map(|()| RawClient::register(&node, &Register::default()));
}

// spec: LNCL-13
#[test]
fn values_of_guests_are_not_retained() {
    let list = format!("[[client]]\nuid = {OTHER_USER}\n[[rule]]\nfrom = ['*']\nto = ['*']\n");
    let node = TestNode::start_guarded(&list);
    let member = node.local(1);
    assert!(node.router().set_member(AppAddress::group("modes"), member.tid.app, true));
    let value = |tid: Tid| {
        let mut message = Message::typed(tid, Tid::group("modes"), &Angle { degrees: 1.0 });
        message.header.flags = Flags::KEEP;
        message
    };
    // Given: one of the robot's own, with a retained value
    let (mut own, tid) = RawClient::register(&node, &named("gait"));
    own.send(&value(tid));
    assert_eq!(member.next().header.flags, Flags::KEEP);
    assert_eq!(node.router().retained().values, 1);
    // When: a guest sends a removal, and a value
    let guest = as_other_user(|| {
        let (mut guest, tid) = RawClient::register(&node, &Register::default());
        let Message { header, .. } = value(tid);
        guest.send(&Message::new(header, Vec::<u8>::new().into()));
        guest.send(&value(tid));
        guest
    });
    let Some(_guest) = guest else { return };
    // Then: its value is delivered, the removal is not, and neither takes room
    let received = member.next();
    assert_eq!((received.header.flags, received.payload.is_empty()), (Flags::NONE, false));
    assert_eq!(node.router().retained().values, 1);
}

// spec: LNCL-8
#[test]
fn guest_types_with_own_ids_bar_no_own_application() {
    // These two have one id.
    let (own, theirs) = (Kind::named("liquid"), Kind::named("costarring"));
    assert_eq!(own, theirs);
    let node = TestNode::start_guarded(&format!("[[client]]\nuid = {OTHER_USER}\n"));
    let naming = |kind: &str| Register { kinds: vec![kind.to_owned()], ..Register::default() };
    // Given: another user has registered first, and one of its applications has ended.
    let Some((guest, _)) = as_other_user(|| {
        drop(RawClient::register(&node, &naming("costarring")));
        RawClient::register(&node, &naming("costarring"))
    }) else {
        return;
    };
    // When, then: the robot's own application is registered, and its type name counts.
    RawClient::register(&node, &naming("liquid"));
    assert_eq!(lock(&node.state.registry).kind_name(theirs), Some("liquid"));
    drop(guest);
    RawClient::register(&node, &naming("liquid"));
}

/// Joins or leaves this group. Returns the outcome.
fn request_group(client: &mut RawClient, tid: Tid, group: AppAddress, member: bool) -> Outcome {
    let mut asked =
        payload::frame(Kind::LNCL_GROUP, tid, payload::lncl_of(tid.node), &Group { group, member });
    asked.header.flags = Flags::CONFIRM;
    asked.header.correlation = 5;
    client.send(&asked);
    outcome_of(&client.next().unwrap()).1
}

#[test]
fn excess_or_invalid_group_is_refused_counted_and_explained() {
    // Given: a client in the maximum number of groups
    let node = TestNode::start();
    let (mut client, tid) = RawClient::register(&node, &named("gait"));
    let group = |number: u32| AppAddress::new(0xf000_0000 + number);
    (0..256).for_each(|number| {
        assert_eq!(request_group(&mut client, tid, group(number), true), Outcome::Delivered);
    });
    assert_eq!(node.refused("membership"), 0);
    // When, then
    assert_eq!(request_group(&mut client, tid, group(256), true), Outcome::Rejected(Rejection::QueueFull));
    assert_eq!(node.refused("membership"), 1);
    let logged = node.state.ctx.refusals.reports();
    let words = &logged.iter().find(|refusal| refusal.cause == "membership").expect("it is counted").detail;
    for word in ["gait", "256 groups", &group(256).to_string(), "leave one"] {
        assert!(words.contains(word), "{words}");
    }
    assert_eq!(
        request_group(&mut client, tid, AppAddress::LNCL, true),
        Outcome::Rejected(Rejection::Unsupported)
    );
    assert_eq!((node.refused("membership"), node.state.ctx.router.memberships()), (2, 256));
}

#[test]
fn client_with_a_revoked_address_joins_nothing() {
    // Given: a client of a hung instance of LNCL, from which a later one has taken its address back
    let node = TestNode::start();
    let (mut client, tid) = RawClient::register(&node, &named("gait"));
    registrar::remove_former_clients(&node.state);
    // When, then
    let refused = Outcome::Rejected(Rejection::NoSuchApplication);
    let group = AppAddress::group("telemetry");
    assert_eq!(request_group(&mut client, tid, group, true), refused);
    assert_eq!(request_group(&mut client, tid, group, false), refused);
    assert_eq!((node.state.ctx.router.memberships(), node.refused("membership")), (0, 1));
}

#[test]
fn other_user_joins_the_groups_of_its_rule() {
    // Given
    let list = format!("[[client]]\nuid = {OTHER_USER}\ngroups = ['telemetry']\n");
    let node = TestNode::start_guarded(&list);
    let [telemetry, stop] = ["telemetry", "stop"].map(AppAddress::group);
    let refused = Outcome::Rejected(Rejection::NotAllowed);
    let Some((mut guest, tid)) = as_other_user(|| RawClient::register(&node, &Register::default())) else {
        return;
    };
    // When, then: it joins the allowed group, and the refusal of the other one is explained in the log
    assert_eq!(request_group(&mut guest, tid, stop, true), refused);
    assert_eq!(request_group(&mut guest, tid, telemetry, true), Outcome::Delivered);
    assert_eq!((node.refused("membership"), node.state.ctx.router.groups()), (1, vec![telemetry]));
    let logged = node.state.ctx.refusals.reports();
    let words = &logged.iter().find(|refusal| refusal.cause == "membership").expect("it is counted").detail;
    for word in ["line 1 ", "`groups`", &OTHER_USER.to_string(), &stop.to_string()] {
        assert!(words.contains(word), "{words}");
    }
    // And: another list counts for later joins
    let access = node.state.security.access.get().expect("it has a list");
    access.replace_in_test(&list.replace("telemetry", "stop"));
    assert!(node.state.ctx.router.is_member(telemetry, tid.app));
    assert_eq!(request_group(&mut guest, tid, telemetry, true), Outcome::Delivered, "it is in it already");
    assert_eq!(request_group(&mut guest, tid, stop, true), Outcome::Delivered);
    assert_eq!(request_group(&mut guest, tid, telemetry, false), Outcome::Delivered);
    assert_eq!(request_group(&mut guest, tid, telemetry, true), refused);
    // The node's own user may join any group.
    let (mut own, tid) = RawClient::register(&node, &Register::default());
    assert_eq!(request_group(&mut own, tid, telemetry, true), Outcome::Delivered);
}

#[test]
fn other_user_has_one_share_of_memberships() {
    let node = TestNode::start_guarded(&format!("[[client]]\nuid = {OTHER_USER}\ngroups = ['*']\n"));
    let register = || [(); 3].map(|()| RawClient::register(&node, &Register::default()));
    let Some([first, second, mut third]) = as_other_user(register) else { return };
    let group = |number: u32| AppAddress::new(0xf000_0000 + number);
    let mut both = [first, second];
    for (client, tid) in &mut both {
        (0..256).for_each(|number| {
            assert_eq!(request_group(client, *tid, group(number), true), Outcome::Delivered)
        });
    }
    let full = Outcome::Rejected(Rejection::QueueFull);
    assert_eq!(request_group(&mut third.0, third.1, group(0), true), full);
    let [(client, tid), _] = &mut both;
    assert_eq!(request_group(client, *tid, group(7), false), Outcome::Delivered);
    assert_eq!(request_group(&mut third.0, third.1, group(0), true), Outcome::Delivered);
    assert_eq!(request_group(&mut third.0, third.1, group(1), true), full);
    // The node's own user has no such share.
    let (mut own, tid) = RawClient::register(&node, &Register::default());
    assert_eq!(request_group(&mut own, tid, group(0), true), Outcome::Delivered);
}

/// A sync manager that reads on the test's request.
#[derive(Default)]
struct Slow(Mutex<VecDeque<Message>>);

impl MessageSink for Slow {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        lock(&self.0).push_back(message);
        Ok(())
    }
}

#[test]
fn other_user_has_a_share_at_the_sync_manager() {
    const SHARE: u64 = OF_USER_AT_SYNC as u64;
    let node = TestNode::start_guarded(&format!("[[client]]\nuid = {OTHER_USER}\n"));
    let slow = Arc::new(Slow::default());
    let route = LocalRoute { sink: slow.clone(), events: Arc::new([]) };
    node.state.ctx.router.set_local(AppAddress::SYNC, route);
    let sync = Tid::new(node.address(), AppAddress::SYNC);
    let Some((mut guest, tid)) = as_other_user(|| RawClient::register(&node, &Register::default())) else {
        return;
    };
    // When, then: one too many is refused, and the outcomes of the others arrive when they are read
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
    let absent = Tid::new(node.address(), AppAddress::fixed(9).unwrap());
    own.send(&confirmed(tid, absent, 0));
    let none = Outcome::Rejected(Rejection::NoSuchApplication);
    assert_eq!(outcome_of(&own.next().unwrap()), (0, none));
    assert_eq!(lock(&slow.0).len() as u64, 3 * SHARE);
}
