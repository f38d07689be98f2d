//! The value that was read while a type was traced, as MessagePack, whole or without one field.

use super::graph::Owner;

/// A value that a type has read.
#[derive(Clone, Debug)]
pub(super) enum Sample {
    Nil,
    Bool,
    Int(u8),
    /// 128 bits: rmp-serde writes 16 bytes.
    Wide(u8),
    F32(u8),
    F64(u8),
    Text(&'static str),
    Bytes,
    List(Vec<Self>),
    Map(Vec<Self>),
    Struct(Owner, Vec<(usize, &'static str, Self)>),
    Variant(&'static str, Box<Self>),
}

/// A field: its struct or variant, and its position.
pub(super) type Place = (Owner, usize);

impl Sample {
    /// Returns the MessagePack bytes of this value without the field `absent`, wherever its struct occurs.
    pub(super) fn encode(&self, absent: Option<Place>) -> Vec<u8> {
        let mut bytes = Vec::new();
        self.write(absent, &mut bytes);
        bytes
    }

    /// Adds each field that occurs to `fields`.
    pub(super) fn collect_fields(&self, fields: &mut Vec<Place>) {
        match self {
            Self::Struct(owner, values) => {
                for (index, _, value) in values {
                    fields.push((*owner, *index));
                    value.collect_fields(fields);
                }
            }
            Self::List(values) | Self::Map(values) => {
                values.iter().for_each(|value| value.collect_fields(fields));
            }
            Self::Variant(_, value) => value.collect_fields(fields),
            Self::Nil
            | Self::Bool
            | Self::Int(_)
            | Self::Wide(_)
            | Self::F32(_)
            | Self::F64(_)
            | Self::Text(_)
            | Self::Bytes => {}
        }
    }

    fn write(&self, absent: Option<Place>, out: &mut Vec<u8>) {
        match self {
            Self::Nil => out.push(0xc0),
            Self::Bool => out.push(0xc2),
            Self::Int(value) => out.push(*value),
            Self::Wide(value) => {
                out.extend([0xc4, 16]);
                out.extend(u128::from(*value).to_be_bytes());
            }
            Self::F32(value) => {
                out.push(0xca);
                out.extend(f32::from(*value).to_be_bytes());
            }
            Self::F64(value) => {
                out.push(0xcb);
                out.extend(f64::from(*value).to_be_bytes());
            }
            Self::Text(text) => write_text(text, out),
            Self::Bytes => out.extend([0xc4, 0]),
            Self::List(values) => {
                write_length(0xdd, values.len(), out);
                values.iter().for_each(|value| value.write(absent, out));
            }
            Self::Map(values) => {
                write_length(0xdf, values.len() / 2, out);
                values.iter().for_each(|value| value.write(absent, out));
            }
            Self::Struct(owner, values) => {
                let is_absent = |index: &usize| absent == Some((*owner, *index));
                write_length(0xdf, values.iter().filter(|(index, ..)| !is_absent(index)).count(), out);
                for (_, name, value) in values.iter().filter(|(index, ..)| !is_absent(index)) {
                    write_text(name, out);
                    value.write(absent, out);
                }
            }
            Self::Variant(name, value) => {
                out.push(0x81);
                write_text(name, out);
                value.write(absent, out);
            }
        }
    }
}

/// Writes the length of a list, a map or a text. A type without fields is read from the shortest form only.
fn write_length(marker: u8, length: usize, out: &mut Vec<u8>) {
    match (marker, length) {
        (0xdd, 0) => out.push(0x90),
        (0xdf, 0) => out.push(0x80),
        _ => {
            out.push(marker);
            out.extend(u32::try_from(length).unwrap_or(u32::MAX).to_be_bytes());
        }
    }
}

fn write_text(text: &str, out: &mut Vec<u8>) {
    write_length(0xdb, text.len(), out);
    out.extend(text.as_bytes());
}
