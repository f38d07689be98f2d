//! Payloads as values: of MessagePack, and of JSON.
//!
//! MessagePack has more values than JSON. In JSON bytes are `{"bytes": "0a0b"}`, a key that is no text is its text,
//! and a number without a JSON form (NaN, infinity) is its name. These are the forms of `sinew watch`.

use std::fmt;

use rmp::{Marker, encode as write};
use serde_json::{Map, Number, Value as Json};

/// Maximum nesting depth of a payload: as in a node.
pub const DEPTH_MAX: usize = 64;
/// Maximum number of values in a payload, each key and element counted.
pub const VALUES_MAX: usize = 1 << 18;
/// Maximum length of a path in an error, in bytes.
const PATH_MAX: usize = 128;

/// A value of a payload.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// Nothing.
    Nil,
    /// A truth.
    Bool(bool),
    /// A number that is not negative.
    Unsigned(u64),
    /// A negative number.
    Signed(i64),
    /// A number of 32 bits with a fraction.
    F32(f32),
    /// A number of 64 bits with a fraction.
    F64(f64),
    /// A text.
    Text(String),
    /// Bytes.
    Bytes(Vec<u8>),
    /// A list.
    List(Vec<Self>),
    /// A map, in its order.
    Map(Vec<(Self, Self)>),
}

/// A payload that is refused: the place of the fault, and the cause.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MalformedError {
    path: Vec<String>,
    why: String,
}

impl MalformedError {
    /// Creates the error of a fault at the present place.
    pub(crate) fn new(why: impl Into<String>) -> Self {
        Self { path: Vec::new(), why: why.into() }
    }

    /// Adds the part of the payload that contains the fault.
    pub(crate) fn within(mut self, part: impl fmt::Display) -> Self {
        self.path.push(part.to_string().chars().take(PATH_MAX).collect());
        self
    }
}

impl fmt::Display for MalformedError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.path.is_empty() {
            let path: Vec<_> = self.path.iter().rev().map(String::as_str).collect();
            let path: String = path.join(".").chars().take(PATH_MAX).collect();
            write!(f, "field `{path}`: ")?;
        }
        f.write_str(&self.why)
    }
}

impl std::error::Error for MalformedError {}

impl Value {
    /// Reads a payload in MessagePack.
    ///
    /// # Errors
    /// The bytes are not exactly one value within the limits.
    pub fn read(bytes: &[u8]) -> Result<Self, MalformedError> {
        let mut reader = Reader { rest: bytes, values: 0 };
        let value = reader.value(0)?;
        match reader.rest.len() {
            0 => Ok(value),
            rest => Err(MalformedError::new(format!("{rest} bytes follow the value"))),
        }
    }

    /// Returns the payload in MessagePack.
    #[must_use]
    pub fn written(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(64);
        self.write(&mut bytes);
        bytes
    }

    /// Reads a payload in JSON, without the structure of its type.
    ///
    /// # Errors
    /// The text is not exactly one value within the limits.
    pub fn read_json(text: &[u8]) -> Result<Self, MalformedError> {
        let json: Json = serde_json::from_slice(text).map_err(|error| {
            MalformedError::new(format!("it is no JSON: {error}; a text needs its quotes"))
        })?;
        let mut values = 0;
        of_json(json, 0, &mut values)
    }

    /// Returns the payload in JSON.
    #[must_use]
    pub fn json(&self) -> String {
        to_json(self).to_string()
    }

