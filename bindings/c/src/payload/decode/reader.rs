//! The unread bytes of a payload, and the values of MessagePack at their start.

use rmp::{Marker, decode::RmpRead};

use super::{ReadError, number::Number};

/// Maximum nesting depth of a skipped value, as in Rust's decoder.
pub(super) const SKIPPED_DEPTH_MAX: usize = 64;

/// The unread rest of a payload.
pub(super) struct Reader<'call> {
    pub(super) bytes: &'call [u8],
}

impl<'call> Reader<'call> {
    pub(super) fn end(&self) -> Result<(), ReadError> {
        match self.bytes.len() {
            0 => Ok(()),
            more => Err(ReadError::payload(format!("{more} bytes too many"))),
        }
    }

    fn take(&mut self, length: usize) -> Result<&'call [u8], ReadError> {
        let (first, rest) = self.bytes.split_at_checked(length).ok_or_else(cut)?;
        self.bytes = rest;
        Ok(first)
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

    /// Reads the start of a struct: the number of fields that follow, and whether each is preceded by its
    /// name.
    pub(super) fn fields(&mut self) -> Result<(usize, bool), ReadError> {
        let marker = self.marker()?;
        let found = family(marker);
        // One of the forms of a struct without fields.
        if found == Family::Nil {
            return Ok((0, true));
        }
        if found != Family::Map && found != Family::List {
            return Err(ReadError::payload(format!("expected a struct, found {}", found.description())));
        }
        Ok((self.length(marker)?.unwrap_or_default(), found == Family::Map))
    }

    pub(super) fn list(&mut self) -> Result<usize, ReadError> {
        let marker = self.marker()?;
        let found = family(marker);
        if found != Family::List {
            return Err(ReadError::payload(format!("expected a list, found {}", found.description())));
        }
        Ok(self.length(marker)?.unwrap_or_default())
    }

    pub(super) fn text(&mut self) -> Result<&'call [u8], ReadError> {
        let marker = self.marker()?;
        let found = family(marker);
        if found != Family::Text {
            return Err(ReadError::payload(format!("expected a text, found {}", found.description())));
        }
        let length = self.length(marker)?.unwrap_or_default();
        self.take(length)
    }

    pub(super) fn name(&mut self) -> Result<&'call [u8], ReadError> {
        self.text().map_err(|_| ReadError::payload("the name of a field is no text"))
    }

    /// Reads bytes, if the next value is bytes.
    pub(super) fn bytes(&mut self) -> Result<Option<&'call [u8]>, ReadError> {
        let marker = Marker::from_u8(*self.bytes.first().ok_or_else(cut)?);
        if family(marker) != Family::Bytes {
            return Ok(None);
        }
        let marker = self.marker()?;
        let length = self.length(marker)?.unwrap_or_default();
        self.take(length).map(Some)
    }

    /// Consumes a nil, if the next value is one.
    pub(super) fn is_nil(&mut self) -> Result<bool, ReadError> {
        let is_nil = Marker::from_u8(*self.bytes.first().ok_or_else(cut)?) == Marker::Null;
        if is_nil {
            self.take(1)?;
        }
        Ok(is_nil)
    }

    pub(super) fn boolean(&mut self) -> Result<bool, ReadError> {
        let marker = self.marker()?;
        if family(marker) != Family::Boolean {
            return Err(ReadError::payload(format!("expected bool, found {}", family(marker).description())));
        }
        Ok(marker == Marker::True)
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "MessagePack has 38 markers, fixed by its specification; the others are no numbers"
    )]
    pub(super) fn number(&mut self) -> Result<Number, ReadError> {
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
                    family(other).description()
                )));
            }
        })
    }

    /// Skips a value. Each value has at least one byte, so that a false length ends with the bytes.
    pub(super) fn skip(&mut self, depth: usize) -> Result<(), ReadError> {
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
            Family::Reserved => {
                return Err(ReadError::payload(format!("found {}", Family::Reserved.description())));
            }
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

/// The kind of value that a marker begins.
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
    Reserved,
}

impl Family {
    const fn description(self) -> &'static str {
        match self {
            Self::Nil => "null",
            Self::Boolean => "a bool",
            Self::Number => "a number",
            Self::Text => "a text",
            Self::Bytes => "bytes",
            Self::List => "a list",
            Self::Map => "a struct",
            Self::Extension => "an extension of MessagePack",
            Self::Reserved => "the byte 0xc1, which MessagePack does not use",
        }
    }
}

const fn family(marker: Marker) -> Family {
    match marker {
        Marker::Null => Family::Nil,
        Marker::Reserved => Family::Reserved,
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
