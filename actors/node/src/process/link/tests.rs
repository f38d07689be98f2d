//! The messages of a hosted application, and their times.

use std::{pin::pin, sync::mpsc::sync_channel, task::Context, time::Duration};

use bytes::Bytes;
use sinew_lncl::Reader;
use sinew_model::{config::NodeConfig, notifications::testing::waits};
use sinew_runtime::{
    mailbox::About,
    pending::Pending,
    sender::Directory,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    wire::HEADER_LEN,
};
use tokio::io::AsyncReadExt;

use super::*;
use crate::process::protocol::{self, EVENTS_MAX, WINDOW};

struct NoDirectory;

impl Directory for NoDirectory {
    fn resolve(&self, _: &str) -> Option<Tid> {
        None
    }

    fn set_member(&self, _: AppAddress, _: AppAddress, _: bool) {}
}

/// A sink that sends to the TID of the ended message, from within the settlement.
struct SendsAgain(Arc<Link>);

impl ReceiptSink for SendsAgain {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        assert_eq!(outcome, Outcome::Failed);
        let again =
            Message::new(Header::new(Kind::named("again"), ticket.source, ticket.destination), Bytes::new());
        self.0.submit(again).expect("there is room");
    }
}

/// The node's end of an application without a process yet, and with a mailbox of 8 messages.
fn begun() -> (Arc<NodeState>, Arc<Link>, Tid) {
    let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
    let link = Link::new(&state, Mailbox::new(8));
    (state, link, Tid::new(NodeAddress::HERE, AppAddress::fixed(1).expect("a fixed one")))
}

/// A process behind `link`, and its end of the connection; it has read the welcome.
async fn connected(state: &NodeState, link: &Link) -> (LinkNumber, UnixStream) {
    let (socket, mut process) = UnixStream::pair().expect("a pair of sockets");
    let welcome = protocol::empty_frame(Kind::HOST_WELCOME, Tid::NONE, Tid::NONE);
    let number = link.connect(
        Arc::new(socket),
        welcome,
        (state.ctx.directory_changes.subscribe(), 0),
        KillFlag::default(),
    );
    let mut frame = [0; HEADER_LEN];
    tokio::select! {
        error = link.drain(number) => panic!("the process reads: {error}"),
        read = process.read_exact(&mut frame) => drop(read.expect("the welcome")),
    }
    (number, process)
}

#[test]
fn process_cannot_exceed_its_counter_range_in_steps() {
    let (state, link, tid) = begun();
    let sender = Sender::new(tid, state.ctx.router.clone(), Arc::new(NoDirectory), Pending::new(1), 1_024);
    assert!(link.sender.set(sender).is_ok());
    let is_accepted = |sequence| {
        let mut header = Header::new(Kind::named("first"), tid, tid);
        header.sequence = sequence;
        link.record_sent(&header)
    };
    link.begin_process();
    assert!(is_accepted(1) && is_accepted(1 << 40) && !is_accepted((1 << 40) + 1) && !is_accepted(u64::MAX));
    link.begin_process();
    assert!(is_accepted((1 << 40) + 1), "the next one counts on from there");
    assert_eq!(link.sequence(), (1 << 40) + 1);
}

#[test]
fn message_does_not_overtake_directory_change() {
    let (state, link, tid) = begun();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().expect("a reactor");
    let _entered = runtime.enter();
    let (number, _process) = runtime.block_on(connected(&state, &link));
    let waits = || lock(&link.present).as_ref().expect("it is connected").held.is_some();
    let send = || {
        link.submit(Message::new(Header::new(Kind::named("event"), tid, tid), Bytes::new()))
            .expect("there is room");
    };
    // Given: a message has arrived behind two changes
    state.ctx.directory_has_changed();
    state.ctx.directory_has_changed();
    send();
    assert!(waits(), "no update was sent");
    // When: the child has been notified of one
    link.directory_was_sent(number, 1);
    link.hand_over_held();
    // Then
    assert!(waits(), "it does not know of the second");
    // When: it has been notified of the second, and meanwhile there was another one
    state.ctx.directory_has_changed();
    link.directory_was_sent(number, 2);
    link.hand_over_held();
    // Then
    assert!(
        !waits(),
        "no sender of it can know the third change: names that change all the time delay no message forever"
    );
    link.directory_was_sent(number, 3);
    send();
    assert!(!waits(), "it knows all changes");
}

