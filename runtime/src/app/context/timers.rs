//! The timers of an application: periodic ones and single ones.

use std::time::Duration;

use actix::Actor;

use super::{AppContext, WatchId};
use crate::{
    schedule::{Tick, TimerId},
    time::Time,
};

type Timer<A> = Box<dyn FnMut(&mut A, Tick, &mut <A as Actor>::Context)>;

/// The action of a timer.
pub(in crate::app) enum Action<A: Actor> {
    Call(Timer<A>),
    CheckWatch(WatchId),
    /// Refuses the sets of parameters that have waited too long.
    ExpireParameters,
}

impl<A: Actor<Context = Self>> AppContext<A> {
    /// Calls `action` once per period, on a grid that begins one period from now. The first argument of
    /// `action` is a [`Tick`] with the lateness of the call and the number of missed turns. Missed turns are
    /// not repeated.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Hip { position: f32, velocity: f32 }
    ///
    /// impl Actor for Hip {
    ///     type Context = AppContext<Self>;
    ///     fn started(&mut self, ctx: &mut Self::Context) {
    ///         let period = Duration::from_millis(1);
    ///         ctx.every(period, move |hip, tick, _| {
    ///             // Missed turns are not made up for: integrate over the time that has passed.
    ///             let turns = (tick.missed + 1) as f32;
    ///             hip.position += hip.velocity * period.as_secs_f32() * turns;
    ///         });
    ///     }
    /// }
    /// ```
    pub fn every(
        &mut self,
        period: Duration,
        action: impl FnMut(&mut A, Tick, &mut Self) + 'static,
    ) -> TimerId {
        self.every_from(self.now() + period, period, action)
    }

    /// Calls `action` once per period, on a grid that begins at `first`. Otherwise the same as
    /// [`every`](Self::every). If `first` has passed, the first call comes at once, and is late.
    ///
    /// A loop that uses the value of another one finds it young if it ticks shortly after it. The distance must
    /// cover a late wake and the other loop's tick: timers that are due fire before messages.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Knee { reference: f32 }
    /// # impl Actor for Knee { type Context = AppContext<Self>; }
    ///
    /// /// Ticks 250 us after each sample is due.
    /// fn follow(sampled: Time, ctx: &mut AppContext<Knee>) {
    ///     let (period, distance) = (Duration::from_millis(1), Duration::from_micros(250));
    ///     ctx.every_from(sampled + distance, period, |knee, _, _| knee.reference = 0.0);
    /// }
    /// ```
    pub fn every_from(
        &mut self,
        first: Time,
        period: Duration,
        action: impl FnMut(&mut A, Tick, &mut Self) + 'static,
    ) -> TimerId {
        let timer = self.schedule.every(first, period, Action::Call(Box::new(action)));
        self.tuning.add_timer(period, timer);
        timer
    }

    /// Calls `action` once, after `delay`.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Brake { engaged: bool }
    /// # impl Actor for Brake { type Context = AppContext<Self>; }
    ///
    /// fn release(ctx: &mut AppContext<Brake>) {
    ///     // The drive holds its position before the brake lets go.
    ///     ctx.after(Duration::from_millis(200), |brake, _, _| brake.engaged = false);
    /// }
    /// ```
    pub fn after(
        &mut self,
        delay: Duration,
        action: impl FnMut(&mut A, Tick, &mut Self) + 'static,
    ) -> TimerId {
        self.schedule.once(self.now() + delay, Action::Call(Box::new(action)))
    }

    /// Cancels a timer from outside its own action.
    pub fn cancel(&mut self, timer: TimerId) -> bool {
        let is_cancelled = self.schedule.cancel(timer);
        if is_cancelled {
            self.tuning.remove_timer(timer);
        }
        is_cancelled
    }
}
