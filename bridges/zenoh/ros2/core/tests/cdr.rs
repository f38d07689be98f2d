//! Properties of messages as bytes, for types and values of all forms.

use std::sync::Arc;

use proptest::{collection::vec, prelude::*};
use sinew_ros2_core::{
    Catalog, Count, Element, MESSAGE_BYTES_MAX, Member, Structure, TypeName, Value, decode, encode,
};

fn element(depth: u32) -> BoxedStrategy<Element> {
    let leaf = prop_oneof![
        Just(Element::Bool),
        Just(Element::Byte),
        prop_oneof![Just(8_u8), Just(16), Just(32), Just(64)].prop_map(Element::Signed),
        prop_oneof![Just(8_u8), Just(16), Just(32), Just(64)].prop_map(Element::Unsigned),
        prop_oneof![Just(32_u8), Just(64)].prop_map(Element::Float),
        prop_oneof![Just(None), Just(Some(12))].prop_map(Element::Text),
    ];
    if depth == 0 {
        return leaf.boxed();
    }
    prop_oneof![3 => leaf, 1 => structure(depth - 1).prop_map(|of| Element::Message(Arc::new(of)))].boxed()
}

fn structure(depth: u32) -> BoxedStrategy<Structure> {
    let count = prop_oneof![
        2 => Just(Count::One),
        1 => (1_u32..4).prop_map(Count::Array),
        1 => (1_u32..4).prop_map(Count::Bounded),
        1 => Just(Count::Unbounded),
    ];
    let members = vec((element(depth), count), 1..6);
    members
        .prop_map(|members| {
            let member = |(at, (element, count))| Member { name: format!("m{at}"), element, count };
            let name = TypeName::parse("demo_msgs/msg/Any").expect("a name");
            Structure { name, members: members.into_iter().enumerate().map(member).collect() }
        })
        .boxed()
}

fn one(of: &Element) -> BoxedStrategy<Value> {
    match of {
        Element::Bool => any::<bool>().prop_map(Value::Bool).boxed(),
        Element::Byte => any::<u8>().prop_map(|value| Value::Unsigned(value.into())).boxed(),
        Element::Signed(bits) => {
            let unused = 64 - u32::from(*bits);
            any::<i64>().prop_map(move |value| Value::Signed(value >> unused)).boxed()
        }
        Element::Unsigned(bits) => {
            let unused = 64 - u32::from(*bits);
            any::<u64>().prop_map(move |value| Value::Unsigned(value >> unused)).boxed()
        }
        Element::Float(32) => any::<f32>()
            .prop_filter("a number", |value| !value.is_nan())
            .prop_map(|value| Value::Float(value.into()))
            .boxed(),
        Element::Float(_) => {
            any::<f64>().prop_filter("a number", |value| !value.is_nan()).prop_map(Value::Float).boxed()
        }
        Element::Text(_) => "[a-z]{0,12}".prop_map(Value::Text).boxed(),
        Element::Message(inner) => message(inner),
    }
}

fn message(of: &Structure) -> BoxedStrategy<Value> {
    let member = |member: &Member| {
        let one = one(&member.element);
        match member.count {
            Count::One => one,
            Count::Array(length) => vec(one, length as usize).prop_map(Value::List).boxed(),
            Count::Bounded(max) => vec(one, 0..=max as usize).prop_map(Value::List).boxed(),
            Count::Unbounded => vec(one, 0..4).prop_map(Value::List).boxed(),
        }
    };
    let members: Vec<_> = of.members.iter().map(member).collect();
    members.prop_map(Value::Message).boxed()
}

fn typed() -> impl Strategy<Value = (Structure, Value)> {
    structure(2).prop_flat_map(|of| {
        let value = message(&of);
        (Just(of), value)
    })
}

proptest! {
    #[test]
    fn each_value_is_read_as_it_was_written((of, value) in typed()) {
        let bytes = encode(&of, &value).expect("it is of the type");
        prop_assert_eq!(decode(&of, &bytes), Ok(value));
    }

    #[test]
    fn cut_messages_are_refused((of, value) in typed(), part in 0.0..1.0) {
        let bytes = encode(&of, &value).expect("it is of the type");
        let cut = (bytes.len() as f64 * part) as usize;
        prop_assert!(decode(&of, &bytes[..cut]).is_err());
    }

    #[test]
    fn any_bytes_are_read_or_refused(of in structure(2), mut bytes: Vec<u8>, little: bool) {
        if let [first, second, ..] = &mut bytes[..] {
            (*first, *second) = (0, little.into());
        }
        if let Ok(value) = decode(&of, &bytes) {
            // A text with a 0 in it can be read, and is not written.
            let _ = encode(&of, &value);
        }
    }
}

#[test]
fn lengths_from_outside_reserve_nothing() {
    let of = Catalog::shipped().message("std_msgs/msg/Float64MultiArray").expect("a type");
    let mut bytes = vec![0, 1, 0, 0];
    bytes.extend([0xff, 0xff, 0xff, 0x7f]);
    assert!(decode(&of, &bytes).expect_err("too many").to_string().starts_with("layout: dim: "));
    assert!(decode(&of, &vec![0; MESSAGE_BYTES_MAX + 1]).is_err());
    let too_long = Value::List(vec![Value::Float(0.0); MESSAGE_BYTES_MAX / 8]);
    let layout = Value::Message(vec![Value::List(Vec::new()), Value::Unsigned(0)]);
    assert!(encode(&of, &Value::Message(vec![layout, too_long])).is_err());
}

#[test]
fn other_representations_are_refused() {
    let of = Catalog::shipped().message("std_msgs/msg/Float64").expect("a type");
    let why = decode(&of, &[0, 7, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]).expect_err("XCDR2");
    assert!(why.to_string().contains("plain CDR"), "{why}");
    assert!(decode(&of, &[0, 1, 0]).is_err());
    let mut longer = vec![0, 1, 0, 0];
    longer.extend([0; 12]);
    assert!(decode(&of, &longer).expect_err("4 bytes more").to_string().contains("behind it"));
    assert!(decode(&of, &longer[..15]).is_ok());
}