#[test]
fn failure_sink_may_send_again_at_once() {
    let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
    let mailbox = Mailbox::new(8);
    let link = Link::new(&state, mailbox.clone());
    let tid = Tid::new(NodeAddress::HERE, AppAddress::fixed(1).expect("a fixed one"));
    let (sender, receiver) = sync_channel(1);
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().expect("a reactor");
        let _entered = runtime.enter();
        let (first, process) = UnixStream::pair().expect("a pair of sockets");
        let (second, _other) = UnixStream::pair().expect("another");
        let connect = |socket| {
            let welcome = protocol::empty_frame(Kind::HOST_WELCOME, Tid::NONE, tid);
            link.connect(
                Arc::new(socket),
                welcome,
                (state.ctx.directory_changes.subscribe(), 0),
                KillFlag::default(),
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
        // The supervisor has not waited for the end of the first one.
        connect(second);
        sender.send(()).expect("it is waited for");
    });
    receiver.recv_timeout(Duration::from_secs(60)).expect("notifications hold no lock");
}

#[test]
fn awaited_message_passes_many_waiting_events() {
    const MET: Kind = Kind::named("met");
    // Given: messages of a node fill the window
    let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
    let link = Link::new(&state, Mailbox::new(2 * (WINDOW + EVENTS_MAX)));
    let tid = Tid::new(NodeAddress::HERE, AppAddress::fixed(1).expect("a fixed one"));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().expect("a reactor");
    let _entered = runtime.enter();
    let (_, process) = runtime.block_on(connected(&state, &link));
    let gone = NodeAddress::new(9);
    let send = |source, kind, about: Option<About>| {
        let mut header = Header::new(kind, source, tid);
        about.iter().for_each(|about| about.write(&mut header));
        link.submit(Message::new(header, Bytes::new()))
    };
    for _ in 0..WINDOW {
        send(Tid::new(gone, tid.app), Kind::named("test"), None).expect("there is room");
    }
    // When: more events about the node arrive than the child may have, while it takes nothing else; then the
    // awaited message
    let ndl = Tid::new(tid.node, AppAddress::NDL);
    for _ in 0..2 * EVENTS_MAX {
        for about in [About::End(gone), About::Node(gone)] {
            // A refused event is offered again.
            let _ = send(ndl, Kind::named("event"), Some(about));
        }
    }
    send(Tid::new(tid.node, AppAddress::SYNC), MET, None).expect("there is room");
    // Then
    let mut kinds = Vec::new();
    let mut reader = Reader::new(1_024);
    runtime.block_on(process.readable()).expect("a connection");
    while let Ok(Some(message)) = reader.next_buffered(&process) {
        kinds.push(message.header.kind);
    }
    assert_eq!((kinds.len(), kinds.last()), (WINDOW + EVENTS_MAX / 2 + 1, Some(&MET)));
}

#[test]
fn held_message_wakes_the_present_child_only() {
    let (state, link, tid) = begun();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().expect("a reactor");
    let _entered = runtime.enter();
    let (former, _process) = runtime.block_on(connected(&state, &link));
    let mut of_former = pin!(link.names_needed(former));
    waits(of_former.as_mut());
    let (present, _other) = runtime.block_on(connected(&state, &link));
    let mut of_present = pin!(link.names_needed(present));
    let woken = waits(of_present.as_mut());
    state.ctx.directory_has_changed();
    link.submit(Message::new(Header::new(Kind::named("event"), tid, tid), Bytes::new()))
        .expect("there is room");
    assert!(woken.is());
}

