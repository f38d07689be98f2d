//! Checks that the ports and the socket of a node are free, and finds the process that has one.

use std::{
    fs, io,
    net::{SocketAddr, TcpListener, UdpSocket},
    os::unix::net::UnixStream,
    path::Path,
};

use rustix::net::sockopt::socket_peercred;

use super::super::order::{NodeOrder, Port};

/// Maximum number of processes that are searched.
const PROCESSES_MAX: usize = 100_000;

/// Checks the ports and the socket of a node that does not run. `folder` is its working directory.
pub(super) fn check(order: &NodeOrder, folder: &Path) -> Result<(), String> {
    for port in &order.ports {
        let Port { key, is_udp, address } = port;
        let bound =
            if *is_udp { UdpSocket::bind(address).map(drop) } else { TcpListener::bind(address).map(drop) };
        // A node waits for an address that is missing.
        if bound.is_err_and(|error| error.kind() == io::ErrorKind::AddrInUse) {
            let owner = owner(*is_udp, *address).map_or_else(|| "another process".to_owned(), shown);
            let kind = if *is_udp { "UDP" } else { "TCP" };
            let name = &order.name;
            return Err(format!(
                "{name}: {kind} port {address} is taken by {owner}; end it, or set another {key} in the configuration"
            ));
        }
    }
    let Some(socket) = &order.socket else { return Ok(()) };
    let path = folder.join(socket);
    let Ok(stream) = UnixStream::connect(&path) else { return Ok(()) };
    let owner = socket_peercred(&stream).map(|peer| shown(peer.pid.as_raw_pid()));
    let owner = owner.unwrap_or_else(|_| "another process".to_owned());
    let (name, path) = (&order.name, path.display());
    Err(format!("{name}: the socket {path} is taken by {owner}; end it, or set another lncl.socket"))
}

/// Returns a process as text.
fn shown(pid: i32) -> String {
    let name = fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
    format!("process {pid} ({})", name.trim())
}

/// Returns the process that has this port open, as far as this user may see it.
fn owner(is_udp: bool, address: SocketAddr) -> Option<i32> {
    let family = if address.is_ipv6() { "6" } else { "" };
    let table = format!("/proc/net/{}{family}", if is_udp { "udp" } else { "tcp" });
    let table = fs::read_to_string(table).ok()?;
    let socket = format!("socket:[{}]", inode(&table, address.port())?);
    let processes = fs::read_dir("/proc").ok()?.flatten().take(PROCESSES_MAX);
    let mut pids = processes.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    pids.find(|pid| {
        let open = fs::read_dir(format!("/proc/{pid}/fd")).into_iter().flatten().flatten();
        open.filter_map(|entry| fs::read_link(entry.path()).ok()).any(|link| link.to_str() == Some(&*socket))
    })
}

/// Returns the inode of the first socket that is bound to this port and connected to none.
fn inode(table: &str, port: u16) -> Option<u64> {
    table.lines().skip(1).find_map(|line| {
        let fields: Vec<_> = line.split_whitespace().collect();
        let (local, remote) = (fields.get(1)?, fields.get(2)?);
        let is_local =
            local.rsplit_once(':').is_some_and(|(_, digits)| u16::from_str_radix(digits, 16) == Ok(port));
        let is_open = remote.ends_with(":0000");
        (is_local && is_open).then(|| fields.get(9)?.parse().ok()).flatten()
    })
}

#[cfg(test)]
mod tests {
    use sinew_testkit::until;

    use super::*;
    use crate::up::order::tests::order;

    #[test]
    fn taken_port_is_named_with_its_process() {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback has free ports");
        let address = listener.local_addr().expect("it is bound");
        let port = Port { key: "gncl.port".to_owned(), is_udp: false, address };
        let order = NodeOrder { ports: vec![port], ..order("knee", 1) };
        let why = check(&order, Path::new("/")).expect_err("the port is taken");
        let own = format!("is taken by process {} (", std::process::id());
        assert!(why.starts_with("knee: TCP port 127.0.0.1:") && why.contains(&own), "{why}");
        drop(listener);
        // A program that another test starts has it, too, until its start.
        until("the port is free", || check(&order, Path::new("/")).ok());
    }

    #[test]
    fn inode_is_that_of_the_open_port() {
        let table = "  sl  local_address rem_address   st ...\n\
                     0: 0100007F:1AFF 0100007F:0016 01 0:0 0:0 0 0 0 11 1\n\
                     1: 0100007F:1AFF 00000000:0000 0A 0:0 0:0 0 0 0 12 1\n";
        assert_eq!(inode(table, 0x1AFF), Some(12));
        assert_eq!(inode(table, 7), None);
    }
}
