//! The end of an endpoint: it releases its address, with a confirmation of the node or without.

use std::{pin::pin, time::Duration};

use sinew_runtime::{
    time::Time,
    wire::{Header, Kind, Message},
};

use super::{Endpoint, LNCL, PROMPT};
use crate::{
    ApiError,
    incoming::WhenFull,
    wait_mode::{WaitMode, block_ready},
};

/// Time limit for messages that wait for room on direct links when a thread drops an endpoint.
const UNREGISTER_FLUSH_TIMEOUT: Duration = Duration::from_millis(20);

impl Endpoint {
    /// Releases the address and waits at most 2 s for the node's confirmation: the name is free when this
    /// returns.
    ///
    /// # Errors
    /// The node did not answer, or a message is lent ([`ApiError::LoanActive`]). The address is released in
    /// any case.
    pub fn unregister(mut self) -> Result<(), ApiError> {
        block_ready(pin!(self.take_leave()))
    }

    pub(crate) async fn take_leave(&mut self) -> Result<(), ApiError> {
        self.inbox.close();
        let deadline = Time::now() + PROMPT;
        self.flush_before_close(self.reconnect.options.stall_timeout.min(PROMPT)).await;
        if self.node.ended.is_some() {
            // The connection has released the address.
            return Ok(());
        }
        self.lender.check_free()?;
        self.node.forget_stall();
        let goodbye = Message::new(Header::new(Kind::LNCL_UNREGISTER, self.tid, LNCL), bytes::Bytes::new());
        let limit = self.stall_timeout().and_in_all(deadline.since(Time::now()));
        self.node.write(goodbye.into(), limit, &mut self.wait_mode).await?;
        while self.node.ended.is_none() {
            self.poll_incoming(None, WhenFull::Refuse, Time::now())?;
            self.inbox.close();
            if self.node.ended.is_some() {
                break;
            }
            if Time::now() >= deadline {
                return Err(ApiError::NoAnswer(PROMPT));
            }
            self.wait(deadline, Time::now()).await;
        }
        Ok(())
    }
}

impl Drop for Endpoint {
    fn drop(&mut self) {
        // Messages that have arrived and were not read are refused, too. An error ends the connection, as
        // this function does.
        let _ = self.poll_incoming(None, WhenFull::Refuse, Time::now());
        self.inbox.close();
        if matches!(self.wait_mode, WaitMode::Blocking) {
            block_ready(pin!(self.flush_before_close(UNREGISTER_FLUSH_TIMEOUT)));
        }
        self.direct.flush();
        self.direct.log_unsent();
        // A message that a thread still handles ends as `Failed`.
        self.node.writer.close();
    }
}
