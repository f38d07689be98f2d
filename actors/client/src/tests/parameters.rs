//! Parameters of an endpoint, which another endpoint lists and sets.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    parameters::{
        AskParameters, LEAD, NamedValue, ParameterList, ParameterOutcome, SetParameters, TransactionVerdict,
        Value,
    },
};

use super::{Registration, TORQUE, TestNode, WATCHDOG};
use crate::{Endpoint, EndpointParameters, NodeApi};

sinew::params! {
    struct Gains {
        /// A gain.
        gain: f64 = 0.5, unit "1", range 0.0..=1.0;
        /// A gain that moves.
        slow: f64 = 0.5, unit "1", range 0.0..=1.0, slope 0.1;
    }
}

fn named(name: &str, value: f64) -> Vec<NamedValue> {
    vec![NamedValue { name: name.to_owned(), value: Value::Number(value) }]
}

/// The loop of a program, on a thread of its own, until this is dropped.
struct Loop {
    gains: Arc<Gains>,
    is_over: Arc<AtomicBool>,
    thread: Option<thread::JoinHandle<u32>>,
}

impl Loop {
    /// Registers under this name, and serves the parameters with this period.
    fn start(api: &NodeApi, name: &str, period: Duration) -> Self {
        let registration = Registration::new().name(name).serves_parameters();
        let mut endpoint = api.register_transport_address(registration).unwrap();
        let (gains, is_over) = (Gains::new(), Arc::new(AtomicBool::new(false)));
        let mut parameters = EndpointParameters::new(&mut endpoint, &gains, period);
        let over = is_over.clone();
        let run = move || {
            let mut others = 0;
            while !over.load(Ordering::SeqCst) {
                if !period.is_zero() {
                    parameters.tick(&mut endpoint);
                }
                if let Some(received) = endpoint.receive(Duration::from_millis(2)).unwrap() {
                    others += u32::from(parameters.serve(&mut endpoint, received).is_some());
                }
            }
            others
        };
        Self { gains, is_over, thread: Some(thread::spawn(run)) }
    }

    /// Ends the loop. Returns the number of messages that were not about parameters.
    fn end(mut self) -> u32 {
        self.is_over.store(true, Ordering::SeqCst);
        self.thread.take().expect("it runs").join().expect("it does not panic")
    }
}

fn set(tuner: &mut Endpoint, app: &str, set: &SetParameters) -> ParameterOutcome {
    tuner.message(app, set).ask(WATCHDOG).unwrap()
}

const PERIOD: Duration = Duration::from_millis(2);

#[test]
fn endpoint_serves_its_parameters_in_its_loop() {
    let node = TestNode::start();
    let api = NodeApi::connect(node.path()).unwrap();
    let camera = Loop::start(&api, "camera", PERIOD);
    let mut tuner = api.register_transport_address(Registration::new()).unwrap();
    let list: ParameterList = tuner.message("camera", &AskParameters {}).ask(WATCHDOG).unwrap();
    assert!(list.has_ticks && list.parameters.len() == 2, "{list:?}");
    let applied = set(&mut tuner, "camera", &SetParameters::Values(named("gain", 0.7)));
    assert!(matches!(applied, ParameterOutcome::Applied { tick: 1.., .. }), "{applied:?}");
    assert_eq!(camera.gains.gain.get(), 0.7);
    let refused = set(&mut tuner, "camera", &SetParameters::Values(named("gain", 1.7)));
    assert!(matches!(&refused, ParameterOutcome::Refused { why } if why.contains("outside")), "{refused:?}");
    set(&mut tuner, "camera", &SetParameters::Undo);
    assert_eq!(camera.gains.gain.get(), 0.5);
    // Other messages are left to the program, and a question without a reply is refused.
    let other = tuner.message("camera", &TORQUE).confirmed(WATCHDOG).unwrap();
    assert_eq!(other, Outcome::Delivered);
    let unsupported = tuner.message("camera", &AskParameters {}).confirmed(WATCHDOG).unwrap();
    assert_eq!(unsupported, Outcome::Rejected(Rejection::Unsupported));
    assert_eq!(camera.end(), 1);
}

#[test]
fn endpoint_without_a_loop_applies_between_two_messages() {
    let node = TestNode::start();
    let api = NodeApi::connect(node.path()).unwrap();
    let camera = Loop::start(&api, "camera", Duration::ZERO);
    let mut tuner = api.register_transport_address(Registration::new()).unwrap();
    let applied = set(&mut tuner, "camera", &SetParameters::Values(named("gain", 0.7)));
    assert!(matches!(applied, ParameterOutcome::Applied { tick: 0, .. }), "{applied:?}");
    let refused = set(&mut tuner, "camera", &SetParameters::Values(named("slow", 0.7)));
    assert!(matches!(&refused, ParameterOutcome::Refused { why } if why.contains("slope")), "{refused:?}");
    assert_eq!((camera.gains.gain.get(), camera.gains.slow.get(), camera.end()), (0.7, 0.5, 0));
}

#[test]
fn endpoints_take_part_in_a_transaction() {
    let node = TestNode::start();
    let api = NodeApi::connect(node.path()).unwrap();
    let [left, right] =
        [("left", PERIOD), ("right", Duration::ZERO)].map(|(name, period)| Loop::start(&api, name, period));
    let mut tuner = api.register_transport_address(Registration::new()).unwrap();
    let sets = |value| ["left", "right"].map(|app| (app.to_owned(), named("gain", value))).to_vec();
    let report = tuner.set_together(sets(0.2), LEAD * 2, WATCHDOG).unwrap();
    assert_eq!(report.verdict, TransactionVerdict::All, "{report:?}");
    assert_eq!((left.gains.gain.get(), right.gains.gain.get()), (0.2, 0.2));
    let report = tuner.set_together(sets(1.2), LEAD, WATCHDOG).unwrap();
    assert_eq!(report.verdict, TransactionVerdict::None, "{report:?}");
    let unknown = tuner.set_together(vec![("middle".to_owned(), named("gain", 0.1))], LEAD, WATCHDOG);
    assert!(unknown.expect_err("there is none").to_string().contains("middle"));
    assert_eq!((left.gains.gain.get(), left.end(), right.end()), (0.2, 0, 0));
}

#[test]
fn requester_that_has_gone_delays_no_loop() {
    let node = TestNode::start();
    let api = NodeApi::connect(node.path()).unwrap();
    let mut camera = api.register_transport_address(Registration::new().name("camera")).unwrap();
    let gains = Gains::new();
    let mut parameters = EndpointParameters::new(&mut camera, &gains, PERIOD);
    let mut tuner = api.register_transport_address(Registration::new()).unwrap();
    let set = SetParameters::Values(named("gain", 0.7));
    let late = tuner.message("camera", &set).ask::<ParameterOutcome>(Duration::from_millis(1));
    assert!(late.is_err(), "{late:?}");
    drop(tuner);
    let received = camera.receive(Duration::ZERO).unwrap();
    // Its request may have been taken back before it arrived here, or is refused as no tick came in time.
    if let Some(received) = received {
        assert!(parameters.serve(&mut camera, received).is_none());
    }
    parameters.tick(&mut camera);
    assert_eq!(gains.gain.get(), 0.5);
}
