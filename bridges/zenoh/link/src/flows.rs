//! The flows that this host began: their answers may come in.

use std::{collections::BTreeMap, net::Ipv4Addr};

use crate::Protocol;

/// Maximum number of known flows. A node has three connections and one socket for discovery with each member.
pub const FLOWS_MAX: usize = 16_384;

/// The ends of a flow.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Flow {
    pub(crate) protocol: Protocol,
    pub(crate) local_port: u16,
    pub(crate) remote: Ipv4Addr,
    pub(crate) remote_port: u16,
}

/// The flows, ordered by their last outgoing packet.
#[derive(Debug, Default)]
pub(crate) struct Flows {
    known: BTreeMap<Flow, u64>,
    by_use: BTreeMap<u64, Flow>,
    uses: u64,
}

impl Flows {
    /// Records an outgoing packet. // spec: ZLINK-2.1
    pub(crate) fn sent(&mut self, flow: Flow) {
        self.uses += 1;
        if let Some(former) = self.known.insert(flow, self.uses) {
            self.by_use.remove(&former);
        } else if self.known.len() > FLOWS_MAX
            && let Some((_, oldest)) = self.by_use.pop_first()
        {
            self.known.remove(&oldest);
        }
        self.by_use.insert(self.uses, flow);
    }

    pub(crate) fn contains(&self, flow: &Flow) -> bool {
        self.known.contains_key(flow)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flow(number: usize) -> Flow {
        let [.., high, low] = number.to_be_bytes();
        let remote = Ipv4Addr::new(10, 99, high, low);
        Flow { protocol: Protocol::Tcp, local_port: 40_000, remote, remote_port: 6_912 }
    }

    #[test]
    fn flow_unused_for_longest_makes_room() {
        let mut flows = Flows::default();
        (0..FLOWS_MAX).for_each(|number| flows.sent(flow(number)));
        flows.sent(flow(0));
        flows.sent(flow(FLOWS_MAX));
        assert!(flows.contains(&flow(0)), "it was used again");
        assert!(!flows.contains(&flow(1)));
        assert!(flows.contains(&flow(FLOWS_MAX)));
        assert_eq!((flows.known.len(), flows.by_use.len()), (FLOWS_MAX, FLOWS_MAX));
    }

    #[test]
    fn flow_with_other_end_is_unknown() {
        let mut flows = Flows::default();
        flows.sent(flow(1));
        assert!(!flows.contains(&Flow { protocol: Protocol::Udp, ..flow(1) }));
        assert!(!flows.contains(&Flow { local_port: 22, ..flow(1) }));
        assert!(!flows.contains(&Flow { remote_port: 6_911, ..flow(1) }));
    }
}
