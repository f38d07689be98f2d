//! The differences between a sender's type and the receiver's, in words.

use std::{collections::BTreeSet, fmt};

use crate::shape::{Field, Schema, Shape, Variant};

/// Maximum number of differences that are reported.
pub const DIFFERENCES_MAX: usize = 16;
/// Maximum number of shapes that are looked into for the number of a unit. A newtype around more counts as a unit.
const UNIT_SHAPES_MAX: usize = 64;
/// Maximum number of pairs of types that one comparison compares; the types of real programs have some tens.
const PAIRS_MAX: usize = 4_096;
/// Maximum depth of a comparison: two types that contain themselves have up to 65,280 pairs below each other.
const DEPTH_MAX: usize = 128;

/// How a sender's structure of a type relates to that of a receiver.
///
/// # Examples
///
/// ```
/// use serde::{Deserialize, Serialize};
/// use sinew_schema::{Comparison, Schema, compare};
///
/// #[derive(Serialize, Deserialize)]
/// struct Old { kp: f32 }
/// #[derive(Serialize, Deserialize)]
/// struct New { kp: f32, kd: f32 }
///
/// let (old, new) = (Schema::of::<Old>().unwrap(), Schema::of::<New>().unwrap());
/// assert!(matches!(compare(&new, &old), Comparison::Addition(_)));
/// let Comparison::Conflict(differences) = compare(&old, &new) else { panic!() };
/// assert_eq!(differences[0].to_string(), "field `kd` is missing at the sender");
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Comparison {
    /// There is no difference in messages.
    Same,
    /// The receiver accepts the messages of the sender, apart from variants of an enum that it does not have. The
    /// differences are additional fields or variants, wider types, and names that do not travel.
    Addition(Vec<Difference>),
    /// The receiver cannot rely on the messages of the sender.
    Conflict(Vec<Difference>),
}

impl Comparison {
    /// Returns the differences; none for [`Same`](Self::Same).
    #[must_use]
    pub fn differences(&self) -> &[Difference] {
        match self {
            Self::Same => &[],
            Self::Addition(differences) | Self::Conflict(differences) => differences,
        }
    }
}

/// A difference, as a sentence without its end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Difference {
    /// The path of the field: `legs[].gains.kp`. Empty for the payload itself.
    pub path: String,
    /// Whether a person should check that both ends mean the same, although the receiver accepts the messages.
    pub is_doubtful: bool,
    words: String,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.words)
    }
}

/// Compares the structure of a sender with that of a receiver.
///
/// Names of structs and enums do not travel and may differ. The names of two newtypes around numbers may not: they are
/// units. A number is accepted in a wider type that holds each of its values. Types that are nested in more than 128
/// levels, or have more than 4,096 pairs, are not compared: that is a conflict.
#[must_use]
pub fn compare(sent: &Schema, handled: &Schema) -> Comparison {
    let (seen, found) = (BTreeSet::new(), Found::default());
    let mut comparing = Comparing { sent, handled, seen, depth: 0, found };
    comparing.shapes(&sent.root, &handled.root, &Path::default());
    let Found { differences, conflicts } = comparing.found;
    if conflicts > 0 {
        Comparison::Conflict(differences)
    } else if differences.is_empty() {
        Comparison::Same
    } else {
        Comparison::Addition(differences)
    }
}

#[derive(Default)]
struct Found {
    differences: Vec<Difference>,
    conflicts: usize,
}

struct Comparing<'s> {
    sent: &'s Schema,
    handled: &'s Schema,
    /// Pairs of types that were compared: a type that occurs in itself is compared once.
    seen: BTreeSet<(&'s str, &'s str)>,
    /// Shapes around the current ones.
    depth: usize,
    found: Found,
}

/// The path of a field.
#[derive(Clone, Default)]
struct Path(String);

impl Path {
    fn field(&self, name: &str) -> Self {
        let name = name.escape_debug();
        Self(if self.0.is_empty() { name.to_string() } else { format!("{}.{name}", self.0) })
    }

    fn element(&self, index: &str) -> Self {
        Self(format!("{}[{index}]", self.0))
    }
}

impl fmt::Display for Path {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_empty() { f.write_str("the payload") } else { write!(f, "`{}`", self.0) }
    }
}

/// The effect of a difference on the verdict.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Meaning {
    /// The receiver accepts it.
    Addition,
    /// The receiver accepts it, and perhaps means something else.
    Doubt,
    Conflict,
}

