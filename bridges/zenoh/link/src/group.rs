//! The pace of discovery packets to all hosts.
//!
//! A node queries the discovery group each period. On an Ethernet network that is one packet. Here a router sends
//! a copy to each host. So the link sends these packets more rarely, and at once to a host that appears.

use std::{collections::BTreeMap, time::Duration};

/// Age of the last packet of a port, up to which a host that appears gets it. An older one is of a node that
/// has ended.
pub const GROUP_KEPT: Duration = Duration::from_secs(5);
/// Maximum number of ports with a kept packet: the nodes of one host. A further one replaces the oldest.
const PORTS_MAX: usize = 16;

/// The last packet of one port.
#[derive(Debug)]
struct Last {
    packet: Vec<u8>,
    read_at: Duration,
    sent_at: Duration,
}

/// The last packet to the group of each port.
#[derive(Debug, Default)]
pub(crate) struct Group {
    last: BTreeMap<u16, Last>,
}

impl Group {
    /// Keeps a packet. Returns whether it goes to all hosts now. // spec: ZLINK-3
    pub(crate) fn read(&mut self, now: Duration, port: u16, packet: &[u8], every: Duration) -> bool {
        if let Some(last) = self.last.get_mut(&port) {
            (last.packet, last.read_at) = (packet.to_vec(), now);
            let is_due = now.saturating_sub(last.sent_at) >= every;
            if is_due {
                last.sent_at = now;
            }
            return is_due;
        }
        if self.last.len() >= PORTS_MAX
            && let Some(oldest) = self.last.iter().min_by_key(|(_, last)| last.read_at).map(|(port, _)| *port)
        {
            self.last.remove(&oldest);
        }
        self.last.insert(port, Last { packet: packet.to_vec(), read_at: now, sent_at: now });
        true
    }

    /// Returns the packets for a host that appears. // spec: ZLINK-3.1
    pub(crate) fn recent(&self, now: Duration) -> impl Iterator<Item = &[u8]> {
        let is_recent = move |last: &&Last| now.saturating_sub(last.read_at) <= GROUP_KEPT;
        self.last.values().filter(is_recent).map(|last| &last.packet[..])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn seconds(count: u64) -> Duration {
        Duration::from_secs(count)
    }

    #[test]
    fn each_port_has_its_own_pace() {
        let mut group = Group::default();
        assert!(group.read(seconds(10), 1, b"a", seconds(1)));
        assert!(!group.read(seconds(10), 1, b"b", seconds(1)));
        assert!(group.read(seconds(10), 2, b"c", seconds(1)), "of another node");
        assert!(group.read(seconds(11), 1, b"d", seconds(1)));
        let recent: Vec<_> = group.recent(seconds(11)).collect();
        assert_eq!(recent, [b"d", b"c"]);
    }

    #[test]
    fn packet_of_ended_node_is_not_recent() {
        let mut group = Group::default();
        group.read(seconds(10), 1, b"a", seconds(1));
        assert_eq!(group.recent(seconds(10) + GROUP_KEPT).count(), 1);
        assert_eq!(group.recent(seconds(11) + GROUP_KEPT).count(), 0);
    }

    #[test]
    fn oldest_port_makes_room() {
        let mut group = Group::default();
        for port in 0..=u16::try_from(PORTS_MAX).expect("a few") {
            group.read(seconds(port.into()), port, b"a", seconds(1));
        }
        assert_eq!(group.last.len(), PORTS_MAX);
        assert!(!group.last.contains_key(&0));
    }
}
