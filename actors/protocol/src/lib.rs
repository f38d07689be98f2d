//! What a node and its clients both speak. Programs use it through the package `sinew`.
//!
//! | module | content |
//! | --- | --- |
//! | [`link_counts`] | the counts of messages on direct links, which a client keeps where its node can read them |
//! | [`observed`] | a message on a direct link, as a client reports it for a watch |
//! | [`payload`] | the payloads between LNCL and its clients |
//! | [`ring`] | frames in rings of shared memory, and how two processes exchange the rings |
//! | [`user_namespace`] | users that a namespace does not map |

pub mod link_counts;
pub mod observed;
pub mod payload;
pub mod ring;
pub mod user_namespace;
