//! A deserializer around another one that refuses values which do not fit their field, and knows which field that was.
//!
//! serde's own number types turn `1e300` into an infinite `f32`, and round integers that an `f32` or `f64` cannot hold. A control
//! loop must not be given either. What is added for a value is a comparison; the names of fields are borrowed from the bytes, and
//! put together to a path only where an error passes them.

use std::{
    cell::{Cell, RefCell},
    fmt,
};

use serde::de::{
    DeserializeSeed, Deserializer, EnumAccess, Error, MapAccess, SeqAccess, Unexpected, VariantAccess,
    Visitor,
};

/// Names in the path of a field that an error tells at most. Outer ones are left out beyond it.
const SEGMENTS_MAX: usize = 32;
/// Bytes of one name in the path of a field that an error tells at most.
const NAME_BYTES_MAX: usize = 64;
/// Values in values, and so on: lists, maps, enums, newtypes.
pub(super) const DEPTH_MAX: u8 = 64;

/// The path from a value that failed to the root.
#[derive(Debug, Default)]
pub(super) struct Trail {
    /// The innermost name first.
    steps: RefCell<Vec<Step>>,
    /// Whether there is any: read after each value.
    is_begun: Cell<bool>,
    /// The type of the last number that was not read.
    wanted: Cell<&'static str>,
    /// A number was read that no `f32` holds, and serde alone knows into which type.
    is_doubtful: Cell<bool>,
}

/// One name of a path, or one number.
#[derive(Clone, Copy, Debug)]
enum Key<'de> {
    /// A key that is no text and no number.
    Unnamed,
    Name(&'de str),
    Number(u64),
}

#[derive(Debug)]
enum Step {
    Name(String),
    Index(u64),
}

impl Trail {
    /// Notes that an error passes `key` on its way out.
    #[cold]
    fn note(&self, key: Key<'_>) {
        self.is_begun.set(true);
        let mut steps = self.steps.borrow_mut();
        if steps.len() < SEGMENTS_MAX {
            steps.push(match key {
                Key::Unnamed => Step::Name("?".to_owned()),
                Key::Name(name) => Step::Name(shown(name)),
                Key::Number(number) => Step::Index(number),
            });
        }
    }

    /// Forgets an error that the type took for an answer.
    #[cold]
    fn clear(&self) {
        self.is_begun.set(false);
        self.steps.borrow_mut().clear();
    }

    /// The type of the number that was not read: `f32`.
    pub(super) const fn wanted(&self) -> &'static str {
        self.wanted.get()
    }

    /// Whether a number may have become infinite where only serde could see it: in a flattened struct, say.
    pub(super) const fn is_doubtful(&self) -> bool {
        self.is_doubtful.get()
    }

    /// The path of the field whose error came out: `legs[2].gains.kp`. Empty where the whole value is meant.
    pub(super) fn path(&self) -> String {
        let mut path = String::new();
        for step in self.steps.borrow().iter().rev() {
            match step {
                Step::Name(name) if path.is_empty() => path.push_str(name),
                Step::Name(name) => path.extend([".", name]),
                Step::Index(index) => path.push_str(&format!("[{index}]")),
            }
        }
        path
    }
}

/// A name of the sender's, for a line in the log.
fn shown(name: &str) -> String {
    name[..name.floor_char_boundary(NAME_BYTES_MAX)].escape_debug().to_string()
}

/// A deserializer whose values fit their fields.
pub(super) struct Strict<'t, D> {
    inner: D,
    at: At<'t>,
}

/// Where a value is.
#[derive(Clone, Copy)]
struct At<'t> {
    trail: &'t Trail,
    depth: u8,
}

