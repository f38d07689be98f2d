//! The thread that answers, and the way to it.

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel},
    },
    time::Duration,
};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    router::{LocalRoute, Outlet, Refused},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Flags, Kind, Message, Payload},
};

use super::{
    access::{self, Readings},
    answers::Answers,
    reach,
    reports::{
        AskAccess, AskApps, AskAudit, AskGroups, AskNode, AskReach, AskReload, AskTree, AskWatch, Report,
        WatchReport,
    },
    watches::{GUESTS_WATCHES_MAX, NewTap, WATCHES_MAX, Watches, Ways},
};
use crate::{log, stores::Stores};

/// After each report: whoever asks without end takes neither the core nor the layers' locks for itself.
const REST: Duration = Duration::from_millis(1);
/// Payloads of messages that are watched in one answer, in bytes and one payload: with the lists' own bytes well below 100 KiB, ten times a
/// second, so that the link to the watcher is not filled.
const WATCH_BYTES: usize = 32 * 1024;
/// Questions that wait at most.
pub(super) const WAITING_MAX: usize = 32;

/// The way to the thread that answers.
pub(super) struct Inbox(pub(super) SyncSender<Message>);

impl Outlet for Inbox {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        // spec: INSPECT-2
        self.0.try_send(message).map_err(|refused| match refused {
            TrySendError::Full(message) => Refused::new(message, Rejection::QueueFull),
            TrySendError::Disconnected(message) => Refused::new(message, Rejection::Closed),
        })
    }
}

/// Answers questions about the node that has these stores until its routing table ends or forgets the address.
///
/// # Errors
/// There is no thread for it.
pub(crate) fn begin(stores: &Arc<Stores>) -> io::Result<()> {
    let (put, questions) = sync_channel(WAITING_MAX);
    let answers = Answers::new(Arc::downgrade(stores), Time::now());
    std::thread::Builder::new().name("inspect".to_owned()).spawn(move || serve(&questions, &answers))?;
    let outlet = Arc::new(Inbox(put));
    stores.router.set_local(AppAddress::INSPECT, LocalRoute { outlet, events: Arc::new([]) });
    Ok(())
}

fn serve(questions: &Receiver<Message>, answers: &Answers) {
    let (mut watches, mut readings) = (Watches::default(), Readings::default());
    let mut number = 0;
    while let Some(question) = next(questions, answers, &mut watches) {
        number += 1;
        // spec: INSPECT-5. The question is dropped with the panic, and its receipt says `Failed`.
        let is_ping = question.header.kind == Kind::PING;
        let answer = AssertUnwindSafe(|| answer(answers, number, &mut watches, &mut readings, question));
        if catch_unwind(answer).is_err() {
            log::error!("an answer of the inspection panicked; the next question is answered");
        }
        // spec: INSPECT-2
        if !is_ping {
            std::thread::sleep(REST);
        }
    }
}

/// The next question; meanwhile it ends the watches that nobody asks for. `None` when the node has ended. spec: INSPECT-6
fn next(questions: &Receiver<Message>, answers: &Answers, watches: &mut Watches) -> Option<Message> {
    loop {
        let Some(end) = watches.next_end() else { return questions.recv().ok() };
        match questions.recv_timeout(end.since(Time::now())) {
            Ok(question) => return Some(question),
            Err(RecvTimeoutError::Disconnected) => return None,
            Err(RecvTimeoutError::Timeout) => {}
        }
        let tap = watches.expire(Time::now());
        put_up(&*answers.stores()?, tap);
    }
}

fn put_up(stores: &Stores, tap: NewTap) {
    if let Some(tap) = tap {
        stores.router.set_tap(tap);
    }
}

