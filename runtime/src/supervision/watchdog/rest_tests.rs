//! The running watchdog, from its rest to the hangs that it finds then.

use std::{
    sync::MutexGuard,
    task::{Context, Poll},
    time::Instant,
};

use bytes::Bytes;
use futures_util::task::noop_waker;

use super::*;
use crate::{
    mailbox::{Mailbox, MailboxReader},
    outcome::Outcome,
    router::MessageSink,
    supervision::{
        actor_handle::Report,
        liveness::{Activity, Liveness},
    },
    tid::Tid,
    wire::{Header, Kind, Message},
};

const BUDGET: Duration = Duration::from_millis(400);
/// No test waits longer than this for an event.
const DEADLINE: Duration = Duration::from_secs(60);

/// Returns whether the actor records the start of its turns. It must have none in progress.
fn records_turns(liveness: &Arc<Liveness>) -> bool {
    let begun = || liveness.snapshot().begun.is_some();
    Liveness::turn(&mut Some(liveness.clone()), Activity::Timer, begun)
}

/// Waits until the watchdog rests. It makes no check before the result is dropped.
fn wait_for_rest(watchdog: &Watchdog) -> MutexGuard<'_, Table> {
    let until = Instant::now() + DEADLINE;
    loop {
        let table = lock(&watchdog.shared.table);
        if table.rest.pace() == Pace::Resting {
            return table;
        }
        drop(table);
        assert!(Instant::now() < until, "it never rests");
        std::thread::sleep(Duration::from_millis(1)); // the polling interval
    }
}

fn submit(mailbox: &Mailbox) {
    let header = Header::new(Kind::named("test"), Tid::NONE, Tid::NONE);
    mailbox.submit(Message::new(header, Bytes::new())).expect("it has room");
}

fn take(reader: &mut MailboxReader) {
    let taken = reader.poll_take(&mut Context::from_waker(&noop_waker()));
    assert!(matches!(taken, Poll::Ready(Some(_))));
    reader.finish(Outcome::Delivered);
}

#[test]
fn hangs_that_begin_at_rest_count_from_their_beginning() {
    // given: three incarnations, one of which has a mailbox, and a watchdog at rest
    let [idle, busy, stalled] = ["idle", "busy", "stalled"].map(Liveness::new);
    let mailbox = Mailbox::new(8);
    let mut reader = mailbox.attach();
    stalled.attach_mailbox(mailbox.clone(), reader.epoch(), Arc::new([]));
    stalled.set_ready();
    let watchdog = Watchdog::default();
    let (say, heard) = sync_channel(3);
    let [_idle, busy, stalled] = [&idle, &busy, &stalled].map(|liveness| {
        let (say, idle) = (say.clone(), idle.clone());
        let report: Report = Box::new(move |event| {
            say.send((format!("{event:?}"), records_turns(&idle))).expect("it is waited for");
        });
        let handle = ActorHandle::new(liveness.clone(), None, Some(BUDGET), report);
        watchdog.watch(&handle);
        handle
    });
    let at_rest = wait_for_rest(&watchdog);
    assert!(records_turns(&idle));
    // when: one begins a turn that does not end; another one takes a message, and not the next one
    let before = Time::now();
    busy.liveness().begin(Activity::Timer, None);
    submit(&mailbox);
    take(&mut reader);
    submit(&mailbox);
    let after = Time::now();
    drop(at_rest);
    // then
    for _ in 0..2 {
        let (event, records) = heard.recv_timeout(DEADLINE).expect("a hang is found");
        assert!(event.contains("of 400ms allowed"), "{event}");
        assert!(!records, "the checks are frequent again: {event}");
    }
    for hung in [busy, stalled] {
        let since = hung.blocked_since().expect("it was accused");
        assert!(
            (before..=after).contains(&since),
            "{}: {since:?} is not from {before:?} to {after:?}",
            hung.liveness().name()
        );
    }
    assert!(!idle.is_fenced());
}
