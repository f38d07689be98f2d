//! The declaration of an application, which a node needs to start it.

mod command;
mod contracts;
mod dyn_app;
mod parameters;

pub use self::command::{COMMAND_WORDS_MAX, CommandLine, CommandReadiness, Program};

use std::{sync::Arc, time::Duration};

use actix::{Actor, AsyncContext, Handler};
use sinew_params::Parameters;

use crate::{
    app::{
        AppContext, Contract, Delivery, DownPolicy, Raw, RequirementEvent, RequirementPolicy, Will,
        context::KeptHook,
        drive::{Dispatch, Drive, dispatch_raw, dispatch_typed},
        requirement::{EndReason, FailedStart, Requirements, SafeState, WithEndReason},
    },
    mailbox::Mailbox,
    sender::Sender,
    supervision::{
        Launch, Place, Policy, Restart, RunningActor, StartRetry, liveness::Liveness, running_actor,
    },
    tid::AppAddress,
    wire::{Kind, Payload, PayloadType, remember},
};

/// Declares an application: its factory, its name, the payloads that it handles, its requirements and its place.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// payload!("demo.angle", Stream => struct Angle { degrees: f32 });
///
/// struct Knee;
/// impl Actor for Knee { type Context = AppContext<Self>; }
/// impl Handler<Delivery<Angle>> for Knee {
///     type Result = ();
///     fn handle(&mut self, angle: Delivery<Angle>, _: &mut Self::Context) {
///         println!("{} degrees, {:?} old", angle.degrees, angle.age); // `None`: not known
///     }
/// }
///
/// let spec = AppSpec::new("knee", || Knee).handles::<Angle>().requires(["hip"]).own_thread();
///
/// // A setpoint that waits for a restart is stale. Where this application dies, its followers get its last will.
/// let spec = spec.while_down(DownPolicy::Drop).last_will(Tid::group("followers"), &Angle { degrees: 0.0 });
/// ```
pub struct AppSpec<A: Actor<Context = AppContext<A>>> {
    factory: Arc<dyn Fn() -> Result<A, String> + Send + Sync>,
    handlers: Vec<(Kind, Dispatch<A>)>,
    pub(super) common: Common,
    pub(super) safe_state: Option<SafeState<A>>,
}

#[derive(Clone)]
pub(super) struct Common {
    name: String,
    address: Option<AppAddress>,
    requires: Vec<String>,
    kinds: Vec<(Kind, &'static str)>,
    /// The types of `kinds`, as far as they are not raw.
    types: Vec<PayloadType>,
    /// The types that it declared to send.
    sends: Vec<PayloadType>,
    policy: Policy,
    place: Place,
    /// The program, if the application is a command.
    command: Option<CommandLine>,
    pub(super) down_policy: DownPolicy,
    pub(super) wills: Vec<Will>,
    pub(super) on_lost: RequirementPolicy,
    has_safe_state: bool,
    /// Number of sets of parameters; an application has at most one.
    parameter_sets: usize,
    /// The parameters; `None`: it has none.
    parameters: Option<Arc<dyn Parameters>>,
    on_kept: KeptHook,
    contracts: Vec<Contract>,
    #[cfg(feature = "fault-points")]
    faults: Vec<crate::supervision::fault::Fault>,
}

impl<A: Actor<Context = AppContext<A>>> AppSpec<A> {
    /// Declares an application called `name` (1 to 63 bytes, unique on its node). `factory` makes a new actor
    /// for the start and for each restart. The application runs on the thread that the node's applications
    /// share, unless a place is set.
    pub fn new(name: impl Into<String>, factory: impl Fn() -> A + Send + Sync + 'static) -> Self {
        Self::made_by(name.into(), Arc::new(move || Ok(factory())))
    }

    /// Same as [`new`](Self::new), with a factory that may fail, for example if it opens a device. Its error
    /// fails the start, as [`AppContext::fail_start`] does.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Imu(std::fs::File);
    /// # impl Actor for Imu { type Context = AppContext<Self>; }
    /// let open = || std::fs::File::open("/dev/ttyUSB0").map(Imu);
    /// let imu = AppSpec::try_new("imu", move || open().map_err(|error| format!("/dev/ttyUSB0: {error}; plug it in")));
    /// ```
    pub fn try_new<E: std::fmt::Display>(
        name: impl Into<String>,
        factory: impl Fn() -> Result<A, E> + Send + Sync + 'static,
    ) -> Self {
        Self::made_by(name.into(), Arc::new(move || factory().map_err(|error| error.to_string())))
    }

