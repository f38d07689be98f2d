//! Two clients, and the frames that each receives.

use std::{
    os::unix::net::UnixStream,
    sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel},
};

use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, recv, recvmsg};
use sinew_model::config::NodeConfig;
use sinew_protocol::payload::Gone;
use sinew_runtime::tid::{Incarnation, NodeAddress};

use super::*;
use crate::{State, process_watch::ProcessWatch, server::Server};

const NOW: Time = Time::from_nanos(1);

fn request(number: u64, correlation: u64) -> LinkRequest {
    LinkRequest { number, correlation }
}

struct Queue {
    frames: SyncSender<Message>,
    /// More than are sent.
    marks: SyncSender<Message>,
}

impl Listener for Queue {
    fn submit_mark(&self, mark: Message) -> Result<(), SubmitError> {
        self.marks.send(mark).map_err(|error| SubmitError::new(error.0, Rejection::Closed))
    }
}

impl MessageSink for Queue {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        self.frames.try_send(message).map_err(|error| match error {
            TrySendError::Full(message) => SubmitError::new(message, Rejection::QueueFull),
            TrySendError::Disconnected(message) => SubmitError::new(message, Rejection::Closed),
        })
    }
}

struct Client {
    tid: Tid,
    frames: Receiver<Message>,
    marks: Receiver<Message>,
    socket: UnixStream,
}

fn tid(app: u32) -> Tid {
    Tid::new(NodeAddress::new(0x7f00_0001), AppAddress::new(app))
}

fn join(link_broker: &LinkBroker, app: u32, room: usize) -> Client {
    join_of(link_broker, app, app, room)
}

/// A client of the process `pid`.
fn join_of(link_broker: &LinkBroker, app: u32, pid: u32, room: usize) -> Client {
    let ((sender, frames), (marking, marks)) = (sync_channel(room), sync_channel(4 * SWITCHES_MAX));
    let (theirs, socket) = UnixStream::pair().unwrap();
    let peer =
        LinkPeer::new(tid(app), pid, Arc::new(Queue { frames: sender, marks: marking }), Arc::new(theirs));
    link_broker.add(peer);
    Client { tid: tid(app), frames, marks, socket }
}

impl Client {
    fn next(&self) -> Message {
        self.frames.try_recv().or_else(|_| self.marks.try_recv()).expect("a frame")
    }

    /// Returns the number and the descriptor received over the socket.
    fn end(&self) -> (u64, OwnedFd) {
        let mut number = [0; 8];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
        let mut control = RecvAncillaryBuffer::new(&mut space);
        let mut parts = [std::io::IoSliceMut::new(&mut number)];
        let flags = RecvFlags::DONTWAIT | RecvFlags::CMSG_CLOEXEC;
        recvmsg(&self.socket, &mut parts, &mut control, flags).unwrap();
        let Some(RecvAncillaryMessage::ScmRights(mut ends)) = control.drain().next() else {
            panic!("no descriptor")
        };
        (u64::from_le_bytes(number), ends.next().expect("a descriptor"))
    }
}

fn outcome_of(message: &Message) -> Outcome {
    assert_eq!(message.header.kind, Kind::OUTCOME);
    Outcome::from_code(message.payload[0]).expect("an outcome")
}

fn introduction_of(message: &Message, kind: Kind) -> Introduction {
    assert_eq!(message.header.kind, kind);
    payload::read(&message.payload).unwrap()
}

#[test]
fn clients_get_both_ends_and_the_node_keeps_none() {
    let link_broker = LinkBroker::default();
    let (requester, peer) = (join(&link_broker, 1, 4), join(&link_broker, 2, 4));
    link_broker.introduce(requester.tid, peer.tid, request(7, 99), NOW).unwrap();
    let mut message = peer.next();
    let introduction = introduction_of(&message, Kind::LNCL_INTRODUCTION);
    assert_eq!(introduction, Introduction { peer: requester.tid.bits(), pid: 1, number: 7 });
    assert!(requester.frames.try_recv().is_err(), "the requester is notified when the peer agrees");
    message.settle(Outcome::Delivered);
    let answer = requester.next();
    assert_eq!(answer.header.correlation, 99);
    let introduction = introduction_of(&answer, Kind::LNCL_INTRODUCED);
    assert_eq!(introduction, Introduction { peer: peer.tid.bits(), pid: 2, number: 7 });
    let ((own_number, own), (their_number, theirs)) = (requester.end(), peer.end());
    assert_eq!((own_number, their_number), (7, 7));
    rustix::net::send(&own, b"x", SendFlags::empty()).unwrap();
    assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::empty()).unwrap().0, 1);
    drop(own);
    assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::DONTWAIT).unwrap().0, 0, "nobody else has it");
}

