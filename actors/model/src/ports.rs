//! The traits by which the layers of one node call each other. No layer names another one: each implements
//! its port, and the node connects them.

use std::{
    collections::BTreeSet,
    fmt::Display,
    net::SocketAddr,
    pin::Pin,
    sync::{Arc, OnceLock, Weak},
};

use sinew_runtime::{
    mailbox::About,
    outcome::Rejection,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::Message,
};

use crate::{
    cause::Cause,
    directory::DirectoryEntry,
    facts::{LossReason, TypeDeclaration, User},
    undelivered::Report,
};

/// An incarnation of a node.
pub type NodeIncarnation = (NodeAddress, Incarnation);

/// The connections to other nodes: GNCL's port.
pub trait Links: Send + Sync {
    /// Returns the incarnations of nodes with an established connection.
    fn connected(&self) -> BTreeSet<NodeIncarnation>;

    /// Returns the current incarnation of `node`, if it was ever linked.
    fn incarnation(&self, node: NodeAddress) -> Option<Incarnation>;

    /// Requests a liveness reply of this incarnation. spec: NDL-4.7
    fn request_liveness(&self, incarnation: NodeIncarnation);

    /// Returns when something of this incarnation was last read.
    fn last_alive(&self, incarnation: NodeIncarnation) -> Option<Time>;

    /// Revokes the departure of this incarnation: the announcement was not its own.
    fn revoke_departure(&self, incarnation: NodeIncarnation);

    /// Records that this incarnation leaves: its last messages are awaited.
    fn record_departure(&self, now: Time, incarnation: NodeIncarnation);

    /// Accepts nothing more from this incarnation.
    fn fence(&self, incarnation: NodeIncarnation);

    /// Delivers an event about a node to an application of this node, behind the last message of that node.
    ///
    /// # Errors
    /// Same as [`Router::send`](sinew_runtime::router::Router::send); `QueueFull` also if too many events are held.
    fn notify_after_messages(&self, about: About, event: Message) -> Result<(), Rejection>;

    /// Delivers the held events, each in its turn. It never ends; a later call takes over.
    fn deliver_held_events(self: Arc<Self>) -> Pin<Box<dyn Future<Output = ()>>>;

    /// Returns the incarnation of `node` that was last authenticated, if nodes authenticate.
    fn authenticated_incarnation(&self, node: NodeAddress) -> Option<Incarnation>;

    /// Returns whether the certificate with which this incarnation was linked is on the deny list.
    fn is_revoked(&self, incarnation: NodeIncarnation) -> bool;

    /// Reports messages to the node that sent them, if it accepts reports.
    fn report_undelivered(&self, node: NodeAddress, report: &Report);
}

/// A node that NDL lost, and why.
#[derive(Clone, Debug)]
#[expect(missing_docs, reason = "each field is what its name says")]
pub struct LostMember {
    pub node: NodeAddress,
    pub incarnation: Incarnation,
    pub why: LossReason,
}

/// A node that is present.
#[derive(Clone, Debug)]
#[expect(missing_docs, reason = "each field is what its name says")]
pub struct Member {
    pub node: NodeAddress,
    pub incarnation: Incarnation,
    pub name: String,
    /// The addresses at which its GNCL listens.
    pub gncl: Vec<SocketAddr>,
}

/// A node of another project that was received.
#[derive(Clone, Debug)]
#[expect(missing_docs, reason = "each field is what its name says")]
pub struct ForeignNode {
    pub at: SocketAddr,
    pub name: String,
    pub project: String,
}

/// The known nodes: NDL's port.
pub trait Members: Send + Sync {
    /// Returns this node's own addresses at which it discovers others.
    fn paths(&self) -> Vec<SocketAddr>;

    /// Returns whether the node is a member that answers.
    fn answers(&self, node: NodeAddress) -> bool;

    /// Returns the remembered nodes that were members and have not returned.
    fn lost(&self) -> Vec<LostMember>;

    /// Returns the present nodes.
    fn present(&self) -> Vec<Member>;

    /// Returns the present and the lost nodes. `None` while NDL is busy: the caller's thread does not wait for it.
    fn in_brief(&self) -> Option<(Vec<Member>, Vec<LostMember>)>;

    /// Returns the received nodes of other projects if no other node of this project is present, else `None`.
    fn strangers_if_alone(&self) -> Option<Vec<ForeignNode>>;
}

/// The names of applications on all nodes: the sync manager's port.
pub trait Names: Send + Sync {
    /// Returns the TIDs of the applications called `name`: the local one first, then by readiness. spec: SYNC-6
    fn called(&self, name: &str) -> Vec<Tid>;

    /// Returns all known names.
    fn all(&self) -> Vec<String>;

    /// Returns every application with a name, of all nodes.
    fn directory(&self) -> Vec<DirectoryEntry>;

    /// Returns what `app` waits for, and why. `None` while the sync manager is busy: the caller's thread does not
    /// wait for it.
    fn missing_in_brief(&self, app: AppAddress) -> Option<Vec<(String, &'static str)>>;
}

/// The lifecycle of applications, which others monitor: a port of the sync manager. The caller may hold its own locks.
pub trait AppLifecycle: Send + Sync {
    /// Records that an application of this node got its address.
    fn began(&self, app: AppAddress, user: User);

