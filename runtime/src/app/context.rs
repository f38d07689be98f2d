//! The context of an application: the operations available to its handlers.

mod actor;
mod guards;
mod messages;
mod parameters;
mod recording;
mod refusals;
mod stop;
mod timers;
mod watches;

use actix::{
    Actor, ActorContext,
    dev::{ContextFut, ContextParts},
};

pub use self::watches::WatchId;
use self::{guards::GuardEntry, parameters::Tuning, watches::Watch};
pub(super) use self::{parameters::KeptHook, timers::Action};
use crate::{
    app::requirement::EndReason,
    clock::Clock,
    monitor::{MonitorError, MonitorId},
    outcome::{Outcome, Rejection},
    protection::Echo,
    schedule::Schedule,
    sender::{SendError, Sender},
    supervision::{ReadyGate, Reason},
    tid::Tid,
    time::Time,
    wire::{Header, Payload},
};

/// The context of an application's actor: the actix context plus the operations of Sinew.
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
    /// The clock of the sender, one step nearer.
    pub(super) clock: Clock,
    pub(super) schedule: Schedule<Action<A>>,
    pub(super) watches: Vec<Watch<A>>,
    pub(super) ready: Option<ReadyGate>,
    /// The end reason, if the application sets it itself.
    end_reason: EndReason,
    /// When a payload that could not be decoded was last logged.
    warned: Option<Time>,
    /// Number of such payloads since then.
    unlogged: u64,
    /// Start and end of the current run of protected messages that were too old.
    old: Option<(Time, Time)>,
    /// The outcome that the handler sets for the current message if it rejects it.
    pub(super) verdict: Option<Outcome>,
    /// The guards of outputs that protected messages control.
    guards: Vec<GuardEntry>,
    /// The parameters, and the timers of the ticks at which they change.
    tuning: Tuning,
}

impl<A: Actor<Context = Self>> AppContext<A> {
    pub(super) fn into_running(
        sender: Sender,
        ready: ReadyGate,
        actor: A,
        end_reason: EndReason,
    ) -> ContextFut<A, Self> {
        let mailbox = actix::dev::Mailbox::default();
        let mut context = Self {
            parts: ContextParts::new(mailbox.sender_producer()),
            mailbox: Some(mailbox),
            clock: sender.clock().clone(),
            sender,
            schedule: Schedule::default(),
            watches: Vec::new(),
            ready: Some(ready),
            end_reason,
            warned: None,
            unlogged: 0,
            old: None,
            verdict: None,
            guards: Vec::new(),
            tuning: Tuning::default(),
        };
        let mailbox = context.mailbox.take().expect("it was put there three lines above");
        ContextFut::new(context, actor, mailbox)
    }

    /// Returns the current time of the application's clock. Use it instead of [`Time::now`], so that the same
    /// actor runs on the wall clock and in virtual time.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Hip { began: Option<Time> }
    ///
    /// impl Actor for Hip {
    ///     type Context = AppContext<Self>;
    ///     fn started(&mut self, ctx: &mut Self::Context) {
    ///         self.began = Some(ctx.now());
    ///     }
    /// }
    /// ```
    #[must_use]
    #[inline]
    pub fn now(&self) -> Time {
        self.clock.now()
    }

    /// Returns the application's clock, for a wait in a future: [`Clock::sleep`].
    #[must_use]
    pub const fn clock(&self) -> &Clock {
        &self.clock
    }

    /// Returns the TID of this application.
    #[must_use]
    pub fn tid(&self) -> Tid {
        self.sender.tid()
    }

    /// Returns the sender of this application, for use in futures and other threads.
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

    /// Returns the TID that is registered for `name` now, on any node.
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

    /// Monitors the current incarnation of the application at `tid`; see [`Sender::monitor`].
    ///
    /// # Errors
    /// The TID is not that of an application, or the maximum number of monitors is reached.
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

    /// Removes a monitor; see [`Sender::demonitor`].
    pub fn demonitor(&self, monitor: MonitorId) -> bool {
        self.sender.demonitor(monitor)
    }

    /// Joins the group called `name`.
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

    /// Leaves the group called `name`.
    pub fn leave(&self, name: &str) {
        self.sender.leave(name);
    }

    /// Removes the value of type `P` that is retained for later members of the group called `name`; see
    /// [`Sender::clear_retained`].
    ///
    /// # Errors
    /// No queue and no socket accepted the message.
    pub fn clear_retained<P: Payload>(&self, name: &str) -> Result<(), SendError> {
        self.sender.clear_retained::<P>(name)
    }

    /// Reports an unconfirmed message that was rejected.
    pub(super) fn refused(&self, header: &Header, why: Rejection) {
        self.sender.refused(header, why);
    }

    /// Records an echo at the sending end.
    pub(super) fn echoed(&self, from: Tid, echo: Echo) {
        self.sender.echoed(from, echo);
    }

    /// Resumes after a pause from `since` until `now`: periodic timers keep their grid, and input watchdogs
    /// and slopes of parameters do not count the pause.
    pub(super) fn resume(&mut self, since: Time, now: Time) {
        self.schedule.skip_to(now);
        self.tuning.resume(now);
        for watch in &mut self.watches {
            watch.input.resume(now.since(since));
        }
    }

    /// Delays the readiness of this application until the returned gate is reached, for example for a
    /// calibration. Returns `None` if the application is ready already; call it in `started`.
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

    /// Fails the start of this application, if it cannot run now, for example because a device is not plugged
    /// in. Call it in `started`, or later while the application [holds its readiness](Self::hold_ready), and
    /// return.
    ///
    /// The application is started again after a wait that grows
    /// ([`AppSpec::start_retry`](super::AppSpec::start_retry)), and is not ready until then. Applications
    /// that require it wait, and messages for it wait in its mailbox. The reason is logged once while it
    /// stays the same. Unlike a panic, such a failure does not count towards restart intensity. If the
    /// application is ready already, the call is a failure that counts.
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
        // Prevents readiness at the end of `started`.
        self.ready = None;
        *self.end_reason.borrow_mut() = Some(Reason::StartFailed(why.into()));
        self.stop();
    }
}
