//! The numbers in a payload, each with the path of its field: `joints.2.angle`. A payload names its fields, so that no
//! structure of its type is needed.

use std::{fmt, io::Cursor};

use serde::{
    Deserialize as _, Deserializer,
    de::{self, DeserializeSeed, IgnoredAny, MapAccess, SeqAccess, Visitor},
};
use sinew::protection::unsealed;

/// Numbers of one payload. Further ones are left out.
pub(crate) const NUMBERS_MAX: usize = 64;
/// Bytes of a path. Fields with longer ones are left out.
const PATH_MAX: usize = 128;
/// Maximum nesting depth of a payload: as in a node.
const DEPTH_MAX: usize = 64;

/// Hands over the numbers of a payload; those of a protected one are in its envelope. Truths are 0 and 1. Bytes that
/// are no payload have no numbers after a fault.
pub(crate) fn numbers(payload: &[u8], take: &mut dyn FnMut(&str, f64)) {
    let payload = unsealed(payload).map_or(payload, |unsealed| unsealed.payload);
    let mut deserializer = rmp_serde::Deserializer::new(Cursor::new(payload));
    deserializer.set_max_depth(DEPTH_MAX);
    let (mut path, mut left) = (String::new(), NUMBERS_MAX);
    // A payload of another program may be anything: then the numbers before the fault are shown.
    let _ = Numbers { path: &mut path, left: &mut left, take }.deserialize(&mut deserializer);
}

struct Numbers<'f> {
    path: &'f mut String,
    left: &'f mut usize,
    take: &'f mut dyn FnMut(&str, f64),
}

impl Numbers<'_> {
    fn number<E: de::Error>(self, value: f64) -> Result<(), E> {
        if self.path.len() > PATH_MAX {
            return Ok(());
        }
        // The rest of a long list is not read.
        *self.left = self.left.checked_sub(1).ok_or_else(|| E::custom("further numbers"))?;
        (self.take)(self.path, value);
        Ok(())
    }

    /// Reads one member. Its path has one more part.
    fn member<T, E>(
        &mut self,
        part: impl fmt::Display,
        read: impl FnOnce(Numbers<'_>) -> Result<T, E>,
    ) -> Result<T, E> {
        use fmt::Write as _;
        let length = self.path.len();
        if length <= PATH_MAX {
            let dot = if length == 0 { "" } else { "." };
            let _ = write!(self.path, "{dot}{part}");
        }
        let result = read(Numbers { path: &mut *self.path, left: &mut *self.left, take: &mut *self.take });
        self.path.truncate(length);
        result
    }
}

impl<'de> DeserializeSeed<'de> for Numbers<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Numbers<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a MessagePack value")
    }

    fn visit_bool<E: de::Error>(self, value: bool) -> Result<(), E> {
        self.number(f64::from(u8::from(value)))
    }

    fn visit_u64<E: de::Error>(self, value: u64) -> Result<(), E> {
        self.number(value as f64)
    }

    fn visit_i64<E: de::Error>(self, value: i64) -> Result<(), E> {
        self.number(value as f64)
    }

    fn visit_f64<E: de::Error>(self, value: f64) -> Result<(), E> {
        self.number(value)
    }

    fn visit_unit<E: de::Error>(self) -> Result<(), E> {
        Ok(())
    }

    fn visit_none<E: de::Error>(self) -> Result<(), E> {
        Ok(())
    }

    fn visit_str<E: de::Error>(self, _: &str) -> Result<(), E> {
        Ok(())
    }

    fn visit_bytes<E: de::Error>(self, _: &[u8]) -> Result<(), E> {
        Ok(())
    }

    /// An extension of MessagePack has no numbers.
    fn visit_newtype_struct<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        IgnoredAny::deserialize(deserializer).map(drop)
    }

    fn visit_seq<A: SeqAccess<'de>>(mut self, mut list: A) -> Result<(), A::Error> {
        let mut place = 0_usize;
        while self.member(place, |member| list.next_element_seed(member))?.is_some() {
            place += 1;
        }
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(mut self, mut map: A) -> Result<(), A::Error> {
        while let Some(Key(key)) = map.next_key()? {
            self.member(key, |member| map.next_value_seed(member))?;
        }
        Ok(())
    }
}

/// The key of a map as text, without control characters and at most as long as a path.
struct Key(String);

impl<'de> de::Deserialize<'de> for Key {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(KeyVisitor).map(Self)
    }
}

struct KeyVisitor;

impl Visitor<'_> for KeyVisitor {
    type Value = String;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a text or a number as the key of a map")
    }

    fn visit_str<E: de::Error>(self, key: &str) -> Result<String, E> {
        Ok(key.chars().take(PATH_MAX).map(|letter| if letter.is_control() { '?' } else { letter }).collect())
    }

    fn visit_u64<E: de::Error>(self, key: u64) -> Result<String, E> {
        Ok(key.to_string())
    }

    fn visit_i64<E: de::Error>(self, key: i64) -> Result<String, E> {
        Ok(key.to_string())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde::Serialize;

    use super::*;

    #[derive(Serialize)]
    struct Joint {
        name: &'static str,
        angle: f32,
        is_safe: bool,
    }

    #[derive(Serialize)]
    struct Gait {
        phase: f64,
        joints: Vec<Joint>,
        count: u64,
        #[serde(with = "serde_bytes")]
        raw: Vec<u8>,
        none: Option<u8>,
    }

    fn found(payload: &[u8]) -> Vec<(String, f64)> {
        let mut found = Vec::new();
        numbers(payload, &mut |path, value| found.push((path.to_owned(), value)));
        found
    }

    #[test]
    fn numbers_of_protected_payloads_are_in_their_envelopes() {
        use sinew::{
            Tid, Time,
            protection::{DataId, Stamp, seal},
        };
        let joint =
            rmp_serde::to_vec_named(&Joint { name: "knee", angle: 0.5, is_safe: true }).expect("it is a map");
        let data_id = DataId { source: Tid::from_bits(1), destination: Tid::from_bits(2), name: "exo.joint" };
        let stamp = Stamp { counter: 3, incarnation: 7, echo: Time::ZERO };
        assert_eq!(found(&seal(&data_id, stamp, &joint)), found(&joint));
        assert_eq!(found(&joint).len(), 2);
    }

    #[test]
    fn numbers_have_the_paths_of_their_fields() {
        let joint = Joint { name: "knee", angle: 0.5, is_safe: true };
        let gait = Gait { phase: 0.25, joints: vec![joint], count: 7, raw: vec![1, 2], none: None };
        let payload = rmp_serde::to_vec_named(&gait).expect("it can be encoded");
        let all = [("phase", 0.25), ("joints.0.angle", 0.5), ("joints.0.is_safe", 1.0), ("count", 7.0)];
        assert_eq!(found(&payload), all.map(|(path, value)| (path.to_owned(), value)));
    }

    #[test]
    fn numbers_and_paths_have_bounds() {
        let many = rmp_serde::to_vec(&vec![1_u8; 1_000]).expect("it can be encoded");
        assert_eq!(found(&many).len(), NUMBERS_MAX);
        let long = std::collections::BTreeMap::from([("x".repeat(10_000), 1_u8)]);
        let long = rmp_serde::to_vec(&long).expect("it can be encoded");
        assert!(found(&long).iter().all(|(path, _)| path.len() <= PATH_MAX));
        assert!(found(&[0x91; 10_000]).is_empty());
    }

    proptest! {
        #[test]
        fn any_bytes_have_few_numbers(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
            prop_assert!(found(&bytes).len() <= NUMBERS_MAX);
        }
    }
}