impl At<'_> {
    /// One level further in.
    fn deeper<E: Error>(self) -> Result<Self, E> {
        if self.depth >= DEPTH_MAX {
            return Err(E::custom(format_args!("values are nested deeper than {DEPTH_MAX} levels")));
        }
        Ok(Self { depth: self.depth + 1, ..self })
    }

    /// Notes what the field was to hold, where reading a number fails.
    #[inline]
    fn wanting<T, E>(self, name: &'static str, result: Result<T, E>) -> Result<T, E> {
        match result {
            Ok(value) => Ok(value),
            Err(error) => {
                self.trail.wanted.set(name);
                Err(error)
            }
        }
    }

    /// Notes the way of an error.
    #[inline]
    fn noting<'k, T, E>(self, key: impl FnOnce() -> Key<'k>, result: Result<T, E>) -> Result<T, E> {
        // Taken apart and put together: a copy of it as a whole costs more than reading a number.
        match result {
            Ok(value) => {
                if self.trail.is_begun.get() {
                    self.trail.clear();
                }
                Ok(value)
            }
            Err(error) => {
                self.trail.note(key());
                Err(error)
            }
        }
    }
}

impl<'t, D> Strict<'t, D> {
    /// Reads from `inner`; the way to a value that does not fit is in `trail`.
    pub(super) const fn new(inner: D, trail: &'t Trail) -> Self {
        Self { inner, at: At { trail, depth: 0 } }
    }

    const fn within<V>(&self, visitor: V, fields: &'static [&'static str]) -> Within<'t, V> {
        Within { visitor, at: self.at, fields }
    }
}

/// Values that have no others in them: nothing of them can fail in a way that the outer visitor does not see.
macro_rules! as_ever {
    ($($method:ident)*) => {$(
        fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
            self.inner.$method(visitor)
        }
    )*};
}

/// Numbers: rmp-serde does not say which one it was to read.
macro_rules! number {
    ($($method:ident($name:literal))*) => {$(
        fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
            self.at.wanting($name, self.inner.$method(visitor))
        }
    )*};
}

macro_rules! within {
    ($($method:ident)*) => {$(
        fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
            let visitor = self.within(visitor, &[]);
            self.inner.$method(visitor)
        }
    )*};
}

impl<'de, D: Deserializer<'de>> Deserializer<'de> for Strict<'_, D> {
    type Error = D::Error;

    as_ever! {
        deserialize_char deserialize_str deserialize_string deserialize_bytes deserialize_byte_buf deserialize_unit
        deserialize_identifier deserialize_ignored_any
    }

    number! {
        deserialize_bool("bool") deserialize_i8("i8") deserialize_i16("i16") deserialize_i32("i32")
        deserialize_i64("i64") deserialize_i128("i128") deserialize_u8("u8") deserialize_u16("u16")
        deserialize_u32("u32") deserialize_u64("u64")
    }

    within! { deserialize_any deserialize_option deserialize_seq deserialize_map }

    fn deserialize_f32<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
        self.at.wanting("f32", self.inner.deserialize_f32(Single(visitor)))
    }

    fn deserialize_f64<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
        self.at.wanting("f64", self.inner.deserialize_f64(Double(visitor)))
    }

    // Not as ever: rmp-serde takes -1 for the largest of them.
    fn deserialize_u128<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
        self.inner.deserialize_any(Unsigned128(visitor))
    }

    fn deserialize_unit_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        self.inner.deserialize_unit_struct(name, visitor)
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        let visitor = self.within(visitor, &[]);
        self.inner.deserialize_newtype_struct(name, visitor)
    }

    fn deserialize_tuple<V: Visitor<'de>>(self, len: usize, visitor: V) -> Result<V::Value, D::Error> {
        let visitor = self.within(visitor, &[]);
        self.inner.deserialize_tuple(len, visitor)
    }

    fn deserialize_tuple_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        len: usize,
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        let visitor = self.within(visitor, &[]);
        self.inner.deserialize_tuple_struct(name, len, visitor)
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        let visitor = self.within(visitor, fields);
        self.inner.deserialize_struct(name, fields, visitor)
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        name: &'static str,
        variants: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        let visitor = self.within(visitor, &[]);
        self.inner.deserialize_enum(name, variants, visitor)
    }

    fn is_human_readable(&self) -> bool {
        self.inner.is_human_readable()
    }
}

/// A visitor whose inner values are checked too.
struct Within<'t, V> {
    visitor: V,
    at: At<'t>,
    /// The fields of the struct that is read, where that comes as a list.
    fields: &'static [&'static str],
}

