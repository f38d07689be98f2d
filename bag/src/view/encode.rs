//! Payloads as messages of their view, in one pass.

#![expect(
    clippy::wildcard_enum_match_arm,
    reason = "each place accepts few of the values that a payload can have"
)]

use super::{FieldPlan, Form, Kind, MessagePlan, View};
use crate::{
    messagepack::{DEPTH_MAX, MisfitError, Reader, Token, json},
    protobuf::{FIXED32, FIXED64, LENGTH, Output, VARINT, zigzag},
};

/// Fields of a message that are checked for absence. Further ones are not.
const CHECKED_MAX: usize = 256;

/// Writes a payload as the first message of `view`.
pub(super) fn payload(view: &View, payload: &[u8], out: &mut Output) -> Result<(), MisfitError> {
    let mut encoder = Encoder { view, reader: Reader::new(payload), out };
    encoder.message(0, DEPTH_MAX)?;
    if encoder.reader.is_empty() { Ok(()) } else { Err(MisfitError::new("one value only")) }
}

struct Encoder<'e, 'p> {
    view: &'e View,
    reader: Reader<'p>,
    out: &'e mut Output,
}

/// The fields of a message that the payload has.
struct Found([u64; CHECKED_MAX / 64]);

impl Found {
    /// Returns whether the field is there for the first time.
    fn insert(&mut self, at: usize) -> bool {
        let Some(word) = self.0.get_mut(at / 64) else { return true };
        let bit = 1 << (at % 64);
        let is_new = *word & bit == 0;
        *word |= bit;
        is_new
    }

    fn has(&self, at: usize) -> bool {
        self.0.get(at / 64).is_none_or(|word| word >> (at % 64) & 1 == 1)
    }
}

