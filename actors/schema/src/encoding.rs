//! The canonical bytes of a schema, and its hash over them.
//!
//! A schema has exactly one encoding:
//!
//! - a byte with the version, 1;
//! - the shape of the root;
//! - the number of types, and each of them in the order of the bytes of its name: name, shape.
//!
//! A shape is a byte with its tag, and its parts. A number is an LEB128 of at most 5 bytes in its shortest form, for
//! values of 32 bits. A text is the number of its bytes, and these. `docs/protocol/schema.md` has the tags.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt,
};

use crate::shape::{Field, Schema, Shape, Variant};

/// Maximum length of an encoded schema, in bytes.
pub const SCHEMA_BYTES_MAX: usize = 8 * 1_024;
/// Maximum length of the name of a type, a field or a variant, in bytes.
pub const NAME_BYTES_MAX: usize = 255;
/// Maximum depth of a shape; the types that it names are not counted.
pub const SHAPE_DEPTH_MAX: usize = 32;
/// Maximum number of types inside a schema.
pub const TYPES_MAX: usize = 256;
/// Maximum number of fields, variants or parts of one shape.
pub const PARTS_MAX: usize = 1_024;

const VERSION: u8 = 1;

/// Shapes without parts, by their tags.
const LEAVES: [Shape; 17] = [
    Shape::Unit,
    Shape::Bool,
    Shape::I8,
    Shape::I16,
    Shape::I32,
    Shape::I64,
    Shape::I128,
    Shape::U8,
    Shape::U16,
    Shape::U32,
    Shape::U64,
    Shape::U128,
    Shape::F32,
    Shape::F64,
    Shape::Char,
    Shape::Text,
    Shape::Bytes,
];
const OPTION: u8 = 17;
const LIST: u8 = 18;
const ARRAY: u8 = 19;
const TUPLE: u8 = 20;
const MAP: u8 = 21;
const STRUCT: u8 = 22;
const NEWTYPE: u8 = 23;
const ENUM: u8 = 24;
const NAMED: u8 = 25;

/// The identity of a structure: equal for equal schemas, in every build and on every platform.
///
/// It is FNV-1a of 64 bits over the canonical encoding. It tells versions of a type apart and is no protection against
/// an attacker: two schemas with one hash can be constructed.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
#[serde(transparent)]
pub struct SchemaHash(pub u64);

impl fmt::Display for SchemaHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:016x}", self.0)
    }
}

impl fmt::Debug for SchemaHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// The reason why bytes are no schema.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SchemaError {
    /// There are too many bytes.
    #[error("its structure takes more than {SCHEMA_BYTES_MAX} bytes")]
    TooLong,
    /// The bytes end in the middle.
    #[error("the bytes of a structure end in the middle")]
    Short,
    /// There are bytes behind the end.
    #[error("there are bytes behind the end of a structure")]
    Rest,
    /// The version or a tag is of another build.
    #[error("a structure has an unknown form: it was written by another version of Sinew")]
    Unknown,
    /// A number, an order or a name has another form than the canonical one.
    #[error("the bytes of a structure are not canonical")]
    NotCanonical,
    /// It has more types, parts or levels than allowed, or longer names.
    #[error("a structure has too many types, parts or levels, or too long a name")]
    TooMuch,
    /// A name has no type, or a type has no use.
    #[error("a structure names a type that it does not have, or has one that it does not name")]
    Dangling,
    /// A type contains itself without a byte in between.
    #[error("a type contains nothing but itself")]
    Endless,
}

