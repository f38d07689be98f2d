//! The application `central.coordinator`: it releases walking when all drives have started.
//!
//! It acts for the operator. In this simulation it presses the button by itself; on a device it would wait
//! for a person.

use exoskeleton_model::joint::Joint;
use sinew::prelude::*;

use super::edges::{GAIT, Release, drive_name};

/// From the start of the last drive to the release: a spectator sees the leg held with zero torque.
const RELEASE_AFTER: Duration = Duration::from_millis(500);
/// Time for gait to confirm the release; after it the release is sent again.
const PATIENCE: Duration = Duration::from_millis(500);

/// The coordinator.
pub struct Coordinator;

/// Declares the coordinator.
#[must_use]
pub fn spec() -> AppSpec<Coordinator> {
    AppSpec::new("central.coordinator", || Coordinator).requires(Joint::ALL.map(drive_name))
}

impl Coordinator {
    fn release(&mut self, context: &mut AppContext<Self>) {
        let sent = match context.message(GAIT, &Release {}).confirmed(PATIENCE) {
            Ok(confirmation) => confirmation,
            Err(error) => {
                tracing::warn!(%error, "walking cannot be released now");
                context.after(PATIENCE, |this, _, context| this.release(context));
                return;
            }
        };
        let judge = sent.into_actor(self).map(|outcome, _, context: &mut AppContext<Self>| {
            if outcome == Outcome::Delivered {
                tracing::info!("central's gait has taken the release");
            } else {
                // A second release has no further effect.
                tracing::warn!(?outcome, "the release was not taken; it is sent again");
                context.after(PATIENCE, |this, _, context| this.release(context));
            }
        });
        context.spawn(judge);
    }
}

impl Actor for Coordinator {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        tracing::info!("all drives have started");
        context.after(RELEASE_AFTER, |this, _, context| this.release(context));
    }
}
