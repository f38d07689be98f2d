//! The protocol of a ring, over any memory: write access, the order of stores that the other side sees, and
//! wakes. No system call, no clock.

pub(crate) mod consumer;
pub(crate) mod producer;
pub(crate) mod sleep;

#[cfg(all(test, loom))]
mod loom;
#[cfg(test)]
mod model;
#[cfg(all(test, not(loom)))]
mod tests;

pub(crate) use consumer::{ConsumerCore, Record};
pub(crate) use producer::ProducerCore;