#[test]
fn refused_requester_is_notified() {
    let link_broker = LinkBroker::default();
    let (requester, peer) = (join(&link_broker, 1, 4), join(&link_broker, 2, 4));
    link_broker.introduce(requester.tid, peer.tid, request(7, 99), NOW).unwrap();
    peer.next().settle(Outcome::Rejected(Rejection::QueueFull));
    let answer = requester.next();
    assert_eq!(
        (answer.header.correlation, outcome_of(&answer)),
        (99, Outcome::Rejected(Rejection::QueueFull))
    );
    let (_, theirs) = peer.end();
    assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::DONTWAIT).unwrap().0, 0);
}

#[test]
fn requester_without_room_ends_the_link_for_the_peer() {
    let link_broker = LinkBroker::default();
    let (requester, peer) = (join(&link_broker, 1, 0), join(&link_broker, 2, 4));
    link_broker.introduce(requester.tid, peer.tid, request(7, 99), NOW).unwrap();
    let (_, theirs) = peer.end();
    peer.next().settle(Outcome::Delivered);
    // Although the other end is still in the requester's socket.
    assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::DONTWAIT).map(|(count, _)| count), Ok(0));
}

#[test]
fn link_to_nothing_or_oneself_is_refused() {
    let link_broker = LinkBroker::default();
    let requester = join(&link_broker, 1, 4);
    assert_eq!(link_broker.introduce(requester.tid, tid(3), request(1, 1), NOW), Err(Rejection::Unsupported));
    assert_eq!(
        link_broker.introduce(requester.tid, requester.tid, request(1, 1), NOW),
        Err(Rejection::Unsupported)
    );
    let gone = join(&link_broker, 2, 4);
    link_broker.remove(gone.tid, Departure::LinksRemain);
    assert_eq!(
        link_broker.introduce(requester.tid, gone.tid, request(1, 1), NOW),
        Err(Rejection::Unsupported)
    );
    assert_eq!(
        link_broker.introduce(gone.tid, requester.tid, request(1, 1), NOW),
        Err(Rejection::Unsupported)
    );
}

#[test]
fn silent_peers_descriptors_in_flight_are_bounded() {
    let link_broker = LinkBroker::default();
    let (requester, peer) = (join(&link_broker, 1, 64), join(&link_broker, 2, 64));
    for number in 0..UNANSWERED_MAX as u64 {
        link_broker.introduce(requester.tid, peer.tid, request(number, number), NOW).unwrap();
    }
    assert_eq!(
        link_broker.introduce(requester.tid, peer.tid, request(50, 50), NOW),
        Err(Rejection::QueueFull)
    );
    peer.next().settle(Outcome::Delivered);
    assert_eq!(link_broker.introduce(requester.tid, peer.tid, request(51, 51), NOW), Ok(()));
}

#[test]
fn unanswered_introduction_is_abandoned_without_leftovers() {
    let link_broker = LinkBroker::default();
    let (requester, peer) = (join(&link_broker, 1, 64), join(&link_broker, 2, 64));
    link_broker.introduce(requester.tid, peer.tid, request(7, 99), NOW).unwrap();
    let (_, theirs) = peer.end();
    let late = NOW + unanswered::ANSWERED_WITHIN;
    link_broker.expire(late.shifted(-1));
    assert!(requester.frames.try_recv().is_err(), "there is time yet");
    assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::DONTWAIT), Err(Errno::AGAIN), "the link is there");

    link_broker.expire(late);
    let answer = requester.next();
    let not_now = Outcome::Rejected(Rejection::QueueFull);
    assert_eq!((answer.header.correlation, outcome_of(&answer)), (99, not_now));
    assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::DONTWAIT).unwrap().0, 0, "the link has ended");
    peer.next().settle(Outcome::Delivered);
    assert!(requester.frames.try_recv().is_err(), "it was notified already");
}

