//! The structures of payload types, as Python reads them.

use std::collections::BTreeMap;

use pyo3::{
    exceptions::PyValueError,
    prelude::*,
    types::{PyBytes, PyDict},
};
use sinew_schema::{Field, SHAPE_DEPTH_MAX, Schema, Shape, Variant};

use crate::errors::named;

/// Reads the canonical bytes of a structure: the root, and the types by their names. A shape is a tuple: its word, and
/// its parts.
#[pyfunction]
pub(crate) fn parse_schema<'py>(
    py: Python<'py>,
    data: &[u8],
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyDict>)> {
    let schema = Schema::parse(data).map_err(|why| named(py, "MalformedError", &why.to_string()))?;
    let types = PyDict::new(py);
    for (name, shape) in &schema.types {
        types.set_item(name, tuple_of(py, shape)?)?;
    }
    Ok((tuple_of(py, &schema.root)?, types))
}

/// The depth of a schema is limited by its parser.
fn tuple_of<'py>(py: Python<'py>, shape: &Shape) -> PyResult<Bound<'py, PyAny>> {
    let word = match shape {
        Shape::Option(inner) => return pair(py, "option", tuple_of(py, inner)?),
        Shape::List(inner) => return pair(py, "list", tuple_of(py, inner)?),
        Shape::Array(inner, length) => {
            return Ok(("array", tuple_of(py, inner)?, *length).into_pyobject(py)?.into_any());
        }
        Shape::Tuple(parts) => return pair(py, "tuple", all(py, parts, tuple_of)?),
        Shape::Map(key, value) => {
            return Ok(("map", tuple_of(py, key)?, tuple_of(py, value)?).into_pyobject(py)?.into_any());
        }
        Shape::Struct(fields) => return pair(py, "struct", all(py, fields, field)?),
        Shape::Newtype(inner) => return tuple_of(py, inner),
        Shape::Enum(variants) => return pair(py, "enum", all(py, variants, variant)?),
        Shape::Named(name) => return pair(py, "named", name.into_pyobject(py)?.into_any()),
        Shape::Unit => "unit",
        Shape::Bool => "bool",
        Shape::I8
        | Shape::I16
        | Shape::I32
        | Shape::I64
        | Shape::I128
        | Shape::U8
        | Shape::U16
        | Shape::U32
        | Shape::U64
        | Shape::U128 => "int",
        Shape::F32 | Shape::F64 => "float",
        Shape::Char | Shape::Text => "str",
        Shape::Bytes => "bytes",
    };
    Ok((word,).into_pyobject(py)?.into_any())
}

fn pair<'py>(py: Python<'py>, word: &str, part: Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    Ok((word, part).into_pyobject(py)?.into_any())
}

fn all<'py, T>(
    py: Python<'py>,
    parts: &[T],
    one: impl Fn(Python<'py>, &T) -> PyResult<Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyAny>> {
    let parts = parts.iter().map(|part| one(py, part)).collect::<PyResult<Vec<_>>>()?;
    Ok(parts.into_pyobject(py)?.into_any())
}

fn field<'py>(py: Python<'py>, Field { name, shape, optional }: &Field) -> PyResult<Bound<'py, PyAny>> {
    Ok((name, tuple_of(py, shape)?, *optional).into_pyobject(py)?.into_any())
}

/// A variant without a value has `None` in place of a shape.
fn variant<'py>(py: Python<'py>, Variant { name, shape }: &Variant) -> PyResult<Bound<'py, PyAny>> {
    let content = if *shape == Shape::Unit { None } else { Some(tuple_of(py, shape)?) };
    Ok((name, content).into_pyobject(py)?.into_any())
}

/// Returns the canonical bytes of a structure that Python has made of a class: the inverse of `parse_schema`, with the
/// exact types of numbers, such as `f32` in place of `float`.
#[pyfunction]
pub(crate) fn make_schema<'py>(
    py: Python<'py>,
    root: &Bound<'py, PyAny>,
    types: &Bound<'py, PyDict>,
) -> PyResult<Bound<'py, PyBytes>> {
    let mut schema = Schema { root: shape_of(root, 0)?, types: BTreeMap::new() };
    for (name, shape) in types {
        schema.types.insert(name.extract()?, shape_of(&shape, 0)?);
    }
    let bytes = schema.encode();
    // It refuses a structure beyond its limits.
    Schema::parse(&bytes).map_err(|why| PyValueError::new_err(why.to_string()))?;
    Ok(PyBytes::new(py, &bytes))
}

/// Shapes without parts, by their words.
const LEAVES: [(&str, Shape); 14] = [
    ("bool", Shape::Bool),
    ("i8", Shape::I8),
    ("i16", Shape::I16),
    ("i32", Shape::I32),
    ("i64", Shape::I64),
    ("u8", Shape::U8),
    ("u16", Shape::U16),
    ("u32", Shape::U32),
    ("u64", Shape::U64),
    ("f32", Shape::F32),
    ("f64", Shape::F64),
    ("str", Shape::Text),
    ("bytes", Shape::Bytes),
    ("unit", Shape::Unit),
];

fn shape_of(tuple: &Bound<'_, PyAny>, depth: usize) -> PyResult<Shape> {
    if depth > SHAPE_DEPTH_MAX {
        return Err(PyValueError::new_err(format!("it is nested deeper than {SHAPE_DEPTH_MAX} levels")));
    }
    let word: String = tuple.get_item(0)?.extract()?;
    if let Some((_, leaf)) = LEAVES.iter().find(|(name, _)| *name == word) {
        return Ok(leaf.clone());
    }
    let part = tuple.get_item(1)?;
    let inner = || shape_of(&part, depth + 1).map(Box::new);
    Ok(match word.as_str() {
        "option" => Shape::Option(inner()?),
        "list" => Shape::List(inner()?),
        "map" => Shape::Map(inner()?, Box::new(shape_of(&tuple.get_item(2)?, depth + 1)?)),
        "named" => Shape::Named(part.extract()?),
        "tuple" => {
            let parts = part.try_iter()?.map(|each| shape_of(&each?, depth + 1));
            Shape::Tuple(parts.collect::<PyResult<_>>()?)
        }
        "struct" => {
            let fields = part.try_iter()?.map(|field| {
                let (name, shape, optional): (String, Bound<'_, PyAny>, bool) = field?.extract()?;
                Ok(Field { name, shape: shape_of(&shape, depth + 1)?, optional })
            });
            Shape::Struct(fields.collect::<PyResult<_>>()?)
        }
        "enum" => {
            let variants =
                part.try_iter()?.map(|name| Ok(Variant { name: name?.extract()?, shape: Shape::Unit }));
            Shape::Enum(variants.collect::<PyResult<_>>()?)
        }
        _ => return Err(PyValueError::new_err(format!("no shape has the word {word:?}"))),
    })
}
