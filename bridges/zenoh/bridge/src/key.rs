//! The key expressions of the bridge.
//!
//! | key | content |
//! | --- | --- |
//! | `sinew/{project}/t/{node}/{app}/{type}` | a message to an address, each part of it 8 hexadecimal digits |
//! | `sinew/{project}/n/{name}/{type}` | a message to the application of this name |
//! | `sinew/{project}/g/{group}/{type}` | a message to a group |
//! | `sinew/{project}/a/{type}` | a message to all applications |
//! | `sinew/{project}/@/{node}` | liveliness token of a node |
//! | `sinew/{project}/@/{node}/{app}/{name}` | liveliness token of an application that is ready |
//! | `sinew/{project}/@z/{name}` | liveliness token of a Zenoh program, which it declares itself |
//!
//! Characters of names other than letters, digits, `-`, `_` and `.` are written as `%` and two hexadecimal digits for
//! each byte, as in the keys of the WAN link. A name has exactly one key.

use std::{fmt, fmt::Write as _};

use sinew::{AppAddress, NodeAddress, Tid, message::Kind};

/// Maximum length of a key in bytes that is parsed: three names with all bytes escaped, and the rest.
pub const KEY_BYTES_MAX: usize = 640;

/// The destination that a key names.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Target {
    /// The application at this address.
    Tid(Tid),
    /// The application that has this name.
    Name(String),
    /// The members of this group.
    Group(String),
    /// All applications.
    All,
}

/// A destination, and the type of a message for it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Address {
    /// The destination.
    pub target: Target,
    /// The name of the payload's type.
    pub payload_type: String,
}

impl Target {
    /// Returns the address, unless it has to be looked up by a name.
    #[must_use]
    pub fn tid(&self) -> Option<Tid> {
        match self {
            Self::Tid(tid) => Some(*tid),
            Self::Name(_) => None,
            Self::Group(name) => Some(Tid::group(name)),
            Self::All => Some(Tid::BROADCAST),
        }
    }

    /// Returns whether this is one application.
    #[must_use]
    pub const fn is_single(&self) -> bool {
        matches!(self, Self::Tid(_) | Self::Name(_))
    }
}

impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tid(tid) => write!(f, "{tid}"),
            Self::Name(name) => write!(f, "{name}"),
            Self::Group(name) => write!(f, "group {name}"),
            Self::All => f.write_str("all applications"),
        }
    }
}

impl Address {
    /// Returns the number of the payload's type.
    #[must_use]
    pub const fn kind(&self) -> Kind {
        Kind::named(self.payload_type.as_str())
    }

    /// Returns the key of messages to this address.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew_zenoh_rules::{Address, Target};
    ///
    /// let drive = Target::Name("knee drive".to_owned());
    /// let address = Address { target: drive, payload_type: "leg.move".to_owned() };
    /// assert_eq!(address.key("leg"), "sinew/leg/n/knee%20drive/leg.move");
    /// assert_eq!(Address::parse("sinew/leg/n/knee%20drive/leg.move", "leg"), Some(address));
    /// ```
    #[must_use]
    pub fn key(&self, project: &str) -> String {
        let payload_type = escaped(&self.payload_type);
        let project = escaped(project);
        match &self.target {
            Target::Tid(Tid { node, app }) => {
                format!("sinew/{project}/t/{:08x}/{:08x}/{payload_type}", node.bits(), app.bits())
            }
            Target::Name(name) => format!("sinew/{project}/n/{}/{payload_type}", escaped(name)),
            Target::Group(name) => format!("sinew/{project}/g/{}/{payload_type}", escaped(name)),
            Target::All => format!("sinew/{project}/a/{payload_type}"),
        }
    }

    /// Returns the address of a key, or `None` if it is no key of a message of this project. A key with wildcards is
    /// none.
    #[must_use]
    pub fn parse(key: &str, project: &str) -> Option<Self> {
        if key.len() > KEY_BYTES_MAX {
            return None;
        }
        let rest = key.strip_prefix("sinew/")?.strip_prefix(&escaped(project))?.strip_prefix('/')?;
        let parts: Vec<&str> = rest.split('/').take(5).collect();
        let (target, payload_type) = match parts[..] {
            ["t", node, app, payload_type] => {
                let (node, app) = (NodeAddress::new(bits(node)?), AppAddress::new(bits(app)?));
                (Target::Tid(Tid::new(node, app)), payload_type)
            }
            ["n", name, payload_type] => (Target::Name(unescaped(name)?), payload_type),
            ["g", name, payload_type] => (Target::Group(unescaped(name)?), payload_type),
            ["a", payload_type] => (Target::All, payload_type),
            _ => return None,
        };
        Some(Self { target, payload_type: unescaped(payload_type)? })
    }
}

/// Returns the key expressions of all messages of a project.
#[must_use]
pub fn all_messages(project: &str) -> [String; 4] {
    let project = escaped(project);
    ["t", "n", "g", "a"].map(|part| format!("sinew/{project}/{part}/**"))
}

