//! What is found of types that are written as users write them.

use std::{
    collections::{BTreeMap, HashMap},
    marker::PhantomData,
    num::NonZeroU32,
    time::Duration,
};

use serde::{Deserialize, Deserializer, Serialize, Serializer};
use sinew_schema::{Field, Schema, SchemaHash, Shape, Variant};

fn listed<T: Serialize + serde::de::DeserializeOwned>() -> String {
    Schema::of::<T>().expect("it is traced").to_string()
}

fn refused<T: Serialize + serde::de::DeserializeOwned>() -> String {
    Schema::of::<T>().expect_err("it has no fixed structure").to_string()
}

#[derive(Serialize, Deserialize)]
struct Degrees(f32);

#[derive(Serialize, Deserialize)]
enum Mode {
    Stand,
    Hold(Degrees),
    Walk { speed: f32, load: Option<f64> },
    Track(u8, i16),
}

#[derive(Serialize, Deserialize)]
struct Gains {
    kp: f32,
    #[serde(default)]
    kd: f32,
}

#[derive(Serialize, Deserialize)]
struct Robot {
    legs: Vec<Gains>,
    mode: Option<Mode>,
    by_joint: BTreeMap<String, Vec<Inner>>,
    position: [f64; 3],
    pair: (u8, String),
    #[serde(with = "serde_bytes")]
    image: Vec<u8>,
    nothing: PhantomData<u8>,
    since: Duration,
}

#[derive(Serialize, Deserialize)]
enum Inner {
    First,
    Second(Vec<Innermost>),
}

#[derive(Serialize, Deserialize)]
enum Innermost {
    Left,
    Right { of: char },
}

#[test]
fn enums_in_lists_maps_and_options_are_traced_completely() {
    let words = "{
    legs: list of Gains,
    mode: optional Mode, may be absent,
    by_joint: map from text to list of Inner,
    position: 3 x f64,
    pair: (u8, text),
    image: bytes,
    nothing: PhantomData,
    since: Duration,
}
Degrees = f32
Duration = {
    secs: u64,
    nanos: u32,
}
Gains = {
    kp: f32,
    kd: f32, may be absent,
}
Inner = one of {
    First,
    Second(list of Innermost),
}
Innermost = one of {
    Left,
    Right { of: char },
}
Mode = one of {
    Stand,
    Hold(Degrees),
    Walk { speed: f32, load: optional f64 },
    Track(u8, i16),
}
PhantomData = nothing
";
    assert_eq!(listed::<Robot>(), words);
}

#[test]
fn optional_fields_are_found_in_variants_too() {
    let schema = Schema::of::<Mode>().unwrap();
    let Shape::Enum(variants) = &schema.root else { panic!("{schema}") };
    let Shape::Struct(fields) = &variants[2].shape else { panic!("{schema}") };
    assert_eq!(fields.iter().map(|field| field.optional).collect::<Vec<_>>(), [false, true]);
}

#[test]
fn option_with_its_own_reader_may_not_be_absent() {
    #[derive(Serialize, Deserialize)]
    struct Strict {
        #[serde(deserialize_with = "Option::deserialize")]
        limit: Option<f32>,
    }
    assert_eq!(listed::<Strict>(), "{\n    limit: optional f32,\n}\n");
}

#[derive(Serialize, Deserialize)]
enum Tree {
    Node(Box<Self>, Vec<Self>),
    Either { left: Option<Box<Self>>, right: Leaf },
    Leaf(Leaf),
}

#[derive(Serialize, Deserialize)]
enum Leaf {
    Green,
    Brown(u8),
}

#[derive(Serialize, Deserialize)]
struct Chain {
    next: Option<Box<Self>>,
    value: f32,
}

#[test]
fn types_that_occur_in_themselves_have_a_name() {
    let tree = Schema::of::<Tree>().unwrap();
    assert_eq!(tree.root, Shape::Named("Tree".into()));
    assert_eq!(tree.types.keys().collect::<Vec<_>>(), ["Leaf", "Tree"]);
    assert_eq!(
        listed::<Chain>(),
        "Chain\nChain = {\n    next: optional Chain, may be absent,\n    value: f32,\n}\n"
    );
}

#[test]
fn aliases_of_fields_and_variants_are_left_out() {
    #[derive(Serialize, Deserialize)]
    struct Angle {
        #[serde(alias = "angle", alias = "a")]
        degrees: f32,
        #[serde(rename = "v")]
        speed: f32,
        #[serde(skip)]
        _kept: u8,
    }
    #[derive(Serialize, Deserialize)]
    enum Leg {
        #[serde(alias = "L")]
        Left,
        #[serde(rename = "right")]
        Right,
    }
    assert_eq!(listed::<Angle>(), "{\n    degrees: f32,\n    v: f32,\n}\n");
    assert_eq!(listed::<Leg>(), "one of {\n    Left,\n    right,\n}\n");
}

