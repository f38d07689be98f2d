//! The structure of a type while it is traced: nodes that are still unknown, and named types with their parts.

use std::collections::{BTreeMap, BTreeSet};

use super::ReadError;
use crate::shape::{Field, Schema, Shape, Variant};

/// Maximum number of nodes of one type.
const NODES_MAX: usize = 4_096;

/// The position of a node in [`Graph::nodes`].
pub(super) type At = usize;

/// A value's structure.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Node {
    /// Not traced so far.
    Unknown,
    /// A value without parts.
    Leaf(Shape),
    Option(At),
    List(At),
    Map(At, At),
    Tuple(Vec<At>),
    /// A long array: all its elements have one node.
    Array(At, usize),
    Named(&'static str),
}

/// The parts of a struct or of a variant.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Content {
    Unit,
    Newtype(At),
    Tuple(Vec<At>),
    Struct(Vec<(&'static str, At)>),
}

/// A variant of an enum.
#[derive(Debug)]
pub(super) struct Case {
    pub(super) name: &'static str,
    /// `None`: not traced so far.
    pub(super) content: Option<Content>,
    /// The hash of its discriminant, and the steps that its value took, once one was read.
    pub(super) read: Option<(u64, usize)>,
    /// Whether a value was written with this name. An alias never is.
    pub(super) is_written: bool,
}

/// A type with a name.
#[derive(Debug)]
pub(super) enum Def {
    Plain(Content),
    Enum(Vec<Case>),
}

/// A struct or variant: the type's name, and the variant's position.
pub(super) type Owner = (&'static str, Option<usize>);

#[derive(Debug)]
pub(super) struct Graph {
    nodes: Vec<Node>,
    pub(super) defs: BTreeMap<&'static str, Def>,
    /// Whether a receiver accepts a message without the field, by its owner and its position.
    pub(super) optional: BTreeMap<(Owner, usize), bool>,
}

impl Graph {
    /// Creates the graph of a type: node 0 is the type itself.
    pub(super) fn new() -> Self {
        Self { nodes: vec![Node::Unknown], defs: BTreeMap::new(), optional: BTreeMap::new() }
    }

    pub(super) fn node(&self, at: At) -> &Node {
        &self.nodes[at]
    }

    /// Adds `count` unknown nodes.
    pub(super) fn add(&mut self, count: usize) -> Result<Vec<At>, ReadError> {
        let first = self.nodes.len();
        if count > NODES_MAX - first.min(NODES_MAX) {
            return Err(ReadError::words(format!("it has more than {NODES_MAX} parts")));
        }
        self.nodes.resize(first + count, Node::Unknown);
        Ok((first..first + count).collect())
    }

    /// Sets an unknown node, or checks that it is the same as before.
    pub(super) fn set(&mut self, at: At, node: Node) -> Result<(), ReadError> {
        if self.nodes[at] == Node::Unknown {
            self.nodes[at] = node;
        } else if self.nodes[at] != node {
            let words =
                "two types inside it have the same name, or a type is not always read in the same way";
            return Err(ReadError::words(words.to_owned()));
        }
        Ok(())
    }

    /// Returns the number of things that are known: it grows with each run that finds something.
    pub(super) fn known(&self) -> usize {
        let nodes = self.nodes.iter().filter(|node| **node != Node::Unknown).count();
        let cases = self.defs.values().map(|def| match def {
            Def::Plain(_) => 1,
            Def::Enum(cases) => cases.iter().filter(|case| case.read.is_some()).count(),
        });
        nodes + cases.sum::<usize>()
    }

    /// Returns whether something is still unknown at `at` or below it.
    pub(super) fn has_unknown(&self, at: At) -> bool {
        let (mut open, mut seen) = (vec![at], BTreeSet::new());
        while let Some(next) = open.pop() {
            let node = self.node(next);
            if *node == Node::Unknown {
                return true;
            }
            let Node::Named(name) = node else {
                open.extend(parts(node));
                continue;
            };
            if seen.insert(*name) {
                match self.defs.get(name) {
                    Some(Def::Enum(cases)) if cases.iter().any(|case| case.read.is_none()) => return true,
                    Some(def) => open.extend(parts_of(def)),
                    None => return true,
                }
            }
        }
        false
    }

    /// Returns whether something is unknown below the parts of a variant.
    pub(super) fn content_has_unknown(&self, content: &Content) -> bool {
        content_parts(content).into_iter().any(|at| self.has_unknown(at))
    }

    /// Describes the first part that is still unknown, for an error.
    pub(super) fn unknown_type(&self) -> String {
        let unread = self.defs.iter().find_map(|(name, def)| match def {
            Def::Enum(cases) => cases.iter().find(|case| case.read.is_none()).map(|case| (name, case.name)),
            Def::Plain(_) => None,
        });
        match unread {
            Some((name, case)) => format!("variant `{case}` of {name} cannot be reached"),
            None => "a part of it cannot be reached".to_owned(),
        }
    }

    /// Returns the schema.
    pub(super) fn schema(&self) -> Schema {
        let mut types = BTreeMap::new();
        let mut root = self.shape(0, &mut types);
        if let (Shape::Named(name), Node::Named(defined)) = (&root, self.node(0))
            && let Some(def) = self.defs.get(defined)
            && !self.occurs_in_itself(defined)
        {
            let inner = self.def_shape(defined, def, &mut BTreeMap::new());
            types.remove(name);
            root = inner;
        }
        Schema { root, types }
    }

    fn occurs_in_itself(&self, name: &'static str) -> bool {
        let Some(def) = self.defs.get(name) else { return false };
        let mut open = parts_of(def);
        let mut seen = BTreeSet::new();
        while let Some(next) = open.pop() {
            let Node::Named(inner) = self.node(next) else {
                open.extend(parts(self.node(next)));
                continue;
            };
            if *inner == name {
                return true;
            }
            if seen.insert(*inner) {
                open.extend(self.defs.get(inner).into_iter().flat_map(parts_of));
            }
        }
        false
    }

    fn shape(&self, at: At, types: &mut BTreeMap<String, Shape>) -> Shape {
        match self.node(at) {
            // `Tracer::is_complete` has ruled it out.
            Node::Unknown => Shape::Unit,
            Node::Leaf(shape) => shape.clone(),
            Node::Option(inner) => Shape::Option(Box::new(self.shape(*inner, types))),
            Node::List(inner) => Shape::List(Box::new(self.shape(*inner, types))),
            Node::Map(key, value) => {
                let key = Box::new(self.shape(*key, types));
                Shape::Map(key, Box::new(self.shape(*value, types)))
            }
            Node::Tuple(parts) => self.tuple(parts, types),
            Node::Array(inner, length) => Shape::Array(Box::new(self.shape(*inner, types)), *length),
            Node::Named(name) => {
                if !types.contains_key(*name)
                    && let Some(def) = self.defs.get(name)
                {
                    // Recorded first, for a type that occurs in itself.
                    types.insert((*name).to_owned(), Shape::Unit);
                    let shape = self.def_shape(name, def, types);
                    types.insert((*name).to_owned(), shape);
                }
                Shape::Named((*name).to_owned())
            }
        }
    }

    /// Returns an array for elements of one structure: serde reads both in the same way.
    fn tuple(&self, parts: &[At], types: &mut BTreeMap<String, Shape>) -> Shape {
        let shapes: Vec<_> = parts.iter().map(|part| self.shape(*part, types)).collect();
        match shapes.split_first() {
            Some((first, rest)) if !rest.is_empty() && rest.iter().all(|shape| shape == first) => {
                Shape::Array(Box::new(first.clone()), shapes.len())
            }
            _ => Shape::Tuple(shapes),
        }
    }

    fn def_shape(&self, name: &'static str, def: &Def, types: &mut BTreeMap<String, Shape>) -> Shape {
        match def {
            Def::Plain(content) => self.content_shape((name, None), content, types),
            Def::Enum(cases) => {
                let is_alias = |case: &Case| {
                    let twin = |other: &&Case| other.is_written && same_discriminant(other, case);
                    !case.is_written && cases.iter().any(|other| twin(&other))
                };
                let mut variants = Vec::new();
                for (index, case) in cases.iter().enumerate().filter(|(_, case)| !is_alias(case)) {
                    let shape = case.content.as_ref().map_or(Shape::Unit, |content| {
                        self.content_shape((name, Some(index)), content, types)
                    });
                    variants.push(Variant { name: case.name.to_owned(), shape });
                }
                Shape::Enum(variants)
            }
        }
    }

    fn content_shape(&self, owner: Owner, content: &Content, types: &mut BTreeMap<String, Shape>) -> Shape {
        match content {
            Content::Unit => Shape::Unit,
            Content::Newtype(at) => Shape::Newtype(Box::new(self.shape(*at, types))),
            // Never an array: the same parts with names would be a struct.
            Content::Tuple(parts) => {
                Shape::Tuple(parts.iter().map(|part| self.shape(*part, types)).collect())
            }
            Content::Struct(fields) => {
                let field = |(index, (name, at)): (usize, &(&'static str, At))| Field {
                    name: (*name).to_owned(),
                    shape: self.shape(*at, types),
                    optional: self.optional.get(&(owner, index)).copied().unwrap_or(false),
                };
                Shape::Struct(fields.iter().enumerate().map(field).collect())
            }
        }
    }
}

fn same_discriminant(one: &Case, other: &Case) -> bool {
    matches!((one.read, other.read), (Some((one, _)), Some((other, _))) if one == other)
}

/// Returns the nodes directly below one.
pub(super) fn parts(node: &Node) -> Vec<At> {
    match node {
        Node::Unknown | Node::Leaf(_) | Node::Named(_) => Vec::new(),
        Node::Option(at) | Node::List(at) | Node::Array(at, _) => vec![*at],
        Node::Map(key, value) => vec![*key, *value],
        Node::Tuple(parts) => parts.clone(),
    }
}

/// Returns the nodes of a struct or a variant.
pub(super) fn content_parts(content: &Content) -> Vec<At> {
    match content {
        Content::Unit => Vec::new(),
        Content::Newtype(at) => vec![*at],
        Content::Tuple(parts) => parts.clone(),
        Content::Struct(fields) => fields.iter().map(|(_, at)| *at).collect(),
    }
}

fn parts_of(def: &Def) -> Vec<At> {
    match def {
        Def::Plain(content) => content_parts(content),
        Def::Enum(cases) => {
            cases.iter().filter_map(|case| case.content.as_ref()).flat_map(content_parts).collect()
        }
    }
}