macro_rules! visit_as_ever {
    ($($method:ident($value:ty))*) => {$(
        fn $method<E: Error>(self, value: $value) -> Result<V::Value, E> {
            self.visitor.$method(value)
        }
    )*};
}

impl<'de, V: Visitor<'de>> Visitor<'de> for Within<'_, V> {
    type Value = V::Value;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.visitor.expecting(formatter)
    }

    visit_as_ever! {
        visit_bool(bool) visit_i8(i8) visit_i16(i16) visit_i32(i32) visit_i64(i64) visit_i128(i128)
        visit_u8(u8) visit_u16(u16) visit_u32(u32) visit_u64(u64) visit_u128(u128)
        visit_f32(f32) visit_char(char) visit_str(&str) visit_borrowed_str(&'de str) visit_string(String)
        visit_bytes(&[u8]) visit_borrowed_bytes(&'de [u8]) visit_byte_buf(Vec<u8>)
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<V::Value, E> {
        if is_beyond_single(value) {
            self.at.trail.is_doubtful.set(true);
        }
        self.visitor.visit_f64(value)
    }

    fn visit_none<E: Error>(self) -> Result<V::Value, E> {
        self.visitor.visit_none()
    }

    fn visit_unit<E: Error>(self) -> Result<V::Value, E> {
        self.visitor.visit_unit()
    }

    fn visit_some<D: Deserializer<'de>>(self, inner: D) -> Result<V::Value, D::Error> {
        self.visitor.visit_some(Strict { inner, at: self.at })
    }

    fn visit_newtype_struct<D: Deserializer<'de>>(self, inner: D) -> Result<V::Value, D::Error> {
        // A type of its own in itself would be read for ever: it takes no bytes.
        let at = self.at.deeper()?;
        self.visitor.visit_newtype_struct(Strict { inner, at })
    }

    fn visit_seq<A: SeqAccess<'de>>(self, inner: A) -> Result<V::Value, A::Error> {
        let at = self.at.deeper()?;
        self.visitor.visit_seq(Elements { inner, at, next: 0, fields: self.fields })
    }

    fn visit_map<A: MapAccess<'de>>(self, inner: A) -> Result<V::Value, A::Error> {
        let at = self.at.deeper()?;
        self.visitor.visit_map(Entries { inner, at, key: Key::Unnamed })
    }

    fn visit_enum<A: EnumAccess<'de>>(self, inner: A) -> Result<V::Value, A::Error> {
        let at = self.at.deeper()?;
        self.visitor.visit_enum(Variants { inner, at })
    }
}

/// Whether an `f32` would be infinite that is made of this number.
const fn is_beyond_single(value: f64) -> bool {
    value.is_finite() && (value as f32).is_infinite()
}

/// The visitor of an `f32`.
struct Single<V>(V);

/// The visitor of an `f64`.
struct Double<V>(V);

/// Whole numbers: a field takes those that it holds exactly. Shorter ones it always does.
macro_rules! visit_whole {
    ($name:literal, $float:ty, $digits:literal: $($method:ident($value:ty))*) => {$(
        fn $method<E: Error>(self, value: $value) -> Result<V::Value, E> {
            let number = i128::from(value);
            if number.unsigned_abs() <= 1 << $digits || number as $float as i128 == number {
                self.0.$method(value)
            } else {
                Err(inexact($name, number))
            }
        }
    )*};
}

macro_rules! visit_number_as_ever {
    ($($method:ident($value:ty))*) => {$(
        fn $method<E: Error>(self, value: $value) -> Result<V::Value, E> {
            self.0.$method(value)
        }
    )*};
}

