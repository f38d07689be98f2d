//! The e-stop of a drive, the stop of the whole system, and their reset.

use exoskeleton_model::message::DriveState;
use sinew::prelude::*;

use super::{Drive, command::CentralCommands};
use crate::robot::edges::{EmergencyStop, Reset};

impl Drive {
    /// Obeys the stop of the whole system, which has shut the guard: the drive stays stopped until it is reset.
    pub(super) fn obey_stop(&mut self, now: Time) {
        let is_stopped = self.commands.as_ref().is_some_and(|commands| commands.guard.is_stopped());
        if is_stopped && self.core.state() != DriveState::EStop {
            self.core.emergency_stop();
            // The guard has ordered it to damp: no torque of before follows.
            self.core.let_device_damp(now.as_nanos());
            self.parts.events.event("e_stop", "sinew stop", String::new());
        }
    }
}

impl Handler<Delivery<EmergencyStop>> for Drive {
    type Result = ();

    fn handle(&mut self, stop: Delivery<EmergencyStop>, _: &mut Self::Context) {
        // Accepted from any sender: stopping needs no permission.
        tracing::warn!(joint = %self.parts.joint, by = %stop.source, "the e-stop was pressed");
        self.core.emergency_stop();
        self.parts.events.event("e_stop", &stop.source.to_string(), String::new());
    }
}

impl Handler<Delivery<Reset>> for Drive {
    type Result = ();

    fn handle(&mut self, reset: Delivery<Reset>, context: &mut Self::Context) {
        let now = context.now();
        if self.central.at(now, context).map(|central| central.node) != Some(reset.source.node) {
            context.reject();
            return;
        }
        // The person at central starts again: that acknowledges a stop of the whole system which is released.
        let acknowledged = self.commands.as_ref().map_or(Ok(()), CentralCommands::acknowledge_stop);
        if let Err(refusal) = acknowledged {
            tracing::warn!(joint = %self.parts.joint, %refusal, "the drive stays stopped");
            context.reject();
            return;
        }
        // For a drive in a process of its own: the node has cut its echoes. A lost one is sent by the next reset.
        let _ = context.acknowledge_stop();
        match self.core.reset(now.as_nanos()) {
            Ok(()) => self.parts.events.event("reset", &reset.source.to_string(), String::new()),
            Err(refusal) => {
                tracing::warn!(joint = %self.parts.joint, %refusal, "the e-stop stays");
                context.reject();
            }
        }
    }
}
