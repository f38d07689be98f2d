//! MessagePack of any type, and where two values differ.

use std::fmt;

use serde::de::{Deserialize, Deserializer, Error, MapAccess, SeqAccess, Visitor};

/// Maximum depth of a value; a deeper one is compared as bytes.
const DEPTH_MAX: usize = 64;
/// Maximum length of a value in words, in characters.
const WORDS_MAX: usize = 60;

/// A value of MessagePack. Its memory is bounded by the length of the payload.
#[derive(Clone, Debug)]
pub(crate) enum Value {
    Nil,
    Bool(bool),
    Integer(i128),
    Single(f32),
    Double(f64),
    Text(String),
    Bytes(Vec<u8>),
    List(Vec<Self>),
    Map(Vec<(Self, Self)>),
}

impl Value {
    /// Reads a payload; `None` if it is not one value of MessagePack.
    pub(crate) fn of(payload: &[u8]) -> Option<Self> {
        let mut reader = rmp_serde::Deserializer::from_read_ref(payload);
        reader.set_max_depth(DEPTH_MAX);
        Self::deserialize(&mut reader).ok()
    }

    /// Returns where this recorded value and the replayed one differ, in words, without the fields of these paths.
    pub(crate) fn difference(&self, replayed: &Self, ignored: &[String]) -> Option<String> {
        difference("", self, replayed, ignored)
    }
}

/// Compares two values at `path`. The depth is that of the values, so it is bounded.
fn difference(path: &str, recorded: &Value, replayed: &Value, ignored: &[String]) -> Option<String> {
    if ignored.iter().any(|field| field == path) {
        return None;
    }
    let label = if path.is_empty() { "the value".to_owned() } else { format!("`{path}`") };
    match (recorded, replayed) {
        (Value::Map(recorded), Value::Map(replayed)) => maps(path, recorded, replayed, ignored),
        (Value::List(recorded), Value::List(replayed)) => {
            let pairs = recorded.iter().zip(replayed).enumerate();
            let mut inner = pairs
                .filter_map(|(index, (was, is))| difference(&format!("{path}[{index}]"), was, is, ignored));
            inner.next().or_else(|| {
                let (was, is) = (recorded.len(), replayed.len());
                (was != is).then(|| format!("{label} had {was} elements and has {is}"))
            })
        }
        _ if recorded.is(replayed) => None,
        _ => {
            let (mut was, mut is) = (recorded.to_string(), replayed.to_string());
            if was == is {
                (was, is) = (recorded.exact(), replayed.exact());
            }
            Some(format!("{label} was {was} and is {is}"))
        }
    }
}

fn maps(
    path: &str,
    recorded: &[(Value, Value)],
    replayed: &[(Value, Value)],
    ignored: &[String],
) -> Option<String> {
    let inner = |key: &Value| {
        let key = if let Value::Text(key) = key { key.clone() } else { key.to_string() };
        if path.is_empty() { key } else { format!("{path}.{key}") }
    };
    let is_ignored = |path: &String| ignored.contains(path);
    let find = |all: &[(Value, Value)], key: &Value| {
        all.iter().find(|(other, _)| other.is(key)).map(|(_, value)| value.clone())
    };
    for (key, was) in recorded {
        let path = inner(key);
        match find(replayed, key) {
            Some(is) => {
                if let Some(words) = difference(&path, was, &is, ignored) {
                    return Some(words);
                }
            }
            None if is_ignored(&path) => {}
            None => return Some(format!("`{path}` was {was} and is missing")),
        }
    }
    let mut added = replayed.iter().filter(|(key, _)| find(recorded, key).is_none());
    let (key, is) = added.find(|(key, _)| !is_ignored(&inner(key)))?;
    Some(format!("`{}` was missing and is {is}", inner(key)))
}

impl Value {
    /// Returns whether both have the same bits.
    fn is(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Nil, Self::Nil) => true,
            (Self::Bool(one), Self::Bool(other)) => one == other,
            (Self::Integer(one), Self::Integer(other)) => one == other,
            (Self::Single(one), Self::Single(other)) => one.to_bits() == other.to_bits(),
            (Self::Double(one), Self::Double(other)) => one.to_bits() == other.to_bits(),
            (Self::Text(one), Self::Text(other)) => one == other,
            (Self::Bytes(one), Self::Bytes(other)) => one == other,
            (Self::List(one), Self::List(other)) => {
                one.len() == other.len() && one.iter().zip(other).all(|(one, other)| one.is(other))
            }
            (Self::Map(one), Self::Map(other)) => {
                one.len() == other.len()
                    && one.iter().zip(other).all(|(one, other)| one.0.is(&other.0) && one.1.is(&other.1))
            }
            _ => false,
        }
    }

    /// Returns the type and the bits of a value, for two that look the same.
    fn exact(&self) -> String {
        match self {
            Self::Single(value) => format!("the single {value:?} ({:#x})", value.to_bits()),
            Self::Double(value) => format!("the double {value:?} ({:#x})", value.to_bits()),
            Self::Integer(value) => format!("the integer {value}"),
            Self::Nil | Self::Bool(_) | Self::Text(_) | Self::Bytes(_) | Self::List(_) | Self::Map(_) => {
                format!("{self:?}")
            }
        }
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Nil => f.write_str("nil"),
            Self::Bool(value) => write!(f, "{value}"),
            Self::Integer(value) => write!(f, "{value}"),
            Self::Single(value) => write!(f, "{value:?}"),
            Self::Double(value) => write!(f, "{value:?}"),
            Self::Text(text) if text.chars().count() <= WORDS_MAX => write!(f, "{text:?}"),
            Self::Text(text) => {
                let begin: String = text.chars().take(WORDS_MAX).collect();
                write!(f, "{begin:?}... of {} bytes", text.len())
            }
            Self::Bytes(bytes) => write!(f, "{} bytes", bytes.len()),
            Self::List(list) => write!(f, "a list of {}", list.len()),
            Self::Map(map) => write!(f, "a map of {}", map.len()),
        }
    }
}

