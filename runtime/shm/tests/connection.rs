//! Two sides in one process, over real sealed memory: the connection as a user sees it.
#![cfg(target_os = "linux")]

use std::{
    io::Read,
    os::{
        fd::{AsFd, OwnedFd},
        unix::net::UnixStream,
    },
    sync::mpsc::sync_channel,
    thread,
    time::{Duration, Instant},
};

use sinew_shm::{
    Armed, BellKind, Capacity, Consumer, HangUp, LoanError, Offer, OfferError, Only, PassError, Producer,
    ReceiveError, Region, RoomError, Spin, Terms, Wait,
};

const BELLS: [BellKind; 3] = [BellKind::Futex, BellKind::EventFd, BellKind::Socket];

fn terms() -> Terms {
    Terms { bells: BELLS.to_vec(), ..Terms::default() }
}

/// One direction of a connection; the ends of the other one are returned too, as a connection lives as long
/// as its parts.
fn pair(capacity: u64, bell: BellKind) -> (Producer, Consumer, (Consumer, Producer)) {
    let capacity = Capacity::new(capacity).expect("a power of two");
    let (left, left_offer) = Region::create(capacity, bell).expect("a region");
    let (right, right_offer) = Region::create(capacity, bell).expect("a region");
    let (producer, left_consumer) = left.connect(right_offer, &terms()).expect("an honest offer");
    let (right_producer, consumer) = right.connect(left_offer, &terms()).expect("an honest offer");
    (producer, consumer, (left_consumer, right_producer))
}

fn soon() -> Wait<'static> {
    Wait::until(Instant::now() + Duration::from_secs(20))
}

#[test]
fn messages_arrive_whole_and_in_order() {
    for bell in BELLS {
        for spin in [
            Spin::Off,
            Spin::For(Duration::from_micros(20)),
            Spin::Adaptive { max: Duration::from_micros(50) },
        ] {
            // given: a ring that wraps every few messages
            let (mut producer, mut consumer, _rest) = pair(4096, bell);
            producer.set_spin(spin);
            consumer.set_spin(spin);
            let lengths = || (0..3_000_usize).map(|number| number * 7919 % 2041);
            let sending = thread::spawn(move || {
                for (number, length) in lengths().enumerate() {
                    let mut loan = producer.loan_before(length, &soon()).expect("room in time");
                    loan.fill(number as u8);
                    loan.publish();
                }
                producer
            });
            // when, then
            for (number, length) in lengths().enumerate() {
                let lent = consumer.receive_before(&soon()).expect("a message in time");
                assert_eq!(lent.to_vec(), vec![number as u8; length], "{bell} {spin:?} {number}");
            }
            let producer = sending.join().expect("no panic");
            assert_eq!((producer.corrupt(), consumer.receive().expect("honest").is_none()), (None, true));
        }
    }
}

#[test]
fn loan_is_invisible_until_it_is_published() {
    let (mut producer, mut consumer, _rest) = pair(4096, BellKind::Futex);
    // given: one dropped, one cut short, one set aside
    producer.loan(100).expect("room").fill(1);
    let mut loan = producer.loan(100).expect("room");
    loan[..3].copy_from_slice(b"abc");
    loan.truncate(3);
    loan.truncate(50);
    loan.publish();
    let mut loan = producer.loan(2).expect("room");
    loan.copy_from_slice(b"xy");
    loan.set_aside();
    // then
    assert_eq!(consumer.receive().expect("honest").expect("published").to_vec(), b"abc");
    assert!(consumer.receive().expect("honest").is_none());
    // when
    producer.resume().expect("it was set aside").publish();
    assert!(producer.resume().is_none());
    // then
    assert_eq!(consumer.receive().expect("honest").expect("published").to_vec(), b"xy");
}

