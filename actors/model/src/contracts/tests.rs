//! Systems of contracts that close, and planted ones that do not.

use proptest::prelude::*;
use sinew_runtime::tid::AppAddress;

use super::*;

const MS: u64 = 1_000;

fn tid(node: u32, app: u32) -> Tid {
    Tid::new(NodeAddress::new(node), AppAddress::new(0x1000 + app))
}

fn ms(time: u64) -> Duration {
    Duration::from_millis(time)
}

/// The knee on node 2, which the gait on node 1 commands: 60 ms of age, 10 ms of silence, 5 ms of slack.
fn knee(contracts: &[Contract]) -> ContractsReport {
    report(2, "knee", contracts, vec![output("gait")])
}

fn output(sender: &str) -> CommandedOutput {
    CommandedOutput {
        receiver: tid(2, 1),
        receiver_name: Some("knee".to_owned()),
        sender: tid(1, 1),
        sender_name: Some(sender.to_owned()),
        sender_node: Some("central".to_owned()),
        kind_name: "exo.torque".to_owned(),
        within_us: 10 * MS,
        age_max_us: 60 * MS,
        measured_us: None,
    }
}

fn report(node: u32, app: &str, contracts: &[Contract], outputs: Vec<CommandedOutput>) -> ContractsReport {
    ContractsReport {
        node: NodeAddress::new(node),
        name: format!("node of {app}"),
        slack_us: 5 * MS,
        detection_us: 500 * MS,
        dry_run: false,
        contracts: contracts.iter().map(|one| ContractReport::new(tid(node, 1), app, one)).collect(),
        contracts_left_out: 0,
        outputs,
        outputs_left_out: 0,
    }
}

fn of_gait(within: u64) -> Contract {
    Contract::when_lost("gait").or_late(ms(60)).or_stopped().goes_to("damped", ms(within))
}

fn faults(closure: &Closure) -> Vec<&str> {
    let gaps = closure.gaps.iter().map(|gap| &*gap.fault);
    closure.rows.iter().filter_map(|row| row.fault.as_deref()).chain(gaps).collect()
}

#[test]
fn contract_with_enough_time_closes() {
    let closure = Closure::of(&[knee(&[of_gait(75)])]);
    assert!(closure.closes(), "{closure:?}");
    let worst: Vec<_> = closure.rows.iter().map(|row| row.worst).collect();
    assert_eq!(worst, [Some(ms(75)), Some(ms(15)), Some(ms(75))]);
    let sum =
        "60.0 ms age_max of exo.torque + 10.0 ms within of exo.torque + 5.0 ms contracts.slack_ms = 75.0 ms";
    assert_eq!(closure.rows[0].sum, sum);
    assert!(closure.rows[1].sum.contains("- 60.0 ms until it is late = 15.0 ms"), "{}", closure.rows[1].sum);
}

#[test]
fn sum_above_the_declared_time_names_its_settings() {
    let closure = Closure::of(&[knee(&[of_gait(74)])]);
    let found = faults(&closure);
    // It is late 60 ms after the last command, so that time is enough.
    assert_eq!(found.len(), 2, "{found:?}");
    let words = "= 75.0 ms, more than 74.0 ms: allow 75.0 ms, or shorten it in the type's `Protection` (age_max of exo.torque)";
    assert!(found.iter().all(|fault| fault.ends_with(words)), "{found:?}");
}

#[test]
fn lateness_below_the_maximum_age_is_a_finding() {
    let late = |time| Contract::when_late("gait", ms(time)).goes_to("damped", ms(75));
    let mut short = knee(&[late(59)]);
    short.outputs[0].measured_us = Some(10 * MS);
    let closure = Closure::of(&[short]);
    let why = closure.rows[0].fault.as_deref();
    assert!(why.is_some_and(|why| why.contains("gait may stay late by 59.0 ms")), "{why:?}");
    assert_eq!((closure.rows[0].worst, closure.rows[0].measured), (None, None));
    let closure = Closure::of(&[knee(&[late(60)])]);
    assert_eq!((&closure.rows[0].fault, closure.rows[0].worst), (&None, Some(ms(15))));
}

#[test]
fn output_without_a_contract_is_named() {
    let closure = Closure::of(&[knee(&[])]);
    let [gap] = &closure.gaps[..] else { panic!("{closure:?}") };
    assert_eq!((&*gap.app, &*gap.sender, &*gap.kind_name), ("knee", "gait", "exo.torque"));
    assert_eq!(gap.conditions, ["lost", "late", "stopped"]);
    assert!(gap.fault.contains("knee obeys gait by exo.torque"), "{}", gap.fault);
    // And: one with a part of the conditions
    let closure =
        Closure::of(&[knee(&[Contract::when_lost("gait").or_late(ms(60)).goes_to("damped", ms(90))])]);
    assert_eq!(closure.gaps[0].conditions, ["stopped"]);
    assert!(!closure.closes());
}

