//! The outputs of an application that protected messages control, and the echoes to their senders.

use std::{io, sync::Arc};

use actix::Actor;

use super::{Action, AppContext};
use crate::{
    protection::{Cause, DataId, Echo, Guard, Guarded},
    schedule::TimerId,
    tid::Tid,
    wire::{Kind, Payload},
};

/// A registered guard.
pub(super) struct GuardEntry {
    guard: Arc<dyn Guarded>,
    /// The type that controls the output.
    kind: Kind,
    /// The timer that sends echoes.
    echoes: TimerId,
}

impl<A: Actor<Context = Self>> AppContext<A> {
    /// Guards `output`: protected messages of type `P` from `source` control it, and `safe` makes it safe if
    /// they do not meet the protection's limits; see [`Guard::new`]. From now on only valid messages that
    /// arrive while the output is live reach the handler of `P`; others are rejected. The sender is sent an
    /// echo four times within the maximum age of a message.
    ///
    /// # Errors
    /// The thread `safe-output` cannot be started, it does not have a higher priority than the calling thread,
    /// or this flow is guarded already.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{prelude::*, protection::{Guard, Protection}, serde::{Deserialize, Serialize}};
    ///
    /// #[derive(Serialize, Deserialize)]
    /// #[serde(crate = "sinew::serde")]
    /// struct Torque { newton_metres: f32 }
    /// impl Payload for Torque {
    ///     const NAME: &'static str = "demo.torque";
    ///     const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(5)));
    /// }
    ///
    /// struct Motor { newton_metres: f32 }
    /// struct Drive { guard: Option<Guard<Motor>> }
    /// # impl Actor for Drive { type Context = AppContext<Self>; }
    ///
    /// fn begin(drive: &mut Drive, control: Tid, ctx: &mut AppContext<Drive>) -> std::io::Result<()> {
    ///     let motor = Motor { newton_metres: 0.0 };
    ///     let guard = ctx.guard::<Torque, _>(control, motor, |motor, cause| {
    ///         motor.newton_metres = 0.0;
    ///         eprintln!("the motor is without torque: {cause}");
    ///     })?;
    ///     drive.guard = Some(guard);
    ///     Ok(())
    /// }
    /// ```
    pub fn guard<P: Payload, O: Send + 'static>(
        &mut self,
        source: Tid,
        output: O,
        safe: impl FnMut(&mut O, Cause) + Send + 'static,
    ) -> io::Result<Guard<O>> {
        let source = self.sender.absolute(source);
        let schedule = &mut self.schedule;
        self.guards.retain(|entry| {
            let has_owner = !entry.guard.is_orphan();
            if !has_owner {
                schedule.cancel(entry.echoes);
            }
            has_owner
        });
        if self.guard_of::<P>(source).is_some() {
            let words = format!(
                "what {source} sends of '{}' is guarded already: keep that guard, or clone it",
                P::NAME
            );
            return Err(io::Error::new(io::ErrorKind::AlreadyExists, words));
        }
        let guard = {
            let node = (self.sender.clock(), self.sender.stop());
            Guard::new_on::<P>(node, (source, self.tid()), output, safe)?
        };
        if self.sender.runs_dry() {
            guard.begin_dry_run();
        }
        let guarded = guard.guarded();
        self.sender.add_guarded_here();
        let protection =
            P::PROTECTION.expect("a guard is for a protected type: that was asserted when this was compiled");
        let echoed = guarded.clone();
        let echo = move |context: &Self| {
            if !echoed.is_orphan() {
                // A failed send is ignored: a sender that cannot be reached sends no commands either, and the
                // watchdog detects that.
                let echo = Echo {
                    others: context.last_echoes(source, P::KIND),
                    ..Echo::new(P::KIND, echoed.echo())
                };
                let _ = context.send(source, &echo);
            }
        };
        echo(self);
        // Not by `every`: parameters change at ticks of the application's own timers.
        let (first, period) = (self.now() + protection.echo_period(), protection.echo_period());
        let action = Action::Call(Box::new(move |_, _, context| echo(context)));
        let echoes = self.schedule.every(first, period, action);
        self.guards.push(GuardEntry { guard: guarded, kind: P::KIND, echoes });
        Ok(guard)
    }

    /// Returns the guard of messages of type `P` from `source`.
    pub(in crate::app) fn guard_of<P: Payload>(&self, source: Tid) -> Option<&Arc<dyn Guarded>> {
        let data_id = DataId::of::<P>(source, self.tid());
        self.guards.iter().map(|entry| &entry.guard).find(|guard| guard.data_id() == data_id)
    }

    /// Returns the last echoed time to `source` for each type except `kind`. All echoes are one Stream, of
    /// which only the newest message may arrive.
    fn last_echoes(&self, source: Tid, kind: Kind) -> Vec<(Kind, u64)> {
        let others =
            self.guards.iter().filter(|entry| entry.kind != kind && entry.guard.data_id().source == source);
        others.map(|entry| (entry.kind, entry.guard.last_echo().as_nanos())).collect()
    }
}
