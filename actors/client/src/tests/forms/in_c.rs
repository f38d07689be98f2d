//! The form of NodeAPI in C: the calls of the suite, made with the functions of `sinew.h`.
//!
//! An error in C is a number and a sentence. Here it becomes the Rust error with this number, and only if
//! both sentences are the same: one semantics has one wording. The suite checks some properties that C does
//! not have:
//!
//! - The transport ([`Client::transport`](super::Client::transport)) is requested and not reported.
//! - The number of an endpoint's registrations is not counted. The endpoint has reconnected when a send
//!   without waiting succeeds: such a send does not look for the node itself.
//! - A panic. A message in the hand of a panicking thread is settled as Failed, as `sinew.hpp` does at an
//!   exception.
//! - Types of payloads: a program in C sends bytes. Here they are those of Rust's types, in MessagePack.
//! - The message of another endpoint is never valid: `SINEW_ERROR_NO_SUCH_MESSAGE`. So there is no claim
//!   about sending another endpoint's loan, and a reply to another one's request is refused with that number.
//! - An endpoint is not dropped: it ends only by `sinew_unregister`, which sends a goodbye to the node. A
//!   message that arrives between the goodbye and the node's answer is reported as Failed. A dropped endpoint
//!   leaves its node to report that it was not handled; so that claim is for Rust alone.
//! - A program that unregisters has returned its loans, and gets no error for them.
//! - During a loan a send reports the loan before it reports that the node is away. So the claim about a loan
//!   from before a restart cannot detect the return, and is for Rust alone.

use std::{path::Path, time::Duration};

use sinew_c::conformance::{
    Asked, Endpoint, InHand, Made, Outcome as Code, SINEW_DIRECT_ALWAYS, SINEW_DIRECT_AUTOMATIC,
    SINEW_DIRECT_NEVER, SINEW_SOCKET_ONLY, SINEW_WITHOUT_RECONNECT, Status, StatusError,
};
use sinew_runtime::{
    outcome::{MemberOutcome, Outcome},
    tid::{AppAddress, Tid},
    time::Time,
    undelivered::Undelivered,
    wire::{Class, Header, Kind, Message, Payload},
};

use crate::{ApiError, DirectLinks, Registration, Transport, reconnect::ReconnectPolicy};

const RAW: Kind = Kind::named("test.raw");

/// An endpoint of C's.
#[derive(Debug)]
pub(in crate::tests) struct Client {
    endpoint: Endpoint,
    registrations: u64,
    is_disconnected: bool,
}

/// Converts the result of a call in C into that of Rust.
fn converted<T>(result: Result<T, StatusError>) -> Result<T, ApiError> {
    result.map_err(|failure| error_of(&failure))
}

fn error_of(failure: &StatusError) -> ApiError {
    let sentence = failure.sentence.as_str();
    let error = match failure.status {
        Status::SinewErrorRefused => ApiError::Refused(between("the node refused: ", sentence, "")),
        Status::SinewErrorClosed => ApiError::Closed(between(
            "the connection to the node has ended: ",
            sentence,
            "; this endpoint does not come back, register a new one",
        )),
        Status::SinewErrorStalled => {
            ApiError::Stalled(time(&between("no room for the message for ", sentence, ", it was not sent")))
        }
        Status::SinewErrorNoAnswer => {
            ApiError::NoAnswer(time(&between("the node did not answer within ", sentence, "; is it stopped")))
        }
        Status::SinewErrorNoReply => {
            ApiError::NoReply(time(&between("no reply came within ", sentence, ", the request may")))
        }
        Status::SinewErrorTooLong => {
            let mut numbers = sentence.split(' ').filter_map(|word| word.trim_end_matches(';').parse().ok());
            let mut next = || numbers.next().unwrap_or_else(|| panic!("no length and limit: {sentence}"));
            ApiError::TooLong { length: next(), limit: next() }
        }
        Status::SinewErrorWaiting => {
            let (waited, missing) = sentence.split_once(" still waiting for these to be ready: ").unwrap();
            let missing = between("", missing, "; start what is missing");
            ApiError::Waiting {
                missing: vec![missing],
                waited: time(waited.strip_prefix("after ").expect("how long")),
            }
        }
        // C has its own names in the remedies of these.
        Status::SinewErrorDisconnected => {
            return ApiError::Disconnected(between(
                "the connection to the node has ended: ",
                sentence,
                "; the endpoint registers again by itself; continue with sinew_receive_message",
            ));
        }
        Status::SinewErrorLoanActive => {
            assert!(sentence.contains("sinew_send_message or sinew_discard_message first"), "{sentence}");
            return ApiError::LoanActive;
        }
        Status::SinewErrorNotAsked => {
            assert!(sentence.contains("only a message sent with sinew_ask does"), "{sentence}");
            return ApiError::NotAsked;
        }
        Status::SinewErrorNotHandled => {
            return ApiError::Ended(outcome_of(failure.ended.expect("what became of it")));
        }
        Status::SinewOk
        | Status::SinewNothing
        | Status::SinewErrorInvalidArgument
        | Status::SinewErrorNoNode
        | Status::SinewErrorMalformed
        | Status::SinewErrorNoSuchEndpoint
        | Status::SinewErrorBusy
        | Status::SinewErrorNoSuchMessage
        | Status::SinewErrorTooMany
        | Status::SinewErrorForked
        | Status::SinewErrorPanic
        | Status::SinewErrorNotMet
        | Status::SinewErrorPartyLost
        | Status::SinewErrorNoSuchGuard
        | Status::SinewErrorNotGood
        | Status::SinewErrorSafeFails
        | Status::SinewErrorNoWatchdog => panic!("no claim of the suite ends so: {failure:?}"),
    };
    assert_eq!(error.to_string(), sentence, "the same words in both languages");
    error
}

