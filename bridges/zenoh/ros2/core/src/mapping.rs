//! The mapping file: which messages of Sinew become topics of ROS, which topics become commands, and all else that the
//! bridge offers.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::PathBuf,
    sync::Arc,
    time::Duration,
};

use serde::Deserialize;

use crate::{
    catalog::{Catalog, Structure},
    convert::to_ros,
    incoming::{Fields, Incoming, Receiver, SealLimits, SendClass, Sending},
    name::{PART_BYTES_MAX, check_topic, is_word},
    outgoing::{Input, Outgoing},
    path::{Expression, Path, Target},
    payload::Payload,
    value::Value,
};

/// Maximum bytes of the file.
pub const FILE_BYTES_MAX: usize = 262_144;
/// Maximum rules of each sort.
const RULES_MAX: usize = 64;
/// Maximum messages from which one topic is made.
const INPUTS_MAX: usize = 32;
/// Maximum fields of a message in a rule.
const FIELDS_MAX: usize = 256;
/// Maximum number of routers.
const ROUTERS_MAX: usize = 16;
/// Rates in Hz.
const RATES: std::ops::RangeInclusive<f64> = 0.01..=1_000.0;
/// Domains of ROS 2.
const DOMAIN_MAX: u32 = 232;
/// Times in milliseconds.
const TIME_MS_MAX: u64 = 60_000;
/// Fixed addresses of applications.
const ADDRESSES: std::ops::RangeInclusive<u32> = 0x1000..=0x7fff_ffff;
/// Names of Sinew: of applications, groups and types.
const NAME_BYTES_MAX: usize = 63;
const TYPE_BYTES_MAX: usize = 255;

/// The keys of the file. Unknown ones are refused.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    socket: PathBuf,
    #[serde(default = "app_name")]
    name: String,
    address: Option<u32>,
    routers: Vec<String>,
    #[serde(default)]
    domain: u32,
    #[serde(default = "node_name")]
    node: String,
    #[serde(default = "root")]
    namespace: String,
    messages: Option<PathBuf>,
    #[serde(default)]
    watched: Vec<String>,
    #[serde(default)]
    to_ros: Vec<ToRos>,
    #[serde(default)]
    from_ros: Vec<FromRos>,
    #[serde(default)]
    parameters: Vec<ParameterRule>,
    stop: Option<StopRule>,
    #[serde(default)]
    diagnostics: bool,
    #[serde(default)]
    tls: Tls,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ToRos {
    topic: String,
    #[serde(rename = "type")]
    type_name: String,
    rate_hz: f64,
    #[serde(default = "max_age_ms")]
    max_age_ms: u64,
    #[serde(default)]
    set: BTreeMap<String, toml::Value>,
    from: Vec<FromApp>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FromApp {
    app: String,
    sinew: String,
    fields: BTreeMap<String, String>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FromRos {
    topic: String,
    #[serde(rename = "type")]
    type_name: String,
    rate_hz: f64,
    max_age_ms: Option<u64>,
    sinew: String,
    to: Option<String>,
    group: Option<String>,
    class: Option<SendClass>,
    protected: Option<SealLimits>,
    #[serde(default)]
    fields: BTreeMap<String, String>,
    #[serde(default)]
    set: BTreeMap<String, toml::Value>,
}

/// An application with parameters that ROS sees, as those of a node.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ParameterRule {
    /// The name of the application.
    pub app: String,
    /// The name of the node of ROS.
    pub node: String,
    /// The socket of the application's node, if it is another one than that of the file.
    pub socket: Option<PathBuf>,
    /// Those that ROS may set; the others are read-only.
    #[serde(default)]
    pub writes: Vec<String>,
}

/// The service that presses the stop of the whole system.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StopRule {
    /// The name of the service.
    pub service: String,
    /// Time in which nodes confirm.
    #[serde(default = "within_ms")]
    pub within_ms: u64,
}

/// Certificates for routers with `tls/` addresses, as paths of PEM files.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tls {
    /// Authority of the routers' certificates; left out: the public authorities.
    pub root_ca_certificate: Option<String>,
    /// Certificate of this host, for routers that require one.
    pub connect_certificate: Option<String>,
    /// Private key of that certificate.
    pub connect_private_key: Option<String>,
}

fn app_name() -> String {
    "ros2".to_owned()
}

