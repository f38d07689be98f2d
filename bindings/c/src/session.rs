//! An endpoint with the messages that the program holds. Safe code: it knows C only by the tokens that C
//! passes.

use std::{collections::BTreeMap, ffi::CString, time::Duration};

use sinew_client::{ApiError, LoanedMessage, MessageBuilder};
use sinew_runtime::{
    outcome::{MemberOutcome, Outcome},
    protection::{
        SealError,
        raw::{ECHO, Judged},
    },
    tid::{NodeAddress, Tid},
    time::Time,
    wire::{Class, Kind},
};

use crate::{
    handles::HandleTable,
    message::{Message, Received, class_of},
    protection::{
        Ends, SINEW_SEALED_HEAD, SINEW_SEALED_OVERHEAD, Typed,
        guards::{self, Found, Output},
        names,
    },
    status::{CallError, Status},
};

/// Maximum number of messages under construction: an endpoint loans one at a time.
const DRAFTS_MAX: usize = 1;
/// Maximum number of received messages that are not settled.
const RECEIVED_MAX: usize = 1024;
/// Maximum number of messages not for the program that one call processes after its deadline. With 0, a
/// program that only polls would never catch up; without a limit, a flood would never end the call.
const SETTLED_MAX: usize = 1024;

/// A message under construction, and its send options.
pub(crate) struct Draft {
    buffer: LoanedMessage,
    /// Time that its sending waits for room; `None`: the stall timeout of the endpoint.
    room_within: Option<Duration>,
}

/// A registered endpoint.
pub(crate) struct Session {
    endpoint: sinew_client::Endpoint,
    node_name: CString,
    drafts: HandleTable<Draft>,
    received: HandleTable<sinew_client::Received>,
    /// The flows of protected payloads that it sends and receives.
    ends: Ends,
    /// The names of their types: a sender takes no lock of the process for them.
    names: BTreeMap<Kind, &'static str>,
}

impl Session {
    pub(crate) fn new(endpoint: sinew_client::Endpoint) -> Self {
        // A node's name has no control characters.
        let node_name = CString::new(endpoint.node_name()).unwrap_or_default();
        let (drafts, received) = (HandleTable::new(DRAFTS_MAX), HandleTable::new(RECEIVED_MAX));
        Self { endpoint, node_name, drafts, received, ends: Ends::new(Time::now()), names: BTreeMap::new() }
    }

    pub(crate) const fn endpoint(&mut self) -> &mut sinew_client::Endpoint {
        &mut self.endpoint
    }

    /// It stays in place until the endpoint is unregistered.
    pub(crate) fn node_name(&self) -> &std::ffi::CStr {
        &self.node_name
    }

    pub(crate) fn create(
        &mut self,
        destination: Tid,
        kind: Kind,
        class: i32,
        length: usize,
    ) -> Result<Message, CallError> {
        let buffer = self.loan((destination, kind, class), length)?;
        self.insert_draft(buffer)
    }

    /// Creates a message of `length` bytes and fills it with `write`; after an error there is no message.
    pub(crate) fn create_with(
        &mut self,
        to: (Tid, Kind, i32),
        length: usize,
        write: impl FnOnce(&mut [u8]) -> Result<(), CallError>,
    ) -> Result<Message, CallError> {
        let mut buffer = self.loan(to, length)?;
        write(&mut buffer)?;
        self.insert_draft(buffer)
    }

    fn loan(&mut self, to: (Tid, Kind, i32), length: usize) -> Result<LoanedMessage, CallError> {
        let (destination, kind, class) = to;
        let class = class_of(class).ok_or_else(|| {
            CallError::argument(format!("`message_class` is {class}: take one of sinew_message_class"))
        })?;
        let mut buffer = self.endpoint.create_message(destination, kind, length)?;
        buffer.set_class(class);
        Ok(buffer)
    }

