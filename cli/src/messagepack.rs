//! Payloads for users: MessagePack as JSON, and JSON as MessagePack.

use std::{fmt, io::Cursor};

use serde::{
    Deserialize, Deserializer,
    de::{self, MapAccess, SeqAccess, Visitor},
};
use serde_json::{Map, Number, Value};

/// Maximum nesting depth of a payload: as in a node.
const DEPTH_MAX: usize = 64;

/// Returns a typed payload as JSON. MessagePack has more types than JSON: bytes become `{"bytes": "0a0b.."}`, a key
/// that is no text becomes one, and a number without a JSON form (NaN, infinity) becomes its name.
///
/// # Errors
/// The bytes are not exactly one MessagePack value: a raw payload.
pub(crate) fn shown(bytes: &[u8]) -> Result<Value, String> {
    let mut deserializer = rmp_serde::Deserializer::new(Cursor::new(bytes));
    deserializer.set_max_depth(DEPTH_MAX);
    let Shown(value) = Shown::deserialize(&mut deserializer).map_err(|error| error.to_string())?;
    let rest = bytes.len() as u64 - deserializer.position();
    if rest > 0 { Err(format!("{rest} bytes follow the value")) } else { Ok(value) }
}

/// Returns the displayed form of a payload: the value, or the bytes of a raw one.
pub(crate) fn shown_or_raw(bytes: &[u8]) -> Value {
    shown(bytes).unwrap_or_else(|_| raw(bytes))
}

/// Returns the payload for a value, encoded as a typed one.
///
/// # Errors
/// A number has no form in MessagePack.
pub(crate) fn written(value: &Value) -> Result<Vec<u8>, String> {
    rmp_serde::to_vec_named(value).map_err(|error| error.to_string())
}

fn raw(bytes: &[u8]) -> Value {
    let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    Value::Object(Map::from_iter([("bytes".to_owned(), Value::String(hex))]))
}

struct Shown(Value);

impl<'de> Deserialize<'de> for Shown {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(AnyValue).map(Self)
    }
}

struct AnyValue;

impl<'de> Visitor<'de> for AnyValue {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a MessagePack value")
    }

    fn visit_unit<E: de::Error>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_none<E: de::Error>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_bool<E: de::Error>(self, value: bool) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_u64<E: de::Error>(self, value: u64) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_i64<E: de::Error>(self, value: i64) -> Result<Value, E> {
        Ok(value.into())
    }

    /// As written by its source: 0.1, not 0.10000000149.
    fn visit_f32<E: de::Error>(self, value: f32) -> Result<Value, E> {
        self.visit_f64(value.to_string().parse().unwrap_or_else(|_| value.into()))
    }

    fn visit_f64<E: de::Error>(self, value: f64) -> Result<Value, E> {
        Ok(Number::from_f64(value).map_or_else(|| Value::String(value.to_string()), Value::Number))
    }

    fn visit_str<E: de::Error>(self, value: &str) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_bytes<E: de::Error>(self, value: &[u8]) -> Result<Value, E> {
        Ok(raw(value))
    }

    fn visit_newtype_struct<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        // An extension: its type and its bytes.
        deserializer.deserialize_any(self)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Value, A::Error> {
        let mut values = Vec::new();
        while let Some(Shown(value)) = list.next_element()? {
            values.push(value);
        }
        Ok(Value::Array(values))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Value, A::Error> {
        let mut values = Map::new();
        while let Some((Shown(key), Shown(value))) = map.next_entry()? {
            let key = if let Value::String(key) = key { key } else { key.to_string() };
            values.insert(key, value);
        }
        Ok(Value::Object(values))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn written_value_is_shown_again() {
        let value = json!({ "degrees": 1.5, "joint": "knee", "n": -3, "big": u64::MAX, "list": [null, true, { "a": 0 }] });
        assert_eq!(shown(&written(&value).unwrap()), Ok(value));
    }

    #[test]
    fn values_without_json_form_are_shown_as_text() {
        // A map of 1 to bytes, and a float of 32 bits.
        assert_eq!(shown(&[0x81, 0x01, 0xc4, 2, 0x0a, 0xff]), Ok(json!({ "1": { "bytes": "0aff" } })));
        let mut float = vec![0xca];
        float.extend(0.1_f32.to_be_bytes());
        assert_eq!(shown(&float), Ok(json!(0.1)));
        let mut none = vec![0xcb];
        none.extend(f64::NAN.to_be_bytes());
        assert_eq!(shown(&none), Ok(json!("NaN")));
        assert_eq!(
            shown_or_raw(&[0x01, 0x02]),
            json!({ "bytes": "0102" }),
            "two values are no typed payload"
        );
    }

    #[test]
    fn foreign_bytes_cause_no_panic_and_no_large_allocation() {
        for bytes in [vec![0x91; 100_000], vec![0xdd, 0xff, 0xff, 0xff, 0xff], vec![0xc1], vec![]] {
            assert!(shown(&bytes).is_err());
        }
    }
}
