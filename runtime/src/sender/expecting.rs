//! The waits for the outcomes of confirmed messages and for the replies to requests.

use std::time::Duration;

use super::{SendError, Sender};
use crate::{
    outcome::{Receipt, Ticket},
    pending::{Awaited, Wait},
    tid::Tid,
    wire::{Flags, Message},
};

impl Sender {
    /// Opens a wait for the outcome or reply of a message. Also returns the duration of the wait, at most the
    /// message's time to live.
    pub(super) fn expect_answer(
        &self,
        message: &mut Message,
        awaited: Awaited,
        within: Duration,
    ) -> Result<(Wait, Duration), SendError> {
        let destination = self.shared.router.absolute(message.header.destination);
        let wait = self.shared.pending.open(awaited, destination).ok_or(SendError::TooManyWaits)?;
        let within = self.confirm_to(message, destination, &wait, within);
        Ok((wait, within))
    }

    /// Same as [`expect_answer`](Self::expect_answer), for the outcomes of all members of a message to many.
    pub(super) fn expect_each(
        &self,
        message: &mut Message,
        within: Duration,
    ) -> Result<(Wait, Duration), SendError> {
        let destination = self.shared.router.absolute(message.header.destination);
        let wait = self.shared.pending.open_each(destination, self.shared.router.node());
        let wait = wait.ok_or(SendError::TooManyWaits)?;
        let within = self.confirm_to(message, destination, &wait, within);
        Ok((wait, within))
    }

    /// Requests a confirmation of the message for `wait`. Returns the duration of the wait.
    fn confirm_to(&self, message: &mut Message, destination: Tid, wait: &Wait, within: Duration) -> Duration {
        message.header.flags = message.header.flags.with(Flags::CONFIRM);
        message.header.correlation = wait.correlation();
        let within = message.header.limit_time_to_live(within);
        let ticket = Ticket { source: self.shared.tid, destination, correlation: wait.correlation() };
        message.receipt = Some(Receipt::new(self.shared.pending.clone(), ticket));
        within
    }
}
