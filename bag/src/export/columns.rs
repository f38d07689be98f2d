//! The columns of a channel: the values of its payloads by their paths.

#![expect(clippy::wildcard_enum_match_arm, reason = "most values are neither list nor map")]

use std::collections::BTreeMap;

use crate::{
    messagepack::{DEPTH_MAX, MisfitError, Reader, Token, base64, json, non_finite},
    read::Header,
};

/// Maximum columns of a file.
const COLUMNS_MAX: usize = 4_096;
/// Maximum values of a list that have columns of their own. A longer list is JSON text.
const LIST_MAX: u32 = 64;
/// Maximum bytes of a path. A payload with a longer one is one value.
const PATH_MAX: usize = 1_024;

/// A message.
#[derive(Clone, Debug)]
pub(super) struct Row {
    pub(super) log_ns: u64,
    pub(super) publish_ns: u64,
    pub(super) header: Option<Header>,
    pub(super) payload: Vec<u8>,
}

/// One value of a row.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Cell {
    Bool(bool),
    Unsigned(u64),
    /// Below zero.
    Negative(i64),
    Float(f32),
    Double(f64),
    Text(String),
}

/// The type of a column, which all its values fit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Type {
    Bool,
    Unsigned,
    Signed,
    Double,
    Text,
}

impl Cell {
    /// Returns the type, and whether it can be counted below zero, too.
    const fn kind(&self) -> Type {
        match self {
            Self::Bool(_) => Type::Bool,
            Self::Unsigned(_) => Type::Unsigned,
            Self::Negative(_) => Type::Signed,
            Self::Float(_) | Self::Double(_) => Type::Double,
            Self::Text(_) => Type::Text,
        }
    }

    /// Returns the value as text, as it was written by its source: 0.1, not 0.10000000149.
    pub(super) fn text(&self) -> String {
        match self {
            Self::Bool(value) => value.to_string(),
            Self::Unsigned(value) => value.to_string(),
            Self::Negative(value) => value.to_string(),
            Self::Float(value) if value.is_finite() => value.to_string(),
            Self::Double(value) if value.is_finite() => value.to_string(),
            Self::Float(value) => non_finite((*value).into()).to_owned(),
            Self::Double(value) => non_finite(*value).to_owned(),
            Self::Text(text) => text.clone(),
        }
    }
}

/// The place and the type of a column.
#[derive(Clone, Copy, Debug)]
struct Column {
    place: usize,
    kind: Type,
    /// Whether a value is above the largest signed number.
    is_large: bool,
}

/// The columns of a channel. The first ones are those of [`FIXED`].
#[derive(Clone, Debug, Default)]
pub(super) struct Columns {
    all: BTreeMap<String, Column>,
    names: Vec<String>,
    left_out: u64,
}

/// The columns that every channel has.
pub(super) const FIXED: [(&str, Type); 8] = [
    ("log_ns", Type::Unsigned),
    ("publish_ns", Type::Unsigned),
    ("sequence", Type::Unsigned),
    ("number", Type::Unsigned),
    ("correlation", Type::Unsigned),
    ("age_ns", Type::Signed),
    ("error_ns", Type::Unsigned),
    ("flags", Type::Unsigned),
];

impl Columns {
    /// Adds the columns of a row, and widens those that are there.
    pub(super) fn add(&mut self, row: &Row) {
        visit(&row.payload, |path, cell| {
            let is_large = matches!(cell, Cell::Unsigned(value) if value > i64::MAX as u64);
            if let Some(column) = self.all.get_mut(path) {
                column.is_large |= is_large;
                column.kind = common(column.kind, cell.kind(), column.is_large);
            } else if self.names.len() + FIXED.len() < COLUMNS_MAX {
                let place = self.names.len();
                self.names.push(path.to_owned());
                self.all.insert(path.to_owned(), Column { place, kind: cell.kind(), is_large });
            } else {
                self.left_out += 1;
            }
        });
    }

    pub(super) fn len(&self) -> usize {
        self.names.len() + FIXED.len()
    }

    pub(super) const fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Returns names and types. A value of the payload that has a name of [`FIXED`] has `payload.` in front.
    pub(super) fn described(&self) -> Vec<(String, Type)> {
        let mut all: Vec<_> = FIXED.iter().map(|(name, kind)| ((*name).to_owned(), *kind)).collect();
        for name in &self.names {
            let kind = self.all.get(name).map_or(Type::Text, |column| column.kind);
            let is_taken = FIXED.iter().any(|(fixed, _)| fixed == name);
            all.push((if is_taken { format!("payload.{name}") } else { name.clone() }, kind));
        }
        all
    }

