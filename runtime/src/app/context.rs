//! What an application's handlers can do.

use std::{fmt, io, sync::Arc, time::Duration};

use actix::{
    Actor, ActorContext, ActorFuture, ActorState, Addr, AsyncContext, Handler, Message, SpawnHandle,
    dev::{AsyncContextParts, ContextFut, ContextParts, Envelope, OneshotSender, ToEnvelope},
};

use crate::{
    app::{Delivery, InputCriterion, InputTimeout, input_watch::InputWatch, requirement::Parting},
    monitor::{MonitorError, MonitorId},
    outcome::{Outcome, Rejection},
    protection::{Cause, DataId, Echo, Guard, Guarded},
    schedule::{Schedule, Tick, TimerId},
    sender::{Destination, MessageBuilder, SendError, Sender, Value, Via},
    supervision::{ReadyGate, Reason, vitals::Vitals},
    tid::Tid,
    time::Time,
    wire::{Header, Kind, Payload},
};

/// The context of an application's actor: actix's, and what Sinew adds to it.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// payload!("demo.angle", Stream => struct Angle { degrees: f32 });
///
/// struct Hip { degrees: f32 }
///
/// impl Actor for Hip {
///     type Context = AppContext<Self>;
///     fn started(&mut self, ctx: &mut Self::Context) {
///         ctx.every(Duration::from_millis(1), |hip, _, ctx| {
///             // The knee may not be there yet, and the next value comes in a millisecond.
///             let _ = ctx.send("knee", &Angle { degrees: hip.degrees });
///         });
///     }
/// }
/// ```
pub struct AppContext<A: Actor<Context = Self>> {
    parts: ContextParts<A>,
    mailbox: Option<actix::dev::Mailbox<A>>,
    sender: Sender,
    pub(super) schedule: Schedule<Action<A>>,
    pub(super) watches: Vec<Watch<A>>,
    pub(super) ready: Option<ReadyGate>,
    /// How it ends, where it says so itself.
    parting: Parting,
    /// When a payload that cannot be read was last logged.
    warned: Option<Time>,
    /// Those since then.
    unlogged: u64,
    /// What the handler says of the message in hand, if it does not take it.
    pub(super) verdict: Option<Outcome>,
    /// The outputs that protected messages move.
    guards: Vec<HeldGuard>,
}

/// What is guarded.
struct HeldGuard {
    guard: Arc<dyn Guarded>,
    /// The type that it is moved by.
    kind: Kind,
    /// The timer of its echoes.
    echoes: TimerId,
}

pub(super) type Timer<A> = Box<dyn FnMut(&mut A, Tick, &mut <A as Actor>::Context)>;

type Alert<A> = Box<dyn FnMut(&mut A, InputTimeout, &mut <A as Actor>::Context)>;

/// What a deadline is for.
pub(super) enum Action<A: Actor> {
    Call(Timer<A>),
    CheckWatch(WatchId),
}

/// Names an input watchdog.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WatchId(pub(super) usize);

/// An input watchdog and what it calls.
pub(super) struct Watch<A: Actor> {
    pub(super) input: InputWatch,
    /// Out while it runs.
    pub(super) action: Option<Alert<A>>,
}

impl<A: Actor<Context = Self>> AppContext<A> {
    pub(super) fn into_life(
        sender: Sender,
        ready: ReadyGate,
        actor: A,
        parting: Parting,
    ) -> ContextFut<A, Self> {
        let mailbox = actix::dev::Mailbox::default();
        let mut context = Self {
            parts: ContextParts::new(mailbox.sender_producer()),
            mailbox: Some(mailbox),
            sender,
            schedule: Schedule::default(),
            watches: Vec::new(),
            ready: Some(ready),
            parting,
            warned: None,
            unlogged: 0,
            verdict: None,
            guards: Vec::new(),
        };
        let mailbox = context.mailbox.take().expect("it was put there three lines above");
        ContextFut::new(context, actor, mailbox)
    }

    /// The TID of this application.
    #[must_use]
    pub fn tid(&self) -> Tid {
        self.sender.tid()
    }

    /// The sending side of this application, for futures and other threads.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.force", Stream => struct Force { newtons: f32 });
    ///
    /// struct Plate;
    /// # fn read_device() -> f32 { 0.0 }
    ///
    /// impl Actor for Plate {
    ///     type Context = AppContext<Self>;
    ///     fn started(&mut self, ctx: &mut Self::Context) {
    ///         let sender = ctx.sender();
    ///         // A device whose driver blocks has a thread of its own.
    ///         std::thread::spawn(move || while sender.send("gait", &Force { newtons: read_device() }).is_ok() {});
    ///     }
    /// }
    /// ```
    #[must_use]
    pub fn sender(&self) -> Sender {
        self.sender.clone()
    }