    fn made_by(name: String, factory: Arc<dyn Fn() -> Result<A, String> + Send + Sync>) -> Self {
        let common = Common {
            name,
            address: None,
            requires: Vec::new(),
            kinds: Vec::new(),
            types: Vec::new(),
            sends: Vec::new(),
            policy: Policy { held: true, ..Policy::default() },
            place: Place::thread("apps"),
            command: None,
            down_policy: DownPolicy::default(),
            wills: Vec::new(),
            on_lost: RequirementPolicy::default(),
            has_safe_state: false,
            parameter_sets: 0,
            parameters: None,
            on_kept: KeptHook::default(),
            contracts: Vec::new(),
            #[cfg(feature = "fault-points")]
            faults: Vec::new(),
        };
        Self { factory, handlers: Vec::new(), common, safe_state: None }
    }

    /// Declares that the application handles payloads of type `P`. The events of layers are payloads too: an
    /// application that handles `NodeEvent` is subscribed to it.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.angle", Stream => struct Angle { degrees: f32 });
    ///
    /// struct Knee;
    /// # impl Actor for Knee { type Context = AppContext<Self>; }
    /// impl Handler<Delivery<Angle>> for Knee {
    ///     type Result = ();
    ///     fn handle(&mut self, angle: Delivery<Angle>, _: &mut Self::Context) {
    ///         println!("{} degrees", angle.degrees);
    ///     }
    /// }
    ///
    /// let knee = AppSpec::new("knee", || Knee).handles::<Angle>();
    /// ```
    #[must_use]
    pub fn handles<P: Payload>(mut self) -> Self
    where
        A: Handler<Delivery<P>, Result = ()>,
    {
        self.common.types.extend(remember::<P>());
        self.handlers.push((P::KIND, dispatch_typed::<A, P>));
        self.common.kinds.push((P::KIND, P::NAME));
        self
    }

    /// Declares that the application handles the raw bytes of `kind`.
    #[must_use]
    pub fn handles_raw(mut self, kind: Kind) -> Self
    where
        A: Handler<Delivery<Raw>, Result = ()>,
    {
        self.handlers.push((kind, dispatch_raw::<A>));
        self.common.kinds.push((kind, "raw"));
        self
    }

    /// Declares that the application sends payloads of type `P`. Then other nodes compare the type with that of their
    /// applications before its first message; without it they compare at the first one.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// payload!("demo.angle", Stream => struct Angle { degrees: f32 });
    ///
    /// struct Gait;
    /// # impl Actor for Gait { type Context = AppContext<Self>; }
    ///
    /// let gait = AppSpec::new("gait", || Gait).sends::<Angle>();
    /// ```
    #[must_use]
    pub fn sends<P: Payload>(mut self) -> Self {
        self.common.sends.extend(remember::<P>());
        self
    }

    /// Declares requirements. The application starts when all of them are met, on this node or on any other.
    /// A requirement is a name (`knee.drive`), a pattern (`*.drive`), alternatives (`hip.imu | knee.imu`), a
    /// minimum count (`2 of *.drive`), or optional after a time (`camera ?2s`). See
    /// [`Requirement`](crate::app::Requirement), which can be given instead of its text.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Gait;
    /// # impl Actor for Gait { type Context = AppContext<Self>; }
    ///
    /// let gait = AppSpec::new("gait", || Gait).requires(["knee.drive", "hip.imu | knee.imu", "camera ?2s"]);
    /// ```
    #[must_use]
    pub fn requires<N: Into<String>>(mut self, names: impl IntoIterator<Item = N>) -> Self {
        self.common.requires.extend(names.into_iter().map(Into::into));
        self
    }

    /// Sets a fixed address, instead of one that LNCL assigns; see [`AppAddress::fixed`].
    #[must_use]
    pub fn address(mut self, address: AppAddress) -> Self {
        self.common.address = Some(address);
        self
    }