    /// Records that an incarnation of the application ended. It is restarted, or is removed (`is_gone`).
    fn ended(&self, app: AppAddress, cause: Cause, is_gone: bool);

    /// Drops the wills of a node with a revoked certificate. The caller holds no lock. spec: WILL-5
    fn revoke(&self, incarnation: NodeIncarnation);
}

/// The applications of this node: LNCL's port.
pub trait Applications: Send + Sync {
    /// Returns the name of an application, or its address as text if it has none.
    fn title_of(&self, app: AppAddress) -> String;

    /// Returns the application of this node called `name`.
    fn resolve(&self, name: &str) -> Option<AppAddress>;

    /// Observes the direct links of the applications that the routing table's taps watch now, and of no others: their
    /// processes report the messages to the taps. Called after each change of a tap.
    fn observe_links(&self);

    /// Adds the rejections that `node` reports. Calls `refuse` for each that `node` cannot have caused.
    fn undelivered_elsewhere(&self, node: NodeAddress, report: Report, refuse: &mut dyn FnMut(&dyn Display));
}

/// The payload types of this node's applications: a port of the node. The caller holds the lock of LNCL's registry, so
/// that each call is about the current owner of the address.
pub trait AppTypes: Send + Sync {
    /// Records a type of an application in another process.
    ///
    /// # Errors
    /// The declaration is no valid one, or there is no room for it. Messages of the type are not compared then.
    fn declare(&self, app: AppAddress, user: User, declaration: TypeDeclaration) -> Result<(), String>;

    /// Removes the types of an application that is not registered any more.
    fn forget(&self, app: AppAddress);
}

/// The ports of one node. A layer that a test has not started is not connected.
#[derive(Default)]
pub struct Ports {
    links: Port<dyn Links>,
    members: Port<dyn Members>,
    names: Port<dyn Names>,
    app_lifecycle: Port<dyn AppLifecycle>,
    applications: Port<dyn Applications>,
    app_types: Port<dyn AppTypes>,
}

struct Port<T: ?Sized>(OnceLock<Weak<T>>);

impl<T: ?Sized> Default for Port<T> {
    fn default() -> Self {
        Self(OnceLock::new())
    }
}

impl<T: ?Sized> Port<T> {
    /// The first connection counts: a node connects each port once.
    fn connect(&self, to: &Arc<T>) {
        let _ = self.0.set(Arc::downgrade(to));
    }

    fn get(&self) -> Option<Arc<T>> {
        self.0.get()?.upgrade()
    }
}

macro_rules! ports {
    ($($name:ident, $connect:ident: $port:ident;)*) => {
        impl Ports {
            $(
                #[doc = concat!("Returns the port [`", stringify!($port), "`], if it is connected.")]
                pub fn $name(&self) -> Option<Arc<dyn $port>> {
                    self.$name.get()
                }

                #[doc = concat!("Connects the port [`", stringify!($port), "`].")]
                pub fn $connect(&self, to: &Arc<dyn $port>) {
                    self.$name.connect(to);
                }
            )*
        }
    };
}

ports! {
    links, connect_links: Links;
    members, connect_members: Members;
    names, connect_names: Names;
    app_lifecycle, connect_app_lifecycle: AppLifecycle;
    applications, connect_applications: Applications;
    app_types, connect_app_types: AppTypes;
}

#[cfg(any(test, feature = "testing"))]
#[doc(hidden)]
pub mod testing {
    //! Ports that a test implements.

    use std::sync::Mutex;

    use sinew_runtime::lock;

    use super::*;

    /// Links in a state that the test sets. They deliver no event.
    #[derive(Debug, Default)]
    #[expect(missing_docs, reason = "each field is what its name says")]
    pub struct PlayedLinks {
        pub linked: Option<Incarnation>,
        pub authenticated: Option<Incarnation>,
        pub revoked: Mutex<Vec<NodeIncarnation>>,
        pub left: Mutex<Vec<NodeIncarnation>>,
    }

    impl Links for PlayedLinks {
        fn connected(&self) -> BTreeSet<NodeIncarnation> {
            BTreeSet::new()
        }

        fn incarnation(&self, _: NodeAddress) -> Option<Incarnation> {
            self.linked
        }

        fn request_liveness(&self, _: NodeIncarnation) {}

        fn last_alive(&self, _: NodeIncarnation) -> Option<Time> {
            None
        }

        fn revoke_departure(&self, incarnation: NodeIncarnation) {
            lock(&self.left).retain(|left| *left != incarnation);
        }

        fn record_departure(&self, _: Time, incarnation: NodeIncarnation) {
            lock(&self.left).push(incarnation);
        }

        fn fence(&self, _: NodeIncarnation) {}

        fn notify_after_messages(&self, _: About, _: Message) -> Result<(), Rejection> {
            Ok(())
        }

        fn deliver_held_events(self: Arc<Self>) -> Pin<Box<dyn Future<Output = ()>>> {
            Box::pin(std::future::pending())
        }

        fn authenticated_incarnation(&self, _: NodeAddress) -> Option<Incarnation> {
            self.authenticated
        }

        fn is_revoked(&self, incarnation: NodeIncarnation) -> bool {
            lock(&self.revoked).contains(&incarnation)
        }

        fn report_undelivered(&self, _: NodeAddress, _: &Report) {}
    }
}