/// Returns the key of a node's liveliness token.
#[must_use]
pub fn node_token(project: &str, node: NodeAddress) -> String {
    format!("sinew/{}/@/{:08x}", escaped(project), node.bits())
}

/// Returns the key of an application's liveliness token.
#[must_use]
pub fn app_token(project: &str, tid: Tid, name: &str) -> String {
    format!("{}/{:08x}/{}", node_token(project, tid.node), tid.app.bits(), escaped(name))
}

/// Returns the key of the liveliness token that a Zenoh program with this name declares.
#[must_use]
pub fn program_token(project: &str, name: &str) -> String {
    format!("sinew/{}/@z/{}", escaped(project), escaped(name))
}

/// Returns a name as one part of a key. Zenoh gives `*`, `$`, `?`, `#` and `/` a meaning, and `@` as a first character.
#[must_use]
pub fn escaped(name: &str) -> String {
    let mut part = String::with_capacity(name.len());
    for character in name.chars() {
        if character.is_alphanumeric() || matches!(character, '-' | '_' | '.') {
            part.push(character);
        } else {
            for byte in character.encode_utf8(&mut [0; 4]).bytes() {
                // A text accepts everything.
                let _ = write!(part, "%{byte:02x}");
            }
        }
    }
    part
}

/// Returns the name of a part of a key, or `None` if no name has this part.
fn unescaped(part: &str) -> Option<String> {
    let (mut bytes, mut rest) = (Vec::with_capacity(part.len()), part.as_bytes());
    while let Some((first, others)) = rest.split_first() {
        if *first == b'%' {
            let (digits, others) = others.split_first_chunk::<2>()?;
            let byte = u8::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?;
            bytes.push(byte);
            rest = others;
        } else {
            bytes.push(*first);
            rest = others;
        }
    }
    let name = String::from_utf8(bytes).ok().filter(|name| !name.is_empty())?;
    // One form alone: the router's rules for keys could be passed by another one.
    (escaped(&name) == part).then_some(name)
}

fn bits(digits: &str) -> Option<u32> {
    let is_plain =
        digits.len() == 8 && digits.bytes().all(|digit| matches!(digit, b'0'..=b'9' | b'a'..=b'f'));
    u32::from_str_radix(digits, 16).ok().filter(|_| is_plain)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn targets() -> impl Strategy<Value = Target> {
        let name = "[^\\p{C}]{1,20}";
        prop_oneof![
            any::<u64>().prop_map(|bits| Target::Tid(Tid::from_bits(bits))),
            name.prop_map(Target::Name),
            name.prop_map(Target::Group),
            Just(Target::All),
        ]
    }

    #[test]
    fn keys_of_other_forms_are_foreign() {
        let foreign = [
            "sinew/leg/n/knee",
            "sinew/leg/n/knee/leg.move/more",
            "sinew/leg/n/*/leg.move",
            "sinew/leg/n/knee/**",
            "sinew/leg/n/kn%65e/leg.move",
            "sinew/leg/n/knee%2/leg.move",
            "sinew/leg/n/knee%+1/leg.move",
            "sinew/leg/n//leg.move",
            "sinew/leg/n/knee/%ff",
            "sinew/leg/n/knee%2Fdrive/leg.move",
            "sinew/leg/x/knee/leg.move",
            "sinew/leg/t/0a000003/1001/leg.move",
            "sinew/leg/t/0A000003/00001001/leg.move",
            "sinew/arm/n/knee/leg.move",
            "sinew/legs/n/knee/leg.move",
            "leg/n/knee/leg.move",
            "",
        ];
        for key in foreign {
            assert_eq!(Address::parse(key, "leg"), None, "{key}");
        }
    }

    #[test]
    fn tokens_have_their_keys() {
        let tid = Tid::new([10, 0, 0, 3].into(), AppAddress::new(0x1001));
        assert_eq!(node_token("leg", tid.node), "sinew/leg/@/0a000003");
        assert_eq!(app_token("leg", tid, "knee/drive"), "sinew/leg/@/0a000003/00001001/knee%2fdrive");
        assert_eq!(program_token("leg", "operator"), "sinew/leg/@z/operator");
    }

    proptest! {
        #[test]
        fn each_address_has_one_key(target in targets(), payload_type in "[^\\p{C}]{1,20}", project in "[^\\p{C}]{1,10}") {
            let address = Address { target, payload_type };
            let key = address.key(&project);
            prop_assert!(key.len() <= KEY_BYTES_MAX);
            // Zenoh's grammar: no wildcards, no empty parts, no verbatim parts.
            prop_assert!(!key.contains(['*', '$', '?', '#', '@']) && !key.contains("//") && !key.ends_with('/'));
            prop_assert_eq!(Address::parse(&key, &project), Some(address));
        }

        #[test]
        fn any_text_is_one_key_or_foreign(key in "sinew/leg/[tnga]/.{0,40}") {
            if let Some(address) = Address::parse(&key, "leg") {
                prop_assert_eq!(address.key("leg"), key);
            }
        }
    }
}