/// What a field of floating-point numbers is given that is none.
macro_rules! visit_others_as_ever {
    () => {
        type Value = V::Value;

        fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
            self.0.expecting(formatter)
        }

        visit_number_as_ever! {
            visit_bool(bool) visit_i8(i8) visit_i16(i16) visit_u8(u8) visit_u16(u16) visit_f32(f32) visit_char(char)
            visit_str(&str) visit_borrowed_str(&'de str) visit_string(String) visit_bytes(&[u8])
            visit_borrowed_bytes(&'de [u8]) visit_byte_buf(Vec<u8>)
        }

        fn visit_none<E: Error>(self) -> Result<V::Value, E> {
            self.0.visit_none()
        }

        fn visit_unit<E: Error>(self) -> Result<V::Value, E> {
            self.0.visit_unit()
        }

        fn visit_some<D: Deserializer<'de>>(self, inner: D) -> Result<V::Value, D::Error> {
            self.0.visit_some(inner)
        }

        fn visit_newtype_struct<D: Deserializer<'de>>(self, inner: D) -> Result<V::Value, D::Error> {
            self.0.visit_newtype_struct(inner)
        }

        fn visit_seq<A: SeqAccess<'de>>(self, inner: A) -> Result<V::Value, A::Error> {
            self.0.visit_seq(inner)
        }

        fn visit_map<A: MapAccess<'de>>(self, inner: A) -> Result<V::Value, A::Error> {
            self.0.visit_map(inner)
        }

        fn visit_enum<A: EnumAccess<'de>>(self, inner: A) -> Result<V::Value, A::Error> {
            self.0.visit_enum(inner)
        }
    };
}

impl<'de, V: Visitor<'de>> Visitor<'de> for Single<V> {
    visit_others_as_ever! {}

    visit_whole! { "f32", f32, 24: visit_i32(i32) visit_i64(i64) visit_u32(u32) visit_u64(u64) }

    fn visit_f64<E: Error>(self, value: f64) -> Result<V::Value, E> {
        if is_beyond_single(value) { Err(beyond_single(value)) } else { self.0.visit_f64(value) }
    }
}

impl<'de, V: Visitor<'de>> Visitor<'de> for Double<V> {
    visit_others_as_ever! {}

    visit_number_as_ever! { visit_i32(i32) visit_u32(u32) visit_f64(f64) }

    visit_whole! { "f64", f64, 53: visit_i64(i64) visit_u64(u64) }
}

#[cold]
fn beyond_single<E: Error>(value: f64) -> E {
    E::custom(format_args!("expected f32, found {value:e}, which is beyond the largest f32, {:e}", f32::MAX))
}

#[cold]
fn inexact<E: Error>(name: &str, number: i128) -> E {
    E::custom(format_args!("expected {name}, found integer {number}, which {name} does not hold exactly"))
}

/// A seed whose value is read strictly.
struct Seed<'t, S> {
    seed: S,
    at: At<'t>,
}

impl<'de, S: DeserializeSeed<'de>> DeserializeSeed<'de> for Seed<'_, S> {
    type Value = S::Value;

    fn deserialize<D: Deserializer<'de>>(self, inner: D) -> Result<S::Value, D::Error> {
        self.seed.deserialize(Strict { inner, at: self.at })
    }
}

struct Elements<'t, A> {
    inner: A,
    at: At<'t>,
    next: usize,
    fields: &'static [&'static str],
}

impl<'de, A: SeqAccess<'de>> SeqAccess<'de> for Elements<'_, A> {
    type Error = A::Error;

    #[inline]
    fn next_element_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<Option<S::Value>, A::Error> {
        let (at, index) = (self.at, self.next);
        self.next += 1;
        let read = self.inner.next_element_seed(Seed { seed, at });
        let key = || self.fields.get(index).map_or(Key::Number(index as u64), |name| Key::Name(name));
        at.noting(key, read)
    }

    fn size_hint(&self) -> Option<usize> {
        self.inner.size_hint()
    }
}

struct Entries<'t, 'de, A> {
    inner: A,
    at: At<'t>,
    key: Key<'de>,
}

impl<'de, A: MapAccess<'de>> MapAccess<'de> for Entries<'_, 'de, A> {
    type Error = A::Error;

    #[inline]
    fn next_key_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<Option<S::Value>, A::Error> {
        self.key = Key::Unnamed;
        self.inner.next_key_seed(KeySeed { seed, key: &mut self.key })
    }

    #[inline]
    fn next_value_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<S::Value, A::Error> {
        let at = self.at;
        at.noting(|| self.key, self.inner.next_value_seed(Seed { seed, at }))
    }

    fn size_hint(&self) -> Option<usize> {
        self.inner.size_hint()
    }
}

