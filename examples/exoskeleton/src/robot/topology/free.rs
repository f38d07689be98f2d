//! A topology for one run on this host, separate from those of all other runs.

use std::io;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::path::PathBuf;
use std::time::Duration;

use exoskeleton_model::joint::Joint;
use exoskeleton_model::part::Part;
use sinew::NodeAddress;

use super::{Control, ControlThread, Discovery, DrivePlace, NodePlace, PlantPlace, ReleaseBy, Topology};

/// A topology on loopback with a project name, a multicast port, a plant port and sockets of its own.
///
/// # Errors
/// The system has no free UDP port.
pub fn for_this_host(seed: u64) -> io::Result<Topology> {
    let id = std::process::id();
    // Both are held at once, so that they differ. If another process takes one before the nodes do, they
    // report that at their start.
    let free_port = || UdpSocket::bind((Ipv4Addr::LOCALHOST, 0));
    let (query, plant) = (free_port()?, free_port()?);
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

/// `sinew` finds `/tmp/sinew-*.sock` by itself. Not in the run folder: the path of a socket has at most 107
/// bytes, and Sinew accepts 100.
fn socket_path(id: u32, part: Part) -> PathBuf {
    std::env::temp_dir().join(format!("sinew-exoskeleton-{id}-{part}.sock"))
}
