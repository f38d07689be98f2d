//! The check that the contracts of a system close: no output without one, and times that add up.

use std::time::Duration;

use sinew_runtime::app::{Condition, Subject};

use super::{
    CommandedOutput, ContractReport, ContractsReport,
    sum::{Part, Sum, millis},
};

/// Maximum bytes of a sum or a fault. Names of the own applications stay far below it; those from outside have no limit
/// beside that of the report, and each row repeats them.
const TEXT_MAX: usize = 4_096;
/// Maximum depth of contracts that are executed through another application. A chain beyond it is a finding.
const CHAIN_MAX: usize = 4;

/// The checked contracts of a system.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Closure {
    /// One row for each condition of each contract, in the order of the nodes.
    pub rows: Vec<ContractRow>,
    /// The outputs without a contract for a condition of their commanders.
    pub gaps: Vec<Gap>,
}

/// A condition of a contract, and whether the system holds its time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ContractRow {
    /// The name of the application's node.
    pub node: String,
    /// The application.
    pub app: String,
    /// The part of the system that the contract is about.
    pub subject: Subject,
    /// The condition.
    pub condition: Condition,
    /// The name of the state.
    pub state: String,
    /// The declared time.
    pub within: Duration,
    /// The worst time from the begin of the condition, by the settings; `None`: nothing executes the contract, or its
    /// executor does not notice the condition.
    pub worst: Option<Duration>,
    /// The same time in a dry run; `None`: there was none.
    pub measured: Option<Duration>,
    /// The worst time as a sum; empty if there is none.
    pub sum: String,
    /// Why the contract does not close, with the remedy; `None`: it does.
    pub fault: Option<String>,
}

/// An output without a contract for some conditions of its commander.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Gap {
    /// The name of the output's node.
    pub node: String,
    /// The application that has the output.
    pub app: String,
    /// The sender of its commands.
    pub sender: String,
    /// The type of its commands.
    pub kind_name: String,
    /// The conditions without a contract: `lost`, `late`, `stopped`.
    pub conditions: Vec<&'static str>,
    /// The declaration that is missing.
    pub fault: String,
}

impl Closure {
    /// Checks the contracts of a system, from the reports of its nodes.
    #[must_use]
    pub fn of(reports: &[ContractsReport]) -> Self {
        let system = System(reports);
        let contracts =
            reports.iter().flat_map(|report| report.contracts.iter().map(move |one| (report, one)));
        let rows = contracts
            .flat_map(|(report, contract)| {
                contract.conditions().map(move |condition| system.row(At { report, contract }, condition))
            })
            .collect();
        let gaps =
            reports.iter().flat_map(|report| report.outputs.iter().filter_map(|output| gap(report, output)));
        Self { rows, gaps: gaps.collect() }
    }

    /// Returns whether all contracts close.
    #[must_use]
    pub fn closes(&self) -> bool {
        self.gaps.is_empty() && self.rows.iter().all(|row| row.fault.is_none())
    }
}

/// A contract, and the report that has it.
#[derive(Clone, Copy)]
struct At<'r> {
    report: &'r ContractsReport,
    contract: &'r ContractReport,
}

impl<'r> At<'r> {
    /// Returns the outputs of the application that the subject commands.
    fn outputs(self) -> impl Iterator<Item = &'r CommandedOutput> {
        let Self { report, contract } = self;
        report.outputs.iter().filter(move |output| is_about(contract, output))
    }

    const fn slack(self) -> Duration {
        Duration::from_micros(self.report.slack_us)
    }
}

#[derive(Clone, Copy)]
struct System<'r>(&'r [ContractsReport]);

impl<'r> System<'r> {
    fn row(self, at: At<'r>, condition: Condition) -> ContractRow {
        let ContractReport { app_name, subject, state, within_us, .. } = at.contract;
        let within = Duration::from_micros(*within_us);
        let sum = self.sum(at, condition, CHAIN_MAX);
        let fault = match &sum {
            Err(why) => Some(why.clone()),
            Ok(sum) if sum.total() > within => Some(sum.excess(within)),
            Ok(_) => slow_output(at),
        };
        let sum = sum.ok();
        let measured = sum.as_ref().and_then(|_| self.measured(at, condition, CHAIN_MAX));
        ContractRow {
            node: at.report.name.clone(),
            app: app_name.clone(),
            subject: subject.clone(),
            condition,
            state: state.clone(),
            within,
            worst: sum.as_ref().map(Sum::total),
            measured,
            sum: capped(sum.as_ref().map(ToString::to_string).unwrap_or_default()),
            fault: fault.map(capped),
        }
    }

