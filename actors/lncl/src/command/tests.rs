//! The place of a command, with a played connection.

use std::{
    pin::pin,
    sync::atomic::AtomicBool,
    task::{Context, Waker},
};

use bytes::Bytes;
use sinew_runtime::{
    tid::AppAddress,
    wire::{Class, Header},
};

use super::*;

const KNEE: ClientId = ClientId(7);
const STRAY: ClientId = ClientId(8);
const GROUP: i32 = 4_711;

/// A connection that takes all messages while it is free.
#[derive(Default)]
struct PlayedQueue {
    is_full: AtomicBool,
    is_to_continue: AtomicBool,
    taken: Mutex<Vec<u64>>,
}

impl MessageSink for PlayedQueue {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        lock(&self.taken).push(message.header.sequence);
        Ok(())
    }
}

impl HandOver for PlayedQueue {
    fn is_free(&self) -> bool {
        !self.is_full.load(Ordering::Relaxed)
    }

    fn reading(&self) -> Reading {
        Reading { mark: (lock(&self.taken).len() as u64, 0), unread: Some(0), leaves_some: false }
    }

    fn continue_later(&self) {
        self.is_to_continue.store(true, Ordering::Relaxed);
    }
}

fn message(sequence: u64) -> Message {
    let mut header = Header::new(Kind::named("test"), Tid::NONE, Tid::NONE);
    (header.class, header.sequence) = (Class::Bulk, sequence);
    Message::new(header, Bytes::new())
}

fn port() -> Arc<CommandPort> {
    CommandPort::new("knee", Mailbox::new(8), false)
}

#[test]
fn only_the_present_group_has_the_name() {
    let port = port();
    assert_eq!(port.claim(KNEE, 1, Some(GROUP)), Err(ClaimError::Stray(1)), "no process was started");
    let first = port.begin(GROUP);
    for group in [None, Some(GROUP + 1)] {
        assert_eq!(port.claim(STRAY, 2, group), Err(ClaimError::Stray(2)));
    }
    assert_eq!(port.claim(KNEE, 3, Some(GROUP)), Ok(()));
    assert_eq!(port.claim(STRAY, 4, Some(GROUP)), Err(ClaimError::Taken), "one address has one connection");
    // When: the process has ended, and the node has not noticed the end of its connection yet
    let second = port.begin(GROUP + 1);
    port.end(first);
    assert_eq!(port.claim(STRAY, 5, Some(GROUP + 1)), Ok(()));
    assert!(!port.release(KNEE) && port.is_held_by(STRAY), "the former connection takes nothing along");
    port.end(second);
    assert_eq!(port.claim(KNEE, 6, Some(GROUP + 1)), Err(ClaimError::Stray(6)), "it has ended");
}

#[test]
fn messages_wait_in_order_for_the_next_process() {
    let (port, first, second) = (port(), Arc::new(PlayedQueue::default()), Arc::new(PlayedQueue::default()));
    port.submit(message(1)).unwrap();
    let process = port.begin(GROUP);
    port.claim(KNEE, 1, Some(GROUP)).unwrap();
    assert!(port.open(KNEE, first.clone()) && !port.open(STRAY, second.clone()));
    port.submit(message(2)).unwrap();
    first.is_full.store(true, Ordering::Relaxed);
    (3..=4).for_each(|number| port.submit(message(number)).unwrap());
    assert_eq!(*lock(&first.taken), [1, 2], "its connection has no room for more");
    port.end(process);
    port.submit(message(5)).unwrap();
    port.begin(GROUP);
    port.claim(STRAY, 1, Some(GROUP)).unwrap();
    port.open(STRAY, second.clone());
    assert_eq!((lock(&first.taken).len(), &**lock(&second.taken)), (2, &[3, 4, 5][..]));
}

