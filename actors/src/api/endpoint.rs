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
    direct::{Came, Direct, Everything, Sent, Terms, ToNode},
    inbox::{Answer, Awaited, Inbox, Sorted},
    link::{Ended, Greeting, Link, Read, Reader, Writer},
    returning::Home,
    routes::LinkNumber,
};
use crate::{
    lncl::payload::{self, Group, Registered, Resolve},
    ring::Taken,
};

/// Time that the node has to answer what it answers at once.
const PROMPT: Duration = Duration::from_secs(2);
/// Chunks of 64 KiB that are read before the caller has its turn. In tests each read is the last of its look: a message
/// that ends with it must not be left lying until more comes.
const READS_PER_LOOK: usize = if cfg!(test) { 1 } else { 16 };
/// Looks for the last words of a node that has gone.
const LAST_LOOKS: usize = 64;
pub(super) const LNCL: Tid = payload::lncl_of(NodeAddress::HERE);

/// A registered transport address: sends and receives, from one thread at a time.
///
/// Dropping it gives the address back at once; [`unregister`](Self::unregister) waits until the node has taken it.
pub struct Endpoint {
    pub(super) tid: Tid,
    pub(super) node_name: String,
    pub(super) payload_max: usize,
    pub(super) writer: Arc<Writer>,
    pub(super) reader: Reader,
    /// Links to other processes that the node is not on the way of.
    pub(super) direct: Direct,
    pub(super) inbox: Inbox,
    sequence: u64,
    pub(super) correlation: u64,
    /// Why the connection has ended, once it has.
    pub(super) ended: Option<Ended>,
    pub(super) home: Home,
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
        let Registration { mut register, deadline, inbox_capacity, link: options, returning } = registration;
        let Some(link) = Greeting::begin(path, &register, options)?.wait(Time::now() + deadline)? else {
            return Err(match register.requires {
                requires if requires.is_empty() => ApiError::NoAnswer(deadline),
                requires => ApiError::Waiting { requires, waited: deadline },
            });
        };
        let Link { registered, writer, reader, node: node_process } = link;
        let terms = Terms::of(&registered, options);
        let Registered { node, app, node_name, payload_max, ring: _ } = registered;
        let control = reader.control().filter(|_| register.direct);
        let inbox = Inbox::new(inbox_capacity, writer.clone());
        register.former = Some(app);
        Ok(Self {
            tid: Tid::new(node, app),
            node_name,
            payload_max: payload_max as usize,
            writer,
            reader,
            direct: Direct::new(terms, control),
            inbox,
            sequence: 0,
            correlation: 0,
            ended: None,
            home: Home::new(path.to_owned(), register, options, returning, node_process),
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
        self.dispatch(buffer.freeze()).map(drop)
    }

    /// Sends a value, in the class of its type. Returns when the socket to the node has taken it.
    ///
    /// # Errors
    /// It was not sent.
    pub fn send<P: Payload>(&mut self, destination: Tid, value: &P) -> Result<(), ApiError> {
        self.dispatch(Message::typed(self.tid, destination, value)).map(drop)
    }

    /// Sends a value and waits for what becomes of it: [`Outcome::Unknown`] when nobody has said so `within` this
    /// time. The message expires where it waits when it is older. Messages that come meanwhile wait to be
    /// [received](Self::receive).
    ///
    /// # Errors
    /// It was not sent. If the connection ends before the outcome is known that is [`Outcome::Unknown`].
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
    /// When the connection has ended, through no fault of this endpoint, it registers again: the first call says so with
    /// [`ApiError::Away`], each later one waits for the node's return as for a message.
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
            if let Some(ended) = self.ended.clone() {
                self.tell(&ended)?;
                if Time::now() >= deadline {
                    return Ok(None);
                }
                self.await_return(deadline);
                continue;
            }
            // The clock is asked by us: a flood keeps the link readable for ever.
            if Time::now() >= deadline {
                return Ok(None);
            }
            self.wait(deadline);
        }
    }

    /// How often this endpoint has registered: 1, and one more each time that it came back after its connection had
    /// ended. Its address may be another one since then if somebody else has got the former one.
    #[must_use]
    pub const fn registrations(&self) -> u64 {
        self.home.registrations
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
        if self.ended.is_some() {
            // The connection has taken the address with it.
            return Ok(());
        }
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
            self.wait(deadline);
        }
        Ok(())
    }

    fn set_member(&mut self, group: AppAddress, member: bool) -> Result<(), ApiError> {
        let message = payload::frame(Kind::LNCL_GROUP, self.tid, LNCL, &Group { group, member });
        match self.request(message, Awaited::Outcome, Flags::CONFIRM, PROMPT)? {
            Some(Answer::Outcome(Outcome::Delivered)) => {
                if member {
                    self.home.groups.insert(group);
                } else {
                    self.home.groups.remove(&group);
                }
                Ok(())
            }
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
        self.dispatch(message).map(drop)
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
        let of = self.absolute(message.header.destination);
        let wanted = Wanted { number: self.correlation, what: awaited, of };
        let deadline = Time::now() + within;
        let way = self.dispatch(message)?;
        loop {
            if let Some(answer) = self.take_in(Some(wanted), WhenFull::Refuse)? {
                return Ok(Some(answer));
            }
            // spec: LNCL-7. The link has ended with the message in the peer's hand.
            if way.is_some_and(|link| !self.direct.has(link)) {
                return Ok(Some(Answer::Outcome(Outcome::Failed)));
            }
            if way.is_none() && self.ended.is_some() {
                // Nobody can say any more.
                return Ok(Some(Answer::Outcome(Outcome::Unknown)));
            }
            // The clock is asked by us: a flood keeps the link readable for ever.
            if Time::now() >= deadline {
                return Ok(None);
            }
            self.wait(deadline);
        }
    }

    /// Sends `message` the way that is right now; the link, if it did not go through the node.
    fn dispatch(&mut self, mut message: Message) -> Result<Option<LinkNumber>, ApiError> {
        self.try_return();
        self.check_length(message.payload.len())?;
        // A new connection may have another address.
        message.header.source = self.tid;
        self.sequence += 1;
        message.header.sequence = self.sequence;
        let now = Time::now();
        message.header.sent = now;
        let destination = self.absolute(message.header.destination);
        let mut node = ToNode { writer: &self.writer, correlation: &mut self.correlation };
        self.direct.look(now, &mut node);
        if self.direct.is_asking(now) {
            // Who only sends looks here for the answer. What it cannot sort in, or read, shows when it receives.
            let _ = self.take_in_from_node(None, WhenFull::Leave);
        }
        let mut node = ToNode { writer: &self.writer, correlation: &mut self.correlation };
        if let Some(link) = self.direct.way(destination, now, &mut node) {
            message.header.destination = destination;
            match self.direct.send(link, message, now)? {
                Sent::Taken => return Ok(Some(link)),
                Sent::Gone(back) => message = back,
            }
        }
        self.be_there()?;
        if self.reader.has_ended(now) {
            return Err(self.explain(ApiError::Closed("the node has gone".to_owned())));
        }
        self.writer.write(&message).map(|()| None).map_err(|error| self.explain(error))
    }

    const fn absolute(&self, destination: Tid) -> Tid {
        if matches!(destination.node, NodeAddress::HERE) {
            Tid::new(self.tid.node, destination.app)
        } else {
            destination
        }
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
        self.ended.as_ref().map_or(error, |ended| self.gone(ended))
    }

    fn check_length(&self, length: usize) -> Result<(), ApiError> {
        if length > self.payload_max {
            return Err(ApiError::TooLong { length, limit: self.payload_max });
        }
        Ok(())
    }

    /// Sorts in what has come so far, without waiting. Returns the answer that is awaited, if it was there.
    fn take_in(&mut self, wanted: Option<Wanted>, when_full: WhenFull) -> Result<Option<Answer>, ApiError> {
        // The node first: there a peer may say that from now on its link is read.
        let answer = self.take_in_from_node(wanted, when_full)?;
        if answer.is_some() || self.direct.is_empty() {
            return Ok(answer);
        }
        let mut node = ToNode { writer: &self.writer, correlation: &mut self.correlation };
        self.direct.look(Time::now(), &mut node);
        // From the last one on: one that ends makes no other one's turn go by.
        let links = (0..self.direct.open.len()).rev();
        Ok(links.into_iter().find_map(|index| self.take_in_from_link(index, wanted, when_full)))
    }

    fn take_in_from_node(
        &mut self,
        wanted: Option<Wanted>,
        when_full: WhenFull,
    ) -> Result<Option<Answer>, ApiError> {
        self.writer.pay();
        for read in 0.. {
            if let Some(answer) = self.sort_in(wanted, when_full)? {
                return Ok(Some(answer));
            }
            let is_full = when_full == WhenFull::Leave && !self.inbox.has_room();
            if is_full || read == READS_PER_LOOK {
                return Ok(None);
            }
            match self.reader.read() {
                Read::Some => {}
                Read::Nothing => return Ok(None),
                Read::Ended(ended) => {
                    self.end(ended);
                    return Ok(None);
                }
            }
        }
        Ok(None)
    }

    /// Sorts in what has been read from the node.
    fn sort_in(&mut self, wanted: Option<Wanted>, when_full: WhenFull) -> Result<Option<Answer>, ApiError> {
        while when_full == WhenFull::Refuse || self.inbox.has_room() {
            let Some(message) = self.reader.next()? else { break };
            let Some(message) = self.heed(message, wanted) else { continue };
            match self.inbox.sort(message, wanted.map(Wanted::at_node)) {
                Sorted::Answer(answer) => return Ok(Some(answer)),
                Sorted::Refusal(refusal) => self.end(refusal.into()),
                Sorted::Message | Sorted::Nothing => {}
            }
        }
        Ok(None)
    }

    /// Hands back what is not about direct links.
    fn heed(&mut self, message: Message, wanted: Option<Wanted>) -> Option<Message> {
        let Header { kind, correlation, .. } = message.header;
        if kind.is_user() || wanted.is_some_and(|wanted| wanted.number == correlation) {
            return Some(message);
        }
        let mut node = ToNode { writer: &self.writer, correlation: &mut self.correlation };
        self.direct.heed(message, Time::now(), &mut node)
    }

    /// Sorts in what has come so far on an open link.
    fn take_in_from_link(
        &mut self,
        index: usize,
        wanted: Option<Wanted>,
        when_full: WhenFull,
    ) -> Option<Answer> {
        for read in 0.. {
            while when_full == WhenFull::Refuse || self.inbox.has_room() {
                let link = &mut self.direct.open[index];
                let awaited = wanted.and_then(|wanted| wanted.on_link_with(link.peer));
                match link.next() {
                    Ok(Came::Nothing) => break,
                    Ok(Came::Refused) => {}
                    Ok(Came::Message(message)) => {
                        if let Sorted::Answer(answer) = self.inbox.sort_from(&link.sink, message, awaited) {
                            return Some(answer);
                        }
                    }
                    Err(why) => return self.direct.fail(index, &why),
                }
            }
            let is_full = when_full == WhenFull::Leave && !self.inbox.has_room();
            if is_full || read == READS_PER_LOOK {
                return None;
            }
            match self.direct.open[index].take() {
                Ok(Taken::Some) => {}
                Ok(Taken::Nothing) => return None,
                Err(why) => return self.direct.fail(index, &why),
            }
        }
        None
    }

    /// Waits until something comes, from the node or from a link, or until there is something to do.
    fn wait(&mut self, deadline: Time) {
        match &mut self.reader {
            Reader::Ring(reader) if !self.direct.open.is_empty() => {
                let deadline = self.direct.wake_by(deadline);
                let links = &mut self.direct.open[..];
                let ended = reader.wait_for_all(deadline, |node| Everything { node, links });
                reader.note(&ended);
                self.direct.note(&ended);
            }
            Reader::Ring(_) | Reader::Socket(_) => self.reader.wait(deadline),
        }
    }
}

/// The answer that a call waits for.
#[derive(Clone, Copy)]
struct Wanted {
    number: u64,
    what: Awaited,
    /// Who says it.
    of: Tid,
}

impl Wanted {
    /// What the node passes on is from whom it says it is.
    const fn at_node(self) -> (u64, Awaited) {
        (self.number, self.what)
    }

    /// On its own link nobody answers for others.
    fn on_link_with(self, peer: Tid) -> Option<(u64, Awaited)> {
        (peer == self.of).then_some((self.number, self.what))
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
