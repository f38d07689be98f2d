//! What a hosted application gets, and when.

use std::{pin::pin, sync::mpsc::sync_channel, task::Context, time::Duration};

use bytes::Bytes;
use sinew_runtime::{
    mailbox::About,
    pending::Pending,
    sender::Directory,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    wire::HEADER_LEN,
};
use tokio::io::AsyncReadExt;

use super::*;
use crate::{
    config::NodeConfig,
    lncl::Reader,
    process::words::{self, EVENTS_MAX, WINDOW},
    takeover::tests::waits,
};

struct Nobody;

impl Directory for Nobody {
    fn resolve(&self, _: &str) -> Option<Tid> {
        None
    }

    fn set_member(&self, _: AppAddress, _: AppAddress, _: bool) {}
}

/// Sends to the TID whose message has ended, from within.
struct SendsAgain(Arc<Link>);

impl ReceiptSink for SendsAgain {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        assert_eq!(outcome, Outcome::Failed);
        let again =
            Message::new(Header::new(Kind::named("again"), ticket.source, ticket.destination), Bytes::new());
        self.0.submit(again).expect("there is room");
    }
}

/// A node's end of an application that has no process yet, and whose mailbox takes 8 messages.
fn begun() -> (Arc<Stores>, Arc<Link>, Tid) {
    let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
    let link = Link::new(&stores, Mailbox::new(8));
    (stores, link, Tid::new(NodeAddress::HERE, AppAddress::fixed(1).expect("a fixed one")))
}

/// A process behind `link`, and its end of the connection; it has read the welcome.
async fn connected(stores: &Stores, link: &Link) -> (LinkNumber, UnixStream) {
    let (socket, mut process) = UnixStream::pair().expect("a pair of sockets");
    let welcome = words::bare(Kind::HOST_WELCOME, Tid::NONE, Tid::NONE);
    let number =
        link.connect(Arc::new(socket), welcome, (stores.directory_changes.subscribe(), 0), Doom::default());
    let mut frame = [0; HEADER_LEN];
    tokio::select! {
        error = link.drain(number) => panic!("the process reads: {error}"),
        read = process.read_exact(&mut frame) => drop(read.expect("the welcome")),
    }
    (number, process)
}

#[test]
fn a_process_cannot_count_beyond_its_reach_step_by_step_either() {
    let (stores, link, tid) = begun();
    let sender = Sender::new(tid, stores.router.clone(), Arc::new(Nobody), Pending::new(1), 1_024);
    assert!(link.sender.set(sender).is_ok());
    let says = |sequence| {
        let mut header = Header::new(Kind::named("first"), tid, tid);
        header.sequence = sequence;
        link.note(&header)
    };
    link.begin_life();
    assert!(says(1) && says(1 << 40) && !says((1 << 40) + 1) && !says(u64::MAX));
    link.begin_life();
    assert!(says((1 << 40) + 1), "the next one counts on from there");
    assert_eq!(link.sequence(), (1 << 40) + 1);
}

#[test]
fn a_message_does_not_overtake_the_change_of_the_directory_behind_which_it_came() {
    let (stores, link, tid) = begun();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().expect("a reactor");
    let _entered = runtime.enter();
    let (socket, mut process) = UnixStream::pair().expect("a pair of sockets");
    let welcome = words::bare(Kind::HOST_WELCOME, Tid::NONE, tid);
    let number =
        link.connect(Arc::new(socket), welcome, (stores.directory_changes.subscribe(), 0), Doom::default());
    let mut frame = [0; HEADER_LEN];
    runtime.block_on(async {
        tokio::select! {
            error = link.drain(number) => panic!("the process reads: {error}"),
            read = process.read_exact(&mut frame) => read.expect("the welcome"),
        }
    });
    let waits = || lock(&link.present).as_ref().expect("it is connected").held.is_some();
    let send = || {
        link.submit(Message::new(Header::new(Kind::named("event"), tid, tid), Bytes::new()))
            .expect("there is room");
    };
    // Given: a message has come behind two changes
    stores.directory_has_changed();
    stores.directory_has_changed();
    send();
    assert!(waits(), "the words are not on their way");
    // When: the child has been told of one
    link.directory_is_told(number, 1);
    link.hand_over_held();
    // Then
    assert!(waits(), "it does not know of the second");
    // When: it has been told of the second, and meanwhile there was another one
    stores.directory_has_changed();
    link.directory_is_told(number, 2);
    link.hand_over_held();
    // Then
    assert!(
        !waits(),
        "nobody who sent it can know of the third: names that change all the time hold nothing up for good"
    );
    link.directory_is_told(number, 3);
    send();
    assert!(!waits(), "it knows all");
}