fn answer(
    answers: &Answers,
    number: u64,
    watches: &mut Watches,
    readings: &mut Readings,
    mut question: Message,
) {
    if question.header.is_expired(Time::now()) {
        return question.settle(Outcome::Expired);
    }
    let outcome = match question.header.kind {
        Kind::PING => Ok(()),
        AskNode::KIND => reply(answers, number, &question, Answers::node),
        AskApps::KIND => reply(answers, number, &question, Answers::apps),
        AskTree::KIND => reply(answers, number, &question, Answers::tree),
        AskAudit::KIND => reply(answers, number, &question, Answers::audit),
        AskWatch::KIND => {
            reply(answers, number, &question, |answers, stores| watch(answers, stores, watches, &question))
        }
        AskAccess::KIND => {
            reply(answers, number, &question, |_, stores| access::explained(stores, &question))
        }
        AskReach::KIND => reply(answers, number, &question, |_, stores| reach::reached(stores, &question)),
        AskGroups::KIND => reply(answers, number, &question, |_, stores| reach::by_groups(stores, &question)),
        AskReload::KIND => {
            reply(answers, number, &question, |_, stores| access::reloaded(stores, readings, &question))
        }
        // spec: INSPECT-4
        _ => Err(Rejection::UnknownKind),
    };
    question.settle(outcome.map_or_else(Outcome::Rejected, |()| Outcome::Delivered));
}

/// What the application that the question names got and sent since the last one. spec: INSPECT-6
fn watch(
    answers: &Answers,
    stores: &Arc<Stores>,
    watches: &mut Watches,
    question: &Message,
) -> Result<WatchReport, Rejection> {
    let AskWatch { app, received, sent } = question.decode().map_err(|_| Rejection::Malformed)?;
    let now = Time::now();
    // One whose end has come makes room for another.
    put_up(stores, watches.expire(now));
    let watched = Tid::new(stores.node, app.app);
    let bytes_max = WATCH_BYTES.min(stores.config.payload_max / 2);
    let ways = Ways { received, sent };
    let key = (question.header.source, watched);
    if !watches.leaves_room(key, |watcher| access::is_of_a_guest(stores, watcher)) {
        return Ok(refused(format!(
            "applications of other users have {GUESTS_WATCHES_MAX} watches at once on this node, which keeps the rest for its own \
             user's, and so many are there; end another one"
        )));
    }
    let (fetched, tap) = watches.fetch(now, key, ways, bytes_max);
    put_up(stores, tap);
    let Some(fetched) = fetched else {
        return Ok(refused(format!(
            "this node shows {WATCHES_MAX} watches at once, and so many are there; end another one"
        )));
    };
    Ok(answers.seen(stores, fetched))
}

/// Nothing is watched, for this reason.
const fn refused(why: String) -> WatchReport {
    WatchReport { seen: Vec::new(), dropped: 0, more: false, refused: Some(why) }
}

fn reply<R: Report + Payload>(
    answers: &Answers,
    number: u64,
    question: &Message,
    report: impl FnOnce(&Answers, &Arc<Stores>) -> Result<R, Rejection>,
) -> Result<(), Rejection> {
    if !question.header.flags.has(Flags::ASK) {
        return Err(Rejection::Unsupported);
    }
    let stores = answers.stores().ok_or(Rejection::Closed)?;
    let asked = question.header;
    let mut message = written(question, report(answers, &stores)?, stores.config.payload_max)?;
    message.header.class = R::TRAVELS;
    message.header.flags = Flags::REPLY;
    message.header.correlation = asked.correlation;
    message.header.sequence = number;
    message.header.sent = Time::now();
    stores.router.send(message)
}

/// The answer, short enough. spec: INSPECT-3
fn written<R: Report + Payload>(
    question: &Message,
    mut report: R,
    payload_max: usize,
) -> Result<Message, Rejection> {
    loop {
        let header = question.header;
        let message = Message::typed(header.destination, header.source, &report);
        if message.payload.len() <= payload_max {
            return Ok(message);
        }
        if !report.halve() {
            return Err(Rejection::TooLong);
        }
    }
}
