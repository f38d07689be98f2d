//! The e-stop of a drive, and its reset.

use sinew::prelude::*;

use super::Drive;
use crate::robot::edges::{EmergencyStop, Reset};

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
        match self.core.reset(now.as_nanos()) {
            Ok(()) => self.parts.events.event("reset", &reset.source.to_string(), String::new()),
            Err(refusal) => {
                tracing::warn!(joint = %self.parts.joint, %refusal, "the e-stop stays");
                context.reject();
            }
        }
    }
}
