//! One transport address of this process, with a connection of its own.

use std::{path::Path, sync::Arc, time::Duration};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Class, Flags, Header, Kind, Message, MessageBuffer, Payload},
};

use super::{
    ApiError, Received, Registration, Transport,
    inbox::{Answer, Awaited, Inbox, Sorted},
    link::{self, Link, Read, Reader, Writer},
};
use crate::lncl::payload::{self, Group, Registered, Resolve};

/// Time that the node has to answer what it answers at once.
const PROMPT: Duration = Duration::from_secs(2);
/// Chunks of 64 KiB that are read before the caller has its turn. In tests each read is the last of its look: a message
/// that ends with it must not be left lying until more comes.
const READS_PER_LOOK: usize = if cfg!(test) { 1 } else { 16 };
/// Looks for the last words of a node that has gone.
const LAST_LOOKS: usize = 64;
const LNCL: Tid = payload::lncl_of(NodeAddress::HERE);

/// A registered transport address: sends and receives, from one thread at a time.
///
/// Dropping it gives the address back at once; [`unregister`](Self::unregister) waits until the node has taken it.
pub struct Endpoint {
    tid: Tid,
    node_name: String,
    payload_max: usize,
    writer: Arc<Writer>,
    reader: Reader,
    inbox: Inbox,
    sequence: u64,
    correlation: u64,
    /// Why the connection has ended, once it has.
    ended: Option<String>,
}

impl std::fmt::Debug for Endpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Endpoint({})", self.tid)
    }
}

/// What to do with messages that find the inbox full.
#[derive(Clone, Copy, PartialEq, Eq)]
enum WhenFull {
    /// They stay in the socket: somebody is about to make room.
    Leave,
    /// They are refused: the answer that is waited for may be behind them.
    Refuse,
}

impl Endpoint {
    pub(super) fn register(path: &Path, registration: Registration) -> Result<Self, ApiError> {
        let Registration { register, deadline, inbox_capacity, link } = registration;
        let Some(link) = link::open(path, &register, Time::now() + deadline, link)? else {
            return Err(match register.requires {
                requires if requires.is_empty() => ApiError::NoAnswer(deadline),
                requires => ApiError::Waiting { requires, waited: deadline },
            });
        };
        let Link { registered, writer, reader } = link;
        let Registered { node, app, node_name, payload_max, ring: _ } = registered;
        let inbox = Inbox::new(inbox_capacity, writer.clone());
        Ok(Self {
            tid: Tid::new(node, app),
            node_name,
            payload_max: payload_max as usize,
            writer,
            reader,
            inbox,
            sequence: 0,
            correlation: 0,
            ended: None,
        })
    }

    /// The address that was registered.
    #[must_use]
    pub const fn tid(&self) -> Tid {
        self.tid
    }

    /// What carries the messages: what was asked for, or the socket where the system or the node has no rings.
    #[must_use]
    pub fn transport(&self) -> Transport {
        self.writer.transport()
    }

    /// The name of the node.
    #[must_use]
    pub fn node_name(&self) -> &str {
        &self.node_name
    }

    /// Longest payload that the node takes, in bytes.
    #[must_use]
    pub const fn payload_max(&self) -> usize {
        self.payload_max
    }

    /// Writable memory of `length` bytes for a raw payload of `kind` (the paper's CreateMessage).
    ///
    /// # Errors
    /// It would be longer than the node takes.
    pub fn create_message(
        &self,
        destination: Tid,
        kind: Kind,
        length: usize,
    ) -> Result<MessageBuffer, ApiError> {
        self.check_length(length)?;
        Ok(MessageBuffer::new(Header::new(kind, self.tid, destination), length))
    }

    /// Sends memory that [`create_message`](Self::create_message) lent (the paper's SendMessage). Returns when the
    /// socket to the node has taken it; what becomes of it then is not told.
    ///
    /// # Errors
    /// It was not sent.
    pub fn send_message(&mut self, buffer: MessageBuffer) -> Result<(), ApiError> {
        self.dispatch(buffer.freeze())
    }

    /// Sends a value, in the class of its type. Returns when the socket to the node has taken it.
    ///
    /// # Errors
    /// It was not sent.
    pub fn send<P: Payload>(&mut self, destination: Tid, value: &P) -> Result<(), ApiError> {
        self.dispatch(Message::typed(self.tid, destination, value))
    }

    /// Sends a value and waits for what becomes of it: [`Outcome::Unknown`] when nobody has said so `within` this
    /// time. The message expires where it waits when it is older. Messages that come meanwhile wait to be
    /// [received](Self::receive).
    ///
    /// # Errors
    /// It was not sent, or the connection ended before the outcome was known.
    pub fn send_confirmed<P: Payload>(
        &mut self,
        destination: Tid,
        value: &P,
        within: Duration,
    ) -> Result<Outcome, ApiError> {
        self.confirm(Message::typed(self.tid, destination, value), within)
    }

