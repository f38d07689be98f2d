//! What a node must know of an application before it can start it.

use std::{sync::Arc, time::Duration};

use actix::{Actor, AsyncContext, Handler};

use crate::{
    app::{
        Absence, AppContext, Delivery, DownPolicy, Raw, RequirementEvent, RequirementPolicy, WILLS_MAX, Will,
        drive::{Dispatch, Drive, dispatch_raw, dispatch_typed},
        requirement::{Parting, PartingLife, Requirements, SafeState, Unmade},
    },
    mailbox::Mailbox,
    sender::Sender,
    supervision::{Launch, Life, Place, Policy, Restart, StartRetry, life, vitals::Vitals},
    tid::AppAddress,
    wire::{Kind, Payload, remember},
};

/// Declares an application: how to make its actor, its name, what it handles, what it requires, where it runs.
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
    policy: Policy,
    place: Place,
    pub(super) away: DownPolicy,
    pub(super) wills: Vec<Will>,
    pub(super) on_lost: RequirementPolicy,
    has_safe_state: bool,
    #[cfg(feature = "fault-points")]
    faults: Vec<crate::supervision::fault::Fault>,
}

impl<A: Actor<Context = AppContext<A>>> AppSpec<A> {
    /// An application called `name` (1 to 63 bytes, unique on its node). `factory` makes a new actor for its start and
    /// for each restart. It runs on the thread that the node's applications share, until a place is set.
    pub fn new(name: impl Into<String>, factory: impl Fn() -> A + Send + Sync + 'static) -> Self {
        Self::made_by(name.into(), Arc::new(move || Ok(factory())))
    }

