//! The hosts that announce themselves by liveliness tokens.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt,
    net::Ipv4Addr,
};

/// Maximum number of present hosts.
pub const HOSTS_MAX: usize = 4_096;
/// Maximum number of present instances of one host: a restarted program appears before its former token is
/// gone.
const INSTANCES_MAX: usize = 4;

/// One run of the program on a host, drawn at random.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Instance(pub [u8; 16]);

impl fmt::Display for Instance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Instance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// A change of the present hosts, for the log. It decides nothing: only discovery makes and loses members.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HostFact {
    /// The host has appeared.
    Appeared(Ipv4Addr),
    /// The host has gone, or no router reaches it.
    Disappeared(Ipv4Addr),
    /// Another host has this host's address. Packets for one of them reach both.
    AddressTaken(Instance),
}

/// The change that a token makes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Change {
    /// The first instance of a host.
    Host,
    /// A further instance of a present host.
    Instance,
    /// The token was known.
    None,
    /// There is no room for it.
    Full,
}

/// The present hosts.
#[derive(Debug, Default)]
pub(crate) struct Presence {
    hosts: BTreeMap<Ipv4Addr, BTreeSet<Instance>>,
}

impl Presence {
    pub(crate) fn appear(&mut self, host: Ipv4Addr, instance: Instance) -> Change {
        let is_full = self.hosts.len() >= HOSTS_MAX;
        match self.hosts.get_mut(&host) {
            Some(known) if known.contains(&instance) => Change::None,
            Some(known) if known.len() >= INSTANCES_MAX => Change::Full,
            Some(known) => {
                known.insert(instance);
                Change::Instance
            }
            None if is_full => Change::Full,
            None => {
                self.hosts.insert(host, BTreeSet::from([instance]));
                Change::Host
            }
        }
    }

    /// Returns whether the host's last instance has gone.
    pub(crate) fn disappear(&mut self, host: Ipv4Addr, instance: Instance) -> bool {
        let Some(known) = self.hosts.get_mut(&host) else { return false };
        let is_gone = known.remove(&instance) && known.is_empty();
        if is_gone {
            self.hosts.remove(&host);
        }
        is_gone
    }

    pub(crate) fn hosts(&self) -> impl Iterator<Item = Ipv4Addr> {
        self.hosts.keys().copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOST: Ipv4Addr = Ipv4Addr::new(10, 99, 0, 2);

    #[test]
    fn restarted_host_is_gone_with_its_last_token() {
        let mut presence = Presence::default();
        let [old, new] = [1, 2].map(|byte| Instance([byte; 16]));
        assert_eq!(presence.appear(HOST, old), Change::Host);
        assert_eq!(presence.appear(HOST, old), Change::None);
        assert_eq!(presence.appear(HOST, new), Change::Instance);
        assert!(!presence.disappear(HOST, old));
        assert!(presence.disappear(HOST, new));
        assert!(!presence.disappear(HOST, new), "it has gone already");
        assert_eq!(presence.hosts().count(), 0);
    }

    #[test]
    fn hosts_and_instances_are_bounded() {
        let mut presence = Presence::default();
        for number in 0..u8::try_from(INSTANCES_MAX).expect("a few") {
            assert_ne!(presence.appear(HOST, Instance([number; 16])), Change::Full);
        }
        assert_eq!(presence.appear(HOST, Instance([99; 16])), Change::Full);
        let others = (0..).map(|number: u32| Ipv4Addr::from_bits(0x0a64_0000 + number));
        for host in others.take(HOSTS_MAX - 1) {
            assert_eq!(presence.appear(host, Instance([0; 16])), Change::Host);
        }
        assert_eq!(presence.appear(Ipv4Addr::new(10, 101, 0, 0), Instance([0; 16])), Change::Full);
        assert_eq!(presence.hosts().count(), HOSTS_MAX);
    }
}
