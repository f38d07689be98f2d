//! Contracts of two whole nodes: they are reported with the output that they are about, and close or do not.

use std::sync::{
    Arc, Mutex, MutexGuard, PoisonError,
    atomic::{AtomicBool, Ordering},
};

use sinew::{
    contracts::{AskContracts, Closure, Contract, ContractsReport},
    message::Sender,
    prelude::*,
    protection::{Cause, Guard, Protection, State},
};
use sinew_testkit::{
    DEADLINE, Loopback, all_run,
    scripted::{SenderApp, sender_app, wait},
    until,
};

const CONTROL: AppAddress = AppAddress::new(0x1001);
const PERIOD: Duration = Duration::from_millis(20);
const PROTECTION: Protection = Protection::of_period(Duration::from_millis(100));

#[derive(serde::Serialize, serde::Deserialize)]
struct Torque {
    newton_metres: f32,
}

impl Payload for Torque {
    const NAME: &'static str = "test.contracts.torque";
    const PROTECTION: Option<Protection> = Some(PROTECTION);
}

/// Sends commands to the knee, all the time.
struct Control;

impl Actor for Control {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(PERIOD, |_, _, ctx| {
            // A knee that is not there gets none.
            let _ = ctx.send("knee", &Torque { newton_metres: 1.0 });
        });
    }
}

/// The view of a test on the output, and its order to arm it.
#[derive(Default)]
struct View {
    guard: Mutex<Option<Guard<()>>>,
    arms: AtomicBool,
}

impl View {
    fn wait_for(&self, wanted: State) {
        until("the output has the state", || {
            let state = self.guard.lock().expect("no test panics with it").as_ref().map(Guard::state);
            (state == Some(wanted)).then_some(())
        });
    }
}

struct Knee {
    control: Tid,
    view: Arc<View>,
}

impl Actor for Knee {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        let guard = ctx.guard::<Torque, _>(self.control, (), |(), _| {}).expect("there is the thread");
        *self.view.guard.lock().expect("no test panics with it") = Some(guard.clone());
        ctx.every(PERIOD, move |knee, _, _| {
            if knee.view.arms.load(Ordering::SeqCst) {
                // It is tried again at the next tick.
                let _ = guard.arm();
            }
        });
    }
}

impl Handler<Delivery<Torque>> for Knee {
    type Result = ();

    fn handle(&mut self, _: Delivery<Torque>, _: &mut Self::Context) {}
}

/// A process lists all its outputs, and the nodes of two legs would have the same addresses.
static ONE_LEG: Mutex<()> = Mutex::new(());

/// A central node that commands a knee on another one, which has these contracts.
struct Leg {
    central: Node,
    knee: Node,
    view: Arc<View>,
    sender: Sender,
    _one_leg: MutexGuard<'static, ()>,
}

impl Leg {
    fn start(contracts: impl IntoIterator<Item = Contract>) -> Self {
        let one_leg = ONE_LEG.lock().unwrap_or_else(PoisonError::into_inner);
        let network = Loopback::new();
        let quick =
            |builder: NodeBuilder| builder.configure(|config| config.ndl.period = Duration::from_millis(50));
        let control = AppSpec::new("control", || Control).address(CONTROL);
        let central = quick(network.node("central")).app(control).start().expect("a node");
        let (view, control) = (Arc::<View>::default(), Tid::new(central.handle().address(), CONTROL));
        let shared = view.clone();
        let knee = AppSpec::new("knee", move || Knee { control, view: shared.clone() }).handles::<Torque>();
        let knee = contracts.into_iter().fold(knee, AppSpec::contract);
        let (test, sender): (_, SenderApp) = sender_app("test");
        let builder = quick(network.node("leg")).configure(|config| config.contracts.dry_run = true);
        let knee = builder.app(knee).app(test).start().expect("a node");
        all_run(&[&central, &knee]);
        Self { central, knee, view, sender: sender.sender(), _one_leg: one_leg }
    }

    fn report(&self, node: &Node) -> ContractsReport {
        let inspect = Tid::new(node.handle().address(), AppAddress::INSPECT);
        let asked = self.sender.message(inspect, &AskContracts {}).ask::<ContractsReport>(DEADLINE);
        wait(asked.expect("there is room")).expect("an answer")
    }

    /// Returns the checked contracts, as soon as the name of the commander is known and the output is measured.
    fn closure(&self) -> Closure {
        until("the output is measured, and its commander known", || {
            let reports = [&self.central, &self.knee].map(|node| self.report(node));
            let output = reports[1].outputs.first()?;
            (output.sender_name.is_some() && output.measured_us.is_some()).then(|| Closure::of(&reports))
        })
    }
}

fn of_control(within: Duration) -> Contract {
    Contract::when_lost("control").or_late(PROTECTION.age_max).or_stopped().goes_to("damped", within)
}

#[test]
fn contract_of_two_nodes_closes_and_is_executed() {
    // Given: 800 ms of age, 300 ms of silence, 5 ms of slack
    let leg = Leg::start([of_control(Duration::from_millis(1_105))]);
    // When
    let closure = leg.closure();
    // Then
    assert_eq!(closure.gaps, []);
    assert_eq!(closure.rows.len(), 3);
    for row in &closure.rows {
        assert!(row.worst.is_some_and(|worst| worst <= row.within), "{row:?}");
        assert!(row.measured.is_some(), "{row:?}");
    }
    let lost = &closure.rows[0];
    assert!(lost.measured.is_some_and(|measured| measured >= PROTECTION.within), "{lost:?}");
    // When: the commander stops
    leg.view.arms.store(true, Ordering::SeqCst);
    leg.view.wait_for(State::Live);
    leg.central.stop();
    // Then
    leg.view.wait_for(State::Safe(Cause::Silent));
    leg.knee.stop();
}

#[test]
fn missing_contract_and_too_short_time_are_found() {
    let leg = Leg::start([]);
    let closure = leg.closure();
    assert_eq!(closure.gaps.len(), 1, "{:?}", closure.gaps);
    assert_eq!((&*closure.gaps[0].app, &*closure.gaps[0].sender), ("knee", "control"));
    drop(leg);
    let leg = Leg::start([of_control(Duration::from_millis(1_104))]);
    let closure = leg.closure();
    assert_eq!(closure.gaps, []);
    // It is late 800 ms after the last command, so that time is enough.
    for row in [&closure.rows[0], &closure.rows[2]] {
        assert!(
            row.fault.as_ref().is_some_and(|why| why.contains("= 1105.0 ms, more than 1104.0 ms")),
            "{row:?}"
        );
    }
    assert_eq!(closure.rows[1].worst, Some(Duration::from_millis(305)));
}