#[test]
fn node_and_type_name_a_commander_as_well() {
    for subject in [Subject::node("central"), Subject::SenderOf("exo.torque".to_owned())] {
        let contract = Contract::when_lost(subject).or_late(ms(60)).or_stopped().goes_to("damped", ms(75));
        let closure = Closure::of(&[knee(&[contract])]);
        assert!(closure.closes(), "{closure:?}");
    }
}

#[test]
fn contract_that_nothing_executes_is_a_finding() {
    let of_camera = Contract::when_lost("camera").goes_to("blind", ms(100));
    let closure = Closure::of(&[knee(&[of_gait(75), of_camera])]);
    let found = faults(&closure);
    assert!(
        matches!(found[..], [why] if why.contains("no output of knee is commanded by camera")),
        "{found:?}"
    );
    assert_eq!(closure.rows.last().and_then(|row| row.worst), None);
}

#[test]
fn safe_state_of_a_requirement_executes_no_lateness() {
    let contract = Contract::when_lost("imu").or_late(ms(10)).or_stopped().goes_to("held", ms(1_505));
    let mut gait = report(1, "gait", &[contract], Vec::new());
    gait.contracts[0].turn_us = Some(1_000 * MS);
    let closure = Closure::of(&[gait]);
    let worst: Vec<_> = closure.rows.iter().map(|row| row.worst).collect();
    assert_eq!(worst, [Some(ms(1_505)), None, Some(ms(1_505))]);
    let found = faults(&closure);
    assert!(matches!(found[..], [why] if why.contains("no late message")), "{found:?}");
}

/// The gait obeys the panel, and the knee obeys the gait.
fn chain(within: u64, of_panel: &[Contract]) -> Closure {
    let mut of_knee = vec![of_gait(75)];
    of_knee.push(Contract::when_lost("panel").goes_to("damped", ms(within)).through("gait"));
    let panel =
        CommandedOutput { receiver: tid(1, 1), sender: tid(3, 1), receiver_name: None, ..output("panel") };
    Closure::of(&[report(1, "gait", of_panel, vec![panel]), knee(&of_knee)])
}

fn of_panel() -> Contract {
    Contract::when_lost("panel").or_late(ms(60)).or_stopped().goes_to("silent", ms(80))
}

#[test]
fn chain_adds_both_times_up() {
    let closure = chain(150, &[of_panel()]);
    assert!(closure.closes(), "{closure:?}");
    assert_eq!(closure.rows.last().and_then(|row| row.worst), Some(ms(75 + 75)));
    let closure = chain(149, &[of_panel()]);
    let found = faults(&closure);
    assert!(matches!(found[..], [why] if why.contains("= 150.0 ms, more than 149.0 ms")), "{found:?}");
}

#[test]
fn chain_without_its_first_contract_is_named() {
    let closure = chain(150, &[]);
    let found = faults(&closure);
    assert!(found.iter().any(|why| why.contains("gait has no contract for panel being lost")), "{found:?}");
}

#[test]
fn lateness_that_the_executor_tolerates_is_a_finding() {
    let late = |time| Contract::when_late("panel", ms(time)).goes_to("damped", ms(150)).through("gait");
    let closure = |time| {
        let panel = CommandedOutput { receiver: tid(1, 1), sender: tid(3, 1), ..output("panel") };
        Closure::of(&[report(1, "gait", &[of_panel()], vec![panel]), knee(&[of_gait(75), late(time)])])
    };
    let found = closure(59);
    let why = found.rows.last().and_then(|row| row.fault.as_deref());
    assert!(why.is_some_and(|why| why.contains("gait takes panel for late by 60.0 ms")), "{why:?}");
    let found = closure(60);
    assert!(found.closes(), "{found:?}");
}

#[test]
fn executor_that_shares_its_name_is_a_finding() {
    let of_knee = [of_gait(75), Contract::when_lost("panel").goes_to("damped", ms(150)).through("gait")];
    let gait = |node| {
        let panel = CommandedOutput { receiver: tid(node, 1), sender: tid(3, 1), ..output("panel") };
        report(node, "gait", &[of_panel()], vec![panel])
    };
    let closure = Closure::of(&[gait(1), gait(4), knee(&of_knee)]);
    let found = faults(&closure);
    assert!(matches!(found[..], [why] if why.contains("are both called gait")), "{found:?}");
    assert!(Closure::of(&[gait(1), knee(&of_knee)]).closes());
}