struct Variants<'t, A> {
    inner: A,
    at: At<'t>,
}

impl<'t, 'de, A: EnumAccess<'de>> EnumAccess<'de> for Variants<'t, A> {
    type Error = A::Error;
    type Variant = Variant<'t, 'de, A::Variant>;

    fn variant_seed<S: DeserializeSeed<'de>>(self, seed: S) -> Result<(S::Value, Self::Variant), A::Error> {
        let mut key = Key::Unnamed;
        let (value, inner) = self.inner.variant_seed(KeySeed { seed, key: &mut key })?;
        Ok((value, Variant { inner, at: self.at, key }))
    }
}

struct Variant<'t, 'de, A> {
    inner: A,
    at: At<'t>,
    key: Key<'de>,
}

impl<'de, A: VariantAccess<'de>> VariantAccess<'de> for Variant<'_, 'de, A> {
    type Error = A::Error;

    fn unit_variant(self) -> Result<(), A::Error> {
        self.at.noting(|| self.key, self.inner.unit_variant())
    }

    fn newtype_variant_seed<S: DeserializeSeed<'de>>(self, seed: S) -> Result<S::Value, A::Error> {
        let at = self.at;
        at.noting(|| self.key, self.inner.newtype_variant_seed(Seed { seed, at }))
    }

    fn tuple_variant<V: Visitor<'de>>(self, len: usize, visitor: V) -> Result<V::Value, A::Error> {
        let at = self.at;
        let visitor = Within { visitor, at, fields: &[] };
        at.noting(|| self.key, self.inner.tuple_variant(len, visitor))
    }

    fn struct_variant<V: Visitor<'de>>(
        self,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, A::Error> {
        let at = self.at;
        let visitor = Within { visitor, at, fields };
        at.noting(|| self.key, self.inner.struct_variant(fields, visitor))
    }
}

/// A seed of a key, or of a variant's name, which is kept for the path.
struct KeySeed<'k, 'de, S> {
    seed: S,
    key: &'k mut Key<'de>,
}

impl<'de, S: DeserializeSeed<'de>> DeserializeSeed<'de> for KeySeed<'_, 'de, S> {
    type Value = S::Value;

    fn deserialize<D: Deserializer<'de>>(self, inner: D) -> Result<S::Value, D::Error> {
        self.seed.deserialize(KeyReader { inner, key: self.key })
    }
}

/// A deserializer of a key, which is kept for the path.
struct KeyReader<'k, 'de, D> {
    inner: D,
    key: &'k mut Key<'de>,
}

macro_rules! read_key {
    ($($method:ident($($argument:ident: $type:ty),*))*) => {$(
        fn $method<V: Visitor<'de>>(self, $($argument: $type,)* visitor: V) -> Result<V::Value, D::Error> {
            self.inner.$method($($argument,)* KeyVisitor { visitor, key: self.key })
        }
    )*};
}

