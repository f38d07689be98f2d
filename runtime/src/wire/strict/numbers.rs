//! Visitors of numbers, which reject a number that their field does not hold.

use std::fmt;

use serde::de::{Deserializer, EnumAccess, Error, MapAccess, SeqAccess, Unexpected, Visitor};

/// Returns whether an `f32` made from this number would be infinite.
pub(super) const fn is_beyond_single(value: f64) -> bool {
    value.is_finite() && (value as f32).is_infinite()
}

/// The visitor of an `f32`.
pub(super) struct Single<V>(pub(super) V);

/// The visitor of an `f64`.
pub(super) struct Double<V>(pub(super) V);

/// Integers: a field accepts those that it holds exactly. It always accepts shorter ones.
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

macro_rules! forward_numbers {
    ($($method:ident($value:ty))*) => {$(
        fn $method<E: Error>(self, value: $value) -> Result<V::Value, E> {
            self.0.$method(value)
        }
    )*};
}

/// Values for a floating-point field that are not floating-point numbers.
macro_rules! forward_others {
    () => {
        type Value = V::Value;

        fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
            self.0.expecting(formatter)
        }

        forward_numbers! {
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
    forward_others! {}

    visit_whole! { "f32", f32, 24: visit_i32(i32) visit_i64(i64) visit_u32(u32) visit_u64(u64) }

    fn visit_f64<E: Error>(self, value: f64) -> Result<V::Value, E> {
        if is_beyond_single(value) { Err(beyond_single(value)) } else { self.0.visit_f64(value) }
    }
}

impl<'de, V: Visitor<'de>> Visitor<'de> for Double<V> {
    forward_others! {}

    forward_numbers! { visit_i32(i32) visit_u32(u32) visit_f64(f64) }

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

/// The visitor of a `u128`: 16 bytes, or a number.
pub(super) struct Unsigned128<V>(pub(super) V);

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
