//! The 64-bit transport ID (TID): the address of an application on a node.
//!
//! ```text
//!  63            32 31             0
//! +----------------+----------------+
//! |  node address  |  application   |
//! +----------------+----------------+
//! ```
//!
//! Application addresses:
//!
//! | range | use |
//! | --- | --- |
//! | `0` | no application; never a destination |
//! | `1..=15` | layers: LNCL 1, sync manager 2, GNCL 3, NDL 4; inspection 5; stop 6 |
//! | `16..=0x0fff` | reserved |
//! | `0x1000..=0x7fff_ffff` | fixed: chosen by the user |
//! | `0x8000_0000..=0xefff_ffff` | dynamic: assigned by LNCL |
//! | `0xf000_0000..=0xffff_fffe` | groups |
//! | `0xffff_ffff` | every application of the node |

use std::{fmt, net::Ipv4Addr, str::FromStr};

use serde::{Deserialize, Serialize};

/// Address of a node: 32 bits, unique in a project; written as an IPv4 address, which it is by default.
///
/// # Examples
///
/// ```
/// use sinew::NodeAddress;
///
/// let knee = NodeAddress::from([10, 0, 0, 3]);
/// assert_eq!(knee.to_string(), "10.0.0.3");
/// assert_eq!("10.0.0.3".parse(), Ok(knee));
/// ```
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct NodeAddress(u32);

impl NodeAddress {
    /// The node of the sender itself.
    pub const HERE: Self = Self(0);
    /// Every node: a broadcast.
    pub const ALL: Self = Self(u32::MAX);

    /// Creates a node address from its 32 bits.
    #[must_use]
    pub const fn new(bits: u32) -> Self {
        Self(bits)
    }

    /// Returns the 32 bits of this address.
    #[must_use]
    pub const fn bits(self) -> u32 {
        self.0
    }

    /// Returns whether this is the address of one node (neither [`HERE`](Self::HERE) nor [`ALL`](Self::ALL)).
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::NodeAddress;
    ///
    /// assert!(NodeAddress::from([10, 0, 0, 3]).is_single());
    /// assert!(!NodeAddress::ALL.is_single()); // a broadcast
    /// ```
    #[must_use]
    pub const fn is_single(self) -> bool {
        self.0 != 0 && self.0 != u32::MAX
    }
}

impl From<Ipv4Addr> for NodeAddress {
    fn from(address: Ipv4Addr) -> Self {
        Self(u32::from(address))
    }
}

impl From<[u8; 4]> for NodeAddress {
    fn from(octets: [u8; 4]) -> Self {
        Self(u32::from_be_bytes(octets))
    }
}

impl fmt::Display for NodeAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::HERE => f.write_str("here"),
            Self::ALL => f.write_str("*"),
            Self(bits) => write!(f, "{}", Ipv4Addr::from(bits)),
        }
    }
}

impl fmt::Debug for NodeAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for NodeAddress {
    type Err = ParseTidError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "here" => Ok(Self::HERE),
            "*" => Ok(Self::ALL),
            _ => text.parse::<Ipv4Addr>().map(Self::from).map_err(|_| ParseTidError::Node(text.to_owned())),
        }
    }
}

/// Address of an application inside its node: 32 bits; see the table of the [module](self).
///
/// # Examples
///
/// ```
/// use sinew::{AppAddress, Tid};
///
/// /// The address of the knee's drive on its node, which other programs know beforehand.
/// const DRIVE: AppAddress = AppAddress::new(0x1001);
///
/// assert!(DRIVE.is_fixed());
/// assert_eq!(Tid::new([10, 0, 0, 3].into(), DRIVE).to_string(), "10.0.0.3/1001");
/// ```
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct AppAddress(u32);

impl AppAddress {
    /// No application. A message to it is rejected.
    pub const NONE: Self = Self(0);
    /// Local Node Communication Layer.
    pub const LNCL: Self = Self(1);
    /// Sync manager.
    pub const SYNC: Self = Self(2);
    /// Global Node Communication Layer.
    pub const GNCL: Self = Self(3);
    /// Node Discovery Layer.
    pub const NDL: Self = Self(4);
    /// Answers queries about its node, for tools. It is not a layer, but has a static address like one.
    pub const INSPECT: Self = Self(5);
    /// Presses, releases and reports the stop of the whole system. It is not a layer, but has a static address like
    /// one.
    pub const STOP: Self = Self(6);
    /// Every application of a node.
    pub const ALL: Self = Self(u32::MAX);

    const FIXED_FIRST: u32 = 0x1000;
    const DYNAMIC_FIRST: u32 = 0x8000_0000;
    const GROUP_FIRST: u32 = 0xf000_0000;

