//! The audit: the location of every message in one node, in two, and in two with a faulty network between
//! them.

use std::sync::{Mutex, mpsc::sync_channel};

use sinew::{
    NodeApi, NodeHandle, Registration,
    audit::{Account, Audit, NodeAudit, Place},
    client::DirectLinks,
    message::Sender,
    prelude::*,
};
use sinew_testkit::{
    DEADLINE, Loopback, TestDirectory, all_run,
    scripted::{Job, Order, Script, Value, outcome_of_job, sender_app, wait},
    sees, until,
};

/// The message that blocks the application.
const HOLD: u64 = 1;
/// The message that it rejects.
const REFUSED: u64 = 99;
/// The message at which it panics.
const FATAL: u64 = 13;
/// Capacity of its mailbox for each class.
const MAILBOX: usize = 16;

/// The sum over all classes of the mailbox of the application called `name`.
fn mailbox(audit: &NodeAudit, wanted: &str) -> Account {
    let is_it = |place: &Place| matches!(place, Place::Mailbox { name, .. } if name == wanted);
    audit.entries.iter().filter(|entry| is_it(&entry.place)).map(|entry| entry.account).sum()
}

/// Checks that every queue of this node accounts for each of its messages.
#[track_caller]
fn balances(audit: &NodeAudit) {
    for entry in &audit.entries {
        assert_eq!(entry.account.unexplained(), 0, "{}: {:?}", entry.place, entry.account);
    }
}

/// Sends messages of every sort to the blocked application: 3 values, 1 that expires, 1 rejected, 1 fatal,
/// and jobs until nothing fits. Returns the number of jobs that were accepted.
fn send_every_sort(sender: &Sender, to: &str) -> u64 {
    for number in 2..5 {
        sender.send(to, &Value { number }).expect("it replaces the one before");
    }
    let late =
        sender.message(to, &Order { number: 5 }).confirmed(Duration::from_millis(1)).expect("it is taken");
    assert_eq!(wait(late), Outcome::Unknown, "no outcome arrived in its time");
    for number in [REFUSED, FATAL, 6] {
        sender.send(to, &Order { number }).expect("there is room");
    }
    (0..).take_while(|number| sender.send(to, &Job { number: 100 + number }).is_ok()).count() as u64
}

#[test]
fn every_outcome_in_a_node_is_counted() {
    // Given: an application that is blocked
    let ((go, gate), (holds, held)) = (sync_channel::<()>(1), sync_channel(1));
    let gate = Mutex::new(gate);
    let (sink, _log) = Script::new()
        .got(move |scripted, context| match scripted.number {
            HOLD => {
                holds.send(()).expect("the test waits");
                gate.lock().expect("one has it").recv().expect("the test lets it go");
            }
            REFUSED => context.reject(),
            FATAL => panic!("thirteen"),
            _ => {}
        })
        .app("sink");
    let (sender_app, key) = sender_app("sender");
    let loopback = Loopback::new();
    let node = loopback.node("one").configure(|config| config.mailbox_capacity = MAILBOX);
    let node = node.app(sink.progress_within(DEADLINE)).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    let (handle, sender) = (node.handle(), key.sender());
    sender.send("sink", &Order { number: HOLD }).expect("there is room");
    held.recv_timeout(DEADLINE).expect("waited for it to be held");
    // When: it is sent messages of every sort
    let jobs = send_every_sort(&sender, "sink");
    let nobody = Tid::new(node.address(), AppAddress::fixed(7).expect("a fixed one"));
    sender.send(nobody, &Job { number: 0 }).expect_err("nobody has this address");
    // Then: waiting messages are counted while they wait, and their outcomes when they have ended
    let audit = handle.audit_here();
    balances(&audit);
    let account = mailbox(&audit, "sink");
    assert_eq!(account.waiting, 1 + 1 + 3 + jobs, "held, value, orders, jobs: {account:?}");
    // The expired message was removed when there was no room.
    assert_eq!((account.expired, account.superseded, account.refused), (1, 2, 1), "{account:?}");
    assert_eq!(jobs, MAILBOX as u64);
    assert_eq!(audit.refused.get("not taken: NoSuchApplication"), Some(&1), "{:?}", audit.refused);
    go.send(()).expect("it waits");
    let audit = until("all has ended", || {
        let audit = handle.audit_here();
        balances(&audit);
        (mailbox(&audit, "sink").waiting == 0).then_some(audit)
    });
    let account = mailbox(&audit, "sink");
    assert_eq!((account.rejected, account.failed, account.expired), (1, 1, 1), "{account:?}");
    assert_eq!(account.delivered, 1 + 1 + 1 + jobs, "held, value, order, jobs: {account:?}");
    // And: the counters of a removed application are kept
    handle.stop_app("sink").expect("it is there");
    handle.remove_app("sink").expect("it has stopped");
    let audit = handle.audit_here();
    balances(&audit);
    assert_eq!(mailbox(&audit, "sink"), Account::default());
    assert_eq!(audit.account(&Place::OtherMailboxes).taken, account.taken);
}

