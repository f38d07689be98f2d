//! A struct to MessagePack: a map with the names of its fields; without fields an empty array, like Rust's
//! unit structs.

use std::io::{self, Write};

use rmp::encode::{self as msgpack, ValueWriteError};

use super::{
    FIELDS_MAX, Field, FieldType, Layout, SINEW_FIELD_ARRAY, SINEW_FIELD_COUNTED, SINEW_FIELD_OPTIONAL,
    check_depth, struct_memory::StructMemory,
};
use crate::status::CallError;

/// Returns the length of a value as MessagePack, in bytes.
pub(super) fn length(layout: &Layout, value: StructMemory<'_>) -> Result<usize, CallError> {
    let mut counter = Counter(0);
    write_struct(layout, value, &mut counter, 0)?;
    Ok(counter.0)
}

/// Writes a value to memory that has room for it; returns its length in bytes.
pub(super) fn write(layout: &Layout, value: StructMemory<'_>, memory: &mut [u8]) -> Result<usize, CallError> {
    let room = memory.len();
    let mut rest = memory;
    write_struct(layout, value, &mut rest, 0)?;
    Ok(room - rest.len())
}

/// Counts the written bytes.
struct Counter(usize);

impl Write for Counter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0 = self.0.saturating_add(bytes.len());
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn write_struct(
    layout: &Layout,
    value: StructMemory<'_>,
    to: &mut impl Write,
    depth: usize,
) -> Result<(), CallError> {
    check_depth(depth)?;
    let fields = layout.fields()?;
    debug_assert!(fields.len() <= FIELDS_MAX, "the table was checked");
    if fields.is_empty() {
        // Rust also reads this form as a field, where it does not read a unit struct from an empty map.
        return msgpack::write_array_len(to, 0).map(|_| ()).map_err(no_room);
    }
    msgpack::write_map_len(to, fields.len() as u32).map_err(no_room)?;
    for field in fields {
        msgpack::write_str(to, field.name()?).map_err(no_room)?;
        write_field(field, value, to, depth)?;
    }
    Ok(())
}

fn write_field(
    field: &Field,
    value: StructMemory<'_>,
    to: &mut impl Write,
    depth: usize,
) -> Result<(), CallError> {
    if field.has(SINEW_FIELD_OPTIONAL) && value.read::<1>(field.extra_offset)? == [0] {
        return msgpack::write_nil(to).map_err(|error| no_room(ValueWriteError::InvalidMarkerWrite(error)));
    }
    let capacity = field.capacity()?;
    match field.field_type()? {
        FieldType::SinewTypeText => return write_text(field, value, to),
        FieldType::SinewTypeBytes => {
            let count = count(field, value, field.size)?;
            return msgpack::write_bin(to, value.bytes(field.offset, count)?).map_err(no_room);
        }
        FieldType::SinewTypeBool
        | FieldType::SinewTypeI8
        | FieldType::SinewTypeI16
        | FieldType::SinewTypeI32
        | FieldType::SinewTypeI64
        | FieldType::SinewTypeU8
        | FieldType::SinewTypeU16
        | FieldType::SinewTypeU32
        | FieldType::SinewTypeU64
        | FieldType::SinewTypeF32
        | FieldType::SinewTypeF64
        | FieldType::SinewTypeStruct => {}
    }
    if !field.has(SINEW_FIELD_ARRAY) {
        return write_element(field, value, field.offset, to, depth);
    }
    let count = count(field, value, capacity)?;
    let announced = u32::try_from(count).map_err(|_| CallError::argument("an array is too long"))?;
    msgpack::write_array_len(to, announced).map_err(no_room)?;
    let size = field.element_size()?;
    (0..count).try_for_each(|at| write_element(field, value, field.offset + at * size, to, depth))
}

/// Number of elements of an array that are in use.
fn count(field: &Field, value: StructMemory<'_>, capacity: usize) -> Result<usize, CallError> {
    if !field.has(SINEW_FIELD_COUNTED) {
        return Ok(capacity);
    }
    let count = usize::from_ne_bytes(value.read(field.extra_offset)?);
    if count <= capacity {
        return Ok(count);
    }
    let name = field.name()?;
    Err(CallError::argument(format!(
        "field `{name}`: its count is {count}, and the array has {capacity} elements"
    )))
}

fn write_text(field: &Field, value: StructMemory<'_>, to: &mut impl Write) -> Result<(), CallError> {
    let bytes = value.bytes(field.offset, field.size)?;
    let length = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    let text = std::str::from_utf8(&bytes[..length]).map_err(|error| {
        let name = field.name().unwrap_or_default();
        CallError::argument(format!("field `{name}`: its text is not UTF-8: {error}"))
    })?;
    msgpack::write_str(to, text).map_err(no_room)
}

fn write_element(
    field: &Field,
    value: StructMemory<'_>,
    at: usize,
    to: &mut impl Write,
    depth: usize,
) -> Result<(), CallError> {
    let written = match field.field_type()? {
        FieldType::SinewTypeBool => {
            msgpack::write_bool(to, value.read::<1>(at)? != [0]).map_err(ValueWriteError::InvalidMarkerWrite)
        }
        FieldType::SinewTypeI8 => signed(to, i8::from_ne_bytes(value.read(at)?)),
        FieldType::SinewTypeI16 => signed(to, i16::from_ne_bytes(value.read(at)?)),
        FieldType::SinewTypeI32 => signed(to, i32::from_ne_bytes(value.read(at)?)),
        FieldType::SinewTypeI64 => signed(to, i64::from_ne_bytes(value.read(at)?)),
        FieldType::SinewTypeU8 => unsigned(to, u8::from_ne_bytes(value.read(at)?)),
        FieldType::SinewTypeU16 => unsigned(to, u16::from_ne_bytes(value.read(at)?)),
        FieldType::SinewTypeU32 => unsigned(to, u32::from_ne_bytes(value.read(at)?)),
        FieldType::SinewTypeU64 => unsigned(to, u64::from_ne_bytes(value.read(at)?)),
        FieldType::SinewTypeF32 => msgpack::write_f32(to, f32::from_ne_bytes(value.read(at)?)),
        FieldType::SinewTypeF64 => msgpack::write_f64(to, f64::from_ne_bytes(value.read(at)?)),
        FieldType::SinewTypeStruct => {
            let layout = field.layout()?;
            return write_struct(layout, value.part(at, layout.size)?, to, depth + 1);
        }
        FieldType::SinewTypeText | FieldType::SinewTypeBytes => {
            return Err(CallError::argument("an array of texts is not supported: take an array of structs"));
        }
    };
    written.map_err(no_room)
}

fn signed(to: &mut impl Write, value: impl Into<i64>) -> Result<(), ValueWriteError<io::Error>> {
    msgpack::write_sint(to, value.into()).map(|_| ())
}

fn unsigned(to: &mut impl Write, value: impl Into<u64>) -> Result<(), ValueWriteError<io::Error>> {
    msgpack::write_uint(to, value.into()).map(|_| ())
}

/// Occurs only if the value was changed between measuring and writing.
fn no_room(error: ValueWriteError<io::Error>) -> CallError {
    CallError::argument(format!("the value was changed by another thread while it was written: {error}"))
}