impl<'e> Encoder<'e, '_> {
    fn message(&mut self, at: usize, depth: usize) -> Result<(), MisfitError> {
        let depth = depth.checked_sub(1).ok_or(MisfitError::new("less nesting"))?;
        let view: &'e View = self.view;
        let plan = &view.messages[at];
        match plan.form {
            Form::Struct => self.structure(plan, depth),
            Form::Tuple => match self.reader.next()? {
                Token::List(count) => self.in_order(plan, count, depth),
                _ => Err(MisfitError::new("a list for a tuple")),
            },
            Form::Single => plan.fields.iter().try_for_each(|field| self.field(1, field, depth)),
            Form::Variants => self.variant(plan, depth),
            Form::Unit => self.unit(),
        }
    }

    /// A unit is nil, or an empty list where it is a struct.
    fn unit(&mut self) -> Result<(), MisfitError> {
        match self.reader.next()? {
            Token::Nil | Token::List(0) | Token::Map(0) => Ok(()),
            _ => Err(MisfitError::new("nil for a unit")),
        }
    }

    fn structure(&mut self, plan: &MessagePlan, depth: usize) -> Result<(), MisfitError> {
        let count = match self.reader.next()? {
            Token::Map(count) => count,
            Token::List(count) => return self.in_order(plan, count, depth),
            _ => return Err(MisfitError::new("a map for a struct")),
        };
        let mut found = Found([0; CHECKED_MAX / 64]);
        let mut next = 0;
        for _ in 0..count {
            let Token::Text(name) = self.reader.next()? else {
                return Err(MisfitError::new("names of fields"));
            };
            // Fields mostly are in their order.
            let is_next = plan.fields.get(next).is_some_and(|field| field.wire == name);
            let at =
                if is_next { Some(next) } else { plan.fields.iter().position(|field| field.wire == name) };
            let Some(at) = at else {
                // A field of a newer version: as for a receiver, it is not there.
                self.reader.skip()?;
                continue;
            };
            if !found.insert(at) {
                return Err(MisfitError::new("each field once"));
            }
            next = at + 1;
            self.field(number(at), &plan.fields[at], depth)?;
        }
        let is_missing = |(at, field): (usize, &FieldPlan)| !field.is_optional && !found.has(at);
        if plan.fields.iter().enumerate().any(is_missing) {
            Err(MisfitError::new("all fields of a struct"))
        } else {
            Ok(())
        }
    }

    fn in_order(&mut self, plan: &MessagePlan, count: u32, depth: usize) -> Result<(), MisfitError> {
        let count = count as usize;
        if count > plan.fields.len() || plan.fields[count..].iter().any(|field| !field.is_optional) {
            return Err(MisfitError::new("as many values as fields"));
        }
        let fields = plan.fields[..count].iter().enumerate();
        fields
            .map(|(at, field)| (number(at), field))
            .try_for_each(|(number, field)| self.field(number, field, depth))
    }

    fn variant(&mut self, plan: &MessagePlan, depth: usize) -> Result<(), MisfitError> {
        let (name, has_data) = match self.reader.next()? {
            Token::Text(name) => (name, false),
            Token::Map(1) => match self.reader.next()? {
                Token::Text(name) => (name, true),
                _ => return Err(MisfitError::new("the name of a variant")),
            },
            _ => return Err(MisfitError::new("a variant")),
        };
        let at = plan
            .fields
            .iter()
            .position(|field| field.wire == name)
            .ok_or(MisfitError::new("a known variant"))?;
        let field = &plan.fields[at];
        if has_data {
            return self.field(number(at), field, depth);
        }
        let is_unit =
            matches!(field.kind, Kind::Message(inner) if self.view.messages[inner].form == Form::Unit);
        if !is_unit {
            return Err(MisfitError::new("the data of a variant"));
        }
        self.out.bytes(number(at), &[]);
        Ok(())
    }

    /// Writes one field with its tag; nothing if it is absent.
    fn field(&mut self, number: u32, field: &FieldPlan, depth: usize) -> Result<(), MisfitError> {
        match &field.kind {
            Kind::Optional(_) if self.reader.skip_nil() => Ok(()),
            Kind::Optional(inner) => self.tagged(number, inner, depth),
            Kind::List(inner) => self.list(number, inner, depth),
            other => self.tagged(number, other, depth),
        }
    }

    fn tagged(&mut self, number: u32, kind: &Kind, depth: usize) -> Result<(), MisfitError> {
        self.out.tag(number, wire(kind));
        match kind {
            Kind::Message(at) => {
                let start = self.out.0.len();
                self.message(*at, depth)?;
                self.out.end(start);
                Ok(())
            }
            other => self.value(other, depth),
        }
    }

    fn list(&mut self, number: u32, kind: &Kind, depth: usize) -> Result<(), MisfitError> {
        let count = match self.reader.next()? {
            Token::List(count) => count,
            Token::Bytes(bytes) if *kind == Kind::Unsigned(8) => {
                self.out.message(number, |out| bytes.iter().for_each(|byte| out.varint(u64::from(*byte))));
                return Ok(());
            }
            _ => return Err(MisfitError::new("a list")),
        };
        if wire(kind) == LENGTH {
            return (0..count).try_for_each(|_| self.tagged(number, kind, depth));
        }
        let start = self.out.begin(number);
        (0..count).try_for_each(|_| self.value(kind, depth))?;
        self.out.end(start);
        Ok(())
    }

    /// Writes a value without its tag.
    fn value(&mut self, kind: &Kind, depth: usize) -> Result<(), MisfitError> {
        let token = match kind {
            Kind::Json => {
                let mut text = String::new();
                json(&mut self.reader, depth, &mut text)?;
                self.sized(text.as_bytes());
                return Ok(());
            }
            _ => self.reader.next()?,
        };
        match (kind, token) {
            (Kind::Bool, Token::Bool(value)) => self.out.varint(value.into()),
            (Kind::Signed(bits), _) => self.out.varint(zigzag(signed(token, *bits)?)),
            (Kind::Unsigned(bits), Token::Unsigned(value)) if *bits == 64 || value >> bits == 0 => {
                self.out.varint(value)
            }
            (Kind::Float, Token::Float(value)) => self.out.0.extend(value.to_le_bytes()),
            (Kind::Double, _) => self.out.0.extend(double(token)?.to_le_bytes()),
            (Kind::Text, Token::Text(text)) => self.sized(text.as_bytes()),
            (Kind::Bytes, Token::Bytes(bytes)) => self.sized(bytes),
            (Kind::Bytes, Token::List(count)) => self.listed_bytes(count)?,
            (Kind::Wide { is_signed }, Token::Bytes(bytes)) => {
                self.sized(wide(bytes, *is_signed)?.as_bytes())
            }
            (Kind::Wide { .. }, Token::Unsigned(value)) => self.sized(value.to_string().as_bytes()),
            (Kind::Wide { is_signed: true }, Token::Negative(value)) => {
                self.sized(value.to_string().as_bytes())
            }
            (Kind::Enum(at), _) => {
                let values = &self.view.enums[*at].values;
                let Token::Text(name) = token else { return Err(MisfitError::new("the name of a variant")) };
                let at = values.iter().position(|(wire, _)| wire == name);
                self.out.varint(at.ok_or(MisfitError::new("a known variant"))? as u64);
            }
            _ => return Err(MisfitError::new(expected(kind))),
        }
        Ok(())
    }

    fn sized(&mut self, bytes: &[u8]) {
        self.out.varint(bytes.len() as u64);
        self.out.0.extend_from_slice(bytes);
    }

    /// Bytes that were written as a list of numbers.
    fn listed_bytes(&mut self, count: u32) -> Result<(), MisfitError> {
        let start = self.out.0.len();
        for _ in 0..count {
            let Token::Unsigned(byte @ 0..=255) = self.reader.next()? else {
                return Err(MisfitError::new("bytes"));
            };
            self.out.0.push(byte as u8);
        }
        self.out.end(start);
        Ok(())
    }
}