    /// The same with a factory that may fail, as it opens a device for example. Its error fails the start, as
    /// [`AppContext::fail_start`] does.
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
            policy: Policy { held: true, ..Policy::default() },
            place: Place::thread("apps"),
            away: DownPolicy::default(),
            wills: Vec::new(),
            on_lost: RequirementPolicy::default(),
            has_safe_state: false,
            #[cfg(feature = "fault-points")]
            faults: Vec::new(),
        };
        Self { factory, handlers: Vec::new(), common, safe_state: None }
    }

    /// It handles payloads of type `P`. Layers' events are payloads too: to handle `NodeEvent` is to subscribe to it.
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
        remember::<P>();
        self.handlers.push((P::KIND, dispatch_typed::<A, P>));
        self.common.kinds.push((P::KIND, P::NAME));
        self
    }

    /// It handles the raw bytes of `kind`.
    #[must_use]
    pub fn handles_raw(mut self, kind: Kind) -> Self
    where
        A: Handler<Delivery<Raw>, Result = ()>,
    {
        self.handlers.push((kind, dispatch_raw::<A>));
        self.common.kinds.push((kind, "raw"));
        self
    }

    /// It starts when all of these are met, on this node or on any other: names (`knee.drive`), patterns (`*.drive`), any of
    /// several (`hip.imu | knee.imu`), so many of them (`2 of *.drive`), or what it waits for no longer than a time
    /// (`camera ?2s`). See [`Requirement`](crate::app::Requirement), which can be given instead of its text.
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

    /// It has this address instead of one that LNCL chooses; see [`AppAddress::fixed`].
    #[must_use]
    pub fn address(mut self, address: AppAddress) -> Self {
        self.common.address = Some(address);
        self
    }

    /// It has a thread of its own: isolation, for one more thread wake each way.
    #[must_use]
    pub fn own_thread(self) -> Self {
        self.place(Place::own_thread())
    }

    /// It has a process of its own, a child of the node's: nothing that it does harms the node, and it can be killed. See
    /// [`Place::process`].
    ///
    /// That process is this program, started again with the same arguments for each life of the application: its `main` runs again,
    /// up to the line that starts the node, which does not return there. Whatever comes before that line happens in each such
    /// process as well, so keep it short, and leave to the application itself what only one process can have (a port, a
    /// device, a file that is written). It can do all that it can in a thread, but `monitor` others.
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

    /// It shares the thread that reads the node's sockets: the lowest latency; its handlers must be short.
    #[must_use]
    pub fn on_io_thread(self) -> Self {
        self.place(Place::io())
    }

    /// It runs in this place: a thread with a name, and perhaps a real-time priority and a CPU. A node in which two ask
    /// for different priorities or CPUs of one thread does not start.
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

    /// A fault strikes it, in all its lives together. Only with the feature `fault-points`.
    #[cfg(feature = "fault-points")]
    #[must_use]
    pub fn fault(mut self, fault: crate::supervision::fault::Fault) -> Self {
        self.common.faults.push(fault);
        self
    }

    /// When it is started again after it ended. Default: always. A node cannot tell a fault that will pass from one that will not
    /// (a device that is not there, a configuration that is wrong): a start that fails is tried again, too, until its supervisor
    /// has had its fill of restarts; by default that is the sixth failure within ten seconds.
    #[must_use]
    pub const fn restart(mut self, restart: Restart) -> Self {
        self.common.policy.restart = restart;
        self
    }

    /// Its end may be the end of its supervisor; see [`AutoShutdown`](crate::supervision::AutoShutdown). For one that is
    /// transient or temporary.
    #[must_use]
    pub const fn significant(mut self) -> Self {
        self.common.policy.significant = true;
        self
    }

    /// The wait before it is started again: `min` at first, doubled by each failure in a row up to `max`, then shortened by
    /// chance by up to a quarter. Default 1 ms to 2 s.
    #[must_use]
    pub const fn backoff(mut self, min: Duration, max: Duration) -> Self {
        self.common.policy.backoff_min = min;
        self.common.policy.backoff_max = max;
        self
    }

    /// How a start is tried again that failed by [`AppContext::fail_start`] or by the error of [`try_new`](Self::try_new). Default: after 100 ms
    /// at first, doubled each time up to 5 s, without an end.
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

    /// Time that it has to become ready once it is started. Default 10 s; after it the start has failed and is tried again.
    /// One that holds its readiness (`hold_ready`) for a device that may be off sets what it is willing to wait.
    #[must_use]
    pub const fn start_within(mut self, time: Duration) -> Self {
        self.common.policy.start_within = time;
        self
    }

    /// Longest time that one turn (a handler, a timer, `started`) may take, and that it may leave its messages waiting while
    /// it waits for something else. After it the application counts as hung and is replaced. Default 1 s.
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

    /// Time that it has for its orderly stop. Default 500 ms.
    #[must_use]
    pub const fn stop_within(mut self, time: Duration) -> Self {
        self.common.policy.stop_within = time;
        self
    }
}

impl Common {
    /// Subscribes it to what its policy needs to know.
    fn hear_of_requirements(&mut self) {
        let told = (RequirementEvent::KIND, RequirementEvent::NAME);
        if self.on_lost != RequirementPolicy::CarryOn && !self.kinds.contains(&told) {
            self.kinds.push(told);
        }
    }
}

/// An [`AppSpec`] whose actor type is no longer named: what a node keeps.
pub struct DynApp {
    common: Common,
    wire: Box<dyn Fn(AppWiring) -> Launch + Send>,
}

/// What a node gives to an application.
#[derive(Clone)]
pub struct AppWiring {
    /// How it sends.
    pub sender: Sender,
    /// What it receives.
    pub mailbox: Arc<Mailbox>,
}

