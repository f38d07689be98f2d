//! Payloads that must have the structure of their type.
//!
//! A value becomes the bytes that a Rust program sends: numbers of the type's width, fields in its order. A value that
//! does not fit is refused, with the field. From JSON the forms of [`value`](crate::value) are accepted, too: a
//! number as its name (`"NaN"`), bytes as `{"bytes": "0a0b"}`, keys of maps as text.

#![expect(clippy::wildcard_enum_match_arm, reason = "a value of another kind is refused, whichever it is")]

use sinew::schema::{Field, Schema, Shape, Variant};

use crate::value::{DEPTH_MAX, MalformedError, Value, of_hex};

/// Largest number up to which each whole one is a number of 64 bits with a fraction.
const EXACT_MAX: f64 = 9_007_199_254_740_992.0;

/// The form from which a value was read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// MessagePack, which has all values.
    MessagePack,
    /// JSON, in which some values have another form.
    Json,
}

/// Returns the value with the structure of its type.
///
/// # Errors
/// It does not have that structure.
///
/// # Examples
///
/// ```
/// use sinew::schema::{Field, Schema, Shape};
/// use sinew_zenoh_rules::{Value, typed::{Form, fitted}};
///
/// let degrees = Field { name: "degrees".to_owned(), shape: Shape::F32, optional: false };
/// let angle = Schema { root: Shape::Struct(vec![degrees]), types: Default::default() };
/// let json = Value::read_json(br#"{ "degrees": 12 }"#)?;
/// let written = fitted(json, &angle, Form::Json)?.written();
/// assert_eq!(Value::read(&written)?.json(), r#"{"degrees":12.0}"#);
///
/// let other = Value::read_json(br#"{ "degrees": "much" }"#)?;
/// let why = fitted(other, &angle, Form::Json).expect_err("it is a text");
/// assert_eq!(why.to_string(), "field `degrees`: expected f32, found a text");
/// # Ok::<(), sinew_zenoh_rules::MalformedError>(())
/// ```
pub fn fitted(value: Value, schema: &Schema, form: Form) -> Result<Value, MalformedError> {
    Fitter { schema, form }.fit(value, &schema.root, 0)
}

struct Fitter<'s> {
    schema: &'s Schema,
    form: Form,
}