#[test]
fn whoever_is_told_that_a_former_process_failed_may_send_to_it_at_once() {
    let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
    let mailbox = Mailbox::new(8);
    let link = Link::new(&stores, mailbox.clone());
    let tid = Tid::new(NodeAddress::HERE, AppAddress::fixed(1).expect("a fixed one"));
    let (say, said) = sync_channel(1);
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().expect("a reactor");
        let _entered = runtime.enter();
        let (first, process) = UnixStream::pair().expect("a pair of sockets");
        let (second, _other) = UnixStream::pair().expect("another");
        let connect = |socket| {
            let welcome = words::bare(Kind::HOST_WELCOME, Tid::NONE, tid);
            link.connect(
                Arc::new(socket),
                welcome,
                (stores.directory_changes.subscribe(), 0),
                Doom::default(),
            )
        };
        let number = connect(first);
        let mut message = Message::new(Header::new(Kind::named("first"), tid, tid), Bytes::new());
        let ticket = Ticket { source: tid, destination: tid, correlation: 1 };
        message.receipt = Some(Receipt::new(Arc::new(SendsAgain(link.clone())), ticket));
        link.submit(message).expect("there is room");
        let (mut process, mut frames) = (process, [0; 2 * HEADER_LEN]);
        let taken = async {
            tokio::select! {
                error = link.drain(number) => panic!("the process reads: {error}"),
                read = process.read_exact(&mut frames) => read.expect("the welcome and the message"),
            }
        };
        runtime.block_on(taken);
        // Its supervisor has not waited for the end of the first one.
        connect(second);
        say.send(()).expect("it is waited for");
    });
    said.recv_timeout(Duration::from_secs(60)).expect("whoever is told is told without a lock");
}

#[test]
fn what_ends_a_pause_is_handed_over_however_many_events_wait_behind_messages_of_a_node() {
    const MET: Kind = Kind::named("met");
    // Given: messages of a node fill the window
    let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
    let link = Link::new(&stores, Mailbox::new(2 * (WINDOW + EVENTS_MAX)));
    let tid = Tid::new(NodeAddress::HERE, AppAddress::fixed(1).expect("a fixed one"));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().expect("a reactor");
    let _entered = runtime.enter();
    let (_, process) = runtime.block_on(connected(&stores, &link));
    let gone = NodeAddress::new(9);
    let send = |source, kind, about: Option<About>| {
        let mut header = Header::new(kind, source, tid);
        about.iter().for_each(|about| about.write(&mut header));
        link.submit(Message::new(header, Bytes::new()))
    };
    for _ in 0..WINDOW {
        send(Tid::new(gone, tid.app), Kind::named("test"), None).expect("there is room");
    }
    // When: more is told of it than the child may have, which takes nothing else, and then what it waits for
    let ndl = Tid::new(tid.node, AppAddress::NDL);
    for _ in 0..2 * EVENTS_MAX {
        for about in [About::End(gone), About::Node(gone)] {
            // One that is refused is offered again.
            let _ = send(ndl, Kind::named("event"), Some(about));
        }
    }
    send(Tid::new(tid.node, AppAddress::SYNC), MET, None).expect("there is room");
    // Then
    let mut kinds = Vec::new();
    let mut reader = Reader::new(1_024);
    runtime.block_on(process.readable()).expect("a connection");
    while let Ok(Some(message)) = reader.next_of_the_dead(&process) {
        kinds.push(message.header.kind);
    }
    assert_eq!((kinds.len(), kinds.last()), (WINDOW + EVENTS_MAX / 2 + 1, Some(&MET)));
}