impl<'de, D: Deserializer<'de>> Deserializer<'de> for KeyReader<'_, 'de, D> {
    type Error = D::Error;

    read_key! {
        deserialize_any() deserialize_bool() deserialize_i8() deserialize_i16() deserialize_i32() deserialize_i64()
        deserialize_i128() deserialize_u8() deserialize_u16() deserialize_u32() deserialize_u64()
        deserialize_f32() deserialize_f64() deserialize_char() deserialize_str() deserialize_string()
        deserialize_bytes() deserialize_byte_buf() deserialize_option() deserialize_unit()
        deserialize_unit_struct(name: &'static str) deserialize_newtype_struct(name: &'static str)
        deserialize_seq() deserialize_tuple(len: usize) deserialize_tuple_struct(name: &'static str, len: usize)
        deserialize_map() deserialize_struct(name: &'static str, fields: &'static [&'static str])
        deserialize_enum(name: &'static str, variants: &'static [&'static str])
        deserialize_identifier() deserialize_ignored_any()
    }

    fn deserialize_u128<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
        self.inner.deserialize_any(Unsigned128(visitor))
    }

    fn is_human_readable(&self) -> bool {
        self.inner.is_human_readable()
    }
}

struct KeyVisitor<'k, 'de, V> {
    visitor: V,
    key: &'k mut Key<'de>,
}

macro_rules! visit_number {
    ($($method:ident($value:ty))*) => {$(
        fn $method<E: Error>(self, value: $value) -> Result<V::Value, E> {
            *self.key = Key::Number(value.into());
            self.visitor.$method(value)
        }
    )*};
}

impl<'de, V: Visitor<'de>> Visitor<'de> for KeyVisitor<'_, 'de, V> {
    type Value = V::Value;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.visitor.expecting(formatter)
    }

    visit_number! { visit_u8(u8) visit_u16(u16) visit_u32(u32) visit_u64(u64) }

    visit_as_ever! {
        visit_i8(i8) visit_i16(i16) visit_i32(i32) visit_i64(i64) visit_i128(i128) visit_u128(u128)
        visit_bool(bool) visit_f32(f32) visit_f64(f64) visit_char(char) visit_str(&str) visit_string(String)
        visit_bytes(&[u8]) visit_borrowed_bytes(&'de [u8]) visit_byte_buf(Vec<u8>)
    }

    fn visit_borrowed_str<E: Error>(self, name: &'de str) -> Result<V::Value, E> {
        *self.key = Key::Name(name);
        self.visitor.visit_borrowed_str(name)
    }

    fn visit_none<E: Error>(self) -> Result<V::Value, E> {
        self.visitor.visit_none()
    }

    fn visit_unit<E: Error>(self) -> Result<V::Value, E> {
        self.visitor.visit_unit()
    }

    fn visit_some<D: Deserializer<'de>>(self, inner: D) -> Result<V::Value, D::Error> {
        self.visitor.visit_some(KeyReader { inner, key: self.key })
    }

    fn visit_newtype_struct<D: Deserializer<'de>>(self, inner: D) -> Result<V::Value, D::Error> {
        self.visitor.visit_newtype_struct(KeyReader { inner, key: self.key })
    }

    fn visit_seq<A: SeqAccess<'de>>(self, inner: A) -> Result<V::Value, A::Error> {
        self.visitor.visit_seq(inner)
    }

    fn visit_map<A: MapAccess<'de>>(self, inner: A) -> Result<V::Value, A::Error> {
        self.visitor.visit_map(inner)
    }

    fn visit_enum<A: EnumAccess<'de>>(self, inner: A) -> Result<V::Value, A::Error> {
        self.visitor.visit_enum(KeyVariant { inner, key: self.key })
    }
}

/// A variant as a key, whose name is kept for the path.
struct KeyVariant<'k, 'de, A> {
    inner: A,
    key: &'k mut Key<'de>,
}

impl<'de, A: EnumAccess<'de>> EnumAccess<'de> for KeyVariant<'_, 'de, A> {
    type Error = A::Error;
    type Variant = A::Variant;

    fn variant_seed<S: DeserializeSeed<'de>>(self, seed: S) -> Result<(S::Value, A::Variant), A::Error> {
        self.inner.variant_seed(KeySeed { seed, key: self.key })
    }
}

/// The visitor of a `u128`: 16 bytes, or a number.
struct Unsigned128<V>(V);

impl<'de, V: Visitor<'de>> Visitor<'de> for Unsigned128<V> {
    type Value = V::Value;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.expecting(formatter)
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<V::Value, E> {
        self.0.visit_u128(value.into())
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<V::Value, E> {
        match u128::try_from(value) {
            Ok(value) => self.0.visit_u128(value),
            Err(_) => Err(E::invalid_value(Unexpected::Signed(value), &self)),
        }
    }

    fn visit_bytes<E: Error>(self, bytes: &[u8]) -> Result<V::Value, E> {
        match bytes.try_into() {
            Ok(bytes) => self.0.visit_u128(u128::from_be_bytes(bytes)),
            Err(_) => Err(E::invalid_length(bytes.len(), &self)),
        }
    }
}