impl Schema {
    /// Returns the canonical bytes of the schema.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![VERSION];
        write_shape(&self.root, &mut bytes);
        write_number(self.types.len(), &mut bytes);
        for (name, shape) in &self.types {
            write_text(name, &mut bytes);
            write_shape(shape, &mut bytes);
        }
        bytes
    }

    /// Returns the hash of the schema.
    #[must_use]
    pub fn hash(&self) -> SchemaHash {
        let fnv = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        SchemaHash(self.encode().iter().fold(0xcbf2_9ce4_8422_2325, fnv))
    }

    /// Reads the bytes of [`encode`](Self::encode).
    ///
    /// # Errors
    /// The bytes are not the canonical encoding of a schema within the limits.
    pub fn parse(bytes: &[u8]) -> Result<Self, SchemaError> {
        if bytes.len() > SCHEMA_BYTES_MAX {
            return Err(SchemaError::TooLong);
        }
        let mut reader = Reader { bytes };
        if reader.byte()? != VERSION {
            return Err(SchemaError::Unknown);
        }
        let root = reader.shape(0)?;
        let mut types = BTreeMap::new();
        for _ in 0..reader.count(TYPES_MAX)? {
            let name = reader.text()?;
            if types.last_key_value().is_some_and(|(last, _)| *last >= name) {
                return Err(SchemaError::NotCanonical);
            }
            types.insert(name, reader.shape(0)?);
        }
        if !reader.bytes.is_empty() {
            return Err(SchemaError::Rest);
        }
        let schema = Self { root, types };
        schema.check_names()?;
        Ok(schema)
    }

    /// Checks that each name has a type, that each type is named from the root, and that none contains only itself.
    fn check_names(&self) -> Result<(), SchemaError> {
        let mut named = BTreeSet::new();
        let mut open = vec![&self.root];
        while let Some(shape) = open.pop() {
            if let Shape::Named(name) = shape {
                let defined = self.types.get(name).ok_or(SchemaError::Dangling)?;
                if named.insert(name.as_str()) {
                    open.push(defined);
                }
            }
            shape.parts(|part| open.push(part));
        }
        if named.len() != self.types.len() {
            return Err(SchemaError::Dangling);
        }
        // Each step has a byte of the encoding, unless it leads back to one from before.
        for shape in self.types.values().chain([&self.root]) {
            let (mut next, mut steps) = (shape, 0);
            while let Some(inner) = self.without_bytes(next) {
                (next, steps) = (inner, steps + 1);
                if steps > SCHEMA_BYTES_MAX {
                    return Err(SchemaError::Endless);
                }
            }
        }
        Ok(())
    }

    /// Returns the shape that begins with the same byte: a newtype and an option take none of their own.
    fn without_bytes<'s>(&'s self, shape: &'s Shape) -> Option<&'s Shape> {
        if let Shape::Newtype(inner) | Shape::Option(inner) = shape {
            return Some(inner);
        }
        if let Shape::Named(name) = shape { self.types.get(name) } else { None }
    }
}

impl Shape {
    /// Calls `each` with each shape that is directly inside this one.
    pub fn parts<'s>(&'s self, mut each: impl FnMut(&'s Self)) {
        match self {
            Self::Option(inner) | Self::List(inner) | Self::Array(inner, _) | Self::Newtype(inner) => {
                each(inner)
            }
            Self::Tuple(parts) => parts.iter().for_each(each),
            Self::Map(key, value) => {
                each(key);
                each(value);
            }
            Self::Struct(fields) => fields.iter().for_each(|field| each(&field.shape)),
            Self::Enum(variants) => variants.iter().for_each(|variant| each(&variant.shape)),
            Self::Unit
            | Self::Bool
            | Self::I8
            | Self::I16
            | Self::I32
            | Self::I64
            | Self::I128
            | Self::U8
            | Self::U16
            | Self::U32
            | Self::U64
            | Self::U128
            | Self::F32
            | Self::F64
            | Self::Char
            | Self::Text
            | Self::Bytes
            | Self::Named(_) => {}
        }
    }
}

fn write_shape(shape: &Shape, out: &mut Vec<u8>) {
    if let Some(tag) = LEAVES.iter().position(|leaf| leaf == shape) {
        return out.push(tag as u8);
    }
    match shape {
        Shape::Option(inner) => write_inner(OPTION, inner, out),
        Shape::List(inner) => write_inner(LIST, inner, out),
        Shape::Newtype(inner) => write_inner(NEWTYPE, inner, out),
        Shape::Array(inner, length) => {
            write_inner(ARRAY, inner, out);
            write_number(*length, out);
        }
        Shape::Tuple(parts) => {
            out.push(TUPLE);
            write_number(parts.len(), out);
            parts.iter().for_each(|part| write_shape(part, out));
        }
        Shape::Map(key, value) => {
            write_inner(MAP, key, out);
            write_shape(value, out);
        }
        Shape::Struct(fields) => {
            out.push(STRUCT);
            write_number(fields.len(), out);
            for field in fields {
                write_text(&field.name, out);
                out.push(u8::from(field.optional));
                write_shape(&field.shape, out);
            }
        }
        Shape::Enum(variants) => {
            out.push(ENUM);
            write_number(variants.len(), out);
            for variant in variants {
                write_text(&variant.name, out);
                write_shape(&variant.shape, out);
            }
        }
        Shape::Named(name) => {
            out.push(NAMED);
            write_text(name, out);
        }
        // Written above.
        Shape::Unit
        | Shape::Bool
        | Shape::I8
        | Shape::I16
        | Shape::I32
        | Shape::I64
        | Shape::I128
        | Shape::U8
        | Shape::U16
        | Shape::U32
        | Shape::U64
        | Shape::U128
        | Shape::F32
        | Shape::F64
        | Shape::Char
        | Shape::Text
        | Shape::Bytes => {}
    }
}

