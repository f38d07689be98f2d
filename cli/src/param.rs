//! `sinew param`: lists the parameters of applications, and sets them while they run.

mod assignment;
mod file;
mod list;
mod together;

use std::path::PathBuf;

use clap::Subcommand;
use serde_json::{Value as Json, json};
use sinew::{
    NodeAddress, Outcome, Payload, Tid,
    client::ApiError,
    message::Rejection,
    parameters::{AskParameters, NamedValue, ParameterList, ParameterOutcome, SetParameters, Value},
};

use crate::{
    Report,
    system::{System, SystemError, in_words},
    table::clean,
};
use assignment::{Assignment, ParameterName};
use sinew_view::AppParameters;

/// The commands of `sinew param`.
#[derive(Debug, Subcommand)]
pub(crate) enum Order {
    /// Shows parameters: value, target while a value moves, unit, range, default, description
    #[command(after_help = r#"Examples:
  sinew param list
  sinew param list knee.drive --json | jq '.apps[].parameters[] | select(.value != .default)'"#)]
    List {
        /// An application's name or TID; without it: every application that has parameters
        app: Option<String>,
    },
    /// Prints the value of one parameter
    #[command(after_help = r#"Examples:
  sinew param get knee.drive.assistance"#)]
    Get {
        /// The application and the parameter, with a dot between them
        #[arg(value_name = "APP.NAME")]
        parameter: ParameterName,
    },
    /// Sets parameters: all of these values, at one tick of the application's loop, or none
    ///
    /// The command prints the tick, or the reason of the refusal. A value that is declared with a slope begins to move
    /// at that tick.
    ///
    /// Values of several applications are one transaction: each applies its values at its first tick at or after one
    /// stated time, half a second later, or none does. The exit code is 1 if they did not all do so, and the command
    /// names each.
    #[command(after_help = r#"Examples:
  sinew param set knee.drive.assistance=0.5
  sinew param set knee.drive.assistance=0.5 knee.drive.damped=true
  sinew param set knee.drive.assistance=0.2 hip.drive.assistance=0.2"#)]
    Set {
        /// The application, the parameter and its value
        #[arg(value_name = "APP.NAME=VALUE", required = true)]
        values: Vec<Assignment>,
    },
    /// Gives the parameters of an application's last set their former values
    ///
    /// Each call goes back one set further, up to the application's start or 16 sets.
    #[command(after_help = r#"Examples:
  sinew param undo knee.drive"#)]
    Undo {
        /// An application's name or TID
        app: String,
    },
    /// Writes the values of parameters to a TOML file
    #[command(after_help = r#"Examples:
  sinew param save walk.toml
  sinew param save knee.toml knee.drive"#)]
    Save {
        /// The file; an existing one is replaced
        file: PathBuf,
        /// Names of applications; without them: every application that has parameters
        apps: Vec<String>,
    },
    /// Sets the values of a file that `save` has written
    ///
    /// The values of one application are one set, and those of up to 16 applications are one transaction, as for `set`:
    /// all are set, or none is. Of more applications each 16 are one.
    #[command(after_help = r#"Examples:
  sinew param load walk.toml"#)]
    Load {
        /// The file
        file: PathBuf,
    },
}

/// Carries out the command.
pub(crate) fn show(system: &mut System, order: &Order, is_wide: bool) -> Result<Report, SystemError> {
    match order {
        Order::List { app } => list::show(system, app.as_deref(), is_wide),
        Order::Get { parameter } => get(system, parameter),
        Order::Set { values } => set_all(system, assignment::sets(values)),
        Order::Undo { app } => Ok(SetResult::of(system, app, &SetParameters::Undo)?.report()),
        Order::Save { file, apps } => file::save(system, file, apps),
        Order::Load { file } => file::load(system, file),
    }
}

/// Sets parameters: of one application as a set, of several as a transaction.
fn set_all(system: &mut System, mut sets: Vec<(String, Vec<NamedValue>)>) -> Result<Report, SystemError> {
    match sets.pop() {
        Some((app, values)) if sets.is_empty() => {
            Ok(SetResult::of(system, &app, &SetParameters::Values(values))?.report())
        }
        last => together::set(system, sets.into_iter().chain(last).collect()),
    }
}

