//! Which of a host's network interfaces a node uses.

use std::{fmt, net::Ipv4Addr, str::FromStr};

/// Bytes of an interface's name at most (`IFNAMSIZ`).
const NAME_BYTES_MAX: usize = 15;
/// What stands for every interface.
const ALL: &str = "all";

/// A choice of network interfaces.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Interface {
    /// The one that has this address. It is used for as long as the node runs, from when the host has the address.
    Address(Ipv4Addr),
    /// The one of this name, with all its addresses, whenever it is there and up: `eth0`. 1 to 15 bytes.
    Name(String),
    /// Each one but loopback, whenever it is there and up.
    All,
}

/// Why a text chooses no interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "it is no IPv4 address, no name of an interface (1 to 15 bytes, as `ip link` shows it), and not `all`"
)]
pub struct NoInterface;

impl FromStr for Interface {
    type Err = NoInterface;

    fn from_str(text: &str) -> Result<Self, NoInterface> {
        if text == ALL {
            return Ok(Self::All);
        }
        if let Ok(address) = text.parse() {
            return Ok(Self::Address(address));
        }
        // An address with a slip of the pen, or of another family, is no name.
        let is_number = text.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.') || text.contains(':');
        let is_fit = |byte: u8| byte.is_ascii_graphic() && byte != b'/';
        let is_name = (1..=NAME_BYTES_MAX).contains(&text.len()) && text.bytes().all(is_fit) && !is_number;
        if is_name { Ok(Self::Name(text.to_owned())) } else { Err(NoInterface) }
    }
}

impl fmt::Display for Interface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Address(address) => address.fmt(f),
            Self::Name(name) => f.write_str(name),
            Self::All => f.write_str(ALL),
        }
    }
}

/// All interfaces that a node uses, the one that it prefers first.
///
/// ```
/// # use sinew::config::{Interface, Interfaces};
/// let cable: Interfaces = [192, 168, 1, 7].into();
/// let both = Interfaces::from(vec![Interface::Name("eth0".into()), Interface::Name("wlan0".into())]);
/// assert_eq!((cable.to_string(), both.to_string()), ("192.168.1.7".into(), "eth0, wlan0".into()));
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Interfaces(Vec<Interface>);

impl Interfaces {
    /// Each choice.
    pub fn iter(&self) -> impl Iterator<Item = &Interface> {
        self.0.iter()
    }

    /// Those that are chosen by their addresses.
    pub fn addresses(&self) -> impl Iterator<Item = Ipv4Addr> {
        self.iter().filter_map(|interface| match interface {
            Interface::Address(address) => Some(*address),
            Interface::Name(_) | Interface::All => None,
        })
    }

    /// Whether each is chosen by its address: nobody has to look which there are.
    #[must_use]
    pub fn are_addresses(&self) -> bool {
        self.addresses().count() == self.0.len()
    }

    /// The address of the first one, if that is what it is chosen by.
    #[must_use]
    pub fn first_address(&self) -> Option<Ipv4Addr> {
        self.addresses().next().filter(|_| matches!(self.0.first(), Some(Interface::Address(_))))
    }

    /// Whether nothing leaves the host.
    #[must_use]
    pub fn are_loopback(&self) -> bool {
        self.are_addresses() && self.addresses().all(|address| address.is_loopback())
    }
}

impl From<Vec<Interface>> for Interfaces {
    fn from(interfaces: Vec<Interface>) -> Self {
        Self(interfaces)
    }
}

impl From<Ipv4Addr> for Interfaces {
    fn from(address: Ipv4Addr) -> Self {
        Self(vec![Interface::Address(address)])
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
    use super::*;

    #[test]
    fn a_text_is_an_address_a_name_or_all_and_a_slip_of_the_pen_is_none() {
        let read = |text: &str| text.parse::<Interface>();
        assert_eq!(read("10.0.0.7"), Ok(Interface::Address(Ipv4Addr::new(10, 0, 0, 7))));
        assert_eq!(read("all"), Ok(Interface::All));
        for name in ["eth0", "enp3s0f1", "br-lan.20", "0eth"] {
            assert_eq!(read(name), Ok(Interface::Name(name.to_owned())));
        }
        for text in
            ["", "10.0.0", "10.0.0.256", "10.0.0.7.", "fe80::1", "eth 0", "a/b", "a-name-of-16-bytes", "ü"]
        {
            assert_eq!(read(text), Err(NoInterface), "{text:?}");
        }
    }
}
