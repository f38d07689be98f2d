//! The event loop of a running application: it fires due timers, handles one message, then checks the clock again.
//!
//! A backlog cannot starve the timers, because they are checked before every message. It cannot starve the
//! stop order or other actors of the thread either, because a turn is bounded.

use std::{
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use actix::{Actor, ActorContext, ActorFuture, ActorState, Handler};

use bytes::Bytes;

use crate::{
    app::{
        AppContext, Delivery, Raw, WatchId,
        context::Action,
        input_watch::WatchCheck,
        requirement::{Requirements, event_in},
    },
    clock::ClockAlarm,
    incident::{self, IncidentKind},
    mailbox::{MailboxReader, is_event},
    outcome::{Outcome, Rejection},
    protection::{Echo, ProtectionError, Verdict},
    remedy::{Wanted, remedy},
    router::mismatches::SPOILED,
    schedule::Due,
    supervision::liveness::{Activity, Liveness},
    time::Time,
    wire::{Flags, Header, Kind, Message, Payload, decode_as},
};

/// Maximum number of messages and timers handled before the other tasks of the thread have their turn.
const TURN_MAX: usize = 64;
/// Time after which no further message or timer is started in this turn. Otherwise 64 slow ones would delay
/// the other tasks and the stop order for seconds.
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
    // Only after decoding: bytes that are no valid `P` are no evidence that the sender is alive.
    let mut delivery = Delivery::new(payload, &message.header, now);
    if P::RETAINED {
        delivery = delivery.marked(&message.header);
    }
    // Nor is a value that was sent before this application joined its group.
    if !(P::RETAINED && delivery.is_retained()) {
        note_arrival(context, message, now);
    }
    actor.handle(delivery, context);
    Ok(())
}

