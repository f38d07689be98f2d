//! The messages of an application: sends, replies, and the rejection of the current one.

use actix::Actor;

use super::AppContext;
use crate::{
    app::Delivery,
    outcome::{Outcome, Rejection},
    sender::{Destination, MessageBuilder, SendError, Sender, Value, Via},
    wire::Payload,
};

impl<A: Actor<Context = Self>> AppContext<A> {
    /// Sends a value; see [`Sender::send`].
    ///
    /// # Errors
    /// The message was not accepted.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{message::SendError, prelude::*};
    ///
    /// payload!("demo.stop" => struct Stop;);
    /// # struct Gait;
    /// # impl Actor for Gait { type Context = AppContext<Self>; }
    ///
    /// fn stop_all(ctx: &AppContext<Gait>) -> Result<(), SendError> {
    ///     ctx.send("knee.drive", &Stop)?; // by name
    ///     ctx.send(Tid::group("drives"), &Stop) // to each member of a group
    /// }
    /// ```
    pub fn send<'a, P: Payload>(&self, to: impl Into<Destination<'a>>, value: &P) -> Result<(), SendError> {
        self.sender.send(to, value)
    }

    /// Returns a builder for a message with other terms than its type's defaults, for a confirmed message or
    /// for a request: see [`MessageBuilder`].
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{message::SendError, prelude::*};
    ///
    /// payload!("demo.calibrate" => struct Calibrate { zero_degrees: f32 });
    ///
    /// struct Gait;
    /// # impl Actor for Gait { type Context = AppContext<Self>; }
    ///
    /// fn calibrate(ctx: &mut AppContext<Gait>) -> Result<(), SendError> {
    ///     let command = Calibrate { zero_degrees: 0.5 };
    ///     let outcome = ctx.message("knee.drive", &command).confirmed(Duration::from_millis(100))?;
    ///     ctx.spawn(outcome.into_actor(&Gait).map(|outcome, _, _| println!("calibrate: {outcome:?}")));
    ///     Ok(())
    /// }
    /// ```
    pub fn message<'a, P: Payload>(
        &'a mut self,
        to: impl Into<Destination<'a>>,
        value: &'a P,
    ) -> MessageBuilder<&'a mut Self, Value<'a, P>> {
        MessageBuilder::new(self, Value { destination: to.into(), value })
    }

    /// Replies to a request.
    ///
    /// # Errors
    /// The sender of `request` does not wait for a reply, or the reply was not accepted.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.ask_angle" => struct AskAngle;);
    /// payload!("demo.angle" => struct Angle { degrees: f32 });
    ///
    /// struct Knee { degrees: f32 }
    /// # impl Actor for Knee { type Context = AppContext<Self>; }
    ///
    /// impl Handler<Delivery<AskAngle>> for Knee {
    ///     type Result = ();
    ///     fn handle(&mut self, request: Delivery<AskAngle>, ctx: &mut Self::Context) {
    ///         let _ = ctx.reply(&request, &Angle { degrees: self.degrees });
    ///     }
    /// }
    /// ```
    pub fn reply<P, R: Payload>(&self, request: &Delivery<P>, value: &R) -> Result<(), SendError> {
        let to = request.reply_to().ok_or(SendError::Rejected(Rejection::Unsupported))?;
        self.sender.reply(to, value)
    }

    /// Returns whether the sender of `request` still waits for a reply; see [`Sender::is_wanted`].
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.plan" => struct Plan { steps: u32 });
    /// payload!("demo.planned" => struct Planned;);
    /// # struct Planner;
    /// # impl Actor for Planner { type Context = AppContext<Self>; }
    ///
    /// impl Handler<Delivery<Plan>> for Planner {
    ///     type Result = ();
    ///     fn handle(&mut self, request: Delivery<Plan>, ctx: &mut Self::Context) {
    ///         for _step in 0..request.steps {
    ///             if !ctx.is_wanted(&request) {
    ///                 return; // its sender waits no more
    ///             }
    ///             // Long work.
    ///         }
    ///         let _ = ctx.reply(&request, &Planned);
    ///     }
    /// }
    /// ```
    #[must_use]
    pub fn is_wanted<P>(&self, request: &Delivery<P>) -> bool {
        request.reply_to().is_some_and(|to| self.sender.is_wanted(&to))
    }

    /// Rejects the current message: its sender gets `Rejected(ByHandler)` instead of `Delivered`.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.move" => struct Move { degrees: f32 });
    ///
    /// struct Knee { target: f32 }
    /// # impl Actor for Knee { type Context = AppContext<Self>; }
    ///
    /// impl Handler<Delivery<Move>> for Knee {
    ///     type Result = ();
    ///     fn handle(&mut self, command: Delivery<Move>, ctx: &mut Self::Context) {
    ///         if !(0.0..=120.0).contains(&command.degrees) {
    ///             return ctx.reject(); // beyond the mechanical stops
    ///         }
    ///         self.target = command.degrees;
    ///     }
    /// }
    /// ```
    pub fn reject(&mut self) {
        self.verdict = Some(Outcome::Rejected(Rejection::ByHandler));
    }
}

impl<A> Via for &mut AppContext<A>
where
    A: Actor<Context = AppContext<A>>,
{
    fn sender(&self) -> &Sender {
        &self.sender
    }
}