    /// Creates an application address from its 32 bits.
    #[must_use]
    pub const fn new(bits: u32) -> Self {
        Self(bits)
    }

    /// Returns the 32 bits of this address.
    #[must_use]
    pub const fn bits(self) -> u32 {
        self.0
    }

    /// Returns the `index`-th address that users may choose; `None` past the end of the range.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::AppAddress;
    ///
    /// assert_eq!(AppAddress::fixed(1), Some(AppAddress::new(0x1001)));
    /// assert_eq!(AppAddress::fixed(0x8000_0000), None);
    /// ```
    #[must_use]
    pub const fn fixed(index: u32) -> Option<Self> {
        if index < Self::DYNAMIC_FIRST - Self::FIXED_FIRST {
            Some(Self(Self::FIXED_FIRST + index))
        } else {
            None
        }
    }

    /// Returns the `index`-th address that LNCL assigns; `None` past the end of the range.
    #[must_use]
    pub const fn dynamic(index: u32) -> Option<Self> {
        if index < Self::GROUP_FIRST - Self::DYNAMIC_FIRST {
            Some(Self(Self::DYNAMIC_FIRST + index))
        } else {
            None
        }
    }

    /// Returns the address of the group called `name`: FNV-1a of the name, folded into the group range.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{AppAddress, Tid};
    ///
    /// assert!(AppAddress::group("drives").is_group());
    /// assert_eq!(Tid::group("drives").app, AppAddress::group("drives"));
    /// ```
    #[must_use]
    pub const fn group(name: &str) -> Self {
        let span = Self::ALL.0 - Self::GROUP_FIRST;
        Self(Self::GROUP_FIRST + crate::wire::fnv1a(name.as_bytes()) % span)
    }

    /// Returns whether this is a layer's static address.
    #[must_use]
    pub const fn is_layer(self) -> bool {
        1 <= self.0 && self.0 <= 15
    }

    /// Returns whether a user may choose this address.
    #[must_use]
    pub const fn is_fixed(self) -> bool {
        Self::FIXED_FIRST <= self.0 && self.0 < Self::DYNAMIC_FIRST
    }

    /// Returns whether LNCL assigns this address.
    #[must_use]
    pub const fn is_dynamic(self) -> bool {
        Self::DYNAMIC_FIRST <= self.0 && self.0 < Self::GROUP_FIRST
    }

    /// Returns whether this is the address of a group.
    #[must_use]
    pub const fn is_group(self) -> bool {
        Self::GROUP_FIRST <= self.0 && self.0 < Self::ALL.0
    }
}

impl fmt::Display for AppAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::LNCL => f.write_str("lncl"),
            Self::SYNC => f.write_str("sync"),
            Self::GNCL => f.write_str("gncl"),
            Self::NDL => f.write_str("ndl"),
            Self::INSPECT => f.write_str("inspect"),
            Self::STOP => f.write_str("stop"),
            Self::ALL => f.write_str("*"),
            Self(bits) => write!(f, "{bits:x}"),
        }
    }
}

impl fmt::Debug for AppAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for AppAddress {
    type Err = ParseTidError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "lncl" => Ok(Self::LNCL),
            "sync" => Ok(Self::SYNC),
            "gncl" => Ok(Self::GNCL),
            "ndl" => Ok(Self::NDL),
            "inspect" => Ok(Self::INSPECT),
            "stop" => Ok(Self::STOP),
            "*" => Ok(Self::ALL),
            _ if text.starts_with('+') => Err(ParseTidError::Application(text.to_owned())),
            _ => u32::from_str_radix(text, 16)
                .map(Self)
                .map_err(|_| ParseTidError::Application(text.to_owned())),
        }
    }
}

/// Transport ID: the address of an application, a layer, a group or all applications.
///
/// Its text form is `node/application`, the application in hexadecimal or by its layer's name; it parses back.
///
/// # Examples
///
/// ```
/// use sinew::Tid;
///
/// let tid: Tid = "10.0.0.7/1001".parse()?;
/// assert_eq!(tid.bits(), 0x0a00_0007_0000_1001);
/// assert_eq!(tid.to_string(), "10.0.0.7/1001");
/// assert_eq!("*/ndl".parse::<Tid>()?.to_string(), "*/ndl");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Tid {
    /// The node, or [`NodeAddress::ALL`].
    pub node: NodeAddress,
    /// The application on that node.
    pub app: AppAddress,
}

