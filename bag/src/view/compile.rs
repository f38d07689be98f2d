//! From a schema to the plan of its view.

#![expect(clippy::wildcard_enum_match_arm, reason = "most shapes are values")]

use std::collections::BTreeMap;

use sinew_schema::{Field, Schema, Shape, Variant};

use super::{
    EnumPlan, FieldPlan, Form, HEADER_FIELD, Kind, MessagePlan, View,
    names::{Fields, Types, camel, identifier, of_type},
};

/// Maximum nesting of shapes. A deeper one is JSON text.
const DEPTH_MAX: usize = 32;
/// Maximum messages and enums of a view, against schemas that were made to be large.
const TYPES_MAX: usize = 4_096;
/// Maximum fields of all messages of a view, and values of all enums.
const FIELDS_MAX: usize = 32_768;

/// Makes the plan. `None` where the schema has more types or fields than a view can.
pub(super) fn compile(type_name: &str, schema: &Schema) -> Option<View> {
    let (package, name) = of_type(type_name);
    let mut compiler = Compiler {
        schema,
        named: BTreeMap::new(),
        messages: Vec::new(),
        enums: Vec::new(),
        fields: 0,
        names: Types::default(),
        unit: None,
    };
    let root = compiler.root(&schema.root);
    // A field of the payload keeps its name; the types beside it give way.
    compiler.names.unique(super::descriptor::HEADER_NAME);
    match root {
        Shape::Struct(fields) => {
            compiler.reserve_fields(fields);
            compiler.structure(name, fields, DEPTH_MAX);
        }
        Shape::Unit => {
            compiler.message(name, Form::Unit, Vec::new());
        }
        other => {
            compiler.names.unique("value");
            let at = compiler.message(name, Form::Single, Vec::new());
            let kind = compiler.kind(other, "Value", DEPTH_MAX);
            compiler.add_field(at, field("value", kind, false));
        }
    }
    let is_full = compiler.is_full();
    let Compiler { messages, enums, .. } = compiler;
    let fields_max = HEADER_FIELD as usize - 1;
    let is_small = !is_full && messages.iter().all(|message| message.fields.len() <= fields_max);
    is_small.then_some(View { package, messages, enums })
}

fn field(name: &str, kind: Kind, is_optional: bool) -> FieldPlan {
    FieldPlan { wire: name.to_owned(), name: name.to_owned(), kind, is_optional }
}

struct Compiler<'s> {
    schema: &'s Schema,
    /// Messages and enums of named shapes, so that a type that contains itself ends.
    named: BTreeMap<&'s str, Kind>,
    messages: Vec<MessagePlan>,
    enums: Vec<EnumPlan>,
    /// Fields of all messages, and values of all enums.
    fields: usize,
    /// The names in the outermost message: its fields, and all nested types.
    names: Types,
    /// The message without fields.
    unit: Option<usize>,
}