#[test]
fn updates_of_former_child_do_not_count_for_next() {
    // Given: a child that has replaced another one, and changed names
    let (state, link, tid) = begun();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().expect("a reactor");
    let _entered = runtime.enter();
    let (former, _process) = runtime.block_on(connected(&state, &link));
    let (present, _other) = runtime.block_on(connected(&state, &link));
    state.ctx.directory_has_changed();
    // When: the delayed supervisor of the former one sends them
    let refused = link.send_to(former, protocol::empty_frame(Kind::HOST_NAMES, Tid::NONE, tid));
    link.directory_was_sent(former, 1);
    // Then
    assert_eq!(refused.expect_err("it is over").why, Rejection::Closed);
    link.submit(Message::new(Header::new(Kind::named("event"), tid, tid), Bytes::new()))
        .expect("there is room");
    let waits = || lock(&link.present).as_ref().expect("it is connected").held.is_some();
    assert!(waits(), "this child was sent no update");
    link.directory_was_sent(present, 1);
    link.hand_over_held();
    assert!(!waits());
    // And: a report of the former child does not settle the message that the present one handles
    let ended = || Progress { done: Some((1, Disposition::Ended(Outcome::Delivered))), taken: None };
    link.handle_progress(former, ended()).expect("it counts for nothing");
    link.handle_progress(present, ended()).expect("it has the message still");
}

#[test]
fn messages_to_killed_child_wait_for_next_one() {
    // Given: a child that handles a message and is killed, with an end that is not noticed yet
    let (state, link, tid) = begun();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a reactor");
    let _entered = runtime.enter();
    let (killed, _process) = runtime.block_on(connected(&state, &link));
    let send = |kind| {
        let message = Message::new(Header::new(Kind::named(kind), tid, tid), Bytes::new());
        link.submit(message).expect("there is room");
    };
    send("before");
    lock(&link.present).as_ref().expect("it is connected").kill_flag.set();
    // When: it is sent another one, and ends without having been read
    send("behind");
    link.disconnect(killed, FinalRead::Incomplete);
    // Then
    let (_, mut next) = runtime.block_on(connected(&state, &link));
    let mut frame = [0; HEADER_LEN];
    let handed_over =
        async { tokio::time::timeout(Duration::from_secs(60), next.read_exact(&mut frame)).await };
    runtime.block_on(handed_over).expect("it is handed over within a minute").expect("it is read");
    let header = Header::decode(&frame, &[]).expect("a header");
    assert_eq!(header.kind, Kind::named("behind"), "the outcome of the one before it is unknown");
}

#[test]
fn held_message_of_killed_child_does_not_spin() {
    // Given: a message waits until the child has been notified of a change
    let (state, link, tid) = begun();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a reactor");
    let _entered = runtime.enter();
    let (killed, _process) = runtime.block_on(connected(&state, &link));
    state.ctx.directory_has_changed();
    link.submit(Message::new(Header::new(Kind::named("behind"), tid, tid), Bytes::new()))
        .expect("there is room");
    let is_needed = || {
        let needed = pin!(link.names_needed(killed));
        needed.poll(&mut Context::from_waker(Waker::noop())).is_ready()
    };
    assert!(is_needed(), "the supervisor of the child must send the update");
    // When: the child is killed before that
    lock(&link.present).as_ref().expect("it is connected").kill_flag.set();
    link.hand_over_held();
    // Then
    assert!(!is_needed(), "there is no child to notify");
    assert!(lock(&link.present).as_ref().expect("it is connected").held.is_some());
    // And: the next one gets it
    link.disconnect(killed, FinalRead::Incomplete);
    assert_eq!(link.mailbox.attach_remote().take().expect("it waits").header.kind, Kind::named("behind"));
}
