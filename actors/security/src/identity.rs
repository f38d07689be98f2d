//! The identity in a certificate (project, address and name), as a URI in its subject alternative names.
//!
//! ```text
//! sinew://walker/node/192.168.0.11/hip     a node
//! sinew://walker                           the project's authority
//! ```
//!
//! Project and name are percent-encoded (RFC 3986, section 2.1), except letters, digits and `-._~`. Each
//! identity has exactly one encoding, and no other is accepted.

use std::{
    fmt::{self, Write as _},
    net::Ipv4Addr,
};

use sinew_runtime::tid::NodeAddress;

const SCHEME: &str = "sinew://";

/// The identity of a node in a project.
///
/// # Examples
///
/// ```
/// use sinew::security::Identity;
///
/// let hip = Identity::from_uri("sinew://walker/node/192.168.0.11/hip").expect("it names a node");
/// assert_eq!((hip.project.as_str(), hip.name.as_str()), ("walker", "hip"));
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    /// The project, as in `node.project`.
    pub project: String,
    /// The node's address, as in `node.address`.
    pub address: NodeAddress,
    /// The node's name, as in `node.name`.
    pub name: String,
}

impl Identity {
    /// Returns the URI of the identity in a certificate.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::security::Identity;
    /// let hip = Identity { project: "walker".into(), address: [192, 168, 0, 11].into(), name: "hip".into() };
    /// assert_eq!(hip.uri(), "sinew://walker/node/192.168.0.11/hip");
    /// assert_eq!(Identity::from_uri(&hip.uri()), Some(hip));
    /// ```
    #[must_use]
    pub fn uri(&self) -> String {
        let address = Ipv4Addr::from(self.address.bits());
        format!("{}/node/{address}/{}", project_uri(&self.project), escaped(&self.name))
    }

    /// Parses the identity in `uri`. Returns `None` if it is not an identity, or not encoded as by [`uri`](Self::uri).
    #[must_use]
    pub fn from_uri(uri: &str) -> Option<Self> {
        let mut parts = uri.strip_prefix(SCHEME)?.split('/');
        let project = unescaped(parts.next()?)?;
        let is_node = parts.next()? == "node";
        let address = NodeAddress::from(parts.next()?.parse::<Ipv4Addr>().ok()?);
        let name = unescaped(parts.next()?)?;
        let identity = Self { project, address, name };
        let is_legal =
            is_node && address.is_single() && is_name(&identity.project) && is_name(&identity.name);
        (is_legal && identity.uri() == uri).then_some(identity)
    }
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "node {:?} ({}) of project {:?}", self.name, self.address, self.project)
    }
}

/// Returns the URI of the authority of `project` in its certificate.
#[must_use]
pub fn project_uri(project: &str) -> String {
    format!("{SCHEME}{}", escaped(project))
}

/// Returns the project of the authority in `uri`, or `None` if it names no authority.
#[must_use]
pub fn project_of(uri: &str) -> Option<String> {
    let project = unescaped(uri.strip_prefix(SCHEME)?)?;
    (is_name(&project) && project_uri(&project) == uri).then_some(project)
}

/// Checks the rule for `node.name` and `node.project`.
fn is_name(text: &str) -> bool {
    sinew_runtime::name::check_node_name(text).is_ok()
}

const fn is_plain(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'.' | b'_' | b'~')
}

fn escaped(text: &str) -> String {
    text.bytes().fold(String::new(), |mut out, byte| {
        if is_plain(byte) {
            out.push(byte.into());
        } else {
            write!(out, "%{byte:02X}").expect("a String takes all that is written");
        }
        out
    })
}

fn unescaped(text: &str) -> Option<String> {
    let mut bytes = Vec::new();
    let mut rest = text.as_bytes();
    while let [first, more @ ..] = rest {
        if *first == b'%' {
            let (digits, after) = more.split_at_checked(2)?;
            bytes.push(u8::from_str_radix(str::from_utf8(digits).ok()?, 16).ok()?);
            rest = after;
        } else {
            bytes.push(*first);
            rest = more;
        }
    }
    String::from_utf8(bytes).ok()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn identity_has_one_spelling() {
        for wrong in [
            "",
            "sinew://walker",
            "sinew://walker/node/10.0.0.1",
            "sinew://walker/node/10.0.0.1/hip/",
            "sinew://walker/node/10.0.0.1/hip/x",
            "sinew://walker/nodes/10.0.0.1/hip",
            "sinew://walker/node/10.0.0.01/hip",
            "sinew://walker/node/0.0.0.0/hip",
            "sinew://walker/node/255.255.255.255/hip",
            "sinew://walker/node/10.0.0.1/%68ip",
            "sinew://walker/node/10.0.0.1/a%2fb",
            "sinew://walker/node/10.0.0.1/a%2",
            "sinew://walker/node/10.0.0.1/a%+1",
            "sinew://walker/node/10.0.0.1/%FF",
            "sinew://walker/node/10.0.0.1/%0A",
            "sinew:///node/10.0.0.1/hip",
            "SINEW://walker/node/10.0.0.1/hip",
            "https://walker/node/10.0.0.1/hip",
        ] {
            assert_eq!(Identity::from_uri(wrong), None, "{wrong}");
        }
        assert_eq!(project_of("sinew://walker/"), None);
        assert_eq!(project_of("sinew://my%20leg"), Some("my leg".to_owned()));
    }

    proptest! {
        #[test]
        fn written_identity_is_read_again(project in "\\PC{1,15}", name in "\\PC{1,15}", bits in 1..u32::MAX) {
            prop_assume!([&project, &name].iter().all(|one| sinew_runtime::name::check_node_name(one).is_ok()));
            let identity = Identity { project, address: NodeAddress::new(bits), name };
            prop_assert!(identity.uri().is_ascii());
            prop_assert_eq!(Identity::from_uri(&identity.uri()), Some(identity.clone()));
            prop_assert_eq!(project_of(&project_uri(&identity.project)), Some(identity.project));
        }

        #[test]
        fn any_text_is_an_identity_or_none(text in "(sinew://)?[a%/0-9.]{0,40}") {
            if let Some(identity) = Identity::from_uri(&text) {
                prop_assert_eq!(identity.uri(), text);
            }
        }
    }
}
