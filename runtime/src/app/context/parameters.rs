//! The parameters of an application: answers to questions about them, and sets that are applied at a tick.
//!
//! The framework handles these messages, before and beside the application's own handlers. A set waits for the next
//! tick of the periodic timer with the shortest period, and is applied before that timer's action. The values of a
//! transaction wait for the first tick at or after its stated time; the participants' messages are sent from here.

use std::{
    sync::{Arc, OnceLock},
    time::Duration,
};

use actix::Actor;
use sinew_params::{
    AskParameters, OwnPart, ParameterError, ParameterList, ParameterOutcome, ParameterVote, Parameters,
    SetParameters, TICK_WITHIN, Tuner,
};

use super::{Action, AppContext};
use crate::{
    log,
    outcome::{Outcome, Rejection},
    schedule::{Tick, TimerId},
    sender::{ReplyTo, Sender},
    tid::Tid,
    time::Time,
    wire::{Flags, Header, Message, Payload},
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

impl Payload for ParameterVote {
    const NAME: &'static str = "sinew.param.vote";
    /// A later one of the same content has been sent by then.
    const TIME_TO_LIVE: Option<Duration> = Some(TICK_WITHIN);
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
    /// The timer that refuses sets without a tick and continues a transaction, and when it fires. There is at most one,
    /// however many sets arrive.
    expiry: Option<(Duration, TimerId)>,
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

    /// Has the kept parameters written.
    fn write_kept(&self) {
        if let Some(on_kept) = self.on_kept.get() {
            on_kept();
        }
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
        self.tuning.tuner.as_ref()?;
        let Header { kind, source, flags, .. } = message.header;
        let reply_to = flags.has(Flags::ASK).then(|| ReplyTo::of(&message.header));
        let served = if kind == AskParameters::KIND {
            Ok(self.list_parameters(reply_to))
        } else if kind == SetParameters::KIND {
            message.decode().map(|set| self.set_parameters(&set, &message.header, reply_to, now))
        } else if kind == ParameterVote::KIND {
            message.decode().map(|vote| self.take_vote(source, vote, now))
        } else {
            return None;
        };
        Some(served.unwrap_or_else(|error| {
            self.warn_of_payload(source, &error, now);
            Outcome::Rejected(Rejection::Malformed)
        }))
    }

    fn list_parameters(&self, reply_to: Option<ReplyTo>) -> Outcome {
        let (Some(to), Some(tuner)) = (reply_to, &self.tuning.tuner) else {
            return Outcome::Rejected(Rejection::Unsupported);
        };
        reply(&self.sender, Some(to), &tuner.list(self.tuning.timer().is_some()));
        Outcome::Delivered
    }

    /// Stages a set for the next tick. Without a periodic timer it is applied now, between two messages. A transaction
    /// is answered at once.
    fn set_parameters(
        &mut self,
        set: &SetParameters,
        header: &Header,
        reply_to: Option<ReplyTo>,
        now: Time,
    ) -> Outcome {
        let has_ticks = self.tuning.timer().is_some();
        let Some(tuner) = &mut self.tuning.tuner else { return Outcome::Rejected(Rejection::UnknownKind) };
        let answer = match set {
            SetParameters::Prepare(transaction) => {
                let sent = header.known_sent().zip(header.sent_error());
                let sent = sent.map(|(sent, error)| (since_origin(sent), error));
                let own = OwnPart { tid: self.sender.tid().bits(), has_ticks };
                tuner.prepare(transaction, own, sent, since_origin(now)).map(Some)
            }
            SetParameters::Conclude(id) => Ok(Some(tuner.outcome_of(*id, since_origin(now)))),
            SetParameters::Values(_) | SetParameters::Undo => {
                let until = reply_to.map_or(Time::MAX, |to| to.deadline()).min(now + TICK_WITHIN);
                let staged = tuner.stage(set, (reply_to, since_origin(until)), has_ticks);
                staged.map(|()| None).map_err(|(_, why)| why)
            }
        };
        match answer {
            Ok(Some(outcome)) => reply(&self.sender, reply_to, &outcome),
            Ok(None) if !has_ticks => self.apply_parameters((0, Duration::ZERO), now),
            Ok(None) => {}
            Err(why) => return refuse(&self.sender, reply_to, &why),
        }
        self.send_votes();
        Outcome::Delivered
    }

    /// Handles a message of another participant of a transaction.
    fn take_vote(&mut self, source: Tid, vote: ParameterVote, now: Time) -> Outcome {
        let Some(tuner) = &mut self.tuning.tuner else { return Outcome::Delivered };
        let is_kept_changed = tuner.on_vote(since_origin(now), source.bits(), vote);
        self.send_votes();
        if is_kept_changed {
            self.tuning.write_kept();
        }
        Outcome::Delivered
    }

    /// Sends the messages to the other participants of a transaction, and sets the timer of its next step.
    fn send_votes(&mut self) {
        if let Some(tuner) = &mut self.tuning.tuner {
            while let Some((to, vote)) = tuner.take_vote() {
                // It is sent again until its receiver has answered, or the doubt ends.
                let _ = self.sender.send(Tid::from_bits(to), &vote);
            }
            if let Some(id) = tuner.take_late() {
                log::warn!(
                    application = %self.sender.tid(),
                    "a transaction of {} was applied late, as this application learned late that all had accepted it: look \
                     whether it was cut off or paused (`sinew nodes`, `sinew apps`)",
                    Tid::from_bits(id.coordinator)
                );
            }
        }
        self.watch_deadline();
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
        let has_transaction = !tuner.is_idle();
        let is_kept_changed =
            tuner.tick(tick, since_origin(now), |to, outcome| reply(&self.sender, to, &outcome));
        if is_kept_changed {
            self.tuning.write_kept();
        }
        if has_transaction {
            self.send_votes();
        }
    }

    /// Refuses the sets for which no tick came in time, and takes the steps of a transaction that are due.
    pub(in crate::app) fn expire_parameters(&mut self, now: Time) {
        self.tuning.expiry = None;
        if self.tuning.timer().is_none() {
            // Agreed values apply between two messages.
            self.apply_parameters((0, Duration::ZERO), now);
        } else if let Some(tuner) = &mut self.tuning.tuner {
            tuner.expire(since_origin(now), |to, outcome| reply(&self.sender, to, &outcome));
        }
        self.send_votes();
    }

    /// Sets the timer for the first deadline of the sets that wait, and of a transaction.
    fn watch_deadline(&mut self) {
        let deadline = self.tuning.tuner.as_ref().and_then(Tuner::next_deadline);
        let Some(deadline) = deadline else { return };
        if let Some((at, timer)) = self.tuning.expiry {
            if at <= deadline {
                return;
            }
            self.schedule.cancel(timer);
        }
        let timer = self.schedule.once(Time::ZERO + deadline, Action::ExpireParameters);
        self.tuning.expiry = Some((deadline, timer));
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
