//! Pressing the stop of the whole system.

use std::time::Duration;

use sinew_runtime::{
    outcome::Outcome,
    stop::{AcknowledgeStop, PressStop, StopReport},
    tid::{AppAddress, Tid},
};

use super::{ApiError, AsyncEndpoint, Endpoint};

/// Time beyond the wait for confirmations in which the node answers.
const ANSWER_MARGIN: Duration = Duration::from_millis(500);
/// Longest wait for confirmations. A node waits no longer either.
const WITHIN_MAX: Duration = Duration::from_secs(60);

fn order(reason: &str, within: Duration) -> PressStop {
    let within_ms = u32::try_from(within.as_millis()).unwrap_or(u32::MAX);
    PressStop { reason: reason.to_owned(), within_ms }
}

impl Endpoint {
    /// Presses the stop of the whole system: every guarded output of every node becomes safe, and stays so until an
    /// operator has released the stop, and each application has acknowledged it and armed its output again.
    ///
    /// Returns when all nodes have confirmed, and `within` this time at the latest, at most 60 s. The report names the
    /// nodes that have not. It is no safety function.
    ///
    /// # Errors
    /// The node did not accept the order, or did not answer in time. In the latter case the stop may be pressed.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use std::time::Duration;
    ///
    /// use sinew::{NodeApi, Registration};
    ///
    /// let node = NodeApi::connect("/run/sinew/knee.sock")?;
    /// let mut button = node.register_transport_address(Registration::new().name("button"))?;
    /// let report = button.press_stop("the button", Duration::from_millis(200))?;
    /// for node in report.nodes.iter().filter(|node| node.confirmed_us.is_none()) {
    ///     eprintln!("{} may still move: {}", node.name, node.note);
    /// }
    /// # Ok::<(), sinew::client::ApiError>(())
    /// ```
    pub fn press_stop(&mut self, reason: &str, within: Duration) -> Result<StopReport, ApiError> {
        let (stop, within) = (Tid::new(self.tid().node, AppAddress::STOP), within.min(WITHIN_MAX));
        self.message(stop, &order(reason, within)).ask(within + ANSWER_MARGIN)
    }

    /// Acknowledges a stop that is released: before that the outputs of this endpoint cannot be armed, as its node
    /// hands over none of its echoes. Call it on the order of a person, or of the application that coordinates the
    /// start. It moves nothing. The outcome is [`Outcome::Delivered`], or a rejection while a stop is in force.
    ///
    /// # Errors
    /// The node cannot be reached.
    pub fn acknowledge_stop(&mut self, within: Duration) -> Result<Outcome, ApiError> {
        let stop = Tid::new(self.tid().node, AppAddress::STOP);
        self.message(stop, &AcknowledgeStop {}).confirmed(within)
    }
}

impl AsyncEndpoint {
    /// Presses the stop of the whole system, like [`Endpoint::press_stop`].
    ///
    /// # Errors
    /// The errors of [`Endpoint::press_stop`].
    pub async fn press_stop(&mut self, reason: &str, within: Duration) -> Result<StopReport, ApiError> {
        let (stop, within) = (Tid::new(self.tid().node, AppAddress::STOP), within.min(WITHIN_MAX));
        self.message(stop, &order(reason, within)).ask(within + ANSWER_MARGIN).await
    }

    /// Acknowledges a stop that is released, like [`Endpoint::acknowledge_stop`].
    ///
    /// # Errors
    /// The errors of [`Endpoint::acknowledge_stop`].
    pub async fn acknowledge_stop(&mut self, within: Duration) -> Result<Outcome, ApiError> {
        let stop = Tid::new(self.tid().node, AppAddress::STOP);
        self.message(stop, &AcknowledgeStop {}).confirmed(within).await
    }
}