impl<'de> Deserialize<'de> for Value {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(AnyValue)
    }
}

struct AnyValue;

impl<'de> Visitor<'de> for AnyValue {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a value of MessagePack")
    }

    fn visit_unit<E: Error>(self) -> Result<Value, E> {
        Ok(Value::Nil)
    }

    fn visit_none<E: Error>(self) -> Result<Value, E> {
        Ok(Value::Nil)
    }

    fn visit_some<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        Value::deserialize(deserializer)
    }

    fn visit_bool<E: Error>(self, value: bool) -> Result<Value, E> {
        Ok(Value::Bool(value))
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Value, E> {
        Ok(Value::Integer(value.into()))
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Value, E> {
        Ok(Value::Integer(value.into()))
    }

    fn visit_f32<E: Error>(self, value: f32) -> Result<Value, E> {
        Ok(Value::Single(value))
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Value, E> {
        Ok(Value::Double(value))
    }

    fn visit_str<E: Error>(self, value: &str) -> Result<Value, E> {
        Ok(Value::Text(value.to_owned()))
    }

    fn visit_bytes<E: Error>(self, value: &[u8]) -> Result<Value, E> {
        Ok(Value::Bytes(value.to_owned()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut access: A) -> Result<Value, A::Error> {
        // The length of the payload bounds it, not the number that the payload names.
        let mut list = Vec::new();
        while let Some(value) = access.next_element()? {
            list.push(value);
        }
        Ok(Value::List(list))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut access: A) -> Result<Value, A::Error> {
        let mut map = Vec::new();
        while let Some(entry) = access.next_entry()? {
            map.push(entry);
        }
        Ok(Value::Map(map))
    }
}

#[cfg(test)]
mod tests {
    use serde::Serialize;

    use super::*;

    #[derive(Serialize)]
    struct Pose {
        hip: f64,
        knees: [f32; 2],
        name: String,
        t_ns: u64,
    }

    fn value(change: impl FnOnce(&mut Pose)) -> Value {
        let mut pose = Pose { hip: 1.5, knees: [0.5, 2.0], name: "left".to_owned(), t_ns: 7 };
        change(&mut pose);
        Value::of(&rmp_serde::to_vec_named(&pose).unwrap()).unwrap()
    }

    fn words(change: impl FnOnce(&mut Pose), ignored: &[String]) -> Option<String> {
        value(|_| {}).difference(&value(change), ignored)
    }

    #[test]
    fn first_field_that_differs_is_named_with_both_values() {
        assert_eq!(words(|_| {}, &[]), None);
        let knee = words(|pose| pose.knees[1] = 2.5, &[]);
        assert_eq!(knee.as_deref(), Some("`knees[1]` was 2.0 and is 2.5"));
        let name = words(|pose| pose.name = "right".to_owned(), &[]);
        assert_eq!(name.as_deref(), Some("`name` was \"left\" and is \"right\""));
        assert!(words(|pose| pose.hip = f64::NAN, &[]).is_some());
        assert_eq!(
            value(|pose| pose.hip = f64::NAN).difference(&value(|pose| pose.hip = f64::NAN), &[]),
            None
        );
        assert_eq!(words(|pose| pose.t_ns = 8, &["t_ns".to_owned()]), None);
    }

    #[test]
    fn values_that_look_alike_are_told_apart() {
        let (one, other) = (f64::from_bits(0x7ff8_0000_0000_0000), f64::from_bits(0x7ff8_0000_0000_0001));
        let words = value(|pose| pose.hip = one).difference(&value(|pose| pose.hip = other), &[]).unwrap();
        assert!(words.contains("0x7ff8000000000001"), "{words}");
    }

    #[test]
    fn missing_and_added_fields_are_named() {
        let map = |keys: &[&str]| {
            let entry = |key: &&str| (Value::Text((*key).to_owned()), Value::Bool(true));
            Value::Map(keys.iter().map(entry).collect())
        };
        let missing = map(&["a", "b"]).difference(&map(&["a"]), &[]);
        assert_eq!(missing.as_deref(), Some("`b` was true and is missing"));
        let added = map(&["a"]).difference(&map(&["a", "b"]), &[]);
        assert_eq!(added.as_deref(), Some("`b` was missing and is true"));
        assert_eq!(map(&["a"]).difference(&map(&["a", "b"]), &["b".to_owned()]), None);
    }

    #[test]
    fn no_bytes_panic() {
        for length in 0..6 {
            for first in 0..=u8::MAX {
                let mut bytes = vec![0xff; length];
                bytes.insert(0, first);
                let _ = Value::of(&bytes);
            }
        }
        assert!(Value::of(&[0x91; 10_000]).is_none(), "it is too deep");
        assert!(Value::of(&[0xdd, 0xff, 0xff, 0xff, 0xff]).is_none(), "it names more elements than it has");
    }
}
