//! The parameters of an application: answers to questions about them, and sets that are applied at a tick.
//!
//! The framework handles these messages, before and beside the application's own handlers. A set waits for the next
//! tick of the periodic timer with the shortest period, and is applied before that timer's action.

use std::{
    sync::{Arc, OnceLock},
    time::Duration,
};

use actix::Actor;
use sinew_params::{
    AskParameters, ParameterError, ParameterList, ParameterOutcome, Parameters, SetParameters, TICK_WITHIN,
    Tuner,
};

use super::{Action, AppContext};
use crate::{
    outcome::{Outcome, Rejection},
    schedule::{Tick, TimerId},
    sender::{ReplyTo, Sender},
    time::Time,
    wire::{Flags, Message, Payload},
};

impl Payload for AskParameters {
    const NAME: &'static str = "sinew.param.ask";
}

impl Payload for ParameterList {
    const NAME: &'static str = "sinew.param.list";
}

impl Payload for SetParameters {
    const NAME: &'static str = "sinew.param.set";
    /// A set that no tick has taken by then is refused.
    const TIME_TO_LIVE: Option<Duration> = Some(TICK_WITHIN);
}

impl Payload for ParameterOutcome {
    const NAME: &'static str = "sinew.param.outcome";
}

/// Called on the application's thread after a kept parameter has changed; it must not wait.
pub(in crate::app) type KeptHook = Arc<OnceLock<Box<dyn Fn() + Send + Sync>>>;

/// The writer of an application's parameters, and the timers of the ticks at which it may write.
#[derive(Default)]
pub(super) struct Tuning {
    /// `None`: the application has no parameters.
    tuner: Option<Tuner<Option<ReplyTo>>>,
    on_kept: KeptHook,
    /// The application's periodic timers, in the order in which they were set.
    timers: Vec<(Duration, TimerId)>,
    /// Whether a timer is set that refuses sets without a tick. There is at most one, however many sets arrive.
    is_expiry_set: bool,
}

impl Tuning {
    /// Records a periodic timer of the application.
    pub(super) fn add_timer(&mut self, period: Duration, timer: TimerId) {
        self.timers.push((period, timer));
    }

    pub(super) fn remove_timer(&mut self, timer: TimerId) {
        self.timers.retain(|(_, other)| *other != timer);
    }

    /// Returns the timer of the ticks at which sets are applied, and its period: the shortest, of several the first.
    fn timer(&self) -> Option<(Duration, TimerId)> {
        self.timers.iter().min_by_key(|(period, _)| *period).copied()
    }

    /// Resumes after a pause.
    pub(super) fn resume(&mut self, now: Time) {
        if let Some(tuner) = &mut self.tuner {
            tuner.resume(since_origin(now));
        }
    }
}

impl<A: Actor<Context = Self>> AppContext<A> {
    /// Takes over the parameters of the application, for this incarnation.
    pub(in crate::app) fn tune(&mut self, set: Arc<dyn Parameters>, on_kept: KeptHook) {
        self.tuning.on_kept = on_kept;
        self.tuning.tuner = Some(Tuner::new(set, since_origin(self.now())));
    }

    /// Handles a message about parameters. `None`: it is another message, or the application has no parameters.
    pub(in crate::app) fn serve_parameters(&mut self, message: &Message, now: Time) -> Option<Outcome> {
        let kind = message.header.kind;
        if self.tuning.tuner.is_none() || ![AskParameters::KIND, SetParameters::KIND].contains(&kind) {
            return None;
        }
        let reply_to = message.header.flags.has(Flags::ASK).then(|| ReplyTo::of(&message.header));
        if kind == AskParameters::KIND {
            return Some(self.list_parameters(reply_to));
        }
        Some(match message.decode::<SetParameters>() {
            Ok(set) => self.set_parameters(&set, reply_to, now),
            Err(error) => {
                self.warn_of_payload(message.header.source, &error, now);
                Outcome::Rejected(Rejection::Malformed)
            }
        })
    }

    fn list_parameters(&self, reply_to: Option<ReplyTo>) -> Outcome {
        let (Some(to), Some(tuner)) = (reply_to, &self.tuning.tuner) else {
            return Outcome::Rejected(Rejection::Unsupported);
        };
        reply(&self.sender, Some(to), &tuner.list(self.tuning.timer().is_some()));
        Outcome::Delivered
    }

    /// Stages a set for the next tick. Without a periodic timer it is applied now, between two messages.
    fn set_parameters(&mut self, set: &SetParameters, reply_to: Option<ReplyTo>, now: Time) -> Outcome {
        let has_ticks = self.tuning.timer().is_some();
        let Some(tuner) = &mut self.tuning.tuner else { return Outcome::Rejected(Rejection::UnknownKind) };
        let until = reply_to.map_or(Time::MAX, |to| to.deadline()).min(now + TICK_WITHIN);
        if let Err((to, why)) = tuner.stage(set, (reply_to, since_origin(until)), has_ticks) {
            return refuse(&self.sender, to, &why);
        }
        if has_ticks {
            self.watch_deadline();
        } else {
            self.apply_parameters((0, Duration::ZERO), now);
        }
        Outcome::Delivered
    }

    /// Applies the sets that wait, and moves values with a slope, before the action of this timer.
    pub(in crate::app) fn tick_parameters(&mut self, timer: TimerId, tick: Tick, now: Time) {
        if self.tuning.tuner.is_some()
            && let Some((period, _)) = self.tuning.timer().filter(|(_, first)| *first == timer)
        {
            self.apply_parameters((tick.number, period), now);
        }
    }

    fn apply_parameters(&mut self, tick: (u64, Duration), now: Time) {
        let Some(tuner) = &mut self.tuning.tuner else { return };
        let is_kept_changed =
            tuner.tick(tick, since_origin(now), |to, outcome| reply(&self.sender, to, &outcome));
        if let Some(on_kept) = self.tuning.on_kept.get().filter(|_| is_kept_changed) {
            on_kept();
        }
    }

    /// Refuses the sets for which no tick came in time.
    pub(in crate::app) fn expire_parameters(&mut self, now: Time) {
        if let Some(tuner) = &mut self.tuning.tuner {
            tuner.expire(since_origin(now), |to, outcome| reply(&self.sender, to, &outcome));
        }
        self.tuning.is_expiry_set = false;
        self.watch_deadline();
    }

    /// Sets the timer for the first deadline of the sets that wait.
    fn watch_deadline(&mut self) {
        let deadline = self.tuning.tuner.as_ref().and_then(Tuner::next_deadline);
        if let Some(deadline) = deadline.filter(|_| !self.tuning.is_expiry_set) {
            let at = Time::ZERO + deadline;
            self.schedule.once(at, Action::ExpireParameters);
            self.tuning.is_expiry_set = true;
        }
    }
}

/// Replies, or rejects a set that asks for no reply.
fn refuse(sender: &Sender, to: Option<ReplyTo>, why: &ParameterError) -> Outcome {
    if to.is_none() {
        return Outcome::Rejected(Rejection::ByHandler);
    }
    reply(sender, to, &ParameterOutcome::from(why));
    Outcome::Delivered
}

fn reply<P: Payload>(sender: &Sender, to: Option<ReplyTo>, value: &P) {
    if let Some(to) = to {
        // A requester that has ended gets no reply; one with a full queue asks again.
        let _ = sender.reply(to, value);
    }
}

const fn since_origin(time: Time) -> Duration {
    Duration::from_nanos(time.as_nanos())
}
