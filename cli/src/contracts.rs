//! `sinew contracts`: the contracts of all applications, and whether they close.

use std::time::Duration;

use serde_json::{Value as Json, json};
use sinew::contracts::{AskContracts, Closure, Condition, ContractRow, ContractsReport, Gap};

use crate::{
    Report,
    system::{Answer, System, SystemError},
    table::{Table, clean, or_dash, paragraph, time},
};

/// Asks every node for its contracts and outputs, and checks them together.
pub(crate) fn show(system: &mut System, is_wide: bool) -> Result<Report, SystemError> {
    let here = system.here()?;
    Ok(checked(system.ask_all::<AskContracts, ContractsReport>(&here), is_wide))
}

fn checked(answers: Vec<Answer<ContractsReport>>, is_wide: bool) -> Report {
    let (mut reports, mut silent) = (Vec::new(), Vec::new());
    for answer in answers {
        match answer.result {
            Ok(report) => reports.push(report),
            // A chain through one of its applications cannot be checked either.
            Err(why) => silent.push((answer.node.to_string(), answer.name, why)),
        }
    }
    let closure = Closure::of(&reports);
    let cut: Vec<_> = reports.iter().filter(|report| left_out(report) > 0).collect();
    let mut text = table(&closure, is_wide);
    for (row, fault) in closure.rows.iter().filter_map(|row| Some((row, row.fault.as_ref()?))) {
        let line =
            format!("{} (node {}), {} {}: {fault}", row.app, row.node, row.subject, words(row.condition));
        text += &paragraph(0, &clean(&line), is_wide);
    }
    for Gap { node, fault, .. } in &closure.gaps {
        text += &paragraph(0, &clean(&format!("node {node}: {fault}")), is_wide);
    }
    for report in &cut {
        let (count, name) = (left_out(report), clean(&report.name));
        text += &format!(
            "{} {name}: {count} further contracts or outputs had no room in its answer\n",
            report.node
        );
    }
    for (node, name, why) in &silent {
        text += &format!("{node} {}: {}; its contracts are not checked\n", clean(name), clean(why));
    }
    let is_complete = silent.is_empty() && cut.is_empty();
    let outputs: usize = reports.iter().map(|report| report.outputs.len()).sum();
    text += &summary(&closure, outputs, is_complete);
    let silent = silent.iter().map(|(node, name, why)| json!({ "node": node, "name": name, "why": why }));
    let cut = cut.iter().map(|report| json!({ "node": report.node.to_string(), "count": left_out(report) }));
    let json = json!({
        "closes": closure.closes() && is_complete, "contracts": closure.rows.iter().map(row_json).collect::<Vec<_>>(),
        "missing": closure.gaps.iter().map(gap_json).collect::<Vec<_>>(), "outputs": outputs,
        "silent": silent.collect::<Vec<_>>(), "left_out": cut.collect::<Vec<_>>(),
    });
    Report { text, json, is_fine: closure.closes() && is_complete }
}

/// Returns the number of entries that did not fit into the answer.
const fn left_out(report: &ContractsReport) -> u64 {
    report.contracts_left_out.saturating_add(report.outputs_left_out)
}

fn table(closure: &Closure, is_wide: bool) -> String {
    if closure.rows.is_empty() {
        return String::new();
    }
    let heading = ["APPLICATION", "NODE", "WHEN", "STATE", "WITHIN", "WORST", "MEASURED", "VERDICT"];
    let mut table = Table::new(heading).whole(&["WITHIN", "WORST", "MEASURED", "VERDICT"]).wide(is_wide);
    for row in &closure.rows {
        table.row([
            row.app.clone(),
            row.node.clone(),
            format!("{} {}", row.subject, words(row.condition)),
            row.state.clone(),
            shown(row.within),
            or_dash(row.worst.map(shown)),
            or_dash(row.measured.map(shown)),
            if row.fault.is_none() { "closes" } else { "does not close" }.to_owned(),
        ]);
    }
    table.text()
}

fn summary(closure: &Closure, outputs: usize, is_complete: bool) -> String {
    let open = closure.rows.iter().filter(|row| row.fault.is_some()).count();
    let (rows, gaps) = (closure.rows.len(), closure.gaps.len());
    if is_complete && rows == 0 && outputs == 0 {
        return "no application declares a contract (`AppSpec::contract`), and none guards an output\n"
            .to_owned();
    }
    let checked = format!("{rows} conditions of contracts, {outputs} guarded outputs");
    match (closure.closes(), is_complete) {
        (true, true) => format!("all close: {checked}\n"),
        (true, false) => format!("the answers close, and are not complete: {checked}\n"),
        (false, _) => {
            format!("{checked}: {open} conditions do not close, {gaps} outputs lack a contract\n")
        }
    }
}

fn row_json(row: &ContractRow) -> Json {
    let late = match row.condition {
        Condition::Late(time) => Some(micros(time)),
        Condition::Lost | Condition::Stopped => None,
    };
    json!({
        "app": row.app, "node_name": row.node, "subject": row.subject.to_string(), "condition": kind(row.condition),
        "late_us": late, "state": row.state, "within_us": micros(row.within), "worst_us": row.worst.map(micros),
        "measured_us": row.measured.map(micros), "sum": row.sum, "closes": row.fault.is_none(), "fault": row.fault,
    })
}

