//! The heart of a running application: fires what is due, then hands over one message, then looks at the clock again.
//!
//! A backlog cannot starve the timers, because they are looked at before every message; nor the stop order or the other
//! actors of the thread, because a turn is bounded.

use std::{
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use actix::{Actor, ActorContext, ActorFuture, ActorState, Handler};

use bytes::Bytes;

use crate::{
    alarm::Alarm,
    app::{
        AppContext, Delivery, Raw, WatchId,
        context::Action,
        input_watch::Looked,
        requirement::{Requirements, event_in},
    },
    mailbox::MailboxReader,
    outcome::{Outcome, Rejection},
    protection::{Echo, Fault, Verdict},
    remedy::{Wanted, remedy},
    schedule::Due,
    supervision::vitals::{Doing, Vitals},
    time::Time,
    wire::{Kind, Message, Payload, decode_as},
};

/// Messages and timers that are handled before the other tasks of the thread have their turn.
const TURN_MAX: usize = 64;
/// Time after which no further message or timer is begun in this turn: of slow ones 64 would keep the others, and the
/// order to stop, waiting for seconds.
const TURN_LONGEST: Duration = Duration::from_millis(1);

/// Decodes a payload and calls its handler.
pub(super) type Dispatch<A> = fn(&mut A, &mut AppContext<A>, &Message, Time) -> Result<(), Rejection>;

/// Calls `Handler<Delivery<P>>`.
pub(super) fn dispatch_typed<A, P>(
    actor: &mut A,
    context: &mut AppContext<A>,
    message: &Message,
    now: Time,
) -> Result<(), Rejection>
where
    A: Actor<Context = AppContext<A>> + Handler<Delivery<P>, Result = ()>,
    P: Payload,
{
    let payload = match P::PROTECTION {
        None => message.decode::<P>().map_err(|error| {
            context.warn_of_payload(message.header.source, &error, now);
            Rejection::Malformed
        })?,
        Some(_) => unseal::<A, P>(context, message, now)?,
    };
    // Only now: bytes that are no `P` are no sign of life of its sender.
    note_arrival(context, message, now);
    actor.handle(Delivery::new(payload, &message.header, now), context);
    Ok(())
}

/// The value of a protected payload, if it is good and its output is live.
fn unseal<A, P>(context: &mut AppContext<A>, message: &Message, now: Time) -> Result<P, Rejection>
where
    A: Actor<Context = AppContext<A>>,
    P: Payload,
{
    let source = message.header.source;
    let Some(guard) = context.guard_of::<P>(source) else {
        context.warn_of_payload(source, &"it is protected, and nothing here is guarded for this sender", now);
        return Err(Rejection::Unsupported);
    };
    let mut unread = None;
    let read = |payload: Bytes| decode_as::<P>(&payload).map_err(|error| unread = Some(error)).ok();
    match (guard.take(&message.payload, read), unread) {
        (Verdict::Apply(value), _) => Ok(value),
        (Verdict::Hold, _) => Err(Rejection::ByHandler),
        (Verdict::Refused(Fault::Unreadable), Some(error)) => {
            context.warn_of_payload(source, &error, now);
            Err(Rejection::Malformed)
        }
        (Verdict::Refused(fault), _) => {
            context.warn_of_payload(source, &fault, now);
            Err(if fault == Fault::Corrupt { Rejection::Malformed } else { Rejection::ByHandler })
        }
    }
}

/// Calls `Handler<Delivery<Raw>>`.
pub(super) fn dispatch_raw<A>(
    actor: &mut A,
    context: &mut AppContext<A>,
    message: &Message,
    now: Time,
) -> Result<(), Rejection>
where
    A: Actor<Context = AppContext<A>> + Handler<Delivery<Raw>, Result = ()>,
{
    note_arrival(context, message, now);
    actor.handle(Delivery::new(Raw(message.payload.clone()), &message.header, now), context);
    Ok(())
}

/// The future, spawned into the actor's context, that drives it.
pub(super) struct Drive<A: Actor<Context = AppContext<A>>> {
    reader: MailboxReader,
    handlers: Vec<(Kind, Dispatch<A>)>,
    requirements: Requirements<A>,
    /// What others see of this incarnation.
    vitals: Arc<Vitals>,
    alarm: Option<Alarm>,
    /// A timer had the last step: a waiting message has the next one, so that a handler that overruns its period does not
    /// shut the mailbox out.
    timer_was_last: bool,
    /// When the present turn had its first step.
    turn_began: Option<Time>,
}

impl<A: Actor<Context = AppContext<A>>> Drive<A> {
    pub(super) const fn new(
        reader: MailboxReader,
        handlers: Vec<(Kind, Dispatch<A>)>,
        requirements: Requirements<A>,
        vitals: Arc<Vitals>,
    ) -> Self {
        Self { reader, handlers, requirements, vitals, alarm: None, timer_was_last: false, turn_began: None }
    }

    /// Steps until there is nothing more to do, or others must have their turn.
    fn steps(&mut self, actor: &mut A, context: &mut AppContext<A>, task: &mut Context<'_>) -> Poll<()> {
        self.turn_began = None;
        for _ in 0..TURN_MAX {
            // A handler called `stop` or `wait`: actix has to see that before the next message.
            if actix::AsyncContext::waiting(context) {
                task.waker().wake_by_ref();
                return Poll::Pending;
            }
            match self.step(actor, context, task) {
                Poll::Ready(true) => {}
                Poll::Ready(false) => {
                    context.stop();
                    return Poll::Ready(());
                }
                Poll::Pending => return Poll::Pending,
            }
        }
        task.waker().wake_by_ref();
        Poll::Pending
    }

    /// One turn's step. `Ready(true)`: there may be more to do; `Ready(false)`: the application is to end.
    fn step(&mut self, actor: &mut A, context: &mut AppContext<A>, task: &mut Context<'_>) -> Poll<bool> {
        let now = Time::now();
        if now.since(*self.turn_began.get_or_insert(now)) >= TURN_LONGEST {
            task.waker().wake_by_ref();
            return Poll::Pending;
        }
        if self.requirements.is_paused() {
            return self.step_paused(actor, context, task, now);
        }
        if !std::mem::replace(&mut self.timer_was_last, false)
            && let Some(due) = context.schedule.take_due(now)
        {
            self.timer_was_last = true;
            self.reader.count();
            self.vitals.begins(Doing::Timer, Some(now));
            fire(actor, context, due, now);
            self.leave_if_over();
            return Poll::Ready(true);
        }
        match &mut self.reader.poll_take(task) {
            Poll::Ready(Some(message)) => {
                self.handle(actor, context, message, now);
                Poll::Ready(true)
            }
            Poll::Ready(None) => Poll::Ready(false),
            Poll::Pending if context.schedule.next_due().is_some_and(|due| due <= now) => Poll::Ready(true),
            Poll::Pending => {
                self.sleep(context, task);
                Poll::Pending
            }
        }
    }

    /// The same in a pause: nothing but the layers' events.
    fn step_paused(
        &mut self,
        actor: &mut A,
        context: &mut AppContext<A>,
        task: &mut Context<'_>,
        now: Time,
    ) -> Poll<bool> {
        self.reader.poll_event(task).map(|event| match event {
            Some(mut event) => {
                self.handle(actor, context, &mut event, now);
                true
            }
            None => false,
        })
    }

    fn handle(&mut self, actor: &mut A, context: &mut AppContext<A>, message: &mut Message, now: Time) {
        if message.header.is_expired(now) {
            self.reader.finish(Outcome::Expired);
            message.settle(Outcome::Expired);
            return;
        }
        self.vitals.begins(Doing::Message(message.header.kind), Some(now));
        let is_confirmed = message.receipt.take().map(|receipt| self.vitals.hold(receipt)).is_some();
        // One that was fenced off while it took this message must not begin with it.
        self.leave_if_over();
        let outcome = self.dispatch(actor, context, message, now);
        self.leave_if_over();
        self.reader.finish(outcome);
        if is_confirmed {
            self.vitals.settle(outcome);
        }
        if let Outcome::Rejected(why) = outcome {
            context.refused(&message.header, why);
        }
    }

    /// A life that was taken while its thread was in the actor's own code goes no further.
    fn leave_if_over(&self) {
        if self.vitals.is_over() {
            self.vitals.leave();
        }
    }

    fn dispatch(
        &mut self,
        actor: &mut A,
        context: &mut AppContext<A>,
        message: &Message,
        now: Time,
    ) -> Outcome {
        let event = event_in(context, message);
        if let Some(event) = &event
            && !self.requirements.take(actor, context, event, now)
        {
            return Outcome::Delivered;
        }
        if message.header.kind == Echo::KIND {
            return match message.decode() {
                Ok(echo) => {
                    context.echoed(message.header.source, echo);
                    Outcome::Delivered
                }
                Err(_) => Outcome::Rejected(Rejection::Malformed),
            };
        }
        let handler = self.handlers.iter().find(|(kind, _)| *kind == message.header.kind);
        let Some((_, dispatch)) = handler else {
            // An event that nobody handles has served its policy; who asks for a sign of life has it.
            let is_served = event.is_some() || message.header.kind == Kind::PING;
            let served = is_served.then_some(Outcome::Delivered);
            return served.unwrap_or(Outcome::Rejected(Rejection::UnknownKind));
        };
        context.verdict = None;
        #[cfg(feature = "fault-points")]
        if crate::supervision::fault::strike_message() {
            context.stop();
        }
        match dispatch(actor, context, message, now) {
            Ok(()) => context.verdict.take().unwrap_or(Outcome::Delivered),
            Err(why) => Outcome::Rejected(why),
        }
    }

    /// Sets the alarm for the next deadline. An application without deadlines has no timer at all.
    fn sleep(&mut self, context: &AppContext<A>, task: &mut Context<'_>) {
        let next = context.schedule.next_due();
        if self.alarm.is_none() && next.is_some() {
            let no_timer = |error: std::io::Error| -> Alarm {
                panic!(
                    "no timer for its deadlines (timerfd): {error}; {}",
                    remedy(Wanted::Descriptor, &error)
                )
            };
            self.alarm = Some(Alarm::new().unwrap_or_else(no_timer));
        }
        if let Some(alarm) = &mut self.alarm {
            alarm.wake_at(next, task).expect("a timerfd that was made takes a time");
        }
    }
}

impl<A: Actor<Context = AppContext<A>>> ActorFuture<A> for Drive<A> {
    type Output = ();

    fn poll(
        self: Pin<&mut Self>,
        actor: &mut A,
        context: &mut AppContext<A>,
        task: &mut Context<'_>,
    ) -> Poll<()> {
        let this = self.get_mut();
        if let Some(ready) = context.ready.take() {
            // `started` has run and did not ask for more time.
            ready.reached();
        }
        let polled = this.steps(actor, context, task);
        // What runs next in this turn is nothing that was taken here.
        this.reader.count();
        let next = match context.state() {
            ActorState::Started | ActorState::Running => Doing::Task,
            ActorState::Stopping | ActorState::Stopped => Doing::Stop,
        };
        this.vitals.begins(next, None);
        polled
    }
}

fn fire<A>(actor: &mut A, context: &mut AppContext<A>, mut due: Due<Action<A>>, now: Time)
where
    A: Actor<Context = AppContext<A>>,
{
    match &mut due.action {
        Action::Call(call) => call(actor, due.tick, context),
        Action::CheckWatch(id) => check_watch(actor, context, *id, now),
    }
    context.schedule.put_back(due);
}

/// Feeds the input watchdogs.
fn note_arrival<A>(context: &mut AppContext<A>, message: &Message, now: Time)
where
    A: Actor<Context = AppContext<A>>,
{
    for (index, watch) in context.watches.iter_mut().enumerate() {
        // Only after a timeout: until then one timer is set for each limit, not one for each message.
        if let Some(at) = watch.input.note(&message.header, now) {
            context.schedule.once(at, Action::CheckWatch(WatchId(index)));
        }
    }
}

fn check_watch<A>(actor: &mut A, context: &mut AppContext<A>, id: WatchId, now: Time)
where
    A: Actor<Context = AppContext<A>>,
{
    let watch = &mut context.watches[id.0];
    let timeout = match watch.input.look(now) {
        Looked::DueAt(at) => {
            context.schedule.once(at, Action::CheckWatch(id));
            return;
        }
        Looked::Over(timeout) => timeout,
    };
    if let Some(mut action) = watch.action.take() {
        action(actor, timeout, context);
        context.watches[id.0].action = Some(action);
    }
}