fn node_name() -> String {
    "sinew".to_owned()
}

fn root() -> String {
    "/".to_owned()
}

const fn max_age_ms() -> u64 {
    500
}

const fn within_ms() -> u64 {
    500
}

/// A checked mapping.
#[derive(Clone, Debug)]
pub struct Mapping {
    /// The socket of the node: its `lncl.socket`.
    pub socket: PathBuf,
    /// The name of the application that sends the commands.
    pub name: String,
    /// Its fixed address: a guard is for one sender.
    pub address: Option<u32>,
    /// The Zenoh endpoints of the routers. One is used at a time.
    pub routers: Vec<String>,
    /// Certificates for them.
    pub tls: Tls,
    /// The domain: `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// The name of the node of ROS.
    pub node: String,
    /// Its namespace.
    pub namespace: String,
    /// Namespaces of topics in which each message without a rule is refused, and counted.
    pub watched: Vec<String>,
    /// Topics that are published.
    pub to_ros: Vec<Outgoing>,
    /// Topics with commands.
    pub from_ros: Vec<Incoming>,
    /// Applications with parameters that are served.
    pub parameters: Vec<ParameterRule>,
    /// The service of the stop.
    pub stop: Option<StopRule>,
    /// Whether the counts are published on `/diagnostics`.
    pub diagnostics: bool,
}

/// A mapping file with known keys. Its rules are not checked yet.
#[derive(Clone, Debug)]
pub struct MappingFile(File);

impl MappingFile {
    /// Reads the text of a file.
    ///
    /// # Errors
    /// It is too long, no TOML, or has unknown keys or other types.
    pub fn parse(text: &str) -> Result<Self, String> {
        if text.len() > FILE_BYTES_MAX {
            return Err(format!("it has {} bytes, more than {FILE_BYTES_MAX}", text.len()));
        }
        toml::from_str(text).map(Self).map_err(|why| why.to_string())
    }

    /// Returns the folder with definitions of messages, if the file names one.
    #[must_use]
    pub const fn messages(&self) -> Option<&PathBuf> {
        self.0.messages.as_ref()
    }

    /// Checks all rules against the definitions.
    ///
    /// # Errors
    /// All faults, each with its place in the file.
    pub fn check(self, catalog: &Catalog) -> Result<Mapping, Vec<String>> {
        let Self(file) = self;
        let mut faults = Faults(Vec::new());
        faults.check_head(&file);
        let mut topics = BTreeSet::new();
        let to_ros = file.to_ros.into_iter().enumerate().filter_map(|(at, rule)| {
            let place = format!("to_ros[{at}] ({})", rule.topic);
            faults.check(topics.insert(rule.topic.clone()), &place, "another rule has this topic");
            outgoing(rule, catalog).map_err(|why| faults.add(&place, &why)).ok()
        });
        let to_ros: Vec<_> = to_ros.collect();
        let from_ros = file.from_ros.into_iter().enumerate().filter_map(|(at, rule)| {
            let place = format!("from_ros[{at}] ({})", rule.topic);
            faults.check(topics.insert(rule.topic.clone()), &place, "another rule has this topic");
            incoming(rule, catalog).map_err(|why| faults.add(&place, &why)).ok()
        });
        let from_ros: Vec<_> = from_ros.collect();
        if !faults.0.is_empty() {
            return Err(faults.0);
        }
        Ok(Mapping {
            socket: file.socket,
            name: file.name,
            address: file.address,
            routers: file.routers,
            tls: file.tls,
            domain: file.domain,
            node: file.node,
            namespace: file.namespace,
            watched: file.watched,
            to_ros,
            from_ros,
            parameters: file.parameters,
            stop: file.stop,
            diagnostics: file.diagnostics,
        })
    }
}

struct Faults(Vec<String>);

impl Faults {
    fn add(&mut self, place: &str, why: &str) {
        self.0.push(format!("{place}: {why}"));
    }

    fn check(&mut self, is_good: bool, place: &str, why: &str) {
        if !is_good {
            self.add(place, why);
        }
    }

    fn check_topic(&mut self, name: &str, place: &str) {
        if let Err(why) = check_topic(name) {
            self.add(place, &why.to_string());
        }
    }

