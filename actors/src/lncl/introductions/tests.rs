//! Two clients, and what each is told.

use std::{
    os::unix::net::UnixStream,
    sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel},
};

use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, recv, recvmsg};
use sinew_runtime::tid::{Incarnation, NodeAddress};

use super::*;
use crate::{
    NodeConfig,
    lncl::{client::life::Life, payload::Gone, server::Server},
    stores::Stores,
};

const NOW: Time = Time::from_nanos(1);

fn question(number: u64, correlation: u64) -> Question {
    Question { number, correlation }
}

struct Queue {
    frames: SyncSender<Message>,
    /// More than are passed.
    marks: SyncSender<Message>,
}

impl Listener for Queue {
    fn submit_mark(&self, mark: Message) -> Result<(), Refused> {
        self.marks.send(mark).map_err(|error| Refused::new(error.0, Rejection::Closed))
    }
}

impl Outlet for Queue {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        self.frames.try_send(message).map_err(|error| match error {
            TrySendError::Full(message) => Refused::new(message, Rejection::QueueFull),
            TrySendError::Disconnected(message) => Refused::new(message, Rejection::Closed),
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

fn join(introductions: &Introductions, app: u32, room: usize) -> Client {
    join_of(introductions, app, app, room)
}

/// A client of the process `pid`.
fn join_of(introductions: &Introductions, app: u32, pid: u32, room: usize) -> Client {
    let ((sender, frames), (marking, marks)) = (sync_channel(room), sync_channel(4 * SWITCHES_MAX));
    let (theirs, socket) = UnixStream::pair().unwrap();
    let party =
        Party::new(tid(app), pid, Arc::new(Queue { frames: sender, marks: marking }), Arc::new(theirs));
    introductions.add(party);
    Client { tid: tid(app), frames, marks, socket }
}

impl Client {
    fn next(&self) -> Message {
        self.frames.try_recv().or_else(|_| self.marks.try_recv()).expect("a frame")
    }

    /// The number and the descriptor that came over the socket.
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
fn both_get_an_end_of_one_socket_and_the_node_keeps_none() {
    let introductions = Introductions::default();
    let (asker, peer) = (join(&introductions, 1, 4), join(&introductions, 2, 4));
    introductions.introduce(asker.tid, peer.tid, question(7, 99), NOW).unwrap();
    let mut message = peer.next();
    let told = introduction_of(&message, Kind::LNCL_INTRODUCTION);
    assert_eq!(told, Introduction { peer: asker.tid.bits(), pid: 1, number: 7 });
    assert!(asker.frames.try_recv().is_err(), "the asker is told when the peer agrees");
    message.settle(Outcome::Delivered);
    let answer = asker.next();
    assert_eq!(answer.header.correlation, 99);
    let told = introduction_of(&answer, Kind::LNCL_INTRODUCED);
    assert_eq!(told, Introduction { peer: peer.tid.bits(), pid: 2, number: 7 });
    let ((own_number, own), (their_number, theirs)) = (asker.end(), peer.end());
    assert_eq!((own_number, their_number), (7, 7));
    rustix::net::send(&own, b"x", SendFlags::empty()).unwrap();
    assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::empty()).unwrap().0, 1);
    drop(own);
    assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::DONTWAIT).unwrap().0, 0, "nobody else has it");
}

#[test]
fn who_is_refused_is_told_so_and_the_peer_sees_the_end_of_the_link() {
    let introductions = Introductions::default();
    let (asker, peer) = (join(&introductions, 1, 4), join(&introductions, 2, 4));
    introductions.introduce(asker.tid, peer.tid, question(7, 99), NOW).unwrap();
    peer.next().settle(Outcome::Rejected(Rejection::QueueFull));
    let answer = asker.next();
    assert_eq!(
        (answer.header.correlation, outcome_of(&answer)),
        (99, Outcome::Rejected(Rejection::QueueFull))
    );
    let (_, theirs) = peer.end();
    assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::DONTWAIT).unwrap().0, 0);
}

