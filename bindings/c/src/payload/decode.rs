//! MessagePack to a struct. The bytes are untrusted: every length is checked against the available bytes, and
//! nothing is allocated for it.

mod number;
mod reader;

use self::reader::{Reader, SKIPPED_DEPTH_MAX};
use super::{
    FIELDS_MAX, Field, FieldType, Layout, SINEW_FIELD_ARRAY, SINEW_FIELD_COUNTED, SINEW_FIELD_OPTIONAL,
    check_depth, struct_memory::StructMemoryMut,
};
use crate::status::{CallError, Status};

/// Checks that the bytes are a value of this type, called `name`. Changes nothing.
pub(super) fn check(layout: &Layout, bytes: &[u8], name: &str) -> Result<(), CallError> {
    let mut reader = Reader { bytes };
    read_struct(layout, &mut reader, None, 0).and_then(|()| reader.end()).map_err(|error| match error {
        ReadError::Payload(text) => {
            CallError::new(Status::SinewErrorMalformed, format!("this is no {name}: {text}"))
        }
        ReadError::Table(error) => error,
    })
}

/// Writes a value that was checked.
pub(super) fn read(layout: &Layout, bytes: &[u8], value: &mut StructMemoryMut<'_>) -> Result<(), CallError> {
    read_struct(layout, &mut Reader { bytes }, Some(value), 0).map_err(|error| match error {
        ReadError::Payload(text) => CallError::new(Status::SinewErrorMalformed, text),
        ReadError::Table(error) => error,
    })
}

/// The reason why a value was not read.
enum ReadError {
    /// The payload is invalid: the place and the cause.
    Payload(String),
    /// The table is invalid.
    Table(CallError),
}

impl From<CallError> for ReadError {
    fn from(error: CallError) -> Self {
        Self::Table(error)
    }
}

impl ReadError {
    fn payload(text: impl Into<String>) -> Self {
        Self::Payload(text.into())
    }

    /// Returns the error with the field's name in front.
    fn in_field(self, name: &str) -> Self {
        match self {
            Self::Payload(text) => match text.strip_prefix("field `") {
                Some(inner) => Self::Payload(format!("field `{name}.{inner}")),
                None => Self::Payload(format!("field `{name}`: {text}")),
            },
            Self::Table(error) => Self::Table(error),
        }
    }
}

/// Reads a struct; only checks it if `value` is `None`.
fn read_struct(
    layout: &Layout,
    reader: &mut Reader<'_>,
    mut value: Option<&mut StructMemoryMut<'_>>,
    depth: usize,
) -> Result<(), ReadError> {
    check_depth(depth)?;
    let fields = layout.fields()?;
    if depth == 0 && fields.is_empty() && reader.bytes.is_empty() {
        return Ok(());
    }
    let (count, has_names) = reader.fields()?;
    let mut seen = [false; FIELDS_MAX];
    for at in 0..count {
        let found = if has_names {
            let name = reader.name()?;
            position(fields, name)?
        } else {
            // A list without names: the fields in their order.
            (at < fields.len()).then_some(at)
        };
        let Some(index) = found else {
            reader.skip(SKIPPED_DEPTH_MAX)?;
            continue;
        };
        let (field, name) = (&fields[index], fields[index].name()?);
        if std::mem::replace(&mut seen[index], true) {
            return Err(ReadError::payload("it occurs twice").in_field(name));
        }
        read_field(field, reader, value.as_deref_mut(), depth).map_err(|error| error.in_field(name))?;
    }
    for (field, _) in fields.iter().zip(seen).filter(|(_, seen)| !seen) {
        if !field.has(SINEW_FIELD_OPTIONAL) {
            return Err(ReadError::payload("it is missing").in_field(field.name()?));
        }
        if let Some(value) = value.as_deref_mut() {
            value.write(field.extra_offset, &[0])?;
        }
    }
    Ok(())
}

fn position(fields: &[Field], name: &[u8]) -> Result<Option<usize>, CallError> {
    for (index, field) in fields.iter().enumerate() {
        if field.name()?.as_bytes() == name {
            return Ok(Some(index));
        }
    }
    Ok(None)
}

fn read_field(
    field: &Field,
    reader: &mut Reader<'_>,
    mut value: Option<&mut StructMemoryMut<'_>>,
    depth: usize,
) -> Result<(), ReadError> {
    if field.has(SINEW_FIELD_OPTIONAL) {
        let is_there = !reader.is_nil()?;
        if let Some(value) = value.as_deref_mut() {
            value.write(field.extra_offset, &[u8::from(is_there)])?;
        }
        if !is_there {
            return Ok(());
        }
    }
    let (capacity, kind) = (field.capacity()?, field.field_type()?);
    if kind == FieldType::SinewTypeText {
        return read_text(field, reader, value);
    }
    if kind == FieldType::SinewTypeBytes {
        return read_bytes(field, reader, value);
    }
    if !field.has(SINEW_FIELD_ARRAY) {
        return read_element(field, field.offset, reader, value, depth);
    }
    let count = reader.list()?;
    check_count(field, count, capacity, value.as_deref_mut())?;
    let size = field.element_size()?;
    (0..count).try_for_each(|at| {
        read_element(field, field.offset + at * size, reader, value.as_deref_mut(), depth)
            .map_err(|error| error.in_field(&at.to_string()))
    })
}