#[test]
fn message_is_lent_again_until_its_loan_ends() {
    let (mut producer, mut consumer, _rest) = pair(4096, BellKind::Futex);
    producer.send(b"once").expect("room");
    std::mem::forget(consumer.receive().expect("honest"));
    assert_eq!(consumer.receive().expect("honest").expect("not released").to_vec(), b"once");
    assert!(consumer.receive().expect("honest").is_none());
}

#[test]
fn message_is_read_in_pieces_from_any_offset() {
    let (mut producer, mut consumer, _rest) = pair(4096, BellKind::Futex);
    let sent: Vec<u8> = (0..=255).collect();
    producer.send(&sent).expect("room");
    let lent = consumer.receive().expect("honest").expect("published");
    let (mut three, mut rest, mut all) = ([0; 3], Vec::new(), vec![9]);
    let mut reader = lent.reader();
    reader.read_exact(&mut three).expect("256 bytes are there");
    reader.read_to_end(&mut rest).expect("it does not fail");
    lent.append_to(&mut all);
    assert_eq!((&three[..], &rest[..]), (&sent[..3], &sent[3..]));
    assert_eq!((all[0], &all[1..]), (9, &sent[..]));
    assert_eq!((lent.copy_at(250, &mut [0; 9]), lent.copy_at(256, &mut [0; 9]), lent.len()), (6, 0, 256));
}

#[test]
fn full_ring_reports_the_room_that_is_left() {
    let (mut producer, mut consumer, _rest) = pair(4096, BellKind::Futex);
    assert_eq!((producer.payload_max(), consumer.payload_max()), (2040, 2040));
    assert_eq!(producer.loan(2041).map(drop), Err(LoanError::TooLong { asked: 2041, max: 2040 }));
    // given
    producer.send(&[0; 2040]).expect("an empty ring");
    producer.send(&[0; 1000]).expect("room");
    // then
    assert_eq!(producer.loan(2000).map(drop), Err(LoanError::Full { asked: 2000, free: 1032 }));
    producer.send(&[0; 1032]).expect("what it said");
    assert_eq!(producer.loan(0).map(drop), Err(LoanError::Full { asked: 0, free: 0 }));
    // when
    drop(consumer.receive().expect("honest").expect("published"));
    // then
    producer.send(&[0; 2040]).expect("room again");
}

#[test]
fn wait_ends_at_its_deadline_with_every_bell() {
    let max = Duration::from_secs(60);
    for (bell, spin) in BELLS
        .into_iter()
        .flat_map(|bell| [Spin::Off, Spin::For(max), Spin::Adaptive { max }].map(|spin| (bell, spin)))
    {
        let (mut producer, mut consumer, _rest) = pair(4096, bell);
        producer.set_spin(spin);
        consumer.set_spin(spin);
        let wait = || Wait::until(Instant::now() + Duration::from_millis(30));
        let start = Instant::now();
        assert!(matches!(consumer.receive_before(&wait()), Err(ReceiveError::TimedOut)), "{bell}");
        assert!(start.elapsed() >= Duration::from_millis(30), "not before: {bell}");
        producer.send(&[0; 2040]).expect("room");
        producer.send(&[0; 2040]).expect("room");
        let began_to_send = Instant::now();
        assert!(matches!(producer.loan_before(1, &wait()), Err(RoomError::TimedOut)), "{bell}");
        assert!(began_to_send.elapsed() >= Duration::from_millis(30), "not before: {bell}");
        assert!(matches!(producer.loan_before(9999, &wait()), Err(RoomError::TooLong { .. })), "{bell}");
        assert!(start.elapsed() < max, "the look went on beyond the deadline: {bell}, {spin:?}");
    }
}

