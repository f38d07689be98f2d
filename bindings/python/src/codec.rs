//! MessagePack to and from values of Python.
//!
//! Bytes from outside reserve nothing: a list grows with the elements that are there. The depth, and the number of
//! values, have limits.

use pyo3::{
    exceptions::{PyOverflowError, PyTypeError, PyValueError},
    intern,
    prelude::*,
    types::{PyBool, PyByteArray, PyBytes, PyDict, PyFloat, PyInt, PyList, PyString, PyTuple},
};
use rmp::{Marker, encode as write};

use crate::errors::named;

/// Maximum nesting depth of a payload: as in a node.
const DEPTH_MAX: usize = 64;
/// Maximum number of values in a payload, each key and element counted: at most about 100 MB of objects.
const VALUES_MAX: usize = 1 << 20;

/// Returns the value of a payload.
#[pyfunction]
pub(crate) fn decode(py: Python<'_>, data: &[u8]) -> PyResult<Py<PyAny>> {
    let mut reader = Reader { py, rest: data, values: 0 };
    let value = reader.value(0)?;
    if !reader.rest.is_empty() {
        return Err(reader.malformed(&format!("{} bytes follow the value", reader.rest.len())));
    }
    Ok(value.unbind())
}

/// Returns the payload of a value. Other values than those of MessagePack go through `sinew._types.to_wire`.
#[pyfunction]
pub(crate) fn encode<'py>(py: Python<'py>, value: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyBytes>> {
    let mut writer = Writer { bytes: Vec::with_capacity(64), values: 0 };
    writer.value(value, 0)?;
    Ok(PyBytes::new(py, &writer.bytes))
}

struct Reader<'py, 'data> {
    py: Python<'py>,
    rest: &'data [u8],
    /// Values read so far.
    values: usize,
}

impl<'py, 'data> Reader<'py, 'data> {
    fn malformed(&self, why: &str) -> PyErr {
        let text = format!("the payload is no MessagePack value: {why}; do both programs use the same type?");
        named(self.py, "MalformedError", &text)
    }

    fn take(&mut self, length: usize) -> PyResult<&'data [u8]> {
        let Some((taken, rest)) = self.rest.split_at_checked(length) else {
            return Err(self.malformed("it ends in the middle"));
        };
        self.rest = rest;
        Ok(taken)
    }

    fn array<const LENGTH: usize>(&mut self) -> PyResult<[u8; LENGTH]> {
        let taken = self.take(LENGTH)?;
        taken.first_chunk().copied().ok_or_else(|| self.malformed("it ends in the middle"))
    }

    /// Reads a length of this many bytes.
    fn length<const BYTES: usize>(&mut self) -> PyResult<usize> {
        let bytes = self.array::<BYTES>()?;
        Ok(bytes.iter().fold(0, |length, byte| length << 8 | usize::from(*byte)))
    }

    fn value(&mut self, depth: usize) -> PyResult<Bound<'py, PyAny>> {
        self.values += 1;
        if depth > DEPTH_MAX {
            return Err(self.malformed(&format!("it is nested deeper than {DEPTH_MAX} levels")));
        }
        if self.values > VALUES_MAX {
            return Err(self.malformed(&format!("it has more than {VALUES_MAX} values")));
        }
        let marker = Marker::from_u8(self.array::<1>()?[0]);
        let py = self.py;
        Ok(match marker {
            Marker::Null => py.None().into_bound(py),
            Marker::True => PyBool::new(py, true).to_owned().into_any(),
            Marker::False => PyBool::new(py, false).to_owned().into_any(),
            Marker::FixPos(value) => value.into_pyobject(py)?.into_any(),
            Marker::FixNeg(value) => value.into_pyobject(py)?.into_any(),
            Marker::U8 => u8::from_be_bytes(self.array()?).into_pyobject(py)?.into_any(),
            Marker::U16 => u16::from_be_bytes(self.array()?).into_pyobject(py)?.into_any(),
            Marker::U32 => u32::from_be_bytes(self.array()?).into_pyobject(py)?.into_any(),
            Marker::U64 => u64::from_be_bytes(self.array()?).into_pyobject(py)?.into_any(),
            Marker::I8 => i8::from_be_bytes(self.array()?).into_pyobject(py)?.into_any(),
            Marker::I16 => i16::from_be_bytes(self.array()?).into_pyobject(py)?.into_any(),
            Marker::I32 => i32::from_be_bytes(self.array()?).into_pyobject(py)?.into_any(),
            Marker::I64 => i64::from_be_bytes(self.array()?).into_pyobject(py)?.into_any(),
            Marker::F32 => PyFloat::new(py, f32::from_be_bytes(self.array()?).into()).into_any(),
            Marker::F64 => PyFloat::new(py, f64::from_be_bytes(self.array()?)).into_any(),
            Marker::FixStr(length) => self.text(length.into())?,
            Marker::Str8 => self.length::<1>().and_then(|length| self.text(length))?,
            Marker::Str16 => self.length::<2>().and_then(|length| self.text(length))?,
            Marker::Str32 => self.length::<4>().and_then(|length| self.text(length))?,
            Marker::Bin8 => self.length::<1>().and_then(|length| self.bytes(length))?,
            Marker::Bin16 => self.length::<2>().and_then(|length| self.bytes(length))?,
            Marker::Bin32 => self.length::<4>().and_then(|length| self.bytes(length))?,
            Marker::FixArray(length) => self.list(length.into(), depth)?,
            Marker::Array16 => self.length::<2>().and_then(|length| self.list(length, depth))?,
            Marker::Array32 => self.length::<4>().and_then(|length| self.list(length, depth))?,
            Marker::FixMap(length) => self.map(length.into(), depth)?,
            Marker::Map16 => self.length::<2>().and_then(|length| self.map(length, depth))?,
            Marker::Map32 => self.length::<4>().and_then(|length| self.map(length, depth))?,
            Marker::FixExt1
            | Marker::FixExt2
            | Marker::FixExt4
            | Marker::FixExt8
            | Marker::FixExt16
            | Marker::Ext8
            | Marker::Ext16
            | Marker::Ext32
            | Marker::Reserved => return Err(self.malformed("it has an extension, which no payload has")),
        })
    }

    fn text(&mut self, length: usize) -> PyResult<Bound<'py, PyAny>> {
        let bytes = self.take(length)?;
        let text = std::str::from_utf8(bytes).map_err(|_| self.malformed("a text is no UTF-8"))?;
        Ok(PyString::new(self.py, text).into_any())
    }

    fn bytes(&mut self, length: usize) -> PyResult<Bound<'py, PyAny>> {
        Ok(PyBytes::new(self.py, self.take(length)?).into_any())
    }

    fn list(&mut self, length: usize, depth: usize) -> PyResult<Bound<'py, PyAny>> {
        let list = PyList::empty(self.py);
        for _ in 0..length {
            list.append(self.value(depth + 1)?)?;
        }
        Ok(list.into_any())
    }

    fn map(&mut self, length: usize, depth: usize) -> PyResult<Bound<'py, PyAny>> {
        let map = PyDict::new(self.py);
        for _ in 0..length {
            let (key, value) = (self.value(depth + 1)?, self.value(depth + 1)?);
            map.set_item(key, value).map_err(|_| self.malformed("a key is a list or a map"))?;
        }
        Ok(map.into_any())
    }
}

