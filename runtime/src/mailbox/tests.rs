//! Mailboxes and their readers: their lifetimes, and the outcome of each message.

use std::{
    task::{Context, Poll},
    time::Duration,
};

use bytes::Bytes;
use futures_util::task::noop_waker;

use super::*;
use crate::{
    tid::Tid,
    wire::{Header, Kind},
};

fn message() -> Message {
    Message::new(Header::new(Kind::named("test"), Tid::NONE, Tid::NONE), Bytes::new())
}

fn take(reader: &mut MailboxReader) -> Poll<Option<Message>> {
    reader.poll_take(&mut Context::from_waker(&noop_waker()))
}

#[test]
fn messages_behind_a_panic_reach_the_next_incarnation() {
    let mailbox = Mailbox::new(8);
    mailbox.submit(message()).unwrap();
    mailbox.submit(message()).unwrap();
    let mut first = mailbox.attach();
    assert!(matches!(take(&mut first), Poll::Ready(Some(_))));
    drop(first); // as the guard does after a panic
    let mut second = mailbox.attach();
    assert!(matches!(take(&mut second), Poll::Ready(Some(_))));
    second.finish(Outcome::Delivered);
    assert!(take(&mut second).is_pending());
    let tally = mailbox.tally(Class::Control);
    assert_eq!((tally.taken, tally.failed, tally.delivered, tally.open()), (2, 1, 1, 0));
}

#[test]
fn start_of_a_wait_is_recorded_on_request() {
    let mailbox = Mailbox::new(8);
    let mut reader = mailbox.attach();
    let since = |mailbox: &Mailbox| mailbox.backlog().unwrap().since;
    let mut take_one = || {
        assert!(matches!(take(&mut reader), Poll::Ready(Some(_))));
        reader.finish(Outcome::Delivered);
    };
    mailbox.submit(message()).unwrap();
    assert_eq!(since(&mailbox), None);
    take_one();
    mailbox.set_records_waits(true);
    mailbox.submit(message()).unwrap();
    let first = since(&mailbox);
    assert!(first.is_some());
    mailbox.submit(message()).unwrap();
    assert_eq!(since(&mailbox), first, "one waited already");
    let before = Time::now();
    take_one();
    assert!(since(&mailbox).is_some_and(|since| since >= before), "the other one waits on");
    take_one();
    let before = Time::now();
    mailbox.submit(message()).unwrap();
    assert!(since(&mailbox).is_some_and(|since| since >= before));
    mailbox.submit(message()).unwrap();
    mailbox.set_records_waits(false);
    take_one();
    assert_eq!(since(&mailbox), None, "one was taken after the record");
}

#[test]
fn idle_reader_counts_its_last_message_and_is_woken() {
    let mailbox = Mailbox::new(8);
    let mut reader = mailbox.attach();
    let waker = noop_waker();
    let task = &mut Context::from_waker(&waker);
    assert!(reader.poll_idle(task).is_ready(), "it has not looked yet");
    for left in [true, false] {
        mailbox.submit(message()).unwrap();
        if left {
            mailbox.submit(message()).unwrap();
        }
        assert!(matches!(take(&mut reader), Poll::Ready(Some(_))));
        reader.finish(Outcome::Delivered);
        assert!(reader.poll_idle(task).is_ready(), "another one waits");
    }
    assert!(matches!(take(&mut reader), Poll::Ready(Some(_))));
    reader.finish(Outcome::Delivered);
    assert!(reader.poll_idle(task).is_pending());
    assert!(lock(&mailbox.shared).waker.is_some());
    assert_eq!(mailbox.tally(Class::Control).delivered, 3);
    mailbox.submit(message()).unwrap();
    assert!(lock(&mailbox.shared).waker.is_none(), "it was woken");
    assert!(reader.poll_idle(task).is_ready());
    assert!(matches!(take(&mut reader), Poll::Ready(Some(_))));
    mailbox.close();
    assert!(reader.poll_idle(task).is_ready(), "the mailbox is closed");
    assert!(matches!(take(&mut reader), Poll::Ready(None)));
}

#[test]
fn fenced_reader_receives_nothing() {
    let mailbox = Mailbox::new(8);
    let mut zombie = mailbox.attach();
    let _present = mailbox.attach();
    mailbox.submit(message()).unwrap();
    assert!(matches!(take(&mut zombie), Poll::Ready(None)));
}

#[test]
fn message_held_by_a_fenced_reader_has_failed() {
    let mailbox = Mailbox::new(8);
    mailbox.submit(message()).unwrap();
    mailbox.submit(message()).unwrap();
    let mut zombie = mailbox.attach();
    assert!(matches!(take(&mut zombie), Poll::Ready(Some(_))));
    zombie.finish(Outcome::Delivered);
    assert!(matches!(take(&mut zombie), Poll::Ready(Some(_))));
    mailbox.detach(zombie.epoch());
    let told = |mailbox: &Mailbox| {
        let tally = mailbox.tally(Class::Control);
        (tally.delivered, tally.failed, tally.open())
    };
    assert_eq!(told(&mailbox), (1, 1, 0));
    zombie.finish(Outcome::Delivered);
    drop(zombie);
    assert_eq!(told(&mailbox), (1, 1, 0));
}

