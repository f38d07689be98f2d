//! Parameters of applications as the parameter services of nodes of ROS 2. The application decides about each set.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::{Arc, mpsc},
    time::Duration,
};

use sinew::{
    Endpoint, NodeApi, Registration,
    client::ApiError,
    parameters::{
        AskParameters, NamedValue, PARAMETERS_MAX, ParameterList, ParameterOutcome, ParameterReport,
        SetParameters, Value as Tuned,
    },
};
use sinew_ros2_core::{Service, Value, mapping::ParameterRule};
use tracing::warn;
use zenoh::query::Queryable;

use crate::{
    counts::Counts,
    graph::Graph,
    load::Services,
    service::{Request, Requests, serve},
};

/// Time between two looks at the connection with the node.
const POLLED_EVERY: Duration = Duration::from_millis(200);
/// Time limit of the registration: the other requests wait meanwhile.
const REGISTERED_WITHIN: Duration = Duration::from_secs(1);
/// Time limit for the answer of an application. It applies a set at its next tick, or refuses it within 1 s.
const ANSWERED_WITHIN: Duration = Duration::from_secs(2);

/// Types of a `ParameterValue`.
const NOT_SET: u64 = 0;
const BOOL: u64 = 1;
const INTEGER: u64 = 2;
const DOUBLE: u64 = 3;
/// Lists of a `ParameterValue`, which no parameter of Sinew has.
const LISTS: usize = 5;

/// The act of a service, for an application.
#[derive(Clone, Debug)]
pub(crate) struct Act {
    sort: Sort,
    rule: Arc<ParameterRule>,
}

#[derive(Clone, Copy, Debug)]
enum Sort {
    List,
    Describe,
    Get,
    Types,
    Set,
    SetAll,
}

/// Declares a node of ROS 2 for the application of each rule, and its services.
///
/// # Errors
/// The session is closed.
pub(crate) fn declare(
    rules: &[ParameterRule],
    namespace: &str,
    graph: &Graph,
    (services, requests): (&Services, &Requests<Act>),
) -> Result<Vec<Queryable<()>>, String> {
    let mut declared = Vec::new();
    for rule in rules {
        let node = graph.node(namespace, &rule.node)?;
        let rule = Arc::new(rule.clone());
        let all: [(&str, &Service, Sort); 6] = [
            ("list_parameters", &services.list, Sort::List),
            ("describe_parameters", &services.describe, Sort::Describe),
            ("get_parameters", &services.get, Sort::Get),
            ("get_parameter_types", &services.types, Sort::Types),
            ("set_parameters", &services.set, Sort::Set),
            ("set_parameters_atomically", &services.set_all, Sort::SetAll),
        ];
        for (name, service, sort) in all {
            let act = Act { sort, rule: Arc::clone(&rule) };
            let topic = format!("{node}/{name}");
            declared.push(serve((graph, &node), (&topic, service), act, requests.clone())?);
        }
    }
    Ok(declared)
}

/// The endpoints at the nodes of the applications. A node lets only programs at its own socket set parameters.
struct Endpoints {
    name: String,
    all: BTreeMap<PathBuf, Endpoint>,
}

impl Endpoints {
    /// Returns the endpoint at a node. It is registered with the first request.
    fn at(&mut self, socket: &Path) -> Result<&mut Endpoint, String> {
        if !self.all.contains_key(socket) {
            let registration = Registration::new().name(&self.name).deadline(REGISTERED_WITHIN);
            let registered =
                NodeApi::connect(socket).and_then(|node| node.register_transport_address(registration));
            self.all.insert(socket.to_owned(), registered.map_err(|why| why.to_string())?);
        }
        self.all.get_mut(socket).ok_or_else(|| "the node cannot be reached".to_owned())
    }

    /// Keeps the connections, and drops those that have ended.
    fn poll(&mut self) {
        self.all.retain(|_, endpoint| !matches!(endpoint.receive(Duration::ZERO), Err(ApiError::Closed(_))));
    }
}

/// Answers requests until the program ends.
///
/// # Errors
/// The services have ended.
pub(crate) fn run(
    socket: &Path,
    name: &str,
    requests: &mpsc::Receiver<Request<Act>>,
    counts: &Counts,
) -> Result<(), String> {
    let mut endpoints = Endpoints { name: name.to_owned(), all: BTreeMap::new() };
    loop {
        let request = match requests.recv_timeout(POLLED_EVERY) {
            Ok(request) => request,
            Err(mpsc::RecvTimeoutError::Disconnected) => return Err("its services have ended".to_owned()),
            Err(mpsc::RecvTimeoutError::Timeout) => {
                endpoints.poll();
                continue;
            }
        };
        let socket = request.of.rule.socket.as_deref().unwrap_or(socket);
        let answered =
            endpoints.at(socket).and_then(|endpoint| answer(endpoint, &request.of, &request.value));
        match answered {
            Ok(response) => request.reply(&response, counts),
            Err(why) => request.fail(&why, counts),
        }
    }
}