#[test]
fn periodic_check_abandons_unanswered_introductions() {
    let server = Server::new(State::for_test(NodeConfig::new("test"), Incarnation(1)));
    let link_broker = &server.link_broker;
    let (requester, peer) = (join(link_broker, 1, 64), join(link_broker, 2, 64));
    link_broker.introduce(requester.tid, peer.tid, request(7, 99), NOW).unwrap();
    server.tick(NOW + unanswered::ANSWERED_WITHIN);
    let answer = requester.next();
    assert_eq!(outcome_of(&answer), Outcome::Rejected(Rejection::QueueFull));
}

#[test]
fn abandoned_descriptors_in_flight_still_count_for_the_peer() {
    let link_broker = LinkBroker::default();
    let (requester, peer) = (join(&link_broker, 1, 64), join(&link_broker, 2, 64));
    for number in 0..UNANSWERED_MAX as u64 {
        link_broker.introduce(requester.tid, peer.tid, request(number, number), NOW).unwrap();
    }
    let late = NOW + unanswered::ANSWERED_WITHIN;
    link_broker.expire(late);
    assert_eq!(
        link_broker.introduce(requester.tid, peer.tid, request(50, 50), late),
        Err(Rejection::QueueFull)
    );
    peer.next().settle(Outcome::Delivered);
    assert_eq!(link_broker.introduce(requester.tid, peer.tid, request(51, 51), late), Ok(()));
}

#[test]
fn silent_clients_hold_a_bounded_number_of_descriptors() {
    // Given: 60 clients of one process that answer nothing, and 16 senders of another.
    let link_broker = LinkBroker::default();
    let silent: Vec<_> = (100..160).map(|app| join_of(&link_broker, app, 2, 64)).collect();
    let senders: Vec<_> = (1..17).map(|app| join_of(&link_broker, app, 1, 64)).collect();

    // When: each sender requests a link to each of them.
    let pairs = senders.iter().flat_map(|sender| silent.iter().map(move |peer| (sender.tid, peer.tid)));
    let begun = pairs.zip(1..).filter(|&((sender, peer), number)| {
        link_broker.introduce(sender, peer, request(number, number), NOW).is_ok()
    });

    // Then: the limit of the process is in flight, and two others are still introduced to each other.
    assert_eq!(begun.count(), unanswered::PROCESS_MAX);
    let (requester, peer) = (join(&link_broker, 30, 4), join(&link_broker, 31, 4));
    assert_eq!(link_broker.introduce(requester.tid, peer.tid, request(5_000, 5_000), NOW), Ok(()));
}

#[test]
fn peer_with_a_full_queue_is_asked_too() {
    let link_broker = LinkBroker::default();
    let (requester, peer) = (join(&link_broker, 1, 4), join(&link_broker, 2, 0));
    link_broker.introduce(requester.tid, peer.tid, request(1, 1), NOW).unwrap();
    introduction_of(&peer.next(), Kind::LNCL_INTRODUCTION);
    let failed = requester.next();
    assert_eq!((failed.header.correlation, outcome_of(&failed)), (1, Outcome::Failed));
}

#[test]
fn mark_follows_each_class_and_unconfirmed_ones_are_bounded() {
    struct OutcomeSink(SyncSender<Outcome>);
    impl ReceiptSink for OutcomeSink {
        fn settle(&self, _: Ticket, outcome: Outcome) {
            // At the end of this test the receiver is gone.
            let _ = self.0.try_send(outcome);
        }
    }
    let link_broker = LinkBroker::default();
    let peer = join(&link_broker, 2, 1);
    let (sender, outcome) = sync_channel(1);
    let ticket = Ticket { source: tid(1), destination: peer.tid, correlation: 5 };
    let receipt = || Receipt::new(Arc::new(OutcomeSink(sender.clone())), ticket);
    let pass = |to| {
        link_broker.pass_marks(tid(1), to, 7, receipt()).map_err(|(receipt, why)| {
            receipt.settle(Outcome::Rejected(why));
            why
        })
    };
    assert_eq!(pass(peer.tid), Ok(()), "there is room for one, and three are taken");
    let (first, second, mut third) =
        (peer.marks.try_recv().unwrap(), peer.marks.try_recv().unwrap(), peer.marks.try_recv().unwrap());
    assert_eq!(
        [&first, &second, &third].map(|mark| (mark.header.class, mark.header.flags.has(Flags::CONFIRM))),
        [(Class::Control, false), (Class::Stream, false), (Class::Bulk, true)]
    );
    assert_eq!(third.header.correlation, 5);
    third.settle(Outcome::Delivered);
    assert_eq!(outcome.try_recv(), Ok(Outcome::Delivered));
    assert_eq!(pass(tid(9)), Err(Rejection::NoSuchApplication));
    assert_eq!(outcome.try_recv(), Ok(Outcome::Rejected(Rejection::NoSuchApplication)));
    for _ in 0..SWITCHES_MAX {
        assert_eq!(pass(peer.tid), Ok(()));
    }
    assert_eq!(pass(peer.tid), Err(Rejection::QueueFull));
    assert_eq!(outcome.try_recv(), Ok(Outcome::Rejected(Rejection::QueueFull)));
}