#[test]
fn simple_payloads_have_the_structure_in_place() {
    #[derive(Serialize, Deserialize)]
    struct Stop;
    #[derive(Serialize, Deserialize)]
    struct Braces {}
    assert_eq!(Schema::of::<Stop>().unwrap().root, Shape::Unit);
    assert_eq!(Schema::of::<Braces>().unwrap().root, Shape::Struct(Vec::new()));
    assert_eq!(Schema::of::<Degrees>().unwrap().root, Shape::Newtype(Box::new(Shape::F32)));
    assert_eq!(listed::<[[f32; 20]; 2]>(), "2 x 20 x f32\n");
    assert_eq!(listed::<HashMap<u8, bool>>(), "map from u8 to bool\n");
    // Zero is refused; the second sample is not.
    assert_eq!(listed::<Option<NonZeroU32>>(), "optional u32\n");
}

/// Two types with the name `Vector` and different fields.
mod other {
    #[derive(serde::Serialize, serde::Deserialize)]
    pub(super) struct Vector {
        pub(super) x: f32,
    }
}

#[derive(Serialize, Deserialize)]
struct Vector {
    y: f32,
}

struct Even(u8);

impl Serialize for Even {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        self.0.serialize(to)
    }
}

impl<'de> Deserialize<'de> for Even {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        let value = String::deserialize(from)?;
        let value: u8 = value.parse().map_err(serde::de::Error::custom)?;
        Ok(Self(value))
    }
}

struct Panics;

impl Serialize for Panics {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_unit()
    }
}

impl<'de> Deserialize<'de> for Panics {
    fn deserialize<D: Deserializer<'de>>(_: D) -> Result<Self, D::Error> {
        panic!("not today");
    }
}

#[test]
fn types_without_a_fixed_structure_say_why() {
    #[derive(Serialize, Deserialize)]
    struct Two {
        one: Vector,
        two: other::Vector,
    }
    #[derive(Serialize, Deserialize)]
    struct Flat {
        #[serde(flatten)]
        gains: Gains,
    }
    #[derive(Serialize, Deserialize)]
    #[serde(untagged)]
    enum Untagged {
        One(f32),
        Two(String),
    }
    #[derive(Serialize, Deserialize)]
    #[serde(tag = "kind")]
    enum Tagged {
        One { x: f32 },
        Two { y: f32 },
    }
    type Cube = Vec<[[[f32; 32]; 32]; 32]>;
    #[derive(Serialize, Deserialize)]
    struct Large(Cube, Cube, Cube, Cube);
    /// Is read as a number and written as a text.
    #[derive(Serialize, Deserialize)]
    struct Crooked {
        #[serde(serialize_with = "as_text")]
        value: f32,
    }
    fn as_text<S: Serializer>(value: &f32, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_str(&value.to_string())
    }
    assert_eq!(refused::<Two>(), "two types inside it have the name Vector");
    assert!(refused::<Flat>().starts_with("it has no fixed structure"));
    assert!(refused::<Untagged>().starts_with("it has no fixed structure"));
    assert!(refused::<Tagged>().starts_with("it has no fixed structure"));
    assert!(
        refused::<Even>().starts_with("it refuses the sample that it was given: "),
        "{}",
        refused::<Even>()
    );
    assert_eq!(refused::<Panics>(), "its code panics with a sample");
    assert_eq!(refused::<Large>(), "it reads too many values");
    assert_eq!(refused::<Crooked>(), "a part of it is written in another form than it is read");
}

#[test]
fn hash_is_the_same_in_every_build() {
    let field = |name: &str, shape, optional| Field { name: name.into(), shape, optional };
    let schema = Schema {
        root: Shape::Struct(vec![
            field("angle", Shape::Named("Degrees".into()), false),
            field("mode", Shape::Option(Box::new(Shape::Named("Mode".into()))), true),
            field("raw", Shape::Array(Box::new(Shape::U16), 300), false),
        ]),
        types: BTreeMap::from([
            ("Degrees".into(), Shape::Newtype(Box::new(Shape::F32))),
            (
                "Mode".into(),
                Shape::Enum(vec![
                    Variant { name: "Stand".into(), shape: Shape::Unit },
                    Variant { name: "Walk".into(), shape: Shape::Newtype(Box::new(Shape::F64)) },
                ]),
            ),
        ]),
    };
    let bytes = b"\x01\x16\x03\x05angle\x00\x19\x07Degrees\x04mode\x01\x11\x19\x04Mode\x03raw\x00\x13\x08\xac\x02\x02\
        \x07Degrees\x17\x0c\x04Mode\x18\x02\x05Stand\x00\x04Walk\x17\x0d";
    assert_eq!(schema.encode(), bytes);
    assert_eq!(schema.hash(), SchemaHash(HASH));
    assert_eq!(Schema::parse(bytes).as_ref(), Ok(&schema));
}

#[test]
fn documented_bytes_are_a_schema() {
    let text = include_str!("../../../docs/protocol/schema.md");
    let block =
        text.split("```").find(|block| block.starts_with("text\n01")).expect("the page has an example");
    let is_byte = |token: &&str| token.len() == 2 && u8::from_str_radix(token, 16).is_ok();
    let tokens = block.lines().flat_map(|line| line.split_whitespace().take_while(is_byte));
    let bytes: Vec<u8> = tokens.map(|token| u8::from_str_radix(token, 16).unwrap()).collect();
    #[derive(Serialize, Deserialize)]
    struct Angle {
        angle: Degrees,
    }
    assert_eq!(Schema::of::<Angle>().unwrap().encode(), bytes);
}

/// Computed once by another program, from the bytes above.
const HASH: u64 = 0xf1dc_dc3e_618e_279f;
