use std::mem::{offset_of, size_of};

use proptest::prelude::*;
use serde::{Deserialize, Serialize};

use super::*;

#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Inner {
    gain: f64,
    axis: u8,
}

#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
struct Outer {
    torque: f32,
    number: u32,
    offset: i16,
    is_armed: bool,
    mode: [u8; 8],
    points: [i64; 4],
    points_count: usize,
    limit: u64,
    has_limit: bool,
    inner: Inner,
    inners: [Inner; 2],
    blob: [u8; 5],
    blob_count: usize,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct RustInner {
    gain: f64,
    axis: u8,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct RustOuter {
    torque: f32,
    number: u32,
    offset: i16,
    is_armed: bool,
    mode: String,
    points: Vec<i64>,
    limit: Option<u64>,
    inner: RustInner,
    inners: [RustInner; 2],
    #[serde(with = "serde_bytes")]
    blob: Vec<u8>,
}

const fn plain(name: &CStr, field_type: FieldType, offset: usize, size: usize) -> Field {
    Field {
        name: name.as_ptr(),
        offset,
        size,
        extra_offset: 0,
        layout: std::ptr::null(),
        field_type: field_type as u32,
        flags: 0,
    }
}

fn inner_fields() -> [Field; 2] {
    [
        plain(c"gain", FieldType::SinewTypeF64, offset_of!(Inner, gain), 8),
        plain(c"axis", FieldType::SinewTypeU8, offset_of!(Inner, axis), 1),
    ]
}

fn with_outer<R>(use_it: impl FnOnce(&PayloadType) -> R) -> R {
    let inner = inner_fields();
    let inner = Layout { fields: inner.as_ptr(), fields_count: inner.len(), size: size_of::<Inner>() };
    let list = SINEW_FIELD_ARRAY | SINEW_FIELD_COUNTED;
    let fields = [
        plain(c"torque", FieldType::SinewTypeF32, offset_of!(Outer, torque), 4),
        plain(c"number", FieldType::SinewTypeU32, offset_of!(Outer, number), 4),
        plain(c"offset", FieldType::SinewTypeI16, offset_of!(Outer, offset), 2),
        plain(c"is_armed", FieldType::SinewTypeBool, offset_of!(Outer, is_armed), 1),
        plain(c"mode", FieldType::SinewTypeText, offset_of!(Outer, mode), 8),
        Field {
            flags: list,
            extra_offset: offset_of!(Outer, points_count),
            ..plain(c"points", FieldType::SinewTypeI64, offset_of!(Outer, points), 32)
        },
        Field {
            flags: SINEW_FIELD_OPTIONAL,
            extra_offset: offset_of!(Outer, has_limit),
            ..plain(c"limit", FieldType::SinewTypeU64, offset_of!(Outer, limit), 8)
        },
        Field {
            layout: &raw const inner,
            ..plain(c"inner", FieldType::SinewTypeStruct, offset_of!(Outer, inner), size_of::<Inner>())
        },
        Field {
            layout: &raw const inner,
            flags: SINEW_FIELD_ARRAY,
            ..plain(c"inners", FieldType::SinewTypeStruct, offset_of!(Outer, inners), 2 * size_of::<Inner>())
        },
        Field {
            flags: SINEW_FIELD_COUNTED,
            extra_offset: offset_of!(Outer, blob_count),
            ..plain(c"blob", FieldType::SinewTypeBytes, offset_of!(Outer, blob), 5)
        },
    ];
    let name = "test.outer";
    use_it(&PayloadType {
        name: Text { bytes: name.as_ptr().cast(), length: name.len() },
        message_class: 0,
        layout: Layout { fields: fields.as_ptr(), fields_count: fields.len(), size: size_of::<Outer>() },
        expires_after_ns: 0,
    })
}

fn in_rust() -> RustOuter {
    RustOuter {
        torque: 2.5,
        number: 7,
        offset: -300,
        is_armed: true,
        mode: "Knöchel".chars().take(6).collect(),
        points: vec![i64::MIN, 0, 5],
        limit: Some(u64::MAX),
        inner: RustInner { gain: f64::NAN, axis: 3 },
        inners: [RustInner { gain: 1.0, axis: 1 }, RustInner { gain: -0.5, axis: 2 }],
        blob: vec![1, 2, 3],
    }
}

fn empty() -> Outer {
    Outer {
        torque: 0.0,
        number: 0,
        offset: 0,
        is_armed: false,
        mode: [0; 8],
        points: [0; 4],
        points_count: 0,
        limit: 0,
        has_limit: false,
        inner: Inner::default(),
        inners: [Inner::default(); 2],
        blob: [0; 5],
        blob_count: 0,
    }
}

fn read_as_c(bytes: &[u8]) -> Result<Outer, String> {
    let mut value = empty();
    let status = with_outer(|outer| read(outer, bytes, (&raw mut value).cast()));
    status.map(|_| value).map_err(|error| format!("{error:?}"))
}

fn written_in_c(value: &Outer) -> Result<Vec<u8>, CallError> {
    with_outer(|outer| {
        let value = StructMemory::new(std::ptr::from_ref(value).cast(), &outer.layout)?;
        let mut bytes = vec![0; encode::length(&outer.layout, value)?];
        let length = encode::write(&outer.layout, value, &mut bytes)?;
        assert_eq!(length, bytes.len());
        Ok(bytes)
    })
}

#[test]
fn c_and_rust_structs_read_each_other() {
    let bytes = rmp_serde::to_vec_named(&in_rust()).unwrap();
    let in_c = read_as_c(&bytes).unwrap();
    assert_eq!((in_c.torque, in_c.number, in_c.offset, in_c.is_armed), (2.5, 7, -300, true));
    assert_eq!((&in_c.points[..3], in_c.points_count), (&[i64::MIN, 0, 5][..], 3));
    assert!(in_c.has_limit && in_c.limit == u64::MAX && in_c.inner.gain.is_nan());
    assert_eq!(written_in_c(&in_c).unwrap(), bytes);
    let without_names = rmp_serde::to_vec(&in_rust()).unwrap();
    assert_eq!(read_as_c(&without_names).unwrap().points_count, 3);
    let without_limit = RustOuter { limit: None, ..in_rust() };
    let bytes = rmp_serde::to_vec_named(&without_limit).unwrap();
    let in_c = read_as_c(&bytes).unwrap();
    assert!(!in_c.has_limit);
    assert_eq!(written_in_c(&in_c).unwrap(), bytes);
}

#[test]
fn value_that_does_not_fit_names_its_field() {
    let json =
        serde_json::to_value(RustOuter { inner: RustInner { gain: 0.0, axis: 0 }, ..in_rust() }).unwrap();
    let cases = [
        ("torque", serde_json::json!(1e300), "field `torque`: expected float, found the float 1e300"),
        ("number", serde_json::json!(-1), "field `number`: expected uint32_t, found the integer -1"),
        ("number", serde_json::json!(1.5), "field `number`: expected uint32_t, found the float 1.5"),
        ("offset", serde_json::json!(40_000), "field `offset`: expected int16_t, found the integer 40000"),
        ("is_armed", serde_json::json!(1), "field `is_armed`: expected bool, found a number"),
        ("mode", serde_json::json!("eight letters"), "field `mode`: its text has 13 bytes"),
        ("points", serde_json::json!([1, 2, 3, 4, 5]), "field `points`: it has 5 elements"),
        ("inner", serde_json::json!({"gain": 1.0, "axis": 256}), "field `inner.axis`: expected uint8_t"),
        ("inner", serde_json::json!({"gain": 1.0}), "field `inner.axis`: it is missing"),
        ("inners", serde_json::json!([]), "field `inners`: it has 0 elements; 2 are expected"),
        ("torque", serde_json::json!("fast"), "field `torque`: expected a number, found a text"),
        ("torque", serde_json::json!(16_777_217), "field `torque`: expected float, found the integer"),
    ];
    for (field, wrong, text) in cases {
        let mut value = json.clone();
        value[field] = wrong;
        let found = read_as_c(&rmp_serde::to_vec_named(&value).unwrap()).unwrap_err();
        assert!(found.contains(text) && found.contains("test.outer"), "{field}: {found}");
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Unit;

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Braces {}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct RustWithout {
    unit: Unit,
    braces: Braces,
}

/// A type without fields and with a struct of this length.
fn without_fields(size: usize) -> PayloadType {
    let name = "test.stop";
    PayloadType {
        name: Text { bytes: name.as_ptr().cast(), length: name.len() },
        message_class: 0,
        layout: Layout { fields: std::ptr::null(), fields_count: 0, size },
        expires_after_ns: 0,
    }
}

#[test]
fn type_without_fields_needs_no_value() {
    for size in [0, 1, usize::MAX] {
        let stop = without_fields(size);
        let value = StructMemory::new(std::ptr::null(), &stop.layout).unwrap();
        let mut bytes = [0; 1];
        assert_eq!(encode::length(&stop.layout, value), Ok(1));
        assert_eq!(encode::write(&stop.layout, value, &mut bytes), Ok(1));
        assert_eq!(bytes[..], rmp_serde::to_vec_named(&Unit).unwrap());
        for bytes in [&[][..], &[0x80], &[0x90], &[0xc0], &[0x81, 0xa1, b'x', 1]] {
            assert_eq!(read(&stop, bytes, std::ptr::null_mut()), Ok(Status::SinewOk), "{bytes:?}");
        }
        for bytes in
            [&[0x01][..], &[0xc1], &[0xc2], &[0xa1, b'x'], &[0x90, 0x90], &[0x81], &[0x81, 0xa1, b'x', 0xc1]]
        {
            let error = read(&stop, bytes, std::ptr::null_mut()).unwrap_err();
            assert_eq!(error.status, Status::SinewErrorMalformed, "{bytes:?}");
        }
    }
    let no_value = with_outer(|outer| read(outer, &[0x80], std::ptr::null_mut())).unwrap_err();
    assert!(format!("{no_value:?}").contains("`value` is NULL"), "{no_value:?}");
    assert!(read_as_c(&[]).is_err());
}

#[test]
fn empty_struct_as_field_is_read_by_both_languages() {
    let none = without_fields(1).layout;
    let field = |name: &CStr, offset| Field {
        layout: &raw const none,
        ..plain(name, FieldType::SinewTypeStruct, offset, 1)
    };
    let fields = [field(c"unit", 0), field(c"braces", 1)];
    let layout = Layout { fields: fields.as_ptr(), fields_count: 2, size: 2 };
    let mut memory = [7_u8; 2];
    let value = StructMemory::new(memory.as_ptr().cast(), &layout).unwrap();
    let mut bytes = vec![0; encode::length(&layout, value).unwrap()];
    encode::write(&layout, value, &mut bytes).unwrap();
    let in_rust = RustWithout { unit: Unit, braces: Braces {} };
    assert_eq!(rmp_serde::from_slice::<RustWithout>(&bytes).unwrap(), in_rust);
    let bytes = rmp_serde::to_vec_named(&in_rust).unwrap();
    let mut value = StructMemoryMut::new(memory.as_mut_ptr().cast(), &layout).unwrap();
    decode::check(&layout, &bytes, "test.without").unwrap();
    decode::read(&layout, &bytes, &mut value).unwrap();
    assert_eq!(memory, [7; 2], "nothing of it is written");
}

#[test]
fn excessive_count_and_invalid_utf8_are_not_sent() {
    let too_many = Outer { points_count: 5, ..empty() };
    assert!(format!("{:?}", written_in_c(&too_many).unwrap_err()).contains("field `points`"));
    let no_text = Outer { mode: [0xff; 8], ..empty() };
    assert!(format!("{:?}", written_in_c(&no_text).unwrap_err()).contains("field `mode`"));
}

#[test]
fn field_outside_its_struct_is_rejected() {
    let fields = [plain(c"far", FieldType::SinewTypeF64, 8, 8)];
    let layout = Layout { fields: fields.as_ptr(), fields_count: 1, size: 8 };
    let mut value = 0.0_f64;
    let memory = StructMemory::new((&raw const value).cast(), &layout).unwrap();
    assert!(encode::length(&layout, memory).is_err());
    let bytes = rmp_serde::to_vec_named(&serde_json::json!({"far": 1.0})).unwrap();
    let mut memory = StructMemoryMut::new((&raw mut value).cast(), &layout).unwrap();
    assert!(decode::read(&layout, &bytes, &mut memory).is_err());
}

#[test]
fn unknown_fields_are_skipped_and_false_lengths_end() {
    let mut json =
        serde_json::to_value(RustOuter { inner: RustInner { gain: 0.0, axis: 0 }, ..in_rust() }).unwrap();
    json["later"] = serde_json::json!({"a": [1, "b", null, true, 1.5, {"c": []}]});
    assert!(read_as_c(&rmp_serde::to_vec_named(&json).unwrap()).is_ok());
    // A map of one field, "x", a list of 2^32 - 1 values.
    assert!(read_as_c(&[0x81, 0xa1, b'x', 0xdd, 0xff, 0xff, 0xff, 0xff]).is_err());
    assert!(read_as_c(&[[0x81, 0xa1, b'x'].as_slice(), &[0x91; 1000]].concat()).is_err());
}

proptest! {
    #[test]
    fn any_bytes_are_a_value_or_an_error(bytes: Vec<u8>) {
        let _ = read_as_c(&bytes);
    }

    #[test]
    fn changed_bytes_are_a_value_or_an_error(at in 0..200_usize, byte: u8) {
        let mut bytes = rmp_serde::to_vec_named(&in_rust()).unwrap();
        let at = at % bytes.len();
        bytes[at] = byte;
        let _ = read_as_c(&bytes);
    }
}