    fn check_head(&mut self, file: &File) {
        self.check(is_name(&file.name, NAME_BYTES_MAX), "name", "1 to 63 bytes without control characters");
        let is_fixed = file.address.is_none_or(|address| ADDRESSES.contains(&address));
        self.check(is_fixed, "address", "0x1000 to 0x7fffffff");
        let count = file.routers.len();
        self.check((1..=ROUTERS_MAX).contains(&count), "routers", "1 to 16, such as tcp/127.0.0.1:7447");
        self.check(file.domain <= DOMAIN_MAX, "domain", "0 to 232, the ROS_DOMAIN_ID of the other nodes");
        self.check(is_word(&file.node), "node", "letters, digits and '_', as ROS names a node");
        if file.namespace != "/" {
            self.check_topic(&file.namespace, "namespace");
        }
        let counts = [file.to_ros.len(), file.from_ros.len(), file.parameters.len(), file.watched.len()];
        let places = ["to_ros", "from_ros", "parameters", "watched"];
        for (count, place) in counts.into_iter().zip(places) {
            self.check(count <= RULES_MAX, place, "at most 64");
        }
        let has_rule = counts.iter().any(|count| *count > 0) || file.stop.is_some();
        self.check(has_rule, "file", "it has no rule: to_ros, from_ros, parameters, watched or stop");
        file.watched.iter().for_each(|name| self.check_topic(name, "watched"));
        let mut nodes = BTreeSet::from([file.node.as_str()]);
        for (at, ParameterRule { app, node, writes, socket: _ }) in file.parameters.iter().enumerate() {
            let place = format!("parameters[{at}] ({app})");
            self.check(is_name(app, NAME_BYTES_MAX), &place, "app: 1 to 63 bytes");
            self.check(is_word(node), &place, "node: letters, digits and '_', as ROS names a node");
            self.check(nodes.insert(node), &place, "node: another node has this name");
            self.check(writes.len() <= PART_BYTES_MAX + 1, &place, "writes: at most 64");
        }
        if let Some(StopRule { service, within_ms }) = &file.stop {
            self.check_topic(service, "stop.service");
            self.check((1..=TIME_MS_MAX).contains(within_ms), "stop.within_ms", "1 to 60000");
        }
    }
}

fn is_name(name: &str, bytes_max: usize) -> bool {
    (1..=bytes_max).contains(&name.len()) && !name.contains(char::is_control)
}

fn check_type(name: &str) -> Result<(), String> {
    if name == "sinew" || name.starts_with("sinew.") {
        return Err(format!("sinew: {name} is one of Sinew's own types, which no rule may send or read"));
    }
    if is_name(name, TYPE_BYTES_MAX) { Ok(()) } else { Err("sinew: 1 to 255 bytes".to_owned()) }
}

fn period(rate_hz: f64) -> Result<Duration, String> {
    if RATES.contains(&rate_hz) {
        Ok(Duration::from_secs_f64(1.0 / rate_hz))
    } else {
        Err("rate_hz: 0.01 to 1000".to_owned())
    }
}

fn age(max_age_ms: u64) -> Result<Duration, String> {
    if (1..=TIME_MS_MAX).contains(&max_age_ms) {
        Ok(Duration::from_millis(max_age_ms))
    } else {
        Err("max_age_ms: 1 to 60000".to_owned())
    }
}

fn message(catalog: &Catalog, name: &str) -> Result<Arc<Structure>, String> {
    catalog.message(name).map_err(|why| format!("type: {why}"))
}

fn count(count: usize, max: usize, title: &str) -> Result<(), String> {
    if (1..=max).contains(&count) { Ok(()) } else { Err(format!("{title}: 1 to {max}")) }
}

fn outgoing(rule: ToRos, catalog: &Catalog) -> Result<Outgoing, String> {
    check_topic(&rule.topic).map_err(|why| why.to_string())?;
    let message = message(catalog, &rule.type_name)?;
    let times = (period(rule.rate_hz)?, age(rule.max_age_ms)?);
    count(rule.from.len(), INPUTS_MAX, "from")?;
    let located = |path: &str| Path::parse(path).and_then(|path| Target::locate(&message, &path));
    let constants = rule.set.iter().map(|(path, constant)| constant_of(&located(path)?, path, constant));
    let constants = constants.collect::<Result<Vec<_>, _>>()?;
    let mut inputs = Vec::with_capacity(rule.from.len());
    for FromApp { app, sinew, fields } in rule.from {
        check_type(&sinew)?;
        if !is_name(&app, NAME_BYTES_MAX) {
            return Err("app: 1 to 63 bytes".to_owned());
        }
        count(fields.len(), FIELDS_MAX, "fields")?;
        let fields = fields.iter().map(|(path, text)| Ok((located(path)?, Expression::parse(text)?)));
        inputs.push(Input::new(app, sinew, fields.collect::<Result<_, String>>()?));
    }
    Ok(Outgoing::new(rule.topic, message, inputs, times, constants))
}

