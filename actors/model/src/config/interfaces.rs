//! The network interfaces of a host that a node uses.

use std::{
    fmt,
    net::{Ipv4Addr, Ipv6Addr},
    str::FromStr,
};

/// Maximum bytes of an interface's name (`IFNAMSIZ`).
const NAME_BYTES_MAX: usize = 15;
/// The text for every interface.
const ALL: &str = "all";
/// The suffix of a name, or of `all`, that chooses one family of its addresses.
const IPV4_ONLY: &str = "/ipv4";
const IPV6_ONLY: &str = "/ipv6";
/// The system's name of the loopback interface.
const LOOPBACK: &str = if cfg!(any(target_os = "linux", target_os = "android")) { "lo" } else { "lo0" };

/// A choice of network interfaces.
///
/// # Examples
///
/// ```
/// use sinew::config::{Families, Interface};
///
/// assert_eq!("wlan0/ipv4".parse(), Ok(Interface::Name("wlan0".into(), Families::Ipv4)));
/// assert_eq!("10.0.0.7".parse(), Ok(Interface::Address([10, 0, 0, 7].into())));
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Interface {
    /// The interface with this IPv4 address. It is used for as long as the node runs, from when the host has
    /// the address.
    Address(Ipv4Addr),
    /// The interface with this IPv6 address, whenever it has it. Several interfaces may have the same
    /// link-local address; then the one with the name `zone` is meant, if there is one: `fd00::7`,
    /// `fe80::7%eth0`.
    Address6 {
        /// The address.
        address: Ipv6Addr,
        /// The interface's name, 1 to 15 bytes, or its number on this host.
        zone: Option<String>,
    },
    /// The interface with this name, with its addresses, whenever it exists and is up: `eth0`, `eth0/ipv6`. 1
    /// to 15 bytes.
    Name(String, Families),
    /// Each interface but loopback, whenever it exists and is up: `all`, `all/ipv4`.
    All(Families),
}

/// The address families of an interface that are used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Families {
    /// IPv4 and IPv6.
    #[default]
    Both,
    /// IPv4 alone.
    Ipv4,
    /// IPv6 alone.
    Ipv6,
}

impl Families {
    /// Returns whether IPv4 addresses are used.
    #[must_use]
    pub const fn has_ipv4(self) -> bool {
        matches!(self, Self::Both | Self::Ipv4)
    }

    /// Returns whether IPv6 addresses are used.
    #[must_use]
    pub const fn has_ipv6(self) -> bool {
        matches!(self, Self::Both | Self::Ipv6)
    }

    /// Splits a text into the part before the family suffix, and the families that the suffix chooses.
    fn cut_from(text: &str) -> (&str, Self) {
        let ipv4 = text.strip_suffix(IPV4_ONLY).map(|rest| (rest, Self::Ipv4));
        let ipv6 = || text.strip_suffix(IPV6_ONLY).map(|rest| (rest, Self::Ipv6));
        ipv4.or_else(ipv6).unwrap_or((text, Self::Both))
    }
}

impl fmt::Display for Families {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Both => "",
            Self::Ipv4 => IPV4_ONLY,
            Self::Ipv6 => IPV6_ONLY,
        })
    }
}

/// Why a text is not a valid interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "it is no IPv4 or IPv6 address, no name of an interface (1 to 15 bytes, as `ip link` shows it), and not `all`; behind a name or `all` \
     /ipv4 or /ipv6 may stand"
)]
pub struct InterfaceError;

impl Interface {
    /// Returns whether its packets never leave the host: a loopback address, or the name of the loopback
    /// interface, of which no other address is used.
    #[must_use]
    pub fn is_loopback(&self) -> bool {
        match self {
            Self::Address(address) => address.is_loopback(),
            Self::Address6 { address, .. } => address.is_loopback(),
            Self::Name(name, _) => name == LOOPBACK,
            Self::All(_) => false,
        }
    }
}

impl FromStr for Interface {
    type Err = InterfaceError;

    fn from_str(text: &str) -> Result<Self, InterfaceError> {
        let (name, families) = Families::cut_from(text);
        if name == ALL {
            return Ok(Self::All(families));
        }
        if let Ok(address) = text.parse() {
            return Ok(Self::Address(address));
        }
        if text.contains(':') {
            let (address, zone) = zoned(text).ok_or(InterfaceError)?;
            return Ok(Self::Address6 { address, zone });
        }
        // An address with a typing error is not taken as a name.
        let is_number = name.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
        if is_interface_name(name) && !is_number {
            Ok(Self::Name(name.to_owned(), families))
        } else {
            Err(InterfaceError)
        }
    }
}

