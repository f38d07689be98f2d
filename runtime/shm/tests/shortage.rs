//! A process without free descriptors. The only test of its process: the limit applies to all threads.
#![cfg(target_os = "linux")]

use std::{fs::File, io, os::unix::net::UnixStream};

use rustix::{
    io::Errno,
    process::{Resource, Rlimit, getrlimit, setrlimit},
};
use sinew_shm::{BellKind, Capacity, Offer, PassError, Received, Region};

/// More than an idle process has.
const FEW: u64 = 64;

#[test]
fn offer_without_free_descriptors_stays_until_there_are_some() {
    // Given: an offer in flight, and a process that has all descriptors that it may have.
    let (left, right) = UnixStream::pair().expect("a pair");
    let (region, offer) = Region::create(Capacity::MIN, BellKind::Socket).expect("a region");
    offer.send(&left).expect("room");
    drop((region, offer));
    let usual = getrlimit(Resource::Nofile);
    setrlimit(Resource::Nofile, Rlimit { current: Some(FEW), ..usual }).expect("it may be lowered");
    let mut all: Vec<File> = Vec::new();
    let full = loop {
        match File::open("/dev/null") {
            Ok(one) => all.push(one),
            Err(full) => break full,
        }
    };
    let is_full = |error: &io::Error| error.raw_os_error() == Some(Errno::MFILE.raw_os_error());
    assert!(is_full(&full), "{full}");
    // When: it is received with room for some of its descriptors and their copies, but not for all.
    for room in 0..2 * Offer::DESCRIPTORS_MAX {
        // Then:
        match Received::receive(&right) {
            Err(PassError::System(error)) if is_full(&error) => {}
            other => panic!("with room for {room}: {other:?}"),
        }
        all.pop().expect("there are more");
    }
    // When: there is room for all. Then: it is whole.
    let mut received = Received::receive(&right).expect("there is room");
    assert_eq!(received.copies().len(), Offer::DESCRIPTORS_MAX);
    received.into_offer().expect("it is an offer");
}
