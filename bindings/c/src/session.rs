//! An endpoint with the messages that the program has in hand. Safe: all that is known of C is that it has tokens.

use std::{collections::BTreeMap, ffi::CString, time::Duration};

use sinew::{
    Class, NodeAddress, Outcome, Tid, Time,
    client::{ApiError, LoanedMessage, MessageBuilder},
    message::{Kind, MemberOutcome},
    protection::{
        SealError,
        raw::{ECHO, Judged},
    },
};

use crate::{
    hand::Hand,
    message::{Message, Received, class_of},
    protection::{
        Ends, SINEW_SEALED_HEAD, SINEW_SEALED_OVERHEAD, Typed,
        guards::{self, Found, Output},
        names,
    },
    status::{Fault, Status},
};

/// Messages that are being made at most: an endpoint lends one at a time.
const MADE_MAX: usize = 1;
/// Messages that were received and not settled at most.
const RECEIVED_MAX: usize = 1024;
/// Messages that are not for the program and that one call takes at most when its time is over: who never waits would be late for ever with
/// those, and a flood of them is to keep nobody.
const SETTLED_MAX: usize = 1024;

/// A message that is being made, and what is said about how it is sent.
pub(crate) struct Made {
    buffer: LoanedMessage,
    /// Time that its sending waits for room; `None`: the stall timeout of the endpoint.
    room_within: Option<Duration>,
}

/// A registered endpoint.
pub(crate) struct Session {
    endpoint: sinew::Endpoint,
    node_name: CString,
    made: Hand<Made>,
    received: Hand<sinew::client::Received>,
    /// What it sends and receives of protected payloads.
    ends: Ends,
    /// The names of their types: who sends takes no lock of the process for them.
    names: BTreeMap<Kind, &'static str>,
}

impl Session {
    pub(crate) fn new(endpoint: sinew::Endpoint) -> Self {
        // A node's name has no control characters.
        let node_name = CString::new(endpoint.node_name()).unwrap_or_default();
        let (made, received) = (Hand::new(MADE_MAX), Hand::new(RECEIVED_MAX));
        Self { endpoint, node_name, made, received, ends: Ends::new(Time::now()), names: BTreeMap::new() }
    }

    pub(crate) const fn endpoint(&mut self) -> &mut sinew::Endpoint {
        &mut self.endpoint
    }

    /// It stays where it is until the endpoint is unregistered.
    pub(crate) fn node_name(&self) -> &std::ffi::CStr {
        &self.node_name
    }

    pub(crate) fn create(
        &mut self,
        destination: Tid,
        kind: Kind,
        class: i32,
        length: usize,
    ) -> Result<Message, Fault> {
        let buffer = self.loan((destination, kind, class), length)?;
        self.hand_out_loan(buffer)
    }

    /// Creates a message of so many bytes and has them written; after an error there is no message.
    pub(crate) fn create_with(
        &mut self,
        to: (Tid, Kind, i32),
        length: usize,
        write: impl FnOnce(&mut [u8]) -> Result<(), Fault>,
    ) -> Result<Message, Fault> {
        let mut buffer = self.loan(to, length)?;
        write(&mut buffer)?;
        self.hand_out_loan(buffer)
    }

    fn loan(&mut self, to: (Tid, Kind, i32), length: usize) -> Result<LoanedMessage, Fault> {
        let (destination, kind, class) = to;
        let class = class_of(class).ok_or_else(|| {
            Fault::argument(format!("`message_class` is {class}: take one of sinew_message_class"))
        })?;
        let mut buffer = self.endpoint.create_message(destination, kind, length)?;
        buffer.set_class(class);
        Ok(buffer)
    }

    fn hand_out_loan(&mut self, mut buffer: LoanedMessage) -> Result<Message, Fault> {
        let (bytes, length) = (buffer.as_mut_ptr(), buffer.len());
        match self.made.take(Made { buffer, room_within: None }) {
            Ok(token) => Ok(Message { bytes, length, token }),
            // Dropped; there is none in the hand that is not lent.
            Err(_) => Err(Fault::plain(Status::SinewErrorLoanActive)),
        }
    }

    /// Has a message that is being made expire where it waits when it is older than this.
    pub(crate) fn set_expires_after(&mut self, message: &Message, time_ns: u64) -> Result<(), Fault> {
        if time_ns == 0 {
            let sentence = "the time to live is 0, so that no message would arrive; for a message that does not expire do not set one";
            return Err(Fault::argument(sentence));
        }
        self.made(message)?.buffer.set_expires_after(Duration::from_nanos(time_ns));
        Ok(())
    }

