//! Attacks of a hostile peer on bells that are sockets, besides rings.

use std::{io::IoSlice, mem::MaybeUninit, os::unix::net::UnixStream};

use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, sendmsg};

use super::*;
use crate::wait::Wait;

fn pair() -> (OwnedFd, OwnedFd) {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    socketpair(AddressFamily::UNIX, SocketType::STREAM, flags, None).expect("two sockets")
}

/// Rings with a descriptor beside it.
fn pass(through: &OwnedFd, descriptor: &OwnedFd) -> Result<usize, Errno> {
    pass_by(SendFlags::NOSIGNAL, through, descriptor)
}

fn pass_by(flags: SendFlags, through: &OwnedFd, descriptor: &OwnedFd) -> Result<usize, Errno> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    let descriptors = [descriptor.as_fd()];
    assert!(control.push(SendAncillaryMessage::ScmRights(&descriptors)));
    sendmsg(through, &[IoSlice::new(&[1])], &mut control, flags)
}

/// A descriptor, and the other end, which hangs up when the last copy of the descriptor is closed.
fn witnessed() -> (OwnedFd, OwnedFd) {
    pair()
}

fn nobody_has_the_other_end_of(witness: &OwnedFd) -> bool {
    matches!(recv(witness, &mut [0; 1][..], RecvFlags::DONTWAIT), Ok((_, 0)))
}

#[test]
fn ear_refuses_descriptors_where_supported() {
    let (listener, button) = socket().expect("a bell");
    if listener.peeks {
        return;
    }
    let (given, _witness) = witnessed();
    assert_eq!(pass(&button, &given), Err(Errno::PERM));
    assert_eq!(send(&button, &[1], SendFlags::NOSIGNAL), Ok(1), "it is rung all the same");
}

#[test]
fn ear_with_descriptors_is_not_drained_and_hangs_up() {
    // Given: a system that cannot refuse descriptors.
    let (socket, button) = pair();
    let listener = SocketBell { socket, peeks: true };
    assert_eq!(send(&button, &[1], SendFlags::NOSIGNAL), Ok(1));
    listener.drain();
    assert_eq!(undescribed(&listener.socket, &mut [0; 1]), Some(0), "what is rung is drained");

    // When:
    let (given, witness) = witnessed();
    assert_eq!(pass(&button, &given), Ok(1));
    drop(given);
    listener.drain();

    // Then:
    assert!(!nobody_has_the_other_end_of(&witness), "it was not closed");
    let waiting = Wait::within(Duration::from_secs(10)).begin(Instant::now());
    assert_eq!(listener.sleep(listener.listen(), &waiting).expect("it sleeps"), Woken::HungUp);
}

#[test]
fn sleeper_at_a_word_checks_regularly_without_a_ring() {
    // Given: another peer that undoes each ring by restoring the word.
    let (message, room) = SharedPage::create().expect("a page").bells();
    let (peer, _its_end) = UnixStream::pair().expect("a pair");
    let wait = Wait::within(Duration::from_secs(10)).or_hang_up(HangUp::Socket(peer.as_fd()));
    // Then:
    for bell in [message, room] {
        assert_eq!(bell.sleep(bell.listen(), &wait.begin(Instant::now())).expect("it sleeps"), Woken::Rung);
    }
}

#[test]
fn nonempty_button_is_rejected_and_empty_one_stays_empty() {
    // Given: two buttons that a peer offers and keeps copies of.
    let ((full, full_ear), (empty, empty_ear)) = (pair(), pair());
    let (given, _witness) = witnessed();
    assert_eq!(pass(&full_ear, &given), Ok(1));
    let copy = empty.try_clone().expect("a descriptor");

    // Then:
    assert!(!is_button(&full));
    assert!(is_button(&empty));
    // Whatever the peer does to its copy.
    let _ = set_descriptors(copy.as_fd(), Descriptors::Taken);
    assert_eq!(pass(&empty_ear, &given), Err(Errno::PIPE));
    assert_eq!(send(&empty, &[1], SendFlags::NOSIGNAL), Ok(1), "it can be rung");
    assert_eq!(recv(&empty_ear, &mut [0; 2][..], RecvFlags::DONTWAIT).map(|(_, count)| count), Ok(1));
}

#[test]
fn button_with_an_urgent_byte_is_rejected() {
    let (button, listener) = pair();
    let (given, _witness) = witnessed();
    assert_eq!(pass_by(SendFlags::OOB | SendFlags::NOSIGNAL, &listener, &given), Ok(1));
    let look = RecvFlags::DONTWAIT | RecvFlags::PEEK;
    assert_eq!(recv(&button, &mut [0; 1][..], look).err(), Some(Errno::AGAIN), "a look passes it over");
    assert!(!is_button(&button));
}

#[test]
fn button_that_is_not_a_connected_stream_is_rejected() {
    // Datagram sockets: a datagram may be empty and still carry descriptors.
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let (datagrams, _) =
        socketpair(AddressFamily::UNIX, SocketType::DGRAM, flags, None).expect("two sockets");
    assert!(!is_button(&datagrams));
    // A socket without another end, before it listens and after.
    let alone =
        rustix::net::socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None).expect("a socket");
    assert!(!is_button(&alone));
    let nameless = rustix::net::SocketAddrUnix::new_unnamed();
    rustix::net::bind(&alone, &nameless).expect("the system gives it a name");
    rustix::net::listen(&alone, 1).expect("it listens");
    assert!(!is_button(&alone));
}

#[test]
fn urgent_byte_with_a_descriptor_is_found_before_draining() {
    // Given: a system that cannot refuse descriptors.
    let (SocketBell { socket, .. }, button) = socket().expect("a bell");
    let _ = set_descriptors(socket.as_fd(), Descriptors::Taken);
    let listener = SocketBell { socket, peeks: true };
    let (given, witness) = witnessed();
    // When:
    assert_eq!(pass_by(SendFlags::OOB | SendFlags::NOSIGNAL, &button, &given), Ok(1));
    drop(given);
    assert_eq!(undescribed(&listener.socket, &mut [0; 1]), None);
    listener.drain();
    // Then:
    assert!(!nobody_has_the_other_end_of(&witness), "it was not closed");
}