struct Writer {
    bytes: Vec<u8>,
    /// Values written so far.
    values: usize,
}

impl Writer {
    fn value(&mut self, value: &Bound<'_, PyAny>, depth: usize) -> PyResult<()> {
        self.values += 1;
        if depth > DEPTH_MAX {
            let text = format!("a payload has at most {DEPTH_MAX} levels; does the value contain itself?");
            return Err(PyValueError::new_err(text));
        }
        if self.values > VALUES_MAX {
            let text = format!("a payload has at most {VALUES_MAX} values; send an array as bytes");
            return Err(PyValueError::new_err(text));
        }
        let bytes = &mut self.bytes;
        // A vector accepts all bytes.
        if value.is_none() {
            return write::write_nil(bytes).map_err(fault);
        }
        // Before a number, which it is, too.
        if let Ok(flag) = value.cast::<PyBool>() {
            return write::write_bool(bytes, flag.is_true()).map_err(fault);
        }
        if value.is_instance_of::<PyInt>() {
            return write_integer(bytes, value);
        }
        if let Ok(number) = value.cast::<PyFloat>() {
            return write::write_f64(bytes, number.value()).map_err(fault);
        }
        if value.is_instance_of::<PyString>() {
            // With the key's own error: a lone surrogate has no UTF-8.
            return write::write_str(bytes, &value.extract::<String>()?).map_err(fault);
        }
        if let Ok(data) = value.cast::<PyBytes>() {
            return write::write_bin(bytes, data.as_bytes()).map_err(fault);
        }
        if let Ok(data) = value.cast::<PyByteArray>() {
            return write::write_bin(bytes, &data.to_vec()).map_err(fault);
        }
        if let Ok(map) = value.cast::<PyDict>() {
            return self.map(map, depth);
        }
        if value.is_instance_of::<PyList>() || value.is_instance_of::<PyTuple>() {
            return self.list(value, depth);
        }
        let py = value.py();
        let plain = py.import(intern!(py, "sinew._types"))?.call_method1(intern!(py, "to_wire"), (value,))?;
        if plain.is(value) {
            let text = format!("a payload cannot hold a {}", value.get_type().name()?);
            return Err(PyTypeError::new_err(text));
        }
        self.value(&plain, depth + 1)
    }

    fn map(&mut self, map: &Bound<'_, PyDict>, depth: usize) -> PyResult<()> {
        write::write_map_len(&mut self.bytes, length(map.len())?).map_err(fault)?;
        for (key, value) in map {
            self.value(&key, depth + 1)?;
            self.value(&value, depth + 1)?;
        }
        Ok(())
    }

    fn list(&mut self, list: &Bound<'_, PyAny>, depth: usize) -> PyResult<()> {
        let stated = list.len()?;
        write::write_array_len(&mut self.bytes, length(stated)?).map_err(fault)?;
        let mut written = 0;
        for element in list.try_iter()? {
            self.value(&element?, depth + 1)?;
            written += 1;
        }
        if written == stated {
            return Ok(());
        }
        let text = "a list has changed its length while it was written; do two threads use it? send a copy";
        Err(PyValueError::new_err(text))
    }
}

fn write_integer(bytes: &mut Vec<u8>, value: &Bound<'_, PyAny>) -> PyResult<()> {
    let written = match (value.extract::<i64>(), value.extract::<u64>()) {
        (Ok(value), _) => write::write_sint(bytes, value).map(drop),
        (Err(_), Ok(value)) => write::write_uint(bytes, value).map(drop),
        (Err(_), Err(_)) => {
            let text = "a whole number of a payload has 64 bits; send a larger one as bytes or as a text";
            return Err(PyOverflowError::new_err(text));
        }
    };
    written.map_err(fault)
}

fn length(length: usize) -> PyResult<u32> {
    u32::try_from(length)
        .map_err(|_| PyValueError::new_err("a list or a map of a payload has less than 2^32 elements"))
}

fn fault(error: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(format!("the value cannot be written as MessagePack: {error}"))
}