impl<'s> Compiler<'s> {
    /// Returns the shape below names and newtypes.
    fn root(&self, mut shape: &'s Shape) -> &'s Shape {
        for _ in 0..DEPTH_MAX {
            shape = match shape {
                Shape::Newtype(inner) => inner,
                Shape::Named(name) => self.schema.types.get(name).unwrap_or(&Shape::Unit),
                other => other,
            };
        }
        shape
    }

    fn reserve_fields(&mut self, fields: &[Field]) {
        let mut scope = Fields::default();
        scope.unique(super::descriptor::HEADER_NAME);
        for field in fields {
            self.names.unique(&scope.unique(&identifier(&field.name)));
        }
    }

    fn is_full(&self) -> bool {
        self.messages.len() + self.enums.len() > TYPES_MAX || self.fields > FIELDS_MAX
    }

    fn add_field(&mut self, message: usize, plan: FieldPlan) {
        self.messages[message].fields.push(plan);
        self.fields += 1;
    }

    fn message(&mut self, name: String, form: Form, fields: Vec<FieldPlan>) -> usize {
        self.fields += fields.len();
        self.messages.push(MessagePlan { name, form, fields });
        self.messages.len() - 1
    }

    /// Adds the fields of a struct. Their numbers are their places.
    fn structure(&mut self, name: String, fields: &'s [Field], depth: usize) -> usize {
        let at = self.message(name, Form::Struct, Vec::new());
        let mut scope = Fields::default();
        if at == 0 {
            scope.unique(super::descriptor::HEADER_NAME);
        }
        for Field { name, shape, optional } in fields {
            if self.is_full() {
                break;
            }
            let kind = self.kind(shape, name, depth);
            let unique = scope.unique(&identifier(name));
            let is_optional = *optional || matches!(kind, Kind::Optional(_));
            let plan = FieldPlan { wire: name.clone(), name: unique, kind, is_optional };
            self.add_field(at, plan);
        }
        at
    }

    fn tuple(&mut self, name: String, shapes: &'s [Shape], depth: usize) -> usize {
        let at = self.message(name, Form::Tuple, Vec::new());
        for (place, shape) in shapes.iter().enumerate() {
            if self.is_full() {
                break;
            }
            let name = format!("item_{place}");
            let kind = self.kind(shape, &name, depth);
            self.add_field(at, field(&name, kind, false));
        }
        at
    }

    fn variants(&mut self, name: String, variants: &'s [Variant], depth: usize) -> usize {
        let at = self.message(name, Form::Variants, Vec::new());
        let mut scope = Fields::default();
        scope.unique(super::descriptor::ONE_OF);
        for Variant { name, shape } in variants {
            if self.is_full() {
                break;
            }
            let kind = self.kind(shape, name, depth);
            // One of several fields can be neither a list nor absent.
            let kind = self.wrapped(kind, name);
            let plan = FieldPlan {
                wire: name.clone(),
                name: scope.unique(&identifier(name)),
                kind,
                is_optional: true,
            };
            self.add_field(at, plan);
        }
        at
    }

    /// Returns a kind that can be repeated, be optional or be one of several.
    fn wrapped(&mut self, kind: Kind, context: &str) -> Kind {
        if !matches!(kind, Kind::Optional(_) | Kind::List(_)) {
            return kind;
        }
        let name = self.names.unique(&camel(&format!("{context} item")));
        Kind::Message(self.message(name, Form::Single, vec![field("value", kind, false)]))
    }

    /// Returns the kind of a shape. `context` names the types that have no name of their own.
    fn kind(&mut self, shape: &'s Shape, context: &str, depth: usize) -> Kind {
        if depth == 0 || self.is_full() {
            return Kind::Json;
        }
        match shape {
            Shape::Bool => Kind::Bool,
            Shape::I8 => Kind::Signed(8),
            Shape::I16 => Kind::Signed(16),
            Shape::I32 => Kind::Signed(32),
            Shape::I64 => Kind::Signed(64),
            Shape::U8 => Kind::Unsigned(8),
            Shape::U16 => Kind::Unsigned(16),
            Shape::U32 => Kind::Unsigned(32),
            Shape::U64 => Kind::Unsigned(64),
            Shape::I128 => Kind::Wide { is_signed: true },
            Shape::U128 => Kind::Wide { is_signed: false },
            Shape::F32 => Kind::Float,
            Shape::F64 => Kind::Double,
            Shape::Char | Shape::Text => Kind::Text,
            Shape::Bytes => Kind::Bytes,
            Shape::Map(..) => Kind::Json,
            Shape::Newtype(inner) => self.kind(inner, context, depth - 1),
            Shape::Option(inner) => {
                let inner = self.kind(inner, context, depth - 1);
                Kind::Optional(Box::new(self.wrapped(inner, context)))
            }
            Shape::List(inner) | Shape::Array(inner, _) => {
                let inner = self.kind(inner, context, depth - 1);
                Kind::List(Box::new(self.wrapped(inner, context)))
            }
            Shape::Named(name) => self.named(name, depth),
            Shape::Unit => self.unit(),
            Shape::Tuple(_) | Shape::Struct(_) | Shape::Enum(_) => self.typed(shape, context, depth),
        }
    }

    fn named(&mut self, name: &'s str, depth: usize) -> Kind {
        if let Some(kind) = self.named.get(name) {
            return kind.clone();
        }
        let Some(shape) = self.schema.types.get(name) else { return Kind::Json };
        match shape {
            Shape::Tuple(_) | Shape::Struct(_) | Shape::Enum(_) => {
                // Known before its fields are, because it may contain itself.
                let next = match shape {
                    Shape::Enum(variants) if is_plain(variants) => Kind::Enum(self.enums.len()),
                    _ => Kind::Message(self.messages.len()),
                };
                self.named.insert(name, next);
                self.typed(shape, name, depth)
            }
            _ => self.kind(shape, name, depth - 1),
        }
    }

    /// Adds the message or the enum of a shape. Its number is the next one.
    fn typed(&mut self, shape: &'s Shape, context: &str, depth: usize) -> Kind {
        let name = self.names.unique(&camel(context));
        match shape {
            Shape::Enum(variants) if is_plain(variants) => {
                let mut scope = Fields::default();
                let value =
                    |variant: &Variant| (variant.name.clone(), scope.unique(&identifier(&variant.name)));
                let values = variants.iter().map(value).collect();
                self.fields += variants.len();
                self.enums.push(EnumPlan { name, values });
                Kind::Enum(self.enums.len() - 1)
            }
            Shape::Enum(variants) => Kind::Message(self.variants(name, variants, depth - 1)),
            Shape::Struct(fields) => Kind::Message(self.structure(name, fields, depth - 1)),
            Shape::Tuple(shapes) => Kind::Message(self.tuple(name, shapes, depth - 1)),
            _ => self.unit(),
        }
    }

    fn unit(&mut self) -> Kind {
        if let Some(at) = self.unit {
            return Kind::Message(at);
        }
        let name = self.names.unique("Empty");
        let at = self.message(name, Form::Unit, Vec::new());
        self.unit = Some(at);
        Kind::Message(at)
    }
}

/// Returns whether no variant has data. An enum without any variant has no values.
fn is_plain(variants: &[Variant]) -> bool {
    !variants.is_empty() && variants.iter().all(|variant| variant.shape == Shape::Unit)
}
