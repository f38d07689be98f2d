//! The deserializer that has no bytes: it notes which value a type asks for, and gives it one.

use std::{
    collections::hash_map::DefaultHasher,
    hash::{Hash as _, Hasher as _},
    mem::discriminant,
};

use serde::de::{Deserializer, Visitor};

use super::{
    ReadError, Tracer,
    access::{Elements, Fields, Variants},
    graph::{At, Case, Content, Def, Node, Owner, content_parts, parts},
    sample::Sample,
};
use crate::shape::Shape;

/// Maximum depth of values, as the decoder of messages has it.
const DEPTH_MAX: usize = 64;
/// Number of elements up to which each one has a node of its own. serde reads tuples of at most 16.
const TUPLE_MAX: usize = 16;

/// Reads one value.
pub(super) struct Reading<'t> {
    pub(super) tracer: &'t mut Tracer,
    pub(super) at: At,
    pub(super) depth: usize,
}

impl<'t> Reading<'t> {
    pub(super) const fn of_root(tracer: &'t mut Tracer) -> Self {
        Self { tracer, at: 0, depth: 0 }
    }

    /// Notes a value without parts, and the value that it was given.
    fn leaf(&mut self, shape: Shape, sample: Sample) -> Result<(), ReadError> {
        self.note(Node::Leaf(shape))?;
        self.tracer.samples.push(sample);
        Ok(())
    }

    fn note(&mut self, node: Node) -> Result<(), ReadError> {
        self.tracer.step()?;
        if self.depth > DEPTH_MAX {
            return Err(ReadError::words(format!("its values are nested deeper than {DEPTH_MAX} levels")));
        }
        self.tracer.graph.set(self.at, node)
    }

    /// Notes a node with parts, and returns these. They are added if the node was unknown.
    fn node_with(
        &mut self,
        count: usize,
        make: impl FnOnce(&[At]) -> Node,
        known: impl FnOnce(&Node) -> Option<Vec<At>>,
    ) -> Result<Vec<At>, ReadError> {
        let node = self.tracer.graph.node(self.at);
        let parts = if *node == Node::Unknown {
            self.tracer.graph.add(count)?
        } else {
            known(node).unwrap_or_default()
        };
        let node = if parts.len() == count { make(&parts) } else { Node::Unknown };
        self.note(node)?;
        Ok(parts)
    }

    /// Notes the name of a type, and its parts if it is new.
    fn named(
        &mut self,
        name: &'static str,
        content: impl FnOnce(&[At]) -> Content,
        count: usize,
    ) -> Result<Content, ReadError> {
        self.note(Node::Named(name))?;
        if !self.tracer.graph.defs.contains_key(name) {
            let parts = self.tracer.graph.add(count)?;
            self.tracer.graph.defs.insert(name, Def::Plain(content(&parts)));
            return self.known(name);
        }
        let found = self.known(name)?;
        let parts = content_parts(&found);
        if parts.len() != count || content(&parts) != found {
            return Err(two_of(name));
        }
        Ok(found)
    }

    fn known(&self, name: &'static str) -> Result<Content, ReadError> {
        match self.tracer.graph.defs.get(name) {
            Some(Def::Plain(content)) => Ok(content.clone()),
            Some(Def::Enum(_)) | None => Err(two_of(name)),
        }
    }

    /// Reads a list or tuple.
    pub(super) fn sequence<'de, V: Visitor<'de>>(
        self,
        parts: &[At],
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        let Self { tracer, depth, .. } = self;
        let first = tracer.samples.len();
        let value = visitor.visit_seq(Elements { tracer: &mut *tracer, parts, depth: depth + 1 })?;
        let values = take(tracer, first);
        tracer.samples.push(Sample::List(values));
        Ok(value)
    }

    /// Reads the fields of a struct or a variant by their names.
    pub(super) fn fields<'de, V: Visitor<'de>>(
        self,
        owner: Owner,
        fields: &[(&'static str, At)],
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        let Self { tracer, depth, .. } = self;
        let mut last = None;
        let first = tracer.samples.len();
        let access = Fields { tracer: &mut *tracer, fields, next: 0, last: &mut last, depth: depth + 1 };
        let read = visitor.visit_map(access);
        let value = read.map_err(|trouble| match (trouble, last) {
            (ReadError::Twice { owner: None, name, .. }, Some(given)) => {
                ReadError::Twice { owner: Some(owner), name, given }
            }
            (trouble, _) => trouble,
        })?;
        let values = take(tracer, first);
        if values.len() != fields.len() {
            return Err(ReadError::words(format!("its part {} does not read all its fields", owner.0)));
        }
        let values = values.into_iter().zip(fields).enumerate();
        let values = values.map(|(index, (value, (name, _)))| (index, *name, value)).collect();
        tracer.samples.push(Sample::Struct(owner, values));
        Ok(value)
    }

    /// Returns whether the parts below an option, a list or a map are to be read.
    fn is_to_be_read(&self, parts: &[At]) -> bool {
        parts.iter().any(|part| self.tracer.graph.has_unknown(*part))
            && !parts.iter().any(|part| self.tracer.open_nodes.contains(part))
    }
}

/// Returns the error for two types of one name.
pub(super) fn two_of(name: &str) -> ReadError {
    ReadError::words(format!("two types inside it have the name {name}"))
}

fn take(tracer: &mut Tracer, first: usize) -> Vec<Sample> {
    tracer.samples.split_off(first.min(tracer.samples.len()))
}

/// Numbers: the type's name, the value that it is given, and its form in the sample.
macro_rules! numbers {
    ($($method:ident $visit:ident $shape:ident $sample:ident)*) => {$(
        fn $method<V: Visitor<'de>>(mut self, visitor: V) -> Result<V::Value, ReadError> {
            let number = self.tracer.filler.number;
            self.leaf(Shape::$shape, Sample::$sample(number))?;
            visitor.$visit(number.into())
        }
    )*};
}

impl<'de> Deserializer<'de> for Reading<'_> {
    type Error = ReadError;