#[test]
fn former_reader_cannot_be_fenced() {
    let mailbox = Mailbox::new(8);
    let former = mailbox.attach().epoch();
    let mut present = mailbox.attach();
    mailbox.detach(former);
    mailbox.submit(message()).unwrap();
    assert!(matches!(take(&mut present), Poll::Ready(Some(_))));
}

#[test]
fn expired_messages_make_room_in_a_full_mailbox() {
    let mailbox = Mailbox::new(1);
    let mut old = message();
    (old.header.sent, old.header.time_to_live_us) = (Time::from_nanos(1), 1);
    mailbox.submit(old).unwrap();
    mailbox.submit(message()).unwrap();
    assert_eq!(mailbox.submit(message()).unwrap_err().why, Rejection::QueueFull);
    let tally = mailbox.tally(Class::Control);
    assert_eq!((tally.taken, tally.expired, tally.refused, tally.open()), (2, 1, 1, 1));
}

#[test]
fn layer_events_come_first_and_alone_in_a_pause() {
    let mailbox = Mailbox::new(8);
    let mut event = message();
    event.header.source = Tid::new(Tid::NONE.node, crate::tid::AppAddress::SYNC);
    let (kind, source) = (event.header.kind, event.header.source);
    mailbox.submit(message()).unwrap();
    mailbox.submit(event).unwrap();
    let mut reader = mailbox.attach();
    let mut poll_event = || reader.poll_event(&mut Context::from_waker(&noop_waker()));
    let Poll::Ready(Some(first)) = poll_event() else { panic!("the event") };
    assert_eq!((first.header.kind, first.header.source), (kind, source));
    assert!(poll_event().is_pending());
    assert!(matches!(take(&mut reader), Poll::Ready(Some(_))));
}

#[test]
fn mailbox_of_a_down_app_that_keeps_nothing_rejects() {
    let mailbox = Mailbox::new(8);
    mailbox.submit(message()).unwrap();
    mailbox.refuse_while_down();
    assert_eq!(mailbox.submit(message()).unwrap_err().why, Rejection::Down);
    mailbox.accept_again();
    mailbox.submit(message()).unwrap();
    let tally = mailbox.tally(Class::Control);
    assert_eq!((tally.taken, tally.rejected, tally.refused, tally.open()), (2, 1, 1, 1));
}

#[test]
fn closed_mailbox_rejects_waiting_and_new_messages() {
    let mailbox = Mailbox::new(8);
    mailbox.submit(message()).unwrap();
    mailbox.close();
    assert_eq!(mailbox.submit(message()).unwrap_err().why, Rejection::Closed);
    let tally = mailbox.tally(Class::Control);
    assert_eq!((tally.taken, tally.rejected, tally.refused, tally.open()), (1, 1, 1, 0));
}

#[test]
fn age_of_the_oldest_message_is_known() {
    let mailbox = Mailbox::new(8);
    assert_eq!(mailbox.oldest(), None);
    // Given: a message that was sent five seconds ago, another one, and one of another class
    let now = Time::now();
    for (seconds, class) in [(5, Class::Control), (1, Class::Control), (3, Class::Bulk)] {
        let mut sent = message();
        (sent.header.sent, sent.header.class) = (now - Duration::from_secs(seconds), class);
        mailbox.submit(sent).unwrap();
    }
    let mut reader = mailbox.attach();
    for seconds in [5, 3] {
        assert!(mailbox.oldest().is_some_and(|age| age >= Duration::from_secs(seconds)));
        assert!(matches!(take(&mut reader), Poll::Ready(Some(_))));
        reader.finish(Outcome::Delivered);
    }
    // Then: the newer ones remain
    assert!(mailbox.oldest().is_some_and(|age| age >= Duration::from_secs(3)));
}

#[test]
fn ages_of_delivered_messages_are_counted() {
    let mailbox = Mailbox::new(8);
    let mut reader = mailbox.attach();
    for outcome in [Outcome::Delivered, Outcome::Failed] {
        mailbox.submit(message()).unwrap();
        assert!(matches!(take(&mut reader), Poll::Ready(Some(_))));
        reader.finish_aged(outcome, Some(30_000));
    }
    // Its last message is counted when the reader ends.
    drop(reader);
    let ages = mailbox.ages();
    assert_eq!((ages.counts[1], ages.counts.iter().sum::<u64>()), (1, 1));
    assert_eq!(ages.sum_ns, 30_000);
}
