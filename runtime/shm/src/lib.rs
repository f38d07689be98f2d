//! Message rings in shared memory between two processes that need not trust each other.
//!
//! Each side creates one [`Region`]: a sealed piece of memory that only it can write and the other can only
//! read. It holds the ring of the messages that this side sends and this side's few header words. Both sides
//! exchange an [`Offer`] over a unix socket, check the other's offer, and have a [`Producer`] and a
//! [`Consumer`]:
//!
//! ```
//! use std::time::{Duration, Instant};
//! use sinew_shm::{BellKind, Capacity, Region, Terms, Wait};
//!
//! let capacity = Capacity::new(64 * 1024)?;
//! let (left, left_offer) = Region::create(capacity, BellKind::Futex)?;
//! let (right, right_offer) = Region::create(capacity, BellKind::Futex)?;
//! // Between processes: `left_offer.send(&socket)` here, `Offer::receive(&socket)` there.
//! let (mut producer, _) = left.connect(right_offer, &Terms::default())?;
//! let (_, mut consumer) = right.connect(left_offer, &Terms::default())?;
//!
//! let mut loan = producer.loan(5)?;          // memory in the ring
//! loan.copy_from_slice(b"hello");
//! loan.publish();                            // now it is a message; dropped instead, it would be given back
//!
//! let wait = Wait::until(Instant::now() + Duration::from_secs(1));
//! let message = consumer.receive_before(&wait)?;
//! assert_eq!(message.to_vec(), b"hello");    // dropping `message` returns its memory to the producer
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! A hostile peer can at worst send wrong bytes, be silent, consume no messages, or cause [`CorruptError`] on this
//! side. It cannot make this side read or write outside the ring, crash, hang or grow. The reasons are in
//! `docs/decisions/0010-shared-memory.md`.
//!
//! This crate does not depend on tokio, actors or layers. A reactor waits for [`Consumer::fd`] after
//! [`Consumer::arm`].

#![cfg_attr(
    not(target_os = "linux"),
    expect(dead_code, reason = "without sealed memory nothing behind `Region::create` is reached")
)]

mod any;
#[cfg(all(target_os = "linux", feature = "bare-ring", not(loom)))]
pub mod bare;
mod bell;
mod consumer;
mod core;
mod error;
#[cfg(all(target_os = "linux", any(test, feature = "hostile-peer"), not(any(loom, miri))))]
pub mod hostile;
pub mod journal;
mod layout;
mod memory;
mod offer;
mod producer;
mod region;
mod set_sleep;
mod spin;
mod trust;
mod wait;
mod wait_set;

#[cfg(target_os = "linux")]
#[path = "linux/mod.rs"]
mod platform;
#[cfg(not(target_os = "linux"))]
#[path = "elsewhere.rs"]
mod platform;

pub use any::{Any, ENDS_MAX, Ends, PollResult, Polling, Waiter};
pub use bell::{Bell, BellKind};
pub use consumer::{Consumer, MessageReader, Only, ReceivedMessage};
pub use error::{
    AnyError, CorruptError, CreateError, LoanError, OfferError, PassError, ReceiveError, RoomError,
};
pub use layout::{Capacity, CapacityError};
pub use offer::{
    Descriptors, OFFER_BYTES, Offer, Received, keep_urgent_in_line, peer_pidfd, set_descriptors,
};
pub use platform::{Counters, PeerCounters};
pub use producer::{Loan, Producer};
pub use region::{Accepted, Region, Terms};
pub use spin::Spin;
pub use wait::{Armed, HangUp, Wait};
pub use wait_set::{Ready, WaitSet};

/// Whether this platform has sealed shared memory; without it [`Region::create`] returns an error.
pub const SUPPORTED: bool = cfg!(target_os = "linux");