    /// Returns the word for this kind of value, for errors.
    #[must_use]
    pub const fn word(&self) -> &'static str {
        match self {
            Self::Nil => "nothing",
            Self::Bool(_) => "a truth",
            Self::Unsigned(_) | Self::Signed(_) => "a whole number",
            Self::F32(_) | Self::F64(_) => "a number",
            Self::Text(_) => "a text",
            Self::Bytes(_) => "bytes",
            Self::List(_) => "a list",
            Self::Map(_) => "a map",
        }
    }

    fn write(&self, bytes: &mut Vec<u8>) {
        // A vector accepts all bytes, and no length is above that of the payload that was read.
        let length = |length: usize| u32::try_from(length).unwrap_or(u32::MAX);
        let _ = match self {
            Self::Nil => write::write_nil(bytes).is_ok(),
            Self::Bool(value) => write::write_bool(bytes, *value).is_ok(),
            Self::Unsigned(value) => write::write_uint(bytes, *value).is_ok(),
            Self::Signed(value) => write::write_sint(bytes, *value).is_ok(),
            Self::F32(value) => write::write_f32(bytes, *value).is_ok(),
            Self::F64(value) => write::write_f64(bytes, *value).is_ok(),
            Self::Text(value) => write::write_str(bytes, value).is_ok(),
            Self::Bytes(value) => write::write_bin(bytes, value).is_ok(),
            Self::List(values) => {
                let is_written = write::write_array_len(bytes, length(values.len())).is_ok();
                values.iter().for_each(|value| value.write(bytes));
                is_written
            }
            Self::Map(entries) => {
                let is_written = write::write_map_len(bytes, length(entries.len())).is_ok();
                for (key, value) in entries {
                    key.write(bytes);
                    value.write(bytes);
                }
                is_written
            }
        };
    }
}

struct Reader<'data> {
    rest: &'data [u8],
    /// Values read so far.
    values: usize,
}

impl<'data> Reader<'data> {
    fn take(&mut self, length: usize) -> Result<&'data [u8], MalformedError> {
        let Some((taken, rest)) = self.rest.split_at_checked(length) else {
            return Err(MalformedError::new("it ends in the middle of a MessagePack value"));
        };
        self.rest = rest;
        Ok(taken)
    }

    fn array<const LENGTH: usize>(&mut self) -> Result<[u8; LENGTH], MalformedError> {
        let taken = self.take(LENGTH)?.first_chunk().copied();
        taken.ok_or_else(|| MalformedError::new("it ends in the middle of a MessagePack value"))
    }

    fn length<const BYTES: usize>(&mut self) -> Result<usize, MalformedError> {
        Ok(self.array::<BYTES>()?.iter().fold(0, |length, byte| length << 8 | usize::from(*byte)))
    }

    fn value(&mut self, depth: usize) -> Result<Value, MalformedError> {
        count(depth, &mut self.values)?;
        let unsigned = |value: u64| Ok(Value::Unsigned(value));
        match Marker::from_u8(self.array::<1>()?[0]) {
            Marker::Null => Ok(Value::Nil),
            Marker::True => Ok(Value::Bool(true)),
            Marker::False => Ok(Value::Bool(false)),
            Marker::FixPos(value) => unsigned(value.into()),
            Marker::FixNeg(value) => Ok(signed(value.into())),
            Marker::U8 => unsigned(u8::from_be_bytes(self.array()?).into()),
            Marker::U16 => unsigned(u16::from_be_bytes(self.array()?).into()),
            Marker::U32 => unsigned(u32::from_be_bytes(self.array()?).into()),
            Marker::U64 => unsigned(u64::from_be_bytes(self.array()?)),
            Marker::I8 => Ok(signed(i8::from_be_bytes(self.array()?).into())),
            Marker::I16 => Ok(signed(i16::from_be_bytes(self.array()?).into())),
            Marker::I32 => Ok(signed(i32::from_be_bytes(self.array()?).into())),
            Marker::I64 => Ok(signed(i64::from_be_bytes(self.array()?))),
            Marker::F32 => Ok(Value::F32(f32::from_be_bytes(self.array()?))),
            Marker::F64 => Ok(Value::F64(f64::from_be_bytes(self.array()?))),
            Marker::FixStr(length) => self.text(length.into()),
            Marker::Str8 => self.length::<1>().and_then(|length| self.text(length)),
            Marker::Str16 => self.length::<2>().and_then(|length| self.text(length)),
            Marker::Str32 => self.length::<4>().and_then(|length| self.text(length)),
            Marker::Bin8 => self.length::<1>().and_then(|length| self.bytes(length)),
            Marker::Bin16 => self.length::<2>().and_then(|length| self.bytes(length)),
            Marker::Bin32 => self.length::<4>().and_then(|length| self.bytes(length)),
            Marker::FixArray(length) => self.list(length.into(), depth),
            Marker::Array16 => self.length::<2>().and_then(|length| self.list(length, depth)),
            Marker::Array32 => self.length::<4>().and_then(|length| self.list(length, depth)),
            Marker::FixMap(length) => self.map(length.into(), depth),
            Marker::Map16 => self.length::<2>().and_then(|length| self.map(length, depth)),
            Marker::Map32 => self.length::<4>().and_then(|length| self.map(length, depth)),
            Marker::FixExt1
            | Marker::FixExt2
            | Marker::FixExt4
            | Marker::FixExt8
            | Marker::FixExt16
            | Marker::Ext8
            | Marker::Ext16
            | Marker::Ext32
            | Marker::Reserved => {
                Err(MalformedError::new("it has an extension of MessagePack, which no payload has"))
            }
        }
    }

    fn text(&mut self, length: usize) -> Result<Value, MalformedError> {
        let text = std::str::from_utf8(self.take(length)?);
        text.map(|text| Value::Text(text.to_owned())).map_err(|_| MalformedError::new("a text is no UTF-8"))
    }

    fn bytes(&mut self, length: usize) -> Result<Value, MalformedError> {
        self.take(length).map(|bytes| Value::Bytes(bytes.to_vec()))
    }

    fn list(&mut self, length: usize, depth: usize) -> Result<Value, MalformedError> {
        // It grows with the elements that are there: the length may be forged.
        let mut values = Vec::new();
        for _ in 0..length {
            values.push(self.value(depth + 1)?);
        }
        Ok(Value::List(values))
    }

    fn map(&mut self, length: usize, depth: usize) -> Result<Value, MalformedError> {
        let mut entries = Vec::new();
        for _ in 0..length {
            entries.push((self.value(depth + 1)?, self.value(depth + 1)?));
        }
        Ok(Value::Map(entries))
    }
}

