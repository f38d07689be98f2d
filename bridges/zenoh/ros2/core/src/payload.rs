//! Payloads of Sinew as values: MessagePack, with the names of the fields.

use std::fmt;

use serde::{
    Deserialize, Deserializer, Serialize, Serializer,
    de::{self, MapAccess, SeqAccess, Visitor},
    ser::{SerializeMap as _, SerializeSeq as _},
};

use crate::cdr::MESSAGE_BYTES_MAX;

/// Maximum nesting of a payload, as in a node.
const DEPTH_MAX: usize = 64;

/// A value of MessagePack.
#[derive(Clone, Debug, PartialEq)]
pub enum Payload {
    /// Nothing.
    Nil,
    /// A truth.
    Bool(bool),
    /// A whole number.
    Integer(i64),
    /// A whole number beyond those of [`Payload::Integer`].
    Unsigned(u64),
    /// A number with a fraction.
    Float(f64),
    /// A text, or a variant without data.
    Text(String),
    /// Bytes.
    Bytes(Vec<u8>),
    /// Values in order.
    List(Vec<Self>),
    /// Fields by their names. Keys that are no texts are left out.
    Map(Vec<(String, Self)>),
}

/// Bytes that are no payload.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PayloadError(String);

impl fmt::Display for PayloadError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the payload is no value of MessagePack: {}", self.0)
    }
}

impl std::error::Error for PayloadError {}

impl Payload {
    /// Reads the bytes of a payload.
    ///
    /// # Errors
    /// They are no value of MessagePack, or too many.
    pub fn read(bytes: &[u8]) -> Result<Self, PayloadError> {
        if bytes.len() > MESSAGE_BYTES_MAX {
            return Err(PayloadError(format!("it has {} bytes, more than {MESSAGE_BYTES_MAX}", bytes.len())));
        }
        let mut inner = rmp_serde::Deserializer::from_read_ref(bytes);
        inner.set_max_depth(DEPTH_MAX);
        Self::deserialize(&mut inner).map_err(|why| PayloadError(why.to_string()))
    }

    /// Returns the bytes of the payload.
    ///
    /// # Errors
    /// It is nested too deeply for MessagePack.
    pub fn write(&self) -> Result<Vec<u8>, PayloadError> {
        rmp_serde::to_vec(self).map_err(|why| PayloadError(why.to_string()))
    }

    /// Returns the number, if it is one. Beyond 2^53 it is rounded.
    #[must_use]
    pub const fn number(&self) -> Option<f64> {
        match self {
            Self::Integer(number) => Some(*number as f64),
            Self::Unsigned(number) => Some(*number as f64),
            Self::Float(number) => Some(*number),
            Self::Nil | Self::Bool(_) | Self::Text(_) | Self::Bytes(_) | Self::List(_) | Self::Map(_) => None,
        }
    }
}

impl Serialize for Payload {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Nil => serializer.serialize_unit(),
            Self::Bool(value) => serializer.serialize_bool(*value),
            Self::Integer(value) => serializer.serialize_i64(*value),
            Self::Unsigned(value) => serializer.serialize_u64(*value),
            Self::Float(value) => serializer.serialize_f64(*value),
            Self::Text(value) => serializer.serialize_str(value),
            Self::Bytes(value) => serializer.serialize_bytes(value),
            Self::List(values) => {
                let mut list = serializer.serialize_seq(Some(values.len()))?;
                values.iter().try_for_each(|value| list.serialize_element(value))?;
                list.end()
            }
            Self::Map(members) => {
                let mut map = serializer.serialize_map(Some(members.len()))?;
                members.iter().try_for_each(|(name, value)| map.serialize_entry(name, value))?;
                map.end()
            }
        }
    }
}

impl<'de> Deserialize<'de> for Payload {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Values)
    }
}

struct Values;

impl<'de> Visitor<'de> for Values {
    type Value = Payload;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a value of MessagePack")
    }

    fn visit_unit<E: de::Error>(self) -> Result<Payload, E> {
        Ok(Payload::Nil)
    }

    fn visit_none<E: de::Error>(self) -> Result<Payload, E> {
        Ok(Payload::Nil)
    }

    fn visit_bool<E: de::Error>(self, value: bool) -> Result<Payload, E> {
        Ok(Payload::Bool(value))
    }

    fn visit_i64<E: de::Error>(self, value: i64) -> Result<Payload, E> {
        Ok(Payload::Integer(value))
    }

    fn visit_u64<E: de::Error>(self, value: u64) -> Result<Payload, E> {
        Ok(i64::try_from(value).map_or(Payload::Unsigned(value), Payload::Integer))
    }

    fn visit_f64<E: de::Error>(self, value: f64) -> Result<Payload, E> {
        Ok(Payload::Float(value))
    }

    fn visit_str<E: de::Error>(self, value: &str) -> Result<Payload, E> {
        Ok(Payload::Text(value.to_owned()))
    }

    fn visit_bytes<E: de::Error>(self, value: &[u8]) -> Result<Payload, E> {
        Ok(Payload::Bytes(value.to_owned()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Payload, A::Error> {
        // Nothing is reserved by a length from outside.
        let mut values = Vec::new();
        while let Some(value) = list.next_element()? {
            values.push(value);
        }
        Ok(Payload::List(values))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Payload, A::Error> {
        let mut members = Vec::new();
        while let Some((key, value)) = map.next_entry()? {
            if let Payload::Text(name) = key {
                members.push((name, value));
            }
        }
        Ok(Payload::Map(members))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[derive(Serialize)]
    struct Sample {
        angle: f32,
        count: u64,
        torque: Option<f32>,
        state: Kind,
        list: Vec<i8>,
    }

    #[derive(Serialize)]
    enum Kind {
        Walk,
    }

    #[test]
    fn payload_of_a_struct_has_its_fields() {
        let sample = Sample { angle: 0.5, count: u64::MAX, torque: None, state: Kind::Walk, list: vec![-1] };
        let bytes = rmp_serde::to_vec_named(&sample).expect("bytes");
        let expected = [
            ("angle", Payload::Float(0.5)),
            ("count", Payload::Unsigned(u64::MAX)),
            ("torque", Payload::Nil),
            ("state", Payload::Text("Walk".to_owned())),
            ("list", Payload::List(vec![Payload::Integer(-1)])),
        ];
        let expected = expected.map(|(name, value)| (name.to_owned(), value));
        let payload = Payload::read(&bytes).expect("a payload");
        assert_eq!(payload, Payload::Map(expected.to_vec()));
        assert_eq!(Payload::read(&payload.write().expect("bytes")), Ok(payload));
    }

    #[test]
    fn deep_and_long_payloads_are_refused() {
        assert!(Payload::read(&[0x91; 10_000]).is_err());
        assert!(Payload::read(&[0xdd, 0xff, 0xff, 0xff, 0xff]).is_err());
        assert!(Payload::read(&[0xc0; MESSAGE_BYTES_MAX + 1]).is_err());
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_or_refused(bytes: Vec<u8>) {
            let _ = Payload::read(&bytes);
        }
    }
}