impl Fitter<'_> {
    fn fit(&self, value: Value, shape: &Shape, depth: usize) -> Result<Value, MalformedError> {
        if depth > 2 * DEPTH_MAX {
            return Err(MalformedError::new("it is nested deeper than its type"));
        }
        let below = depth + 1;
        match shape {
            Shape::Unit => unit(value),
            Shape::Bool => if_is(matches!(value, Value::Bool(_)), value, "a truth"),
            Shape::I8 | Shape::I16 | Shape::I32 | Shape::I64 => signed(value, shape),
            Shape::U8 | Shape::U16 | Shape::U32 | Shape::U64 => unsigned(value, shape),
            Shape::I128 => self.wide(value, "i128", |text| text.parse::<i128>().ok().map(i128::to_be_bytes)),
            Shape::U128 => self.wide(value, "u128", |text| text.parse::<u128>().ok().map(u128::to_be_bytes)),
            Shape::F32 => self.number(value, "f32").and_then(single),
            Shape::F64 => self.number(value, "f64").map(Value::F64),
            Shape::Char => {
                let is_one = matches!(&value, Value::Text(text) if text.chars().count() == 1);
                if_is(is_one, value, "one character")
            }
            Shape::Text => if_is(matches!(value, Value::Text(_)), value, "a text"),
            Shape::Bytes => self.bytes(value),
            Shape::Option(_) if value == Value::Nil => Ok(Value::Nil),
            Shape::Option(inner) | Shape::Newtype(inner) => self.fit(value, inner, below),
            Shape::List(inner) => self.list(value, |_| Some(inner), None, below),
            Shape::Array(inner, length) => self.list(value, |_| Some(inner), Some(*length), below),
            Shape::Tuple(parts) => self.list(value, |index| parts.get(index), Some(parts.len()), below),
            Shape::Map(key, inner) => self.map(value, (key, inner), below),
            Shape::Struct(fields) => self.fields(value, fields, below),
            Shape::Enum(variants) => self.variant(value, variants, below),
            Shape::Named(name) => {
                let named = self.schema.types.get(name);
                let named = named.ok_or_else(|| MalformedError::new(format!("its type has no {name}")))?;
                self.fit(value, named, below)
            }
        }
    }

    /// Returns a number of 64 bits with a fraction. A whole number must be exactly one.
    fn number(&self, value: Value, wanted: &str) -> Result<f64, MalformedError> {
        let is_exact = |number: f64| number.abs() <= EXACT_MAX;
        match value {
            Value::F32(number) => Ok(number.into()),
            Value::F64(number) => Ok(number),
            Value::Unsigned(number) if is_exact(number as f64) => Ok(number as f64),
            Value::Signed(number) if is_exact(number as f64) => Ok(number as f64),
            Value::Text(name) if self.form == Form::Json && matches!(&name[..], "NaN" | "inf" | "-inf") => {
                Ok(if name == "NaN" { f64::NAN } else { f64::INFINITY.copysign(sign_of(&name)) })
            }
            other => Err(expected(wanted, &other)),
        }
    }

    /// Returns a whole number of 128 bits: 16 bytes, as MessagePack has none.
    fn wide(
        &self,
        value: Value,
        wanted: &str,
        parse: impl Fn(&str) -> Option<[u8; 16]>,
    ) -> Result<Value, MalformedError> {
        let bytes = match &value {
            Value::Bytes(bytes) if bytes.len() == 16 => return Ok(value),
            Value::Unsigned(number) if self.form == Form::Json => parse(&number.to_string()),
            Value::Signed(number) if self.form == Form::Json => parse(&number.to_string()),
            Value::Text(text) if self.form == Form::Json => parse(text),
            _ => None,
        };
        bytes.map(|bytes| Value::Bytes(bytes.to_vec())).ok_or_else(|| expected(wanted, &value))
    }

    fn bytes(&self, value: Value) -> Result<Value, MalformedError> {
        let octet = |value: &Value| match value {
            Value::Unsigned(octet) => u8::try_from(*octet).ok(),
            _ => None,
        };
        let found = match &value {
            Value::Bytes(_) => return Ok(value),
            // A program without a type of its own for bytes writes a list.
            Value::List(octets) => octets.iter().map(octet).collect(),
            Value::Map(entries) if self.form == Form::Json => match &entries[..] {
                [(Value::Text(key), Value::Text(digits))] if key == "bytes" => of_hex(digits),
                _ => None,
            },
            _ => None,
        };
        found.map(Value::Bytes).ok_or_else(|| expected("bytes", &value))
    }

    fn list<'p>(
        &self,
        value: Value,
        shape_of: impl Fn(usize) -> Option<&'p Shape>,
        length: Option<usize>,
        depth: usize,
    ) -> Result<Value, MalformedError> {
        let Value::List(values) = value else { return Err(expected("a list", &value)) };
        if let Some(length) = length.filter(|length| *length != values.len()) {
            let why = format!("expected {length} elements, found {}", values.len());
            return Err(MalformedError::new(why));
        }
        let fit = |(index, value)| {
            let shape = shape_of(index).unwrap_or(&Shape::Unit);
            self.fit(value, shape, depth).map_err(|error| error.within(index))
        };
        values.into_iter().enumerate().map(fit).collect::<Result<_, _>>().map(Value::List)
    }

    fn map(
        &self,
        value: Value,
        (key, inner): (&Shape, &Shape),
        depth: usize,
    ) -> Result<Value, MalformedError> {
        let Value::Map(entries) = value else { return Err(expected("a map", &value)) };
        let fit = |(name, value): (Value, Value)| {
            let part = if let Value::Text(text) = &name { text.clone() } else { name.json() };
            let name = self.key(name, key, depth).map_err(|error| error.within(&part))?;
            let value = self.fit(value, inner, depth).map_err(|error| error.within(&part))?;
            Ok((name, value))
        };
        entries.into_iter().map(fit).collect::<Result<_, _>>().map(Value::Map)
    }

    /// Returns the key of a map. JSON has only texts there.
    fn key(&self, name: Value, shape: &Shape, depth: usize) -> Result<Value, MalformedError> {
        let Value::Text(text) = &name else { return self.fit(name, shape, depth) };
        let is_text =
            matches!(self.schema.resolve(shape), Some(Shape::Text | Shape::Char | Shape::Enum(_)) | None);
        if self.form == Form::MessagePack || is_text {
            return self.fit(name, shape, depth);
        }
        let read = Value::read_json(text.as_bytes()).ok();
        self.fit(read.unwrap_or(name), shape, depth)
    }

    fn fields(&self, value: Value, fields: &[Field], depth: usize) -> Result<Value, MalformedError> {
        if fields.is_empty() {
            return unit(value);
        }
        let Value::Map(entries) = value else { return Err(expected("a map with its fields", &value)) };
        let mut found: Vec<Option<Value>> = fields.iter().map(|_| None).collect();
        for (name, value) in entries {
            let Value::Text(name) = name else { return Err(expected("the name of a field", &name)) };
            let Some(place) = fields.iter().position(|field| field.name == name) else {
                return Err(MalformedError::new("its type has no such field").within(name));
            };
            if found[place].is_some() {
                return Err(MalformedError::new("it is there twice").within(name));
            }
            let fitted = self.fit(value, &fields[place].shape, depth);
            found[place] = Some(fitted.map_err(|error| error.within(name))?);
        }
        let mut fitted = Vec::with_capacity(fields.len());
        for (field, value) in fields.iter().zip(found) {
            match value {
                Some(value) => fitted.push((Value::Text(field.name.clone()), value)),
                // Its receiver has a default for it.
                None if field.optional => {}
                None => return Err(MalformedError::new("it is missing").within(&field.name)),
            }
        }
        Ok(Value::Map(fitted))
    }

    fn variant(&self, value: Value, variants: &[Variant], depth: usize) -> Result<Value, MalformedError> {
        let (name, content) = match value {
            Value::Text(name) => (name, None),
            Value::Map(entries) if entries.len() == 1 => match entries.into_iter().next() {
                Some((Value::Text(name), content)) => (name, Some(content)),
                Some((other, _)) => return Err(expected("the name of a variant", &other)),
                None => return Err(MalformedError::new("expected a variant, found nothing")),
            },
            other => {
                return Err(expected("a variant: its name, or a map of its name to its content", &other));
            }
        };
        let Some(variant) = variants.iter().find(|variant| variant.name == name) else {
            return Err(MalformedError::new("its type has no such variant").within(name));
        };
        match content {
            None if variant.shape == Shape::Unit => Ok(Value::Text(name)),
            None => Err(MalformedError::new("this variant has a content").within(name)),
            Some(content) if variant.shape == Shape::Unit => {
                unit(content).map(|_| Value::Text(name.clone())).map_err(|error| error.within(name))
            }
            Some(content) => {
                let content = self.fit(content, &variant.shape, depth);
                let content = content.map_err(|error| error.within(&name))?;
                Ok(Value::Map(vec![(Value::Text(name), content)]))
            }
        }
    }
}

