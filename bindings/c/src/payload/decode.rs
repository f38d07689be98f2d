//! MessagePack to a struct. Bytes from outside: every length is checked against what is there, and nothing is allocated for it.

use rmp::{Marker, decode::RmpRead};

use super::{
    FIELDS_MAX, Field, FieldType, Layout, SINEW_FIELD_ARRAY, SINEW_FIELD_COUNTED, SINEW_FIELD_OPTIONAL,
    check_depth, struct_memory::StructMemoryMut,
};
use crate::status::{Fault, Status};

/// Values nested in one that is skipped at most, as in Rust's decoder.
const SKIPPED_DEPTH_MAX: usize = 64;

/// Whether the bytes are a value of this type, `name`. Changes nothing.
pub(super) fn check(layout: &Layout, bytes: &[u8], name: &str) -> Result<(), Fault> {
    let mut reader = Reader { bytes };
    read_struct(layout, &mut reader, None, 0).and_then(|()| reader.end()).map_err(|error| match error {
        ReadError::Payload(words) => {
            Fault::new(Status::SinewErrorMalformed, format!("this is no {name}: {words}"))
        }
        ReadError::Table(fault) => fault,
    })
}

/// Writes a value that was checked.
pub(super) fn read(layout: &Layout, bytes: &[u8], value: &mut StructMemoryMut<'_>) -> Result<(), Fault> {
    read_struct(layout, &mut Reader { bytes }, Some(value), 0).map_err(|error| match error {
        ReadError::Payload(words) => Fault::new(Status::SinewErrorMalformed, words),
        ReadError::Table(fault) => fault,
    })
}

/// Why a value was not read.
enum ReadError {
    /// The payload is to blame: where and how.
    Payload(String),
    /// The table is to blame.
    Table(Fault),
}

impl From<Fault> for ReadError {
    fn from(fault: Fault) -> Self {
        Self::Table(fault)
    }
}

impl ReadError {
    fn payload(words: impl Into<String>) -> Self {
        Self::Payload(words.into())
    }

    /// The same, with the field in front.
    fn in_field(self, name: &str) -> Self {
        match self {
            Self::Payload(words) => match words.strip_prefix("field `") {
                Some(inner) => Self::Payload(format!("field `{name}.{inner}")),
                None => Self::Payload(format!("field `{name}`: {words}")),
            },
            Self::Table(fault) => Self::Table(fault),
        }
    }
}

/// A struct, to nowhere if `value` is `None`.
fn read_struct(
    layout: &Layout,
    reader: &mut Reader<'_>,
    mut value: Option<&mut StructMemoryMut<'_>>,
    depth: usize,
) -> Result<(), ReadError> {
    check_depth(depth)?;
    let fields = layout.fields()?;
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
            return Err(ReadError::payload("it comes twice").in_field(name));
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

fn position(fields: &[Field], name: &[u8]) -> Result<Option<usize>, Fault> {
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

/// Whether an array has room for so many elements; writes their number.
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

/// Bytes, or a list of numbers of one byte each, as Rust writes a `Vec<u8>`.
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
            Err(Fault::argument("an array of texts is not supported: take an array of structs").into())
        }
    }
}

fn put(value: Option<&mut StructMemoryMut<'_>>, at: usize, bytes: &[u8]) -> Result<(), ReadError> {
    match value {
        Some(value) => Ok(value.write(at, bytes)?),
        None => Ok(()),
    }
}

/// A number as it was sent.
#[derive(Clone, Copy)]
enum Number {
    Unsigned(u64),
    Signed(i64),
    Single(f32),
    Double(f64),
}

/// Integers to 2^53 are exact in a double, to 2^24 in a float (IEEE 754).
const EXACT_IN_DOUBLE: u64 = 1 << 53;
const EXACT_IN_FLOAT: u64 = 1 << 24;

impl Number {
    fn integer<T: TryFrom<u64> + TryFrom<i64>>(self, expected: &str) -> Result<T, ReadError> {
        let fits = match self {
            Self::Unsigned(value) => T::try_from(value).ok(),
            Self::Signed(value) => T::try_from(value).ok(),
            Self::Single(_) | Self::Double(_) => None,
        };
        fits.ok_or_else(|| ReadError::payload(format!("expected {expected}, found {}", self.words())))
    }

    fn float(self) -> Result<f32, ReadError> {
        let refused = || Err(ReadError::payload(format!("expected float, found {}", self.words())));
        match self {
            Self::Single(value) => Ok(value),
            // Rounded to the nearest, but not to infinity.
            Self::Double(value) if value.is_finite() && (value as f32).is_infinite() => refused(),
            Self::Double(value) => Ok(value as f32),
            Self::Unsigned(value) if value <= EXACT_IN_FLOAT => Ok(value as f32),
            Self::Signed(value) if value.unsigned_abs() <= EXACT_IN_FLOAT => Ok(value as f32),
            Self::Unsigned(_) | Self::Signed(_) => refused(),
        }
    }

