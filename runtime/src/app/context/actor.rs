//! The context as actix uses it: the stop, the address and the futures of its actor.

use std::time::Duration;

use actix::{
    Actor, ActorContext, ActorFuture, ActorFutureExt, ActorState, Addr, AsyncContext, Handler, Message,
    SpawnHandle,
    dev::{AsyncContextParts, ContextParts, Envelope, OneshotSender, ToEnvelope},
    fut::wrap_future,
    utils::{IntervalFunc, TimerFunc},
};

use futures_util::StreamExt;

use super::AppContext;
use crate::supervision::liveness::Liveness;

fn note_stop() {
    if let Some(liveness) = Liveness::current() {
        liveness.record_stop();
    }
}

impl<A: Actor<Context = Self>> ActorContext for AppContext<A> {
    fn stop(&mut self) {
        note_stop();
        self.parts.stop();
    }

    fn terminate(&mut self) {
        note_stop();
        self.parts.terminate();
    }

    fn state(&self) -> ActorState {
        self.parts.state()
    }
}

impl<A: Actor<Context = Self>> AsyncContext<A> for AppContext<A> {
    fn address(&self) -> Addr<A> {
        self.parts.address()
    }

    fn spawn<F>(&mut self, future: F) -> SpawnHandle
    where
        F: ActorFuture<A, Output = ()> + 'static,
    {
        self.parts.spawn(future)
    }

    fn wait<F>(&mut self, future: F)
    where
        F: ActorFuture<A, Output = ()> + 'static,
    {
        self.parts.wait(future);
    }

    fn waiting(&self) -> bool {
        self.parts.waiting()
    }

    fn cancel_future(&mut self, handle: SpawnHandle) -> bool {
        self.parts.cancel_future(handle)
    }

    // actix's own timers run on the clock of tokio. They are replaced in virtual time only. `notify_later` uses
    // `run_later` on both clocks.

    fn notify_later<M>(&mut self, message: M, after: Duration) -> SpawnHandle
    where
        A: Handler<M>,
        M: Message + 'static,
    {
        self.run_later(after, |actor, context| {
            let result = actor.handle(message, context);
            actix::dev::MessageResponse::<A, M>::handle(result, context, None);
        })
    }

    fn run_later<F>(&mut self, after: Duration, action: F) -> SpawnHandle
    where
        F: FnOnce(&mut A, &mut A::Context) + 'static,
    {
        if !self.clock.is_virtual() {
            return self.spawn(TimerFunc::new(after, action));
        }
        let due = wrap_future::<_, A>(self.clock.sleep(after));
        self.spawn(due.map(|(), actor, context| action(actor, context)))
    }

    fn run_interval<F>(&mut self, period: Duration, mut action: F) -> SpawnHandle
    where
        F: FnMut(&mut A, &mut A::Context) + 'static,
    {
        if !self.clock.is_virtual() {
            return self.spawn(actix::fut::ActorStreamExt::finish(IntervalFunc::new(period, action)));
        }
        let (clock, mut next) = (self.clock.clone(), self.clock.now());
        // A period of zero would never let the clock move.
        let period = period.max(Duration::from_micros(1));
        let ticks = futures_util::stream::repeat(()).then(move |()| {
            next = next + period;
            clock.sleep_until(next)
        });
        let ticks = actix::fut::wrap_stream::<_, A>(ticks);
        let each = actix::fut::ActorStreamExt::map(ticks, move |(), actor, context| action(actor, context));
        self.spawn(actix::fut::ActorStreamExt::finish(each))
    }
}

impl<A: Actor<Context = Self>> AsyncContextParts<A> for AppContext<A> {
    fn parts(&mut self) -> &mut ContextParts<A> {
        &mut self.parts
    }
}

impl<A, M> ToEnvelope<A, M> for AppContext<A>
where
    A: Actor<Context = Self> + Handler<M>,
    M: Message<Result: Send> + Send + 'static,
{
    fn pack(message: M, answer: Option<OneshotSender<M::Result>>) -> Envelope<A> {
        Envelope::new(message, answer)
    }
}
