//! Pressing the stop of the whole system.

use std::time::Duration;

use actix::Actor;

use super::AppContext;
use crate::{
    sender::{Reply, SendError},
    stop::StopReport,
};

impl<A: Actor<Context = Self>> AppContext<A> {
    /// Presses the stop of the whole system; see [`Sender::press_stop`](crate::sender::Sender::press_stop).
    ///
    /// # Errors
    /// This node did not accept the order: see there.
    pub fn press_stop(&self, reason: &str, within: Duration) -> Result<Reply<StopReport>, SendError> {
        self.sender.press_stop(reason, within)
    }

    /// Acknowledges a stop that is released, in a process of its own; see
    /// [`Sender::acknowledge_stop`](crate::sender::Sender::acknowledge_stop).
    ///
    /// # Errors
    /// No queue and no socket accepted the message.
    pub fn acknowledge_stop(&self) -> Result<(), SendError> {
        self.sender.acknowledge_stop()
    }
}
