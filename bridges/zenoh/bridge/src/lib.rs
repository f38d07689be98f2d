//! The rules of the bridge between Sinew and programs that speak Zenoh. Pure: keys, payloads and times come in as
//! arguments.
//!
//! | module | content |
//! | --- | --- |
//! | [`key`] | key expressions: of messages, and of liveliness tokens |
//! | [`file`](mod@file) | the configuration file |
//! | [`rules`] | the allow-list of both directions |
//! | [`payload`] | payloads on their way between both sides |
//! | [`value`] | payloads as MessagePack and as JSON |
//! | [`typed`] | payloads that must have the structure of their type |
//! | [`attachment`] | the header of a message, which the bridge adds for Zenoh |
//! | [`outcome`] | outcomes as replies |
//! | [`qos`] | classes as priorities of Zenoh |
//! | [`counts`] | counters of passed and refused messages |

pub mod attachment;
pub mod counts;
pub mod file;
pub mod key;
pub mod outcome;
pub mod payload;
pub mod qos;
pub mod rules;
pub mod typed;
pub mod value;

pub use counts::{Counts, Passed, Refusal};
pub use file::{Config, ConfigError};
pub use key::{Address, Target};
pub use rules::{Arrival, Encoding, Get, InRoute, OutRoute, Rules};
pub use value::{MalformedError, Value};
