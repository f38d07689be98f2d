//! The differences between two versions of a type, in words, and properties of bytes and comparisons.

use std::collections::BTreeMap;

use proptest::prelude::*;
use serde::{Deserialize, Serialize};
use sinew_schema::{Comparison, Field, Schema, SchemaError, Shape, Variant, compare};

#[derive(Serialize, Deserialize)]
struct Degrees(f32);
#[derive(Serialize, Deserialize)]
struct Radians(f32);

/// Declares a type and returns its schema.
macro_rules! schema {
    ($($item:tt)*) => {{
        #[derive(Serialize, Deserialize)]
        $($item)*
        Schema::of::<Payload>().expect("it is traced")
    }};
}

fn words(differences: &[sinew_schema::Difference]) -> Vec<String> {
    differences.iter().map(ToString::to_string).collect()
}

fn conflict(sent: &Schema, handled: &Schema) -> Vec<String> {
    let compared = compare(sent, handled);
    assert!(matches!(compared, Comparison::Conflict(_)), "{compared:?}");
    words(compared.differences())
}

fn addition(sent: &Schema, handled: &Schema) -> Vec<String> {
    let compared = compare(sent, handled);
    assert!(matches!(compared, Comparison::Addition(_)), "{compared:?}");
    words(compared.differences())
}