    /// Returns the worst time of a contract, or why nothing executes it. `depth` is the number of further steps of a
    /// chain.
    fn sum(self, at: At<'r>, condition: Condition, depth: usize) -> Result<Sum, String> {
        if let Some(executor) = &at.contract.through {
            let (first, own) = self.chain(at, executor, condition, depth)?;
            let tolerated = late_by(first.1);
            if tolerated > late_by(condition) {
                let (subject, tolerated) = (&at.contract.subject, millis(tolerated));
                return Err(format!(
                    "{executor} takes {subject} for late by {tolerated}, and does nothing before: declare `late` of at least {tolerated} here, or shorten \
                     it with {executor}"
                ));
            }
            let sum = self.sum(first.0, first.1, depth - 1)?;
            return Ok(sum.and_then(self.sum(own, Condition::Stopped, depth - 1)?));
        }
        if let Some(why) = unnoticed(at, condition) {
            return Err(why);
        }
        let sums = at.outputs().map(|output| of_guard(at, output, condition));
        if let Some(worst) = sums.max_by_key(Sum::total) {
            return Ok(worst);
        }
        of_requirement(at, condition)
    }

    /// Returns both contracts of a chain: that of the executor, with its condition, and that of the application about
    /// the executor.
    fn chain(
        self,
        at: At<'r>,
        executor: &str,
        condition: Condition,
        depth: usize,
    ) -> Result<((At<'r>, Condition), At<'r>), String> {
        let ContractReport { app, app_name, subject, .. } = at.contract;
        if depth == 0 {
            return Err(format!(
                "the chain through {executor} has more than {CHAIN_MAX} steps, or is a circle"
            ));
        }
        let all = self.0.iter();
        let mut of_subject = all
            .flat_map(|report| report.contracts.iter().map(move |contract| At { report, contract }))
            .filter(|first| first.contract.app_name == executor && first.contract.subject == *subject)
            .filter_map(|first| {
                Some((first, first.contract.conditions().find(|other| is_same(*other, condition))?))
            });
        let first = of_subject.next().ok_or_else(|| {
            format!(
                "{executor} has no contract for {subject} being {}: declare one with {executor}",
                word(condition)
            )
        })?;
        if let Some((other, _)) = of_subject.find(|(other, _)| other.contract.app != first.0.contract.app) {
            let (one, other) = (first.0.contract.app, other.contract.app);
            return Err(format!(
                "{one} and {other} are both called {executor}, so `through` names no single application: give each a name of its own"
            ));
        }
        let of_executor = Subject::Application(executor.to_owned());
        // Of its own node's report: another node cannot declare it.
        let report = at.report;
        let own = report.contracts.iter().map(|contract| At { report, contract }).find(|own| {
            let own = own.contract;
            own.app == *app && own.stopped && own.subject == of_executor
        });
        let own = own.ok_or_else(|| {
            format!("{app_name} has no contract for {executor} being stopped: declare it, as {executor} sends nothing in its state")
        })?;
        Ok((first, own))
    }

    /// Returns the time of the dry runs, from the begin of the condition; `None` if one of them is missing.
    fn measured(self, at: At<'r>, condition: Condition, depth: usize) -> Option<Duration> {
        if let Some(executor) = &at.contract.through {
            let (first, own) = self.chain(at, executor, condition, depth).ok()?;
            let first = self.measured(first.0, first.1, depth - 1)?;
            return Some(first + self.measured(own, Condition::Stopped, depth - 1)?);
        }
        let times: Option<Vec<_>> = at.outputs().map(|output| output.measured_us).collect();
        let longest = Duration::from_micros(times?.into_iter().max()?);
        Some(longest.saturating_sub(late_by(condition)))
    }
}

/// Returns the worst time of an output that the subject commands. A command is good up to `age_max` after the echo
/// that it quotes, so it arrives at most `age_max` after it was sent. The output is safe `within` after its arrival. A
/// lateness is at least `age_max` ([`unnoticed`]), so a good command that arrives ends it.
fn of_guard(at: At<'_>, output: &CommandedOutput, condition: Condition) -> Sum {
    let kind = &output.kind_name;
    let limit = |setting: &str, micros| Part {
        name: format!("{setting} of {kind}"),
        time: Duration::from_micros(micros),
        remedy: "shorten it in the type's `Protection`".to_owned(),
    };
    let parts = vec![limit("age_max", output.age_max_us), limit("within", output.within_us), slack(at)];
    let watchdog = Duration::from_micros(output.age_max_us.saturating_add(output.within_us));
    Sum { parts, passed: late_by(condition).min(watchdog) }
}

/// Returns why the guards do not notice this lateness, if they do not: commands up to `age_max` old are good, so an
/// output stays live as long as they arrive.
fn unnoticed(at: At<'_>, condition: Condition) -> Option<String> {
    let Condition::Late(late) = condition else { return None };
    let oldest = at.outputs().max_by_key(|output| output.age_max_us)?;
    let age_max = Duration::from_micros(oldest.age_max_us);
    (late < age_max).then(|| {
        let (subject, kind, age_max) = (&at.contract.subject, &oldest.kind_name, millis(age_max));
        format!(
            "the guard accepts commands of {kind} up to age_max of {age_max}, so {subject} may stay late by {}: declare `late` of at least {age_max}, or \
             shorten age_max in the type's `Protection`",
            millis(late)
        )
    })
}

/// Returns the worst time of an application that requires the subject, and has a safe state for its loss.
fn of_requirement(at: At<'_>, condition: Condition) -> Result<Sum, String> {
    let ContractReport { app_name, subject, turn_us, own_process, .. } = at.contract;
    let Some(turn) = *turn_us else {
        let place =
            if *own_process { ", as far as the node sees: it is in a process of its own" } else { "" };
        return Err(format!(
            "no output of {app_name} is commanded by {subject}{place}: is it started? Otherwise guard the output (`ctx.guard`), require {subject} with \
             a safe state (`requires`, `safe_state`), or name the application that commands it (`through`)"
        ));
    };
    if let Condition::Late(_) = condition {
        return Err(format!(
            "{app_name} notices the loss of {subject} by its requirement, and no late message: guard an output that {subject} commands, or leave out `late`"
        ));
    }
    let detection = Part {
        name: "detection of a lost node".to_owned(),
        time: Duration::from_micros(at.report.detection_us),
        remedy: "lower ndl.period_ms or ndl.missed_max".to_owned(),
    };
    let turn = Part {
        name: format!("longest turn of {app_name}"),
        time: Duration::from_micros(turn),
        remedy: "shorten it by `progress_within`".to_owned(),
    };
    Ok(Sum { parts: vec![detection, turn, slack(at)], passed: Duration::ZERO })
}

fn slack(at: At<'_>) -> Part {
    let remedy = "lower it, if the dry runs permit that".to_owned();
    Part { name: "contracts.slack_ms".to_owned(), time: at.slack(), remedy }
}

/// Returns the fault of an output if its dry run took longer than the settings allow for.
fn slow_output(at: At<'_>) -> Option<String> {
    at.outputs().find_map(|output| {
        let measured = Duration::from_micros(output.measured_us?);
        let allowed = Duration::from_micros(output.within_us).saturating_add(at.slack());
        (measured > allowed).then(|| {
            format!(
                "its dry run took {}, more than within of {} + contracts.slack_ms = {}: shorten the safe function, let the system grant a real-time \
                 priority (`sinew doctor`), or raise contracts.slack_ms",
                millis(measured),
                output.kind_name,
                millis(allowed)
            )
        })
    })
}

/// Returns whether a contract is about the commander of an output.
fn is_about(contract: &ContractReport, output: &CommandedOutput) -> bool {
    contract.app == output.receiver
        && match &contract.subject {
            Subject::Application(name) => output.sender_name.as_ref() == Some(name),
            Subject::Node(name) => output.sender_node.as_ref() == Some(name),
            Subject::SenderOf(kind) => output.kind_name == *kind,
        }
}

/// Returns the conditions of an output's commander without a contract, if there are any.
fn gap(report: &ContractsReport, output: &CommandedOutput) -> Option<Gap> {
    let own = report.contracts.iter().filter(|contract| is_about(contract, output));
    let covered: Vec<_> = own.flat_map(ContractReport::conditions).map(word).collect();
    let mut conditions = vec!["lost", "late", "stopped"];
    conditions.retain(|condition| !covered.contains(condition));
    if conditions.is_empty() {
        return None;
    }
    let app = output.receiver_name.clone().unwrap_or_else(|| output.receiver.to_string());
    let sender = output.sender_name.clone().unwrap_or_else(|| output.sender.to_string());
    let conditions_text = conditions.join(", ");
    let kind = &output.kind_name;
    let fault = if output.sender_name.is_some() {
        format!(
            "{app} obeys {sender} by {kind}, and has no contract for {sender} being {conditions_text}: declare \
             `Contract::when_lost(\"{sender}\").or_late(TIME).or_stopped().goes_to(STATE, TIME)` with its `AppSpec`; the first TIME is at least {}",
            millis(Duration::from_micros(output.age_max_us))
        )
    } else {
        format!(
            "{app} obeys {sender} by {kind}, of which the name is not known now, so no contract by name covers it: check again when that application \
             and its node are there"
        )
    };
    Some(Gap {
        node: report.name.clone(),
        app,
        sender,
        kind_name: output.kind_name.clone(),
        conditions,
        fault: capped(fault),
    })
}

/// Returns a text of at most `TEXT_MAX` bytes.
fn capped(mut text: String) -> String {
    if text.len() > TEXT_MAX {
        let end = (0..=TEXT_MAX).rev().find(|end| text.is_char_boundary(*end));
        text.truncate(end.unwrap_or_default());
        text.shrink_to_fit();
    }
    text
}

const fn word(condition: Condition) -> &'static str {
    match condition {
        Condition::Lost => "lost",
        Condition::Late(_) => "late",
        Condition::Stopped => "stopped",
    }
}

fn is_same(one: Condition, other: Condition) -> bool {
    word(one) == word(other)
}

/// Returns the lateness of a condition; zero for the others.
const fn late_by(condition: Condition) -> Duration {
    match condition {
        Condition::Late(time) => time,
        Condition::Lost | Condition::Stopped => Duration::ZERO,
    }
}