impl<'s> Comparing<'s> {
    fn add(&mut self, path: &Path, meaning: Meaning, words: String) {
        self.found.conflicts += usize::from(meaning == Meaning::Conflict);
        if self.found.differences.len() < DIFFERENCES_MAX {
            let is_doubtful = meaning == Meaning::Doubt;
            self.found.differences.push(Difference { path: path.0.clone(), is_doubtful, words });
        }
    }

    fn shapes(&mut self, sent: &'s Shape, handled: &'s Shape, path: &Path) {
        if self.depth == DEPTH_MAX {
            let words = format!("{path} is nested too deep to be compared");
            return self.add(path, Meaning::Conflict, words);
        }
        self.depth += 1;
        self.shapes_at_depth(sent, handled, path);
        self.depth -= 1;
    }

    fn shapes_at_depth(&mut self, sent: &'s Shape, handled: &'s Shape, path: &Path) {
        if let (Shape::Named(name_sent), Shape::Named(name_handled)) = (sent, handled) {
            let pair = (name_sent.as_str(), name_handled.as_str());
            if self.seen.contains(&pair) {
                return;
            }
            if self.seen.len() == PAIRS_MAX {
                let words = format!("{path} is behind {PAIRS_MAX} pairs of types, and is not compared");
                return self.add(path, Meaning::Conflict, words);
            }
            self.seen.insert(pair);
        }
        if let Shape::Option(inner) = handled
            && !matches!(bare(self.sent, sent), Some(Shape::Option(_) | Shape::Unit) | None)
        {
            return self.wider(
                path,
                |this| this.shapes(sent, inner, path),
                || format!("{path} is always there at the sender, and may be absent at the receiver"),
            );
        }
        let words = || {
            let (one, other) = (shown(self.sent, sent), shown(self.handled, handled));
            format!(
                "{path} is {one} at the sender and {other} at the receiver, which is the same on the wire"
            )
        };
        match (unit(self.sent, sent), unit(self.handled, handled)) {
            (None, None) => {}
            (Some((one, inner)), Some((other, inner_handled))) => {
                self.units(&[one, other], [inner, inner_handled], path);
                return self.shapes(inner, inner_handled, path);
            }
            (Some((_, inner)), None) => {
                let words = words();
                return self.renamed(path, words, |this| this.shapes(inner, handled, path));
            }
            (None, Some((_, inner))) => {
                let words = words();
                return self.renamed(path, words, |this| this.shapes(sent, inner, path));
            }
        }
        let (Some(one), Some(other)) = (self.sent.resolve(sent), self.handled.resolve(handled)) else {
            return self.differ(sent, handled, path);
        };
        self.resolved((sent, one), (handled, other), path);
    }

    /// Adds an addition, unless `compare` finds a conflict.
    fn wider(&mut self, path: &Path, compare: impl FnOnce(&mut Self), words: impl FnOnce() -> String) {
        let conflicts = self.found.conflicts;
        compare(self);
        if self.found.conflicts == conflicts {
            self.add(path, Meaning::Addition, words());
        }
    }

    /// Adds a doubt about a name that only one end has, unless `compare` finds a conflict.
    fn renamed(&mut self, path: &Path, words: String, compare: impl FnOnce(&mut Self)) {
        let conflicts = self.found.conflicts;
        compare(self);
        if self.found.conflicts == conflicts {
            self.add(path, Meaning::Doubt, words);
        }
    }

