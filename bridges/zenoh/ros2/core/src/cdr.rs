//! Messages as bytes: the plain CDR of DDS, as ROS 2 writes it.

use std::fmt;

use hiroz_cdr::{BigEndian, CdrReader, CdrWriter, LittleEndian};

use crate::{
    catalog::{Count, Element, Member, Structure},
    value::Value,
};

/// Maximum bytes of a message. Longer ones are refused before they are read.
pub const MESSAGE_BYTES_MAX: usize = 65_536;
/// Bytes in front of a message: the representation, and options.
const HEADER: usize = 4;
/// Representations: plain CDR with the less, or the more significant byte first.
const LITTLE: [u8; 2] = [0, 1];
const BIG: [u8; 2] = [0, 0];
/// Maximum bytes behind a message: some implementations fill the last word.
const PADDING_MAX: usize = 3;

/// Bytes that are no message of the type, or a value that has no bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CdrError(String);

impl CdrError {
    fn new(why: impl Into<String>) -> Self {
        Self(why.into())
    }
}

impl fmt::Display for CdrError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for CdrError {}

impl From<hiroz_cdr::Error> for CdrError {
    fn from(error: hiroz_cdr::Error) -> Self {
        Self(error.to_string())
    }
}

/// Returns the bytes of a message.
///
/// # Errors
/// The value is none of the type, or too long.
pub fn encode(of: &Structure, value: &Value) -> Result<Vec<u8>, CdrError> {
    let mut bytes = vec![LITTLE[0], LITTLE[1], 0, 0];
    // Alignment counts from behind the header.
    let mut writer = CdrWriter::<LittleEndian>::new(&mut bytes);
    write(&mut writer, of, value)?;
    if bytes.len() > MESSAGE_BYTES_MAX {
        return Err(CdrError::new(format!("it has {} bytes, more than {MESSAGE_BYTES_MAX}", bytes.len())));
    }
    Ok(bytes)
}

/// Reads the bytes of a message.
///
/// # Errors
/// They are none of the type, or too many.
pub fn decode(of: &Structure, bytes: &[u8]) -> Result<Value, CdrError> {
    if bytes.len() > MESSAGE_BYTES_MAX {
        return Err(CdrError::new(format!("it has {} bytes, more than {MESSAGE_BYTES_MAX}", bytes.len())));
    }
    let Some((header, body)) = bytes.split_first_chunk::<HEADER>() else {
        return Err(CdrError::new("it is shorter than its header"));
    };
    match [header[0], header[1]] {
        LITTLE => whole(CdrReader::<LittleEndian>::new(body), of),
        BIG => whole(CdrReader::<BigEndian>::new(body), of),
        other => {
            Err(CdrError::new(format!("its representation is {other:02x?}, and only plain CDR is read")))
        }
    }
}

/// The byte order of a reader, with the names of hiroz's functions.
trait Source {
    fn value(&mut self, element: &Element) -> Result<Value, CdrError>;
    fn length(&mut self) -> Result<usize, CdrError>;
    fn left(&self) -> usize;
}

macro_rules! source {
    ($order:ty) => {
        impl Source for CdrReader<'_, $order> {
            fn value(&mut self, element: &Element) -> Result<Value, CdrError> {
                Ok(match element {
                    Element::Bool => Value::Bool(self.read_bool()?),
                    Element::Signed(8) => Value::Signed(self.read_i8()?.into()),
                    Element::Signed(16) => Value::Signed(self.read_i16()?.into()),
                    Element::Signed(32) => Value::Signed(self.read_i32()?.into()),
                    Element::Signed(_) => Value::Signed(self.read_i64()?),
                    Element::Byte | Element::Unsigned(8) => Value::Unsigned(self.read_u8()?.into()),
                    Element::Unsigned(16) => Value::Unsigned(self.read_u16()?.into()),
                    Element::Unsigned(32) => Value::Unsigned(self.read_u32()?.into()),
                    Element::Unsigned(_) => Value::Unsigned(self.read_u64()?),
                    Element::Float(32) => Value::Float(self.read_f32()?.into()),
                    Element::Float(_) => Value::Float(self.read_f64()?),
                    Element::Text(max) => Value::Text(bounded(self.read_str()?, *max)?.to_owned()),
                    Element::Message(inner) => read(self, inner)?,
                })
            }

            fn length(&mut self) -> Result<usize, CdrError> {
                Ok(self.read_sequence_length()?)
            }

            fn left(&self) -> usize {
                self.remaining()
            }
        }
    };
}

source!(LittleEndian);
source!(BigEndian);

fn whole<S: Source>(mut source: S, of: &Structure) -> Result<Value, CdrError> {
    let value = read(&mut source, of)?;
    match source.left() {
        0..=PADDING_MAX => Ok(value),
        left => Err(CdrError::new(format!("{left} bytes are behind it: is it of another type?"))),
    }
}

