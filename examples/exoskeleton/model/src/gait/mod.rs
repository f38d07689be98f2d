//! Human walking as data: reference curves, the band around them, and recorded trials.

pub mod band;
pub mod curves;
pub mod filter;
pub mod motion;
pub mod spline;
pub mod table;
pub mod trial;