/// Returns whether an interface may have this name.
fn is_interface_name(text: &str) -> bool {
    let is_fit = |byte: u8| byte.is_ascii_graphic() && !b"/:%".contains(&byte);
    (1..=NAME_BYTES_MAX).contains(&text.len()) && text.bytes().all(is_fit)
}

/// Parses an IPv6 address with an interface's name behind it: `fe80::1%eth0` (RFC 4007, section 11).
pub(super) fn zoned(text: &str) -> Option<(Ipv6Addr, Option<String>)> {
    let (address, zone) = match text.split_once('%') {
        Some((address, zone)) => (address, Some(zone)),
        None => (text, None),
    };
    let zone = zone.map(|zone| is_interface_name(zone).then(|| zone.to_owned()));
    // An invalid zone makes the whole text invalid.
    let zone = zone.map_or(Some(None), |zone| zone.map(Some))?;
    Some((address.parse().ok()?, zone))
}

/// Displays the name behind an address.
pub(super) struct Zone<'a>(pub(super) &'a Option<String>);

impl fmt::Display for Zone<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.as_ref().map_or(Ok(()), |zone| write!(f, "%{zone}"))
    }
}

impl fmt::Display for Interface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Address(address) => address.fmt(f),
            Self::Address6 { address, zone } => write!(f, "{address}{}", Zone(zone)),
            Self::Name(name, families) => write!(f, "{name}{families}"),
            Self::All(families) => write!(f, "{ALL}{families}"),
        }
    }
}

/// All interfaces that a node uses, the preferred one first.
///
/// # Examples
///
/// ```
/// # use sinew::config::{Interface, Interfaces};
/// let cable: Interfaces = [192, 168, 1, 7].into();
/// let both = Interfaces::from(["eth0", "wlan0/ipv4"].map(|name| name.parse::<Interface>().unwrap()).to_vec());
/// assert_eq!((cable.to_string(), both.to_string()), ("192.168.1.7".into(), "eth0, wlan0/ipv4".into()));
/// ```
#[derive(Clone, Debug)]
pub struct Interfaces {
    chosen: Vec<Interface>,
    is_default: bool,
}

impl Interfaces {
    /// Returns each choice.
    pub fn iter(&self) -> impl Iterator<Item = &Interface> {
        self.chosen.iter()
    }

    /// Returns the IPv4 addresses of the choices that have one.
    pub fn addresses(&self) -> impl Iterator<Item = Ipv4Addr> {
        self.iter().filter_map(|interface| match interface {
            Interface::Address(address) => Some(*address),
            Interface::Address6 { .. } | Interface::Name(..) | Interface::All(_) => None,
        })
    }

    /// Returns whether each is chosen by its IPv4 address: then the host's interfaces need not be enumerated.
    #[must_use]
    pub fn are_ipv4_addresses(&self) -> bool {
        self.addresses().count() == self.chosen.len()
    }

    /// Returns whether any of them may have an IPv4 address that is used.
    #[must_use]
    pub fn have_ipv4(&self) -> bool {
        self.iter().any(|interface| match interface {
            Interface::Address(_) => true,
            Interface::Address6 { .. } => false,
            Interface::Name(_, families) | Interface::All(families) => families.has_ipv4(),
        })
    }

    /// Returns whether any of them may have an IPv6 address that is used.
    #[must_use]
    pub fn have_ipv6(&self) -> bool {
        self.iter().any(|interface| match interface {
            Interface::Address(_) => false,
            Interface::Address6 { .. } => true,
            Interface::Name(_, families) | Interface::All(families) => families.has_ipv6(),
        })
    }

    /// Returns the IPv4 address of the first one, if it is chosen by that.
    #[must_use]
    pub fn first_address(&self) -> Option<Ipv4Addr> {
        self.addresses().next().filter(|_| matches!(self.chosen.first(), Some(Interface::Address(_))))
    }

    /// Returns whether they are the default. An explicit 127.0.0.1 is taken as intended: there is no warning
    /// that other hosts cannot reach the node.
    #[must_use]
    pub const fn are_default(&self) -> bool {
        self.is_default
    }

    /// Returns whether no packet leaves the host.
    #[must_use]
    pub fn are_loopback(&self) -> bool {
        self.iter().all(Interface::is_loopback)
    }
}