#[test]
fn sleeper_is_woken_by_message_and_by_room() {
    for bell in BELLS {
        let (mut producer, mut consumer, _rest) = pair(4096, bell);
        let (asleep, was_asleep) = sync_channel(0);
        let receiving = thread::spawn(move || {
            for _ in 0..50 {
                asleep.send(()).expect("the test waits");
                // The return is the claim: without a wake this times out.
                assert_eq!(consumer.receive_before(&soon()).expect("woken").to_vec(), [5; 2040]);
            }
        });
        for _ in 0..50 {
            was_asleep.recv().expect("the receiver lives");
            producer.loan_before(2040, &soon()).expect("woken for room").fill(5);
            producer.send(&[5; 2040]).expect("given back just now");
        }
        receiving.join().expect("every wait ended with a message");
    }
}

#[test]
fn reactor_is_notified_and_never_sleeps_on_a_message() {
    for bell in [BellKind::EventFd, BellKind::Socket] {
        let (mut producer, mut consumer, _rest) = pair(4096, bell);
        let readable = |fd: std::os::fd::BorrowedFd<'_>| {
            let mut fds = [rustix::event::PollFd::from_borrowed_fd(fd, rustix::event::PollFlags::IN)];
            rustix::event::poll(&mut fds, Some(&rustix::fs::Timespec { tv_sec: 0, tv_nsec: 0 }))
                .expect("poll")
                == 1
        };
        // when no side sleeps, then no ring
        producer.send(b"1").expect("room");
        assert!(!readable(consumer.fd().expect("it has one")));
        assert_eq!(consumer.arm().expect("honest"), Armed::Ready);
        drop(consumer.receive().expect("honest").expect("published"));
        // when armed, then rung once
        assert_eq!(consumer.arm().expect("honest"), Armed::Sleep);
        producer.send(b"2").expect("room");
        producer.send(b"3").expect("room");
        assert!(readable(consumer.fd().expect("it has one")), "{bell}");
        consumer.disarm();
        assert!(!readable(consumer.fd().expect("it has one")), "{bell}");
        // the same for room
        producer.send(&[0; 2000]).expect("room");
        producer.send(&[0; 1900]).expect("room");
        assert_eq!(producer.arm(2000).expect("honest"), Armed::Sleep);
        while consumer.receive().expect("honest").is_some() {}
        assert!(readable(producer.fd().expect("it has one")), "{bell}");
        producer.disarm();
        assert_eq!(producer.arm(2000).expect("honest"), Armed::Ready);
    }
    assert!(pair(4096, BellKind::Futex).1.fd().is_none());
}

#[test]
fn departed_peer_is_noticed_after_its_last_message() {
    for bell in BELLS {
        // given
        let (mut producer, mut consumer, rest) = pair(4096, bell);
        let (ours, theirs) = UnixStream::pair().expect("a pair");
        producer.send(b"last words").expect("room");
        // when
        drop((producer, rest, theirs));
        // then
        let wait = soon().or_hang_up(HangUp::Socket(ours.as_fd()));
        assert_eq!(consumer.receive_before(&wait).expect("still there").to_vec(), b"last words");
        assert!(matches!(consumer.receive_before(&wait), Err(ReceiveError::HungUp)), "{bell}");
    }
}

#[test]
fn offer_passes_over_a_socket() {
    for bell in BELLS {
        // given
        let (left, right) = UnixStream::pair().expect("a pair");
        let (here, offer) = Region::create(Capacity::MIN, bell).expect("a region");
        offer.send(&left).expect("an empty socket");
        drop(offer);
        // when: the other side receives it and answers with its own
        let taken = Offer::receive(&right).expect("whole").expect("an offer");
        assert_eq!((taken.capacity(), taken.bell()), (Capacity::MIN, bell));
        let (there, answer) = Region::create(Capacity::MIN, bell).expect("a region");
        answer.send(&right).expect("an empty socket");
        let answer = Offer::receive(&left).expect("whole").expect("an offer");
        // then
        let (mut producer, _consumer) = here.connect(answer, &terms()).expect("honest");
        let (_producer, mut consumer) = there.connect(taken, &terms()).expect("honest");
        producer.send(b"through").expect("room");
        assert_eq!(consumer.receive().expect("honest").expect("published").to_vec(), b"through");
    }
}

