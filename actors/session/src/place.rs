//! The places at which messages are counted.

use std::fmt;

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    name::shown,
    tid::{AppAddress, NodeAddress},
    wire::Class,
};

/// Maximum number of displayed characters of a text from another node.
const SHOWN_MAX: usize = 63;

/// A place at which messages are counted. A message passes several places, one after the other.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Place {
    /// The mailbox of an application of the node, either in the node's process or in a process of its own.
    Mailbox {
        /// The address of the application.
        app: AppAddress,
        /// The name of the application.
        name: String,
        /// The class of the counted messages.
        class: Class,
    },
    /// Messages that the node forwards to an application that another process has registered.
    Client {
        /// The address of the application.
        app: AppAddress,
        /// The name of the application.
        name: String,
    },
    /// Messages on the direct link of two applications, in one direction. Their processes count them.
    DirectLink {
        /// The address of the sender.
        from: AppAddress,
        /// The name of the sender.
        from_name: String,
        /// The address of the receiver.
        to: AppAddress,
        /// The name of the receiver.
        to_name: String,
    },
    /// Messages to another node: delivered once that node has acknowledged them.
    ToNode {
        /// The address of the other node.
        node: NodeAddress,
        /// The class of the counted messages; `None` if all classes share one connection.
        class: Option<Class>,
    },
    /// Messages that another node has sent to this one.
    FromNode {
        /// The address of the other node.
        node: NodeAddress,
        /// The class of the counted messages; `None` if all classes share one connection.
        class: Option<Class>,
    },
    /// Mailboxes that have ended, or that did not fit into an answer.
    OtherMailboxes,
    /// Clients that have disconnected, or that did not fit into an answer.
    OtherClients,
    /// Direct links that have ended, or that did not fit into an answer.
    OtherDirectLinks,
    /// Messages to incarnations of nodes that have ended.
    ToFormerNodes,
    /// Messages from incarnations of nodes that have ended.
    FromFormerNodes,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // A name from another node must not forge a line or fill the screen.
        match self {
            Self::Mailbox { app, name, class } => {
                write!(f, "mailbox {} ({app}), {class:?}", cut(name))
            }
            Self::Client { app, name } => write!(f, "client {} ({app})", cut(name)),
            Self::DirectLink { from, from_name, to, to_name } => {
                write!(f, "direct {} ({from}) -> {} ({to})", cut(from_name), cut(to_name))
            }
            Self::ToNode { node, class: Some(class) } => write!(f, "to {node}, {class:?}"),
            Self::ToNode { node, class: None } => write!(f, "to {node}"),
            Self::FromNode { node, class: Some(class) } => write!(f, "from {node}, {class:?}"),
            Self::FromNode { node, class: None } => write!(f, "from {node}"),
            Self::OtherMailboxes => f.write_str("other mailboxes, and ended ones"),
            Self::OtherClients => f.write_str("other clients, and ended ones"),
            Self::OtherDirectLinks => f.write_str("other direct links, and ended ones"),
            Self::ToFormerNodes => f.write_str("to ended incarnations of nodes"),
            Self::FromFormerNodes => f.write_str("from ended incarnations of nodes"),
        }
    }
}

/// Returns a text of another node as displayed: it cannot forge a line, and is no longer than a name.
#[must_use]
pub fn cut(text: &str) -> String {
    let text = shown(text);
    match text.char_indices().nth(SHOWN_MAX) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text,
    }
}
