//! Where is every message? What the audit says of a node, of two, and of two with a faulty network between them.

use std::sync::{Mutex, mpsc::sync_channel};

use sinew::{
    NodeApi, NodeHandle, Registration,
    audit::{Account, Audit, NodeAudit, Place},
    message::Sender,
    prelude::*,
};
use sinew_tests::{
    DEADLINE, Ground, OwnDirectory, all_run,
    puppet::{Job, Order, Stage, Value, desk, outcome_of_job, wait},
    sees, until,
};

/// What holds the application up.
const HOLD: u64 = 1;
/// What it refuses.
const REFUSED: u64 = 99;
/// What it panics at.
const FATAL: u64 = 13;
/// Messages of a class that wait for it at most.
const MAILBOX: usize = 16;

/// Of all classes of the mailbox of the application called `name`.
fn mailbox(audit: &NodeAudit, wanted: &str) -> Account {
    let is_it = |place: &Place| matches!(place, Place::Mailbox { name, .. } if name == wanted);
    audit.entries.iter().filter(|entry| is_it(&entry.place)).map(|entry| entry.account).sum()
}

/// Every place of this node knows where each of its messages is.
#[track_caller]
fn balances(audit: &NodeAudit) {
    for entry in &audit.entries {
        assert_eq!(entry.account.unexplained(), 0, "{}: {:?}", entry.place, entry.account);
    }
}

/// One message of every sort for the held application: 3 values, 1 that expires, 1 refused, 1 fatal, jobs until nothing has room.
/// Returns how many jobs were taken.
fn send_every_sort(sender: &Sender, to: &str) -> u64 {
    for number in 2..5 {
        sender.send(to, &Value { number }).expect("it replaces the one before");
    }
    let late =
        sender.message(to, &Order { number: 5 }).confirmed(Duration::from_millis(1)).expect("it is taken");
    assert_eq!(wait(late), Outcome::Unknown, "nobody has said anything in its time");
    for number in [REFUSED, FATAL, 6] {
        sender.send(to, &Order { number }).expect("there is room");
    }
    (0..).take_while(|number| sender.send(to, &Job { number: 100 + number }).is_ok()).count() as u64
}

#[test]
fn every_sort_of_end_in_a_node_is_counted_and_nothing_is_unexplained() {
    // Given: an application that is held up
    let ((go, gate), (say, held)) = (sync_channel::<()>(1), sync_channel(1));
    let gate = Mutex::new(gate);
    let (sink, _log) = Stage::new()
        .got(move |puppet, context| match puppet.number {
            HOLD => {
                say.send(()).expect("the test waits");
                gate.lock().expect("one has it").recv().expect("the test lets it go");
            }
            REFUSED => context.reject(),
            FATAL => panic!("thirteen"),
            _ => {}
        })
        .app("sink");
    let (desk, key) = desk("desk");
    let ground = Ground::new();
    let node = ground.node("one").configure(|config| config.mailbox_capacity = MAILBOX);
    let node = node.app(sink.progress_within(DEADLINE)).app(desk).start().expect("a node");
    all_run(&[&node]);
    let (handle, sender) = (node.handle(), key.sender());
    sender.send("sink", &Order { number: HOLD }).expect("there is room");
    held.recv_timeout(DEADLINE).expect("waited for it to be held");
    // When: it is sent every sort of message
    let jobs = send_every_sort(&sender, "sink");
    let nobody = Tid::new(node.address(), AppAddress::fixed(7).expect("a fixed one"));
    sender.send(nobody, &Job { number: 0 }).expect_err("nobody has this address");
    // Then: what waits is counted while it waits, and what became of it when it has ended
    let audit = handle.audit_here();
    balances(&audit);
    let account = mailbox(&audit, "sink");
    assert_eq!(account.waiting, 1 + 1 + 3 + jobs, "held, value, orders, jobs: {account:?}");
    // What was late made way when there was no room.
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
    // And: of one that is gone it is still known
    handle.stop_app("sink").expect("it is there");
    handle.remove_app("sink").expect("it has stopped");
    let audit = handle.audit_here();
    balances(&audit);
    assert_eq!(mailbox(&audit, "sink"), Account::default());
    assert_eq!(audit.account(&Place::OtherMailboxes).taken, account.taken);
}

#[test]
fn what_a_client_is_given_is_counted_while_it_is_there_and_when_it_has_gone() {
    let (directory, ground) = (OwnDirectory::new(), Ground::new());
    let socket = directory.join("node.sock");
    let ((sink, _log), (desk, key)) = (Stage::new().app("sink"), desk("desk"));
    let door = socket.clone();
    let node = ground.node("one").configure(move |config| config.lncl.socket = Some(door));
    let node = node.app(sink).app(desk).start().expect("a node");
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

/// The audit of the whole system, which `nodes` are, once nothing waits or is under way. At every moment before, nothing is unexplained.
fn once_quiet(nodes: [&NodeHandle; 2]) -> Audit {
    // Each says so of itself, since a node answers another one 16 times a second and no more often.
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
fn an_audit_of_two_nodes_explains_every_message_while_they_flow_and_when_all_is_quiet() {
    // Given: two nodes, and messages of every class from one to the other
    const JOBS: u64 = 300;
    let ground = Ground::new();
    let (sink, _log) = Stage::new().app("sink");
    let (desk, key) = desk("desk");
    let there = ground.node("there").app(sink).start().expect("a node");
    let here = ground.node("home").app(desk).start().expect("a node");
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
    // Then: each message that the desk has sent is where it ended, and both ends of every link agree
    assert_eq!((audit.silent.len(), audit.nodes.len(), audit.links.len()), (0, 2, 6), "{audit}");
    for link in &audit.links {
        let taken = link.taken.unwrap_or_else(|| panic!("both speak of one session: {audit}"));
        // The audit's own question and answer may lie between the readings.
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
    // What went by the connection may come behind what went by datagram.
    let arrived = there.account(&Place::FromNode { node: here.address(), class: Some(Class::Stream) });
    let superseded = values.superseded + on_the_way.superseded + arrived.superseded;
    assert_eq!(values.delivered + superseded, JOBS, "{audit}");
    assert_eq!(there.refused.get("not taken: NoSuchApplication"), Some(&1), "{audit}");
    let json = serde_json::to_string(&audit).expect("every field can be written");
    assert_eq!(serde_json::from_str::<Audit>(&json).expect("and read"), audit);
    assert!(audit.to_string().contains("every message is explained"), "{audit}");
}

/// What a node says of what it has sent to another one.
fn to(audit: &Audit, from: &NodeHandle, to: NodeAddress, class: Class) -> Account {
    let from = audit.nodes.iter().find(|node| node.node == from.address()).expect("it asked");
    from.account(&Place::ToNode { node: to, class: Some(class) })
}