fn get(system: &mut System, parameter: &ParameterName) -> Result<Report, SystemError> {
    let ParameterName { app, name } = parameter;
    let to = system.find(app)?;
    let list = ask(system, app, to).map_err(SystemError::Unknown)?;
    let Some(found) = list.parameters.iter().find(|one| one.name == *name) else {
        let (app, name) = (clean(app), clean(name));
        let near = crate::unknown::suggestion(&name, list.parameters.iter().map(|one| one.name.as_str()));
        return Err(SystemError::Unknown(format!(
            "{app} has no parameter '{name}'{near}. `sinew param list {app}` shows all"
        )));
    };
    // Alone, for a pipe.
    Ok(Report { text: format!("{}\n", found.value), json: list::parameter_json(found), is_fine: true })
}

/// The fault of an answer that belongs to no set of one application.
const HELD: &str = "it answered with a state of a transaction: it has another version of Sinew; update both";

/// The result of a set of parameters of one application.
struct SetResult {
    app: String,
    to: Tid,
    /// The outcome, or the reason why there is none.
    outcome: Result<ParameterOutcome, String>,
}

impl SetResult {
    /// Sends a set, and waits for its outcome.
    fn of(system: &mut System, app: &str, set: &SetParameters) -> Result<Self, SystemError> {
        let to = system.find(app)?;
        Ok(Self { app: app.to_owned(), to, outcome: send(system, app, to, set) })
    }

    /// Returns why the set was not applied, or may not have been.
    fn fault(&self) -> Option<&str> {
        match &self.outcome {
            Ok(ParameterOutcome::Applied { .. }) => None,
            Ok(ParameterOutcome::Refused { why }) | Err(why) => Some(why),
            Ok(ParameterOutcome::Held { .. }) => Some(HELD),
        }
    }

    fn text(&self) -> String {
        let app = clean(&self.app);
        let (tick, at_ns, values) = match &self.outcome {
            Ok(ParameterOutcome::Applied { tick, at_ns, values }) => (tick, at_ns, values),
            Ok(ParameterOutcome::Refused { why }) => return format!("{app}: refused: {}\n", clean(why)),
            Ok(ParameterOutcome::Held { .. }) => return format!("{app}: {HELD}\n"),
            Err(why) => return format!("{app}: {}\n", clean(why)),
        };
        let values: Vec<_> =
            values.iter().map(|one| format!("{} = {}", clean(&one.name), one.value)).collect();
        let place = if *tick == 0 { "between two messages".to_owned() } else { format!("at tick {tick}") };
        let (seconds, rest) = (at_ns / 1_000_000_000, at_ns % 1_000_000_000);
        format!(
            "{app}: {}: applied {place}, at {seconds}.{rest:09} s of its host's clock\n",
            values.join(", ")
        )
    }

    fn json(&self) -> Json {
        let (tick, at_ns, values) = match &self.outcome {
            Ok(ParameterOutcome::Applied { tick, at_ns, values }) => (Some(tick), Some(at_ns), &values[..]),
            Ok(ParameterOutcome::Refused { .. } | ParameterOutcome::Held { .. }) | Err(_) => {
                (None, None, &[][..])
            }
        };
        let values = values.iter().map(|one| json!({ "name": one.name, "value": value_json(one.value) }));
        json!({
            "app": self.app, "tid": self.to.to_string(), "tick": tick, "at_ns": at_ns,
            "values": values.collect::<Vec<_>>(), "fault": self.fault(),
        })
    }

    fn report(&self) -> Report {
        Report { text: self.text(), json: self.json(), is_fine: self.fault().is_none() }
    }
}

fn value_json(value: Value) -> Json {
    match value {
        Value::Number(number) => json!(number),
        Value::Integer(integer) => json!(integer),
        Value::Flag(flag) => json!(flag),
    }
}