impl<A: Actor<Context = AppContext<A>>> From<AppSpec<A>> for DynApp {
    fn from(spec: AppSpec<A>) -> Self {
        let AppSpec { factory, handlers, mut common, safe_state } = spec;
        let on_lost = common.on_lost;
        common.hear_of_requirements();
        common.has_safe_state = safe_state.is_some();
        let kinds: Arc<[_]> = common.kinds.clone().into();
        let wire = move |wiring: AppWiring| {
            let (factory, handlers, safe_state) = (factory.clone(), handlers.clone(), safe_state.clone());
            let kinds = kinds.clone();
            let launch: Launch = Arc::new(move |ready| {
                // A launch outside of a guard has nobody who would take its life.
                let vitals = Vitals::present().unwrap_or_else(|| Vitals::new("unguarded"));
                // Before the factory: if that comes back after another life has taken this one's place, the reader is the
                // other's, and stays so.
                let reader = wiring.mailbox.attach();
                let made = factory();
                if vitals.is_over() {
                    vitals.leave();
                }
                let actor = match made {
                    Ok(actor) => actor,
                    Err(why) => return Box::new(Unmade(why)) as Box<dyn Life>,
                };
                vitals.reads(wiring.mailbox.clone(), reader.epoch(), kinds.clone());
                let sender = wiring.sender.in_life(vitals.clone());
                let parting = Parting::default();
                let requirements = Requirements::new(on_lost, safe_state.clone(), parting.clone());
                let drive = Drive::new(reader, handlers.clone(), requirements, vitals);
                let mut running = AppContext::into_life(sender, ready, actor, parting.clone());
                running.ctx().spawn(drive);
                Box::new(PartingLife { life: life(running), parting })
            });
            launch
        };
        Self { common, wire: Box::new(wire) }
    }
}

impl DynApp {
    /// Its name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.common.name
    }

    /// The fixed address that it wants.
    #[must_use]
    pub const fn address(&self) -> Option<AppAddress> {
        self.common.address
    }

    /// What it requires.
    #[must_use]
    pub fn requires(&self) -> &[String] {
        &self.common.requires
    }

    /// What it handles: kinds, with the names of their types.
    #[must_use]
    pub fn kinds(&self) -> &[(Kind, &'static str)] {
        &self.common.kinds
    }

    /// What its supervisor may do with it.
    #[must_use]
    pub const fn policy(&self) -> &Policy {
        &self.common.policy
    }

    /// Where it runs.
    #[must_use]
    pub const fn place(&self) -> &Place {
        &self.common.place
    }

    /// One more fault strikes it.
    #[cfg(feature = "fault-points")]
    pub fn plan_fault(&mut self, fault: crate::supervision::fault::Fault) {
        self.common.faults.push(fault);
    }

    /// The faults that strike it.
    #[cfg(feature = "fault-points")]
    #[must_use]
    pub fn faults(&self) -> &[crate::supervision::fault::Fault] {
        &self.common.faults
    }

    /// What it does when it loses what it requires.
    #[must_use]
    pub const fn requirement_policy(&self) -> RequirementPolicy {
        self.common.on_lost
    }

    /// What is sent on its behalf when it has ended.
    #[must_use]
    pub fn wills(&self) -> &[Will] {
        &self.common.wills
    }

    /// What is wrong with its declaration, in words.
    #[must_use]
    pub fn fault(&self) -> Option<String> {
        let Common { wills, on_lost, has_safe_state, .. } = &self.common;
        if wills.len() > WILLS_MAX {
            let wills = wills.len();
            return Some(format!("{wills} last wills are more than the {WILLS_MAX} that it may have"));
        }
        match on_lost {
            RequirementPolicy::SafeState if !has_safe_state => {
                Some("it goes to its safe state and has none; declare it with `safe_state`".to_owned())
            }
            RequirementPolicy::CarryOn
            | RequirementPolicy::Pause
            | RequirementPolicy::SafeState
            | RequirementPolicy::Restart => None,
        }
    }

    /// What its node keeps for the time that it is away.
    #[must_use]
    pub fn absence(&self, wiring: AppWiring) -> Absence {
        Absence::new(wiring, self.common.away, self.common.wills.clone())
    }

    /// How it is started, on the thread of its place, with what its node gives it.
    #[must_use]
    pub fn launch(&self, wiring: AppWiring) -> Launch {
        (self.wire)(wiring)
    }
}
