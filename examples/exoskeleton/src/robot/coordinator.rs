//! The application `central.coordinator`: when all drives have started it releases walking.
//!
//! It stands for the operator's hand. In this simulation it presses the button by itself; on a device it would wait for
//! a person.

use sinew::prelude::*;

use super::edges::{GAIT, Release, drive_name};
use crate::joint::Joint;

/// From the start of the last drive to the release: everybody sees the leg held with zero torque.
const RELEASE_AFTER: Duration = Duration::from_millis(500);
/// Time for gait to say that it was released; after it the release is sent again.
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
                // To be released twice is no more than once.
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