    /// Sends a request and waits for the reply.
    ///
    /// # Errors
    /// It was not sent or not handled, no reply came `within` this time, or the reply is not an `R`.
    pub fn ask<P: Payload, R: Payload>(
        &mut self,
        destination: Tid,
        request: &P,
        within: Duration,
    ) -> Result<R, ApiError> {
        Ok(self.await_reply(Message::typed(self.tid, destination, request), within)?.decode()?)
    }

    /// Answers a request.
    ///
    /// # Errors
    /// The message asks for no reply, or the reply was not sent.
    pub fn reply<R: Payload>(&mut self, request: &Received, value: &R) -> Result<(), ApiError> {
        self.answer(request, Message::typed(self.tid, request.source(), value))
    }

    /// Waits for a message, at most `within` this time; `None` if none came (the paper's ReceiveMessage). Control
    /// comes first, then Stream, of which only the newest value of each source and kind, then Bulk.
    ///
    /// # Errors
    /// The connection has ended, and everything that came before was received.
    pub fn receive(&mut self, within: Duration) -> Result<Option<Received>, ApiError> {
        let deadline = Time::now() + within;
        loop {
            // The socket first: what came just now may be more urgent or newer than what waits.
            self.take_in(None, WhenFull::Leave)?;
            if let Some(message) = self.inbox.pop(Time::now()) {
                return Ok(Some(Received::new(message)));
            }
            if let Some(why) = &self.ended {
                return Err(ApiError::Closed(why.clone()));
            }
            // The clock is asked by us: a flood keeps the link readable for ever.
            if Time::now() >= deadline {
                return Ok(None);
            }
            self.reader.wait(deadline);
        }
    }

    /// Joins the group called `name`: what is sent to [`Tid::group`] reaches this endpoint from now on.
    ///
    /// # Errors
    /// It is a member of 256 groups already, or the node did not answer.
    pub fn join(&mut self, name: &str) -> Result<(), ApiError> {
        self.set_member(AppAddress::group(name), true)
    }

    /// Leaves the group called `name`.
    ///
    /// # Errors
    /// The node did not answer.
    pub fn leave(&mut self, name: &str) -> Result<(), ApiError> {
        self.set_member(AppAddress::group(name), false)
    }

    /// The TID that has `name` now, on any node; `None` if nobody has it.
    ///
    /// # Errors
    /// The node did not answer `within` this time.
    pub fn resolve(&mut self, name: &str, within: Duration) -> Result<Option<Tid>, ApiError> {
        let asked = Resolve { name: name.to_owned() };
        let message = payload::frame(Kind::LNCL_RESOLVE, self.tid, LNCL, &asked);
        match self.request(message, Awaited::Resolved, Flags::NONE, within)? {
            Some(Answer::Resolved(tid)) => Ok(tid),
            Some(Answer::Outcome(_) | Answer::Reply(_)) | None => Err(ApiError::NoAnswer(within)),
        }
    }

    /// Gives the address back and waits until the node has taken it: the name is free when this returns.
    ///
    /// # Errors
    /// The node did not answer. The address is given back in any case.
    pub fn unregister(mut self) -> Result<(), ApiError> {
        self.inbox.close();
        let goodbye = Message::new(Header::new(Kind::LNCL_UNREGISTER, self.tid, LNCL), bytes::Bytes::new());
        self.writer.write(&goodbye)?;
        let deadline = Time::now() + PROMPT;
        while self.ended.is_none() {
            self.take_in(None, WhenFull::Refuse)?;
            self.inbox.close();
            if self.ended.is_some() {
                break;
            }
            if Time::now() >= deadline {
                return Err(ApiError::NoAnswer(PROMPT));
            }
            self.reader.wait(deadline);
        }
        Ok(())
    }

    fn set_member(&mut self, group: AppAddress, member: bool) -> Result<(), ApiError> {
        let message = payload::frame(Kind::LNCL_GROUP, self.tid, LNCL, &Group { group, member });
        match self.request(message, Awaited::Outcome, Flags::CONFIRM, PROMPT)? {
            Some(Answer::Outcome(Outcome::Delivered)) => Ok(()),
            Some(Answer::Outcome(outcome)) => Err(ApiError::Ended(outcome)),
            Some(Answer::Reply(_) | Answer::Resolved(_)) | None => Err(ApiError::NoAnswer(PROMPT)),
        }
    }

    /// Sends `message` and waits for its outcome.
    pub(super) fn confirm(&mut self, mut message: Message, within: Duration) -> Result<Outcome, ApiError> {
        if message.header.class == Class::Stream {
            // Of a Stream the newest wins, so an older one has no outcome of its own.
            return Ok(Outcome::Rejected(Rejection::Unsupported));
        }
        message.header.time_to_live_us = in_micros(within);
        match self.request(message, Awaited::Outcome, Flags::CONFIRM, within)? {
            Some(Answer::Outcome(outcome)) => Ok(outcome),
            Some(Answer::Reply(_) | Answer::Resolved(_)) | None => Ok(Outcome::Unknown),
        }
    }