/// Sends a set. If the application is on another node, which refuses senders elsewhere, it is sent once more through
/// that node's own socket, if this host has it.
fn send(system: &mut System, app: &str, to: Tid, set: &SetParameters) -> Result<ParameterOutcome, String> {
    let sent = request::<_, ParameterOutcome>(system, to, set);
    let is_refused = matches!(sent, Err(ApiError::Ended(Outcome::Rejected(Rejection::NotAllowed))));
    if !is_refused || system.endpoint.tid().node == to.node {
        return sent.map_err(|error| words(&error, app, true));
    }
    let Some(mut own) = enter_node(system, to.node) else {
        return sent.map_err(|error| words(&error, app, true));
    };
    let sent = request::<_, ParameterOutcome>(&mut own, to, set);
    own.leave();
    sent.map_err(|error| words(&error, app, true))
}

/// Sets parameters for the page of `sinew view`. Also returns the lines for the terminal.
pub(crate) fn set(
    system: &mut System,
    app: &str,
    set: &SetParameters,
) -> (Result<ParameterOutcome, String>, String) {
    match SetResult::of(system, app, set) {
        Ok(result) => {
            let text = result.text();
            (result.outcome, text)
        }
        Err(why) => (Err(why.to_string()), format!("{}: {}\n", clean(app), clean(&why.to_string()))),
    }
}

/// Returns the parameters of each application that has some, for the page of `sinew view`.
///
/// # Errors
/// The entry node does not answer.
pub(crate) fn all(system: &mut System) -> Result<Vec<AppParameters>, SystemError> {
    let (listed, silent) = list::all(system)?;
    let mut all: Vec<_> =
        listed.into_iter().map(|one| AppParameters { app: one.app, result: one.result }).collect();
    all.extend(silent.into_iter().map(|node| AppParameters {
        app: node,
        result: Err("its node did not list its applications".to_owned()),
    }));
    Ok(all)
}

/// Registers at the socket of this node, if this host has it.
pub(crate) fn enter_node(system: &mut System, node: NodeAddress) -> Option<System> {
    // A node of another robot on this host may have the same address.
    let incarnation = system.here().ok()?.peers.iter().find(|peer| peer.node == node)?.incarnation;
    let (others, _) = System::beside(system, &[]);
    let mut found = None;
    for mut other in others {
        let is_it = found.is_none()
            && other.endpoint.tid().node == node
            && other.here().is_ok_and(|here| here.incarnation == incarnation);
        if is_it {
            found = Some(other);
        } else {
            other.leave();
        }
    }
    found
}

/// Asks an application for its parameters.
fn ask(system: &mut System, app: &str, to: Tid) -> Result<ParameterList, String> {
    request(system, to, &AskParameters {}).map_err(|error| words(&error, app, false))
}

fn request<Q: Payload, R: Payload>(system: &mut System, to: Tid, question: &Q) -> Result<R, ApiError> {
    let within = system.within;
    system.endpoint.message(to, question).ask::<R>(within)
}

/// Returns why there is no reply, and the remedy.
fn words(error: &ApiError, app: &str, is_set: bool) -> String {
    let app = clean(app);
    if let ApiError::Ended(Outcome::Rejected(Rejection::UnknownKind)) = error {
        return format!("{app} has no parameters: its `AppSpec` declares them by `params`");
    }
    if let ApiError::Ended(Outcome::Rejected(Rejection::NotAllowed)) = error {
        return if is_set {
            format!(
                "the node of {app} takes parameters from operators only, and this command is none. Its access list names operators in [roles]. Without \
                 a list the programs of the node's own user at its own socket are operators, if the node is open and on loopback, else nobody is"
            )
        } else {
            format!(
                "the access list of the node of {app} does not let this command read parameters: name it in `observers` of [roles], or add a [[rule]]"
            )
        };
    }
    if let ApiError::Ended(Outcome::Expired) = error {
        return format!(
            "{app} did not take it in time, and nothing was set; look at `sinew apps` and `sinew tree`"
        );
    }
    if let ApiError::Ended(Outcome::Rejected(
        Rejection::NoSuchApplication | Rejection::Closed | Rejection::Down,
    )) = error
    {
        return format!("{app} has ended, and nothing was set; `sinew tree` shows whether it starts again");
    }
    let why = if let ApiError::NoReply(within) = error {
        format!("no answer within {within:?}")
    } else {
        in_words(error)
    };
    if is_set && may_be_set(error) {
        return format!("{why}; the values may have been set: `sinew param list {app}` shows them");
    }
    why
}