fn gap_json(gap: &Gap) -> Json {
    json!({
        "app": gap.app, "node_name": gap.node, "sender": gap.sender, "kind": gap.kind_name,
        "conditions": gap.conditions, "fault": gap.fault,
    })
}

const fn kind(condition: Condition) -> &'static str {
    match condition {
        Condition::Lost => "lost",
        Condition::Late(_) => "late",
        Condition::Stopped => "stopped",
    }
}

fn words(condition: Condition) -> String {
    match condition {
        Condition::Late(time) => format!("late by {}", shown(time)),
        Condition::Lost | Condition::Stopped => kind(condition).to_owned(),
    }
}

fn shown(duration: Duration) -> String {
    time(micros(duration))
}

fn micros(duration: Duration) -> u64 {
    u64::try_from(duration.as_micros()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use sinew::{
        AppAddress, NodeAddress, Tid,
        contracts::{CommandedOutput, Contract, ContractReport},
    };

    use super::*;
    use crate::table::{
        WIDTH,
        tests::{long_name, widest},
    };

    fn ms(time: u64) -> Duration {
        Duration::from_millis(time)
    }

    /// The answer of a knee that obeys the gait, with a contract of this time.
    fn answer(within: Duration) -> Answer<ContractsReport> {
        let node = NodeAddress::new(2);
        let tid = |app| Tid::new(node, AppAddress::new(app));
        let contract = Contract::when_lost("gait").or_late(ms(60)).or_stopped().goes_to("damped", within);
        let output = CommandedOutput {
            receiver: tid(0x1001),
            receiver_name: Some("knee.drive".to_owned()),
            sender: tid(0x1002),
            sender_name: Some("gait".to_owned()),
            sender_node: Some("knee".to_owned()),
            kind_name: "exo.torque".to_owned(),
            within_us: 10_000,
            age_max_us: 60_000,
            measured_us: Some(10_200),
        };
        let report = ContractsReport {
            node,
            name: "knee".to_owned(),
            slack_us: 5_000,
            detection_us: 500_000,
            dry_run: true,
            contracts: vec![ContractReport::new(tid(0x1001), "knee.drive", &contract)],
            contracts_left_out: 0,
            outputs: vec![output],
            outputs_left_out: 0,
        };
        Answer { node, name: "knee".to_owned(), result: Ok(report) }
    }

    #[test]
    fn closed_system_is_fine_and_shows_its_times() {
        let report = checked(vec![answer(ms(75))], false);
        assert!(report.is_fine, "{}", report.text);
        for words in ["gait late by 60.0 ms", "75.0 ms", "10.2 ms", "closes", "all close: 3 conditions"] {
            assert!(report.text.contains(words), "{words}: {}", report.text);
        }
        let row = &report.json["contracts"][1];
        assert_eq!((&row["condition"], &row["late_us"]), (&json!("late"), &json!(60_000)));
        assert_eq!((&row["worst_us"], &row["measured_us"]), (&json!(15_000), &json!(0)));
        assert_eq!(report.json["closes"], true);
    }

    #[test]
    fn open_contract_and_missing_one_are_findings() {
        let report = checked(vec![answer(ms(70))], true);
        assert!(!report.is_fine && report.text.contains("= 75.0 ms, more than 70.0 ms"), "{}", report.text);
        assert!(report.text.contains("2 conditions do not close, 0 outputs lack"), "{}", report.text);
        let mut without = answer(ms(75));
        without.result.as_mut().expect("it answers").contracts.clear();
        let report = checked(vec![without], true);
        assert!(
            !report.is_fine && report.text.contains("knee.drive obeys gait by exo.torque"),
            "{}",
            report.text
        );
        assert_eq!(report.json["missing"][0]["conditions"], json!(["lost", "late", "stopped"]));
    }

    #[test]
    fn system_without_outputs_needs_no_contract() {
        let mut empty = answer(ms(75));
        let report = empty.result.as_mut().expect("it answers");
        (report.contracts, report.outputs) = (Vec::new(), Vec::new());
        let report = checked(vec![empty], false);
        assert!(report.is_fine && report.text.starts_with("no application declares"), "{}", report.text);
    }

    #[test]
    fn incomplete_answers_are_never_fine() {
        let silent =
            Answer { node: NodeAddress::new(3), name: "hip".to_owned(), result: Err("no answer".to_owned()) };
        let report = checked(vec![answer(ms(75)), silent], false);
        assert!(!report.is_fine && report.text.contains("hip: no answer; its contracts are not checked"));
        let mut cut = answer(ms(75));
        cut.result.as_mut().expect("it answers").outputs_left_out = 2;
        let report = checked(vec![cut], false);
        assert!(!report.is_fine && report.text.contains("2 further contracts or outputs"), "{}", report.text);
    }

    #[test]
    fn table_fits_a_terminal_for_any_names() {
        let mut answer = answer(ms(75));
        let report = answer.result.as_mut().expect("it answers");
        report.name = long_name();
        (report.contracts[0].app_name, report.contracts[0].state) = (long_name(), long_name());
        let report = checked(vec![answer], false);
        let table: String =
            report.text.lines().take_while(|line| !line.starts_with("all")).collect::<Vec<_>>().join("\n");
        assert!(widest(&table) <= WIDTH, "{}", report.text);
    }
}
