//! The picture of a run as SVG, written by hand: no fonts, no drawing library, the same text for the same record.

mod canvas;
mod contrast;
mod figure;
mod strides;

pub use contrast::{Contrast, ContrastPoint, ContrastSide, contrast};
pub use figure::{Figure, Lateness, figure};
