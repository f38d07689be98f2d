//! Decoding of MessagePack: every number fits its field, and an error names the field.

use std::fmt;

use rmp_serde::decode::Error;
use serde::{
    Serialize,
    de::{DeserializeOwned, DeserializeSeed, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor},
};

use super::{
    encode,
    strict::{DEPTH_MAX, Strict, Trail},
};

/// Maximum length of an error's text in bytes: a part of it can be text from the sender.
const WORDS_BYTES_MAX: usize = 400;

/// Decodes a value from MessagePack.
///
/// A number that does not fit its field is rejected. Rejected numbers are integers out of range, and
/// floating-point numbers that would become infinite or lose their fraction. An integer that an `f32` or
/// `f64` field does not hold exactly is rejected too. A floating-point number is rounded to the nearest `f32`
/// for an `f32` field. NaN and infinity are accepted unchanged.
///
/// Values nested deeper than 64 levels are rejected. With rmp-serde's own limit of 1,024, a payload of 1,100
/// bytes, each the start of a list, can overflow the stack of a thread. That would end the process. rmp-serde
/// has no limit for enums.
///
/// # Errors
/// The bytes are not a `T`. The text names the field: "field `kp`: expected f32, found string".
pub fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, Error> {
    let trail = Trail::default();
    read(bytes, &trail).map_err(|error| with_path(error, &trail))
}

/// Same as [`decode`], for a value that can be encoded again. Numbers in flattened structs and untagged enums
/// pass through serde's own memory; they are rejected too if they would become infinite.
pub(super) fn decode_payload<T: DeserializeOwned + Serialize>(bytes: &[u8]) -> Result<T, Error> {
    let trail = Trail::default();
    let value = read(bytes, &trail).map_err(|error| with_path(error, &trail))?;
    if trail.is_doubtful() && infinities(&encode(&value)) > infinities(bytes) {
        let words =
            "a number is beyond the largest f32, and its field is one, in a flattened or untagged part";
        return Err(Error::Syntax(words.to_owned()));
    }
    Ok(value)
}

fn read<T: DeserializeOwned>(bytes: &[u8], trail: &Trail) -> Result<T, Error> {
    let mut inner = rmp_serde::Deserializer::from_read_ref(bytes);
    inner.set_max_depth(DEPTH_MAX.into());
    T::deserialize(Strict::new(&mut inner, trail))
}

/// Returns an error with the name of its field.
#[cold]
fn with_path(error: Error, trail: &Trail) -> Error {
    let (path, mut words) = (trail.path(), describe(error, trail.wanted()));
    if words.len() > WORDS_BYTES_MAX {
        words.truncate(words.floor_char_boundary(WORDS_BYTES_MAX));
        words.push_str("...");
    }
    Error::Syntax(if path.is_empty() { words } else { format!("field `{path}`: {words}") })
}

fn describe(error: Error, wanted: &str) -> String {
    match error {
        Error::Syntax(words) | Error::Uncategorized(words) => reworded(words),
        Error::InvalidMarkerRead(_) | Error::InvalidDataRead(_) => {
            "the payload ends before its value does".to_owned()
        }
        Error::TypeMismatch(marker) => {
            let found = format!("{marker:?}");
            // `FixStr(5)`, `Str8`, `Array16`, `Map32`, `Bin8`, `FixExt4`, `Reserved`.
            let found =
                KINDS.iter().find(|(mark, _)| found.contains(mark)).map_or(&*found, |(_, found)| found);
            format!("expected {wanted}, found {found}")
        }
        Error::OutOfRange => "the number is out of range".to_owned(),
        Error::LengthMismatch(length) => format!("a list or map has another length than expected: {length}"),
        Error::Utf8Error(cause) => format!("a text is not UTF-8: {cause}"),
        Error::DepthLimitExceeded => format!("values are nested deeper than {DEPTH_MAX} levels"),
    }
}

/// Values that are not numbers, by a part of their marker's name.
const KINDS: [(&str, &str); 5] =
    [("Str", "string"), ("Array", "sequence"), ("Map", "map"), ("Bin", "byte array"), ("Ext", "extension")];

/// Rewrites serde's text about a value of another type into the order that a reader needs.
fn reworded(words: String) -> String {
    let said = words.strip_prefix("invalid type: ").or_else(|| words.strip_prefix("invalid value: "));
    match said.and_then(|said| said.rsplit_once(", expected ")) {
        Some((found, expected)) => format!("expected {expected}, found {found}"),
        None => words,
    }
}

/// Returns the number of infinite numbers in a value.
fn infinities(bytes: &[u8]) -> usize {
    let mut count = 0;
    let mut inner = rmp_serde::Deserializer::from_read_ref(bytes);
    inner.set_max_depth(DEPTH_MAX.into());
    // A value that cannot be read was rejected before.
    let _ = Census(&mut count).deserialize(&mut inner);
    count
}

/// Counts infinite numbers.
struct Census<'c>(&'c mut usize);

