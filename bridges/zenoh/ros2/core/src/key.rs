//! Key expressions of topics and services, and the tokens by which ROS 2 shows nodes and topics.

use std::fmt;

use crate::name::TypeName;

/// The first part of each token.
const ADMIN: &str = "@ros2_lv";
/// An empty namespace or enclave in a token, and `/` in names.
const MANGLED: &str = "%";
/// The only quality of service of this bridge: reliable, volatile, the last 10 messages are kept.
pub const RELIABLE: &str = "::,10:,:,:,,";
/// Maximum bytes of a token that is read.
const TOKEN_BYTES_MAX: usize = 1_024;

/// Returns the key of a topic or service: `0/knee/angle/std_msgs::msg::dds_::Float64_/RIHS01_..`.
#[must_use]
pub fn topic_key(domain: u32, topic: &str, of: &TypeName, hash: &str) -> String {
    format!("{domain}/{}/{}/{hash}", topic.trim_start_matches('/'), of.dds())
}

/// A node as ROS 2 shows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GraphNode {
    /// The domain: `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// The identity of the session with the router.
    pub session: String,
    /// A number of the node within the session.
    pub id: u32,
    /// The namespace: `/` or `/leg`.
    pub namespace: String,
    /// The name.
    pub name: String,
}

/// The part of an endpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EndpointKind {
    /// Of a topic.
    Publisher,
    /// Of a topic.
    Subscription,
    /// The server of a service.
    Service,
    /// The client of a service.
    Client,
}

impl EndpointKind {
    const ALL: [Self; 4] = [Self::Publisher, Self::Subscription, Self::Service, Self::Client];

    const fn word(self) -> &'static str {
        match self {
            Self::Publisher => "MP",
            Self::Subscription => "MS",
            Self::Service => "SS",
            Self::Client => "SC",
        }
    }
}

/// A publisher, subscription, service or client of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Endpoint {
    /// Its part.
    pub kind: EndpointKind,
    /// A number of the endpoint within the session.
    pub id: u32,
    /// The topic or the service.
    pub topic: String,
    /// The type, as keys have it.
    pub dds_type: String,
    /// The hash of the type.
    pub hash: String,
}

/// A token that was read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Token {
    /// The node.
    pub node: GraphNode,
    /// The endpoint; `None` for the token of the node itself.
    pub endpoint: Option<Endpoint>,
}

fn mangle(name: &str) -> String {
    name.replace('/', MANGLED)
}

fn unmangle(name: &str) -> String {
    name.replace(MANGLED, "/")
}

impl GraphNode {
    /// Returns the token of the node.
    #[must_use]
    pub fn token(&self) -> String {
        format!("{ADMIN}/{}/{}/{}/{}/NN/{}", self.domain, self.session, self.id, self.id, self.place())
    }

    /// Returns the token of an endpoint of the node.
    #[must_use]
    pub fn endpoint_token(&self, endpoint: &Endpoint) -> String {
        let Endpoint { kind, id, topic, dds_type, hash } = endpoint;
        let (kind, topic) = (kind.word(), mangle(topic));
        format!(
            "{ADMIN}/{}/{}/{}/{id}/{kind}/{}/{topic}/{dds_type}/{hash}/{RELIABLE}",
            self.domain,
            self.session,
            self.id,
            self.place()
        )
    }

    /// Returns enclave, namespace and name.
    fn place(&self) -> String {
        format!("{MANGLED}/{}/{}", mangle(&self.namespace), self.name)
    }
}

impl fmt::Display for GraphNode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.namespace.trim_end_matches('/'), self.name)
    }
}

/// Reads a token of any node. `None`: it is none that this bridge knows.
#[must_use]
pub fn parse_token(text: &str) -> Option<Token> {
    if text.len() > TOKEN_BYTES_MAX {
        return None;
    }
    let parts: Vec<_> = text.split('/').collect();
    let [ADMIN, domain, session, node_id, id, kind, _enclave, namespace, name, rest @ ..] = &parts[..] else {
        return None;
    };
    let node = GraphNode {
        domain: domain.parse().ok()?,
        session: (*session).to_owned(),
        id: node_id.parse().ok()?,
        namespace: unmangle(namespace),
        name: unmangle(name),
    };
    let id = id.parse().ok()?;
    let endpoint = match (*kind, rest) {
        ("NN", []) => None,
        // Later versions of ROS 2 have parts behind the quality of service.
        (kind, [topic, dds_type, hash, _qos, ..]) => Some(Endpoint {
            kind: EndpointKind::ALL.into_iter().find(|known| known.word() == kind)?,
            id,
            topic: unmangle(topic),
            dds_type: (*dds_type).to_owned(),
            hash: (*hash).to_owned(),
        }),
        _ => return None,
    };
    Some(Token { node, endpoint })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const HASH: &str = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a";

    fn node() -> GraphNode {
        GraphNode {
            domain: 2,
            session: "f9980ee0495eaafb3e38f0d19e2eae12".to_owned(),
            id: 0,
            namespace: "/".to_owned(),
            name: "add_two_ints_server".to_owned(),
        }
    }

    /// The examples of the design document of rmw_zenoh.
    #[test]
    fn keys_and_tokens_are_those_of_rmw_zenoh() {
        let of = TypeName::parse("example_interfaces/srv/AddTwoInts").expect("a name");
        let key = topic_key(2, "/add_two_ints", &of, HASH);
        assert_eq!(key, format!("2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{HASH}"));
        let server = Endpoint {
            kind: EndpointKind::Service,
            id: 10,
            topic: "/add_two_ints".to_owned(),
            dds_type: of.dds(),
            hash: HASH.to_owned(),
        };
        let token = node().endpoint_token(&server);
        let expected = format!(
            "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server/%add_two_ints/\
             example_interfaces::srv::dds_::AddTwoInts_/{HASH}/::,10:,:,:,,"
        );
        assert_eq!(token, expected);
        assert_eq!(parse_token(&token), Some(Token { node: node(), endpoint: Some(server) }));
    }

    #[test]
    fn node_has_a_token_of_its_own() {
        let node = GraphNode { namespace: "/leg".to_owned(), ..node() };
        assert_eq!(
            node.token(),
            "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/0/NN/%/%leg/add_two_ints_server"
        );
        assert_eq!(parse_token(&node.token()), Some(Token { node: node.clone(), endpoint: None }));
        assert_eq!(node.to_string(), "/leg/add_two_ints_server");
    }

    proptest! {
        #[test]
        fn any_text_is_a_token_or_none(text in "(@ros2_lv)?(/[a-zA-Z0-9%:_]{0,6}){0,14}") {
            let _ = parse_token(&text);
        }
    }
}
