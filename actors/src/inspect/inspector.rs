//! The thread that answers, and the way to it.

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        mpsc::{Receiver, SyncSender, TrySendError, sync_channel},
    },
    time::Duration,
};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    router::{LocalRoute, Outlet, Refused},
    tid::AppAddress,
    time::Time,
    wire::{Class, Flags, Kind, Message, Payload},
};

use super::{
    answers::Answers,
    reports::{AskApps, AskAudit, AskNode, AskTree, Report},
};
use crate::{log, stores::Stores};

/// After each report: whoever asks without end takes neither the core nor the layers' locks for itself.
const REST: Duration = Duration::from_millis(1);
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
    for (number, question) in (1..).zip(questions) {
        // spec: INSPECT-5. The question is dropped with the panic, and its receipt says `Failed`.
        let is_ping = question.header.kind == Kind::PING;
        if catch_unwind(AssertUnwindSafe(|| answer(answers, number, question))).is_err() {
            log::error!("an answer of the inspection panicked; the next question is answered");
        }
        // spec: INSPECT-2
        if !is_ping {
            std::thread::sleep(REST);
        }
    }
}

fn answer(answers: &Answers, number: u64, mut question: Message) {
    if question.header.is_expired(Time::now()) {
        return question.settle(Outcome::Expired);
    }
    let outcome = match question.header.kind {
        Kind::PING => Ok(()),
        AskNode::KIND => reply(answers, number, &question, Answers::node),
        AskApps::KIND => reply(answers, number, &question, Answers::apps),
        AskTree::KIND => reply(answers, number, &question, Answers::tree),
        AskAudit::KIND => reply(answers, number, &question, Answers::audit),
        // spec: INSPECT-4
        _ => Err(Rejection::UnknownKind),
    };
    question.settle(outcome.map_or_else(Outcome::Rejected, |()| Outcome::Delivered));
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
    message.header.class = Class::Control;
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