fn number(at: usize) -> u32 {
    // A view has fewer fields than the header's number.
    at as u32 + 1
}

fn wire(kind: &Kind) -> u32 {
    match kind {
        Kind::Bool | Kind::Signed(_) | Kind::Unsigned(_) | Kind::Enum(_) => VARINT,
        Kind::Float => FIXED32,
        Kind::Double => FIXED64,
        Kind::Text
        | Kind::Wide { .. }
        | Kind::Bytes
        | Kind::Json
        | Kind::Message(_)
        | Kind::Optional(_)
        | Kind::List(_) => LENGTH,
    }
}

fn signed(token: Token<'_>, bits: u32) -> Result<i64, MisfitError> {
    let value = match token {
        Token::Unsigned(value) => i64::try_from(value).ok(),
        Token::Negative(value) => Some(value),
        _ => None,
    };
    let unused = 64 - bits;
    value
        .filter(|value| value << unused >> unused == *value)
        .ok_or(MisfitError::new("a signed number of this size"))
}

fn double(token: Token<'_>) -> Result<f64, MisfitError> {
    match token {
        Token::Double(value) => Ok(value),
        // As receivers accept it, and exact.
        Token::Float(value) => Ok(value.into()),
        _ => Err(MisfitError::new("f64")),
    }
}

/// Returns a number of 128 bits as text. MessagePack has it as 16 bytes, the highest first.
fn wide(bytes: &[u8], is_signed: bool) -> Result<String, MisfitError> {
    let bytes: [u8; 16] =
        bytes.try_into().map_err(|_| MisfitError::new("16 bytes for a number of 128 bits"))?;
    Ok(if is_signed {
        i128::from_be_bytes(bytes).to_string()
    } else {
        u128::from_be_bytes(bytes).to_string()
    })
}

fn expected(kind: &Kind) -> &'static str {
    match kind {
        Kind::Bool => "bool",
        Kind::Signed(_) => "a signed number of this size",
        Kind::Unsigned(_) => "an unsigned number of this size",
        Kind::Float => "f32",
        Kind::Double => "f64",
        Kind::Text => "text",
        Kind::Wide { .. } => "a number of 128 bits",
        Kind::Bytes => "bytes",
        Kind::Json | Kind::Enum(_) | Kind::Message(_) | Kind::Optional(_) | Kind::List(_) => "another value",
    }
}
