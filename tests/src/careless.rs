//! A commander, and drives that arm their guarded outputs whenever that is possible: careless applications, for the
//! scenarios of the stop and of contracts.

use std::sync::{
    Arc, Mutex, PoisonError,
    atomic::{AtomicBool, AtomicU64, Ordering},
};

use sinew::{
    prelude::*,
    protection::{Guard, Protection, State},
};

/// The address of the commander.
const COMMANDER: AppAddress = AppAddress::new(0x1001);

/// A protected command, with the limits of a period of so many milliseconds.
#[derive(serde::Serialize, serde::Deserialize)]
struct Torque<const PERIOD_MS: u64> {
    newton_metres: f32,
}

impl<const PERIOD_MS: u64> Payload for Torque<PERIOD_MS> {
    const NAME: &'static str = "careless.torque";
    const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(PERIOD_MS)));
}

/// Commands the outputs of drives, all the time.
#[derive(Debug)]
pub struct Commander<const PERIOD_MS: u64> {
    every: Duration,
    drives: Vec<String>,
}

/// Returns the application `control`, which sends a command to each of these drives in this period.
#[must_use]
pub fn commander<const PERIOD_MS: u64>(
    every: Duration,
    drives: impl IntoIterator<Item = String>,
) -> AppSpec<Commander<PERIOD_MS>> {
    let drives: Vec<_> = drives.into_iter().collect();
    AppSpec::new("control", move || Commander { every, drives: drives.clone() }).address(COMMANDER)
}

impl<const PERIOD_MS: u64> Actor for Commander<PERIOD_MS> {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(self.every, |commander, _, context| {
            for drive in &commander.drives {
                // A drive that is not there gets none.
                let _ = context.send(drive.as_str(), &Torque::<PERIOD_MS> { newton_metres: 1.0 });
            }
        });
    }
}

/// The output of a drive, as a scenario sees it.
#[derive(Debug, Default)]
pub struct Output {
    guard: Mutex<Option<Guard<()>>>,
    safe_ns: AtomicU64,
    moved: AtomicU64,
    acknowledges: AtomicBool,
}

impl Output {
    /// Returns its guard, as soon as the drive has started.
    #[must_use]
    pub fn guard(&self) -> Option<Guard<()>> {
        self.guard.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Returns whether commands reach it.
    #[must_use]
    pub fn is_live(&self) -> bool {
        self.guard().is_some_and(|guard| guard.state() == State::Live)
    }

    /// Returns when it was made safe last, on the clock of the machine; 0: never.
    #[must_use]
    pub fn safe_ns(&self) -> u64 {
        self.safe_ns.load(Ordering::SeqCst)
    }

    /// Returns the number of commands that reached it.
    #[must_use]
    pub fn moved(&self) -> u64 {
        self.moved.load(Ordering::SeqCst)
    }

    /// Sets whether the drive acknowledges a released stop, as on the order of a person.
    pub fn set_acknowledges(&self, acknowledges: bool) {
        self.acknowledges.store(acknowledges, Ordering::SeqCst);
    }
}

/// Arms its output whenever that is possible.
#[derive(Debug)]
pub struct Drive<const PERIOD_MS: u64> {
    control: Tid,
    every: Duration,
    output: Arc<Output>,
}

/// Returns a drive that obeys the commander of this node, and looks at its output in this period.
#[must_use]
pub fn drive<const PERIOD_MS: u64>(
    name: String,
    (node, every): (NodeAddress, Duration),
    output: &Arc<Output>,
) -> AppSpec<Drive<PERIOD_MS>> {
    let (control, output) = (Tid::new(node, COMMANDER), output.clone());
    let drive = AppSpec::new(name, move || Drive { control, every, output: output.clone() });
    drive.handles::<Torque<PERIOD_MS>>()
}

impl<const PERIOD_MS: u64> Actor for Drive<PERIOD_MS> {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let output = self.output.clone();
        let make_safe = move |(): &mut (), _| output.safe_ns.store(Time::now().as_nanos(), Ordering::SeqCst);
        let guard = context
            .guard::<Torque<PERIOD_MS>, _>(self.control, (), make_safe)
            .expect("the host has room for the thread that makes outputs safe");
        *self.output.guard.lock().unwrap_or_else(PoisonError::into_inner) = Some(guard.clone());
        context.every(self.every, move |drive, _, _| {
            if drive.output.acknowledges.load(Ordering::SeqCst) {
                // It is refused while a stop is in force.
                let _ = guard.acknowledge_stop();
            }
            // It is refused until enough good commands have come.
            let _ = guard.arm();
        });
    }
}

impl<const PERIOD_MS: u64> Handler<Delivery<Torque<PERIOD_MS>>> for Drive<PERIOD_MS> {
    type Result = ();

    fn handle(&mut self, _: Delivery<Torque<PERIOD_MS>>, _: &mut Self::Context) {
        if let Some(guard) = self.output.guard() {
            // A safe output does not move.
            let _ = guard.apply(|()| self.output.moved.fetch_add(1, Ordering::SeqCst));
        }
    }
}