/// Returns the numbers of the links for which the client received the end of the peer.
fn reported_ends(client: &Client, departed: Tid) -> Vec<u64> {
    let gone = client.marks.try_iter().filter(|mark| mark.header.kind == Kind::LNCL_GONE);
    gone.map(|mark| payload::read::<Gone>(&mark.payload).unwrap())
        .inspect(|gone| assert_eq!(gone.peer, departed.bits()))
        .map(|gone| gone.number)
        .collect()
}

// spec: LNCL-17
#[test]
fn process_end_is_reported_even_after_a_hang_up() {
    let sleeper = || std::process::Command::new("sleep").arg("600").spawn().unwrap();
    let watch_of =
        |child: &std::process::Child| ProcessWatch::of(i32::try_from(child.id()).unwrap()).unwrap();
    actix_rt::System::new().block_on(async {
        let link_broker = LinkBroker::default();
        let [departed, running, asked] = [1, 2, 3].map(|app| join(&link_broker, app, 4));
        for (from, number) in [(&departed, 7), (&running, 8)] {
            link_broker.introduce(from.tid, asked.tid, request(number, 1), NOW).unwrap();
            asked.next().settle(Outcome::Delivered);
        }
        let [mut ending_process, mut running_process] = [sleeper(), sleeper()];
        let [ended_watch, running_watch] = [watch_of(&ending_process), watch_of(&running_process)];
        // When: both hang up, and the process of one ends.
        link_broker.remove(running.tid, Departure::HungUp(running_watch));
        link_broker.remove(departed.tid, Departure::HungUp(ended_watch));
        ending_process.kill().unwrap();
        // Then: the time allowed for the end of a process is over.
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        let reported = reported_ends(&asked, departed.tid);
        assert!(reported.is_empty() || reported == [7], "{reported:?}");
        running_process.kill().unwrap();
        [ending_process, running_process].iter_mut().for_each(|child| _ = child.wait().unwrap());
        // And: the end of a process that had ended before is reported, however late the check is.
        let [departed] = [4].map(|app| join(&link_broker, app, 4));
        link_broker.introduce(departed.tid, asked.tid, request(9, 1), NOW).unwrap();
        asked.next().settle(Outcome::Delivered);
        link_broker.remove(departed.tid, Departure::HungUp(ProcessWatch::Over));
        for _ in 0..100 {
            tokio::task::yield_now().await;
        }
        assert_eq!(reported_ends(&asked, departed.tid), [9]);
    });
}

// spec: LNCL-17
#[test]
fn process_end_is_reported_once_to_linked_clients_only() {
    // Given: a client linked with two others, as requester and as peer, and one that has refused it.
    let link_broker = LinkBroker::default();
    let [departed, asked, asking, shy] = [1, 2, 3, 4].map(|app| join(&link_broker, app, 4));
    for (from, to, number) in [(&asking, &departed, 8), (&departed, &asked, 7)] {
        link_broker.introduce(from.tid, to.tid, request(number, 1), NOW).unwrap();
        to.next().settle(Outcome::Delivered);
    }
    link_broker.introduce(departed.tid, shy.tid, request(9, 1), NOW).unwrap();
    shy.next().settle(Outcome::Rejected(Rejection::Unsupported));

    // When: its process ends, and another client has its address and ends, too.
    link_broker.remove(departed.tid, Departure::ProcessEnded);
    join(&link_broker, 1, 4);
    link_broker.remove(departed.tid, Departure::ProcessEnded);

    // Then:
    assert_eq!(reported_ends(&asked, departed.tid), [7]);
    assert_eq!(reported_ends(&asking, departed.tid), [8]);
    assert!(reported_ends(&shy, departed.tid).is_empty());
}