    fn insert_draft(&mut self, mut buffer: LoanedMessage) -> Result<Message, CallError> {
        let (bytes, length) = (buffer.as_mut_ptr(), buffer.len());
        match self.drafts.insert(Draft { buffer, room_within: None }) {
            Ok(token) => Ok(Message { bytes, length, token }),
            // The buffer is dropped; every message under construction is on loan.
            Err(_) => Err(CallError::plain(Status::SinewErrorLoanActive)),
        }
    }

    /// Sets the time to live of a message under construction.
    pub(crate) fn set_expires_after(&mut self, message: &Message, time_ns: u64) -> Result<(), CallError> {
        if time_ns == 0 {
            let sentence = "the time to live is 0, so that no message would arrive; for a message that does not expire do not set one";
            return Err(CallError::argument(sentence));
        }
        self.draft(message)?.buffer.set_expires_after(Duration::from_nanos(time_ns));
        Ok(())
    }

    /// Sets the longest time that the sending of a message under construction waits for room.
    pub(crate) fn set_room_within(&mut self, message: &Message, within: Duration) -> Result<(), CallError> {
        self.draft(message)?.room_within = Some(within);
        Ok(())
    }

    fn draft(&mut self, message: &Message) -> Result<&mut Draft, CallError> {
        self.drafts.get_mut(message.token).ok_or_else(|| no_such("the message"))
    }

    /// Copies a payload into a message of the same length.
    pub(crate) fn fill(&mut self, message: &Message, payload: &[u8]) {
        if let Some(draft) = self.drafts.get_mut(message.token) {
            draft.buffer.copy_from_slice(payload);
        }
    }

    pub(crate) fn discard(&mut self, message: &mut Message) -> Result<(), CallError> {
        self.take(message).map(drop)
    }

    pub(crate) fn send(&mut self, message: &mut Message) -> Result<(), CallError> {
        let draft = self.take(message)?;
        Ok(self.builder(draft).send()?)
    }

