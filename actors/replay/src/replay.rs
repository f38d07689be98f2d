//! The declaration of a replay: the applications under test, names, and the end.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{
        Arc,
        atomic::AtomicU64,
        mpsc::{RecvTimeoutError, sync_channel},
    },
    thread,
    time::Duration,
};

use sinew_runtime::{
    app::{AppWiring, DynApp},
    clock::VirtualTime,
    mailbox::{Bounds, Mailbox},
    pending::{AppSink, Pending},
    router::{MessageSink, Router},
    sender::Sender,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::Kind,
};
use sinew_schema::Schema;

use crate::{
    CheckError, Checked, Comparison, Misfit, ReplayError, RunError, TimedMessage,
    directory::Names,
    misfit,
    run::{Prepared, Progress, Run},
    world::World,
};

/// The node of applications without an address of their own.
const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
/// The first address that such an application gets.
const FIRST: u32 = 0x1000;
/// The time of the start without inputs and without [`Replay::starts_at`].
const START: Time = Time::from_nanos(1_000_000_000);
/// Real time for one turn of an application, without [`Replay::turn_within`].
const TURN_WITHIN: Duration = Duration::from_secs(10);
/// The bounds of an application's mailbox, for each class.
const MAILBOX: Bounds = Bounds { messages: 1_024, bytes: 64 << 20 };
/// Maximum number of concurrent waits of an application.
const WAITS_MAX: usize = 1_024;
/// Maximum length of a payload.
const PAYLOAD_MAX: usize = 64 << 20;

/// Applications to run in virtual time.
///
/// # Examples
///
/// A closed loop without any input: each application is one of those under test.
///
/// ```
/// use sinew::{prelude::*, replay::Replay};
///
/// payload!("demo.tick" => struct Tock);
///
/// struct Clockwork;
/// impl Actor for Clockwork {
///     type Context = AppContext<Self>;
///     fn started(&mut self, ctx: &mut Self::Context) {
///         ctx.every(Duration::from_secs(1), |_, _, ctx| ctx.send("bell", &Tock).expect("the bell has a name"));
///     }
/// }
///
/// let hour = Time::ZERO + Duration::from_secs(3_600);
/// let bell: Tid = "10.0.0.9/1001".parse()?;
/// let clockwork = AppSpec::new("clockwork", || Clockwork);
/// let ticks = Replay::new().app(clockwork).name("bell", bell).starts_at(Time::ZERO).ends_at(hour).run([])?;
/// assert_eq!(ticks.len(), 3_600);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Replay {
    apps: Vec<DynApp>,
    names: BTreeMap<String, Tid>,
    starts_at: Option<Time>,
    ends_at: Option<Time>,
    latency: Duration,
    turn_within: Duration,
    first_wait: u64,
    turns: Option<Kind>,
    schemas: BTreeMap<Kind, Schema>,
}

impl std::fmt::Debug for Replay {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let apps: Vec<_> = self.apps.iter().map(DynApp::name).collect();
        f.debug_struct("Replay").field("apps", &apps).field("names", &self.names).finish_non_exhaustive()
    }
}

impl Default for Replay {
    fn default() -> Self {
        Self::new()
    }
}