impl<'de> DeserializeSeed<'de> for Census<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, inner: D) -> Result<(), D::Error> {
        inner.deserialize_any(self)
    }
}

macro_rules! forward_uncounted {
    ($($method:ident($value:ty))*) => {$(
        fn $method<E>(self, _: $value) -> Result<(), E> {
            Ok(())
        }
    )*};
}

impl<'de> Visitor<'de> for Census<'_> {
    type Value = ();

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("any value")
    }

    forward_uncounted! { visit_bool(bool) visit_i64(i64) visit_u64(u64) visit_str(&str) visit_bytes(&[u8]) }

    fn visit_f64<E>(self, value: f64) -> Result<(), E> {
        *self.0 += usize::from(value.is_infinite());
        Ok(())
    }

    fn visit_unit<E>(self) -> Result<(), E> {
        Ok(())
    }

    fn visit_newtype_struct<D: Deserializer<'de>>(self, inner: D) -> Result<(), D::Error> {
        inner.deserialize_any(IgnoredAny).map(drop)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut elements: A) -> Result<(), A::Error> {
        while elements.next_element_seed(Census(self.0))?.is_some() {}
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<(), A::Error> {
        while entries.next_key::<IgnoredAny>()?.is_some() {
            entries.next_value_seed(Census(self.0))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use serde::Deserialize;
    use serde_json::json;

    use super::*;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Gains {
        kp: f32,
        kd: Option<f32>,
    }

    #[derive(Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
    enum Joint {
        Hip,
        Knee,
    }

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Newtons(f32);

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    enum Mode {
        Off,
        Hold(f32),
        Walk { speed: f32, load: Newtons },
        Track(u8, f32),
    }

    #[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
    #[serde(default)]
    struct Robot {
        gains: Option<Gains>,
        legs: Vec<Gains>,
        offsets: [f32; 2],
        by_joint: BTreeMap<Joint, f32>,
        mode: Option<Mode>,
        load: Option<Newtons>,
        pair: (u8, i16),
        count: u32,
        mass: f64,
        serial: u128,
    }

    fn bytes(value: serde_json::Value) -> Vec<u8> {
        rmp_serde::to_vec_named(&value).unwrap()
    }

    fn refusal<T: DeserializeOwned + Serialize + fmt::Debug>(bytes: &[u8]) -> String {
        decode_payload::<T>(bytes).expect_err("it does not fit").to_string()
    }

    fn of_robot(value: serde_json::Value) -> String {
        refusal::<Robot>(&bytes(value))
    }

    #[test]
    fn float_that_would_be_infinite_is_rejected() {
        let huge = "expected f32, found 1e300, which is beyond the largest f32, 3.4028235e38";
        for (field, value) in [
            ("gains.kp", json!({"gains": {"kp": 1e300}})),
            ("gains.kd", json!({"gains": {"kp": 1, "kd": 1e300}})),
            ("legs[1].kp", json!({"legs": [{"kp": 1}, {"kp": 1e300}]})),
            ("offsets[1]", json!({"offsets": [0.5, 1e300]})),
            ("by_joint.Knee", json!({"by_joint": {"Hip": 1, "Knee": 1e300}})),
            ("mode.Hold", json!({"mode": {"Hold": 1e300}})),
            ("mode.Walk.speed", json!({"mode": {"Walk": {"speed": 1e300}}})),
            ("mode.Walk.load", json!({"mode": {"Walk": {"speed": 1, "load": 1e300}}})),
            ("mode.Track[1]", json!({"mode": {"Track": [1, 1e300]}})),
            ("load", json!({"load": 1e300})),
            // A struct as a list.
            ("gains.kd", json!({"gains": [1.0, 1e300]})),
        ] {
            assert_eq!(of_robot(value), format!("field `{field}`: {huge}"));
        }
        assert!(of_robot(json!({"load": -1e39})).contains("-1e39"));
    }

    #[test]
    fn integers_fit_their_field_or_are_rejected() {
        for (words, value) in [
            ("field `pair[0]`: expected u8, found integer `300`", json!({"pair": [300, 0]})),
            ("field `pair[1]`: expected i16, found integer `-40000`", json!({"pair": [1, -40000]})),
            ("field `count`: expected u32, found integer `-1`", json!({"count": -1})),
            ("field `count`: expected u32, found integer `4294967296`", json!({"count": 4_294_967_296_u64})),
            ("field `count`: expected u32, found floating point `1.5`", json!({"count": 1.5})),
            ("field `count`: expected u32, found boolean `true`", json!({"count": true})),
            ("field `serial`: expected u128, found integer `-1`", json!({"serial": -1})),
            (
                "field `load`: expected f32, found integer 16777217, which f32 does not hold exactly",
                json!({"load": 16_777_217}),
            ),
            (
                "field `mass`: expected f64, found integer -9007199254740993, which f64 does not hold exactly",
                json!({"mass": -9_007_199_254_740_993_i64}),
            ),
            (
                "field `mass`: expected f64, found integer 18446744073709551615, which f64 does not hold exactly",
                json!({"mass": u64::MAX}),
            ),
        ] {
            assert_eq!(of_robot(value), words);
        }
        let fits =
            json!({"load": 33_554_432, "mass": 9_007_199_254_740_992_i64, "pair": [255, -32768], "count": 0});
        assert_eq!(decode_payload::<Robot>(&bytes(fits)).unwrap().load, Some(Newtons(33_554_432.0)));
    }

    #[test]
    fn wrong_structure_names_its_field() {
        for (words, value) in [
            ("field `gains.kp`: expected f32, found string", json!({"gains": {"kp": "x"}})),
            ("field `gains.kp`: expected f32, found unit value", json!({"gains": {"kp": null}})),
            ("field `gains.kp`: expected f32, found map", json!({"gains": {"kp": {"x": 1}}})),
            ("field `gains.kp`: expected f32, found sequence", json!({"gains": {"kp": [1]}})),
            ("field `gains`: missing field `kp`", json!({"gains": {"kd": 1}})),
            ("field `gains`: expected struct Gains, found integer `1`", json!({"gains": 1})),
            ("field `offsets`: invalid length 1, expected an array of length 2", json!({"offsets": [1]})),
            (
                "field `mode`: unknown variant `Run`, expected one of `Off`, `Hold`, `Walk`, `Track`",
                json!({"mode": "Run"}),
            ),
            ("field `mode.Hold`: expected newtype variant, found unit variant", json!({"mode": "Hold"})),
        ] {
            assert_eq!(of_robot(value), words);
        }
        assert_eq!(
            refusal::<Gains>(&[0x81, 0xa2, b'k', b'p', 0xcb, 1]),
            "field `kp`: the payload ends before its value does"
        );
        assert_eq!(refusal::<Gains>(&[0x01]), "expected struct Gains, found integer `1`");
        let long = refusal::<Joint>(&bytes(json!("x".repeat(100_000))));
        assert!(long.len() < 500, "{} bytes", long.len());
    }

    #[test]
    fn sent_value_arrives_unchanged() {
        let robot = Robot {
            gains: Some(Gains { kp: f32::MAX, kd: Some(f32::MIN_POSITIVE) }),
            legs: vec![Gains { kp: f32::INFINITY, kd: None }],
            offsets: [-0.0, 1e-45],
            by_joint: [(Joint::Hip, 0.1), (Joint::Knee, f32::NEG_INFINITY)].into(),
            mode: Some(Mode::Walk { speed: 1.5, load: Newtons(2.5) }),
            load: Some(Newtons(3.0)),
            pair: (255, i16::MIN),
            count: u32::MAX,
            mass: f64::MAX,
            serial: u128::MAX,
        };
        assert_eq!(decode_payload::<Robot>(&encode(&robot)).unwrap(), robot);
        // A sender without `f32`: rounded to the nearest, and NaN stays NaN.
        let doubles = |kp: f64| decode_payload::<Gains>(&encode(&BTreeMap::from([("kp", kp)]))).unwrap().kp;
        assert_eq!((doubles(0.1), doubles(1e-300), doubles(f64::INFINITY)), (0.1, 0.0, f32::INFINITY));
        assert!(doubles(f64::NAN).is_nan());
        for mode in [Mode::Off, Mode::Hold(1.0), Mode::Track(1, 2.0)] {
            assert_eq!(decode_payload::<Mode>(&encode(&mode)).unwrap(), mode);
        }
    }

    #[derive(Debug, Serialize, Deserialize)]
    struct Flat {
        name: String,
        #[serde(flatten)]
        gains: Gains,
    }

    #[derive(Debug, Serialize, Deserialize)]
    #[serde(untagged)]
    enum Either {
        Gains(Gains),
        Double { x: f64 },
    }

    #[test]
    fn flattened_or_untagged_number_never_becomes_infinite() {
        for huge in [
            refusal::<Flat>(&bytes(json!({"name": "hip", "kp": 1e300}))),
            refusal::<Either>(&bytes(json!({"kp": 1e300}))),
        ] {
            assert!(huge.starts_with("a number is beyond the largest f32"), "{huge}");
        }
        assert!(decode_payload::<Either>(&bytes(json!({"x": 1e300}))).is_ok());
    }

    #[derive(Debug, Serialize, Deserialize)]
    enum Tree {
        Leaf,
        Not(Box<Self>),
    }

    #[derive(Debug, Serialize, Deserialize)]
    struct Chain(Option<Box<Self>>);

    #[test]
    fn endless_enums_and_newtypes_are_rejected() {
        let nots: Vec<u8> = [0x81, 0xa3, b'N', b'o', b't'].repeat(100_000);
        for words in [refusal::<Tree>(&nots), refusal::<Chain>(&[0x01])] {
            assert!(words.contains("values are nested deeper than 64 levels"), "{words}");
        }
        assert!(decode_payload::<Tree>(&encode(&Tree::Not(Box::new(Tree::Leaf)))).is_ok());
    }
}