    /// Returns the message with its send options.
    fn builder(&mut self, draft: Draft) -> MessageBuilder<'_, sinew_client::Endpoint, LoanedMessage> {
        let builder = self.endpoint.loaned(draft.buffer);
        match draft.room_within {
            None => builder,
            Some(within) => builder.room_within(within),
        }
    }

    pub(crate) fn send_confirmed(&mut self, draft: Draft, within: Duration) -> Result<Outcome, CallError> {
        Ok(self.builder(draft).confirmed(within)?)
    }

    pub(crate) fn send_confirmed_by_each(
        &mut self,
        draft: Draft,
        within: Duration,
    ) -> Result<Vec<MemberOutcome>, CallError> {
        Ok(self.builder(draft).confirmed_by_each(within)?)
    }

    /// Sends a request; the error includes the outcome of a request that was not handled.
    pub(crate) fn ask(
        &mut self,
        draft: Draft,
        within: Duration,
    ) -> Result<Result<Received, (Outcome, CallError)>, CallError> {
        self.check_room()?;
        match self.builder(draft).ask_raw(within) {
            Ok(reply) => self.deliver(reply).map(Ok),
            Err(ApiError::Ended(outcome)) => Ok(Err((outcome, ApiError::Ended(outcome).into()))),
            Err(error) => Err(error.into()),
        }
    }

    pub(crate) fn reply(&mut self, request: &Received, draft: Draft) -> Result<(), CallError> {
        let Self { endpoint, received, .. } = self;
        let Some(request) = received.get_mut(request.token) else { return Err(no_such("the request")) };
        let builder = endpoint.loaned(draft.buffer);
        Ok(match draft.room_within {
            None => builder.reply_to(request),
            Some(within) => builder.room_within(within).reply_to(request),
        }?)
    }

    /// Checks that a protected payload of this length can be sent.
    pub(crate) fn check_length(&self, length: usize) -> Result<(), CallError> {
        let longest = self.endpoint.payload_max().saturating_sub(SINEW_SEALED_OVERHEAD);
        if length <= longest {
            return Ok(());
        }
        let sentence = format!("`length` is {length}, and the longest protected payload has {longest} bytes");
        Err(CallError::new(Status::SinewErrorTooLong, sentence))
    }

    /// `within` is `None` for the stall timeout of the endpoint.
    pub(crate) fn send_protected(
        &mut self,
        destination: Tid,
        typed: &Typed<'_>,
        payload: &[u8],
        within: Option<Duration>,
    ) -> Result<(), CallError> {
        typed.check_length(payload.len())?;
        let (source, receiver) = (self.endpoint.tid(), self.absolute(destination));
        if !receiver.is_single() {
            let sentence =
                "a protected message is for one application, not for a group or for all; send it to each";
            return Err(CallError::argument(sentence));
        }
        let protected = typed.protected(self.name_of(typed)?);
        let length = payload.len().saturating_add(SINEW_SEALED_OVERHEAD);
        // First, since it rejects lengths that cannot be sent: then no counter value is used up.
        let mut message = self.create(destination, typed.kind, typed.message_class, length)?;
        match self.ends.seal((source, receiver), &protected, payload, Time::now()) {
            Ok(sealed) => self.fill(&message, &sealed),
            Err(error) => {
                self.discard(&mut message)?;
                return Err(error.into());
            }
        }
        if let Some(within) = within {
            self.set_room_within(&message, within)?;
        }
        self.send(&mut message)
    }

    /// Returns the name of a type with static lifetime.
    fn name_of(&mut self, typed: &Typed<'_>) -> Result<&'static str, CallError> {
        let name = match self.names.get(&typed.kind) {
            Some(name) => *name,
            None => names::kept(typed.name)?,
        };
        if name != typed.name {
            let sentence =
                format!("'{}' hashes as another type's name does; call it something else", typed.name);
            return Err(CallError::argument(sentence));
        }
        self.names.insert(typed.kind, name);
        Ok(name)
    }

    /// Guards the messages of this type from `source`. Returns the guard's handle, and the state of its
    /// output.
    pub(crate) fn guard(
        &mut self,
        source: Tid,
        typed: &Typed<'_>,
        output: Output,
    ) -> Result<(usize, Found), CallError> {
        let (source, own) = (self.absolute(source), self.endpoint.tid());
        let protected = typed.protected(self.name_of(typed)?);
        if self.ends.is_held(source, typed.kind) {
            let sentence = format!(
                "the messages of '{}' from {source} are guarded already: keep that guard",
                typed.name
            );
            return Err(CallError::argument(sentence));
        }
        guards::make_held(&mut self.ends, (source, own), protected, output)
    }

    pub(crate) fn receive(&mut self, within: Duration) -> Result<Option<Received>, CallError> {
        if !self.ends.are_idle() {
            // Guards handle the messages and echoes that arrive, and the calling thread may be using one of
            // their outputs.
            guards::check_callback()?;
        }
        self.check_room()?;
        if self.ends.are_idle() {
            return match self.endpoint.receive(within)? {
                Some(received) => self.deliver(received).map(Some),
                None => Ok(None),
            };
        }
        let deadline = Time::now() + within;
        let mut settled = 0;
        loop {
            let now = Time::now();
            let until = deadline.min(self.send_echoes(now));
            match self.endpoint.receive(until.since(now))? {
                Some(received) => {
                    let from = (received.source(), received.kind());
                    match self.ends.judge(from, received.bytes()) {
                        Judged::Plain => return self.deliver(received).map(Some),
                        Judged::Good(_) => return self.deliver_unsealed(received).map(Some),
                        Judged::Settled(outcome) => received.settle(outcome),
                    }
                    settled += usize::from(Time::now() >= deadline);
                }
                None if Time::now() >= deadline => return Ok(None),
                // An echo is due.
                None => {}
            }
            if settled >= SETTLED_MAX {
                return Ok(None);
            }
        }
    }

    /// Sends due echoes to the senders of protected payloads; returns the time of the next one.
    fn send_echoes(&mut self, now: Time) -> Time {
        // Each echo that is due is postponed by its period.
        while let Some((to, echo)) = self.ends.echo_payload(now) {
            // If a message is on loan, or there is no room, the next echo replaces this one; the watchdog
            // covers the gap.
            if let Ok(mut message) = self.endpoint.create_message(to, ECHO, echo.len()) {
                message.set_class(Class::Stream);
                message.copy_from_slice(&echo);
                let _ = self.endpoint.loaned(message).room_within(Duration::ZERO).send();
            }
        }
        self.ends.echo_due().unwrap_or(Time::MAX)
    }

    fn absolute(&self, tid: Tid) -> Tid {
        if tid.node == NodeAddress::HERE { Tid::new(self.endpoint.tid().node, tid.app) } else { tid }
    }

    pub(crate) fn settle(&mut self, received: &mut Received, outcome: Outcome) -> Result<(), CallError> {
        let Some(message) = self.received.remove(received.token) else { return Err(no_such("the message")) };
        *received = Received::GONE;
        message.settle(outcome);
        Ok(())
    }

    /// Unregisters the address. Messages that the program holds were not handled completely, and fail.
    pub(crate) fn unregister(mut self) -> Result<(), CallError> {
        // One of these may be in the ring, through which the rest is sent.
        self.drafts.drain().for_each(drop);
        // No message arrives any more; the program still has the guards. Does not wait for them: the program
        // may be using an output of theirs now.
        self.ends.trip();
        for message in self.received.drain() {
            message.settle(Outcome::Failed);
        }
        Ok(self.endpoint.unregister()?)
    }

    /// Removes a message from those that the program holds: it is gone, even after a later error.
    pub(crate) fn take(&mut self, message: &mut Message) -> Result<Draft, CallError> {
        let Some(draft) = self.drafts.remove(message.token) else { return Err(no_such("the message")) };
        *message = Message::GONE;
        Ok(draft)
    }

    fn deliver(&mut self, received: sinew_client::Received) -> Result<Received, CallError> {
        let mut out = Received::of(&received, 0);
        match self.received.insert(received) {
            Ok(token) => {
                out.token = token;
                Ok(out)
            }
            // There was room at the check, and one thread at a time is in a call.
            Err(message) => {
                message.settle(Outcome::Failed);
                Err(CallError::plain(Status::SinewErrorTooMany))
            }
        }
    }

    /// Delivers a message that came through a guard, without its envelope.
    fn deliver_unsealed(&mut self, received: sinew_client::Received) -> Result<Received, CallError> {
        let payload = received.bytes().get(SINEW_SEALED_HEAD..).unwrap_or_default();
        let length = payload.len().saturating_sub(SINEW_SEALED_OVERHEAD - SINEW_SEALED_HEAD);
        let bytes = payload.as_ptr();
        Ok(Received { bytes, length, ..self.deliver(received)? })
    }

    fn check_room(&self) -> Result<(), CallError> {
        if self.received.is_full() {
            let sentence = format!("{RECEIVED_MAX} received messages are unsettled; settle them");
            return Err(too_many(sentence));
        }
        Ok(())
    }
}

impl From<SealError> for CallError {
    fn from(error: SealError) -> Self {
        let status = match error {
            SealError::ToMany => Status::SinewErrorInvalidArgument,
            SealError::TooManyFlows => Status::SinewErrorTooMany,
        };
        Self::new(status, error.to_string())
    }
}

fn too_many(sentence: String) -> CallError {
    CallError::new(Status::SinewErrorTooMany, sentence)
}

fn no_such(what: &str) -> CallError {
    let sentence =
        format!("{what} is no message of this endpoint; was it sent, discarded or settled already?");
    CallError::new(Status::SinewErrorNoSuchMessage, sentence)
}
