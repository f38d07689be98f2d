//! `sinew param set` for several applications: one transaction.

use std::{collections::BTreeMap, fmt::Write as _, time::Duration};

use serde_json::{Value as Json, json};
use sinew::{
    NodeAddress, Outcome, Tid, Time,
    client::ApiError,
    message::Rejection,
    parameters::{
        Coordinator, NamedValue, ParameterOutcome, PartOutcome, PartReport, Participant, SetParameters, Step,
        TransactionId, TransactionReport, TransactionVerdict,
    },
};

use super::{enter_node, value_json, words};
use crate::{
    Report,
    system::{System, SystemError},
    table::clean,
};

/// Time from the begin to the stated time. Twice the usual one: this command may run beside a loaded robot, with the
/// priority of a shell.
const LEAD: Duration = Duration::from_millis(500);

/// The connections of the command: to its entry node, and to the nodes that take sets through their own sockets alone.
struct Ways<'a> {
    entry: &'a mut System,
    own: BTreeMap<NodeAddress, System>,
}

/// Sets parameters of several applications as one transaction.
pub(super) fn set(system: &mut System, sets: Vec<(String, Vec<NamedValue>)>) -> Result<Report, SystemError> {
    let mut named = Vec::new();
    for (app, values) in sets {
        let mut to = system.find(&app)?;
        if to.node == NodeAddress::HERE {
            to.node = system.endpoint.tid().node;
        }
        named.push((Participant { tid: to.bits(), app }, values));
    }
    let (coordinator, within) = (system.endpoint.tid().bits(), system.within);
    let mut ways = Ways { entry: system, own: BTreeMap::new() };
    // Missing rights, and applications without parameters, are found before anything is held.
    let nothing = SetParameters::Conclude(TransactionId { coordinator, began_ns: 0 });
    for (one, _) in &named {
        if let Err(why) = ways.ask(Tid::from_bits(one.tid), &one.app, &nothing, within) {
            let why = format!("nothing was set: {}: {}\n", clean(&one.app), clean(&why));
            return Ok(Report {
                json: json!({ "verdict": "none", "fault": why.trim_end() }),
                text: why,
                is_fine: false,
            });
        }
    }
    let begun = Coordinator::begin(coordinator, named, (LEAD, within), now());
    let mut transaction = begun.map_err(|why| SystemError::Usage(why.to_string()))?;
    loop {
        match transaction.next(now()) {
            Step::Ask { index, set, within } => {
                let reply = ways.ask_participant(transaction.participant(index), &set, within);
                transaction.answered(reply);
            }
            Step::Wait(until) => std::thread::sleep(until.saturating_sub(now())),
            Step::Done => break,
        }
    }
    ways.own.into_values().for_each(System::leave);
    Ok(report(&transaction.report()))
}

fn now() -> Duration {
    Duration::from_nanos(Time::now().as_nanos())
}

impl Ways<'_> {
    fn ask_participant(
        &mut self,
        participant: Option<&Participant>,
        set: &SetParameters,
        within: Duration,
    ) -> Result<ParameterOutcome, String> {
        let participant = participant.ok_or_else(|| "the transaction has no such application".to_owned())?;
        let app = participant.app.as_str();
        let mut to = Tid::from_bits(participant.tid);
        // One that was restarted may have another TID.
        if !matches!(set, SetParameters::Prepare(_)) && app.parse::<Tid>().is_err() {
            let found = self.entry.endpoint.resolve(app, within).map_err(|why| why.to_string())?;
            to = found.ok_or_else(|| "it has ended".to_owned())?;
        }
        self.ask(to, app, set, within)
    }

    /// Asks an application; if its node refuses senders elsewhere, through its own socket, if this host has it.
    fn ask(
        &mut self,
        to: Tid,
        app: &str,
        set: &SetParameters,
        within: Duration,
    ) -> Result<ParameterOutcome, String> {
        let way = self.own.get_mut(&to.node).unwrap_or(self.entry);
        let reply = way.endpoint.message(to, set).ask(within);
        let is_refused = matches!(reply, Err(ApiError::Ended(Outcome::Rejected(Rejection::NotAllowed))));
        if !is_refused || self.own.contains_key(&to.node) || self.entry.endpoint.tid().node == to.node {
            return reply.map_err(|error| words(&error, app, true));
        }
        let Some(mut way) = enter_node(self.entry, to.node) else {
            return reply.map_err(|error| words(&error, app, true));
        };
        let reply = way.endpoint.message(to, set).ask(within);
        self.own.insert(to.node, way);
        reply.map_err(|error| words(&error, app, true))
    }
}

fn report(of: &TransactionReport) -> Report {
    let mut text: String = of.parts.iter().map(line).collect();
    let count = of.parts.len();
    let has_unknown = of.parts.iter().any(|part| matches!(part.outcome, PartOutcome::Unknown(_)));
    let (verdict, sentence) = match of.verdict {
        TransactionVerdict::All => ("all", format!("set together: {count} applications\n")),
        TransactionVerdict::None if has_unknown => (
            "none",
            "no application that answers has its values; `sinew param list` shows the others when they can be reached\n"
                .to_owned(),
        ),
        TransactionVerdict::None => ("none", "nothing was set\n".to_owned()),
        TransactionVerdict::Repaired => (
            "repaired",
            format!("{count} applications have their values, but not all since the stated time\n"),
        ),
        TransactionVerdict::Mixed => (
            "mixed",
            "some have their values, and others do not, or do not answer: `sinew param list` shows them; set them again, or undo the others\n"
                .to_owned(),
        ),
    };
    text += &sentence;
    let apps = of.parts.iter().map(json_of).collect::<Vec<_>>();
    let json = json!({ "verdict": verdict, "began_ns": of.id.began_ns, "apps": apps });
    Report { text, json, is_fine: of.verdict == TransactionVerdict::All }
}