    fn double(self) -> Result<f64, ReadError> {
        match self {
            Self::Single(value) => Ok(f64::from(value)),
            Self::Double(value) => Ok(value),
            Self::Unsigned(value) if value <= EXACT_IN_DOUBLE => Ok(value as f64),
            Self::Signed(value) if value.unsigned_abs() <= EXACT_IN_DOUBLE => Ok(value as f64),
            Self::Unsigned(_) | Self::Signed(_) => {
                Err(ReadError::payload(format!("expected double, found {}", self.words())))
            }
        }
    }

    fn words(self) -> String {
        match self {
            Self::Unsigned(value) => format!("the integer {value}"),
            Self::Signed(value) => format!("the integer {value}"),
            Self::Single(value) => format!("the float {value:?}"),
            Self::Double(value) => format!("the float {value:?}"),
        }
    }
}

/// What is left of a payload.
struct Reader<'call> {
    bytes: &'call [u8],
}

impl<'call> Reader<'call> {
    fn end(&self) -> Result<(), ReadError> {
        match self.bytes.len() {
            0 => Ok(()),
            more => Err(ReadError::payload(format!("{more} bytes too many"))),
        }
    }

    fn take(&mut self, length: usize) -> Result<&'call [u8], ReadError> {
        let (taken, rest) = self.bytes.split_at_checked(length).ok_or_else(cut)?;
        self.bytes = rest;
        Ok(taken)
    }

    fn marker(&mut self) -> Result<Marker, ReadError> {
        Ok(Marker::from_u8(self.take(1)?[0]))
    }

    fn data<T>(
        &mut self,
        read: impl FnOnce(&mut &'call [u8]) -> Result<T, rmp::decode::ValueReadError>,
    ) -> Result<T, ReadError> {
        read(&mut self.bytes).map_err(|_| cut())
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "MessagePack has 38 markers, fixed by its specification; the others have no length"
    )]
    fn length(&mut self, marker: Marker) -> Result<Option<usize>, ReadError> {
        Ok(Some(match marker {
            Marker::FixStr(length) | Marker::FixArray(length) | Marker::FixMap(length) => usize::from(length),
            Marker::Str8 | Marker::Bin8 => usize::from(self.data(RmpRead::read_data_u8)?),
            Marker::Str16 | Marker::Bin16 | Marker::Array16 | Marker::Map16 => {
                usize::from(self.data(RmpRead::read_data_u16)?)
            }
            Marker::Str32 | Marker::Bin32 | Marker::Array32 | Marker::Map32 => {
                self.data(RmpRead::read_data_u32)? as usize
            }
            _ => return Ok(None),
        }))
    }

    /// The start of a struct: how many fields come, and whether each has its name before it.
    fn fields(&mut self) -> Result<(usize, bool), ReadError> {
        let marker = self.marker()?;
        let found = family(marker);
        // What Rust writes for a struct without fields.
        if found == Family::Nil {
            return Ok((0, true));
        }
        if found != Family::Map && found != Family::List {
            return Err(ReadError::payload(format!("expected a struct, found {}", found.words())));
        }
        Ok((self.length(marker)?.unwrap_or_default(), found == Family::Map))
    }

    fn list(&mut self) -> Result<usize, ReadError> {
        let marker = self.marker()?;
        let found = family(marker);
        if found != Family::List {
            return Err(ReadError::payload(format!("expected a list, found {}", found.words())));
        }
        Ok(self.length(marker)?.unwrap_or_default())
    }

    fn text(&mut self) -> Result<&'call [u8], ReadError> {
        let marker = self.marker()?;
        let found = family(marker);
        if found != Family::Text {
            return Err(ReadError::payload(format!("expected a text, found {}", found.words())));
        }
        let length = self.length(marker)?.unwrap_or_default();
        self.take(length)
    }

    fn name(&mut self) -> Result<&'call [u8], ReadError> {
        self.text().map_err(|_| ReadError::payload("the name of a field is no text"))
    }

    /// Bytes, if that is what comes.
    fn bytes(&mut self) -> Result<Option<&'call [u8]>, ReadError> {
        let marker = Marker::from_u8(*self.bytes.first().ok_or_else(cut)?);
        if family(marker) != Family::Bytes {
            return Ok(None);
        }
        let marker = self.marker()?;
        let length = self.length(marker)?.unwrap_or_default();
        self.take(length).map(Some)
    }

    /// Takes a nil, if that is what comes.
    fn is_nil(&mut self) -> Result<bool, ReadError> {
        let is_nil = Marker::from_u8(*self.bytes.first().ok_or_else(cut)?) == Marker::Null;
        if is_nil {
            self.take(1)?;
        }
        Ok(is_nil)
    }

    fn boolean(&mut self) -> Result<bool, ReadError> {
        let marker = self.marker()?;
        if family(marker) != Family::Boolean {
            return Err(ReadError::payload(format!("expected bool, found {}", family(marker).words())));
        }
        Ok(marker == Marker::True)
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "MessagePack has 38 markers, fixed by its specification; the others are no numbers"
    )]
    fn number(&mut self) -> Result<Number, ReadError> {
        Ok(match self.marker()? {
            Marker::FixPos(value) => Number::Unsigned(u64::from(value)),
            Marker::FixNeg(value) => Number::Signed(i64::from(value)),
            Marker::U8 => Number::Unsigned(u64::from(self.data(RmpRead::read_data_u8)?)),
            Marker::U16 => Number::Unsigned(u64::from(self.data(RmpRead::read_data_u16)?)),
            Marker::U32 => Number::Unsigned(u64::from(self.data(RmpRead::read_data_u32)?)),
            Marker::U64 => Number::Unsigned(self.data(RmpRead::read_data_u64)?),
            Marker::I8 => Number::Signed(i64::from(self.data(RmpRead::read_data_i8)?)),
            Marker::I16 => Number::Signed(i64::from(self.data(RmpRead::read_data_i16)?)),
            Marker::I32 => Number::Signed(i64::from(self.data(RmpRead::read_data_i32)?)),
            Marker::I64 => Number::Signed(self.data(RmpRead::read_data_i64)?),
            Marker::F32 => Number::Single(self.data(RmpRead::read_data_f32)?),
            Marker::F64 => Number::Double(self.data(RmpRead::read_data_f64)?),
            other => {
                return Err(ReadError::payload(format!(
                    "expected a number, found {}",
                    family(other).words()
                )));
            }
        })
    }

    /// Passes over a value. Each value has a byte at least, so that a length which is a lie ends with the bytes.
    fn skip(&mut self, depth: usize) -> Result<(), ReadError> {
        if depth == 0 {
            return Err(ReadError::payload(format!("values are nested deeper than {SKIPPED_DEPTH_MAX}")));
        }
        let marker = self.marker()?;
        let length = self.length(marker)?.unwrap_or_default();
        match family(marker) {
            Family::Map => {
                for _ in 0..length {
                    self.skip(depth - 1)?;
                    self.skip(depth - 1)?;
                }
            }
            Family::List => {
                for _ in 0..length {
                    self.skip(depth - 1)?;
                }
            }
            Family::Text | Family::Bytes => drop(self.take(length)?),
            Family::Nil | Family::Boolean | Family::Number | Family::Extension => self.skip_data(marker)?,
        }
        Ok(())
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "MessagePack has 38 markers, fixed by its specification; the others have no data"
    )]
    fn skip_data(&mut self, marker: Marker) -> Result<(), ReadError> {
        let length = match marker {
            Marker::U8 | Marker::I8 => 1,
            Marker::U16 | Marker::I16 | Marker::FixExt1 => 2,
            Marker::FixExt2 => 3,
            Marker::U32 | Marker::I32 | Marker::F32 => 4,
            Marker::FixExt4 => 5,
            Marker::U64 | Marker::I64 | Marker::F64 => 8,
            Marker::FixExt8 => 9,
            Marker::FixExt16 => 17,
            Marker::Ext8 => usize::from(self.data(RmpRead::read_data_u8)?) + 1,
            Marker::Ext16 => usize::from(self.data(RmpRead::read_data_u16)?) + 1,
            Marker::Ext32 => (self.data(RmpRead::read_data_u32)? as usize).saturating_add(1),
            _ => 0,
        };
        self.take(length).map(drop)
    }
}