#[test]
fn link_outlives_the_connections_of_its_ends() {
    let link_broker = LinkBroker::default();
    let (one, other) = (join(&link_broker, 1, 4), join(&link_broker, 2, 4));
    link_broker.introduce(one.tid, other.tid, request(7, 1), NOW).unwrap();
    other.next().settle(Outcome::Delivered);
    link_broker.remove(one.tid, Departure::LinksRemain);
    assert!(reported_ends(&other, one.tid).is_empty());
}

// spec: LNCL-10
#[test]
fn request_waits_for_a_peers_rings_and_proceeds_then() {
    // Given: a client that requests a link to another that has just registered.
    let link_broker = LinkBroker::default();
    let requester = join(&link_broker, 1, 4);
    link_broker.expect(tid(2), 2);
    link_broker.introduce(requester.tid, tid(2), request(7, 99), NOW).unwrap();
    assert!(requester.frames.try_recv().is_err(), "its rings are being made");

    // When: the rings exist.
    let peer = join(&link_broker, 2, 4);

    // Then: the introduction proceeds.
    let mut message = peer.next();
    assert_eq!(introduction_of(&message, Kind::LNCL_INTRODUCTION).number, 7);
    message.settle(Outcome::Delivered);
    let answer = requester.next();
    assert_eq!(introduction_of(&answer, Kind::LNCL_INTRODUCED).number, 7);
    assert_eq!(answer.header.correlation, 99);
    assert_eq!((requester.end().0, peer.end().0), (7, 7));
}

// spec: LNCL-10
#[test]
fn waiting_requester_is_notified_when_no_link_is_possible() {
    let link_broker = LinkBroker::default();
    let requester = join(&link_broker, 1, 4);
    let late = NOW + unanswered::ANSWERED_WITHIN;
    let ends: [(&dyn Fn(Tid), _); 3] = [
        (&|it| link_broker.expect_no_more(it), Rejection::Unsupported),
        (&|it| link_broker.remove(it, Departure::ProcessEnded), Rejection::Unsupported),
        (&|_| _ = link_broker.expire(late), Rejection::QueueFull),
    ];
    for ((end, why), number) in ends.into_iter().zip(1..) {
        link_broker.expect(tid(2), 2);
        link_broker.introduce(requester.tid, tid(2), request(number, number), NOW).unwrap();
        link_broker.expire(late.shifted(-1));
        assert!(requester.frames.try_recv().is_err(), "there is time yet");
        end(tid(2));
        let answer = requester.next();
        assert_eq!((answer.header.correlation, outcome_of(&answer)), (number, Outcome::Rejected(why)));
    }
    assert!(requester.frames.try_recv().is_err(), "each is notified once");
}

// spec: LNCL-10
#[test]
fn waiting_requests_of_a_process_are_bounded() {
    // Given: two clients that have just registered, and the maximum number of requests of one process.
    let link_broker = LinkBroker::default();
    let requester = join(&link_broker, 1, 4);
    [2, 3].into_iter().for_each(|app| link_broker.expect(tid(app), app));
    let ask = |from, to, number| link_broker.introduce(from, tid(to), request(number, number), NOW);
    for number in 0..unanswered::PROCESS_MAX as u64 {
        assert_eq!(ask(requester.tid, 2, number), Ok(()));
    }
    assert_eq!(ask(requester.tid, 3, 90), Err(Rejection::QueueFull));

    // When: the requester goes, and another one has its address.
    link_broker.remove(requester.tid, Departure::ProcessEnded);
    let next = join(&link_broker, 1, 4);

    // Then: there is room, and the requests of the former client have no effect.
    assert_eq!(ask(next.tid, 3, 91), Ok(()));
    let peer = join(&link_broker, 2, 4);
    assert!(peer.frames.try_recv().is_err(), "no current client has requested it");
    assert!(next.frames.try_recv().is_err());
}

// spec: LNCL-17
#[test]
fn pending_end_reports_for_an_idle_client_are_bounded() {
    // Given: a client with a full queue, which receives its ends from the socket.
    let link_broker = LinkBroker::default();
    let idle = join(&link_broker, 1, 0);
    for round in 0..100 {
        let departed = join(&link_broker, 2, 4);
        link_broker.introduce(idle.tid, departed.tid, request(round, 1), NOW).unwrap();
        departed.next().settle(Outcome::Delivered);
        drop(idle.end());
        link_broker.remove(departed.tid, Departure::ProcessEnded);
    }
    assert_eq!(idle.marks.try_iter().count(), 0);
}