    /// Sends `message` as a request and waits for the reply.
    pub(super) fn await_reply(
        &mut self,
        mut message: Message,
        within: Duration,
    ) -> Result<Message, ApiError> {
        message.header.class = Class::Control;
        message.header.time_to_live_us = in_micros(within);
        match self.request(message, Awaited::Reply, Flags::CONFIRM.with(Flags::ASK), within)? {
            Some(Answer::Reply(reply)) => Ok(reply),
            Some(Answer::Outcome(outcome)) => Err(ApiError::Ended(outcome)),
            Some(Answer::Resolved(_)) | None => Err(ApiError::NoReply(within)),
        }
    }

    /// Sends `message` as the reply to `request`.
    pub(super) fn answer(&mut self, request: &Received, mut message: Message) -> Result<(), ApiError> {
        if !request.wants_reply() {
            return Err(ApiError::NotAsked);
        }
        message.header.destination = request.source();
        message.header.class = Class::Control;
        message.header.flags = Flags::REPLY;
        message.header.correlation = request.correlation();
        self.dispatch(message)
    }

    /// Sends `message` and waits for its answer; `None` at the deadline.
    fn request(
        &mut self,
        mut message: Message,
        awaited: Awaited,
        flags: Flags,
        within: Duration,
    ) -> Result<Option<Answer>, ApiError> {
        self.correlation += 1;
        message.header.correlation = self.correlation;
        message.header.flags = message.header.flags.with(flags);
        let (number, deadline) = (self.correlation, Time::now() + within);
        self.dispatch(message)?;
        loop {
            if let Some(answer) = self.take_in(Some((number, awaited)), WhenFull::Refuse)? {
                return Ok(Some(answer));
            }
            if let Some(why) = &self.ended {
                return Err(ApiError::Closed(why.clone()));
            }
            // The clock is asked by us: a flood keeps the link readable for ever.
            if Time::now() >= deadline {
                return Ok(None);
            }
            self.reader.wait(deadline);
        }
    }

    fn dispatch(&mut self, mut message: Message) -> Result<(), ApiError> {
        self.check_length(message.payload.len())?;
        self.sequence += 1;
        message.header.sequence = self.sequence;
        message.header.sent = Time::now();
        if self.reader.has_ended(message.header.sent) {
            return Err(self.explain(ApiError::Closed("the node has gone".to_owned())));
        }
        self.writer.write(&message).map_err(|error| self.explain(error))
    }

    /// What the node said before it closed the connection says more than a broken pipe does.
    fn explain(&mut self, error: ApiError) -> ApiError {
        if !matches!(error, ApiError::Closed(_)) {
            return error;
        }
        for _ in 0..LAST_LOOKS {
            // The error to tell is the first one.
            if self.ended.is_some() || self.take_in(None, WhenFull::Refuse).is_err() {
                break;
            }
        }
        self.ended.clone().map_or(error, ApiError::Closed)
    }

    fn check_length(&self, length: usize) -> Result<(), ApiError> {
        if length > self.payload_max {
            return Err(ApiError::TooLong { length, limit: self.payload_max });
        }
        Ok(())
    }

    /// Sorts in what has come so far, without waiting. Returns the answer that is awaited, if it was there.
    fn take_in(
        &mut self,
        awaited: Option<(u64, Awaited)>,
        when_full: WhenFull,
    ) -> Result<Option<Answer>, ApiError> {
        self.writer.pay();
        for read in 0.. {
            if let Some(answer) = self.sort_in(awaited, when_full)? {
                return Ok(Some(answer));
            }
            let is_full = when_full == WhenFull::Leave && !self.inbox.has_room();
            if is_full || read == READS_PER_LOOK {
                return Ok(None);
            }
            match self.reader.read() {
                Read::Some => {}
                Read::Nothing => return Ok(None),
                Read::Ended(why) => {
                    self.ended.get_or_insert(why);
                    return Ok(None);
                }
            }
        }
        Ok(None)
    }

    /// Sorts in what has been read.
    fn sort_in(
        &mut self,
        awaited: Option<(u64, Awaited)>,
        when_full: WhenFull,
    ) -> Result<Option<Answer>, ApiError> {
        while when_full == WhenFull::Refuse || self.inbox.has_room() {
            let Some(message) = self.reader.next()? else { break };
            match self.inbox.sort(message, awaited) {
                Sorted::Answer(answer) => return Ok(Some(answer)),
                Sorted::Refusal(sentence) => self.ended = Some(sentence),
                Sorted::Message | Sorted::Nothing => {}
            }
        }
        Ok(None)
    }
}

impl Drop for Endpoint {
    fn drop(&mut self) {
        // What has come and was not looked at is refused, too. An error ends the connection, as this does.
        let _ = self.take_in(None, WhenFull::Refuse);
        self.inbox.close();
        // A message that is still in some thread's hand ends as `Failed`.
        self.writer.close();
    }
}

/// At least one: zero would mean for ever.
fn in_micros(within: Duration) -> u32 {
    u32::try_from(within.as_micros()).unwrap_or(u32::MAX).max(1)
}