impl Tid {
    /// No application: the source of a message that expects no reply.
    pub const NONE: Self = Self::new(NodeAddress::HERE, AppAddress::NONE);
    /// Every application of every node.
    pub const BROADCAST: Self = Self::new(NodeAddress::ALL, AppAddress::ALL);

    /// Returns the TID of `app` on `node`.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{AppAddress, NodeAddress, Tid};
    ///
    /// let drive = Tid::new(NodeAddress::from([10, 0, 0, 3]), AppAddress::new(0x1001));
    /// let own_drive = Tid::new(NodeAddress::HERE, AppAddress::new(0x1001)); // on the node of the sender
    /// assert_ne!(drive, own_drive);
    /// ```
    #[must_use]
    pub const fn new(node: NodeAddress, app: AppAddress) -> Self {
        Self { node, app }
    }

    /// Returns the TID of the members of the group called `name`, on every node.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::Tid;
    ///
    /// const DRIVES: Tid = Tid::group("drives");
    ///
    /// assert!(!DRIVES.is_single()); // so a confirmed message to it has one outcome for each member
    /// ```
    #[must_use]
    pub const fn group(name: &str) -> Self {
        Self::new(NodeAddress::ALL, AppAddress::group(name))
    }

    /// Creates the TID with these 64 bits, node address in the upper half.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::Tid;
    ///
    /// // For example from the header of a frame that a logger has recorded.
    /// let tid = Tid::from_bits(0x0a00_0003_0000_1001);
    /// assert_eq!(tid.to_string(), "10.0.0.3/1001");
    /// ```
    #[must_use]
    pub const fn from_bits(bits: u64) -> Self {
        Self::new(NodeAddress((bits >> 32) as u32), AppAddress(bits as u32))
    }

    /// Returns the 64 bits, node address in the upper half.
    #[must_use]
    pub const fn bits(self) -> u64 {
        (self.node.0 as u64) << 32 | self.app.0 as u64
    }

    /// Returns whether this is the address of exactly one application or layer.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::Tid;
    ///
    /// let drive: Tid = "10.0.0.3/1001".parse().expect("a TID");
    /// assert!(drive.is_single());
    /// assert!(!Tid::BROADCAST.is_single() && !Tid::NONE.is_single());
    /// ```
    #[must_use]
    pub const fn is_single(self) -> bool {
        !matches!(self.node, NodeAddress::ALL)
            && !matches!(self.app, AppAddress::NONE | AppAddress::ALL)
            && !self.app.is_group()
    }
}

impl fmt::Display for Tid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.node, self.app)
    }
}

impl fmt::Debug for Tid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for Tid {
    type Err = ParseTidError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let Some((node, app)) = text.split_once('/') else {
            return Err(ParseTidError::Form(text.to_owned()));
        };
        Ok(Self::new(node.parse()?, app.parse()?))
    }
}

/// The reason why a text is not a TID. This is an error of the caller; nothing changed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ParseTidError {
    /// There is no slash between the node and the application.
    #[error("'{0}' is not a TID: write node/application, as in 10.0.0.7/1001")]
    Form(String),
    /// The part before the slash is not a node address.
    #[error("'{0}' is not a node address: write an IPv4 address, '*' for every node or 'here'")]
    Node(String),
    /// The part after the slash is not an application address.
    #[error(
        "'{0}' is not an application address: write hexadecimal digits, lncl, sync, gncl, ndl, inspect or '*'"
    )]
    Application(String),
}

/// The incarnation of a node or an application; larger is later.
///
/// # Examples
///
/// ```
/// use sinew::address::Incarnation;
///
/// let (known, found) = (Incarnation(7), Incarnation(8));
/// assert!(found > known, "the node was restarted");
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Incarnation(pub u64);

impl fmt::Display for Incarnation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn text_form_parses_back(bits: u64) {
            let tid = Tid::from_bits(bits);
            prop_assert_eq!(tid.to_string().parse::<Tid>(), Ok(tid));
        }

        #[test]
        fn any_text_is_a_tid_or_an_error(text in ".{0,40}") {
            let _ = text.parse::<Tid>();
        }
    }

    #[test]
    fn every_address_has_exactly_one_use() {
        for bits in
            [0, 1, 15, 16, 0xfff, 0x1000, 0x7fff_ffff, 0x8000_0000, 0xf000_0000, u32::MAX - 1, u32::MAX]
        {
            let app = AppAddress::new(bits);
            let uses = [app.is_layer(), app.is_fixed(), app.is_dynamic(), app.is_group()];
            assert!(uses.iter().filter(|used| **used).count() <= 1, "{app}");
        }
    }

    #[test]
    fn group_of_a_name_is_in_the_group_range() {
        assert!(AppAddress::group("drives").is_group());
    }
}