/// Checks that an array has room for this many elements, and writes their number.
fn check_count(
    field: &Field,
    count: usize,
    capacity: usize,
    value: Option<&mut StructMemoryMut<'_>>,
) -> Result<(), ReadError> {
    if field.has(SINEW_FIELD_COUNTED) {
        if count > capacity {
            return Err(ReadError::payload(format!(
                "it has {count} elements, and there is room for {capacity}"
            )));
        }
        if let Some(value) = value {
            value.write(field.extra_offset, &count.to_ne_bytes())?;
        }
    } else if count != capacity {
        return Err(ReadError::payload(format!("it has {count} elements; {capacity} are expected")));
    }
    Ok(())
}

fn read_text(
    field: &Field,
    reader: &mut Reader<'_>,
    value: Option<&mut StructMemoryMut<'_>>,
) -> Result<(), ReadError> {
    let bytes = reader.text()?;
    if bytes.len() >= field.size {
        let (length, room) = (bytes.len(), field.size.saturating_sub(1));
        return Err(ReadError::payload(format!("its text has {length} bytes, and there is room for {room}")));
    }
    if std::str::from_utf8(bytes).is_err() || bytes.contains(&0) {
        return Err(ReadError::payload("its text is not UTF-8 without zeros"));
    }
    if let Some(value) = value {
        value.write(field.offset, bytes)?;
        value.write(field.offset + bytes.len(), &[0])?;
    }
    Ok(())
}

/// Reads bytes, or a list of numbers of one byte each, as Rust writes a `Vec<u8>`.
fn read_bytes(
    field: &Field,
    reader: &mut Reader<'_>,
    mut value: Option<&mut StructMemoryMut<'_>>,
) -> Result<(), ReadError> {
    if let Some(bytes) = reader.bytes()? {
        check_count(field, bytes.len(), field.size, value.as_deref_mut())?;
        return match value {
            Some(value) => Ok(value.write(field.offset, bytes)?),
            None => Ok(()),
        };
    }
    let count = reader.list()?;
    check_count(field, count, field.size, value.as_deref_mut())?;
    for at in 0..count {
        let byte = reader.number()?.integer::<u8>("uint8_t")?;
        if let Some(value) = value.as_deref_mut() {
            value.write(field.offset + at, &[byte])?;
        }
    }
    Ok(())
}

fn read_element(
    field: &Field,
    at: usize,
    reader: &mut Reader<'_>,
    value: Option<&mut StructMemoryMut<'_>>,
    depth: usize,
) -> Result<(), ReadError> {
    match field.field_type()? {
        FieldType::SinewTypeBool => put(value, at, &[u8::from(reader.boolean()?)]),
        FieldType::SinewTypeI8 => put(value, at, &reader.number()?.integer::<i8>("int8_t")?.to_ne_bytes()),
        FieldType::SinewTypeI16 => put(value, at, &reader.number()?.integer::<i16>("int16_t")?.to_ne_bytes()),
        FieldType::SinewTypeI32 => put(value, at, &reader.number()?.integer::<i32>("int32_t")?.to_ne_bytes()),
        FieldType::SinewTypeI64 => put(value, at, &reader.number()?.integer::<i64>("int64_t")?.to_ne_bytes()),
        FieldType::SinewTypeU8 => put(value, at, &reader.number()?.integer::<u8>("uint8_t")?.to_ne_bytes()),
        FieldType::SinewTypeU16 => {
            put(value, at, &reader.number()?.integer::<u16>("uint16_t")?.to_ne_bytes())
        }
        FieldType::SinewTypeU32 => {
            put(value, at, &reader.number()?.integer::<u32>("uint32_t")?.to_ne_bytes())
        }
        FieldType::SinewTypeU64 => {
            put(value, at, &reader.number()?.integer::<u64>("uint64_t")?.to_ne_bytes())
        }
        FieldType::SinewTypeF32 => put(value, at, &reader.number()?.float()?.to_ne_bytes()),
        FieldType::SinewTypeF64 => put(value, at, &reader.number()?.double()?.to_ne_bytes()),
        FieldType::SinewTypeStruct => {
            let layout = field.layout()?;
            match value {
                Some(value) => {
                    read_struct(layout, reader, Some(&mut value.part(at, layout.size)?), depth + 1)
                }
                None => read_struct(layout, reader, None, depth + 1),
            }
        }
        FieldType::SinewTypeText | FieldType::SinewTypeBytes => {
            Err(CallError::argument("an array of texts is not supported: take an array of structs").into())
        }
    }
}

fn put(value: Option<&mut StructMemoryMut<'_>>, at: usize, bytes: &[u8]) -> Result<(), ReadError> {
    match value {
        Some(value) => Ok(value.write(at, bytes)?),
        None => Ok(()),
    }
}
