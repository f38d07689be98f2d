//! Payloads whose type Rust does not know: bytes from another language, or laid out by the application itself.

use std::time::Duration;

use sinew_runtime::outcome::Outcome;

use super::{ApiError, Endpoint, LoanedMessage, Received, form::at_once, outgoing::Request};

impl Endpoint {
    /// As [`send_confirmed`](Self::send_confirmed), for memory that [`create_message`](Self::create_message) lent.
    ///
    /// # Errors
    /// It was not sent, or the connection ended before the outcome was known.
    pub fn send_message_confirmed(
        &mut self,
        message: LoanedMessage,
        within: Duration,
    ) -> Result<Outcome, ApiError> {
        at_once(self.confirm(message.into(), within))
    }

    /// As [`ask`](Self::ask), for memory that [`create_message`](Self::create_message) lent; it travels as Control.
    ///
    /// # Errors
    /// It was not sent or not handled, or no reply came `within` this time.
    pub fn ask_message(&mut self, message: LoanedMessage, within: Duration) -> Result<Received, ApiError> {
        at_once(self.await_reply(message.into(), within)).map(Received::new)
    }

    /// As [`reply`](Self::reply), for memory that [`create_message`](Self::create_message) lent. It goes to who asked,
    /// whatever destination it was created for.
    ///
    /// # Errors
    /// The message asks for no reply, or the reply was not sent.
    pub fn reply_message(&mut self, request: &Received, message: LoanedMessage) -> Result<(), ApiError> {
        at_once(self.answer(Request::of(request, self.tid())?, message.into(), self.stall_timeout()))
    }
}
