//! The contracts of the node's applications, and their outputs.

use std::time::Duration;

use sinew_model::{
    config::{NodeConfig, WatchGroup},
    contracts::{AskContracts, ContractsReport},
};
use sinew_runtime::{
    app::{AppContext, AppSpec, Contract, DynApp, Subject},
    outcome::Outcome,
    protection::{Guard, Protection},
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Flags, Payload},
};

use super::Bench;
use crate::inspect::reports::Report as _;

const MS: Duration = Duration::from_millis(1);

struct Knee;

impl actix::Actor for Knee {
    type Context = AppContext<Self>;
}

#[derive(serde::Serialize, serde::Deserialize)]
struct Torque;

impl Payload for Torque {
    const NAME: &'static str = "test.contracts.torque";
    const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(20)));
}

impl Bench {
    fn contracts(&self) -> ContractsReport {
        assert_eq!(self.outcome(AskContracts::KIND, Flags::ASK), Outcome::Delivered);
        self.reply().decode().expect("a report")
    }
}

fn knee() -> DynApp {
    let of_gait = Contract::when_lost("gait").or_late(60 * MS).goes_to("damped", 200 * MS);
    let of_node = Contract::when_stopped(Subject::node("central")).goes_to("damped", 300 * MS).through("hip");
    AppSpec::new("knee", || Knee)
        .requires(["gait"])
        .safe_state(|_, _, _| (), |_, _, _| ())
        .progress_within(30 * MS)
        .contract(of_gait)
        .contract(of_node)
        .into()
}

// spec: INSPECT-12
#[test]
fn contracts_are_reported_until_their_application_is_removed() {
    // Given
    let mut config = NodeConfig::new("knee");
    (config.contracts.slack, config.ndl.period, config.ndl.missed_max) = (2 * MS, 100 * MS, 3);
    let bench = Bench::new(config);
    let tid = Tid::new(bench.state.ctx.node, AppAddress::new(0x1002));
    // When
    bench.state.contracts.register(tid, &knee());
    // Then
    let report = bench.contracts();
    assert_eq!((report.slack_us, report.detection_us, report.dry_run), (2_000, 500_000, false));
    let [of_gait, of_node] = &report.contracts[..] else { panic!("{report:?}") };
    assert_eq!((of_gait.lost, of_gait.late_us, of_gait.stopped), (true, Some(60_000), false));
    assert_eq!((of_gait.turn_us, of_gait.within_us), (Some(30_000), 200_000));
    assert_eq!((of_node.stopped, of_node.turn_us, of_node.through.as_deref()), (true, None, Some("hip")));
    bench.state.contracts.remove(tid.app);
    assert_eq!(bench.contracts().contracts, []);
}

#[test]
fn outputs_are_reported_with_their_limits() {
    let bench = Bench::new(NodeConfig::new("knee"));
    let node = bench.state.ctx.node;
    let (sender, receiver) =
        (Tid::new(NodeAddress::new(8), AppAddress::new(1)), Tid::new(node, AppAddress::new(0x1003)));
    let _guard = Guard::new::<Torque>(sender, receiver, (), |(), _| {}).expect("there is the thread");
    let report = bench.contracts();
    let output = report.outputs.iter().find(|output| output.receiver == receiver).expect("its output");
    assert_eq!((output.sender, &*output.kind_name), (sender, Torque::NAME));
    assert_eq!((output.within_us, output.age_max_us, output.measured_us), (60_000, 160_000, None));
}

#[test]
fn slowest_group_of_nodes_bounds_the_detection() {
    let mut config = NodeConfig::new("knee");
    (config.ndl.period, config.ndl.missed_max) = (100 * MS, 3);
    config.ndl.watch = vec![WatchGroup { nodes: vec!["arm".into()], period: 200 * MS, missed_max: 5 }];
    assert_eq!(Bench::new(config).contracts().detection_us, 1_400_000);
}

#[test]
fn shortened_report_counts_its_contracts() {
    let bench = Bench::new(NodeConfig::new("knee"));
    bench.state.contracts.register(Tid::new(bench.state.ctx.node, AppAddress::new(0x1002)), &knee());
    let mut report = bench.contracts();
    report.outputs.clear();
    assert!(report.halve());
    assert_eq!((report.contracts.len(), report.contracts_left_out), (1, 1));
    assert!(report.halve() && !report.halve());
}
