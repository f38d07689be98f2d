//! What a node and its clients both speak. Programs use it through the package `sinew`.
//!
//! | module | content |
//! | --- | --- |
//! | [`payload`] | the payloads between LNCL and its clients |
//! | [`ring`] | frames in rings of shared memory, and how two processes exchange the rings |
//! | [`user_namespace`] | users that a namespace does not map |

pub mod payload;
pub mod ring;
pub mod user_namespace;