#[test]
fn a_message_that_waits_for_names_is_told_to_who_waits_for_this_child_whoever_waited_for_the_former() {
    let (stores, link, tid) = begun();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().expect("a reactor");
    let _entered = runtime.enter();
    let (former, _process) = runtime.block_on(connected(&stores, &link));
    let mut of_former = pin!(link.nudged(former));
    waits(of_former.as_mut());
    let (present, _other) = runtime.block_on(connected(&stores, &link));
    let mut of_present = pin!(link.nudged(present));
    let woken = waits(of_present.as_mut());
    stores.directory_has_changed();
    link.submit(Message::new(Header::new(Kind::named("event"), tid, tid), Bytes::new()))
        .expect("there is room");
    assert!(woken.is());
}

#[test]
fn what_is_said_for_a_former_child_neither_reaches_the_next_one_nor_counts_as_said_to_it() {
    // Given: a child that has followed another one, and names that have changed
    let (stores, link, tid) = begun();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().expect("a reactor");
    let _entered = runtime.enter();
    let (former, _process) = runtime.block_on(connected(&stores, &link));
    let (present, _other) = runtime.block_on(connected(&stores, &link));
    stores.directory_has_changed();
    // When: the former one's supervisor, which was held up, tells it
    let refused = link.say_to(former, words::bare(Kind::HOST_NAMES, Tid::NONE, tid));
    link.directory_is_told(former, 1);
    // Then
    assert_eq!(refused.expect_err("it is over").why, Rejection::Closed);
    link.submit(Message::new(Header::new(Kind::named("event"), tid, tid), Bytes::new()))
        .expect("there is room");
    let waits = || lock(&link.present).as_ref().expect("it is connected").held.is_some();
    assert!(waits(), "this child has not been told");
    link.directory_is_told(present, 1);
    link.hand_over_held();
    assert!(!waits());
    // And: what the former one says that it did says nothing of what this one has in its hand
    let ended = || Turn { done: Some((1, Fate::Ended(Outcome::Delivered))), taken: None };
    link.turn(former, ended()).expect("it counts for nothing");
    link.turn(present, ended()).expect("it has the message still");
}

#[test]
fn what_is_sent_to_a_child_that_is_killed_next_waits_for_the_one_after_it() {
    // Given: a child that has been handed over a message, is killed, and whose end is not noticed yet
    let (stores, link, tid) = begun();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a reactor");
    let _entered = runtime.enter();
    let (killed, _process) = runtime.block_on(connected(&stores, &link));
    let send = |kind| {
        let message = Message::new(Header::new(Kind::named(kind), tid, tid), Bytes::new());
        link.submit(message).expect("there is room");
    };
    send("before");
    lock(&link.present).as_ref().expect("it is connected").doom.comes();
    // When: it is sent another one, and ends without having been heard
    send("behind");
    link.disconnect(killed, LastWords::Unheard);
    // Then
    let (_, mut next) = runtime.block_on(connected(&stores, &link));
    let mut frame = [0; HEADER_LEN];
    let handed_over =
        async { tokio::time::timeout(Duration::from_secs(60), next.read_exact(&mut frame)).await };
    runtime.block_on(handed_over).expect("it is handed over within a minute").expect("it is read");
    let header = Header::decode(&frame, &[]).expect("a header");
    assert_eq!(header.kind, Kind::named("behind"), "of the one before it nobody knows what became");
}

#[test]
fn a_message_that_waits_for_names_keeps_nobody_busy_when_its_child_is_killed() {
    // Given: a message waits until the child has been told of a change
    let (stores, link, tid) = begun();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a reactor");
    let _entered = runtime.enter();
    let (killed, _process) = runtime.block_on(connected(&stores, &link));
    stores.directory_has_changed();
    link.submit(Message::new(Header::new(Kind::named("behind"), tid, tid), Bytes::new()))
        .expect("there is room");
    let is_nudged = || {
        let nudged = pin!(link.nudged(killed));
        nudged.poll(&mut Context::from_waker(Waker::noop())).is_ready()
    };
    assert!(is_nudged(), "who listens to the child is to tell it");
    // When: the child is killed before that
    lock(&link.present).as_ref().expect("it is connected").doom.comes();
    link.hand_over_held();
    // Then
    assert!(!is_nudged(), "there is nobody to be told");
    assert!(lock(&link.present).as_ref().expect("it is connected").held.is_some());
    // And: the next one gets it
    link.disconnect(killed, LastWords::Unheard);
    assert_eq!(link.mailbox.lend().take().expect("it waits").header.kind, Kind::named("behind"));
}