fn answer(endpoint: &mut Endpoint, act: &Act, request: &Value) -> Result<Value, String> {
    let Act { sort, rule } = act;
    let names = request.at(0).map(Value::list).unwrap_or_default();
    if names.len() > PARAMETERS_MAX {
        return Err(format!(
            "a request has at most {PARAMETERS_MAX} names, as an application has parameters"
        ));
    }
    match sort {
        Sort::Set => {
            let results = names.iter().map(|one| set(endpoint, rule, std::slice::from_ref(one)));
            return Ok(Value::Message(vec![Value::List(results.collect())]));
        }
        Sort::SetAll => return Ok(Value::Message(vec![set(endpoint, rule, names)])),
        Sort::List | Sort::Describe | Sort::Get | Sort::Types => {}
    }
    let list: ParameterList = endpoint
        .message(rule.app.as_str(), &AskParameters {})
        .ask(ANSWERED_WITHIN)
        .map_err(|why| format!("{}: {why}", rule.app))?;
    let found = |name: &Value| list.parameters.iter().find(|parameter| parameter.name == name.text());
    let of_each = |of: &dyn Fn(&Value) -> Value| Value::List(names.iter().map(of).collect());
    Ok(match sort {
        Sort::Describe => {
            let one = |name: &Value| found(name).map_or_else(|| unknown(name), |known| describe(known, rule));
            Value::Message(vec![of_each(&one)])
        }
        Sort::Get => {
            let one = |name: &Value| value_of(found(name).map(|known| known.value));
            Value::Message(vec![of_each(&one)])
        }
        Sort::Types => {
            let one = |name: &Value| Value::Unsigned(type_of(found(name).map(|known| known.value)));
            Value::Message(vec![of_each(&one)])
        }
        Sort::List | Sort::Set | Sort::SetAll => {
            let names = listed(&list, names);
            Value::Message(vec![Value::Message(vec![Value::List(names), Value::List(Vec::new())])])
        }
    })
}

/// Returns the names with one of the prefixes; all without a prefix. Names of Sinew have no levels.
fn listed(list: &ParameterList, prefixes: &[Value]) -> Vec<Value> {
    let has_prefix = |name: &str| prefixes.is_empty() || prefixes.iter().any(|prefix| prefix.text() == name);
    let names = list.parameters.iter().map(|parameter| &parameter.name).filter(|name| has_prefix(name));
    names.map(|name| Value::Text(name.clone())).collect()
}

const fn type_of(value: Option<Tuned>) -> u64 {
    match value {
        None => NOT_SET,
        Some(Tuned::Flag(_)) => BOOL,
        Some(Tuned::Integer(_)) => INTEGER,
        Some(Tuned::Number(_)) => DOUBLE,
    }
}

/// Returns a `ParameterValue`.
fn value_of(value: Option<Tuned>) -> Value {
    let (mut flag, mut integer, mut number) = (false, 0, 0.0);
    match value {
        None => {}
        Some(Tuned::Flag(value)) => flag = value,
        Some(Tuned::Integer(value)) => integer = value,
        Some(Tuned::Number(value)) => number = value,
    }
    let mut members = vec![
        Value::Unsigned(type_of(value)),
        Value::Bool(flag),
        Value::Signed(integer),
        Value::Float(number),
        Value::Text(String::new()),
    ];
    members.extend((0..LISTS).map(|_| Value::List(Vec::new())));
    Value::Message(members)
}

/// Returns the value of a `ParameterValue`; `None` for a type that no parameter of Sinew has.
fn tuned(value: &Value) -> Option<Tuned> {
    match (value.at(0)?, value.at(1)?, value.at(2)?, value.at(3)?) {
        (Value::Unsigned(BOOL), Value::Bool(flag), _, _) => Some(Tuned::Flag(*flag)),
        (Value::Unsigned(INTEGER), _, Value::Signed(integer), _) => Some(Tuned::Integer(*integer)),
        (Value::Unsigned(DOUBLE), _, _, Value::Float(number)) => Some(Tuned::Number(*number)),
        _ => None,
    }
}

/// Returns a `ParameterDescriptor`.
fn describe(known: &ParameterReport, rule: &ParameterRule) -> Value {
    let ParameterReport { name, description, unit, value, min, max, slope_per_s, .. } = known;
    let unit = if unit.is_empty() { String::new() } else { format!(" [{unit}]") };
    let slope = slope_per_s.map(|slope| format!("moves by at most {slope} a second")).unwrap_or_default();
    let (mut floats, mut integers) = (Vec::new(), Vec::new());
    match (min, max) {
        (Some(Tuned::Number(min)), Some(Tuned::Number(max))) => {
            floats.push(Value::Message(vec![Value::Float(*min), Value::Float(*max), Value::Float(0.0)]));
        }
        (Some(Tuned::Integer(min)), Some(Tuned::Integer(max))) => {
            integers.push(Value::Message(vec![Value::Signed(*min), Value::Signed(*max), Value::Unsigned(1)]));
        }
        // A flag has no range.
        _ => {}
    }
    descriptor(
        (name, type_of(Some(*value))),
        (format!("{description}{unit}"), slope),
        !rule.writes.contains(name),
        (floats, integers),
    )
}

