//! The thread that answers questions, and its inbox.

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel},
    },
    time::Duration,
};

use sinew_model::contracts::AskContracts;
use sinew_runtime::{
    log,
    outcome::{Outcome, Rejection},
    router::{LocalRoute, MessageSink, SubmitError, tap::TapOf},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Flags, Kind, Message, Payload},
};

use super::{
    access::{self, Readings},
    answers::Answers,
    contracts, frozen, logs, reach, record,
    reports::{
        AskAccess, AskApps, AskAudit, AskFreeze, AskFrozen, AskGroups, AskLogs, AskMismatches, AskNode,
        AskReach, AskRecord, AskReload, AskSchemas, AskTree, AskWatch, Report, WatchReport,
    },
    types,
    watches::{Directions, GUESTS_WATCHES_MAX, NewTap, WATCHES_MAX, Watches},
};
use crate::NodeState;

/// Pause after each report: repeated questions must not occupy the core or the layers' locks. This is no
/// rate: the pause follows also a report that took long.
const PAUSE_AFTER_REPORT: Duration = Duration::from_millis(1);
/// Maximum bytes of watched payloads in one answer, plus one payload. With the lists' own bytes this is well
/// below 100 KiB, ten times a second, so that the watcher does not saturate its link.
const WATCH_BYTES: usize = 32 * 1024;
/// Maximum number of queued questions.
pub(super) const WAITING_MAX: usize = 32;

/// The queue of the answering thread.
pub(super) struct Inbox(pub(super) SyncSender<Message>);

impl MessageSink for Inbox {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        // spec: INSPECT-2
        self.0.try_send(message).map_err(|refused| match refused {
            TrySendError::Full(message) => SubmitError::new(message, Rejection::QueueFull),
            TrySendError::Disconnected(message) => SubmitError::new(message, Rejection::Closed),
        })
    }
}

/// Answers questions about the node with this state until its routing table ends or removes the address.
///
/// # Errors
/// The thread cannot be started.
pub(crate) fn begin(state: &Arc<NodeState>) -> io::Result<()> {
    let (put, questions) = sync_channel(WAITING_MAX);
    let answers = Answers::new(Arc::downgrade(state), Time::now());
    std::thread::Builder::new().name("inspect".to_owned()).spawn(move || serve(&questions, &answers))?;
    let sink = Arc::new(Inbox(put));
    state.ctx.router.set_local(AppAddress::INSPECT, LocalRoute { sink, events: Arc::new([]) });
    Ok(())
}

fn serve(questions: &Receiver<Message>, answers: &Answers) {
    let (mut watches, mut readings) = (Watches::default(), Readings::default());
    let mut number = 0;
    while let Some(question) = next(questions, answers, &mut watches) {
        number += 1;
        // spec: INSPECT-5. The question is dropped with the panic, and its receipt reports `Failed`.
        let is_ping = question.header.kind == Kind::PING;
        let answer = AssertUnwindSafe(|| answer(answers, number, &mut watches, &mut readings, question));
        if catch_unwind(answer).is_err() {
            log::error!("an answer of the inspection panicked; the next question is answered");
        }
        // spec: INSPECT-2
        if !is_ping {
            std::thread::sleep(PAUSE_AFTER_REPORT);
        }
    }
}

/// Returns the next question, and ends expired watches meanwhile. `None` when the node has ended. spec:
/// INSPECT-6
fn next(questions: &Receiver<Message>, answers: &Answers, watches: &mut Watches) -> Option<Message> {
    loop {
        let Some(end) = watches.next_end() else { return questions.recv().ok() };
        match questions.recv_timeout(end.since(Time::now())) {
            Ok(question) => return Some(question),
            Err(RecvTimeoutError::Disconnected) => return None,
            Err(RecvTimeoutError::Timeout) => {}
        }
        let tap = watches.expire(Time::now());
        install_tap(&*answers.state()?, tap);
    }
}

