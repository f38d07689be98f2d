//! The route of messages to a client: its outlet, and the checks that settle what expires there.

use std::{sync::Arc, task::Waker};

use sinew_model::periodic_checks::PeriodicChecks;
use sinew_runtime::{
    outcome::Ticket,
    router::{MessageSink, SubmitError},
    wire::Message,
};

use super::{
    super::command::{HandOver, Reading},
    ClientOutlet,
};

/// Submits messages to a client's outlet. A message that can expire there requests the checks of LNCL, which run only
/// while such messages are left.
pub(super) struct ClientSink<S> {
    outlet: Arc<S>,
    checks: Arc<PeriodicChecks>,
}

impl<S: MessageSink> ClientSink<S> {
    pub(super) const fn new(outlet: Arc<S>, checks: Arc<PeriodicChecks>) -> Self {
        Self { outlet, checks }
    }

    /// Passes on a message, and requests checks for one that was accepted and can expire.
    fn pass(
        &self,
        message: Message,
        submit: impl FnOnce(&S, Message) -> Result<(), SubmitError>,
    ) -> Result<(), SubmitError> {
        let has_a_time = message.header.time_to_live_us != 0 || message.receipt.is_some();
        submit(&self.outlet, message)?;
        if has_a_time {
            self.checks.request();
        }
        Ok(())
    }
}

impl<S: MessageSink> MessageSink for ClientSink<S> {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        self.pass(message, S::submit)
    }

    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), SubmitError> {
        self.pass(message, |outlet, message| outlet.offer(message, room))
    }

    fn cancel(&self, ticket: Ticket) -> bool {
        self.outlet.cancel(ticket)
    }
}

impl HandOver for ClientSink<ClientOutlet> {
    fn is_free(&self) -> bool {
        self.outlet.waiting() == 0
    }

    fn reading(&self) -> Reading {
        let unread = self.outlet.unread();
        self.outlet.taking().map_or_else(Reading::default, |taking| Reading {
            mark: taking.mark,
            unread,
            leaves_some: taking.leaves_some,
        })
    }

    fn continue_later(&self) {
        self.outlet.wake_drain();
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use sinew_model::notifications::testing::waits;
    use sinew_runtime::{
        outcome::Rejection,
        tid::Tid,
        wire::{Header, Kind},
    };

    use super::*;

    /// An outlet that accepts all messages, or none.
    struct PlayedOutlet {
        accepts: bool,
    }

    impl MessageSink for PlayedOutlet {
        fn submit(&self, message: Message) -> Result<(), SubmitError> {
            if self.accepts { Ok(()) } else { Err(SubmitError::new(message, Rejection::QueueFull)) }
        }
    }

    fn message(time_to_live_us: u32) -> Message {
        let mut header = Header::new(Kind::named("test"), Tid::NONE, Tid::NONE);
        header.time_to_live_us = time_to_live_us;
        Message::new(header, bytes::Bytes::new())
    }

    /// Whether checks are requested by a message with this time to live, submitted or offered.
    fn requests(accepts: bool, is_offered: bool, time_to_live_us: u32) -> bool {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
        runtime.block_on(async {
            let checks = Arc::<PeriodicChecks>::default();
            let mut run = std::pin::pin!(checks.run(Duration::ZERO, || false));
            // It has found nothing, and waits.
            let waited = tokio::time::timeout(Duration::from_millis(20), run.as_mut()).await;
            waited.expect_err("it never ends");
            let woken = waits(run.as_mut());
            let sink = ClientSink::new(Arc::new(PlayedOutlet { accepts }), checks.clone());
            let message = message(time_to_live_us);
            let result = if is_offered { sink.offer(message, None) } else { sink.submit(message) };
            assert_eq!(result.is_ok(), accepts);
            woken.is()
        })
    }

    #[test]
    fn accepted_message_that_can_expire_requests_checks() {
        for is_offered in [false, true] {
            assert!(requests(true, is_offered, 7));
            assert!(!requests(true, is_offered, 0), "it cannot expire");
            assert!(!requests(false, is_offered, 7), "it was refused");
        }
    }
}
