//! The inner values of lists, maps, structs and variants, while a type is read without bytes.

use serde::de::{
    DeserializeSeed, EnumAccess, MapAccess, SeqAccess, VariantAccess, Visitor, value::BorrowedStrDeserializer,
};

use super::{
    ReadError, Tracer,
    de::{Reading, two_of},
    graph::{At, Content, Def, content_parts},
    sample::Sample,
};

/// The elements of a list or tuple, or the keys and values of a map.
pub(super) struct Elements<'t, 'p> {
    pub(super) tracer: &'t mut Tracer,
    pub(super) parts: &'p [At],
    pub(super) depth: usize,
}

impl Elements<'_, '_> {
    fn next<'de, S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<Option<S::Value>, ReadError> {
        let Some((at, rest)) = self.parts.split_first() else { return Ok(None) };
        self.parts = rest;
        seed.deserialize(Reading { tracer: &mut *self.tracer, at: *at, depth: self.depth }).map(Some)
    }
}

impl<'de> SeqAccess<'de> for Elements<'_, '_> {
    type Error = ReadError;

    fn next_element_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<Option<S::Value>, ReadError> {
        self.next(seed)
    }

    fn size_hint(&self) -> Option<usize> {
        Some(self.parts.len())
    }
}

impl<'de> MapAccess<'de> for Elements<'_, '_> {
    type Error = ReadError;

    fn next_key_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<Option<S::Value>, ReadError> {
        self.next(seed)
    }

    fn next_value_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<S::Value, ReadError> {
        self.next(seed)?.ok_or_else(|| ReadError::words("it reads a value without a key".to_owned()))
    }
}

/// The fields of a struct, by their names.
pub(super) struct Fields<'t, 'f> {
    pub(super) tracer: &'t mut Tracer,
    pub(super) fields: &'f [(&'static str, At)],
    pub(super) next: usize,
    /// The name that was given last.
    pub(super) last: &'f mut Option<&'static str>,
    pub(super) depth: usize,
}

impl<'de> MapAccess<'de> for Fields<'_, '_> {
    type Error = ReadError;

    fn next_key_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<Option<S::Value>, ReadError> {
        let Some(&(name, _)) = self.fields.get(self.next) else { return Ok(None) };
        *self.last = Some(name);
        seed.deserialize(BorrowedStrDeserializer::new(name)).map(Some)
    }

    fn next_value_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<S::Value, ReadError> {
        let Some((_, at)) = self.fields.get(self.next) else {
            return Err(ReadError::words("it reads a value without a key".to_owned()));
        };
        self.next += 1;
        seed.deserialize(Reading { tracer: &mut *self.tracer, at: *at, depth: self.depth })
    }
}

/// One variant of an enum.
pub(super) struct Variants<'t> {
    pub(super) tracer: &'t mut Tracer,
    /// The enum, and the position of the variant.
    pub(super) owner: (&'static str, usize),
    pub(super) case: &'static str,
    pub(super) depth: usize,
}

impl Variants<'_> {
    /// Notes the parts of the variant, or checks that they are those from before.
    fn content(&mut self, count: usize, make: impl FnOnce(&[At]) -> Content) -> Result<Content, ReadError> {
        let (name, index) = self.owner;
        let case = |def: &Def| match def {
            Def::Enum(cases) => cases.get(index).and_then(|case| case.content.clone()),
            Def::Plain(_) => None,
        };
        let known = self.tracer.graph.defs.get(name).and_then(case);
        let parts = match &known {
            None => self.tracer.graph.add(count)?,
            Some(content) => content_parts(content),
        };
        if parts.len() != count {
            return Err(two_of(name));
        }
        let content = make(&parts);
        if known.as_ref().is_some_and(|known| *known != content) {
            return Err(two_of(name));
        }
        if let Some(Def::Enum(cases)) = self.tracer.graph.defs.get_mut(name)
            && let Some(case) = cases.get_mut(index)
        {
            case.content = Some(content.clone());
        }
        Ok(content)
    }

    /// Puts the sample of the variant's content below its name.
    fn wrap(tracer: &mut Tracer, case: &'static str) {
        if let Some(sample) = tracer.samples.pop() {
            tracer.samples.push(Sample::Variant(case, Box::new(sample)));
        }
    }
}

impl<'de> EnumAccess<'de> for Variants<'_> {
    type Error = ReadError;
    type Variant = Self;

    fn variant_seed<S: DeserializeSeed<'de>>(self, seed: S) -> Result<(S::Value, Self), ReadError> {
        let value = seed.deserialize(BorrowedStrDeserializer::new(self.case))?;
        Ok((value, self))
    }
}

impl<'de> VariantAccess<'de> for Variants<'_> {
    type Error = ReadError;

    fn unit_variant(mut self) -> Result<(), ReadError> {
        self.content(0, |_| Content::Unit)?;
        self.tracer.samples.push(Sample::Text(self.case));
        Ok(())
    }

    fn newtype_variant_seed<S: DeserializeSeed<'de>>(mut self, seed: S) -> Result<S::Value, ReadError> {
        let Content::Newtype(at) = self.content(1, |parts| Content::Newtype(parts[0]))? else {
            return Err(two_of(self.owner.0));
        };
        let Self { tracer, case, depth, .. } = self;
        let value = seed.deserialize(Reading { tracer: &mut *tracer, at, depth })?;
        Self::wrap(tracer, case);
        Ok(value)
    }

    fn tuple_variant<V: Visitor<'de>>(mut self, length: usize, visitor: V) -> Result<V::Value, ReadError> {
        let Content::Tuple(parts) = self.content(length, |parts| Content::Tuple(parts.to_vec()))? else {
            return Err(two_of(self.owner.0));
        };
        let Self { tracer, case, depth, .. } = self;
        let value = Reading { tracer: &mut *tracer, at: 0, depth }.sequence(&parts, visitor)?;
        Self::wrap(tracer, case);
        Ok(value)
    }

    fn struct_variant<V: Visitor<'de>>(
        mut self,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        let owner = (self.owner.0, Some(self.owner.1));
        let names = self.tracer.aliases.own_fields(owner, fields);
        let content =
            |parts: &[At]| Content::Struct(names.iter().copied().zip(parts.iter().copied()).collect());
        let Content::Struct(fields) = self.content(names.len(), content)? else {
            return Err(two_of(self.owner.0));
        };
        let Self { tracer, case, depth, .. } = self;
        let value = Reading { tracer: &mut *tracer, at: 0, depth }.fields(owner, &fields, visitor)?;
        Self::wrap(tracer, case);
        Ok(value)
    }
}