#[test]
fn client_messages_are_counted_until_after_its_end() {
    let (directory, loopback) = (TestDirectory::new(), Loopback::new());
    let socket = directory.join("node.sock");
    let ((sink, _log), (sender_app, key)) = (Script::new().app("sink"), sender_app("sender"));
    let door = socket.clone();
    let node = loopback.node("one").configure(move |config| config.lncl.socket = Some(door));
    let node = node.app(sink).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    let (handle, sender) = (node.handle(), key.sender());
    // Given
    let api = NodeApi::connect(&socket).expect("the door is open");
    let mut far = api.register_transport_address(Registration::new().name("far")).expect("the name is free");
    // When
    for number in 0..7 {
        sender.send(far.tid(), &Job { number }).expect("there is room");
    }
    let sink = handle.resolve("sink").expect("it is registered");
    assert_eq!(
        far.message(sink, &Job { number: 7 }).confirmed(DEADLINE).expect("an outcome"),
        Outcome::Delivered
    );
    // Then: beside the 7 messages it was sent an outcome
    let audit = handle.audit_here();
    balances(&audit);
    let place = Place::Client { app: far.tid().app, name: "far".to_owned() };
    let account = audit.account(&place);
    assert_eq!((account.taken, account.own, account.delivered), (8, 1, 8), "{account:?}");
    // And
    far.unregister().expect("the node answers");
    let former = until("it has gone", || {
        let audit = handle.audit_here();
        balances(&audit);
        (audit.account(&place) == Account::default()).then(|| audit.account(&Place::OtherClients))
    });
    assert_eq!(former.delivered - former.own, 7, "{former:?}");
}

#[test]
fn messages_on_direct_links_stay_counted_after_their_end() {
    const MESSAGES: u64 = 20;
    // Given: two clients with a direct link
    let (directory, loopback) = (TestDirectory::new(), Loopback::new());
    let socket = directory.join("node.sock");
    let door = socket.clone();
    let node = loopback.node("one").configure(move |config| config.lncl.socket = Some(door));
    let node = node.start().expect("a node");
    let api = NodeApi::connect(&socket).expect("the door is open");
    let register = |name: &str| {
        let registration = Registration::new().direct(DirectLinks::Always).name(name);
        api.register_transport_address(registration).expect("the name is free")
    };
    let (mut hip, mut knee) = (register("hip"), register("knee"));
    let link = Place::DirectLink {
        from: hip.tid().app,
        from_name: "hip".to_owned(),
        to: knee.tid().app,
        to_name: "knee".to_owned(),
    };
    let of_link = || {
        let audit = node.handle().audit_here();
        balances(&audit);
        audit.account(&link)
    };
    let mut number = 0;
    until("a message goes by the link", || {
        number += 1;
        hip.send(knee.tid(), &Job { number }).expect("there is room");
        drop(knee.receive(DEADLINE).expect("the node lives").expect("the message"));
        drop(hip.receive(Duration::ZERO).expect("the node lives"));
        (of_link().taken > 0).then_some(())
    });
    // When
    let before = of_link();
    for number in 0..MESSAGES {
        hip.send(knee.tid(), &Job { number }).expect("there is room");
    }
    // Then
    let sent = of_link();
    assert_eq!((sent.taken - before.taken, sent.waiting), (MESSAGES, MESSAGES), "{sent:?}");
    // When: half of them are read, and the sender ends
    for _ in 0..MESSAGES / 2 {
        drop(knee.receive(DEADLINE).expect("the node lives").expect("a message"));
    }
    drop(hip);
    // Then: what was sent is still known, and all of it arrives
    let former = until("it has gone, and its messages are read", || {
        drop(knee.receive(Duration::from_millis(1)).expect("the node lives"));
        let audit = node.handle().audit_here();
        balances(&audit);
        let others = audit.account(&Place::OtherDirectLinks);
        (others.taken == sent.taken && others.unknown == 0).then_some(others)
    });
    assert_eq!(former.delivered, sent.taken, "{former:?}");
}

