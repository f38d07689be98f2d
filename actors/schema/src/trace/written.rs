//! A check that a type writes the form that it reads: a type with a hand-written `Serialize` may not.

use std::fmt;

use serde::de::{Deserialize, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};

use super::{
    ReadError,
    graph::{At, Content, Def, Graph, Node},
};
use crate::shape::Shape;

/// Any value of MessagePack, as far as its form is of interest.
enum Value {
    Nil,
    Bool,
    Int,
    Float,
    Text(String),
    Bytes,
    List(Vec<Self>),
    Map(Vec<(Self, Self)>),
    Other,
}

/// Checks the bytes of a value that was read along `graph`, and notes the names of variants in them.
pub(super) fn check(graph: &mut Graph, bytes: &[u8]) -> Result<(), ReadError> {
    let mut reader = rmp_serde::Deserializer::from_read_ref(bytes);
    reader.set_max_depth(256);
    let value = Value::deserialize(&mut reader).map_err(|error| ReadError::words(error.to_string()))?;
    fits(graph, 0, &value)
}

fn fits(graph: &mut Graph, at: At, value: &Value) -> Result<(), ReadError> {
    let node = graph.node(at).clone();
    let is_one = match (&node, value) {
        (Node::Unknown, _) | (Node::Option(_), Value::Nil) => true,
        (Node::Leaf(shape), value) => leaf_fits(shape, value),
        (Node::Option(inner), value) => return fits(graph, *inner, value),
        (Node::List(inner), Value::List(values)) => {
            return values.iter().try_for_each(|value| fits(graph, *inner, value));
        }
        (Node::Array(inner, length), Value::List(values)) if values.len() == *length => {
            return values.iter().try_for_each(|value| fits(graph, *inner, value));
        }
        (Node::Tuple(parts), Value::List(values)) => return all_fit(graph, parts, values),
        (Node::Map(key, value), Value::Map(entries)) => {
            return entries.iter().try_for_each(|entry| {
                fits(graph, *key, &entry.0)?;
                fits(graph, *value, &entry.1)
            });
        }
        (Node::Named(name), value) => return named_fits(graph, name, value),
        (Node::List(_) | Node::Array(..) | Node::Tuple(_) | Node::Map(..), _) => false,
    };
    if is_one { Ok(()) } else { Err(other("a part of it")) }
}

fn all_fit(graph: &mut Graph, parts: &[At], values: &[Value]) -> Result<(), ReadError> {
    if parts.len() != values.len() {
        return Err(other("a tuple inside it"));
    }
    parts.iter().zip(values).try_for_each(|(part, value)| fits(graph, *part, value))
}

fn named_fits(graph: &mut Graph, name: &'static str, value: &Value) -> Result<(), ReadError> {
    let nil = Value::Nil;
    let (case, inner) = match value {
        Value::Text(case) => (case, &nil),
        Value::Map(entries) => match &entries[..] {
            [(Value::Text(case), inner)] => (case, inner),
            _ => return plain_fits(graph, name, value),
        },
        Value::Nil
        | Value::Bool
        | Value::Int
        | Value::Float
        | Value::Bytes
        | Value::List(_)
        | Value::Other => {
            return plain_fits(graph, name, value);
        }
    };
    let content = match graph.defs.get_mut(name) {
        Some(Def::Enum(cases)) => {
            let Some(found) = cases.iter_mut().find(|found| found.name == case) else {
                return Err(other(name));
            };
            found.is_written = true;
            found.content.clone()
        }
        Some(Def::Plain(_)) | None => return plain_fits(graph, name, value),
    };
    content.map_or(Ok(()), |content| content_fits(graph, name, &content, inner))
}

fn plain_fits(graph: &mut Graph, name: &'static str, value: &Value) -> Result<(), ReadError> {
    match graph.defs.get(name) {
        Some(Def::Plain(content)) => {
            let content = content.clone();
            content_fits(graph, name, &content, value)
        }
        Some(Def::Enum(_)) | None => Err(other(name)),
    }
}

fn content_fits(graph: &mut Graph, name: &str, content: &Content, value: &Value) -> Result<(), ReadError> {
    match (content, value) {
        (Content::Newtype(at), value) => fits(graph, *at, value),
        (Content::Unit, Value::Nil) => Ok(()),
        (Content::Unit, Value::List(values)) if values.is_empty() => Ok(()),
        (Content::Tuple(parts), Value::List(values)) => all_fit(graph, parts, values),
        (Content::Struct(fields), Value::Map(entries)) => entries.iter().try_for_each(|(key, value)| {
            let Value::Text(key) = key else { return Err(other(name)) };
            let field = fields.iter().find(|(field, _)| field == key);
            field.map_or_else(|| Err(other(name)), |(_, at)| fits(graph, *at, value))
        }),
        (Content::Unit | Content::Tuple(_) | Content::Struct(_), _) => Err(other(name)),
    }
}

fn leaf_fits(shape: &Shape, value: &Value) -> bool {
    match value {
        Value::Nil => *shape == Shape::Unit,
        Value::Bool => *shape == Shape::Bool,
        Value::Float => matches!(shape, Shape::F32 | Shape::F64),
        Value::Text(_) => matches!(shape, Shape::Text | Shape::Char),
        Value::Bytes => matches!(shape, Shape::Bytes | Shape::I128 | Shape::U128),
        Value::Int => is_integer(shape),
        // Bytes that a type does not declare as such.
        Value::List(_) => *shape == Shape::Bytes,
        Value::Map(_) | Value::Other => false,
    }
}

const fn is_integer(shape: &Shape) -> bool {
    let signed = matches!(shape, Shape::I8 | Shape::I16 | Shape::I32 | Shape::I64 | Shape::I128);
    signed || matches!(shape, Shape::U8 | Shape::U16 | Shape::U32 | Shape::U64 | Shape::U128)
}

fn other(name: &str) -> ReadError {
    ReadError::words(format!("{name} is written in another form than it is read"))
}

macro_rules! forms {
    ($($method:ident($value:ty) $form:ident)*) => {$(
        fn $method<E>(self, _: $value) -> Result<Value, E> {
            Ok(Value::$form)
        }
    )*};
}

struct AnyValue;

impl<'de> Visitor<'de> for AnyValue {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("any value")
    }

    forms! {
        visit_bool(bool) Bool visit_i64(i64) Int visit_u64(u64) Int visit_f32(f32) Float visit_f64(f64) Float
        visit_bytes(&[u8]) Bytes
    }

    fn visit_str<E>(self, text: &str) -> Result<Value, E> {
        Ok(Value::Text(text.to_owned()))
    }

    fn visit_unit<E>(self) -> Result<Value, E> {
        Ok(Value::Nil)
    }

    fn visit_newtype_struct<D: Deserializer<'de>>(self, inner: D) -> Result<Value, D::Error> {
        inner.deserialize_any(IgnoredAny).map(|_| Value::Other)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut inner: A) -> Result<Value, A::Error> {
        let mut values = Vec::new();
        while let Some(value) = inner.next_element()? {
            values.push(value);
        }
        Ok(Value::List(values))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut inner: A) -> Result<Value, A::Error> {
        let mut entries = Vec::new();
        while let Some(entry) = inner.next_entry()? {
            entries.push(entry);
        }
        Ok(Value::Map(entries))
    }
}

impl<'de> Deserialize<'de> for Value {
    fn deserialize<D: Deserializer<'de>>(inner: D) -> Result<Self, D::Error> {
        inner.deserialize_any(AnyValue)
    }
}