/// Returns the text between two texts, of which the last may be cut.
fn between(before: &str, sentence: &str, after: &str) -> String {
    let rest = sentence.strip_prefix(before);
    let found =
        rest.and_then(|rest| if after.is_empty() { Some(rest) } else { Some(rest.split_once(after)?.0) });
    found.unwrap_or_else(|| panic!("'{sentence}' is not '{before}' ... '{after}'")).to_owned()
}

/// A duration as Rust prints it, of which the claims have whole numbers alone; and the longest that C has.
fn time(text: &str) -> Duration {
    humantime::parse_duration(text).unwrap_or_else(|why| panic!("'{text}' is no time: {why}"))
}

fn outcome_of(code: Code) -> Outcome {
    let code = u8::try_from(code as i32).expect("an outcome has the number that it has on the wire");
    Outcome::from_code(code).expect("it is one")
}

fn nanos(within: Duration) -> u64 {
    u64::try_from(within.as_nanos()).unwrap_or(u64::MAX)
}

const fn code_of(class: Class) -> i32 {
    match class {
        Class::Control => 0,
        Class::Stream => 1,
        Class::Bulk => 2,
    }
}

/// The request of C, where zero is the default: no stall timeout is the minimum.
fn asked(registration: &Registration) -> Asked {
    let (register, link) = (&registration.register, &registration.link);
    let chosen = [
        (link.transport == Transport::Socket, SINEW_SOCKET_ONLY),
        (link.direct_links == DirectLinks::Automatic, SINEW_DIRECT_AUTOMATIC),
        (link.direct_links == DirectLinks::Always, SINEW_DIRECT_ALWAYS),
        (link.direct_links == DirectLinks::Never, SINEW_DIRECT_NEVER),
        (matches!(registration.returning, ReconnectPolicy::Never), SINEW_WITHOUT_RECONNECT),
    ];
    Asked {
        name: register.name.clone().unwrap_or_default(),
        required: register.requires.clone(),
        handled: register.kinds.clone(),
        fixed_address: register.address.map_or(0, AppAddress::bits),
        deadline_ns: nanos(registration.deadline),
        stall_timeout_ns: nanos(link.stall_timeout).max(1),
        inbox_capacity: registration.inbox_capacity,
        links: chosen.into_iter().filter(|(is, _)| *is).fold(0, |links, (_, link)| links | link),
    }
}

impl Client {
    pub(super) fn register(socket: &Path, registration: &Registration) -> Result<Self, ApiError> {
        let endpoint = converted(Endpoint::register(socket, &asked(registration)))?;
        Ok(Self { endpoint, registrations: 1, is_disconnected: false })
    }

    /// Returns the result of a call, and remembers whether the endpoint is away.
    fn record<T>(&mut self, result: Result<T, StatusError>) -> Result<T, ApiError> {
        let result = converted(result);
        self.is_disconnected |= matches!(result, Err(ApiError::Disconnected(_)));
        result
    }

