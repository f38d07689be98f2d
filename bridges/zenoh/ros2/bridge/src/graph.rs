//! Tokens by which ROS 2 sees nodes, topics and services, and the identities behind them.

use std::sync::{
    Mutex, PoisonError,
    atomic::{AtomicU32, Ordering},
};

use sinew_ros2_core::{Endpoint, EndpointKind, GraphNode, Structure, TypeName, topic_key, type_hash};
use zenoh::{Session, Wait as _, liveliness::LivelinessToken};

/// The session with a router, and the tokens that are declared in it.
pub(crate) struct Graph {
    pub(crate) session: Session,
    domain: u32,
    next: AtomicU32,
    tokens: Mutex<Vec<LivelinessToken>>,
}

/// A declared endpoint.
#[derive(Clone, Debug)]
pub(crate) struct Declared {
    /// Its key for puts and requests.
    pub(crate) key: String,
    /// Its identity in attachments.
    pub(crate) gid: [u8; 16],
}

impl Graph {
    pub(crate) fn new(session: Session, domain: u32) -> Self {
        Self { session, domain, next: AtomicU32::new(0), tokens: Mutex::default() }
    }

    /// Returns the domain.
    pub(crate) const fn domain(&self) -> u32 {
        self.domain
    }

    fn next(&self) -> u32 {
        self.next.fetch_add(1, Ordering::Relaxed)
    }

    fn declare(&self, token: String) -> Result<(), String> {
        let declared = self.session.liveliness().declare_token(token).wait();
        let token = declared.map_err(|why| format!("zenoh: a token was not declared: {why}"))?;
        self.tokens.lock().unwrap_or_else(PoisonError::into_inner).push(token);
        Ok(())
    }

    /// Declares a node.
    pub(crate) fn node(&self, namespace: &str, name: &str) -> Result<GraphNode, String> {
        let node = GraphNode {
            domain: self.domain,
            session: self.session.zid().to_string(),
            id: self.next(),
            namespace: namespace.to_owned(),
            name: name.to_owned(),
        };
        self.declare(node.token())?;
        Ok(node)
    }

    /// Declares a publisher, a subscription or a service of a node. `described` is the structure of which the hash is.
    pub(crate) fn endpoint(
        &self,
        node: &GraphNode,
        kind: EndpointKind,
        topic: &str,
        (of, described): (&TypeName, &Structure),
    ) -> Result<Declared, String> {
        let (id, hash) = (self.next(), type_hash(described));
        let key = topic_key(self.domain, topic, of, &hash);
        let endpoint = Endpoint { kind, id, topic: topic.to_owned(), dds_type: of.dds(), hash };
        self.declare(node.endpoint_token(&endpoint))?;
        Ok(Declared { key, gid: self.gid(id) })
    }

    /// Returns an identity that no other endpoint has: that of the session, with the number of the endpoint in it.
    fn gid(&self, id: u32) -> [u8; 16] {
        let mut gid = self.session.zid().to_le_bytes();
        gid.iter_mut().zip(id.to_le_bytes()).for_each(|(byte, part)| *byte ^= part);
        gid
    }
}