fn line(part: &PartReport) -> String {
    let app = clean(&part.app);
    let values: Vec<_> =
        part.values.iter().map(|one| format!("{} = {}", clean(&one.name), one.value)).collect();
    let values = values.join(", ");
    let (tick, at_ns, word) = match &part.outcome {
        PartOutcome::Applied { tick, at_ns } => (tick, at_ns, "applied"),
        PartOutcome::Repaired { tick, at_ns } => (tick, at_ns, "applied late, to repair"),
        PartOutcome::Agreed => return format!("{app}: {values}: agreed, and applies at its next tick\n"),
        PartOutcome::Refused(why) => return format!("{app}: not applied: {}\n", clean(why)),
        PartOutcome::Unknown(why) => return format!("{app}: not known: {}\n", clean(why)),
    };
    let place = if *tick == 0 { "between two messages".to_owned() } else { format!("at tick {tick}") };
    let (seconds, rest) = (at_ns / 1_000_000_000, at_ns % 1_000_000_000);
    let mut line = format!("{app}: {values}: {word} {place}, at {seconds}.{rest:09} s of its host's clock");
    if let Some((stated_ns, bound_ns)) = part.stated
        && let Some(after) = at_ns.checked_sub(stated_ns)
    {
        let ms = |ns: u64| ns as f64 / 1e6;
        // Writing to a text does not fail.
        let _ =
            write!(line, ", {:.3} ms after the stated time (known within {:.3} ms)", ms(after), ms(bound_ns));
    }
    line + "\n"
}

fn json_of(part: &PartReport) -> Json {
    let (outcome, at, fault) = match &part.outcome {
        PartOutcome::Applied { tick, at_ns } => ("applied", Some((tick, at_ns)), None),
        PartOutcome::Repaired { tick, at_ns } => ("repaired", Some((tick, at_ns)), None),
        PartOutcome::Agreed => ("agreed", None, None),
        PartOutcome::Refused(why) => ("refused", None, Some(why)),
        PartOutcome::Unknown(why) => ("unknown", None, Some(why)),
    };
    let values = part.values.iter().map(|one| json!({ "name": one.name, "value": value_json(one.value) }));
    json!({
        "app": part.app, "outcome": outcome, "tick": at.map(|(tick, _)| tick), "at_ns": at.map(|(_, at)| at),
        "stated_ns": part.stated.map(|(stated, _)| stated), "bound_ns": part.stated.map(|(_, bound)| bound),
        "values": values.collect::<Vec<_>>(), "fault": fault,
    })
}

#[cfg(test)]
mod tests {
    use sinew::parameters::Value;

    use super::*;

    fn part(app: &str, outcome: PartOutcome) -> PartReport {
        let values = vec![NamedValue { name: "gain".to_owned(), value: Value::Number(0.2) }];
        PartReport { app: app.to_owned(), values, stated: Some((2_000_000_000, 40_000)), outcome }
    }

    fn report_of(verdict: TransactionVerdict, parts: Vec<PartReport>) -> Report {
        report(&TransactionReport { id: TransactionId { coordinator: 1, began_ns: 2 }, verdict, parts })
    }

    #[test]
    fn each_application_has_its_tick_and_lateness() {
        let applied = PartOutcome::Applied { tick: 7, at_ns: 2_000_900_000 };
        let report = report_of(TransactionVerdict::All, vec![part("knee", applied)]);
        let line = "knee: gain = 0.2: applied at tick 7, at 2.000900000 s of its host's clock, 0.900 ms after the stated \
                    time (known within 0.040 ms)\n";
        assert_eq!(report.text, format!("{line}set together: 1 applications\n"));
        assert!(report.is_fine && report.json["apps"][0]["tick"] == json!(7), "{}", report.json);
    }

    #[test]
    fn silent_application_may_have_its_values() {
        let refused = || PartOutcome::Refused("no acceptance".to_owned());
        let of = |outcome| {
            report_of(TransactionVerdict::None, vec![part("knee", refused()), part("hip", outcome)])
        };
        let (certain, open) = (of(refused()), of(PartOutcome::Unknown("no answer".to_owned())));
        assert!(certain.text.ends_with("nothing was set\n") && !certain.is_fine, "{}", certain.text);
        assert!(!open.text.contains("nothing was set") && open.text.contains("param list"), "{}", open.text);
    }

    #[test]
    fn mixed_transaction_is_a_finding_that_names_each() {
        let applied = PartOutcome::Applied { tick: 7, at_ns: 2_000_900_000 };
        let unknown = PartOutcome::Unknown("no answer".to_owned());
        let report = report_of(TransactionVerdict::Mixed, vec![part("knee", applied), part("hip", unknown)]);
        assert!(!report.is_fine && report.text.contains("hip: not known: no answer\n"), "{}", report.text);
        assert_eq!(report.json["verdict"], json!("mixed"));
    }
}