fn constant_of(target: &Target, path: &str, constant: &toml::Value) -> Result<(Target, Value), String> {
    let plain = Expression::plain(Path::parse(".")?);
    let value = to_ros(target, &payload_of(constant)?, &plain).map_err(|why| format!("set.{path}: {why}"))?;
    Ok((target.clone(), value))
}

fn payload_of(constant: &toml::Value) -> Result<Payload, String> {
    match constant {
        toml::Value::String(text) => Ok(Payload::Text(text.clone())),
        toml::Value::Integer(number) => Ok(Payload::Integer(*number)),
        toml::Value::Float(number) => Ok(Payload::Float(*number)),
        toml::Value::Boolean(truth) => Ok(Payload::Bool(*truth)),
        toml::Value::Array(values) => {
            values.iter().map(payload_of).collect::<Result<_, _>>().map(Payload::List)
        }
        toml::Value::Datetime(_) | toml::Value::Table(_) => {
            Err("set: numbers, texts, truths and lists of them".to_owned())
        }
    }
}

fn incoming(rule: FromRos, catalog: &Catalog) -> Result<Incoming, String> {
    check_topic(&rule.topic).map_err(|why| why.to_string())?;
    check_type(&rule.sinew)?;
    let message = message(catalog, &rule.type_name)?;
    let times = (period(rule.rate_hz)?, rule.max_age_ms.map(age).transpose()?);
    let to = match (rule.to, rule.group) {
        (Some(app), None) => Receiver::App(app),
        (None, Some(group)) => Receiver::Group(group),
        (Some(_), Some(_)) | (None, None) => return Err("either `to` or `group`".to_owned()),
    };
    let (Receiver::App(name) | Receiver::Group(name)) = &to;
    if !is_name(name, NAME_BYTES_MAX) {
        return Err("to, group: 1 to 63 bytes".to_owned());
    }
    if let Some(limits) = &rule.protected {
        check_limits(limits, &to)?;
    }
    if rule.fields.len() > FIELDS_MAX || rule.set.len() > FIELDS_MAX {
        return Err(format!("fields, set: at most {FIELDS_MAX}"));
    }
    let taken = rule.fields.iter().map(|(path, text)| {
        let expression = Expression::parse(text)?;
        let target = Target::locate(&message, &expression.path)?;
        Ok((names(path)?, target, expression))
    });
    let taken = taken.collect::<Result<_, String>>()?;
    let constants = rule.set.iter().map(|(path, constant)| Ok((names(path)?, payload_of(constant)?)));
    let constants = constants.collect::<Result<_, String>>()?;
    let class = rule.class.unwrap_or_default();
    let sending = Sending { type_name: rule.sinew, to, class, protected: rule.protected };
    Ok(Incoming::new(rule.topic, message, sending, Fields { taken, constants }, times))
}

fn names(path: &str) -> Result<Vec<String>, String> {
    let parsed = Path::parse(path)?;
    let names = parsed.names().ok_or_else(|| format!("'{path}': a field of a command has no index"))?;
    Ok(names.into_iter().map(str::to_owned).collect())
}

fn check_limits(limits: &SealLimits, to: &Receiver) -> Result<(), String> {
    if matches!(to, Receiver::Group(_)) {
        return Err("protected: commands go to one application; write `to`".to_owned());
    }
    let times = [limits.within_ms, limits.age_max_ms];
    let are_times = times.iter().all(|time| (1..=TIME_MS_MAX).contains(&u64::from(*time)));
    if are_times && limits.good_min > 0 {
        Ok(())
    } else {
        Err("protected: within_ms and age_max_ms 1 to 60000, good_min 1 or more: those of the type"
            .to_owned())
    }
}