    /// Compares the names of two newtypes. Around numbers they are units.
    fn units(&mut self, names: &[&str; 2], inner: [&'s Shape; 2], path: &Path) {
        let [one, other] = names;
        if one == other {
            return;
        }
        let is_measure = |schema, inner| is_measure(schema, inner, &mut { UNIT_SHAPES_MAX });
        let is_measure = is_measure(self.sent, inner[0]) || is_measure(self.handled, inner[1]);
        let (one, other) = (one.escape_debug(), other.escape_debug());
        let (meaning, verb) = if is_measure { (Meaning::Conflict, "in") } else { (Meaning::Doubt, "called") };
        let words = format!("{path} is {verb} {one} at the sender and {other} at the receiver");
        self.add(path, meaning, words);
    }

    /// Compares the shapes that two names stand for; the first of each pair is for words.
    fn resolved(&mut self, sent: (&'s Shape, &'s Shape), handled: (&'s Shape, &'s Shape), path: &Path) {
        match (sent.1, handled.1) {
            (Shape::Option(one), Shape::Option(other)) | (Shape::Newtype(one), Shape::Newtype(other)) => {
                self.shapes(one, other, path);
            }
            // The payload itself, or a variant: its name does not show a unit.
            (Shape::Newtype(one), _) => self.shapes(one, handled.0, path),
            (_, Shape::Newtype(other)) => self.shapes(sent.0, other, path),
            (Shape::List(one), Shape::List(other)) => self.shapes(one, other, &path.element("")),
            (Shape::Array(one, length), Shape::Array(other, of)) if length == of => {
                self.shapes(one, other, &path.element(""));
            }
            (Shape::Array(one, length), Shape::List(other)) => {
                self.wider(
                    path,
                    |this| this.shapes(one, other, &path.element("")),
                    || format!("{path} has {length} values at the sender, and any number at the receiver"),
                );
            }
            (Shape::Array(one, length), Shape::Tuple(others)) if *length == others.len() => {
                for (index, other) in others.iter().enumerate() {
                    self.shapes(one, other, &path.element(&index.to_string()));
                }
            }
            (Shape::Tuple(parts), Shape::Array(other, length)) if *length == parts.len() => {
                for (index, one) in parts.iter().enumerate() {
                    self.shapes(one, other, &path.element(&index.to_string()));
                }
            }
            (Shape::Map(key, value), Shape::Map(other_key, other_value)) => {
                self.shapes(key, other_key, &path.element("key"));
                self.shapes(value, other_value, &path.element(""));
            }
            (Shape::Tuple(parts), Shape::Tuple(others)) if parts.len() == others.len() => {
                for (index, (one, other)) in parts.iter().zip(others).enumerate() {
                    self.shapes(one, other, &path.element(&index.to_string()));
                }
            }
            (Shape::Struct(fields), Shape::Struct(others)) => self.fields(fields, others, path),
            (Shape::Enum(variants), Shape::Enum(others)) => self.variants(variants, others, path),
            // A type without fields is read from each form of an empty value.
            (one, other) if path.0.is_empty() && is_empty(one) && is_empty(other) => {}
            (one, other) if one == other && is_leaf(one) => {}
            (one, other) if holds_each(other, one) => {
                let words = format!(
                    "{path} is {one} at the sender and {other} at the receiver, which holds each value"
                );
                self.add(path, Meaning::Addition, words);
            }
            _ => self.differ(sent.0, handled.0, path),
        }
    }

    fn differ(&mut self, sent: &Shape, handled: &Shape, path: &Path) {
        let (one, other) = (shown(self.sent, sent), shown(self.handled, handled));
        let words = format!("{path} is {one} at the sender and {other} at the receiver");
        self.add(path, Meaning::Conflict, words);
    }

    fn fields(&mut self, sent: &'s [Field], handled: &'s [Field], path: &Path) {
        let lacks = |fields: &[Field], name: &str| !fields.iter().any(|field| field.name == name);
        for field in sent {
            if let Some(other) = handled.iter().find(|other| other.name == field.name) {
                self.shapes(&field.shape, &other.shape, &path.field(&field.name));
            }
        }
        let extra = sent.iter().filter(|field| lacks(handled, &field.name));
        let mut extra: Vec<_> = extra.map(|field| (field, shown(self.sent, &field.shape))).collect();
        for missing in handled.iter().filter(|field| lacks(sent, &field.name)) {
            let shape = shown(self.handled, &missing.shape);
            // A field that both ends regard as optional may be a new one at each.
            let is_twin =
                |(field, of): &(&Field, String)| *of == shape && !(field.optional && missing.optional);
            if let Some(twin) = extra.iter().position(is_twin) {
                let (one, other) = (path.field(&extra.remove(twin).0.name), path.field(&missing.name));
                let words = format!(
                    "field {one} ({shape}) at the sender seems to be {other} ({shape}) at the receiver"
                );
                self.add(&other, Meaning::Conflict, words);
                continue;
            }
            let path = path.field(&missing.name);
            if missing.optional {
                let words = format!("field {path} is missing at the sender, which the receiver accepts");
                self.add(&path, Meaning::Addition, words);
            } else {
                self.add(&path, Meaning::Conflict, format!("field {path} is missing at the sender"));
            }
        }
        for (field, _) in extra {
            let path = path.field(&field.name);
            self.add(&path, Meaning::Addition, format!("field {path} is missing at the receiver"));
        }
    }

    fn variants(&mut self, sent: &'s [Variant], handled: &'s [Variant], path: &Path) {
        for variant in sent {
            let inner = path.field(&variant.name);
            match handled.iter().find(|other| other.name == variant.name) {
                // A variant without a value is a text, and each other one a map.
                Some(other) if (variant.shape == Shape::Unit) != (other.shape == Shape::Unit) => {
                    self.differ(&variant.shape, &other.shape, &inner);
                }
                Some(other) => {
                    self.resolved((&variant.shape, &variant.shape), (&other.shape, &other.shape), &inner);
                }
                None => {
                    let words = format!(
                        "variant {inner} is missing at the receiver, whose decoder refuses messages with it"
                    );
                    self.add(&inner, Meaning::Doubt, words);
                }
            }
        }
        for other in handled {
            if !sent.iter().any(|variant| variant.name == other.name) {
                let inner = path.field(&other.name);
                let words = format!("variant {inner} is missing at the sender");
                self.add(&inner, Meaning::Addition, words);
            }
        }
    }
}

/// Returns the name and the inside of a newtype.
fn unit<'s>(schema: &'s Schema, shape: &'s Shape) -> Option<(&'s str, &'s Shape)> {
    let Shape::Named(name) = shape else { return None };
    match schema.types.get(name) {
        Some(Shape::Newtype(inner)) => Some((name.as_str(), &**inner)),
        Some(_) | None => None,
    }
}