    numbers! {
        deserialize_u8 visit_u8 U8 Int
        deserialize_u16 visit_u16 U16 Int
        deserialize_u32 visit_u32 U32 Int
        deserialize_u64 visit_u64 U64 Int
        deserialize_u128 visit_u128 U128 Wide
        deserialize_i16 visit_i16 I16 Int
        deserialize_i32 visit_i32 I32 Int
        deserialize_i64 visit_i64 I64 Int
        deserialize_i128 visit_i128 I128 Wide
        deserialize_f32 visit_f32 F32 F32
        deserialize_f64 visit_f64 F64 F64
    }

    fn deserialize_any<V: Visitor<'de>>(self, _: V) -> Result<V::Value, ReadError> {
        Err(ReadError::words(
            "it has no fixed structure (flatten, untagged, tag, or its own Deserialize)".to_owned(),
        ))
    }

    fn deserialize_bool<V: Visitor<'de>>(mut self, visitor: V) -> Result<V::Value, ReadError> {
        self.leaf(Shape::Bool, Sample::Bool)?;
        visitor.visit_bool(false)
    }

    fn deserialize_i8<V: Visitor<'de>>(mut self, visitor: V) -> Result<V::Value, ReadError> {
        let number = self.tracer.filler.number;
        self.leaf(Shape::I8, Sample::Int(number))?;
        visitor.visit_i8(number.cast_signed())
    }

    fn deserialize_char<V: Visitor<'de>>(mut self, visitor: V) -> Result<V::Value, ReadError> {
        self.leaf(Shape::Char, Sample::Text("a"))?;
        visitor.visit_char('a')
    }

    fn deserialize_str<V: Visitor<'de>>(mut self, visitor: V) -> Result<V::Value, ReadError> {
        let text = self.tracer.filler.text;
        self.leaf(Shape::Text, Sample::Text(text))?;
        visitor.visit_borrowed_str(text)
    }

    fn deserialize_string<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ReadError> {
        self.deserialize_str(visitor)
    }

    fn deserialize_bytes<V: Visitor<'de>>(mut self, visitor: V) -> Result<V::Value, ReadError> {
        self.leaf(Shape::Bytes, Sample::Bytes)?;
        visitor.visit_borrowed_bytes(&[])
    }

    fn deserialize_byte_buf<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, ReadError> {
        self.deserialize_bytes(visitor)
    }

    fn deserialize_option<V: Visitor<'de>>(mut self, visitor: V) -> Result<V::Value, ReadError> {
        let known = |node: &Node| matches!(node, Node::Option(_)).then(|| parts(node));
        let parts = self.node_with(1, |parts| Node::Option(parts[0]), known)?;
        if !self.is_to_be_read(&parts) {
            self.tracer.samples.push(Sample::Nil);
            return visitor.visit_none();
        }
        self.tracer.open_nodes.extend(&parts);
        let Self { tracer, depth, .. } = self;
        let value = visitor.visit_some(Reading { tracer: &mut *tracer, at: parts[0], depth: depth + 1 })?;
        parts.iter().for_each(|part| _ = tracer.open_nodes.remove(part));
        Ok(value)
    }

    fn deserialize_unit<V: Visitor<'de>>(mut self, visitor: V) -> Result<V::Value, ReadError> {
        self.leaf(Shape::Unit, Sample::Nil)?;
        visitor.visit_unit()
    }

    fn deserialize_unit_struct<V: Visitor<'de>>(
        mut self,
        name: &'static str,
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        self.named(name, |_| Content::Unit, 0)?;
        self.tracer.samples.push(Sample::List(Vec::new()));
        visitor.visit_unit()
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(
        mut self,
        name: &'static str,
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        let Content::Newtype(at) = self.named(name, |parts| Content::Newtype(parts[0]), 1)? else {
            return Err(two_of(name));
        };
        visitor.visit_newtype_struct(Reading { tracer: self.tracer, at, depth: self.depth + 1 })
    }

    fn deserialize_seq<V: Visitor<'de>>(mut self, visitor: V) -> Result<V::Value, ReadError> {
        let known = |node: &Node| matches!(node, Node::List(_)).then(|| parts(node));
        let parts = self.node_with(1, |parts| Node::List(parts[0]), known)?;
        let given: &[At] = if self.is_to_be_read(&parts) { &parts } else { &[] };
        self.tracer.open_nodes.extend(given);
        let Self { tracer, at, depth } = self;
        let value = Reading { tracer: &mut *tracer, at, depth }.sequence(given, visitor)?;
        given.iter().for_each(|part| _ = tracer.open_nodes.remove(part));
        Ok(value)
    }

    fn deserialize_tuple<V: Visitor<'de>>(
        mut self,
        length: usize,
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        if length > TUPLE_MAX {
            let known = |node: &Node| matches!(node, Node::Array(..)).then(|| parts(node));
            let parts = self.node_with(1, |parts| Node::Array(parts[0], length), known)?;
            if length > super::STEPS_MAX {
                return Err(ReadError::words("it has an array that is too long".to_owned()));
            }
            return self.sequence(&vec![parts[0]; length], visitor);
        }
        let known = |node: &Node| matches!(node, Node::Tuple(_)).then(|| parts(node));
        let parts = self.node_with(length, |parts| Node::Tuple(parts.to_vec()), known)?;
        self.sequence(&parts, visitor)
    }

    fn deserialize_tuple_struct<V: Visitor<'de>>(
        mut self,
        name: &'static str,
        length: usize,
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        let Content::Tuple(parts) = self.named(name, |parts| Content::Tuple(parts.to_vec()), length)? else {
            return Err(two_of(name));
        };
        self.sequence(&parts, visitor)
    }

    fn deserialize_map<V: Visitor<'de>>(mut self, visitor: V) -> Result<V::Value, ReadError> {
        let known = |node: &Node| matches!(node, Node::Map(..)).then(|| parts(node));
        let parts = self.node_with(2, |parts| Node::Map(parts[0], parts[1]), known)?;
        let given: &[At] = if self.is_to_be_read(&parts) { &parts } else { &[] };
        self.tracer.open_nodes.extend(given);
        let Self { tracer, depth, .. } = self;
        let first = tracer.samples.len();
        let value = visitor.visit_map(Elements { tracer: &mut *tracer, parts: given, depth: depth + 1 })?;
        let values = take(tracer, first);
        tracer.samples.push(Sample::Map(values));
        given.iter().for_each(|part| _ = tracer.open_nodes.remove(part));
        Ok(value)
    }

    fn deserialize_struct<V: Visitor<'de>>(
        mut self,
        name: &'static str,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        let owner = (name, None);
        let names = self.tracer.aliases.own_fields(owner, fields);
        let content =
            |parts: &[At]| Content::Struct(names.iter().copied().zip(parts.iter().copied()).collect());
        let Content::Struct(fields) = self.named(name, content, names.len())? else {
            return Err(two_of(name));
        };
        self.fields(owner, &fields, visitor)
    }

    fn deserialize_enum<V: Visitor<'de>>(
        mut self,
        name: &'static str,
        variants: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        self.note(Node::Named(name))?;
        let unread = |&name: &&'static str| Case { name, content: None, read: None, is_written: false };
        let def = self.tracer.graph.defs.entry(name);
        let def = def.or_insert_with(|| Def::Enum(variants.iter().map(unread).collect()));
        match def {
            Def::Enum(cases) if cases.iter().map(|case| case.name).eq(variants.iter().copied()) => {}
            Def::Enum(_) | Def::Plain(_) => return Err(two_of(name)),
        }
        let index = self.tracer.choose(name);
        let Some(&case) = variants.get(index) else {
            return Err(ReadError::words(format!("the enum {name} has no variants")));
        };
        let (tracer, depth) = (self.tracer, self.depth);
        let before = tracer.steps;
        tracer.open_cases.push((name, index));
        let value = visitor.visit_enum(Variants {
            tracer: &mut *tracer,
            owner: (name, index),
            case,
            depth: depth + 1,
        })?;
        tracer.open_cases.pop();
        let mut hasher = DefaultHasher::new();
        discriminant(&value).hash(&mut hasher);
        let steps = tracer.steps - before;
        if let Some(Def::Enum(cases)) = tracer.graph.defs.get_mut(name)
            && let Some(case) = cases.get_mut(index)
        {
            let least = case.read.map_or(steps, |(_, least)| least.min(steps));
            case.read = Some((hasher.finish(), least));
        }
        Ok(value)
    }

    fn deserialize_identifier<V: Visitor<'de>>(self, _: V) -> Result<V::Value, ReadError> {
        Err(ReadError::words("it has no fixed structure (flatten, or its own Deserialize)".to_owned()))
    }

    fn deserialize_ignored_any<V: Visitor<'de>>(self, _: V) -> Result<V::Value, ReadError> {
        Err(ReadError::words("it skips a value (its own Deserialize)".to_owned()))
    }

    fn is_human_readable(&self) -> bool {
        false
    }
}
