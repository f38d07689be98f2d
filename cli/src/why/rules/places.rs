//! The announced addresses of nodes, and the addresses at which others look for them.

use sinew::{
    config::{Interface, Seed},
    inspect::NodeReport,
};

/// Returns whether a node discovers others on its own host only: none of its interfaces leads out of it.
pub(super) fn is_on_loopback(interfaces: &str) -> bool {
    interfaces.split(", ").all(|choice| choice.parse().is_ok_and(|choice: Interface| choice.is_loopback()))
}

/// Returns whether a seed is the announced address of a node. The zone of a link-local address is local to each host,
/// as a name or a number, so it is not compared.
pub(super) fn names(seed: &str, udp: &str) -> bool {
    let at = |text: &str| text.parse::<Seed>().ok().map(|seed| seed.address);
    seed == udp || at(seed).is_some_and(|seed| at(udp) == Some(seed))
}

/// Returns a seed of `of` with the host of the other but not its port: the other takes another port at each start, or
/// the seed is mistyped.
pub(super) fn useless_seed(of: &NodeReport, other: &NodeReport) -> Option<(String, String)> {
    let udp = other.udp.as_ref()?;
    let address = udp.parse::<Seed>().ok()?.address;
    let is_useless = |seed: &&String| {
        let named = seed.parse::<Seed>().ok().map(|seed| seed.address);
        named.is_some_and(|named| named.ip() == address.ip() && named.port() != address.port())
    };
    let seed = of.seeds.iter().find(is_useless)?;
    let detail = format!(
        "the seed {seed} of {} names the host of {} but not its port: it listens at {udp}",
        of.name, other.name
    );
    let port = address.port();
    let fix = format!(
        "with `port = 0` (an ephemeral port) a node takes another one at each start: set [ndl] port in {}, and the same one in the seed; now it is {port}",
        other.name
    );
    Some((detail, fix))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seed_matches_a_node_for_any_interface_name() {
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
    fn loopback_is_recognised_by_each_of_its_names() {
        for interface in ["127.0.0.1", "::1", "::1%lo", "lo/ipv6", "127.0.0.1, ::1%lo"] {
            assert!(is_on_loopback(interface), "{interface}");
        }
        for interface in ["eth0", "all", "fe80::1%eth0", "127.0.0.1, eth0"] {
            assert!(!is_on_loopback(interface), "{interface}");
        }
    }
}
