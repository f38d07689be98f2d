//! The declaration of an application without its actor type.

use std::sync::Arc;

use sinew_params::Parameters;

use super::{AppWiring, CommandLine, Common, DynApp};
use crate::{
    app::{DownPolicy, DownState, RequirementPolicy, WILLS_MAX, Will, contract},
    supervision::{Launch, Place, Policy},
    tid::AppAddress,
    wire::{Kind, PayloadType},
};

impl DynApp {
    /// Returns the name of the application.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.common.name
    }

    /// Returns the fixed address that the application requests.
    #[must_use]
    pub const fn address(&self) -> Option<AppAddress> {
        self.common.address
    }

    /// Returns the requirements of the application.
    #[must_use]
    pub fn requires(&self) -> &[String] {
        &self.common.requires
    }

    /// Returns the kinds that the application handles, with the names of their types.
    #[must_use]
    pub fn kinds(&self) -> &[(Kind, &'static str)] {
        &self.common.kinds
    }

    /// Returns the types that the application handles, without those of which it takes the raw bytes.
    #[must_use]
    pub fn types(&self) -> &[PayloadType] {
        &self.common.types
    }

    /// Returns the types that the application declared to send.
    #[must_use]
    pub fn sends(&self) -> &[PayloadType] {
        &self.common.sends
    }

    /// Returns the parameters of the application, if it has any.
    #[must_use]
    pub const fn parameters(&self) -> Option<&Arc<dyn Parameters>> {
        self.common.parameters.as_ref()
    }

    /// Has `notify` called on the application's thread after each change of a kept parameter. It must not wait.
    /// Only the first call has an effect.
    pub fn on_kept_change(&self, notify: impl Fn() + Send + Sync + 'static) {
        let _ = self.common.on_kept.set(Box::new(notify));
    }

    /// Returns the supervision policy of the application.
    #[must_use]
    pub const fn policy(&self) -> &Policy {
        &self.common.policy
    }

    /// Returns the place of the application.
    #[must_use]
    pub const fn place(&self) -> &Place {
        &self.common.place
    }

    /// Returns the program of the application, if it is a command.
    #[must_use]
    pub const fn command(&self) -> Option<&CommandLine> {
        self.common.command.as_ref()
    }

    /// Adds one more injected fault.
    #[cfg(feature = "fault-points")]
    pub fn plan_fault(&mut self, fault: crate::supervision::fault::Fault) {
        self.common.faults.push(fault);
    }

    /// Returns the injected faults.
    #[cfg(feature = "fault-points")]
    #[must_use]
    pub fn faults(&self) -> &[crate::supervision::fault::Fault] {
        &self.common.faults
    }

    /// Returns the policy for the loss of a requirement.
    #[must_use]
    pub const fn requirement_policy(&self) -> RequirementPolicy {
        self.common.on_lost
    }

    /// Returns the last wills of the application.
    #[must_use]
    pub fn wills(&self) -> &[Will] {
        &self.common.wills
    }

    /// Returns the error in the declaration, as a text, if it has one.
    #[must_use]
    pub fn fault(&self) -> Option<String> {
        let Common { wills, on_lost, has_safe_state, parameter_sets, contracts, .. } = &self.common;
        if wills.len() > WILLS_MAX {
            let wills = wills.len();
            return Some(format!("{wills} last wills are more than the {WILLS_MAX} that it may have"));
        }
        if *parameter_sets > 1 {
            return Some(format!(
                "it has {parameter_sets} sets of parameters, and may have one: put all into one `params!`"
            ));
        }
        if let Some(why) = contract::fault(self.name(), contracts) {
            return Some(why);
        }
        if let Some(why) = self.command().and_then(|line| line.fault(self.place(), *on_lost)) {
            return Some(why);
        }
        match on_lost {
            RequirementPolicy::SafeState if !has_safe_state => {
                Some("it goes to its safe state and has none; declare it with `safe_state`".to_owned())
            }
            RequirementPolicy::CarryOn
            | RequirementPolicy::Pause
            | RequirementPolicy::SafeState
            | RequirementPolicy::Restart => None,
        }
    }

    /// Returns the policy for messages while the application is down.
    #[must_use]
    pub const fn down_policy(&self) -> DownPolicy {
        self.common.down_policy
    }

    /// Creates the state that the node keeps for the time when the application is down.
    #[must_use]
    pub fn down_state(&self, wiring: AppWiring) -> DownState {
        DownState::new(wiring, self.common.down_policy, self.common.wills.clone())
    }

    /// Creates the launch function, which starts the application on the thread of its place.
    #[must_use]
    pub fn launch(&self, wiring: AppWiring) -> Launch {
        (self.wire)(wiring)
    }
}
