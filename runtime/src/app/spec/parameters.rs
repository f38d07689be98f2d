//! The parameters in the declaration of an application.

use std::sync::Arc;

use actix::Actor;
use sinew_params::{
    AskParameters, ParameterList, ParameterOutcome, ParameterVote, Parameters, SetParameters,
};

use super::AppSpec;
use crate::{
    app::AppContext,
    wire::{Payload, remember},
};

impl<A: Actor<Context = AppContext<A>>> AppSpec<A> {
    /// Declares the parameters of the application, which `params!` has made. `sinew param` lists and sets them while it
    /// runs; the framework handles these messages.
    ///
    /// A set of values is checked as a whole, and applied at the next tick of the periodic timer with the shortest
    /// period ([`AppContext::every`]), before the timer's action. So all values that one tick reads belong together.
    /// Without a periodic timer it is applied between two messages. If no tick comes within 1 s the set is refused, and
    /// is not applied later.
    ///
    /// Several applications, also of several nodes, are set as one by a transaction: see
    /// [`Sender::set_together`](crate::sender::Sender::set_together).
    ///
    /// An application has one set of parameters, and no other application of its process may have the same one. After a
    /// restart by its supervisor a parameter has its default again, unless it is declared with `keep`. With
    /// `node.state` a kept value also survives a restart of the node. In a process of its own each restart begins with
    /// the defaults.
    ///
    /// # Examples
    ///
    /// ```
    /// use std::sync::Arc;
    /// use sinew::prelude::*;
    ///
    /// params! {
    ///     /// How the knee assists.
    ///     struct KneeGains {
    ///         /// Assistance, as a share of the model's torque.
    ///         assistance: f64 = 0.3, unit "1", range 0.0..=1.0, slope 0.5, keep;
    ///     }
    /// }
    ///
    /// struct Knee { gains: Arc<KneeGains>, newton_metres: f64 }
    ///
    /// impl Actor for Knee {
    ///     type Context = AppContext<Self>;
    ///     fn started(&mut self, ctx: &mut Self::Context) {
    ///         ctx.every(Duration::from_millis(1), |knee, _, _| {
    ///             knee.newton_metres = 12.0 * knee.gains.assistance.get();
    ///         });
    ///     }
    /// }
    ///
    /// let gains = KneeGains::new();
    /// let shared = gains.clone();
    /// let knee = AppSpec::new("knee", move || Knee { gains: shared.clone(), newton_metres: 0.0 }).params(&gains);
    /// ```
    #[must_use]
    pub fn params<P: Parameters>(mut self, parameters: &Arc<P>) -> Self {
        let handled = remember::<AskParameters>().into_iter().chain(remember::<SetParameters>());
        self.common.types.extend(handled.chain(remember::<ParameterVote>()));
        let sent = remember::<ParameterList>().into_iter().chain(remember::<ParameterOutcome>());
        self.common.sends.extend(sent.chain(remember::<ParameterVote>()));
        for (kind, name) in [
            (AskParameters::KIND, AskParameters::NAME),
            (SetParameters::KIND, SetParameters::NAME),
            (ParameterVote::KIND, ParameterVote::NAME),
        ] {
            self.common.kinds.push((kind, name));
        }
        self.common.parameter_sets += 1;
        self.common.parameters = Some(parameters.clone());
        self
    }
}