/// Returns the audit of the system of these `nodes` once no message waits or is in flight. At every moment
/// before, no message is unexplained.
fn once_quiet(nodes: [&NodeHandle; 2]) -> Audit {
    // Each node is asked directly, since a node answers another one at most 16 times a second.
    until("nothing waits or is under way", || {
        nodes
            .map(NodeHandle::audit_here)
            .iter()
            .flat_map(|node| &node.entries)
            .all(|entry| {
                let account = entry.account;
                assert_eq!(account.unexplained(), 0, "{}: {account:?}", entry.place);
                account.waiting + account.unacknowledged == 0
            })
            .then_some(())
    });
    let audit = nodes[0].audit(DEADLINE).expect("it runs, and few ask");
    assert_eq!(audit.missing(), 0, "{audit}");
    audit
}

#[test]
fn audit_of_two_nodes_explains_every_message() {
    // Given: two nodes, and messages of every class from one to the other
    const JOBS: u64 = 300;
    let loopback = Loopback::new();
    let (sink, _log) = Script::new().app("sink");
    let (sender_app, key) = sender_app("sender");
    let there = loopback.node("there").app(sink).start().expect("a node");
    let here = loopback.node("home").app(sender_app).start().expect("a node");
    all_run(&[&there, &here]);
    let (handle, sender) = (here.handle(), key.sender());
    sees(&handle, there.address());
    until("the name is known", || sender.resolve("sink"));
    for number in 0..JOBS {
        sender.send("sink", &Job { number }).expect("there is room");
        sender.send("sink", &Value { number }).expect("it replaces the one before");
        if number % 100 == 0 {
            // While they flow, too.
            let audit = handle.audit(DEADLINE).expect("it runs, and few ask");
            assert_eq!((audit.missing(), audit.nodes.len()), (0, 2), "{audit}");
        }
    }
    assert_eq!(outcome_of_job(&sender, "sink", JOBS), Outcome::Delivered);
    let nobody = Tid::new(there.address(), AppAddress::fixed(7).expect("a fixed one"));
    sender.send(nobody, &Job { number: 0 }).expect("its node is there");
    // When
    let audit = once_quiet([&handle, &there.handle()]);
    // Then: each message of the sender is accounted for at its destination, and both ends of every link
    // agree
    assert_eq!((audit.silent.len(), audit.nodes.len(), audit.links.len()), (0, 2, 6), "{audit}");
    for link in &audit.links {
        let taken = link.taken.unwrap_or_else(|| panic!("both speak of one session: {audit}"));
        // The audit's own request and reply may lie between the readings.
        assert!(link.sent.abs_diff(taken) <= 1, "{link}\n{audit}");
    }
    let there = audit.nodes.iter().find(|node| node.name == "there").expect("it answered");
    let of = |class| {
        let is_it = |place: &Place| matches!(place, Place::Mailbox { name, class: its, .. } if name == "sink" && *its == class);
        there
            .entries
            .iter()
            .find(|entry| is_it(&entry.place))
            .map(|entry| entry.account)
            .expect("it got some")
    };
    assert_eq!((of(Class::Bulk).taken, of(Class::Bulk).delivered), (JOBS + 1, JOBS + 1), "{audit}");
    let (values, on_the_way) = (of(Class::Stream), to(&audit, &handle, there.node, Class::Stream));
    // Values by the connection may arrive after values by datagram.
    let arrived = there.account(&Place::FromNode { node: here.address(), class: Some(Class::Stream) });
    let superseded = values.superseded + on_the_way.superseded + arrived.superseded;
    assert_eq!(values.delivered + superseded, JOBS, "{audit}");
    assert_eq!(there.refused.get("not taken: NoSuchApplication"), Some(&1), "{audit}");
    let json = serde_json::to_string(&audit).expect("every field can be written");
    assert_eq!(serde_json::from_str::<Audit>(&json).expect("and read"), audit);
    assert!(audit.to_string().contains("every message is explained"), "{audit}");
}

/// A node's account of the messages that it has sent to another one.
fn to(audit: &Audit, from: &NodeHandle, to: NodeAddress, class: Class) -> Account {
    let from = audit.nodes.iter().find(|node| node.node == from.address()).expect("it asked");
    from.account(&Place::ToNode { node: to, class: Some(class) })
}
