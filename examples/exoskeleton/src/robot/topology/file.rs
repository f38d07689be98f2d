//! The text form of a topology.

use std::collections::BTreeSet;
use std::fmt::Display;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use exoskeleton_model::joint::Joint;
use exoskeleton_model::part::Part;
use serde::{Deserialize, Serialize};
use sinew::NodeAddress;
use sinew::config::{Interface, Interfaces, Seed};

use super::{
    Control, ControlThread, Discovery, DrivePlace, FlightRecorder, NodePlace, PlantPlace, Topology,
    TopologyError,
};

const OFF: &str = "off";
/// The path of a unix socket has at most 107 bytes; Sinew accepts 100.
const SOCKET_PATH_MAX: usize = 100;
const SEEDS_MAX: usize = 256;

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    project: String,
    /// Directory of the robot's keys.
    keys: Option<PathBuf>,
    #[serde(default)]
    discovery: DiscoveryTable,
    #[serde(default)]
    control: Control,
    record: Option<FlightRecorder>,
    central: NodeTable,
    hip: NodeTable,
    knee: NodeTable,
    ankle: NodeTable,
    plant: PlantTable,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct DiscoveryTable {
    multicast: String,
    mdns: bool,
    period_ms: u64,
    missed_max: u32,
}

impl Default for DiscoveryTable {
    fn default() -> Self {
        Self { multicast: "239.255.83.119:6910".to_owned(), mdns: true, period_ms: 500, missed_max: 3 }
    }
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct NodeTable {
    address: String,
    interface: Option<String>,
    #[serde(default)]
    port: u16,
    #[serde(default)]
    seeds: Vec<String>,
    /// The socket for processes of the same host.
    socket: Option<PathBuf>,
    /// Directory of its state, which outlives it.
    state: Option<PathBuf>,
    /// The process in which the drive runs; at a joint only.
    drive: Option<DrivePlace>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PlantTable {
    address: String,
    device_watchdog_ms: Option<u64>,
    #[serde(default = "first_seed")]
    seed: u64,
    trial: Option<PathBuf>,
}

const fn first_seed() -> u64 {
    1
}

/// Collects faults while reading continues.
#[derive(Default)]
struct Faults(Vec<String>);

impl Faults {
    fn note(&mut self, holds: bool, fault: impl FnOnce() -> String) {
        if !holds {
            self.0.push(fault());
        }
    }

    fn parsed<T: FromStr<Err: Display>>(&mut self, place: &str, text: &str, remedy: &str) -> Option<T> {
        text.parse().map_err(|e| self.0.push(format!("{place} = \"{text}\": {e}; {remedy}"))).ok()
    }
}

pub(super) fn parse(text: &str) -> Result<Topology, TopologyError> {
    let file: File = toml::from_str(text).map_err(|e| TopologyError(vec![e.to_string()]))?;
    let mut faults = Faults::default();
    let project = file.project;
    faults.note((1..=63).contains(&project.len()), || {
        format!("project has {} bytes; give it a name of 1 to 63", project.len())
    });
    let tables = [&file.central, &file.hip, &file.knee, &file.ankle];
    let places: Vec<Option<NodePlace>> =
        Part::ALL.into_iter().zip(tables).map(|(part, table)| node(&mut faults, part, table)).collect();
    let discovery = discovery(&mut faults, &file.discovery);
    check_control(&mut faults, file.control);
    let plant = plant(&mut faults, file.plant);
    check_together(&mut faults, &places, discovery.as_ref());
    let places: Option<Vec<NodePlace>> = places.into_iter().collect();
    let places: Option<[NodePlace; 4]> = places.and_then(|places| places.try_into().ok());
    match (places, discovery, plant) {
        (Some([central, hip, knee, ankle]), Some(discovery), Some(plant)) if faults.0.is_empty() => {
            let joints = [hip, knee, ankle];
            Ok(Topology {
                project,
                keys: file.keys,
                discovery,
                control: file.control,
                record: file.record,
                central,
                joints,
                plant,
            })
        }
        (Some(_) | None, Some(_) | None, Some(_) | None) => Err(TopologyError(faults.0)),
    }
}

fn node(faults: &mut Faults, part: Part, table: &NodeTable) -> Option<NodePlace> {
    let form = "write an IPv4 address, as in 10.0.0.7";
    let address: Option<Ipv4Addr> = faults.parsed(&format!("{part}.address"), &table.address, form);
    let interface: Option<Interfaces> = match &table.interface {
        Some(text) => {
            let form =
                "write an address of its host, as in 10.0.0.7 or fd00::7, or an interface's name, as in eth0";
            let one: Option<Interface> = faults.parsed(&format!("{part}.interface"), text, form);
            one.map(|one| vec![one].into())
        }
        None => address.map(Into::into),
    };
    if let Some(address) = address {
        let single = !address.is_unspecified() && !address.is_broadcast() && !address.is_multicast();
        faults.note(single, || format!("{part}.address = \"{address}\" names no single node"));
    }
    let seeds = seeds(faults, &format!("{part}.seeds"), &table.seeds);
    let socket = table.socket.clone();
    check_socket(faults, part, socket.as_deref());
    faults.note(part != Part::Central || table.drive.is_none(), || {
        "central.drive: central has none; take it out here".to_owned()
    });
    let (state, drive) = (table.state.clone(), table.drive.unwrap_or_default());
    let (address, port) = (NodeAddress::from(address?), table.port);
    Some(NodePlace { address, interface: interface?, port, seeds, socket, state, drive })
}

fn seeds(faults: &mut Faults, place: &str, texts: &[String]) -> Vec<Seed> {
    faults.note(texts.len() <= SEEDS_MAX, || format!("{place} has more than {SEEDS_MAX} entries"));
    let form = "write address:port, as in 10.0.0.7:6911 or [fd00::7]:6911";
    let seeds: Vec<Seed> = texts.iter().filter_map(|text| faults.parsed(place, text, form)).collect();
    faults.note(seeds.iter().all(|seed| seed.address.port() != 0), || {
        format!("{place}: port 0 cannot be asked; set `port` at that node and write it here")
    });
    seeds
}

fn check_socket(faults: &mut Faults, part: Part, socket: Option<&Path>) {
    let Some(path) = socket else { return };
    let length = path.as_os_str().len();
    faults.note((1..=SOCKET_PATH_MAX).contains(&length), || {
        format!("{part}.socket has {length} bytes; a socket's path has 1 to {SOCKET_PATH_MAX}")
    });
}

fn discovery(faults: &mut Faults, table: &DiscoveryTable) -> Option<Discovery> {
    let place = "discovery.multicast";
    let form = "write group:port, as in 239.255.83.119:6910, or \"off\"";
    faults.note((10..=60_000).contains(&table.period_ms), || {
        format!("discovery.period_ms = {} is not within 10 to 60000", table.period_ms)
    });
    faults.note((2..=100).contains(&table.missed_max), || {
        format!("discovery.missed_max = {} is not within 2 to 100", table.missed_max)
    });
    let multicast = match table.multicast.as_str() {
        OFF => None,
        text => Some(faults.parsed::<SocketAddrV4>(place, text, form)?),
    };
    if let Some(group) = multicast {
        let usable = group.ip().is_multicast() && group.port() != 0;
        faults.note(usable, || format!("{place} = \"{group}\" is no multicast group with a port; {form}"));
    }
    let period = Duration::from_millis(table.period_ms);
    Some(Discovery { multicast, mdns: table.mdns, period, missed_max: table.missed_max })
}

fn check_control(faults: &mut Faults, control: Control) {
    let Some(priority) = control.realtime_priority else { return };
    faults.note((1..=89).contains(&priority), || {
        format!("control.realtime_priority = {priority} is not within 1 to 89")
    });
    faults.note(control.thread == ControlThread::Own, || {
        "control.realtime_priority needs control.thread = \"own\": the network must not run at it".to_owned()
    });
}

fn plant(faults: &mut Faults, table: PlantTable) -> Option<PlantPlace> {
    if let Some(ms) = table.device_watchdog_ms {
        faults.note((1..=10_000).contains(&ms), || {
            format!("plant.device_watchdog_ms = {ms} is not within 1 to 10000; leave it out for none")
        });
    }
    let form = "write address:port, as in 10.0.0.9:6920";
    let address: SocketAddr = faults.parsed("plant.address", &table.address, form)?;
    faults.note(address.port() != 0, || "plant.address has port 0, which nobody can send to".to_owned());
    let device_watchdog = table.device_watchdog_ms.map(Duration::from_millis);
    Some(PlantPlace { address, device_watchdog, seed: table.seed, trial: table.trial })
}

/// Checks that concern several nodes at once.
fn check_together(faults: &mut Faults, places: &[Option<NodePlace>], discovery: Option<&Discovery>) {
    let known: Vec<(Part, &NodePlace)> =
        Part::ALL.into_iter().zip(places).filter_map(|(part, place)| Some((part, place.as_ref()?))).collect();
    let mut seen = BTreeSet::new();
    for (part, place) in &known {
        faults.note(seen.insert(place.address), || {
            format!("{part}.address = \"{}\" is another node's already; each needs its own", place.address)
        });
    }
    let on_loopback = known.iter().filter(|(_, place)| place.interface.are_loopback()).count();
    faults.note(on_loopback == 0 || on_loopback == known.len(), || {
        "some nodes are on a loopback interface and others are not; they would never meet".to_owned()
    });
    let Some(discovery) = discovery else { return };
    let seeded = known.iter().filter(|(_, place)| !place.seeds.is_empty()).count();
    // Of n nodes, n - 1 that query are enough; with fewer a node may stay alone.
    faults.note(discovery.multicast.is_some() || discovery.mdns || seeded + 1 >= known.len(), || {
        "discovery.multicast and discovery.mdns are off and too few nodes have seeds: they cannot find each other; \
         switch one on, or list seeds"
            .to_owned()
    });
}

pub(super) fn write(topology: &Topology) -> String {
    let node = |part: Part| {
        let place = topology.place(part);
        NodeTable {
            address: place.address.to_string(),
            interface: Some(place.interface.to_string()),
            port: place.port,
            seeds: place.seeds.iter().map(ToString::to_string).collect(),
            socket: place.socket.clone(),
            state: place.state.clone(),
            drive: (place.drive == DrivePlace::Process && part != Part::Central).then_some(place.drive),
        }
    };
    let (discovery, plant) = (&topology.discovery, &topology.plant);
    let file = File {
        project: topology.project.clone(),
        keys: topology.keys.clone(),
        discovery: DiscoveryTable {
            multicast: discovery.multicast.map_or_else(|| OFF.to_owned(), |group| group.to_string()),
            mdns: discovery.mdns,
            period_ms: discovery.period.as_millis() as u64,
            missed_max: discovery.missed_max,
        },
        control: topology.control,
        record: topology.record.clone(),
        central: node(Part::Central),
        hip: node(Part::Joint(Joint::Hip)),
        knee: node(Part::Joint(Joint::Knee)),
        ankle: node(Part::Joint(Joint::Ankle)),
        plant: PlantTable {
            address: plant.address.to_string(),
            device_watchdog_ms: plant.device_watchdog.map(|limit| limit.as_millis() as u64),
            seed: plant.seed,
            trial: plant.trial.clone(),
        },
    };
    toml::to_string(&file).expect("tables of strings and numbers can be written as TOML")
}