fn install_tap(state: &NodeState, tap: NewTap) {
    if let Some(tap) = tap {
        state.ctx.router.set_tap(TapOf::Watches, tap);
        if let Some(applications) = state.ctx.ports.applications() {
            applications.observe_links();
        }
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
            reply(answers, number, &question, |answers, state| watch(answers, state, watches, &question))
        }
        AskAccess::KIND => reply(answers, number, &question, |_, state| access::explained(state, &question)),
        AskReach::KIND => reply(answers, number, &question, |_, state| reach::reached(state, &question)),
        AskGroups::KIND => reply(answers, number, &question, |_, state| reach::by_groups(state, &question)),
        AskReload::KIND => {
            reply(answers, number, &question, |_, state| access::reloaded(state, readings, &question))
        }
        AskFreeze::KIND => reply(answers, number, &question, |_, state| frozen::triggered(state, &question)),
        AskFrozen::KIND => reply(answers, number, &question, |_, state| frozen::fetched(state, &question)),
        AskContracts::KIND => reply(answers, number, &question, |_, state| contracts::declared(state)),
        AskLogs::KIND => reply(answers, number, &question, |_, state| logs::kept(state, &question)),
        AskSchemas::KIND => reply(answers, number, &question, |_, state| types::schemas(state, &question)),
        AskMismatches::KIND => reply(answers, number, &question, |_, state| types::mismatches(state)),
        AskRecord::KIND => reply(answers, number, &question, |_, state| record::recorded(state, &question)),
        // spec: INSPECT-4
        _ => Err(Rejection::UnknownKind),
    };
    question.settle(outcome.map_or_else(Outcome::Rejected, |()| Outcome::Delivered));
}

/// Returns the messages that the application of the question received and sent since the last question. spec:
/// INSPECT-6
fn watch(
    answers: &Answers,
    state: &Arc<NodeState>,
    watches: &mut Watches,
    question: &Message,
) -> Result<WatchReport, Rejection> {
    let AskWatch { app, received, sent } = question.decode().map_err(|_| Rejection::Malformed)?;
    let now = Time::now();
    // An ended watch frees its place for another one.
    let tap = watches.expire(now);
    install_tap(state, tap);
    let watched = Tid::new(state.ctx.node, app.app);
    let bytes_max = WATCH_BYTES.min(state.ctx.config.payload_max / 2);
    let directions = Directions { received, sent };
    let key = (question.header.source, watched);
    if !watches.leaves_room(key, |watcher| access::is_of_a_guest(state, watcher)) {
        return Ok(refused(format!(
            "applications of other users have {GUESTS_WATCHES_MAX} watches at once on this node, which keeps the rest for its own \
             user's, and so many are there; end another one"
        )));
    }
    let (fetched, tap) = watches.fetch(now, key, directions, bytes_max);
    install_tap(state, tap);
    let Some(fetched) = fetched else {
        return Ok(refused(format!(
            "this node shows {WATCHES_MAX} watches at once, and so many are there; end another one"
        )));
    };
    Ok(answers.seen(state, fetched))
}

/// Returns the report of a refused watch, with this reason.
const fn refused(why: String) -> WatchReport {
    WatchReport { seen: Vec::new(), dropped: 0, more: false, refused: Some(why) }
}

fn reply<R: Report + Payload>(
    answers: &Answers,
    number: u64,
    question: &Message,
    report: impl FnOnce(&Answers, &Arc<NodeState>) -> Result<R, Rejection>,
) -> Result<(), Rejection> {
    if !question.header.flags.has(Flags::ASK) {
        return Err(Rejection::Unsupported);
    }
    let state = answers.state().ok_or(Rejection::Closed)?;
    let asked = question.header;
    let mut message = written(question, report(answers, &state)?, state.ctx.config.payload_max)?;
    message.header.class = R::TRAVELS;
    message.header.flags = Flags::REPLY;
    message.header.correlation = asked.correlation;
    message.header.sequence = number;
    message.header.sent = Time::now();
    state.ctx.router.send(message)
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
