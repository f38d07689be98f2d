//! An endpoint with the messages that the program has in hand. Safe: all that is known of C is that it has tokens.

use std::{ffi::CString, time::Duration};

use sinew::{ApiError, Kind, LentMessage, Outcome, Tid};

use crate::{
    hand::Hand,
    message::{Message, Received, class_of},
    status::{Fault, Status},
};

/// Messages that are being made at most: an endpoint lends one at a time.
const MADE_MAX: usize = 1;
/// Messages that were received and not settled at most.
const RECEIVED_MAX: usize = 1024;

/// A registered endpoint.
pub(crate) struct Session {
    endpoint: sinew::Endpoint,
    node_name: CString,
    made: Hand<LentMessage>,
    received: Hand<sinew::Received>,
}

impl Session {
    pub(crate) fn new(endpoint: sinew::Endpoint) -> Self {
        // A node's name has no control characters.
        let node_name = CString::new(endpoint.node_name()).unwrap_or_default();
        Self { endpoint, node_name, made: Hand::new(MADE_MAX), received: Hand::new(RECEIVED_MAX) }
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
        let class = class_of(class).ok_or_else(|| {
            Fault::argument(format!("`message_class` is {class}: take one of sinew_message_class"))
        })?;
        let mut buffer = self.endpoint.create_message(destination, kind, length)?;
        buffer.set_class(class);
        let bytes = buffer.as_mut_ptr();
        match self.made.take(buffer) {
            Ok(token) => Ok(Message { bytes, length, token }),
            // Dropped; there is none in the hand that is not lent.
            Err(_) => Err(Fault::plain(Status::SinewErrorLent)),
        }
    }

    /// Copies a payload into a message of the same length.
    pub(crate) fn fill(&mut self, message: &Message, payload: &[u8]) {
        if let Some(buffer) = self.made.get_mut(message.token) {
            buffer.copy_from_slice(payload);
        }
    }

    pub(crate) fn discard(&mut self, message: &mut Message) -> Result<(), Fault> {
        self.take(message).map(drop)
    }

    /// `within` `None`: for the endpoint's patience.
    pub(crate) fn send(&mut self, message: &mut Message, within: Option<Duration>) -> Result<(), Fault> {
        let buffer = self.take(message)?;
        Ok(match within {
            None => self.endpoint.send_message(buffer),
            Some(within) => self.endpoint.send_message_within(buffer, within),
        }?)
    }

    pub(crate) fn send_confirmed(&mut self, buffer: LentMessage, within: Duration) -> Result<Outcome, Fault> {
        Ok(self.endpoint.send_message_confirmed(buffer, within)?)
    }

    /// Asks; what became of the request, too, if it was not handled.
    pub(crate) fn ask(
        &mut self,
        buffer: LentMessage,
        within: Duration,
    ) -> Result<Result<Received, (Outcome, Fault)>, Fault> {
        self.check_hand()?;
        match self.endpoint.ask_message(buffer, within) {
            Ok(reply) => self.hand_out(reply).map(Ok),
            Err(ApiError::Ended(outcome)) => Ok(Err((outcome, ApiError::Ended(outcome).into()))),
            Err(error) => Err(error.into()),
        }
    }

    pub(crate) fn reply(
        &mut self,
        request: &Received,
        buffer: LentMessage,
        within: Option<Duration>,
    ) -> Result<(), Fault> {
        let Some(request) = self.received.get_mut(request.token) else {
            return Err(no_such("the request"));
        };
        Ok(match within {
            None => self.endpoint.reply_message(request, buffer),
            Some(within) => self.endpoint.reply_message_within(request, buffer, within),
        }?)
    }

    pub(crate) fn receive(&mut self, within: Duration) -> Result<Option<Received>, Fault> {
        self.check_hand()?;
        match self.endpoint.receive(within)? {
            Some(received) => self.hand_out(received).map(Some),
            None => Ok(None),
        }
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
        for message in self.received.empty() {
            message.settle(Outcome::Failed);
        }
        Ok(self.endpoint.unregister()?)
    }

    /// Takes a message out of the program's hand: whatever comes now, it is gone.
    pub(crate) fn take(&mut self, message: &mut Message) -> Result<LentMessage, Fault> {
        let Some(buffer) = self.made.give(message.token) else { return Err(no_such("the message")) };
        *message = Message::GONE;
        Ok(buffer)
    }

    fn hand_out(&mut self, received: sinew::Received) -> Result<Received, Fault> {
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

    fn check_hand(&self) -> Result<(), Fault> {
        if self.received.is_full() {
            let sentence = format!("{RECEIVED_MAX} received messages are in hand; settle them");
            return Err(too_many(sentence));
        }
        Ok(())
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
