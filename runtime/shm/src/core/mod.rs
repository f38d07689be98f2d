//! The protocol of a ring, over any memory: who may write what when, in which order the other side sees it, and who has to
//! be woken. No system call, no clock.

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
