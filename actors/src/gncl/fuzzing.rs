//! What fuzzers may reach of this layer.

pub(crate) use super::{
    core::fuzzing::{A_LINK, handshake, handshakes, links},
    datagrams::fuzzing::{datagrams, some_datagrams},
};
