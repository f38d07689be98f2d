//! Writes the records of a node's journal into the file of a recording.
//!
//! ```text
//! journal (sinew-shm) ──► Recorder: order, names, counters ──► BagWriter (sinew-bag) ──► walk.mcap
//! ```
//!
//! [`Recorder`] takes a reader of the journal and a writer of the file. Its owner calls [`Recorder::pump`] every few
//! milliseconds. It knows no node, no socket and no clock: names and times are arguments. So the command `sinew record`
//! and a program use the same code.

mod channels;
mod facts;
mod names;
mod order;
mod recorder;
mod sink;
mod span;
#[cfg(test)]
mod tests;

pub use names::Names;
pub use order::WINDOW;
pub use recorder::{Recorder, Setup};
pub use sinew_shm::journal::{JournalReader, ReadJournalError, Start};
pub use span::Span;
