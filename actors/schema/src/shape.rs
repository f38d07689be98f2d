//! The structure of a type as data.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// The structure of a payload type.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Schema {
    /// The structure of the payload itself: [`Shape::Named`] for a struct or an enum that occurs in itself, otherwise
    /// the structure in place.
    pub root: Shape,
    /// The structs, newtypes and enums inside it, by the name that they have in Rust (or by `#[serde(rename)]`). These
    /// names do not travel in messages. They show units, as in `Degrees(f32)`.
    pub types: BTreeMap<String, Shape>,
}

impl Schema {
    /// Returns the shape that a name stands for, or the shape itself if it is no name. `None`: the schema does not have
    /// the name, which a parsed schema always has.
    #[must_use]
    pub fn resolve<'s>(&'s self, shape: &'s Shape) -> Option<&'s Shape> {
        if let Shape::Named(name) = shape { self.types.get(name) } else { Some(shape) }
    }
}

/// The structure of one value.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Shape {
    /// No value: `()`, or a struct without fields.
    Unit,
    /// `bool`
    Bool,
    /// `i8`
    I8,
    /// `i16`
    I16,
    /// `i32`
    I32,
    /// `i64`
    I64,
    /// `i128`
    I128,
    /// `u8`
    U8,
    /// `u16`
    U16,
    /// `u32`
    U32,
    /// `u64`
    U64,
    /// `u128`
    U128,
    /// `f32`
    F32,
    /// `f64`
    F64,
    /// `char`
    Char,
    /// `String`
    Text,
    /// Bytes, as `serde_bytes` writes them.
    Bytes,
    /// `Option<T>`: the value, or nil.
    Option(Box<Self>),
    /// `Vec<T>` or a set: any number of values.
    List(Box<Self>),
    /// `[T; N]`
    Array(Box<Self>, usize),
    /// A tuple, or a struct with several fields without names.
    Tuple(Vec<Self>),
    /// A map from keys to values.
    Map(Box<Self>, Box<Self>),
    /// A struct with named fields, in the order of their declaration.
    Struct(Vec<Field>),
    /// A struct with one field without a name. On the wire it is that field.
    Newtype(Box<Self>),
    /// An enum, with its variants in the order of their declaration.
    Enum(Vec<Variant>),
    /// The type of this name in [`Schema::types`].
    Named(String),
}

/// A field of a struct.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Field {
    /// The name on the wire.
    pub name: String,
    /// The structure of its values.
    pub shape: Shape,
    /// Whether a receiver accepts a message without it: `#[serde(default)]` or an `Option`.
    pub optional: bool,
}

/// A variant of an enum.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Variant {
    /// The name on the wire.
    pub name: String,
    /// [`Shape::Unit`], [`Shape::Newtype`], [`Shape::Tuple`] or [`Shape::Struct`].
    pub shape: Shape,
}