/// Returns the value of a protected payload, if the message is valid and its output is live.
fn unseal<A, P>(context: &mut AppContext<A>, message: &Message, now: Time) -> Result<P, Rejection>
where
    A: Actor<Context = AppContext<A>>,
    P: Payload,
{
    let source = message.header.source;
    let Some(guard) = context.guard_of::<P>(source) else {
        let (why, remedy) =
            ("it is protected, and nothing here is guarded for this sender", "call `ctx.guard` for it");
        context.warn_of_refusal(source, &why, remedy, now);
        return Err(Rejection::Unsupported);
    };
    let mut unread = None;
    let read = |payload: Bytes| decode_as::<P>(&payload).map_err(|error| unread = Some(error)).ok();
    match (guard.take(&message.payload, read), unread) {
        (Verdict::Apply(value), _) => Ok(value),
        (Verdict::Hold, _) => Err(Rejection::ByHandler),
        (Verdict::Refused(ProtectionError::Unreadable), Some(error)) => {
            context.warn_of_payload(source, &error, now);
            Err(Rejection::Malformed)
        }
        (Verdict::Refused(ProtectionError::Corrupt), _) if message.payload == SPOILED => {
            let (why, remedy) = (
                "its sender has another version of the type",
                "build both programs with one version of the type; `sinew schema` shows the difference",
            );
            context.warn_of_refusal(source, &why, remedy, now);
            Err(Rejection::Malformed)
        }
        (Verdict::Refused(fault), _) => {
            context.warn_of_fault(source, fault, now);
            Err(if fault == ProtectionError::Corrupt { Rejection::Malformed } else { Rejection::ByHandler })
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
    let delivery = Delivery::new(Raw(message.payload.clone()), &message.header, now).marked(&message.header);
    if !delivery.is_retained() {
        note_arrival(context, message, now);
    }
    actor.handle(delivery, context);
    Ok(())
}

/// The future that runs the event loop, spawned into the actor's context.
pub(super) struct Drive<A: Actor<Context = AppContext<A>>> {
    reader: MailboxReader,
    handlers: Vec<(Kind, Dispatch<A>)>,
    requirements: Requirements<A>,
    /// The liveness state of this incarnation, read by other threads.
    liveness: Arc<Liveness>,
    alarm: Option<ClockAlarm>,
    /// Whether the last step was a timer. Then a queued message has the next step, so that a handler that
    /// overruns its period does not starve the mailbox.
    timer_was_last: bool,
    /// When the first step of the current turn began.
    turn_began: Option<Time>,
}

impl<A: Actor<Context = AppContext<A>>> Drive<A> {
    pub(super) const fn new(
        reader: MailboxReader,
        handlers: Vec<(Kind, Dispatch<A>)>,
        requirements: Requirements<A>,
        liveness: Arc<Liveness>,
    ) -> Self {
        Self {
            reader,
            handlers,
            requirements,
            liveness,
            alarm: None,
            timer_was_last: false,
            turn_began: None,
        }
    }

    /// Runs steps until no work is left or the turn's bound is reached.
    fn steps(&mut self, actor: &mut A, context: &mut AppContext<A>, task: &mut Context<'_>) -> Poll<()> {
        self.turn_began = None;
        for _ in 0..TURN_MAX {
            // A handler called `stop` or `wait`: actix must process that before the next message.
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

    /// Runs one step. `Ready(true)`: more work may be ready; `Ready(false)`: the application must end.
    fn step(&mut self, actor: &mut A, context: &mut AppContext<A>, task: &mut Context<'_>) -> Poll<bool> {
        // Without timers, an empty mailbox needs no look at the clock.
        if !self.requirements.is_paused()
            && context.schedule.next_due().is_none()
            && self.reader.poll_idle(task).is_pending()
        {
            self.timer_was_last = false;
            self.sleep(context, task);
            return Poll::Pending;
        }
        let now = context.now();
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
            self.liveness.begin(Activity::Timer, watched(context, now));
            // The successor of a fenced incarnation may have begun: its parameters have one writer.
            self.leave_if_over();
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

    /// Runs one step of a paused application: only layers' events are handled.
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
        self.liveness.begin(Activity::Message(message.header.kind), watched(context, now));
        let is_confirmed =
            message.receipt.take().map(|receipt| self.liveness.hold_receipt(receipt)).is_some();
        // An incarnation that was fenced while it took this message must not handle it.
        self.leave_if_over();
        let outcome = self.dispatch(actor, context, message, now);
        self.leave_if_over();
        self.reader.finish_aged(outcome, counted_age_ns(&message.header, now));
        if is_confirmed {
            self.liveness.settle(outcome);
        }
        if let Outcome::Rejected(why) = outcome {
            context.refused(&message.header, why);
        }
    }

    /// Ends this thread's work for an incarnation that was fenced while the actor's own code ran.
    fn leave_if_over(&self) {
        if self.liveness.is_fenced() {
            self.liveness.unwind_turn();
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
        if let Some(outcome) = context.serve_parameters(message, now) {
            return outcome;
        }
        let handler = self.handlers.iter().find(|(kind, _)| *kind == message.header.kind);
        let Some((_, dispatch)) = handler else {
            // An event without a handler is complete after its policy, and a liveness request is answered by
            // being processed.
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

    /// Sets the alarm for the next deadline. An application without deadlines has no timer.
    fn sleep(&mut self, context: &AppContext<A>, task: &mut Context<'_>) {
        let next = context.schedule.next_due();
        if self.alarm.is_none() && next.is_some() {
            let no_timer = |error: std::io::Error| -> ClockAlarm {
                panic!(
                    "no timer for its deadlines (timerfd): {error}; {}",
                    remedy(Wanted::Descriptor, &error)
                )
            };
            self.alarm = Some(context.clock().alarm().unwrap_or_else(no_timer));
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
            // `started` has run and did not hold the readiness.
            ready.reached();
        }
        let polled = this.steps(actor, context, task);
        // The tasks that run next in this turn are not messages of this mailbox.
        this.reader.count();
        let next = match context.state() {
            ActorState::Started | ActorState::Running => Activity::Task,
            ActorState::Stopping | ActorState::Stopped => Activity::Stop,
        };
        this.liveness.begin(next, None);
        polled
    }
}

/// Returns the begin of a step for the watchdog, if it is known without another look at a clock. The watchdog
/// judges hung actors by the host's clock, also in virtual time.
fn watched<A>(context: &AppContext<A>, now: Time) -> Option<Time>
where
    A: Actor<Context = AppContext<A>>,
{
    (!context.clock.is_virtual()).then_some(now)
}

/// Returns the age in nanoseconds that the mailbox counts. Events of layers were sent by no application, and the age of
/// a retained value is no property of its path.
fn counted_age_ns(header: &Header, now: Time) -> Option<u64> {
    if !header.kind.is_user() || is_event(header) || header.flags.has(Flags::RETAINED) {
        return None;
    }
    Some(now.as_nanos().saturating_sub(header.known_sent()?.as_nanos()))
}

fn fire<A>(actor: &mut A, context: &mut AppContext<A>, mut due: Due<Action<A>>, now: Time)
where
    A: Actor<Context = AppContext<A>>,
{
    let id = due.id();
    match &mut due.action {
        Action::Call(call) => {
            context.tick_parameters(id, due.tick, now);
            call(actor, due.tick, context);
        }
        Action::CheckWatch(id) => check_watch(actor, context, *id, now),
        Action::ExpireParameters => context.expire_parameters(now),
    }
    context.schedule.put_back(due);
}

/// Feeds the input watchdogs.
fn note_arrival<A>(context: &mut AppContext<A>, message: &Message, now: Time)
where
    A: Actor<Context = AppContext<A>>,
{
    for (index, watch) in context.watches.iter_mut().enumerate() {
        // Only after a timeout: until then one timer is set per limit, not one per message.
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
    let timeout = match watch.input.check(now) {
        WatchCheck::DueAt(at) => {
            context.schedule.once(at, Action::CheckWatch(id));
            return;
        }
        WatchCheck::TimedOut(timeout) => timeout,
    };
    // On the wall clock, also where the application has another one.
    let at = Time::now();
    if let Some(mut action) = watch.action.take() {
        action(actor, timeout, context);
        context.watches[id.0].action = Some(action);
    }
    // Behind the action, which may bring an output into its safe state.
    incident::report(
        at,
        IncidentKind::Symptom,
        format_args!("an input of {} is late: {timeout}", context.tid()),
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tid::{AppAddress, NodeAddress, Tid};

    #[test]
    fn ages_of_events_and_retained_values_are_not_counted() {
        let node = NodeAddress::new(1);
        let app = |number| Tid::new(node, AppAddress::new(number));
        let mut header = Header::new(Kind::named("test"), app(0x8000_0001), app(0x8000_0002));
        header.sent = Time::from_nanos(1_000);
        let age_ns = |header: &Header| counted_age_ns(header, Time::from_nanos(5_000));
        assert_eq!(age_ns(&header), Some(4_000));
        let event = Header { source: Tid::new(node, AppAddress::SYNC), ..header };
        let retained = Header { flags: Flags::RETAINED, ..header };
        let of_unknown_age = {
            let mut header = header;
            header.set_sent_error(None);
            header
        };
        for header in [event, retained, Header { kind: Kind::STOP_STATE, ..header }, of_unknown_age] {
            assert_eq!(age_ns(&header), None);
        }
    }
}