/// What sort of value a marker begins.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Family {
    Nil,
    Boolean,
    Number,
    Text,
    Bytes,
    List,
    Map,
    Extension,
}

impl Family {
    const fn words(self) -> &'static str {
        match self {
            Self::Nil => "null",
            Self::Boolean => "a bool",
            Self::Number => "a number",
            Self::Text => "a text",
            Self::Bytes => "bytes",
            Self::List => "a list",
            Self::Map => "a struct",
            Self::Extension => "an extension of MessagePack",
        }
    }
}

const fn family(marker: Marker) -> Family {
    match marker {
        Marker::Null | Marker::Reserved => Family::Nil,
        Marker::True | Marker::False => Family::Boolean,
        Marker::FixStr(_) | Marker::Str8 | Marker::Str16 | Marker::Str32 => Family::Text,
        Marker::Bin8 | Marker::Bin16 | Marker::Bin32 => Family::Bytes,
        Marker::FixArray(_) | Marker::Array16 | Marker::Array32 => Family::List,
        Marker::FixMap(_) | Marker::Map16 | Marker::Map32 => Family::Map,
        Marker::FixPos(_)
        | Marker::FixNeg(_)
        | Marker::U8
        | Marker::U16
        | Marker::U32
        | Marker::U64
        | Marker::I8
        | Marker::I16
        | Marker::I32
        | Marker::I64
        | Marker::F32
        | Marker::F64 => Family::Number,
        Marker::FixExt1
        | Marker::FixExt2
        | Marker::FixExt4
        | Marker::FixExt8
        | Marker::FixExt16
        | Marker::Ext8
        | Marker::Ext16
        | Marker::Ext32 => Family::Extension,
    }
}

fn cut() -> ReadError {
    ReadError::payload("its bytes end too early")
}