fn signed(value: i64) -> Value {
    u64::try_from(value).map_or(Value::Signed(value), Value::Unsigned)
}

fn count(depth: usize, values: &mut usize) -> Result<(), MalformedError> {
    *values += 1;
    if depth > DEPTH_MAX {
        return Err(MalformedError::new(format!("it is nested deeper than {DEPTH_MAX} levels")));
    }
    if *values > VALUES_MAX {
        let why = format!("it has more than {VALUES_MAX} values; send an array as bytes");
        return Err(MalformedError::new(why));
    }
    Ok(())
}

fn of_json(json: Json, depth: usize, values: &mut usize) -> Result<Value, MalformedError> {
    count(depth, values)?;
    Ok(match json {
        Json::Null => Value::Nil,
        Json::Bool(value) => Value::Bool(value),
        Json::Number(number) => match (number.as_u64(), number.as_i64()) {
            (Some(value), _) => Value::Unsigned(value),
            (None, Some(value)) => signed(value),
            (None, None) => Value::F64(number.as_f64().unwrap_or(f64::NAN)),
        },
        Json::String(text) => Value::Text(text),
        Json::Array(list) => {
            let list = list.into_iter().map(|one| of_json(one, depth + 1, values));
            Value::List(list.collect::<Result<_, _>>()?)
        }
        Json::Object(map) => {
            let entries = map.into_iter().map(|(key, value)| {
                Ok::<_, MalformedError>((Value::Text(key), of_json(value, depth + 1, values)?))
            });
            Value::Map(entries.collect::<Result<_, _>>()?)
        }
    })
}

fn to_json(value: &Value) -> Json {
    match value {
        Value::Nil => Json::Null,
        Value::Bool(value) => (*value).into(),
        Value::Unsigned(value) => (*value).into(),
        Value::Signed(value) => (*value).into(),
        // As its source wrote it: 0.1, not 0.10000000149.
        Value::F32(value) => float(value.to_string().parse().unwrap_or_else(|_| (*value).into())),
        Value::F64(value) => float(*value),
        Value::Text(text) => text.as_str().into(),
        Value::Bytes(bytes) => Json::Object(Map::from_iter([("bytes".to_owned(), Json::String(hex(bytes)))])),
        Value::List(values) => values.iter().map(to_json).collect(),
        Value::Map(entries) => {
            let entry = |(key, value): &(Value, Value)| (key_of(key), to_json(value));
            Json::Object(entries.iter().map(entry).collect())
        }
    }
}

