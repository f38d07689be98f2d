//! The structure of payload types.
//!
//! A [`Schema`] names the fields, the variants and the number types of a payload, as they are on the wire. So
//! nodes can name the differences between two versions of a type, and tools can decode a payload of a type that they
//! were not built with.
//!
//! This package knows no message, no node and no clock.

mod compare;
mod encoding;
mod listing;
mod shape;
mod trace;

pub use compare::{Comparison, DIFFERENCES_MAX, Difference, compare};
pub use encoding::{
    NAME_BYTES_MAX, PARTS_MAX, SCHEMA_BYTES_MAX, SHAPE_DEPTH_MAX, SchemaError, SchemaHash, TYPES_MAX,
};
pub use shape::{Field, Schema, Shape, Variant};
pub use trace::{TraceError, Wire};