#[test]
fn incomplete_offer_is_rejected() {
    use std::io::Write;
    let (mut left, right) = UnixStream::pair().expect("a pair");
    left.write_all(b"SINEWSHM").expect("room");
    assert!(matches!(
        Offer::receive(&right),
        Err(PassError::Broken { bytes: 8, descriptors: 0, cut: false })
    ));
    // It was left there, and has an offer's length with the bytes that arrive now.
    left.write_all(&[0; 16]).expect("room");
    assert!(matches!(Offer::receive(&right), Ok(Err(OfferError::Capacity(0) | OfferError::Version { .. }))));
    let (_region, offer) = Region::create(Capacity::MIN, BellKind::Socket).expect("a region");
    left.write_all(&offer.to_bytes()).expect("room");
    let refused = Offer::receive(&right).expect("whole").expect_err("without its descriptors");
    assert!(matches!(refused, OfferError::Descriptors { got: 0, expected: 3 }), "{refused}");
    drop(left);
    assert!(matches!(Offer::receive(&right), Err(PassError::Closed)));
}

#[test]
fn message_with_too_many_descriptors_stays_in_the_socket() {
    use std::{io::IoSlice, mem::MaybeUninit, os::fd::AsFd};

    use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg};

    let (left, right) = UnixStream::pair().expect("a pair");
    let (_region, offer) = Region::create(Capacity::MIN, BellKind::Socket).expect("a region");
    let pass = |count| {
        let descriptors = vec![left.as_fd(); count];
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(253))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        assert!(control.push(SendAncillaryMessage::ScmRights(&descriptors)), "room for 253");
        sendmsg(&left, &[IoSlice::new(&offer.to_bytes())], &mut control, SendFlags::empty()).expect("room");
    };
    for count in [Offer::DESCRIPTORS_MAX + 1, 253] {
        pass(count);
        // Each time: nothing of it is read.
        for _ in 0..2 {
            let broken = Offer::receive(&right).expect_err("too many");
            assert!(
                matches!(broken, PassError::Broken { bytes: 24, descriptors: 3..=6, cut: true }),
                "{broken}"
            );
        }
        let taken = rustix::net::recv(&right, &mut [0; 64][..], rustix::net::RecvFlags::DONTWAIT);
        assert_eq!(taken.expect("still there").0, 24);
    }
    pass(Offer::DESCRIPTORS_MAX);
    let mut received = sinew_shm::Received::receive(&right).expect("as many as an offer has");
    assert_eq!(received.copies().len(), Offer::DESCRIPTORS_MAX);
    assert!(received.into_offer().is_ok(), "what they are is looked at later");
}

#[test]
fn terms_bound_a_peers_offers() {
    // given
    let region = || Region::create(Capacity::MIN, BellKind::Futex).expect("a region").0;
    let offer = |capacity, bell| Region::create(capacity, bell).expect("a region").1;
    let small = Terms { capacity_max: Capacity::MIN, ..Terms::default() };
    let larger = Capacity::new(8192).expect("a power of two");
    // when, then
    let refused = region().connect(offer(larger, BellKind::Futex), &small).expect_err("too large");
    assert!(matches!(refused, OfferError::TooLarge { offered, .. } if offered == larger));
    let refused =
        region().connect(offer(Capacity::MIN, BellKind::EventFd), &small).expect_err("it could block");
    assert!(matches!(refused, OfferError::Bell(BellKind::EventFd)));
}

#[test]
fn descriptor_that_is_no_bell_is_rejected() {
    for bell in [BellKind::EventFd, BellKind::Socket] {
        let (_theirs, offer) = Region::create(Capacity::MIN, bell).expect("a region");
        let null = || OwnedFd::from(std::fs::File::open("/dev/null").expect("it is there"));
        let memory = offer.descriptors()[0].try_clone().expect("a descriptor");
        let forged =
            Offer::from_parts(&offer.to_bytes(), vec![memory, null(), null()]).expect("it looks like one");
        let (region, _) = Region::create(Capacity::MIN, bell).expect("a region");
        let refused = region.connect(forged, &terms()).expect_err("no bell");
        assert!(matches!(refused, OfferError::NotABell(kind) if kind == bell), "{refused}");
    }
}