    /// Has the sending of a message that is being made wait for room no longer than this.
    pub(crate) fn set_room_within(&mut self, message: &Message, within: Duration) -> Result<(), Fault> {
        self.made(message)?.room_within = Some(within);
        Ok(())
    }

    fn made(&mut self, message: &Message) -> Result<&mut Made, Fault> {
        self.made.get_mut(message.token).ok_or_else(|| no_such("the message"))
    }

    /// Copies a payload into a message of the same length.
    pub(crate) fn fill(&mut self, message: &Message, payload: &[u8]) {
        if let Some(made) = self.made.get_mut(message.token) {
            made.buffer.copy_from_slice(payload);
        }
    }

    pub(crate) fn discard(&mut self, message: &mut Message) -> Result<(), Fault> {
        self.take(message).map(drop)
    }

    pub(crate) fn send(&mut self, message: &mut Message) -> Result<(), Fault> {
        let made = self.take(message)?;
        Ok(self.builder(made).send()?)
    }

    /// The message as it is sent.
    fn builder(&mut self, made: Made) -> MessageBuilder<'_, sinew::Endpoint, LoanedMessage> {
        let builder = self.endpoint.loaned(made.buffer);
        match made.room_within {
            None => builder,
            Some(within) => builder.room_within(within),
        }
    }

    pub(crate) fn send_confirmed(&mut self, made: Made, within: Duration) -> Result<Outcome, Fault> {
        Ok(self.builder(made).confirmed(within)?)
    }

    pub(crate) fn send_confirmed_by_each(
        &mut self,
        made: Made,
        within: Duration,
    ) -> Result<Vec<MemberOutcome>, Fault> {
        Ok(self.builder(made).confirmed_by_each(within)?)
    }

    /// Asks; what became of the request, too, if it was not handled.
    pub(crate) fn ask(
        &mut self,
        made: Made,
        within: Duration,
    ) -> Result<Result<Received, (Outcome, Fault)>, Fault> {
        self.check_hand()?;
        match self.builder(made).ask_raw(within) {
            Ok(reply) => self.hand_out(reply).map(Ok),
            Err(ApiError::Ended(outcome)) => Ok(Err((outcome, ApiError::Ended(outcome).into()))),
            Err(error) => Err(error.into()),
        }
    }

    pub(crate) fn reply(&mut self, request: &Received, made: Made) -> Result<(), Fault> {
        let Self { endpoint, received, .. } = self;
        let Some(request) = received.get_mut(request.token) else { return Err(no_such("the request")) };
        let builder = endpoint.loaned(made.buffer);
        Ok(match made.room_within {
            None => builder.reply_to(request),
            Some(within) => builder.room_within(within).reply_to(request),
        }?)
    }

    /// Whether a protected payload of so many bytes can be sent.
    pub(crate) fn check_length(&self, length: usize) -> Result<(), Fault> {
        let longest = self.endpoint.payload_max().saturating_sub(SINEW_SEALED_OVERHEAD);
        if length <= longest {
            return Ok(());
        }
        let sentence = format!("`length` is {length}, and the longest protected payload has {longest} bytes");
        Err(Fault::new(Status::SinewErrorTooLong, sentence))
    }

    /// `within` `None`: for the stall timeout of the endpoint.
    pub(crate) fn send_protected(
        &mut self,
        destination: Tid,
        typed: &Typed<'_>,
        payload: &[u8],
        within: Option<Duration>,
    ) -> Result<(), Fault> {
        typed.check_length(payload.len())?;
        let (source, receiver) = (self.endpoint.tid(), self.absolute(destination));
        if !receiver.is_single() {
            let sentence =
                "a protected message is for one application, not for a group or for all; send it to each";
            return Err(Fault::argument(sentence));
        }
        let protected = typed.protected(self.name_of(typed)?);
        let length = payload.len().saturating_add(SINEW_SEALED_OVERHEAD);
        // First, since it says whether so many bytes can be sent at all: then no number is used up.
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

    /// The name of a type, which stays.
    fn name_of(&mut self, typed: &Typed<'_>) -> Result<&'static str, Fault> {
        let name = match self.names.get(&typed.kind) {
            Some(name) => *name,
            None => names::kept(typed.name)?,
        };
        if name != typed.name {
            let sentence =
                format!("'{}' hashes as another type's name does; call it something else", typed.name);
            return Err(Fault::argument(sentence));
        }
        self.names.insert(typed.kind, name);
        Ok(name)
    }

    /// Has what `source` sends of this type go through a guard; its handle, and how its output is found.
    pub(crate) fn guard(
        &mut self,
        source: Tid,
        typed: &Typed<'_>,
        output: Output,
    ) -> Result<(usize, Found), Fault> {
        let (source, own) = (self.absolute(source), self.endpoint.tid());
        let protected = typed.protected(self.name_of(typed)?);
        if self.ends.is_held(source, typed.kind) {
            let sentence =
                format!("what {source} sends of '{}' is guarded already: keep that guard", typed.name);
            return Err(Fault::argument(sentence));
        }
        guards::make_held(&mut self.ends, (source, own), protected, output)
    }

    pub(crate) fn receive(&mut self, within: Duration) -> Result<Option<Received>, Fault> {
        if !self.ends.are_idle() {
            // What comes and the echoes are the guards' affair, and who is asking may have one of their outputs in hand.
            guards::check_callback()?;
        }
        self.check_hand()?;
        if self.ends.are_idle() {
            return match self.endpoint.receive(within)? {
                Some(received) => self.hand_out(received).map(Some),
                None => Ok(None),
            };
        }
        let deadline = Time::now() + within;
        let mut settled = 0;
        loop {
            let now = Time::now();
            let until = deadline.min(self.tell_echoes(now));
            match self.endpoint.receive(until.since(now))? {
                Some(received) => {
                    let from = (received.source(), received.kind());
                    match self.ends.judge(from, received.bytes()) {
                        Judged::Plain => return self.hand_out(received).map(Some),
                        Judged::Good(_) => return self.hand_out_good(received).map(Some),
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

    /// Tells senders of protected payloads what they have to quote, where that is due; when the next one is.
    fn tell_echoes(&mut self, now: Time) -> Time {
        // Each that is due is put off by its period.
        while let Some((to, echo)) = self.ends.echo_payload(now) {
            // Where a message is lent, or there is no room, it is told the next time; the watchdog knows.
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

    pub(crate) fn settle(&mut self, received: &mut Received, outcome: Outcome) -> Result<(), Fault> {
        let Some(message) = self.received.give(received.token) else { return Err(no_such("the message")) };
        *received = Received::GONE;
        message.settle(outcome);
        Ok(())
    }

    /// Gives the address back. What is in hand has not been handled to its end, and fails.
    pub(crate) fn unregister(mut self) -> Result<(), Fault> {
        // One of these may lie in the ring, through which the rest is said.
        self.made.empty().for_each(drop);
        // Nothing comes any more; the program has them still. Waits for none of them: it may have one's output in hand just now.
        self.ends.trip();
        for message in self.received.empty() {
            message.settle(Outcome::Failed);
        }
        Ok(self.endpoint.unregister()?)
    }

    /// Takes a message out of the program's hand: whatever comes now, it is gone.
    pub(crate) fn take(&mut self, message: &mut Message) -> Result<Made, Fault> {
        let Some(made) = self.made.give(message.token) else { return Err(no_such("the message")) };
        *message = Message::GONE;
        Ok(made)
    }

    fn hand_out(&mut self, received: sinew::client::Received) -> Result<Received, Fault> {
        let mut out = Received::of(&received, 0);
        match self.received.take(received) {
            Ok(token) => {
                out.token = token;
                Ok(out)
            }
            // There was room when it was looked for, and one thread at a time is in a call.
            Err(message) => {
                message.settle(Outcome::Failed);
                Err(Fault::plain(Status::SinewErrorTooMany))
            }
        }
    }

    /// One that came through a guard: without its envelope.
    fn hand_out_good(&mut self, received: sinew::client::Received) -> Result<Received, Fault> {
        let payload = received.bytes().get(SINEW_SEALED_HEAD..).unwrap_or_default();
        let length = payload.len().saturating_sub(SINEW_SEALED_OVERHEAD - SINEW_SEALED_HEAD);
        let bytes = payload.as_ptr();
        Ok(Received { bytes, length, ..self.hand_out(received)? })
    }

    fn check_hand(&self) -> Result<(), Fault> {
        if self.received.is_full() {
            let sentence = format!("{RECEIVED_MAX} received messages are in hand; settle them");
            return Err(too_many(sentence));
        }
        Ok(())
    }
}

impl From<SealError> for Fault {
    fn from(error: SealError) -> Self {
        let status = match error {
            SealError::ToMany => Status::SinewErrorInvalidArgument,
            SealError::TooManyFlows => Status::SinewErrorTooMany,
        };
        Self::new(status, error.to_string())
    }
}

fn too_many(sentence: String) -> Fault {
    Fault::new(Status::SinewErrorTooMany, sentence)
}

fn no_such(what: &str) -> Fault {
    let sentence =
        format!("{what} is no message of this endpoint; was it sent, discarded or settled already?");
    Fault::new(Status::SinewErrorNoSuchMessage, sentence)
}