fn write_inner(tag: u8, inner: &Shape, out: &mut Vec<u8>) {
    out.push(tag);
    write_shape(inner, out);
}

fn write_number(number: usize, out: &mut Vec<u8>) {
    let mut rest = u32::try_from(number).unwrap_or(u32::MAX);
    while rest >= 0x80 {
        out.push(rest as u8 | 0x80);
        rest >>= 7;
    }
    out.push(rest as u8);
}

fn write_text(text: &str, out: &mut Vec<u8>) {
    write_number(text.len(), out);
    out.extend(text.as_bytes());
}

struct Reader<'b> {
    bytes: &'b [u8],
}

impl Reader<'_> {
    fn byte(&mut self) -> Result<u8, SchemaError> {
        let (first, rest) = self.bytes.split_first().ok_or(SchemaError::Short)?;
        self.bytes = rest;
        Ok(*first)
    }

    fn number(&mut self) -> Result<usize, SchemaError> {
        let mut number: u64 = 0;
        for shift in [0, 7, 14, 21, 28] {
            let byte = self.byte()?;
            number |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                let is_shortest = byte != 0 || shift == 0;
                let number = u32::try_from(number).map_err(|_| SchemaError::NotCanonical)?;
                return if is_shortest { Ok(number as usize) } else { Err(SchemaError::NotCanonical) };
            }
        }
        Err(SchemaError::NotCanonical)
    }

    /// Reads a number of parts. Each of them has at least one byte: none is reserved for that does not follow.
    fn count(&mut self, max: usize) -> Result<usize, SchemaError> {
        let count = self.number()?;
        match count {
            _ if count > max => Err(SchemaError::TooMuch),
            _ if count > self.bytes.len() => Err(SchemaError::Short),
            _ => Ok(count),
        }
    }

    fn text(&mut self) -> Result<String, SchemaError> {
        let length = self.count(NAME_BYTES_MAX)?;
        let (text, rest) = self.bytes.split_at_checked(length).ok_or(SchemaError::Short)?;
        self.bytes = rest;
        std::str::from_utf8(text).map(str::to_owned).map_err(|_| SchemaError::NotCanonical)
    }

    fn inner(&mut self, depth: usize) -> Result<Box<Shape>, SchemaError> {
        self.shape(depth + 1).map(Box::new)
    }

    fn shape(&mut self, depth: usize) -> Result<Shape, SchemaError> {
        if depth > SHAPE_DEPTH_MAX {
            return Err(SchemaError::TooMuch);
        }
        let tag = self.byte()?;
        if let Some(leaf) = LEAVES.get(usize::from(tag)) {
            return Ok(leaf.clone());
        }
        Ok(match tag {
            OPTION => Shape::Option(self.inner(depth)?),
            LIST => Shape::List(self.inner(depth)?),
            NEWTYPE => Shape::Newtype(self.inner(depth)?),
            ARRAY => Shape::Array(self.inner(depth)?, self.number()?),
            TUPLE => {
                let count = self.count(PARTS_MAX)?;
                Shape::Tuple((0..count).map(|_| self.shape(depth + 1)).collect::<Result<_, _>>()?)
            }
            MAP => Shape::Map(self.inner(depth)?, self.inner(depth)?),
            STRUCT => Shape::Struct(self.fields(depth)?),
            ENUM => Shape::Enum(self.variants(depth)?),
            NAMED => Shape::Named(self.text()?),
            _ => return Err(SchemaError::Unknown),
        })
    }

    fn fields(&mut self, depth: usize) -> Result<Vec<Field>, SchemaError> {
        let count = self.count(PARTS_MAX)?;
        let mut names = BTreeSet::new();
        let mut fields = Vec::new();
        for _ in 0..count {
            let name = self.text()?;
            let optional = match self.byte()? {
                0 => false,
                1 => true,
                _ => return Err(SchemaError::NotCanonical),
            };
            if !names.insert(name.clone()) {
                return Err(SchemaError::NotCanonical);
            }
            fields.push(Field { name, shape: self.shape(depth + 1)?, optional });
        }
        Ok(fields)
    }

    fn variants(&mut self, depth: usize) -> Result<Vec<Variant>, SchemaError> {
        let count = self.count(PARTS_MAX)?;
        let mut names = BTreeSet::new();
        let mut variants = Vec::new();
        for _ in 0..count {
            let name = self.text()?;
            if !names.insert(name.clone()) {
                return Err(SchemaError::NotCanonical);
            }
            let shape = self.shape(depth + 1)?;
            if !matches!(shape, Shape::Unit | Shape::Newtype(_) | Shape::Tuple(_) | Shape::Struct(_)) {
                return Err(SchemaError::NotCanonical);
            }
            variants.push(Variant { name, shape });
        }
        Ok(variants)
    }
}
