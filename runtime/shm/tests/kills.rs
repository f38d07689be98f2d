//! `kill -9` at any instant, again and again, leaves no resources behind. In a process of its own, because
//! the test counts its descriptors.
//!
//! `SINEW_SHM_KILLS=1000 cargo test --release -p sinew-shm --test kills` for the long form.
#![cfg(target_os = "linux")]

#[path = "processes/peer.rs"]
mod peer;

use std::{os::unix::net::UnixStream, time::Duration};

use peer::{BELLS, Connected, Peer, Role, connect, holders, numbered, soon};
use sinew_shm::ReceiveError;

#[test]
#[ignore = "the other process of this test, started by it"]
fn the_other_process() {
    peer::play();
}

#[test]
fn kills_leave_whole_messages_and_no_resources() {
    let kills: u64 = std::env::var("SINEW_SHM_KILLS").map_or(30, |kills| kills.parse().expect("a number"));
    // given
    one(0);
    let before = descriptors();
    let mut seen = 0;
    // when
    for kill in 1..=kills {
        seen += one(kill);
    }
    // then
    assert_eq!(descriptors(), before);
    println!("{kills} kills, {seen} messages, descriptors {before} before and after");
}

/// Runs one peer that is killed at an instant chosen by `seed`. Returns how many of its messages arrived.
fn one(seed: u64) -> u64 {
    let bell = BELLS[(seed % 3) as usize];
    let (ours, theirs) = UnixStream::pair().expect("a pair");
    let mut peer = Peer::start(Role::Sprays, bell, theirs);
    let Connected { mut producer, mut consumer, memory } = connect(bell, &ours);
    peer.has_come_so_far();
    let last_words = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 54;
    let mut number = 0;
    let ended = loop {
        if number == last_words {
            // The duration selects the instant of the kill.
            std::thread::sleep(Duration::from_micros(seed % 7 * 30));
            peer.kill();
        }
        let wait = soon().or_hang_up(peer.hang_up());
        match consumer.receive_before(&wait) {
            Ok(lent) => assert_eq!(lent.to_vec(), numbered(number), "seed {seed}"),
            Err(ended) => break ended,
        }
        number += 1;
        // The peer holds messages too when it dies. A full ring is no fault.
        let _ = producer.send(&[0; 100]);
    };
    assert!(matches!(ended, ReceiveError::HungUp), "seed {seed}: {ended}");
    peer.wait();
    drop((producer, consumer));
    assert_eq!(holders(&memory), Vec::<String>::new(), "seed {seed}");
    number
}

fn descriptors() -> usize {
    std::fs::read_dir("/proc/self/fd").expect("it is there").count()
}
