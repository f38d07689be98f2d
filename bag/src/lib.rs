//! The files of recordings.
//!
//! A recording is one or more MCAP files, each of one node. [`BagWriter`] writes them: for each channel the payload as
//! it was sent (`msgpack`), and a view with a schema (`protobuf`) for Foxglove, PlotJuggler, Rerun and other tools.
//! `docs/protocol/recording.md` specifies the topics, the metadata and the fields.
//!
//! [`ViewWriter`] makes the same channels and views without a file, for programs that show messages as they come.
//!
//! [`read`] opens finished and unfinished files, [`check()`] proves that nothing is missing, [`info()`] sums a file up,
//! [`merge()`] puts the files of several nodes on one time line, and `export` writes CSV and Parquet, unless the
//! feature of this name is off.
//!
//! This package knows MCAP and [`sinew_schema::Schema`]. It knows no node, no socket and no clock: all times are
//! arguments.

pub mod check;
#[cfg(feature = "export")]
pub mod export;
pub mod info;
pub mod merge;
pub mod read;

mod clocks;
mod error;
mod messagepack;
mod protobuf;
mod sequences;
mod terms;
#[cfg(test)]
mod testing;
mod view;
mod writer;

pub use check::check;
pub use error::BagError;
#[cfg(feature = "export")]
pub use export::export;
pub use info::info;
pub use merge::merge;
pub use terms::{
    ChannelId, ChannelInfo, Class, ClockReading, Compression, Direction, Event, EventTopic, Level, Options,
    Origin, Party, Record, Totals,
};
pub use writer::{BagWriter, ViewChannel, ViewItem, ViewWriter};