#[test]
fn added_fields_pass_where_the_receiver_accepts_them() {
    let old = schema! { struct Payload { kp: f32 } };
    let new = schema! { struct Payload { kp: f32, kd: f32 } };
    let tolerant = schema! { struct Payload { kp: f32, #[serde(default)] kd: f32 } };
    assert_eq!(addition(&new, &old), ["field `kd` is missing at the receiver"]);
    assert_eq!(conflict(&old, &new), ["field `kd` is missing at the sender"]);
    assert_eq!(
        addition(&old, &tolerant),
        ["field `kd` is missing at the sender, which the receiver accepts"]
    );
    // Whether a field may be absent is no difference where it is there.
    assert_eq!(compare(&new, &tolerant), Comparison::Same);
    // One more at each end: the receiver skips the one, and accepts to be without the other.
    let both = schema! { struct Payload { kp: f32, ki: u8 } };
    let of_both = [
        "field `kd` is missing at the sender, which the receiver accepts",
        "field `ki` is missing at the receiver",
    ];
    assert_eq!(addition(&both, &tolerant), of_both);
    let optional = schema! { struct Payload { kp: f32, #[serde(default)] ki: f32 } };
    assert_eq!(addition(&optional, &tolerant), of_both);
}

#[test]
fn renamed_field_is_named_at_both_ends() {
    let sent = schema! { struct Payload { angle: f32, limit: f64 } };
    let handled = schema! { struct Payload { degrees: f32, limit: f64 } };
    let said = ["field `angle` (f32) at the sender seems to be `degrees` (f32) at the receiver"];
    assert_eq!(conflict(&sent, &handled), said);
    // Also where the receiver would accept a message without it.
    let tolerant = schema! { struct Payload { #[serde(default)] degrees: f32, limit: f64 } };
    assert_eq!(conflict(&sent, &tolerant), said);
}

#[test]
fn other_numbers_and_units_are_conflicts() {
    let sent = schema! { struct Payload { limits: Vec<f64>, angle: Degrees, ids: u32, pair: [u8; 2] } };
    let handled = schema! { struct Payload { limits: Vec<f32>, angle: Radians, ids: String, pair: [u8; 3] } };
    assert_eq!(
        conflict(&sent, &handled),
        [
            "`limits[]` is f64 at the sender and f32 at the receiver",
            "`angle` is in Degrees at the sender and Radians at the receiver",
            "`ids` is u32 at the sender and text at the receiver",
            "`pair` is 2 x u8 at the sender and 3 x u8 at the receiver",
        ]
    );
}

#[test]
fn unit_that_only_one_end_names_is_doubtful() {
    let bare = schema! { struct Payload { turn: f32 } };
    let unit = schema! { struct Payload { turn: Degrees } };
    for (sent, handled, one, other) in
        [(&bare, &unit, "f32", "Degrees (f32)"), (&unit, &bare, "Degrees (f32)", "f32")]
    {
        let words = format!(
            "`turn` is {one} at the sender and {other} at the receiver, which is the same on the wire"
        );
        assert_eq!(addition(sent, handled), [words]);
        assert!(compare(sent, handled).differences()[0].is_doubtful);
    }
    // The unit of a list is one too, and the name of a text is none.
    #[derive(Serialize, Deserialize)]
    struct InDegrees(Vec<f32>);
    #[derive(Serialize, Deserialize)]
    struct InRadians(Vec<f32>);
    #[derive(Serialize, Deserialize)]
    struct JointName(String);
    #[derive(Serialize, Deserialize)]
    struct LinkName(String);
    let sent = schema! { struct Payload { all: InDegrees } };
    let handled = schema! { struct Payload { all: InRadians } };
    assert_eq!(
        conflict(&sent, &handled),
        ["`all` is in InDegrees at the sender and InRadians at the receiver"]
    );
    let sent = schema! { struct Payload { of: JointName } };
    let handled = schema! { struct Payload { of: LinkName } };
    assert_eq!(
        addition(&sent, &handled),
        ["`of` is called JointName at the sender and LinkName at the receiver"]
    );
}

#[test]
fn wider_types_are_accepted() {
    let narrow = schema! { struct Payload {
        a: u8, b: u8, c: i32, d: f32, e: u16, f: [u8; 2], g: u8, h: char,
    } };
    let wide = schema! { struct Payload {
        a: u16, b: i16, c: i64, d: f64, e: f32, f: Vec<u8>, g: Option<u8>, h: String,
    } };
    let words = addition(&narrow, &wide);
    assert_eq!(words[0], "`a` is u8 at the sender and u16 at the receiver, which holds each value");
    assert_eq!(words[5], "`f` has 2 values at the sender, and any number at the receiver");
    assert_eq!(words[6], "`g` is always there at the sender, and may be absent at the receiver");
    assert_eq!(words.len(), 8);
    assert_eq!(conflict(&wide, &narrow).len(), 8);
    // A number that does not hold each value: the sign, the size, the exact integers of a float.
    let sent = schema! { struct Payload { a: u8, b: i8, c: u32, d: i64, e: f32 } };
    let handled = schema! { struct Payload { a: i8, b: u64, c: f32, d: f64, e: i64 } };
    assert_eq!(conflict(&sent, &handled).len(), 5);
}

#[test]
fn nested_types_are_compared_by_their_parts() {
    let sent = {
        #[derive(Serialize, Deserialize)]
        enum Mode {
            Stand,
            Walk { speed: f32 },
            Run,
        }
        schema! { struct Payload { mode: Option<Mode> } }
    };
    let handled = {
        #[derive(Serialize, Deserialize)]
        enum Gait {
            Stand,
            Walk { speed: f32 },
        }
        schema! { struct Payload { mode: Option<Gait> } }
    };
    let other = {
        #[derive(Serialize, Deserialize)]
        enum Mode {
            Stand,
            Walk { speed: i32 },
        }
        schema! { struct Payload { mode: Option<Mode> } }
    };
    let words = "variant `mode.Run` is missing at the receiver, whose decoder refuses messages with it";
    assert_eq!(addition(&sent, &handled), [words]);
    assert!(compare(&sent, &handled).differences()[0].is_doubtful);
    assert_eq!(addition(&handled, &sent), ["variant `mode.Run` is missing at the sender"]);
    assert_eq!(
        conflict(&other, &handled),
        ["`mode.Walk.speed` is i32 at the sender and f32 at the receiver"]
    );
}

#[test]
fn payloads_without_fields_are_the_same() {
    let unit = schema! { struct Payload; };
    let braces = schema! { struct Payload {} };
    let one = schema! { struct Payload { x: u8 } };
    assert_eq!(compare(&unit, &braces), Comparison::Same);
    assert_eq!(conflict(&one, &unit), ["the payload is { x: u8 } at the sender and nothing at the receiver"]);
}

#[test]
fn hostile_bytes_are_refused() {
    let endless = Schema {
        root: Shape::Named("A".into()),
        types: BTreeMap::from([
            ("A".into(), Shape::Option(Box::new(Shape::Named("B".into())))),
            ("B".into(), Shape::Newtype(Box::new(Shape::Named("A".into())))),
        ]),
    };
    let dangling = Schema { root: Shape::Named("A".into()), types: BTreeMap::new() };
    let unused = Schema { root: Shape::U8, types: BTreeMap::from([("A".into(), Shape::U8)]) };
    let mut deep = Shape::U8;
    for _ in 0..100 {
        deep = Shape::List(Box::new(deep));
    }
    let deep = Schema { root: deep, types: BTreeMap::new() };
    for (schema, error) in [
        (endless, SchemaError::Endless),
        (dangling, SchemaError::Dangling),
        (unused, SchemaError::Dangling),
        (deep, SchemaError::TooMuch),
    ] {
        assert_eq!(Schema::parse(&schema.encode()), Err(error));
    }
    for (bytes, error) in [
        (&[][..], SchemaError::Short),
        (&[2, 0, 0], SchemaError::Unknown),
        (&[1, 99, 0], SchemaError::Unknown),
        (&[1, 0, 0, 0], SchemaError::Rest),
        // A number in a longer form than needed.
        (&[1, 0, 0x80, 0], SchemaError::NotCanonical),
        // A million parts that do not follow.
        (&[1, 20, 0x80, 0x08], SchemaError::Short),
        (&[0; 9_000], SchemaError::TooLong),
    ] {
        assert_eq!(Schema::parse(bytes), Err(error), "{} bytes", bytes.len());
    }
}

fn name() -> impl Strategy<Value = String> {
    "[a-c]{1,2}"
}

fn shape() -> impl Strategy<Value = Shape> {
    let leaf =
        prop::sample::select(vec![Shape::Unit, Shape::Bool, Shape::U8, Shape::F32, Shape::F64, Shape::Text]);
    leaf.prop_recursive(4, 24, 4, |inner| {
        let boxed = || inner.clone().prop_map(Box::new);
        let fields = prop::collection::btree_map(name(), (inner.clone(), any::<bool>()), 0..4)
            .prop_map(|fields| {
                let field = |(name, (shape, optional))| Field { name, shape, optional };
                Shape::Struct(fields.into_iter().map(field).collect())
            })
            .boxed();
        let variants = prop::collection::btree_map(name(), fields.clone(), 1..4).prop_map(|variants| {
            Shape::Enum(variants.into_iter().map(|(name, shape)| Variant { name, shape }).collect())
        });
        prop_oneof![
            boxed().prop_map(Shape::Option),
            boxed().prop_map(Shape::List),
            (boxed(), 0..300_usize).prop_map(|(inner, length)| Shape::Array(inner, length)),
            prop::collection::vec(inner.clone(), 0..4).prop_map(Shape::Tuple),
            (boxed(), boxed()).prop_map(|(key, value)| Shape::Map(key, value)),
            fields,
            variants,
        ]
    })
}

/// A schema with up to three types, of which the root names all.
fn schema() -> impl Strategy<Value = Schema> {
    (shape(), prop::collection::btree_map("[A-C]", (shape(), any::<bool>()), 0..3)).prop_map(
        |(root, types)| {
            let named = types.keys().map(|name| Shape::Named(name.clone()));
            let root = Shape::Tuple(named.chain([root]).collect());
            let typed = |(name, (shape, is_unit)): (String, (Shape, bool))| {
                (name, if is_unit { Shape::Newtype(Box::new(shape)) } else { shape })
            };
            Schema { root, types: types.into_iter().map(typed).collect() }
        },
    )
}

proptest! {
    #[test]
    fn bytes_are_read_back_and_equal_schemas_hash_equally(one in schema(), other in schema()) {
        prop_assert_eq!(Schema::parse(&one.encode()), Ok(one.clone()));
        prop_assert_eq!(one == other, one.hash() == other.hash());
    }

    #[test]
    fn changed_bytes_are_refused_or_canonical(one in schema(), at in any::<prop::sample::Index>(), byte in any::<u8>()) {
        let mut bytes = one.encode();
        let at = at.index(bytes.len());
        bytes[at] = byte;
        if let Ok(read) = Schema::parse(&bytes) {
            prop_assert_eq!(read.encode(), bytes);
            let _ = (read.to_string(), compare(&one, &read), compare(&read, &one));
        }
    }

    #[test]
    fn comparison_with_itself_is_the_same_and_sides_agree(one in schema(), other in schema()) {
        prop_assert_eq!(compare(&one, &one), Comparison::Same);
        let is_same = |one, other| compare(one, other) == Comparison::Same;
        prop_assert_eq!(is_same(&one, &other), is_same(&other, &one));
        prop_assert_eq!(
            compare(&one, &other).differences().is_empty(),
            compare(&other, &one).differences().is_empty()
        );
    }
}

/// A struct in a struct, in so many levels.
fn nested(levels: usize) -> Schema {
    let name = |level: usize| format!("Level{level}");
    let level = |at: usize| {
        let shape = if at + 1 == levels { Shape::U8 } else { Shape::Named(name(at + 1)) };
        (name(at), Shape::Struct(vec![Field { name: "a".into(), shape, optional: false }]))
    };
    Schema { root: Shape::Named(name(0)), types: (0..levels).map(level).collect() }
}

#[test]
fn depth_of_a_comparison_is_limited() {
    assert_eq!(compare(&nested(100), &nested(100)), Comparison::Same);
    let differences = conflict(&nested(200), &nested(200));
    assert_eq!(differences.len(), 1);
    assert!(differences[0].ends_with("is nested too deep to be compared"), "{differences:?}");
}

/// A struct with a field for each pair of `count` types. `of` selects the type of a field.
fn paired(count: usize, of: impl Fn(usize, usize) -> usize) -> Schema {
    let name = |type_number: usize| format!("Part{type_number}");
    let pairs = (0..count).flat_map(|one| (0..count).map(move |other| (one, other)));
    let fields = pairs.map(|(one, other)| Field {
        name: format!("f{one}_{other}"),
        shape: Shape::Named(name(of(one, other))),
        optional: false,
    });
    let root = Shape::Struct(fields.collect());
    let part = Shape::Struct(vec![Field { name: "a".into(), shape: Shape::U8, optional: false }]);
    Schema { root, types: (0..count).map(|at| (name(at), part.clone())).collect() }
}

#[test]
fn pairs_of_a_comparison_are_limited() {
    let of = |count| compare(&paired(count, |one, _| one), &paired(count, |_, other| other));
    assert_eq!(of(64), Comparison::Same);
    let beyond = of(65);
    assert!(matches!(beyond, Comparison::Conflict(_)));
    assert!(words(beyond.differences())[0].ends_with("is behind 4096 pairs of types, and is not compared"));
}

#[test]
fn names_of_another_node_cannot_forge_lines() {
    let forged = "a\n\u{1b}[31mERROR\u{202e}";
    let field = |shape| Field { name: forged.into(), shape, optional: false };
    let variant = Variant { name: forged.into(), shape: Shape::Struct(vec![field(Shape::U8)]) };
    let inside = Shape::Struct(vec![
        field(Shape::Enum(vec![variant])),
        Field { name: "b".into(), ..field(Shape::U8) },
    ]);
    let types = BTreeMap::from([(forged.to_owned(), Shape::Newtype(Box::new(inside.clone())))]);
    let sent = Schema {
        root: Shape::Struct(vec![
            Field { name: "list".into(), ..field(Shape::List(Box::new(inside))) },
            Field { name: "unit".into(), ..field(Shape::Named(forged.into())) },
            field(Shape::U8),
        ]),
        types,
    };
    let handled = schema! { struct Payload { list: u8, unit: Degrees, other: u8 } };
    let mut lines: Vec<_> = [compare(&sent, &handled), compare(&handled, &sent)]
        .iter()
        .flat_map(|compared| words(compared.differences()))
        .collect();
    assert!(lines.len() >= 6, "{lines:?}");
    lines.extend(sent.to_string().lines().map(str::to_owned));
    for line in lines {
        assert!(!line.contains(|one: char| one.is_control() || one == '\u{202e}'), "{line:?}");
    }
}

/// Newtypes in levels of 100 parts each, with texts in the innermost: 10,000,000,000,000,000 in all.
fn wide_units(name: &str) -> Schema {
    let named = |level: usize| Shape::Named(format!("{name}{level}"));
    let level = |at: usize| {
        let part = if at == 7 { Shape::Text } else { named(at + 1) };
        (format!("{name}{at}"), Shape::Newtype(Box::new(Shape::Tuple(vec![part; 100]))))
    };
    Schema { root: named(0), types: (0..8).map(level).collect() }
}

#[test]
fn search_for_a_unit_is_limited() {
    let compared = compare(&wide_units("A"), &wide_units("B"));
    assert_eq!(words(compared.differences())[0], "the payload is in A0 at the sender and B0 at the receiver");
}
