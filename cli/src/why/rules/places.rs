//! Where nodes say that they are, and where others look for them.

use sinew::{
    config::{Interface, Seed},
    inspect::NodeReport,
};

/// Whether a node looks for others on its own host only: none of its interfaces leads out of it.
pub(super) fn is_on_loopback(interfaces: &str) -> bool {
    interfaces.split(", ").all(|choice| choice.parse().is_ok_and(|choice: Interface| choice.is_loopback()))
}

/// Whether a seed is where a node says that it is. The interface behind a link-local address is each host's own: one calls it by its name,
/// another by its number, and it may be another one.
pub(super) fn names(seed: &str, udp: &str) -> bool {
    let at = |text: &str| text.parse::<Seed>().ok().map(|seed| seed.address);
    seed == udp || at(seed).is_some_and(|seed| at(udp) == Some(seed))
}

/// A seed of `of` that names the host of the other and not its port: the other takes another one at each start, or the seed is mistyped.
pub(super) fn useless_seed(of: &NodeReport, other: &NodeReport) -> Option<(String, String)> {
    let udp = other.udp.as_ref()?;
    let address = udp.parse::<Seed>().ok()?.address;
    let is_useless = |seed: &&String| {
        let named = seed.parse::<Seed>().ok().map(|seed| seed.address);
        named.is_some_and(|named| named.ip() == address.ip() && named.port() != address.port())
    };
    let seed = of.seeds.iter().find(is_useless)?;
    let seen = format!(
        "the seed {seed} of {} names the host of {} but not its port: it listens at {udp}",
        of.name, other.name
    );
    let port = address.port();
    let mend = format!(
        "with `port = 0` (an ephemeral port) a node takes another one at each start: set [ndl] port in {}, and the same one in the seed; now it is {port}",
        other.name
    );
    Some((seen, mend))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seed_names_a_node_whatever_the_interface_is_called_on_either_host() {
        for (seed, udp, is_it) in [
            ("[fe80::2%eth0]:6911", "[fe80::2%2]:6911", true),
            ("[fe80::2]:6911", "[fe80::2%2]:6911", true),
            ("[::1%lo]:6911", "[::1]:6911", true),
            ("[fd00::2]:6911", "[fd00:0::2]:6911", true),
            ("[fe80::2%eth0]:6911", "[fe80::2%2]:6912", false),
            ("[fe80::2%eth0]:6911", "[fe80::3%2]:6911", false),
            ("10.0.0.2:7000", "10.0.0.2:7000", true),
            ("10.0.0.2:7000", "10.0.0.3:7000", false),
        ] {
            assert_eq!(names(seed, udp), is_it, "{seed} {udp}");
        }
    }

    #[test]
    fn a_node_on_loopback_is_so_by_each_name_of_it() {
        for interface in ["127.0.0.1", "::1", "::1%lo", "lo/ipv6", "127.0.0.1, ::1%lo"] {
            assert!(is_on_loopback(interface), "{interface}");
        }
        for interface in ["eth0", "all", "fe80::1%eth0", "127.0.0.1, eth0"] {
            assert!(!is_on_loopback(interface), "{interface}");
        }
    }
}
