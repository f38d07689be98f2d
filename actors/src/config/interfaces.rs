//! Which of a host's network interfaces a node uses.

use std::{
    fmt,
    net::{Ipv4Addr, Ipv6Addr},
    str::FromStr,
};

/// Bytes of an interface's name at most (`IFNAMSIZ`).
const NAME_BYTES_MAX: usize = 15;
/// What stands for every interface.
const ALL: &str = "all";
/// What stands behind a name, or `all`, to choose one family of its addresses.
const IPV4_ONLY: &str = "/ipv4";
const IPV6_ONLY: &str = "/ipv6";
/// What the system calls the interface of loopback.
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
    /// The one that has this IPv4 address. It is used for as long as the node runs, from when the host has the address.
    Address(Ipv4Addr),
    /// The one that has this IPv6 address, whenever it has it; of several, as each may have the same link-local address, the one of the name
    /// `zone`, if there is one: `fd00::7`, `fe80::7%eth0`.
    Address6 {
        /// The address.
        address: Ipv6Addr,
        /// The interface's name, 1 to 15 bytes, or its number in this host.
        zone: Option<String>,
    },
    /// The one of this name, with its addresses, whenever it is there and up: `eth0`, `eth0/ipv6`. 1 to 15 bytes.
    Name(String, Families),
    /// Each one but loopback, whenever it is there and up: `all`, `all/ipv4`.
    All(Families),
}

/// Which addresses of an interface are used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Families {
    /// Those of IPv4 and of IPv6.
    #[default]
    Both,
    /// Those of IPv4 alone.
    Ipv4,
    /// Those of IPv6 alone.
    Ipv6,
}

impl Families {
    /// Whether addresses of IPv4 are among them.
    #[must_use]
    pub const fn has_ipv4(self) -> bool {
        matches!(self, Self::Both | Self::Ipv4)
    }

    /// Whether addresses of IPv6 are among them.
    #[must_use]
    pub const fn has_ipv6(self) -> bool {
        matches!(self, Self::Both | Self::Ipv6)
    }

    /// A text without what chooses a family at its end, and which it chooses.
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

/// Why a text chooses no interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "it is no IPv4 or IPv6 address, no name of an interface (1 to 15 bytes, as `ip link` shows it), and not `all`; behind a name or `all` \
     /ipv4 or /ipv6 may stand"
)]
pub struct NoInterface;

impl Interface {
    /// Whether nothing that goes there leaves the host: an address of loopback, or the name of its interface, of which no other address is used.
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
    type Err = NoInterface;

    fn from_str(text: &str) -> Result<Self, NoInterface> {
        let (name, families) = Families::cut_from(text);
        if name == ALL {
            return Ok(Self::All(families));
        }
        if let Ok(address) = text.parse() {
            return Ok(Self::Address(address));
        }
        if text.contains(':') {
            let (address, zone) = zoned(text).ok_or(NoInterface)?;
            return Ok(Self::Address6 { address, zone });
        }
        // An address with a slip of the pen is no name.
        let is_number = name.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
        if is_interface_name(name) && !is_number {
            Ok(Self::Name(name.to_owned(), families))
        } else {
            Err(NoInterface)
        }
    }
}

/// Whether an interface may have this name.
fn is_interface_name(text: &str) -> bool {
    let is_fit = |byte: u8| byte.is_ascii_graphic() && !b"/:%".contains(&byte);
    (1..=NAME_BYTES_MAX).contains(&text.len()) && text.bytes().all(is_fit)
}

/// An IPv6 address, and the name of the interface that stands behind it: `fe80::1%eth0` (RFC 4007, section 11).
pub(super) fn zoned(text: &str) -> Option<(Ipv6Addr, Option<String>)> {
    let (address, zone) = match text.split_once('%') {
        Some((address, zone)) => (address, Some(zone)),
        None => (text, None),
    };
    let zone = zone.map(|zone| is_interface_name(zone).then(|| zone.to_owned()));
    // A zone that is none is a fault of the whole.
    let zone = zone.map_or(Some(None), |zone| zone.map(Some))?;
    Some((address.parse().ok()?, zone))
}

/// The name behind an address, as it is written.
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

/// All interfaces that a node uses, the one that it prefers first.
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
    /// Each choice.
    pub fn iter(&self) -> impl Iterator<Item = &Interface> {
        self.chosen.iter()
    }

    /// Those that are chosen by their IPv4 addresses.
    pub fn addresses(&self) -> impl Iterator<Item = Ipv4Addr> {
        self.iter().filter_map(|interface| match interface {
            Interface::Address(address) => Some(*address),
            Interface::Address6 { .. } | Interface::Name(..) | Interface::All(_) => None,
        })
    }

    /// Whether each is chosen by its IPv4 address: nobody has to look which there are.
    #[must_use]
    pub fn are_ipv4_addresses(&self) -> bool {
        self.addresses().count() == self.chosen.len()
    }

    /// Whether any of them may have an IPv4 address that is used.
    #[must_use]
    pub fn have_ipv4(&self) -> bool {
        self.iter().any(|interface| match interface {
            Interface::Address(_) => true,
            Interface::Address6 { .. } => false,
            Interface::Name(_, families) | Interface::All(families) => families.has_ipv4(),
        })
    }

    /// Whether any of them may have an IPv6 address that is used.
    #[must_use]
    pub fn have_ipv6(&self) -> bool {
        self.iter().any(|interface| match interface {
            Interface::Address(_) => false,
            Interface::Address6 { .. } => true,
            Interface::Name(_, families) | Interface::All(families) => families.has_ipv6(),
        })
    }

    /// The IPv4 address of the first one, if that is what it is chosen by.
    #[must_use]
    pub fn first_address(&self) -> Option<Ipv4Addr> {
        self.addresses().next().filter(|_| matches!(self.chosen.first(), Some(Interface::Address(_))))
    }

    /// Whether nobody has chosen any. Who writes 127.0.0.1 means that, and is not told that other hosts do not see the node.
    #[must_use]
    pub const fn are_default(&self) -> bool {
        self.is_default
    }

    /// Whether nothing leaves the host.
    #[must_use]
    pub fn are_loopback(&self) -> bool {
        self.iter().all(Interface::is_loopback)
    }
}

impl Default for Interfaces {
    /// Loopback alone, as long as nobody chooses.
    fn default() -> Self {
        Self { chosen: vec![Interface::Address(Ipv4Addr::LOCALHOST)], is_default: true }
    }
}

/// Who chooses what is the default anyway has the same interfaces.
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
    fn a_text_is_an_address_a_name_or_all_and_a_slip_of_the_pen_is_none() {
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
            assert_eq!(read(text), Err(NoInterface), "{text:?}");
        }
    }

    #[test]
    fn loopback_that_somebody_chose_is_told_from_the_default_and_is_the_same_otherwise() {
        let chosen = Interfaces::from(Ipv4Addr::LOCALHOST);
        assert_eq!(chosen, Interfaces::default());
        assert!(Interfaces::default().are_default() && !chosen.are_default());
    }

    #[test]
    fn a_choice_says_which_families_it_may_have_and_whether_it_leaves_the_host() {
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
        fn what_is_read_is_written_so_that_it_is_read_again(text in "[a-z0-9:./%]{0,24}") {
            if let Ok(interface) = text.parse::<Interface>() {
                prop_assert_eq!(interface.to_string().parse::<Interface>(), Ok(interface));
            }
        }
    }
}