/// Returns whether a set that ended so may have been applied, or will be.
const fn may_be_set(error: &ApiError) -> bool {
    matches!(
        error,
        ApiError::NoReply(_)
            | ApiError::NoAnswer(_)
            | ApiError::Closed(_)
            | ApiError::Ended(Outcome::Unknown | Outcome::Failed)
    )
}

/// Returns the values of a list, without those on their way: their targets.
fn targets(list: &ParameterList) -> Vec<NamedValue> {
    list.parameters.iter().map(|one| NamedValue { name: one.name.clone(), value: one.target }).collect()
}

#[cfg(test)]
mod tests {
    use sinew::AppAddress;

    use super::*;

    fn result(outcome: Result<ParameterOutcome, String>) -> SetResult {
        let to = Tid::new(NodeAddress::new(2), AppAddress::new(0x1001));
        SetResult { app: "knee".to_owned(), to, outcome }
    }

    #[test]
    fn applied_set_names_its_tick_and_time() {
        let values = vec![NamedValue { name: "gain".to_owned(), value: Value::Number(0.5) }];
        let applied = ParameterOutcome::Applied { tick: 12, at_ns: 3_000_000_007, values };
        let report = result(Ok(applied)).report();
        assert!(report.is_fine);
        let text = "knee: gain = 0.5: applied at tick 12, at 3.000000007 s of its host's clock\n";
        assert_eq!(report.text, text);
        assert_eq!(report.json["values"], json!([{ "name": "gain", "value": 0.5 }]));
        assert_eq!((&report.json["tick"], &report.json["fault"]), (&json!(12), &Json::Null));
    }

    #[test]
    fn refused_set_is_a_finding_with_the_reason() {
        let why = "gain = 1.4 is outside 0.0 to 1.0".to_owned();
        let report = result(Ok(ParameterOutcome::Refused { why: why.clone() })).report();
        assert!(!report.is_fine && report.text == format!("knee: refused: {why}\n"), "{}", report.text);
        assert_eq!((&report.json["fault"], &report.json["tick"]), (&json!(why), &Json::Null));
    }

    #[test]
    fn missing_right_is_explained_with_the_remedy() {
        let refused = ApiError::Ended(Outcome::Rejected(Rejection::NotAllowed));
        assert!(words(&refused, "knee", true).contains("[roles]"));
        assert!(words(&refused, "knee", false).contains("observers"));
        let unknown = ApiError::Ended(Outcome::Rejected(Rejection::UnknownKind));
        assert!(words(&unknown, "knee", true).contains("knee has no parameters"));
    }

    #[test]
    fn set_without_a_certain_end_may_have_been_applied() {
        let ended = ApiError::Ended;
        let lost = ApiError::Closed("the node has ended".to_owned());
        let late = ApiError::NoReply(std::time::Duration::from_secs(1));
        for error in [ended(Outcome::Unknown), ended(Outcome::Failed), lost, late] {
            assert!(words(&error, "knee", true).contains("may have been set"), "{error}");
            assert!(!words(&error, "knee", false).contains("may have been set"), "{error}");
        }
        let gone = [Rejection::NoSuchApplication, Rejection::Closed, Rejection::Down, Rejection::QueueFull];
        for certain in gone.map(Outcome::Rejected).into_iter().chain([Outcome::Expired, Outcome::PeerLost]) {
            assert!(!words(&ended(certain), "knee", true).contains("may have been set"), "{certain:?}");
        }
    }
}
