//! Two processes, one of which may end at any time.
#![cfg(target_os = "linux")]

mod peer;

use std::os::unix::net::UnixStream;

use peer::{BELLS, Peer, Role, connect, holders, numbered, soon};
use sinew_shm::{LoanError, ReceiveError, RoomError};

#[test]
#[ignore = "the other process of these tests, started by them"]
fn the_other_process() {
    peer::play();
}

#[test]
fn messages_make_round_trips_with_every_bell() {
    for bell in BELLS {
        let (ours, theirs) = UnixStream::pair().expect("a pair");
        let peer = Peer::start(Role::Echo, bell, theirs);
        let mut connected = connect(bell, &ours);
        let wait = soon().or_hang_up(peer.hang_up());
        for number in 0..500 {
            let sent = numbered(number);
            connected.producer.send(&sent).expect("one at a time");
            let back = connected.consumer.receive_before(&wait).expect("it echoes");
            assert_eq!(back.to_vec(), sent, "{bell} {number}");
        }
    }
}

#[test]
fn process_killed_with_a_loan_leaves_no_memory() {
    for bell in BELLS {
        // given
        let (ours, theirs) = UnixStream::pair().expect("a pair");
        let mut peer = Peer::start(Role::HoldsLoan, bell, theirs);
        let mut connected = connect(bell, &ours);
        peer.has_come_so_far();
        assert!(!holders(&connected.memory).is_empty(), "otherwise nothing is looked for");
        // when
        peer.kill();
        // then
        let wait = soon().or_hang_up(peer.hang_up());
        let before = connected.consumer.receive_before(&wait).expect("it was published");
        assert_eq!(before.to_vec(), b"before");
        drop(before);
        let after = connected.consumer.receive_before(&wait).map(|lent| lent.to_vec());
        assert!(matches!(after, Err(ReceiveError::HungUp)), "{bell}: {after:?}");
        peer.wait();
        let memory = std::mem::take(&mut connected.memory);
        drop(connected);
        assert_eq!(holders(&memory), Vec::<String>::new(), "{bell}");
    }
}

#[test]
fn process_killed_with_a_message_ends_the_wait() {
    for bell in BELLS {
        // given: a ring filled behind a message that is not released
        let (ours, theirs) = UnixStream::pair().expect("a pair");
        let mut peer = Peer::start(Role::HoldsMessage, bell, theirs);
        let mut connected = connect(bell, &ours);
        connected.producer.send(&[1; 1000]).expect("an empty ring");
        peer.has_come_so_far();
        while !matches!(connected.producer.send(&[2; 1000]), Err(LoanError::Full { .. })) {}
        // when
        peer.kill();
        // then
        let wait = soon().or_hang_up(peer.hang_up());
        let room = connected.producer.loan_before(1000, &wait).map(drop);
        assert!(matches!(room, Err(RoomError::HungUp)), "{bell}: {room:?}");
        peer.wait();
        let memory = std::mem::take(&mut connected.memory);
        drop(connected);
        assert_eq!(holders(&memory), Vec::<String>::new(), "{bell}");
    }
}

#[test]
fn producer_killed_while_sending_is_noticed() {
    for bell in BELLS {
        // given: two other processes, connected with each other
        let (here, there) = UnixStream::pair().expect("a pair");
        let mut sprays = Peer::start(Role::Sprays, bell, here);
        let mut counts = Peer::start(Role::Counts, bell, there);
        counts.has_come_so_far();
        // when
        sprays.kill();
        // then: it saw whole messages in order, and the end
        assert!(counts.wait().success(), "{bell}");
    }
}