#[test]
fn texts_of_a_hostile_report_are_bounded() {
    let long = "é".repeat(100_000);
    let mut contract = ContractReport::new(tid(2, 1), &long, &of_gait(1));
    contract.through = Some(long.clone());
    let mut hostile = knee(&[of_gait(1)]);
    hostile.contracts.push(contract);
    (hostile.outputs[0].kind_name, hostile.outputs[0].sender_node) = (long, None);
    hostile.contracts[0].stopped = false;
    hostile.contracts[1].stopped = false;
    let closure = Closure::of(&[hostile]);
    assert_eq!(closure.gaps.len(), 1);
    let sums = closure.rows.iter().map(|row| row.sum.as_str());
    assert!(faults(&closure).into_iter().chain(sums).all(|text| text.len() <= 4_096));
    assert!(faults(&closure).iter().any(|text| text.len() > 4_000));
}

#[test]
fn circle_of_contracts_ends_as_a_finding() {
    let through = |executor: &str| {
        let of_panel = Contract::when_lost("panel").goes_to("damped", ms(150)).through(executor);
        [of_panel, Contract::when_stopped(executor).goes_to("damped", ms(75)).through(executor)]
    };
    let closure = Closure::of(&[report(1, "gait", &through("knee"), Vec::new()), knee(&through("gait"))]);
    assert!(faults(&closure).iter().any(|why| why.contains("is a circle")), "{closure:?}");
}

#[test]
fn slow_dry_run_is_a_finding() {
    let mut knee = knee(&[of_gait(75)]);
    knee.outputs[0].measured_us = Some(15 * MS);
    let closure = Closure::of(std::slice::from_ref(&knee));
    assert!(closure.closes(), "{closure:?}");
    let measured: Vec<_> = closure.rows.iter().map(|row| row.measured).collect();
    // It counts as late only after that.
    assert_eq!(measured, [Some(ms(15)), Some(ms(0)), Some(ms(15))]);
    knee.outputs[0].measured_us = Some(15 * MS + 1);
    let closure = Closure::of(&[knee]);
    assert!(faults(&closure).iter().all(|why| why.contains("its dry run took 15.1 ms")), "{closure:?}");
    assert!(!closure.closes());
}

proptest! {
    /// For any settings a contract closes exactly if its sum is not above its time.
    #[test]
    fn contract_closes_exactly_within_its_sum(
        age_max in 1..100_000u64, within in 1..100_000u64, slack in 0..100_000u64,
        later in 0..100_000u64, declared in 1..300_000u64,
    ) {
        let micros = Duration::from_micros;
        let late = age_max + later;
        let contract = Contract::when_lost("gait").or_late(micros(late)).or_stopped();
        let mut knee = knee(&[contract.goes_to("damped", micros(declared))]);
        knee.slack_us = slack;
        (knee.outputs[0].age_max_us, knee.outputs[0].within_us) = (age_max, within);
        let closure = Closure::of(&[knee]);
        let watchdog = age_max + within;
        let sums = [watchdog + slack, watchdog.saturating_sub(late) + slack, watchdog + slack];
        for (row, sum) in closure.rows.iter().zip(sums) {
            prop_assert_eq!(row.worst, Some(micros(sum)));
            prop_assert_eq!(row.fault.is_none(), sum <= declared);
        }
        prop_assert_eq!(closure.rows.len(), 3);
    }

    /// For any missing conditions, exactly these are the gap of the output.
    #[test]
    fn missing_conditions_are_exactly_the_gap(lost: bool, late: bool, stopped: bool) {
        let mut knee = knee(&[of_gait(75)]);
        let contract = &mut knee.contracts[0];
        (contract.lost, contract.stopped) = (lost, stopped);
        contract.late_us = contract.late_us.filter(|_| late);
        let all = [("lost", lost), ("late", late), ("stopped", stopped)];
        let missing: Vec<_> = all.into_iter().filter(|(_, is_there)| !is_there).map(|(word, _)| word).collect();
        let closure = Closure::of(&[knee]);
        let found: Vec<_> = closure.gaps.iter().flat_map(|gap| gap.conditions.clone()).collect();
        prop_assert_eq!(&found, &missing);
        prop_assert_eq!(closure.closes(), missing.is_empty());
    }

    /// A chain takes as long as its parts together, for any times.
    #[test]
    fn chain_takes_as_long_as_its_parts(age_max in 1..60_000u64, within in 1..100_000u64) {
        let of_knee = [of_gait(75), Contract::when_lost("panel").goes_to("damped", ms(150)).through("gait")];
        let panel = CommandedOutput {
            receiver: tid(1, 1), age_max_us: age_max, within_us: within, ..output("panel")
        };
        let closure = Closure::of(&[report(1, "gait", &[of_panel()], vec![panel]), knee(&of_knee)]);
        let parts = closure.rows[0].worst.zip(closure.rows[3].worst).map(|(first, own)| first + own);
        prop_assert_eq!(closure.rows.last().and_then(|row| row.worst), parts);
    }
}