fn read(source: &mut impl Source, of: &Structure) -> Result<Value, CdrError> {
    let members =
        of.members.iter().map(|member| read_member(source, member).map_err(|why| within(member, &why)));
    members.collect::<Result<_, _>>().map(Value::Message)
}

fn read_member(source: &mut impl Source, member: &Member) -> Result<Value, CdrError> {
    let length = match member.count {
        Count::One => return source.value(&member.element),
        Count::Array(length) => length as usize,
        Count::Bounded(_) | Count::Unbounded => source.length()?,
    };
    check_length(member.count, length)?;
    // Each value has one byte at least, so this bounds the list before it is read.
    if length > source.left() {
        return Err(CdrError::new(format!("it has {length} values, and {} bytes are left", source.left())));
    }
    let mut values = Vec::new();
    for _ in 0..length {
        values.push(source.value(&member.element)?);
    }
    Ok(Value::List(values))
}

fn check_length(count: Count, length: usize) -> Result<(), CdrError> {
    match count {
        Count::Array(exact) if length != exact as usize => {
            Err(CdrError::new(format!("it has {length} values, and its type has {exact}")))
        }
        Count::Bounded(max) if length > max as usize => {
            Err(CdrError::new(format!("it has {length} values, and its type allows {max}")))
        }
        Count::One | Count::Array(_) | Count::Bounded(_) | Count::Unbounded => Ok(()),
    }
}

fn bounded(text: &str, max: Option<u32>) -> Result<&str, CdrError> {
    match max {
        Some(max) if text.len() > max as usize => {
            Err(CdrError::new(format!("a text has {} bytes, and its type allows {max}", text.len())))
        }
        Some(_) | None => Ok(text),
    }
}

fn within(member: &Member, why: &CdrError) -> CdrError {
    CdrError(format!("{}: {}", member.name, why.0))
}

fn write(writer: &mut CdrWriter<'_, LittleEndian>, of: &Structure, value: &Value) -> Result<(), CdrError> {
    let Value::Message(values) = value else { return Err(misfit(of.name.as_str())) };
    if values.len() != of.members.len() {
        return Err(misfit(of.name.as_str()));
    }
    for (member, value) in of.members.iter().zip(values) {
        write_member(writer, member, value).map_err(|why| within(member, &why))?;
    }
    Ok(())
}

fn write_member(
    writer: &mut CdrWriter<'_, LittleEndian>,
    member: &Member,
    value: &Value,
) -> Result<(), CdrError> {
    let values = match (member.count, value) {
        (Count::One, value) => return write_value(writer, &member.element, value),
        (count, Value::List(values)) => {
            check_length(count, values.len())?;
            if !matches!(count, Count::Array(_)) {
                writer.write_sequence_length(values.len());
            }
            values
        }
        (..) => return Err(misfit("list")),
    };
    values.iter().try_for_each(|value| write_value(writer, &member.element, value))
}

fn write_value(
    writer: &mut CdrWriter<'_, LittleEndian>,
    element: &Element,
    value: &Value,
) -> Result<(), CdrError> {
    let range = |_| CdrError::new("the number is out of the range of its type");
    match (element, value) {
        (Element::Bool, Value::Bool(value)) => writer.write_bool(*value),
        (Element::Signed(8), Value::Signed(value)) => writer.write_i8((*value).try_into().map_err(range)?),
        (Element::Signed(16), Value::Signed(value)) => writer.write_i16((*value).try_into().map_err(range)?),
        (Element::Signed(32), Value::Signed(value)) => writer.write_i32((*value).try_into().map_err(range)?),
        (Element::Signed(_), Value::Signed(value)) => writer.write_i64(*value),
        (Element::Byte | Element::Unsigned(8), Value::Unsigned(value)) => {
            writer.write_u8((*value).try_into().map_err(range)?);
        }
        (Element::Unsigned(16), Value::Unsigned(value)) => {
            writer.write_u16((*value).try_into().map_err(range)?)
        }
        (Element::Unsigned(32), Value::Unsigned(value)) => {
            writer.write_u32((*value).try_into().map_err(range)?)
        }
        (Element::Unsigned(_), Value::Unsigned(value)) => writer.write_u64(*value),
        (Element::Float(32), Value::Float(value)) => writer.write_f32(*value as f32),
        (Element::Float(_), Value::Float(value)) => writer.write_f64(*value),
        (Element::Text(max), Value::Text(text)) => {
            if text.len() > MESSAGE_BYTES_MAX || text.contains('\0') {
                return Err(CdrError::new("a text is too long, or has a character 0, which ends it for C"));
            }
            writer.write_string(bounded(text, *max)?);
        }
        (Element::Message(inner), value) => write(writer, inner, value)?,
        (
            Element::Bool
            | Element::Byte
            | Element::Signed(_)
            | Element::Unsigned(_)
            | Element::Float(_)
            | Element::Text(_),
            _,
        ) => return Err(misfit("value")),
    }
    Ok(())
}

fn misfit(what: &str) -> CdrError {
    CdrError(format!("it is no {what} of its type"))
}