impl Default for Interfaces {
    /// Loopback alone.
    fn default() -> Self {
        Self { chosen: vec![Interface::Address(Ipv4Addr::LOCALHOST)], is_default: true }
    }
}

/// An explicit choice of the default is equal to the default.
impl PartialEq for Interfaces {
    fn eq(&self, other: &Self) -> bool {
        self.chosen == other.chosen
    }
}

impl Eq for Interfaces {}

impl From<Vec<Interface>> for Interfaces {
    fn from(chosen: Vec<Interface>) -> Self {
        Self { chosen, is_default: false }
    }
}

impl From<Ipv4Addr> for Interfaces {
    fn from(address: Ipv4Addr) -> Self {
        vec![Interface::Address(address)].into()
    }
}

impl From<[u8; 4]> for Interfaces {
    fn from(address: [u8; 4]) -> Self {
        Ipv4Addr::from(address).into()
    }
}

impl fmt::Display for Interfaces {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (nth, interface) in self.iter().enumerate() {
            write!(f, "{}{interface}", if nth > 0 { ", " } else { "" })?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn text_is_address_name_or_all_but_no_typo() {
        let read = |text: &str| text.parse::<Interface>();
        assert_eq!(read("10.0.0.7"), Ok(Interface::Address(Ipv4Addr::new(10, 0, 0, 7))));
        assert_eq!(read("all"), Ok(Interface::All(Families::Both)));
        assert_eq!(read("all/ipv4"), Ok(Interface::All(Families::Ipv4)));
        for name in ["eth0", "enp3s0f1", "br-lan.20", "0eth"] {
            assert_eq!(read(name), Ok(Interface::Name(name.to_owned(), Families::Both)));
        }
        assert_eq!(read("eth0/ipv6"), Ok(Interface::Name("eth0".to_owned(), Families::Ipv6)));
        let address6 = |address: &str, zone: Option<&str>| {
            Ok(Interface::Address6 { address: address.parse().unwrap(), zone: zone.map(str::to_owned) })
        };
        assert_eq!(read("fd00::7"), address6("fd00::7", None));
        assert_eq!(read("FE80:0::1%eth0"), address6("fe80::1", Some("eth0")));
        for text in [
            "",
            "10.0.0",
            "10.0.0.256",
            "10.0.0.7.",
            "10.0.0.7/ipv4",
            "fe80::1%",
            "fe80::1%a/b",
            "fe80:::1",
            "fe80::1/64",
            "[fe80::1]",
            "fe80::1%a-name-of-16-byt",
            "eth0%1",
            "eth 0",
            "a/b",
            "eth0/ipv5",
            "/ipv6",
            "a-name-of-16-bytes",
            "ü",
        ] {
            assert_eq!(read(text), Err(InterfaceError), "{text:?}");
        }
    }

    #[test]
    fn chosen_loopback_differs_from_default_only_in_origin() {
        let chosen = Interfaces::from(Ipv4Addr::LOCALHOST);
        assert_eq!(chosen, Interfaces::default());
        assert!(Interfaces::default().are_default() && !chosen.are_default());
    }

    #[test]
    fn choice_states_families_and_reach() {
        let of = |choices: &[&str]| {
            let chosen: Vec<Interface> = choices.iter().map(|choice| choice.parse().unwrap()).collect();
            let chosen = Interfaces::from(chosen);
            (chosen.have_ipv4(), chosen.have_ipv6(), chosen.are_loopback(), chosen.are_ipv4_addresses())
        };
        assert_eq!(of(&["127.0.0.1"]), (true, false, true, true));
        assert_eq!(of(&["127.0.0.1", "::1"]), (true, true, true, false));
        assert_eq!(of(&[LOOPBACK, "::1"]), (true, true, true, false));
        assert_eq!(of(&[LOOPBACK, "eth0"]), (true, true, false, false));
        assert_eq!(of(&["fe80::1%eth0"]), (false, true, false, false));
        assert_eq!(of(&["eth0"]), (true, true, false, false));
        assert_eq!(of(&["all/ipv6"]), (false, true, false, false));
        assert_eq!(of(&["eth0/ipv4", "10.0.0.7"]), (true, false, false, false));
    }

    proptest! {
        #[test]
        fn parsed_text_is_written_and_parsed_again(text in "[a-z0-9:./%]{0,24}") {
            if let Ok(interface) = text.parse::<Interface>() {
                prop_assert_eq!(interface.to_string().parse::<Interface>(), Ok(interface));
            }
        }
    }
}