#[test]
fn presence_follows_the_registered_process() {
    let port = port();
    let presence = port.presence();
    let is = |state| assert_eq!(*presence.borrow(), state);
    is(Presence::Absent);
    port.begin(GROUP);
    port.claim(KNEE, 1, Some(GROUP)).unwrap();
    is(Presence::Absent);
    assert_eq!(port.signs(), None);
    port.open(KNEE, Arc::new(PlayedQueue::default()));
    is(Presence::Registered);
    port.ready(STRAY);
    is(Presence::Registered);
    port.ready(KNEE);
    is(Presence::Ready);
    port.release(KNEE);
    is(Presence::Absent);
}

#[test]
fn frames_of_a_program_are_signs_of_life() {
    let (port, queue) = (port(), Arc::new(PlayedQueue::default()));
    let own = Tid::new(sinew_runtime::tid::NodeAddress::new(1), AppAddress::new(0x1001));
    port.begin(GROUP);
    port.claim(KNEE, 1, Some(GROUP)).unwrap();
    port.open(KNEE, queue.clone());
    let before = port.signs().unwrap();
    port.probe(own);
    port.on_frame();
    let after = port.signs().unwrap();
    assert_eq!((after.frames, after.reading.mark), (before.frames + 1, (1, 0)));
}

#[test]
fn reply_of_a_former_process_is_dropped() {
    let (port, queue) = (port(), Arc::new(PlayedQueue::default()));
    let reply = || {
        let mut reply = message(9);
        reply.header.flags = reply.header.flags.with(Flags::REPLY);
        reply
    };
    port.submit(reply()).unwrap();
    port.begin(GROUP);
    port.claim(KNEE, 1, Some(GROUP)).unwrap();
    port.open(KNEE, queue.clone());
    assert!(lock(&queue.taken).is_empty());
    port.submit(reply()).unwrap();
    assert_eq!(*lock(&queue.taken), [9]);
}

#[test]
fn process_is_retired_when_its_connection_has_ended() {
    let (port, queue) = (port(), Arc::new(PlayedQueue::default()));
    let process = port.begin(GROUP);
    port.claim(KNEE, 1, Some(GROUP)).unwrap();
    port.open(KNEE, queue.clone());
    let mut retired = pin!(port.retire(process));
    let mut is_retired = || retired.as_mut().poll(&mut Context::from_waker(Waker::noop())).is_ready();
    assert!(!is_retired(), "its connection may have frames of it");
    assert!(!port.is_held_by(KNEE), "the connection learns that it has to end");
    port.submit(message(1)).unwrap();
    assert!(lock(&queue.taken).is_empty(), "it waits for the next process");
    assert_eq!(port.claim(STRAY, 2, Some(GROUP)), Err(ClaimError::Stray(2)));
    assert!(!is_retired());
    assert!(port.release(KNEE));
    assert!(is_retired());
}

#[test]
fn one_call_hands_over_a_limited_number() {
    let queue = Arc::new(PlayedQueue::default());
    let port = CommandPort::new("knee", Mailbox::new(2 * HAND_OVER_MAX), false);
    let count = HAND_OVER_MAX as u64 + 1;
    (1..=count).for_each(|number| port.submit(message(number)).unwrap());
    port.begin(GROUP);
    port.claim(KNEE, 1, Some(GROUP)).unwrap();
    port.open(KNEE, queue.clone());
    assert_eq!(lock(&queue.taken).len(), HAND_OVER_MAX);
    assert!(queue.is_to_continue.swap(false, Ordering::Relaxed), "the task of the connection continues");
    port.hand_over();
    assert_eq!(*lock(&queue.taken), (1..=count).collect::<Vec<_>>());
    assert!(!queue.is_to_continue.load(Ordering::Relaxed));
}

#[test]
fn refusing_command_has_no_stale_message_for_its_program() {
    let (port, queue) = (port(), Arc::new(PlayedQueue::default()));
    port.begin(GROUP);
    port.submit(message(1)).unwrap();
    port.set_refusing(true);
    assert_eq!(port.submit(message(2)).unwrap_err().why, Rejection::Down);
    port.claim(KNEE, 1, Some(GROUP)).unwrap();
    port.open(KNEE, queue.clone());
    port.set_refusing(false);
    port.submit(message(3)).unwrap();
    assert_eq!(*lock(&queue.taken), [3]);
}