/// Returns the shape inside all newtypes: the shape on the wire. `None`: the schema does not have one.
fn bare<'s>(schema: &'s Schema, mut shape: &'s Shape) -> Option<&'s Shape> {
    for _ in 0..DEPTH_MAX {
        let resolved = schema.resolve(shape)?;
        let Shape::Newtype(inner) = resolved else { return Some(resolved) };
        shape = inner;
    }
    None
}

/// Returns whether a newtype around this shape can be a unit: it is a number, or consists of numbers.
fn is_measure(schema: &Schema, shape: &Shape, left: &mut usize) -> bool {
    let (Some(shape), Some(rest)) = (bare(schema, shape), left.checked_sub(1)) else { return true };
    *left = rest;
    if let Shape::Option(inner) | Shape::List(inner) | Shape::Array(inner, _) | Shape::Map(_, inner) = shape {
        is_measure(schema, inner, left)
    } else if let Shape::Tuple(parts) = shape {
        parts.iter().any(|part| is_measure(schema, part, left))
    } else {
        number(shape).is_some()
    }
}

/// A type of numbers.
#[derive(Clone, Copy)]
struct Number {
    is_signed: bool,
    is_float: bool,
    /// It holds each integer of so many bits.
    bits: u32,
}

const fn whole(is_signed: bool, bits: u32) -> Number {
    Number { is_signed, is_float: false, bits }
}

const fn float(bits: u32) -> Number {
    Number { is_signed: true, is_float: true, bits }
}

const NUMBERS: [(Shape, Number); 12] = [
    (Shape::I8, whole(true, 7)),
    (Shape::I16, whole(true, 15)),
    (Shape::I32, whole(true, 31)),
    (Shape::I64, whole(true, 63)),
    (Shape::I128, whole(true, 127)),
    (Shape::U8, whole(false, 8)),
    (Shape::U16, whole(false, 16)),
    (Shape::U32, whole(false, 32)),
    (Shape::U64, whole(false, 64)),
    (Shape::U128, whole(false, 128)),
    (Shape::F32, float(24)),
    (Shape::F64, float(53)),
];

fn number(shape: &Shape) -> Option<Number> {
    NUMBERS.iter().find(|(of, _)| of == shape).map(|(_, number)| *number)
}

/// Returns whether a value of the type `wide` is read from each value of the type `narrow`, without a loss. MessagePack
/// writes a number in its shortest form, with its type.
fn holds_each(wide: &Shape, narrow: &Shape) -> bool {
    match (number(wide), number(narrow)) {
        (Some(wide), Some(narrow)) => {
            wide.bits >= narrow.bits && wide.is_signed >= narrow.is_signed && wide.is_float >= narrow.is_float
        }
        _ => (wide, narrow) == (&Shape::Text, &Shape::Char),
    }
}

/// Returns a shape for a sentence; a newtype is shown with its inside.
fn shown(schema: &Schema, shape: &Shape) -> String {
    match unit(schema, shape) {
        Some((name, inner)) => format!("{} ({inner})", name.escape_debug()),
        None => shape.to_string(),
    }
}

fn is_empty(shape: &Shape) -> bool {
    *shape == Shape::Unit || matches!(shape, Shape::Struct(fields) if fields.is_empty())
}

fn is_leaf(shape: &Shape) -> bool {
    let mut has_parts = false;
    shape.parts(|_| has_parts = true);
    !has_parts && !matches!(shape, Shape::Named(_))
}