    /// Runs the application on a thread of its own: it is isolated, at the cost of one more thread wake in
    /// each direction.
    #[must_use]
    pub fn own_thread(self) -> Self {
        self.place(Place::own_thread())
    }

    /// Runs the application in a process of its own, a child of the node's process. A crash does not harm the
    /// node, and the process can be killed. See [`Place::process`].
    ///
    /// The process is this program, started again with the same arguments for each incarnation of the
    /// application. Its `main` runs again, up to the line that starts the node, which does not return there.
    /// The code before that line runs in each such process as well, so keep it short. Let the application
    /// itself open resources that only one process can have (a port, a device, a file that is written). The
    /// application has all the features that it has in a thread, except `monitor`.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Camera;
    /// # impl Actor for Camera { type Context = AppContext<Self>; }
    ///
    /// // A driver that may crash takes nothing else with it.
    /// let camera = AppSpec::new("camera", || Camera).own_process();
    /// ```
    #[must_use]
    pub fn own_process(self) -> Self {
        self.place(Place::process())
    }

    /// Runs the application on the thread that reads the node's sockets. This has the lowest latency; its
    /// handlers must be short.
    #[must_use]
    pub fn on_io_thread(self) -> Self {
        self.place(Place::io())
    }

    /// Sets the place in which the application runs: a named thread, and optionally a real-time priority and
    /// a CPU. A node does not start if two applications request different priorities or CPUs for one thread.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Gait;
    /// # impl Actor for Gait { type Context = AppContext<Self>; }
    ///
    /// // A real-time thread on a CPU that the kernel keeps free (`isolcpus=3`).
    /// let gait = AppSpec::new("gait", || Gait).place(Place::own_thread().realtime(60).on_cpu(3));
    /// ```
    #[must_use]
    pub fn place(mut self, place: Place) -> Self {
        self.common.place = place.of_application(&self.common.name);
        self
    }

    /// Injects a fault into the application, counted over all its incarnations. Only with the feature `fault-points`.
    #[cfg(feature = "fault-points")]
    #[must_use]
    pub fn fault(mut self, fault: crate::supervision::fault::Fault) -> Self {
        self.common.faults.push(fault);
        self
    }

    /// Sets when the application is restarted after it ended. Default: always. A node cannot distinguish a
    /// transient fault from a permanent one (a missing device, a wrong configuration), so a failed start is
    /// retried too. Retries end when the supervisor's restart intensity is exceeded: by default at the sixth
    /// failure within ten seconds. A start that fails by an explicit call (`fail_start`, an error of
    /// [`try_new`](Self::try_new)) does not count: see [`StartRetry`](crate::supervision::StartRetry).
    #[must_use]
    pub const fn restart(mut self, restart: Restart) -> Self {
        self.common.policy.restart = restart;
        self
    }

    /// Marks the application as significant: its end may end its supervisor; see
    /// [`AutoShutdown`](crate::supervision::AutoShutdown). For transient or temporary applications.
    #[must_use]
    pub const fn significant(mut self) -> Self {
        self.common.policy.significant = true;
        self
    }

    /// Sets the wait before a restart: `min` at first, doubled by each consecutive failure up to `max`, then
    /// shortened by a random part of up to a quarter. Default 1 ms to 2 s.
    #[must_use]
    pub const fn backoff(mut self, min: Duration, max: Duration) -> Self {
        self.common.policy.backoff_min = min;
        self.common.policy.backoff_max = max;
        self
    }

    /// Sets the retry policy for a start that failed by [`AppContext::fail_start`] or by an error of
    /// [`try_new`](Self::try_new)'s factory. Default: after 100 ms at first, doubled each time up to 5 s,
    /// without a limit on retries.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{prelude::*, supervision::StartRetry};
    ///
    /// struct Imu;
    /// # impl Actor for Imu { type Context = AppContext<Self>; }
    ///
    /// let retry = StartRetry { wait_max: Duration::from_secs(1), ..StartRetry::default() };
    /// let imu = AppSpec::new("imu", || Imu).start_retry(retry);
    /// ```
    #[must_use]
    pub const fn start_retry(mut self, retry: StartRetry) -> Self {
        self.common.policy.start_retry = retry;
        self
    }