    pub(super) fn registrations(&mut self) -> u64 {
        if self.is_disconnected {
            let made = self.endpoint.create(0, RAW.bits(), code_of(Class::Control), 0);
            match converted(made.and_then(|made| self.endpoint.send(made, Some(0)))) {
                Ok(()) => {
                    self.registrations += 1;
                    self.is_disconnected = false;
                }
                Err(ApiError::Disconnected(_)) => {}
                Err(other) => panic!("{other}"),
            }
        }
        self.registrations
    }

    pub(super) fn tid(&self) -> Tid {
        Tid::from_bits(self.endpoint.tid())
    }

    pub(super) fn node_name(&self) -> &str {
        self.endpoint.node_name()
    }

    pub(super) fn payload_max(&self) -> usize {
        self.endpoint.payload_max()
    }

    pub(super) fn create(&mut self, to: Tid, kind: Kind, length: usize) -> Result<Made, ApiError> {
        self.create_of(Class::Control, to, kind, length)
    }

    fn create_of(&mut self, class: Class, to: Tid, kind: Kind, length: usize) -> Result<Made, ApiError> {
        let created = self.endpoint.create(to.bits(), kind.bits(), code_of(class), length);
        match created {
            Err(failure) if failure.status == Status::SinewErrorInvalidArgument && !kind.is_user() => {
                assert!(failure.sentence.contains("take one from sinew_kind_named"), "{failure:?}");
                Err(ApiError::NotYours(kind))
            }
            other => self.record(other),
        }
    }

    /// Loaned and filled with a value.
    fn made<P: Payload>(&mut self, to: Tid, value: &P) -> Result<Made, ApiError> {
        let message = Message::typed(self.tid(), to, value);
        let mut made = self.create_of(P::CLASS, to, P::KIND, message.payload.len())?;
        made.copy_from_slice(&message.payload);
        Ok(made)
    }

    pub(super) fn send_message(&mut self, made: Made, within: Option<Duration>) -> Result<(), ApiError> {
        let sent = self.endpoint.send(made, within.map(nanos));
        self.record(sent)
    }

    pub(super) fn send<P: Payload>(
        &mut self,
        to: Tid,
        value: &P,
        within: Option<Duration>,
    ) -> Result<(), ApiError> {
        if within.is_some() {
            let made = self.made(to, value)?;
            return self.send_message(made, within);
        }
        let message = Message::typed(self.tid(), to, value);
        let as_what = (P::KIND.bits(), code_of(P::CLASS));
        let sent = self.endpoint.send_bytes(to.bits(), as_what, &message.payload);
        self.record(sent)
    }

    pub(super) fn confirm_message(&mut self, made: Made, within: Duration) -> Result<Outcome, ApiError> {
        let sent = self.endpoint.send_confirmed(made, nanos(within));
        self.record(sent).map(outcome_of)
    }

    pub(super) fn confirm<P: Payload>(
        &mut self,
        to: Tid,
        value: &P,
        within: Duration,
    ) -> Result<Outcome, ApiError> {
        let made = self.made(to, value)?;
        match self.endpoint.send_confirmed(made, nanos(within)) {
            Err(failure) if failure.status == Status::SinewErrorInvalidArgument && !to.is_single() => {
                assert!(failure.sentence.contains("sinew_send_message_confirmed_by_each"), "{failure:?}");
                Err(ApiError::ToMany(to))
            }
            sent => self.record(sent).map(outcome_of),
        }
    }

    pub(super) fn confirm_by_each<P: Payload>(
        &mut self,
        to: Tid,
        value: &P,
        within: Duration,
    ) -> Result<Vec<MemberOutcome>, ApiError> {
        let made = self.made(to, value)?;
        let sent = self.endpoint.send_confirmed_by_each(made, nanos(within));
        let of = |(tid, code): (u64, i32)| MemberOutcome {
            tid: Tid::from_bits(tid),
            outcome: u8::try_from(code).ok().and_then(Outcome::from_code).expect("an outcome"),
        };
        self.record(sent).map(|members| members.into_iter().map(of).collect())
    }