    /// The TID that has `name` now, on any node.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Hip { knee: Option<Tid> }
    /// # impl Actor for Hip { type Context = AppContext<Self>; }
    ///
    /// /// Looks the name up once, so that each turn of the loop sends to a TID.
    /// fn find(hip: &mut Hip, ctx: &AppContext<Hip>) {
    ///     hip.knee = ctx.resolve("knee.drive");
    /// }
    /// ```
    #[must_use]
    pub fn resolve(&self, name: &str) -> Option<Tid> {
        self.sender.resolve(name)
    }

    /// Watches the present life of the application at `tid`; see [`Sender::monitor`].
    ///
    /// # Errors
    /// The TID is not that of an application, or there are too many monitors.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{events::MonitorError, prelude::*};
    ///
    /// struct Gait;
    /// # impl Actor for Gait { type Context = AppContext<Self>; }
    /// impl Handler<Delivery<Down>> for Gait {
    ///     type Result = ();
    ///     fn handle(&mut self, down: Delivery<Down>, _: &mut Self::Context) {
    ///         println!("stop walking: {}", *down);
    ///     }
    /// }
    ///
    /// fn watch_the_knee(ctx: &mut AppContext<Gait>) -> Result<(), MonitorError> {
    ///     if let Some(knee) = ctx.resolve("knee.drive") {
    ///         ctx.monitor(knee)?;
    ///     }
    ///     Ok(())
    /// }
    /// ```
    pub fn monitor(&self, tid: Tid) -> Result<MonitorId, MonitorError> {
        self.sender.monitor(tid)
    }

    /// Ends a monitor; see [`Sender::demonitor`].
    pub fn demonitor(&self, monitor: MonitorId) -> bool {
        self.sender.demonitor(monitor)
    }

    /// Sends a value; see [`Sender::send`].
    ///
    /// # Errors
    /// Nobody took it.
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

    /// A value to be sent otherwise than as its type says, confirmed, or as a request: see [`MessageBuilder`].
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

    /// Answers a request.
    ///
    /// # Errors
    /// The sender of `request` waits for no reply, or nobody took the reply.
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

    /// Whether the sender of `request` still waits for a reply; see [`Sender::is_wanted`].
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

    /// Refuses the message in hand: its sender gets `Rejected(ByHandler)` instead of `Delivered`.
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

    /// Logs a payload that cannot be read, once a second at most: the mailbox counts them all.
    pub(super) fn warn_of_payload(&mut self, source: Tid, error: &dyn fmt::Display, now: Time) {
        if self.warned.is_some_and(|last| now.since(last) < Duration::from_secs(1)) {
            self.unlogged += 1;
            return;
        }
        self.warned = Some(now);
        let suppressed = Some(std::mem::take(&mut self.unlogged)).filter(|count| *count > 0);
        let vitals = Vitals::present();
        let application = vitals.as_ref().map(|vitals| vitals.name());
        crate::log::warn!(
            application, tid = %self.tid(), %source, suppressed,
            "a message was refused: {error}; build sender and receiver with the same type"
        );
    }

    /// Becomes a member of the group called `name`.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Drive;
    ///
    /// impl Actor for Drive {
    ///     type Context = AppContext<Self>;
    ///     fn started(&mut self, ctx: &mut Self::Context) {
    ///         ctx.join("drives"); // what is sent to Tid::group("drives") comes here, too
    ///     }
    /// }
    /// ```
    pub fn join(&self, name: &str) {
        self.sender.join(name);
    }

    /// Ends the membership in the group called `name`.
    pub fn leave(&self, name: &str) {
        self.sender.leave(name);
    }