#[test]
fn where_the_asker_has_no_room_for_the_answer_the_peer_sees_the_end_of_the_link() {
    let introductions = Introductions::default();
    let (asker, peer) = (join(&introductions, 1, 0), join(&introductions, 2, 4));
    introductions.introduce(asker.tid, peer.tid, question(7, 99), NOW).unwrap();
    let (_, theirs) = peer.end();
    peer.next().settle(Outcome::Delivered);
    // Though the other end lies in the asker's socket.
    assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::DONTWAIT).map(|(count, _)| count), Ok(0));
}

#[test]
fn who_is_not_there_or_oneself_cannot_be_met() {
    let introductions = Introductions::default();
    let asker = join(&introductions, 1, 4);
    assert_eq!(introductions.introduce(asker.tid, tid(3), question(1, 1), NOW), Err(Rejection::Unsupported));
    assert_eq!(
        introductions.introduce(asker.tid, asker.tid, question(1, 1), NOW),
        Err(Rejection::Unsupported)
    );
    let gone = join(&introductions, 2, 4);
    introductions.remove(gone.tid, Leaves::WithItsLinks);
    assert_eq!(
        introductions.introduce(asker.tid, gone.tid, question(1, 1), NOW),
        Err(Rejection::Unsupported)
    );
    assert_eq!(
        introductions.introduce(gone.tid, asker.tid, question(1, 1), NOW),
        Err(Rejection::Unsupported)
    );
}

#[test]
fn a_peer_that_does_not_answer_has_so_many_descriptors_on_their_way_and_no_more() {
    let introductions = Introductions::default();
    let (asker, peer) = (join(&introductions, 1, 64), join(&introductions, 2, 64));
    for number in 0..UNANSWERED_MAX as u64 {
        introductions.introduce(asker.tid, peer.tid, question(number, number), NOW).unwrap();
    }
    assert_eq!(
        introductions.introduce(asker.tid, peer.tid, question(50, 50), NOW),
        Err(Rejection::QueueFull)
    );
    peer.next().settle(Outcome::Delivered);
    assert_eq!(introductions.introduce(asker.tid, peer.tid, question(51, 51), NOW), Ok(()));
}

#[test]
fn an_introduction_that_is_not_answered_in_time_is_given_up_and_the_node_keeps_nothing_of_it() {
    let introductions = Introductions::default();
    let (asker, peer) = (join(&introductions, 1, 64), join(&introductions, 2, 64));
    introductions.introduce(asker.tid, peer.tid, question(7, 99), NOW).unwrap();
    let (_, theirs) = peer.end();
    let late = NOW + unanswered::ANSWERED_WITHIN;
    introductions.give_up(late.shifted(-1));
    assert!(asker.frames.try_recv().is_err(), "there is time yet");
    assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::DONTWAIT), Err(Errno::AGAIN), "the link is there");

    introductions.give_up(late);
    let told = asker.next();
    let not_now = Outcome::Rejected(Rejection::QueueFull);
    assert_eq!((told.header.correlation, outcome_of(&told)), (99, not_now));
    assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::DONTWAIT).unwrap().0, 0, "the link has ended");
    peer.next().settle(Outcome::Delivered);
    assert!(asker.frames.try_recv().is_err(), "it was told already");
}

#[test]
fn what_nobody_answers_is_given_up_by_the_look_that_lncl_takes_at_its_clients() {
    let server = Server::new(Stores::for_test(NodeConfig::new("test"), Incarnation(1)));
    let introductions = &server.introductions;
    let (asker, peer) = (join(introductions, 1, 64), join(introductions, 2, 64));
    introductions.introduce(asker.tid, peer.tid, question(7, 99), NOW).unwrap();
    server.tick(NOW + unanswered::ANSWERED_WITHIN);
    let told = asker.next();
    assert_eq!(outcome_of(&told), Outcome::Rejected(Rejection::QueueFull));
}