fn key_of(key: &Value) -> String {
    if let Value::Text(text) = key { text.clone() } else { to_json(key).to_string() }
}

fn float(value: f64) -> Json {
    Number::from_f64(value).map_or_else(|| Json::String(value.to_string()), Json::Number)
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Returns the bytes of hexadecimal digits.
pub(crate) fn of_hex(digits: &str) -> Option<Vec<u8>> {
    let is_hex = digits.len().is_multiple_of(2) && digits.bytes().all(|digit| digit.is_ascii_hexdigit());
    let pairs = digits.as_bytes().chunks_exact(2).filter_map(|pair| std::str::from_utf8(pair).ok());
    is_hex.then(|| pairs.filter_map(|pair| u8::from_str_radix(pair, 16).ok()).collect())
}

#[cfg(test)]
pub(crate) mod tests {
    use proptest::prelude::*;

    use super::*;

    pub(crate) fn values() -> impl Strategy<Value = Value> {
        let leaf = prop_oneof![
            Just(Value::Nil),
            any::<bool>().prop_map(Value::Bool),
            any::<u64>().prop_map(Value::Unsigned),
            (i64::MIN..0).prop_map(Value::Signed),
            (-1e30_f32..1e30).prop_map(Value::F32),
            (-1e300_f64..1e300).prop_map(Value::F64),
            ".{0,12}".prop_map(Value::Text),
            proptest::collection::vec(any::<u8>(), 0..8).prop_map(Value::Bytes),
        ];
        leaf.prop_recursive(4, 32, 4, |inner| {
            prop_oneof![
                proptest::collection::vec(inner.clone(), 0..4).prop_map(Value::List),
                proptest::collection::btree_map(".{0,4}", inner, 0..4).prop_map(|map| Value::Map(
                    map.into_iter().map(|(key, value)| (Value::Text(key), value)).collect()
                )),
            ]
        })
    }

    #[test]
    fn values_without_json_form_are_shown_as_text() {
        let map = Value::Map(vec![(Value::Unsigned(1), Value::Bytes(vec![0x0a, 0xff]))]);
        assert_eq!(map.json(), r#"{"1":{"bytes":"0aff"}}"#);
        assert_eq!(Value::F32(0.1).json(), "0.1");
        assert_eq!(Value::F64(f64::NAN).json(), "\"NaN\"");
        assert_eq!(of_hex("0aff"), Some(vec![0x0a, 0xff]));
        assert_eq!((of_hex("0"), of_hex("+1")), (None, None));
    }

    #[test]
    fn error_names_the_place_of_the_fault() {
        let error = MalformedError::new("expected f32").within("angle").within(2).within("joints");
        assert_eq!(error.to_string(), "field `joints.2.angle`: expected f32");
    }

    #[test]
    fn forged_lengths_and_depths_are_refused() {
        for bytes in [vec![0x91; 100_000], vec![0xdd, 0xff, 0xff, 0xff, 0xff], vec![0xc1], vec![], vec![1, 2]]
        {
            assert!(Value::read(&bytes).is_err());
        }
        assert!(Value::read_json("[".repeat(100_000).as_bytes()).is_err());
    }

    proptest! {
        #[test]
        fn written_values_are_read_again(value in values()) {
            prop_assert_eq!(Value::read(&value.written()), Ok(value));
        }

        #[test]
        fn json_is_read_again_as_the_same_json(value in values()) {
            let json = value.json();
            let again = Value::read_json(json.as_bytes()).expect("it is JSON");
            prop_assert_eq!(again.json(), json);
        }

        #[test]
        fn any_bytes_are_a_value_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            if let Ok(value) = Value::read(&bytes) {
                prop_assert!(Value::read(&value.written()).is_ok());
            }
            let _ = Value::read_json(&bytes);
        }
    }
}
