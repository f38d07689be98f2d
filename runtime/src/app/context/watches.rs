//! The input watchdogs of an application: they detect inputs that are silent or old.

use std::time::Duration;

use actix::Actor;

use super::{Action, AppContext};
use crate::{
    app::{InputCriterion, InputTimeout, input_watch::InputWatch},
    tid::Tid,
    wire::{Kind, Payload},
};

type Alert<A> = Box<dyn FnMut(&mut A, InputTimeout, &mut <A as Actor>::Context)>;

/// The ID of an input watchdog.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WatchId(pub(in crate::app) usize);

/// An input watchdog and its action.
pub(in crate::app) struct Watch<A: Actor> {
    pub(in crate::app) input: InputWatch,
    /// `None` while the action runs.
    pub(in crate::app) action: Option<Alert<A>>,
}

impl<A: Actor<Context = Self>> AppContext<A> {
    /// Sets an input watchdog that judges by **arrival**. It calls `action` if no `P` from `source` (from any
    /// sender, if `None`) was handled for `within`, counted from now. Each silence causes one call; the next
    /// `P` starts a new count.
    ///
    /// The watchdog detects a silent sender, node or network. It does not detect a late one: every value
    /// feeds it, of any age and also of unknown age. Where a late value is a hazard, use
    /// [`watch_input_age`](Self::watch_input_age), or both.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.setpoint", Stream => struct Setpoint { newton_metres: f32 });
    ///
    /// struct Drive { newton_metres: f32 }
    ///
    /// impl Actor for Drive {
    ///     type Context = AppContext<Self>;
    ///     fn started(&mut self, ctx: &mut Self::Context) {
    ///         ctx.watch_input::<Setpoint>(None, Duration::from_millis(15), |drive, timeout, _| {
    ///             drive.newton_metres = 0.0;
    ///             eprintln!("{timeout}");
    ///         });
    ///     }
    /// }
    /// ```
    pub fn watch_input<P: Payload>(
        &mut self,
        source: Option<Tid>,
        within: Duration,
        action: impl FnMut(&mut A, InputTimeout, &mut Self) + 'static,
    ) -> WatchId {
        self.set_watch((source, P::KIND), (InputCriterion::Arrival, within), Box::new(action))
    }

    /// Sets an input watchdog that judges by **age**. It calls `action` if the youngest `P` from `source`
    /// (from any sender, if `None`) that was handled may be older than `limit`. A value feeds it from its
    /// handling until the value is as old as the limit; the error of an age counts as age. A value that is
    /// older on arrival does not feed it. **A value of unknown age does not feed it either**, as it may be
    /// old. Therefore `action` is also called while the clock of the sender's host is not measured. `action`
    /// is called once, and again after a fresh value and a further timeout. Until the first value the limit
    /// counts from now.
    ///
    /// Use it for setpoints and measurements that control a motion. The limit must be longer than the sum of
    /// the sender's period, the network latency and the error of the clocks.
    /// [`watch_input`](Self::watch_input) judges by arrival: it needs no measured clock, and detects whether
    /// a sender is alive. [`InputTimeout`] contains the criterion, the silence and the age.
    ///
    /// A late value still reaches its handler: the handler rejects it by
    /// [`Delivery::is_older_than`](crate::app::Delivery::is_older_than).
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.setpoint", Stream => struct Setpoint { newton_metres: f32 });
    ///
    /// struct Drive {
    ///     newton_metres: f32,
    /// }
    ///
    /// impl Actor for Drive {
    ///     type Context = AppContext<Self>;
    ///
    ///     fn started(&mut self, context: &mut Self::Context) {
    ///         // Setpoints come each 5 ms: three periods without one that is fresh, and the torque is let go.
    ///         context.watch_input_age::<Setpoint>(None, Duration::from_millis(15), |drive, timeout, _| {
    ///             drive.newton_metres = 0.0;
    ///             eprintln!("{timeout}");
    ///         });
    ///     }
    /// }
    /// # impl Handler<Delivery<Setpoint>> for Drive {
    /// #     type Result = ();
    /// #     fn handle(&mut self, setpoint: Delivery<Setpoint>, _: &mut Self::Context) {
    /// #         self.newton_metres = setpoint.newton_metres;
    /// #     }
    /// # }
    /// ```
    pub fn watch_input_age<P: Payload>(
        &mut self,
        source: Option<Tid>,
        limit: Duration,
        action: impl FnMut(&mut A, InputTimeout, &mut Self) + 'static,
    ) -> WatchId {
        self.set_watch((source, P::KIND), (InputCriterion::Age, limit), Box::new(action))
    }

    fn set_watch(
        &mut self,
        (source, kind): (Option<Tid>, Kind),
        (criterion, limit): (InputCriterion, Duration),
        action: Alert<A>,
    ) -> WatchId {
        let (id, now) = (WatchId(self.watches.len()), self.now());
        let input = InputWatch::new(source, kind, (criterion, limit), now);
        self.watches.push(Watch { input, action: Some(action) });
        self.schedule.once(now + limit, Action::CheckWatch(id));
        id
    }
}
