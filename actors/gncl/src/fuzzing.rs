//! The functions of this layer that fuzzers may call.

pub use super::{
    core::fuzzing::{A_LINK, handshake, handshakes, links},
    datagrams::fuzzing::{datagrams, some_datagrams},
};