fn unknown(name: &Value) -> Value {
    descriptor((name.text(), NOT_SET), Default::default(), true, Default::default())
}

fn descriptor(
    (name, of): (&str, u64),
    (description, constraints): (String, String),
    is_read_only: bool,
    (floats, integers): (Vec<Value>, Vec<Value>),
) -> Value {
    Value::Message(vec![
        Value::Text(name.to_owned()),
        Value::Unsigned(of),
        Value::Text(description),
        Value::Text(constraints),
        Value::Bool(is_read_only),
        // The type never changes.
        Value::Bool(false),
        Value::List(floats),
        Value::List(integers),
    ])
}

/// Sets all of these parameters, or none. Returns a `SetParametersResult`.
fn set(endpoint: &mut Endpoint, rule: &ParameterRule, parameters: &[Value]) -> Value {
    let done = named(rule, parameters).and_then(|values| apply(endpoint, &rule.app, values));
    if let Err(why) = &done {
        warn!("refused to set parameters of {}: {why}", rule.app);
    }
    let reason = done.as_ref().err().cloned().unwrap_or_default();
    Value::Message(vec![Value::Bool(done.is_ok()), Value::Text(reason)])
}

fn named(rule: &ParameterRule, parameters: &[Value]) -> Result<Vec<NamedValue>, String> {
    let of = |parameter: &Value| {
        let name = parameter.at(0).map(Value::text).unwrap_or_default();
        if !rule.writes.iter().any(|write| write == name) {
            let shown: String = name.chars().filter(|character| !character.is_control()).take(64).collect();
            return Err(format!(
                "'{shown}' is read-only for ROS 2: the `writes` of {} in the mapping file of sinew-ros2 lack it",
                rule.app
            ));
        }
        let value = parameter.at(1).and_then(tuned);
        let value = value
            .ok_or_else(|| format!("{name} takes a bool, an integer or a double, and is never unset"))?;
        Ok(NamedValue { name: name.to_owned(), value })
    };
    parameters.iter().map(of).collect()
}

fn apply(endpoint: &mut Endpoint, app: &str, values: Vec<NamedValue>) -> Result<(), String> {
    let set = endpoint.message(app, &SetParameters::Values(values)).ask(ANSWERED_WITHIN);
    match set.map_err(|why| format!("{app}: {why}"))? {
        ParameterOutcome::Applied { .. } => Ok(()),
        ParameterOutcome::Refused { why } => Err(why),
        ParameterOutcome::Held { .. } => {
            Err("a transaction holds the parameters; set them again after it".to_owned())
        }
    }
}

#[cfg(test)]
mod tests {
    use sinew_ros2_core::{Catalog, decode, encode};

    use super::*;

    fn rule() -> ParameterRule {
        let writes = vec!["assistance".to_owned()];
        ParameterRule { app: "knee".to_owned(), node: "knee".to_owned(), socket: None, writes }
    }

    fn report(value: Tuned, range: Option<(Tuned, Tuned)>) -> ParameterReport {
        ParameterReport {
            name: "assistance".to_owned(),
            description: "How it assists.".to_owned(),
            unit: "1".to_owned(),
            value,
            target: value,
            default: value,
            min: range.map(|range| range.0),
            max: range.map(|range| range.1),
            slope_per_s: Some(0.5),
            keep: false,
        }
    }

    #[test]
    fn values_and_descriptors_fit_their_types() {
        let catalog = Catalog::shipped();
        for (value, range) in [
            (Tuned::Flag(true), None),
            (Tuned::Integer(-3), Some((Tuned::Integer(-5), Tuned::Integer(5)))),
            (Tuned::Number(0.5), Some((Tuned::Number(0.0), Tuned::Number(1.0)))),
        ] {
            for (name, message) in [
                ("rcl_interfaces/msg/ParameterValue", value_of(Some(value))),
                ("rcl_interfaces/msg/ParameterDescriptor", describe(&report(value, range), &rule())),
            ] {
                let of = catalog.message(name).expect("a type");
                let bytes = encode(&of, &message).expect("it fits");
                assert_eq!(decode(&of, &bytes), Ok(message), "{name}");
            }
            assert_eq!(tuned(&value_of(Some(value))), Some(value));
        }
        assert_eq!(tuned(&value_of(None)), None);
    }

    #[test]
    fn only_parameters_of_the_rule_are_written() {
        let parameter =
            |name: &str, value| Value::Message(vec![Value::Text(name.to_owned()), value_of(value)]);
        let named = |name: &str, value| named(&rule(), &[parameter(name, value)]);
        assert!(named("assistance", Some(Tuned::Number(0.5))).is_ok());
        assert!(named("torque_max", Some(Tuned::Number(0.5))).expect_err("no right").contains("read-only"));
        assert!(named("assistance", None).expect_err("no value").contains("never unset"));
    }
}