    /// Returns the values of a row, in the order of the columns.
    pub(super) fn cells(&self, row: &Row) -> Vec<Option<Cell>> {
        let mut cells = vec![None; self.len()];
        cells[0] = Some(Cell::Unsigned(row.log_ns));
        cells[1] = Some(Cell::Unsigned(row.publish_ns));
        if let Some(header) = &row.header {
            let age = u64::try_from(header.age_ns).map_or(Cell::Negative(header.age_ns), Cell::Unsigned);
            let unsigned = [header.sequence, header.number, header.correlation].map(Cell::Unsigned);
            let last = [age, Cell::Unsigned(header.error_ns), Cell::Unsigned(header.flags.into())];
            for (cell, value) in cells[2..].iter_mut().zip(unsigned.into_iter().chain(last)) {
                *cell = Some(value);
            }
        }
        visit(&row.payload, |path, cell| {
            if let Some(column) = self.all.get(path) {
                cells[FIXED.len() + column.place] = Some(cell);
            }
        });
        cells
    }
}

/// Returns a type that holds the values of both.
fn common(one: Type, other: Type, is_large: bool) -> Type {
    match (one, other) {
        _ if one == other && !(one == Type::Signed && is_large) => one,
        (Type::Unsigned, Type::Signed) | (Type::Signed, Type::Unsigned) if !is_large => Type::Signed,
        (Type::Double, Type::Unsigned | Type::Signed) | (Type::Unsigned | Type::Signed, Type::Double) => {
            Type::Double
        }
        _ => Type::Text,
    }
}

/// Calls `each` for every value with its path. Bytes are in base64. A payload is one value if it is no MessagePack or
/// has a path that is too long.
fn visit(payload: &[u8], mut each: impl FnMut(&str, Cell)) {
    let mut path = String::new();
    let mut reader = Reader::new(payload);
    let is_read = value(&mut reader, &mut path, DEPTH_MAX, &mut |_, _| {});
    if is_read.is_err() || !reader.is_empty() {
        return each("bytes", Cell::Text(base64(payload)));
    }
    // A second pass instead of a list: a payload can have very many values, and each has its path. It cannot fail.
    let mut each = |path: &str, cell| each(if path.is_empty() { "value" } else { path }, cell);
    let _ = value(&mut Reader::new(payload), &mut path, DEPTH_MAX, &mut each);
}

fn value(
    reader: &mut Reader<'_>,
    path: &mut String,
    depth: usize,
    each: &mut dyn FnMut(&str, Cell),
) -> Result<(), MisfitError> {
    let depth = depth.checked_sub(1).ok_or(MisfitError::new("less nesting"))?;
    let mut ahead = *reader;
    match ahead.next()? {
        Token::List(count) if count <= LIST_MAX => {
            *reader = ahead;
            (0..count).try_for_each(|at| below(reader, path, &at.to_string(), depth, each))
        }
        Token::List(_) => {
            let mut text = String::new();
            json(reader, depth, &mut text)?;
            each(path, Cell::Text(text));
            Ok(())
        }
        Token::Map(count) => {
            *reader = ahead;
            for _ in 0..count {
                let mut key = String::new();
                let mut ahead = *reader;
                if let Token::Text(text) = ahead.next()? {
                    *reader = ahead;
                    key.push_str(text);
                } else {
                    json(reader, depth.min(1), &mut key)?;
                }
                below(reader, path, &key, depth, each)?;
            }
            Ok(())
        }
        token => {
            *reader = ahead;
            if let Some(cell) = cell(token) {
                each(path, cell);
            }
            Ok(())
        }
    }
}

fn below(
    reader: &mut Reader<'_>,
    path: &mut String,
    name: &str,
    depth: usize,
    each: &mut dyn FnMut(&str, Cell),
) -> Result<(), MisfitError> {
    let length = path.len();
    if length > 0 {
        path.push('.');
    }
    path.push_str(name);
    let read = if path.len() > PATH_MAX {
        Err(MisfitError::new("shorter names"))
    } else {
        value(reader, path, depth, each)
    };
    path.truncate(length);
    read
}

fn cell(token: Token<'_>) -> Option<Cell> {
    Some(match token {
        Token::Bool(value) => Cell::Bool(value),
        Token::Unsigned(value) => Cell::Unsigned(value),
        Token::Negative(value) => Cell::Negative(value),
        Token::Float(value) => Cell::Float(value),
        Token::Double(value) => Cell::Double(value),
        Token::Text(text) => Cell::Text(text.to_owned()),
        Token::Bytes(bytes) | Token::Extension(_, bytes) => Cell::Text(base64(bytes)),
        Token::Nil | Token::List(_) | Token::Map(_) => return None,
    })
}