    pub(super) fn ask_message(&mut self, made: Made, within: Duration) -> Result<InHand, ApiError> {
        let asked = self.endpoint.ask(made, nanos(within));
        self.record(asked)
    }

    pub(super) fn ask<P: Payload, R: Payload>(
        &mut self,
        to: Tid,
        request: &P,
        within: Duration,
    ) -> Result<R, ApiError> {
        let made = self.made(to, request)?;
        let reply = self.ask_message(made, within)?;
        Ok(message_of(&reply).decode()?)
    }

    pub(super) fn reply_message(
        &mut self,
        request: &InHand,
        made: Made,
        within: Option<Duration>,
    ) -> Result<(), ApiError> {
        match self.endpoint.reply(request, made, within.map(nanos)) {
            Err(failure) if failure.status == Status::SinewErrorNoSuchMessage => {
                assert!(
                    failure.sentence.contains("the request is no message of this endpoint"),
                    "{failure:?}"
                );
                Err(ApiError::OthersRequest(Tid::from_bits(request.fields().destination)))
            }
            other => self.record(other),
        }
    }

    pub(super) fn reply<R: Payload>(
        &mut self,
        request: &InHand,
        value: &R,
        within: Option<Duration>,
    ) -> Result<(), ApiError> {
        let made = self.made(Tid::from_bits(request.fields().source), value)?;
        self.reply_message(request, made, within)
    }

    pub(super) fn receive(&mut self, within: Duration) -> Result<Option<InHand>, ApiError> {
        let received = self.endpoint.receive(nanos(within));
        self.record(received)
    }

    pub(super) fn take_undelivered(&mut self) -> Option<Undelivered> {
        let undelivered = converted(self.endpoint.next_undelivered()).expect("it only looks")?;
        let code =
            u8::try_from(undelivered.outcome).expect("an outcome has the number that it has on the wire");
        Some(Undelivered {
            destination: Tid::from_bits(undelivered.destination),
            why: match Outcome::from_code(code) {
                Some(Outcome::Rejected(why)) => why,
                other => panic!("{other:?} is no reason"),
            },
            name: {
                let bytes = undelivered.name.iter().map(|byte| byte.to_ne_bytes()[0]);
                let name: Vec<u8> = bytes.take_while(|byte| *byte != 0).collect();
                (!name.is_empty()).then(|| String::from_utf8(name).expect("names are UTF-8"))
            },
            kind: (undelivered.kind != 0).then(|| Kind::from_bits(undelivered.kind)),
            class: Class::ALL.into_iter().find(|class| *class as i32 == undelivered.message_class),
            count: undelivered.count,
            since: Time::from_nanos(undelivered.since_ns),
            first_sequence: undelivered.are_sequences_known.then_some(undelivered.first_sequence),
            last_sequence: undelivered.are_sequences_known.then_some(undelivered.last_sequence),
        })
    }

    pub(super) fn join(&mut self, name: &str) -> Result<(), ApiError> {
        let joined = self.endpoint.join(name);
        self.record(joined)
    }

    pub(super) fn leave(&mut self, name: &str) -> Result<(), ApiError> {
        let left = self.endpoint.leave(name);
        self.record(left)
    }

    pub(super) fn resolve(&mut self, name: &str, within: Duration) -> Result<Option<Tid>, ApiError> {
        let found = self.endpoint.resolve(name, nanos(within));
        Ok(self.record(found)?.map(Tid::from_bits))
    }

    pub(super) fn unregister(self) -> Result<(), ApiError> {
        converted(self.endpoint.unregister())
    }
}

/// Converts a message received in C into that of Rust.
pub(super) fn message_of(received: &InHand) -> Message {
    let fields = received.fields();
    assert_eq!(fields.length, received.payload().len());
    let (source, destination) = (Tid::from_bits(fields.source), Tid::from_bits(fields.destination));
    let mut header = Header::new(Kind::from_bits(fields.kind), source, destination);
    header.sequence = fields.sequence;
    header.sent = Time::from_nanos(fields.sent_ns);
    header.set_sent_error(fields.is_sent_known.then(|| Duration::from_nanos(fields.sent_error_ns)));
    Message::new(header, received.payload().to_vec().into())
}

/// Settles the message with this outcome.
pub(super) fn settle(received: InHand, outcome: Outcome) {
    converted(received.settle(outcome.code().into())).expect("it is in hand, and nobody else is in a call");
}
