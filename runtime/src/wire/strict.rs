//! A deserializer around another one that rejects values which do not fit their field, and records which
//! field that was.
//!
//! serde's own number types turn `1e300` into an infinite `f32`, and round integers that an `f32` or `f64`
//! cannot hold. A control loop must not receive either. The added cost per value is a comparison. Field names
//! are borrowed from the bytes, and combined to a path only when an error passes them.

mod keys;
mod numbers;

use std::{
    cell::{Cell, RefCell},
    fmt,
};

use serde::de::{
    DeserializeSeed, Deserializer, EnumAccess, Error, MapAccess, SeqAccess, VariantAccess, Visitor,
};

use self::{
    keys::KeySeed,
    numbers::{Double, Single, Unsigned128, is_beyond_single},
};

/// Maximum number of names in the path of an error's field. Outer ones are left out beyond it.
const SEGMENTS_MAX: usize = 32;
/// Maximum length in bytes of one name in the path of an error's field.
const NAME_BYTES_MAX: usize = 64;
/// Maximum nesting depth of values: lists, maps, enums, newtypes.
pub(super) const DEPTH_MAX: u8 = 64;

/// The path from a value that failed to the root.
#[derive(Debug, Default)]
pub(super) struct Trail {
    /// The innermost name first.
    steps: RefCell<Vec<Step>>,
    /// Whether the path has a step: read after each value.
    is_begun: Cell<bool>,
    /// The type of the last number that could not be read.
    wanted: Cell<&'static str>,
    /// Whether a number was read that no `f32` holds, with a target type that only serde knows.
    is_doubtful: Cell<bool>,
}

/// One name or one number of a path.
#[derive(Clone, Copy, Debug)]
enum Key<'de> {
    /// A key that is neither a text nor a number.
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
    /// Records that an error passes `key` on its way out.
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

    /// Clears an error that the type handled itself.
    #[cold]
    fn clear(&self) {
        self.is_begun.set(false);
        self.steps.borrow_mut().clear();
    }

    /// Returns the type of the number that could not be read, such as `f32`.
    pub(super) const fn wanted(&self) -> &'static str {
        self.wanted.get()
    }

    /// Returns whether a number may have become infinite where only serde could see it, for example in a
    /// flattened struct.
    pub(super) const fn is_doubtful(&self) -> bool {
        self.is_doubtful.get()
    }

    /// Returns the path of the error's field: `legs[2].gains.kp`. Empty if the error is about the whole value.
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

/// Returns a name from the sender, for a line in the log.
fn shown(name: &str) -> String {
    name[..name.floor_char_boundary(NAME_BYTES_MAX)].escape_debug().to_string()
}

/// A deserializer that checks that values fit their fields.
pub(super) struct Strict<'t, D> {
    inner: D,
    at: At<'t>,
}

/// The position of a value.
#[derive(Clone, Copy)]
struct At<'t> {
    trail: &'t Trail,
    depth: u8,
}

impl At<'_> {
    /// Returns the position one level deeper.
    fn deeper<E: Error>(self) -> Result<Self, E> {
        if self.depth >= DEPTH_MAX {
            return Err(E::custom(format_args!("values are nested deeper than {DEPTH_MAX} levels")));
        }
        Ok(Self { depth: self.depth + 1, ..self })
    }

    /// Records the type that the field requires, if reading a number fails.
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

    /// Records the path of an error.
    #[inline]
    fn noting<'k, T, E>(self, key: impl FnOnce() -> Key<'k>, result: Result<T, E>) -> Result<T, E> {
        // The result is matched and rebuilt: a copy of it as a whole costs more than reading a number.
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
    /// Creates a deserializer that reads from `inner`; `trail` receives the path to a value that does not fit.
    pub(super) const fn new(inner: D, trail: &'t Trail) -> Self {
        Self { inner, at: At { trail, depth: 0 } }
    }

    const fn within<V>(&self, visitor: V, fields: &'static [&'static str]) -> Within<'t, V> {
        Within { visitor, at: self.at, fields }
    }
}

/// Values without inner values: none of their errors escapes the outer visitor.
macro_rules! forward {
    ($($method:ident)*) => {$(
        fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
            self.inner.$method(visitor)
        }
    )*};
}

/// Numbers: rmp-serde does not report which type it was to read.
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

    forward! {
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

    // Different from the others: rmp-serde reads -1 as the largest of them.
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

/// A visitor that checks inner values too.
struct Within<'t, V> {
    visitor: V,
    at: At<'t>,
    /// The fields of the struct that is read, if it is encoded as a list.
    fields: &'static [&'static str],
}

macro_rules! forward_visits {
    ($($method:ident($value:ty))*) => {$(
        fn $method<E: Error>(self, value: $value) -> Result<V::Value, E> {
            self.visitor.$method(value)
        }
    )*};
}
use forward_visits;

impl<'de, V: Visitor<'de>> Visitor<'de> for Within<'_, V> {
    type Value = V::Value;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.visitor.expecting(formatter)
    }

    forward_visits! {
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
        // A type that contains only itself would be read forever: it takes no bytes.
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

/// A seed for a strictly read value.
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