    /// Calls `action` once a period, on a grid that begins one period from now. The first argument's
    /// [`Tick`] says how late it is and how many turns were missed; missed turns are not made up for.
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
        self.schedule.every(Time::now() + period, period, Action::Call(Box::new(action)))
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
        self.schedule.once(Time::now() + delay, Action::Call(Box::new(action)))
    }

    /// Ends a timer from outside its own action.
    pub fn cancel(&mut self, timer: TimerId) -> bool {
        self.schedule.cancel(timer)
    }

    /// Sets an input watchdog that judges by **arrival**: calls `action` when no `P` from `source` (from any sender, if `None`) was handled
    /// for `within`, counted from now. It is called once for each silence; the next `P` begins a new count.
    ///
    /// It finds a sender, a node or a network that is silent. It does not find one that is late: a value feeds it however old the value is,
    /// and of whatever age that is not known. Where a late value is a hazard take [`watch_input_age`](Self::watch_input_age), or both.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.setpoint", Stream => struct Setpoint { newton_metres: f32 });
    ///
    /// struct Drive { newton_metres: f32 }
    ///
    /// impl Actor for Drive {
    ///     type Context = AppContext<Self>;
    ///     fn started(&mut self, ctx: &mut Self::Context) {
    ///         ctx.watch_input::<Setpoint>(None, Duration::from_millis(15), |drive, timeout, _| {
    ///             drive.newton_metres = 0.0;
    ///             eprintln!("{timeout}");
    ///         });
    ///     }
    /// }
    /// ```
    pub fn watch_input<P: Payload>(
        &mut self,
        source: Option<Tid>,
        within: Duration,
        action: impl FnMut(&mut A, InputTimeout, &mut Self) + 'static,
    ) -> WatchId {
        self.set_watch((source, P::KIND), (InputCriterion::Arrival, within), Box::new(action))
    }

    /// Sets an input watchdog that judges by **age**: calls `action` when the youngest `P` from `source` (from any sender, if `None`) that was
    /// handled may be older than `limit`. A value feeds it from its handling until it is as old as the limit; the error of an age counts as
    /// age. A value that is older when it arrives does not feed it. **One of unknown age does not either**, as it may be old: so it is called,
    /// too, while the clock of the sender's host is not measured. It is called once, and again after a fresh value and a further timeout.
    /// Until the first value the limit counts from now.
    ///
    /// Take it for setpoints and measurements by which something moves. The limit is to be longer than the sender's period, the way and the
    /// error of the clocks together. [`watch_input`](Self::watch_input) judges by arrival: it needs no measured clock, and tells of a sender
    /// that is there at all. [`InputTimeout`] has what a watchdog judged by, the silence and the age.
    ///
    /// A late value still reaches its handler: [`Delivery::is_older_than`] refuses it there.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.setpoint", Stream => struct Setpoint { newton_metres: f32 });
    ///
    /// struct Drive {
    ///     newton_metres: f32,
    /// }
    ///
    /// impl Actor for Drive {
    ///     type Context = AppContext<Self>;
    ///
    ///     fn started(&mut self, context: &mut Self::Context) {
    ///         // Setpoints come each 5 ms: three periods without one that is fresh, and the torque is let go.
    ///         context.watch_input_age::<Setpoint>(None, Duration::from_millis(15), |drive, timeout, _| {
    ///             drive.newton_metres = 0.0;
    ///             eprintln!("{timeout}");
    ///         });
    ///     }
    /// }
    /// # impl Handler<Delivery<Setpoint>> for Drive {
    /// #     type Result = ();
    /// #     fn handle(&mut self, setpoint: Delivery<Setpoint>, _: &mut Self::Context) {
    /// #         self.newton_metres = setpoint.newton_metres;
    /// #     }
    /// # }
    /// ```
    pub fn watch_input_age<P: Payload>(
        &mut self,
        source: Option<Tid>,
        limit: Duration,
        action: impl FnMut(&mut A, InputTimeout, &mut Self) + 'static,
    ) -> WatchId {
        self.set_watch((source, P::KIND), (InputCriterion::Age, limit), Box::new(action))
    }

    fn set_watch(
        &mut self,
        (source, kind): (Option<Tid>, Kind),
        (criterion, limit): (InputCriterion, Duration),
        action: Alert<A>,
    ) -> WatchId {
        let (id, now) = (WatchId(self.watches.len()), Time::now());
        let input = InputWatch::new(source, kind, (criterion, limit), now);
        self.watches.push(Watch { input, action: Some(action) });
        self.schedule.once(now + limit, Action::CheckWatch(id));
        id
    }

    /// Has `output` moved by what `source` sends of type `P`, which is protected, and made safe by `safe` when that is not as it has
    /// to be; see [`Guard::new`]. From now on only messages that are good, and that come while the output is live, reach the handler
    /// of `P`; others are refused. The sender is sent an echo four times in the greatest age of a message.
    ///
    /// # Errors
    /// The thread that keeps the watchdogs cannot be started or is not more urgent than this one, or this is guarded already.
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
        self.guards.retain(|held| {
            let is_held = !held.guard.is_orphan();
            if !is_held {
                schedule.cancel(held.echoes);
            }
            is_held
        });
        if self.guard_of::<P>(source).is_some() {
            let words = format!(
                "what {source} sends of '{}' is guarded already: keep that guard, or clone it",
                P::NAME
            );
            return Err(io::Error::new(io::ErrorKind::AlreadyExists, words));
        }
        let guard = Guard::new::<P>(source, self.tid(), output, safe)?;
        let guarded = guard.guarded();
        let protection =
            P::PROTECTION.expect("a guard is for a protected type: that was asserted when this was compiled");
        let echoed = guarded.clone();
        let echo = move |context: &Self| {
            if !echoed.is_orphan() {
                // Whoever cannot be reached does not answer either: the watchdog knows.
                let echo = Echo {
                    others: context.last_echoes(source, P::KIND),
                    ..Echo::new(P::KIND, echoed.echo())
                };
                let _ = context.send(source, &echo);
            }
        };
        echo(self);
        let echoes = self.every(protection.echo_period(), move |_, _, context| echo(context));
        self.guards.push(HeldGuard { guard: guarded, kind: P::KIND, echoes });
        Ok(guard)
    }

    /// The guard of what `source` sends of type `P`.
    pub(super) fn guard_of<P: Payload>(&self, source: Tid) -> Option<&Arc<dyn Guarded>> {
        let data_id = DataId::of::<P>(source, self.tid());
        self.guards.iter().map(|held| &held.guard).find(|guard| guard.data_id() == data_id)
    }

    /// What was sent last to `source` for each type but `kind`. All echoes are one Stream, of which only the newest message may arrive.
    fn last_echoes(&self, source: Tid, kind: Kind) -> Vec<(Kind, u64)> {
        let others =
            self.guards.iter().filter(|held| held.kind != kind && held.guard.data_id().source == source);
        others.map(|held| (held.kind, held.guard.last_echo().as_nanos())).collect()
    }

    /// An unconfirmed message was refused.
    pub(super) fn refused(&self, header: &Header, why: Rejection) {
        self.sender.refused(header, why);
    }

    /// The sender's side hears an echo.
    pub(super) fn echoed(&self, from: Tid, echo: Echo) {
        self.sender.echoed(from, echo);
    }

    /// A pause from `since` until `now` is over: periods go on on their grid, and input watchdogs count as if it had not
    /// been.
    pub(super) fn resume(&mut self, since: Time, now: Time) {
        self.schedule.skip_to(now);
        for watch in &mut self.watches {
            watch.input.resume(now.since(since));
        }
    }

    /// Keeps this application from being ready until the gate that is returned is reached: for one that has to
    /// calibrate first. `None` if it is ready already; call it in `started`.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Imu { calibrated: bool }
    ///
    /// impl Actor for Imu {
    ///     type Context = AppContext<Self>;
    ///     fn started(&mut self, ctx: &mut Self::Context) {
    ///         let mut gate = ctx.hold_ready();
    ///         // Applications that require this one wait until the bias of the gyroscope is known.
    ///         ctx.after(Duration::from_secs(2), move |imu, _, _| {
    ///             imu.calibrated = true;
    ///             gate.take().into_iter().for_each(|gate| gate.reached());
    ///         });
    ///     }
    /// }
    /// ```
    pub fn hold_ready(&mut self) -> Option<ReadyGate> {
        self.ready.take()
    }

    /// Fails the start of this application, which cannot run now: a device is not plugged in, for example. Call it in `started`, or later
    /// as long as the application [holds its readiness](Self::hold_ready), and return.
    ///
    /// It is started again after a wait that grows ([`AppSpec::start_retry`](super::AppSpec::start_retry)), and is not ready until then:
    /// applications that require it wait, and messages wait in its mailbox. The reason is logged once for as long as it stays the same. Such a
    /// failure does not count towards restart intensity, as a panic does. Of an application that is ready already it is a failure that counts.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Imu;
    ///
    /// impl Actor for Imu {
    ///     type Context = AppContext<Self>;
    ///     fn started(&mut self, ctx: &mut Self::Context) {
    ///         if let Err(error) = std::fs::File::open("/dev/ttyUSB0") {
    ///             ctx.fail_start(format!("/dev/ttyUSB0: {error}; plug the sensor in"));
    ///         }
    ///     }
    /// }
    /// ```
    pub fn fail_start(&mut self, why: impl Into<String>) {
        // Not ready by the end of `started`.
        self.ready = None;
        *self.parting.borrow_mut() = Some(Reason::StartFailed(why.into()));
        self.stop();
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

fn note_stop() {
    if let Some(vitals) = Vitals::present() {
        vitals.stops();
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
