//! The messages and events that a client receives.

use sinew::{
    Payload as _,
    client::Received,
    events::{DirectoryEvent, NodeEvent},
    message::Kind,
};

/// The kind of the echoes of a receiver of protected payloads. They are for the endpoint alone.
const ECHO: Kind = sinew::protection::raw::ECHO;

/// A message or an event.
#[derive(Debug)]
pub enum Seen {
    /// A message of an application. It counts as handled when it is dropped.
    Message(Received),
    /// The directory of names has changed.
    Directory(DirectoryEvent),
    /// A node was found, lost, or has a stalled application.
    Node(NodeEvent),
    /// A message for the endpoint itself, or an event of another version of Sinew.
    Other,
}

impl Seen {
    pub(crate) fn of(received: Received) -> Self {
        // A node alone sends these: their sources are layers.
        let kind = received.kind();
        let is_of_layer = received.source().app.is_layer();
        if kind == DirectoryEvent::KIND && is_of_layer {
            return received.decode().map_or(Self::Other, Self::Directory);
        }
        if kind == NodeEvent::KIND && is_of_layer {
            return received.decode().map_or(Self::Other, Self::Node);
        }
        if kind == ECHO {
            return Self::Other;
        }
        Self::Message(received)
    }
}
