//! The picture of a run as SVG, written by hand: no fonts, no drawing library, the same text for the same record.

mod canvas;
mod figure;
mod strides;

pub use figure::{Figure, Lateness, figure};
