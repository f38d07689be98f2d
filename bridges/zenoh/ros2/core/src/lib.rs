//! The rules between Sinew and ROS 2 over Zenoh, as `rmw_zenoh` speaks it. Pure: bytes, texts and times are arguments.
//!
//! ```text
//! payload (MessagePack) ──► Outgoing ──► value ──► CDR ──► put under the key of the topic
//! put under the key of a topic ──► Incoming ──► value ──► payload, or a Refusal
//! ```
//!
//! | module | content |
//! | --- | --- |
//! | `name` | names of types, topics and nodes |
//! | `definition` | the parser of `.msg` and `.srv` texts |
//! | `catalog` | known definitions, those that are shipped among them, and types made of them |
//! | `hash` | RIHS01 hashes of types |
//! | `value`, `cdr` | messages as values, and their bytes |
//! | `key`, `attachment` | key expressions, tokens of the graph, attachments |
//! | `payload` | payloads of Sinew as values |
//! | `path`, `convert` | fields, and numbers with their factors |
//! | `mapping` | the mapping file |
//! | `outgoing`, `incoming` | one topic of each direction, with its limits |

mod attachment;
mod catalog;
mod cdr;
mod convert;
mod definition;
mod hash;
mod incoming;
mod key;
pub mod mapping;
mod name;
mod outgoing;
mod pace;
mod path;
mod payload;
mod value;

pub use attachment::{Attachment, AttachmentError};
pub use catalog::{Catalog, CatalogError, Count, Element, Member, Service, Structure};
pub use cdr::{CdrError, MESSAGE_BYTES_MAX, decode, encode};
pub use convert::ConvertError;
pub use definition::DefinitionError;
pub use hash::type_hash;
pub use incoming::{Cause, Incoming, Receiver, Refusal, SealLimits, SendClass};
pub use key::{Endpoint, EndpointKind, GraphNode, RELIABLE, Token, parse_token, topic_key};
pub use name::{NameError, TypeName, check_topic};
pub use outgoing::{Input, Outgoing};
pub use payload::{Payload, PayloadError};
pub use value::Value;