#[test]
fn what_was_given_up_and_is_on_its_way_still_counts_for_the_peer() {
    let introductions = Introductions::default();
    let (asker, peer) = (join(&introductions, 1, 64), join(&introductions, 2, 64));
    for number in 0..UNANSWERED_MAX as u64 {
        introductions.introduce(asker.tid, peer.tid, question(number, number), NOW).unwrap();
    }
    let late = NOW + unanswered::ANSWERED_WITHIN;
    introductions.give_up(late);
    assert_eq!(
        introductions.introduce(asker.tid, peer.tid, question(50, 50), late),
        Err(Rejection::QueueFull)
    );
    peer.next().settle(Outcome::Delivered);
    assert_eq!(introductions.introduce(asker.tid, peer.tid, question(51, 51), late), Ok(()));
}

#[test]
fn clients_that_never_answer_cost_the_node_so_many_descriptors_and_leave_others_theirs() {
    // Given: 60 clients of one process that answer nothing, and 16 senders of another.
    let introductions = Introductions::default();
    let silent: Vec<_> = (100..160).map(|app| join_of(&introductions, app, 2, 64)).collect();
    let senders: Vec<_> = (1..17).map(|app| join_of(&introductions, app, 1, 64)).collect();

    // When: each sender wants to meet each of them.
    let pairs = senders.iter().flat_map(|sender| silent.iter().map(move |peer| (sender.tid, peer.tid)));
    let begun = pairs.zip(1..).filter(|&((sender, peer), number)| {
        introductions.introduce(sender, peer, question(number, number), NOW).is_ok()
    });

    // Then: so many are under way, and two others are still introduced to each other.
    assert_eq!(begun.count(), unanswered::PROCESS_MAX);
    let (asker, peer) = (join(&introductions, 30, 4), join(&introductions, 31, 4));
    assert_eq!(introductions.introduce(asker.tid, peer.tid, question(5_000, 5_000), NOW), Ok(()));
}

#[test]
fn a_peer_whose_queue_is_full_is_asked_all_the_same_and_its_end_is_an_answer() {
    let introductions = Introductions::default();
    let (asker, peer) = (join(&introductions, 1, 4), join(&introductions, 2, 0));
    introductions.introduce(asker.tid, peer.tid, question(1, 1), NOW).unwrap();
    introduction_of(&peer.next(), Kind::LNCL_INTRODUCTION);
    let failed = asker.next();
    assert_eq!((failed.header.correlation, outcome_of(&failed)), (1, Outcome::Failed));
}

