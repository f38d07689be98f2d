//! The trigger of an application for the recordings of all nodes.

use actix::Actor;

use super::AppContext;
use crate::{
    incident::{self, IncidentKind},
    time::Time,
};

impl<A: Actor<Context = Self>> AppContext<A> {
    /// Has all nodes that record freeze the messages around this moment, as after a fault. `sinew record fetch` gathers
    /// them. Of `reason` the first 200 bytes are kept.
    ///
    /// It never waits, and without a node that records it does nothing. Further calls within `record.after_ms` belong
    /// to the same span. In a process of its own ([`own_process`](crate::app::AppSpec::own_process)) an application
    /// sends `sinew.inspect.freeze` to its node instead.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.slip", Control => struct Slip { millimetres: f32 });
    ///
    /// struct Foot;
    ///
    /// impl Actor for Foot {
    ///     type Context = AppContext<Self>;
    /// }
    ///
    /// impl Handler<Delivery<Slip>> for Foot {
    ///     type Result = ();
    ///     fn handle(&mut self, slip: Delivery<Slip>, context: &mut Self::Context) {
    ///         if slip.millimetres > 20.0 {
    ///             context.freeze_recording(&format!("the foot slips by {} mm", slip.millimetres));
    ///         }
    ///     }
    /// }
    /// ```
    pub fn freeze_recording(&self, reason: &str) {
        incident::report(Time::now(), IncidentKind::Symptom, format_args!("{}: {reason}", self.tid()));
    }
}