    /// Sets the time in which the application must become ready after its start. Default 10 s; after that the
    /// start has failed and is retried. An application that holds its readiness (`hold_ready`) for a device
    /// that may be off sets the time that it can wait.
    #[must_use]
    pub const fn start_within(mut self, time: Duration) -> Self {
        self.common.policy.start_within = time;
        self
    }

    /// Sets the maximum duration of one turn (a handler, a timer, `started`). It is also the maximum time for
    /// which messages may wait while the application waits for something else. After that the application
    /// counts as hung and is replaced. Default 1 s.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// struct Drive;
    /// # impl Actor for Drive { type Context = AppContext<Self>; }
    ///
    /// // A turn takes 200 us. One that takes 20 ms hangs, and the drive is started again.
    /// let drive = AppSpec::new("knee.drive", || Drive).own_thread().progress_within(Duration::from_millis(20));
    /// ```
    #[must_use]
    pub const fn progress_within(mut self, time: Duration) -> Self {
        self.common.policy.progress_within = Some(time);
        self
    }

    /// Sets the time for an orderly stop. Default 500 ms.
    #[must_use]
    pub const fn stop_within(mut self, time: Duration) -> Self {
        self.common.policy.stop_within = time;
        self
    }
}

impl Common {
    /// Subscribes the application to the events that its requirement policy needs.
    fn subscribe_to_requirements(&mut self) {
        let kind = (RequirementEvent::KIND, RequirementEvent::NAME);
        if self.on_lost != RequirementPolicy::CarryOn && !self.kinds.contains(&kind) {
            self.kinds.push(kind);
        }
    }
}

/// An [`AppSpec`] without its actor type, as a node stores it.
pub struct DynApp {
    common: Common,
    wire: Box<dyn Fn(AppWiring) -> Launch + Send>,
}

/// The endpoints that a node gives to an application.
#[derive(Clone)]
pub struct AppWiring {
    /// The sender of the application.
    pub sender: Sender,
    /// The mailbox of the application.
    pub mailbox: Arc<Mailbox>,
}

impl<A: Actor<Context = AppContext<A>>> From<AppSpec<A>> for DynApp {
    fn from(spec: AppSpec<A>) -> Self {
        let AppSpec { factory, handlers, mut common, safe_state } = spec;
        let on_lost = common.on_lost;
        common.subscribe_to_requirements();
        common.has_safe_state = safe_state.is_some();
        let kinds: Arc<[_]> = common.kinds.clone().into();
        let (parameters, on_kept) = (common.parameters.clone(), common.on_kept.clone());
        let wire = move |wiring: AppWiring| {
            let (factory, handlers, safe_state) = (factory.clone(), handlers.clone(), safe_state.clone());
            let (kinds, parameters, on_kept) = (kinds.clone(), parameters.clone(), on_kept.clone());
            let launch: Launch = Arc::new(move |ready| {
                // A launch outside of a guard has no supervisor that could fence its incarnation.
                let liveness = Liveness::current().unwrap_or_else(|| Liveness::new("unguarded"));
                // The reader is attached before the factory runs. If the factory returns after another
                // incarnation has taken this one's place, the reader belongs to that incarnation, and remains
                // there.
                let reader = wiring.mailbox.attach();
                let made = factory();
                if liveness.is_fenced() {
                    liveness.unwind_turn();
                }
                let actor = match made {
                    Ok(actor) => actor,
                    Err(why) => return Box::new(FailedStart(why)) as Box<dyn RunningActor>,
                };
                liveness.attach_mailbox(wiring.mailbox.clone(), reader.epoch(), kinds.clone());
                let sender = wiring.sender.for_incarnation(liveness.clone());
                let end_reason = EndReason::default();
                let requirements = Requirements::new(on_lost, safe_state.clone(), end_reason.clone());
                let drive = Drive::new(reader, handlers.clone(), requirements, liveness);
                let mut running = AppContext::into_running(sender, ready, actor, end_reason.clone());
                if let Some(parameters) = &parameters {
                    running.ctx().tune(parameters.clone(), on_kept.clone());
                }
                running.ctx().spawn(drive);
                Box::new(WithEndReason { actor: running_actor(running), end_reason })
            });
            launch
        };
        Self { common, wire: Box::new(wire) }
    }
}