#[test]
fn a_mark_goes_behind_each_class_whatever_the_bounds_and_so_many_are_unconfirmed_at_most() {
    struct Told(SyncSender<Outcome>);
    impl ReceiptSink for Told {
        fn settle(&self, _: Ticket, outcome: Outcome) {
            // At the end of this test nobody listens.
            let _ = self.0.try_send(outcome);
        }
    }
    let introductions = Introductions::default();
    let peer = join(&introductions, 2, 1);
    let (sender, outcome) = sync_channel(1);
    let ticket = Ticket { source: tid(1), destination: peer.tid, correlation: 5 };
    let receipt = || Receipt::new(Arc::new(Told(sender.clone())), ticket);
    let pass = |to| {
        introductions.pass_marks(tid(1), to, 7, receipt()).map_err(|(receipt, why)| {
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

/// The numbers of the links of which a client is told that their peer is dead.
fn told_dead(client: &Client, dead: Tid) -> Vec<u64> {
    let gone = client.marks.try_iter().filter(|mark| mark.header.kind == Kind::LNCL_GONE);
    gone.map(|mark| payload::read::<Gone>(&mark.payload).unwrap())
        .inspect(|gone| assert_eq!(gone.peer, dead.bits()))
        .map(|gone| gone.number)
        .collect()
}

// spec: LNCL-17
#[test]
fn that_one_who_hung_up_is_dead_is_told_where_its_process_has_ended_too() {
    let sleeper = || std::process::Command::new("sleep").arg("600").spawn().unwrap();
    let life_of = |child: &std::process::Child| Life::of(i32::try_from(child.id()).unwrap()).unwrap();
    actix_rt::System::new().block_on(async {
        let introductions = Introductions::default();
        let [dead, lives, asked] = [1, 2, 3].map(|app| join(&introductions, app, 4));
        for (from, number) in [(&dead, 7), (&lives, 8)] {
            introductions.introduce(from.tid, asked.tid, question(number, 1), NOW).unwrap();
            asked.next().settle(Outcome::Delivered);
        }
        let [mut ends, mut stays] = [sleeper(), sleeper()];
        let [ended, standing] = [life_of(&ends), life_of(&stays)];
        // When: both hang up, and the process of one ends.
        introductions.remove(lives.tid, Leaves::HungUp(standing));
        introductions.remove(dead.tid, Leaves::HungUp(ended));
        ends.kill().unwrap();
        // Then: the time in which a process ends is over.
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        let told = told_dead(&asked, dead.tid);
        assert!(told.is_empty() || told == [7], "{told:?}");
        stays.kill().unwrap();
        [ends, stays].iter_mut().for_each(|child| _ = child.wait().unwrap());
        // And: of one that had ended before it is told, however late anybody looks.
        let [dead] = [4].map(|app| join(&introductions, app, 4));
        introductions.introduce(dead.tid, asked.tid, question(9, 1), NOW).unwrap();
        asked.next().settle(Outcome::Delivered);
        introductions.remove(dead.tid, Leaves::HungUp(Life::Over));
        for _ in 0..100 {
            tokio::task::yield_now().await;
        }
        assert_eq!(told_dead(&asked, dead.tid), [9]);
    });
}

// spec: LNCL-17
#[test]
fn who_has_met_one_that_is_dead_is_told_once_and_nobody_else_is() {
    // Given: one who has met two others, by asking and by being asked, and one who has refused it.
    let introductions = Introductions::default();
    let [dead, asked, asking, shy] = [1, 2, 3, 4].map(|app| join(&introductions, app, 4));
    for (from, to, number) in [(&asking, &dead, 8), (&dead, &asked, 7)] {
        introductions.introduce(from.tid, to.tid, question(number, 1), NOW).unwrap();
        to.next().settle(Outcome::Delivered);
    }
    introductions.introduce(dead.tid, shy.tid, question(9, 1), NOW).unwrap();
    shy.next().settle(Outcome::Rejected(Rejection::Unsupported));

    // When: its process ends, and another one has its address and ends, too.
    introductions.remove(dead.tid, Leaves::Dead);
    join(&introductions, 1, 4);
    introductions.remove(dead.tid, Leaves::Dead);

    // Then:
    assert_eq!(told_dead(&asked, dead.tid), [7]);
    assert_eq!(told_dead(&asking, dead.tid), [8]);
    assert!(told_dead(&shy, dead.tid).is_empty());
}

#[test]
fn a_link_outlives_the_connections_of_those_who_have_it() {
    let introductions = Introductions::default();
    let (one, other) = (join(&introductions, 1, 4), join(&introductions, 2, 4));
    introductions.introduce(one.tid, other.tid, question(7, 1), NOW).unwrap();
    other.next().settle(Outcome::Delivered);
    introductions.remove(one.tid, Leaves::WithItsLinks);
    assert!(told_dead(&other, one.tid).is_empty());
}

// spec: LNCL-10
#[test]
fn one_whose_rings_are_being_made_is_waited_for_and_met_when_they_are() {
    // Given: one who asks for another that has just registered.
    let introductions = Introductions::default();
    let asker = join(&introductions, 1, 4);
    introductions.expect(tid(2), 2);
    introductions.introduce(asker.tid, tid(2), question(7, 99), NOW).unwrap();
    assert!(asker.frames.try_recv().is_err(), "its rings are being made");

    // When: they are there.
    let peer = join(&introductions, 2, 4);

    // Then: the introduction takes its way.
    let mut message = peer.next();
    assert_eq!(introduction_of(&message, Kind::LNCL_INTRODUCTION).number, 7);
    message.settle(Outcome::Delivered);
    let answer = asker.next();
    assert_eq!(introduction_of(&answer, Kind::LNCL_INTRODUCED).number, 7);
    assert_eq!(answer.header.correlation, 99);
    assert_eq!((asker.end().0, peer.end().0), (7, 7));
}

// spec: LNCL-10
#[test]
fn who_waits_for_one_that_will_have_no_links_or_goes_or_takes_too_long_is_told() {
    let introductions = Introductions::default();
    let asker = join(&introductions, 1, 4);
    let late = NOW + unanswered::ANSWERED_WITHIN;
    let ends: [(&dyn Fn(Tid), _); 3] = [
        (&|it| introductions.expect_no_more(it), Rejection::Unsupported),
        (&|it| introductions.remove(it, Leaves::Dead), Rejection::Unsupported),
        (&|_| introductions.give_up(late), Rejection::QueueFull),
    ];
    for ((end, why), number) in ends.into_iter().zip(1..) {
        introductions.expect(tid(2), 2);
        introductions.introduce(asker.tid, tid(2), question(number, number), NOW).unwrap();
        introductions.give_up(late.shifted(-1));
        assert!(asker.frames.try_recv().is_err(), "there is time yet");
        end(tid(2));
        let told = asker.next();
        assert_eq!((told.header.correlation, outcome_of(&told)), (number, Outcome::Rejected(why)));
    }
    assert!(asker.frames.try_recv().is_err(), "each is told once");
}

// spec: LNCL-10
#[test]
fn so_many_of_one_process_wait_for_those_whose_rings_are_being_made_and_who_has_gone_does_not() {
    // Given: two that have just registered, and as many questions as one process may have.
    let introductions = Introductions::default();
    let asker = join(&introductions, 1, 4);
    [2, 3].into_iter().for_each(|app| introductions.expect(tid(app), app));
    let ask = |from, to, number| introductions.introduce(from, tid(to), question(number, number), NOW);
    for number in 0..unanswered::PROCESS_MAX as u64 {
        assert_eq!(ask(asker.tid, 2, number), Ok(()));
    }
    assert_eq!(ask(asker.tid, 3, 90), Err(Rejection::QueueFull));

    // When: the asker goes, and another one has its address.
    introductions.remove(asker.tid, Leaves::Dead);
    let next = join(&introductions, 1, 4);

    // Then: there is room, and what its former life has asked for comes to nothing.
    assert_eq!(ask(next.tid, 3, 91), Ok(()));
    let peer = join(&introductions, 2, 4);
    assert!(peer.frames.try_recv().is_err(), "nobody who is there has asked for it");
    assert!(next.frames.try_recv().is_err());
}

// spec: LNCL-17
#[test]
fn who_takes_nothing_is_not_owed_the_deaths_of_more_and_more_whom_it_has_asked_for() {
    // Given: one whose queue takes nothing, and who takes its ends from the socket.
    let introductions = Introductions::default();
    let deaf = join(&introductions, 1, 0);
    for round in 0..100 {
        let dead = join(&introductions, 2, 4);
        introductions.introduce(deaf.tid, dead.tid, question(round, 1), NOW).unwrap();
        dead.next().settle(Outcome::Delivered);
        drop(deaf.end());
        introductions.remove(dead.tid, Leaves::Dead);
    }
    assert_eq!(deaf.marks.try_iter().count(), 0);
}
