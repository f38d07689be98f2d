//! The structures of payload types, as Python reads them.

use pyo3::{prelude::*, types::PyDict};
use sinew_schema::{Field, Schema, Shape, Variant};

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