impl Replay {
    /// Creates a replay without applications.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            apps: Vec::new(),
            names: BTreeMap::new(),
            starts_at: None,
            ends_at: None,
            latency: Duration::ZERO,
            turn_within: TURN_WITHIN,
            first_wait: 1,
            turns: None,
            schemas: BTreeMap::new(),
        }
    }

    /// Adds an application under test. Its address is that of its [name](Self::name), or else a free one.
    #[must_use]
    pub fn app(mut self, spec: impl Into<DynApp>) -> Self {
        self.apps.push(spec.into());
        self
    }

    /// Sets the address of a name: of an application under test, or of another one that these send to.
    #[must_use]
    pub fn name(mut self, name: impl Into<String>, tid: Tid) -> Self {
        self.names.insert(name.into(), tid);
        self
    }

    /// Sets the virtual time at which the applications start, instead of that of the first input. Without
    /// both it is 1 s.
    #[must_use]
    pub const fn starts_at(mut self, time: Time) -> Self {
        self.starts_at = Some(time);
        self
    }

    /// Sets the virtual time of the end, instead of that of the last input. Timers that are due at that time
    /// still fire.
    #[must_use]
    pub const fn ends_at(mut self, time: Time) -> Self {
        self.ends_at = Some(time);
        self
    }

    /// Sets the time that messages between applications under test take. Default: none.
    #[must_use]
    pub const fn latency(mut self, time: Duration) -> Self {
        self.latency = time;
        self
    }

    /// Sets the real time in which each turn of an application must end. Default 10 s. A turn that takes longer is
    /// reported after at most twice this time.
    #[must_use]
    pub const fn turn_within(mut self, time: Duration) -> Self {
        self.turn_within = time;
        self
    }

    /// Sets the number of the first request or confirmed message of each application, if the recording does
    /// not begin with it. Default 1. Recorded answers name their requests by these numbers.
    #[must_use]
    pub const fn first_wait(mut self, number: u64) -> Self {
        self.first_wait = number;
        self
    }

    /// Sets the type by which the applications record their turns: the time, and the inputs that were used. Each
    /// gets its recorded messages of this type back, at the times at which they were sent, and computes the turn
    /// again. [`check`](Self::check) compares only messages of this type.
    ///
    /// For programs with outputs that depend on how late a timer was on the wall clock. No replay has these times.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{prelude::*, replay::{Replay, TimedMessage}};
    ///
    /// payload!("demo.turn", Stream => #[derive(Clone)] struct Turn { t_ns: u64, degrees: f64, newton_metres: f64 });
    ///
    /// /// Computes each turn of the knee again. The knee itself has a timer.
    /// struct Again { gain: f64 }
    /// # impl Actor for Again { type Context = AppContext<Self>; }
    /// impl Handler<Delivery<Turn>> for Again {
    ///     type Result = ();
    ///     fn handle(&mut self, turn: Delivery<Turn>, ctx: &mut Self::Context) {
    ///         let newton_metres = self.gain * turn.degrees;
    ///         let _ = ctx.send(Tid::group("turns"), &Turn { newton_metres, ..turn.payload });
    ///     }
    /// }
    ///
    /// let knee: Tid = "10.0.0.2/1001".parse()?;
    /// let turn = Turn { t_ns: 1_000_083, degrees: 10.0, newton_metres: 5.0 };
    /// let recorded = vec![TimedMessage::of(Time::from_nanos(1_000_151), knee, Tid::group("turns"), &turn)];
    /// let check = |gain| {
    ///     let again = AppSpec::new("knee", move || Again { gain }).handles::<Turn>();
    ///     Replay::new().app(again).name("knee", knee).turns(Turn::KIND).check(recorded.clone())
    /// };
    /// check(0.5)?;
    /// let difference = check(0.25).expect_err("the gain differs").to_string();
    /// assert!(difference.contains("`newton_metres` was 5.0 and is 2.5"), "{difference}");
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[must_use]
    pub const fn turns(mut self, kind: Kind) -> Self {
        self.turns = Some(kind);
        self
    }

    /// Sets the structure that a type had when it was recorded. It explains messages that an application under test
    /// cannot decode: [`Misfit::differences`].
    #[must_use]
    pub fn recorded_type(mut self, kind: Kind, schema: Schema) -> Self {
        self.schemas.insert(kind, schema);
        self
    }

    /// Runs the applications on these inputs, which must be in the order of their times. Returns everything
    /// that the applications sent, in order.
    ///
    /// Inputs from an application under test are ignored, as it sends them itself, except records of its
    /// [turns](Self::turns). Inputs for others are ignored too.
    ///
    /// # Errors
    /// An application panicked, ended, blocked or never became idle; the inputs are not in order; or two
    /// applications have one address.
    ///
    /// # Panics
    /// The iterator of the inputs panicked.
    pub fn run<I>(&self, inputs: I) -> Result<Vec<TimedMessage>, ReplayError>
    where
        I: IntoIterator<Item = TimedMessage, IntoIter: Send + 'static>,
    {
        self.run_until(self.ends_at, BTreeMap::new(), inputs).map(|(outputs, _)| outputs)
    }

    fn run_until<I>(
        &self,
        ends_at: Option<Time>,
        expected: BTreeMap<Tid, usize>,
        inputs: I,
    ) -> Result<(Vec<TimedMessage>, Vec<Misfit>), ReplayError>
    where
        I: IntoIterator<Item = TimedMessage, IntoIter: Send + 'static>,
    {
        let mut inputs = inputs.into_iter().peekable();
        let start = self.starts_at.or_else(|| inputs.peek().map(|input| input.at)).unwrap_or(START);
        let time = VirtualTime::starting_at(start);
        let world = Arc::new(World::new(time.clock(), self.latency, self.turns));
        world.expect(expected);
        let progress = Arc::new(Progress::default());
        let fault = |fault| ReplayError { at: world.clock().now(), fault, outputs: world.take_outputs() };
        let prepared = self.prepare(&world).map_err(fault)?;
        let names: Vec<String> = prepared.iter().map(|app| app.name.clone()).collect();
        let run = Run { time, world: world.clone(), progress: progress.clone(), ends_at };
        let (finish, finished) = sync_channel(1);
        let replay = move || {
            let result = actix_rt::System::new().block_on(run.all(prepared, inputs));
            // The caller has given up if it does not wait any more.
            let _ = finish.send(result);
        };
        let thread = thread::Builder::new().name("replay".to_owned()).spawn(replay);
        let thread = thread.map_err(|error| fault(RunError::NoThread(error)))?;
        let mut seen = None;
        loop {
            match finished.recv_timeout(self.turn_within) {
                Ok(Ok(())) => return Ok((world.take_outputs(), world.misfits().take(&self.schemas))),
                Ok(Err(why)) => return Err(fault(why)),
                Err(RecvTimeoutError::Timeout) => {
                    let now = progress.read();
                    if let (true, Some(app)) = (seen == Some(now), now.1) {
                        let app = names.get(app).cloned().unwrap_or_default();
                        return Err(fault(RunError::Blocked { app, within: self.turn_within }));
                    }
                    seen = Some(now);
                }
                // Only the iterator of the inputs can panic there.
                Err(RecvTimeoutError::Disconnected) => match thread.join() {
                    Err(panic) => std::panic::resume_unwind(panic),
                    Ok(()) => unreachable!("the thread passes its result before it ends"),
                },
            }
        }
    }

    /// Runs the applications on a recording, and compares their messages with it: those from applications
    /// under test are expected, all others are inputs. Their times are not compared, see [`Comparison`].
    ///
    /// The end is the time of the last recorded message, without [`Replay::ends_at`]. While a source has sent fewer
    /// messages than recorded, the replay runs on, for at most 1 s of virtual time. Further messages after the end are
    /// not compared.
    ///
    /// # Errors
    /// The replay did not reach its end, or differs from the recording.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{prelude::*, replay::{CheckError, Replay, TimedMessage}};
    ///
    /// struct Hip;
    /// # impl Actor for Hip { type Context = AppContext<Self>; }
    ///
    /// fn still_the_same(recorded: Vec<TimedMessage>, hip: Tid) -> Result<(), CheckError> {
    ///     Replay::new().app(AppSpec::new("hip", || Hip)).name("hip", hip).check(recorded)
    /// }
    /// ```
    pub fn check(&self, recorded: Vec<TimedMessage>) -> Result<(), CheckError> {
        self.check_by(&Comparison::default(), recorded).map(drop)
    }

    /// Same as [`check`](Self::check), by these terms. Returns how much was compared.
    ///
    /// # Errors
    /// The replay did not reach its end, or differs from the recording. If it differs, and an application under test
    /// could not decode recorded messages, these are the error: [`CheckError::Misfit`].
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{prelude::*, replay::{CheckError, Comparison, Replay, TimedMessage}};
    ///
    /// struct Hip;
    /// # impl Actor for Hip { type Context = AppContext<Self>; }
    ///
    /// fn check(recorded: Vec<TimedMessage>, hip: Tid) -> Result<(), CheckError> {
    ///     let replay = Replay::new().app(AppSpec::new("hip", || Hip)).name("hip", hip);
    ///     let checked = replay.check_by(&Comparison::default().ignoring("t_ns"), recorded)?;
    ///     println!("identical: {} messages", checked.messages);
    ///     Ok(())
    /// }
    /// ```
    pub fn check_by(
        &self,
        comparison: &Comparison,
        recorded: Vec<TimedMessage>,
    ) -> Result<Checked, CheckError> {
        let tested = self.addresses();
        let is_compared = |message: &TimedMessage| self.turns.is_none_or(|kind| message.kind == kind);
        let (mut expected, mut inputs): (Vec<_>, Vec<_>) =
            recorded.into_iter().partition(|message| tested.contains(&message.source));
        expected.retain(is_compared);
        if self.turns.is_some() {
            inputs.extend(expected.iter().cloned());
            // Stable: at one time a turn comes after the inputs that it may have used.
            inputs.sort_by_key(|input| input.at);
        }
        // Timers between the last input and the last output still fire.
        let end = expected.iter().chain(&inputs).map(|message| message.at).max();
        let ends_at = self.ends_at.or(end);
        let mut counts: BTreeMap<Tid, usize> = BTreeMap::new();
        for message in &expected {
            *counts.entry(message.source).or_default() += 1;
        }
        // An end that the caller has set is exact.
        let missing = if self.ends_at.is_none() { counts.clone() } else { BTreeMap::new() };
        let (mut replayed, misfits) = self.run_until(ends_at, missing, inputs)?;
        // While one source has too few messages, the others send more than the recording has.
        replayed.retain(|message| {
            if !is_compared(message) {
                return false;
            }
            let rest = counts.entry(message.source).or_default();
            let is_expected = *rest > 0;
            *rest = rest.saturating_sub(1);
            is_expected || ends_at.is_none_or(|end| message.at <= end)
        });
        if let Err(difference) = comparison.compare(&expected, &replayed) {
            return Err(match misfits.into_iter().next() {
                Some(misfit) => CheckError::Misfit(Box::new(misfit), Box::new(difference)),
                None => CheckError::Differs(difference),
            });
        }
        let sources: BTreeSet<_> = expected.iter().map(|message| message.source).collect();
        Ok(Checked { messages: expected.len(), sources: sources.len(), misfits })
    }

    /// Returns the address of each application under test.
    fn addresses(&self) -> Vec<Tid> {
        let own = |(index, app): (usize, &DynApp)| {
            let free = || AppAddress::new(FIRST + u32::try_from(index).unwrap_or_default());
            let named = self.names.get(app.name()).copied();
            named.unwrap_or_else(|| Tid::new(NODE, app.address().unwrap_or_else(free)))
        };
        self.apps.iter().enumerate().map(own).collect()
    }

    /// Connects the applications with the world, ready to be started.
    fn prepare(&self, world: &Arc<World>) -> Result<Vec<Prepared>, RunError> {
        let tids = self.addresses();
        let mut names = self.names.clone();
        for (app, tid) in self.apps.iter().zip(&tids) {
            names.insert(app.name().to_owned(), *tid);
        }
        let names = Arc::new(names);
        let mut prepared: Vec<Prepared> = Vec::with_capacity(tids.len());
        for (app, tid) in self.apps.iter().zip(tids) {
            let name = app.name().to_owned();
            if let Some(why) = app.fault() {
                return Err(RunError::Ended { app: name, why });
            }
            let clock = world.clock();
            let mailbox = Mailbox::on_clock(clock.clone(), MAILBOX);
            let pending = Pending::on_clock(clock.clone(), self.first_wait, WAITS_MAX);
            let sink = Arc::new(AppSink { pending: pending.clone(), inbox: mailbox.clone() });
            if !world.add(tid, sink) || prepared.iter().any(|other| other.name == name) {
                return Err(RunError::Twice(name));
            }
            let uplink: Arc<dyn MessageSink> = world.clone();
            let router = Arc::new(Router::through(tid.node, uplink).on_clock(clock.clone()));
            router.set_refusal_sink(misfit::sink(world.misfits()));
            let directory = Arc::new(Names {
                node: tid.node,
                names: names.clone(),
                world: world.clone(),
                monitors: AtomicU64::new(0),
            });
            let sender = Sender::new(tid, router, directory, pending, PAYLOAD_MAX);
            prepared.push(Prepared { name, tid, launch: app.launch(AppWiring { sender, mailbox }) });
        }
        Ok(prepared)
    }
}
