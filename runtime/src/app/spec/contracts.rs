//! The contracts in the declaration of an application.

use actix::Actor;

use super::{AppSpec, DynApp};
use crate::app::{AppContext, Contract};

impl<A: Actor<Context = AppContext<A>>> AppSpec<A> {
    /// Declares a contract: to which state the application goes when another part of the system is lost, late or
    /// stopped, and within which time. At most 32. It changes nothing in the application. `sinew contracts` shows the
    /// contracts of all nodes, and checks that each output has one for each of its commanders and that the times add
    /// up.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{contracts::Contract, prelude::*};
    ///
    /// struct Knee;
    /// # impl Actor for Knee { type Context = AppContext<Self>; }
    ///
    /// const MS: Duration = Duration::from_millis(1);
    /// let of_gait = Contract::when_lost("gait").or_late(60 * MS).or_stopped().goes_to("damped", 100 * MS);
    /// let knee = AppSpec::new("knee", || Knee).contract(of_gait);
    /// ```
    #[must_use]
    pub fn contract(mut self, contract: Contract) -> Self {
        self.common.contracts.push(contract);
        self
    }
}

impl DynApp {
    /// Returns the contracts of the application.
    #[must_use]
    pub fn contracts(&self) -> &[Contract] {
        &self.common.contracts
    }
}
