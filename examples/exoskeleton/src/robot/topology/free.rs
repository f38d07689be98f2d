//! A topology for one run on this host, separate from those of all other runs.

use std::io;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::path::PathBuf;
use std::time::Duration;

use exoskeleton_model::joint::Joint;
use exoskeleton_model::part::Part;
use sinew::NodeAddress;

use super::{Control, ControlThread, Discovery, DrivePlace, NodePlace, PlantPlace, ReleaseBy, Topology};

/// The first of the ports that are tried. The system gives none of them to a socket that asks for any port
/// (`net.ipv4.ip_local_port_range` of Linux begins at 32,768), so no node takes one by chance before it is used.
const FIRST_PORT: u16 = 20_000;
/// Number of these ports.
const PORTS: u16 = 10_000;
/// Number of ports that are tried.
const TRIES: u16 = 100;

/// A topology on loopback with a project name, a multicast port, a plant port and sockets of its own.
///
/// # Errors
/// None of the tried UDP ports is free.
pub fn for_this_host(seed: u64) -> io::Result<Topology> {
    let id = std::process::id();
    // Both are held at once, so that they differ. If another process takes one before the nodes do, they
    // report that at their start.
    let (query, plant) = (free_port(id)?, free_port(id)?);
    let group = Ipv4Addr::new(239, 255, (id >> 8) as u8, id as u8);
    let node = |part, last| NodePlace {
        address: NodeAddress::from([127, 0, 0, last]),
        interface: Ipv4Addr::LOCALHOST.into(),
        port: 0,
        seeds: Vec::new(),
        socket: Some(socket_path(id, part)),
        state: None,
        drive: DrivePlace::Node,
    };
    Ok(Topology {
        project: format!("exoskeleton-{id}"),
        keys: None,
        discovery: Discovery {
            multicast: Some(SocketAddrV4::new(group, query.local_addr()?.port())),
            mdns: false,
            period: Duration::from_millis(500),
            missed_max: 3,
        },
        control: Control {
            thread: ControlThread::Io,
            realtime_priority: None,
            release: ReleaseBy::Itself,
            record: false,
        },
        record: None,
        central: node(Part::Central, 1),
        joints: [(Joint::Hip, 2), (Joint::Knee, 3), (Joint::Ankle, 4)]
            .map(|(joint, last)| node(Part::Joint(joint), last)),
        plant: PlantPlace { address: plant.local_addr()?, device_watchdog: None, seed, trial: None },
    })
}

/// Returns a socket with a free UDP port. Runs that start one after another try different ones first.
fn free_port(id: u32) -> io::Result<UdpSocket> {
    let first = (id % u32::from(PORTS / 2)) as u16 * 2;
    let ports = (0..TRIES).map(|number| FIRST_PORT + (first + number) % PORTS);
    let mut result = Err(io::ErrorKind::AddrInUse.into());
    for port in ports {
        result = UdpSocket::bind((Ipv4Addr::LOCALHOST, port));
        if result.is_ok() {
            break;
        }
    }
    result
}

/// `sinew` finds `/tmp/sinew-*.sock` by itself. Not in the run folder: the path of a socket has at most 107
/// bytes, and Sinew accepts 100.
fn socket_path(id: u32, part: Part) -> PathBuf {
    std::env::temp_dir().join(format!("sinew-exoskeleton-{id}-{part}.sock"))
}
