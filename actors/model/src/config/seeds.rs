//! Addresses that are always queried for other nodes.

use std::{
    fmt,
    net::{SocketAddr, SocketAddrV6},
    str::FromStr,
};

use super::interfaces::{Zone, zoned};

/// A UDP address that is always queried.
///
/// A link-local IPv6 address belongs to a different host on each link. It is queried over the interface of
/// the name `zone`, or over each one, if there is none.
///
/// # Examples
///
/// ```
/// # use sinew::config::Seed;
/// let seed: Seed = "[fe80::1%eth0]:6911".parse().unwrap();
/// assert_eq!((seed.zone.as_deref(), seed.address.port()), (Some("eth0"), 6911));
/// assert_eq!("10.0.0.7:6911".parse(), Ok(Seed::from(([10, 0, 0, 7], 6911))));
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Seed {
    /// Address and port.
    pub address: SocketAddr,
    /// Name or number of the interface over which it is queried, 1 to 15 bytes; for IPv6 alone.
    pub zone: Option<String>,
}

/// Why a text is not a valid seed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("it is no address with a port, as in 192.168.1.7:6911, [fd00::7]:6911 or [fe80::7%eth0]:6911")]
pub struct SeedError;

impl FromStr for Seed {
    type Err = SeedError;

    fn from_str(text: &str) -> Result<Self, SeedError> {
        let Some((address, port)) = text.strip_prefix('[').and_then(|text| text.split_once("]:")) else {
            let address: SocketAddr = text.parse().map_err(|_| SeedError)?;
            return Ok(address.into());
        };
        let (address, zone) = zoned(address).ok_or(SeedError)?;
        // The standard library accepts a sign before the number; it is certainly a mistake.
        let is_number = port.bytes().all(|byte| byte.is_ascii_digit());
        let port = port.parse().ok().filter(|_| is_number).ok_or(SeedError)?;
        Ok(Self { address: SocketAddrV6::new(address, port, 0, 0).into(), zone })
    }
}

impl<T: Into<SocketAddr>> From<T> for Seed {
    fn from(address: T) -> Self {
        match address.into() {
            SocketAddr::V6(address) => {
                let zone = (address.scope_id() != 0).then(|| address.scope_id().to_string());
                Self { address: SocketAddrV6::new(*address.ip(), address.port(), 0, 0).into(), zone }
            }
            address @ SocketAddr::V4(_) => Self { address, zone: None },
        }
    }
}

impl fmt::Display for Seed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.address {
            SocketAddr::V6(address) if self.zone.is_some() => {
                write!(f, "[{}{}]:{}", address.ip(), Zone(&self.zone), address.port())
            }
            address @ (SocketAddr::V4(_) | SocketAddr::V6(_)) => address.fmt(f),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn seed_is_address_with_port_and_ipv6_interface() {
        for text in ["10.0.0.7:6911", "[fd00::7]:6911", "[fe80::7%eth0]:6911", "[fe80::7%3]:1", "[::1]:65535"]
        {
            assert_eq!(text.parse::<Seed>().map(|seed| seed.to_string()), Ok(text.to_owned()));
        }
        for text in [
            "",
            "10.0.0.7",
            "fd00::7:6911",
            "[fd00::7]",
            "[fd00::7]:",
            "[fd00::7]:+1",
            "[fd00::7]:65536",
            "[fe80::7%]:1",
            "[fe80::7%a b]:1",
            "[10.0.0.7]:1",
            "[10.0.0.7%eth0]:1",
            "10.0.0.7%eth0:1",
            "[fe80::7%eth0%1]:1",
            "eth0:1",
        ] {
            assert_eq!(text.parse::<Seed>(), Err(SeedError), "{text:?}");
        }
    }

    proptest! {
        #[test]
        fn any_text_is_a_round_tripping_seed_or_none(text in r"[\[\]a-f0-9:.%et]{0,24}|\PC{0,40}") {
            if let Ok(seed) = text.parse::<Seed>() {
                prop_assert_eq!(seed.to_string().parse::<Seed>(), Ok(seed));
            }
        }
    }
}