/// The reason why [`BellKind::EventFd`] is for trusted peers only. The system's behaviour, not this
/// package's.
#[test]
fn full_eventfd_blocks_its_ringer_but_a_socket_never() {
    use rustix::fs::{OFlags, fcntl_setfl};
    let (_theirs, offer) = Region::create(Capacity::MIN, BellKind::EventFd).expect("a region");
    let bell = offer.descriptors()[1].try_clone().expect("a descriptor");
    fcntl_setfl(&bell, OFlags::empty()).expect("flags are shared by all who have it");
    rustix::io::write(&bell, &(u64::MAX - 1).to_ne_bytes()).expect("it was empty");
    let (done, is_done) = sync_channel(1);
    let shared = bell.try_clone().expect("a descriptor");
    let ringing = thread::spawn(move || {
        let written = rustix::io::write(&shared, &1_u64.to_ne_bytes());
        done.send(written).expect("the test waits");
    });
    assert!(is_done.recv_timeout(Duration::from_millis(100)).is_err(), "it blocks");
    rustix::io::read(&bell, &mut [0; 8]).expect("it was full");
    assert!(is_done.recv().expect("it goes on").is_ok());
    ringing.join().expect("no panic");
    // A socket: never drained, made blocking by the peer, rung ten thousand times.
    let (mut producer, mut consumer, _rest) = pair(4096, BellKind::Socket);
    fcntl_setfl(consumer.fd().expect("it has one"), OFlags::empty()).expect("its own end");
    for _ in 0..10_000 {
        assert_eq!(consumer.arm().expect("honest"), Armed::Sleep);
        producer.send(b"!").expect("room");
        drop(consumer.receive().expect("honest").expect("published"));
    }
}

#[test]
fn only_message_is_received_and_others_are_left() {
    let (mut producer, mut consumer, _rest) = pair(4096, BellKind::Futex);
    assert!(matches!(consumer.receive_only(), Only::Nothing));
    producer.send(&[1]).expect("room");
    match consumer.receive_only() {
        Only::Message(message) => message.leave(),
        other @ (Only::Nothing | Only::Other) => panic!("one message is there, not {other:?}"),
    }
    match consumer.receive_only() {
        Only::Message(message) => assert_eq!(message.to_vec(), [1], "it was left"),
        other @ (Only::Nothing | Only::Other) => panic!("one message is there, not {other:?}"),
    }
    assert!(matches!(consumer.receive_only(), Only::Nothing), "it was taken");
    for number in [2, 3] {
        producer.send(&[number]).expect("room");
    }
    assert!(matches!(consumer.receive_only(), Only::Other), "there are two");
    assert_eq!(consumer.receive().expect("an honest peer").expect("a message").to_vec(), [2]);
    assert!(matches!(consumer.receive_only(), Only::Message(message) if message.to_vec() == [3]));
}

/// A reactor that is edge-triggered reads no ring, and the rings must not fill the socket.
#[test]
fn reported_rings_never_fill_a_bell() {
    let (mut producer, mut consumer, _rest) = pair(4096, BellKind::Socket);
    for round in 0..1_000 {
        assert_eq!(consumer.arm().expect("an honest peer"), Armed::Sleep);
        producer.send(&[0]).expect("room");
        consumer.disarm_reported();
        drop(consumer.receive().expect("an honest peer").expect("a message"));
        let fd = consumer.fd().expect("a socket");
        let rings = rustix::io::ioctl_fionread(fd).expect("a count");
        assert!(rings <= 32, "{rings} after round {round}");
    }
}