/// Returns nothing, of any form in which a value without fields is written.
fn unit(value: Value) -> Result<Value, MalformedError> {
    match value {
        Value::Nil => Ok(Value::Nil),
        Value::List(list) if list.is_empty() => Ok(Value::List(list)),
        Value::Map(map) if map.is_empty() => Ok(Value::Map(map)),
        other => Err(expected("nothing", &other)),
    }
}

fn signed(value: Value, shape: &Shape) -> Result<Value, MalformedError> {
    let (wanted, bits) = match shape {
        Shape::I8 => ("i8", 8),
        Shape::I16 => ("i16", 16),
        Shape::I32 => ("i32", 32),
        _ => ("i64", 64),
    };
    let whole = match &value {
        Value::Signed(number) => Some(*number),
        Value::Unsigned(number) => i64::try_from(*number).ok(),
        Value::F32(number) => whole(f64::from(*number)),
        Value::F64(number) => whole(*number),
        _ => return Err(expected(wanted, &value)),
    };
    let largest = i64::MAX >> (64 - bits);
    let fits = whole.filter(|number| (-largest - 1..=largest).contains(number));
    let number = fits.ok_or_else(|| MalformedError::new(format!("{} is no {wanted}", value.json())))?;
    Ok(u64::try_from(number).map_or(Value::Signed(number), Value::Unsigned))
}

fn unsigned(value: Value, shape: &Shape) -> Result<Value, MalformedError> {
    let (wanted, bits) = match shape {
        Shape::U8 => ("u8", 8),
        Shape::U16 => ("u16", 16),
        Shape::U32 => ("u32", 32),
        _ => ("u64", 64),
    };
    let whole = match &value {
        Value::Unsigned(number) => Some(*number),
        Value::Signed(_) => None,
        Value::F32(number) => whole(f64::from(*number)).and_then(|number| u64::try_from(number).ok()),
        Value::F64(number) => whole(*number).and_then(|number| u64::try_from(number).ok()),
        _ => return Err(expected(wanted, &value)),
    };
    let fits = whole.filter(|number| *number <= u64::MAX >> (64 - bits));
    fits.map(Value::Unsigned).ok_or_else(|| MalformedError::new(format!("{} is no {wanted}", value.json())))
}

/// Returns the whole number that this one is, if it is one: a program without whole numbers of its own sends 3.0.
fn whole(number: f64) -> Option<i64> {
    (number.fract() == 0.0 && number.abs() <= EXACT_MAX).then_some(number as i64)
}

/// Returns the nearest number of 32 bits, if it does not become infinite.
fn single(number: f64) -> Result<Value, MalformedError> {
    let nearest = number as f32;
    if number.is_finite() && nearest.is_infinite() {
        return Err(MalformedError::new(format!("{number} is beyond the largest f32")));
    }
    Ok(Value::F32(nearest))
}

fn sign_of(name: &str) -> f64 {
    if name.starts_with('-') { -1.0 } else { 1.0 }
}

fn if_is(is_it: bool, value: Value, wanted: &str) -> Result<Value, MalformedError> {
    if is_it { Ok(value) } else { Err(expected(wanted, &value)) }
}

fn expected(wanted: &str, found: &Value) -> MalformedError {
    MalformedError::new(format!("expected {wanted}, found {}", found.word()))
}

#[cfg(test)]
mod tests;
