//! The differences between a sender's type and the receiver's, in words.

use std::{collections::BTreeSet, fmt};

use crate::shape::{Field, Schema, Shape, Variant};

/// Maximum number of differences that are reported.
pub const DIFFERENCES_MAX: usize = 16;
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
    /// One of them has more fields or variants, and the receiver accepts the messages of the sender.
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
    words: String,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.words)
    }
}

/// Compares the structure of a sender with that of a receiver.
///
/// Names of structs and enums do not travel and may differ. Names of newtypes may not: they are units. Types that are
/// nested in more than 128 levels are not compared: that is a conflict.
#[must_use]
pub fn compare(sent: &Schema, handled: &Schema) -> Comparison {
    let (seen, found) = (BTreeSet::new(), Found::default());
    let mut comparing = Comparing { sent, handled, seen, depth: 0, found };
    comparing.shapes(&sent.root, &handled.root, &Path::default());
    let Found { differences, sender_has_more, receiver_has_more, is_conflict } = comparing.found;
    if is_conflict || (sender_has_more && receiver_has_more) {
        Comparison::Conflict(differences)
    } else if sender_has_more || receiver_has_more {
        Comparison::Addition(differences)
    } else {
        Comparison::Same
    }
}

#[derive(Default)]
struct Found {
    differences: Vec<Difference>,
    sender_has_more: bool,
    receiver_has_more: bool,
    is_conflict: bool,
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
#[derive(Clone, Copy)]
enum Meaning {
    SenderHasMore,
    ReceiverHasMore,
    Conflict,
}

impl<'s> Comparing<'s> {
    fn add(&mut self, path: &Path, meaning: Meaning, words: String) {
        match meaning {
            Meaning::SenderHasMore => self.found.sender_has_more = true,
            Meaning::ReceiverHasMore => self.found.receiver_has_more = true,
            Meaning::Conflict => self.found.is_conflict = true,
        }
        if self.found.differences.len() < DIFFERENCES_MAX {
            self.found.differences.push(Difference { path: path.0.clone(), words });
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
        let (schema_sent, schema_handled) = (self.sent, self.handled);
        if let (Shape::Named(name_sent), Shape::Named(name_handled)) = (sent, handled)
            && !self.seen.insert((name_sent.as_str(), name_handled.as_str()))
        {
            return;
        }
        match (unit(schema_sent, sent), unit(schema_handled, handled)) {
            (None, None) => {}
            (Some((one, sent)), Some((other, handled))) if one == other => {
                return self.shapes(sent, handled, path);
            }
            (Some((one, inner_sent)), Some((other, inner_handled)))
                if shown(schema_sent, inner_sent) == shown(schema_handled, inner_handled) =>
            {
                let words = format!("{path} is in {one} at the sender and {other} at the receiver");
                return self.add(path, Meaning::Conflict, words);
            }
            _ => return self.differ(sent, handled, path),
        }
        let (Some(one), Some(other)) = (schema_sent.resolve(sent), schema_handled.resolve(handled)) else {
            return self.differ(sent, handled, path);
        };
        self.resolved((sent, one), (handled, other), path);
    }

    /// Compares the shapes that two names stand for; the first of each pair is for words.
    fn resolved(&mut self, sent: (&'s Shape, &'s Shape), handled: (&'s Shape, &'s Shape), path: &Path) {
        match (sent.1, handled.1) {
            (Shape::Option(one), Shape::Option(other)) | (Shape::Newtype(one), Shape::Newtype(other)) => {
                self.shapes(one, other, path);
            }
            (Shape::List(one), Shape::List(other)) => self.shapes(one, other, &path.element("")),
            (Shape::Array(one, length), Shape::Array(other, of)) if length == of => {
                self.shapes(one, other, &path.element(""));
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
        let mut extra: Vec<_> = sent.iter().filter(|field| lacks(handled, &field.name)).collect();
        for missing in handled.iter().filter(|field| lacks(sent, &field.name)) {
            let shape = shown(self.handled, &missing.shape);
            let twin = extra.iter().position(|field| shown(self.sent, &field.shape) == shape);
            if let Some(twin) = twin {
                let (one, other) = (path.field(&extra.remove(twin).name), path.field(&missing.name));
                let words = format!(
                    "field {one} ({shape}) at the sender seems to be {other} ({shape}) at the receiver"
                );
                self.add(&other, Meaning::Conflict, words);
                continue;
            }
            let path = path.field(&missing.name);
            if missing.optional {
                let words = format!("field {path} is missing at the sender, which the receiver accepts");
                self.add(&path, Meaning::ReceiverHasMore, words);
            } else {
                self.add(&path, Meaning::Conflict, format!("field {path} is missing at the sender"));
            }
        }
        for field in extra {
            let path = path.field(&field.name);
            self.add(&path, Meaning::SenderHasMore, format!("field {path} is missing at the receiver"));
        }
    }

    fn variants(&mut self, sent: &'s [Variant], handled: &'s [Variant], path: &Path) {
        for variant in sent {
            let inner = path.field(&variant.name);
            match handled.iter().find(|other| other.name == variant.name) {
                Some(other) => {
                    self.resolved((&variant.shape, &variant.shape), (&other.shape, &other.shape), &inner);
                }
                None => {
                    let words = format!("variant {inner} is missing at the receiver");
                    self.add(&inner, Meaning::SenderHasMore, words);
                }
            }
        }
        for other in handled {
            if !sent.iter().any(|variant| variant.name == other.name) {
                let inner = path.field(&other.name);
                let words = format!("variant {inner} is missing at the sender");
                self.add(&inner, Meaning::ReceiverHasMore, words);
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
