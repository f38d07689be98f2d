//! A topology for one run on this host, which never meets another run's.

use std::io;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::path::PathBuf;
use std::time::Duration;

use sinew::NodeAddress;

use super::{Control, ControlThread, Discovery, DrivePlace, NodePlace, PlantPlace, ReleaseBy, Topology};
use crate::joint::Joint;
use crate::part::Part;

/// A topology on loopback with a project name, a multicast port, a plant port and sockets of its own.
///
/// # Errors
/// The system has no free UDP port.
pub fn for_this_host(seed: u64) -> io::Result<Topology> {
    let id = std::process::id();
    // Both held at once, so that they differ. Whoever takes one of them in the moment before the nodes do is met by
    // an error in words at their start.
    let (query, plant) = (free_port()?, free_port()?);
    let group = Ipv4Addr::new(239, 255, (id >> 8) as u8, id as u8);
    let node = |part, last| NodePlace {
        address: NodeAddress::from([127, 0, 0, last]),
        interface: Ipv4Addr::LOCALHOST.into(),
        port: 0,
        seeds: Vec::new(),
        socket: Some(socket_path(id, part)),
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
        control: Control { thread: ControlThread::Io, realtime_priority: None, release: ReleaseBy::Itself },
        central: node(Part::Central, 1),
        joints: [(Joint::Hip, 2), (Joint::Knee, 3), (Joint::Ankle, 4)]
            .map(|(joint, last)| node(Part::Joint(joint), last)),
        plant: PlantPlace { address: plant.local_addr()?, device_watchdog: None, seed, trial: None },
    })
}

fn free_port() -> io::Result<UdpSocket> {
    UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))
}

/// `sinew` finds `/tmp/sinew-*.sock` by itself. Not in the run folder: the path of a socket has at most 107 bytes,
/// of which Sinew takes 100.
fn socket_path(id: u32, part: Part) -> PathBuf {
    std::env::temp_dir().join(format!("sinew-exoskeleton-{id}-{part}.sock"))
}
