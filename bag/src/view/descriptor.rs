//! The description of a view: a `FileDescriptorSet`, written field by field as `descriptor.proto` numbers them.

#![expect(clippy::wildcard_enum_match_arm, reason = "most kinds are values")]

use super::{EnumPlan, FieldPlan, Form, HEADER_FIELD, HEADER_FIELDS, HEADER_TYPE, Kind, MessagePlan, View};
use crate::protobuf::Output;

/// The name of the field with the header. A field of the payload with this name gets another one.
pub(super) const HEADER_NAME: &str = "sinew";
/// The name of the group of variants.
pub(super) const ONE_OF: &str = "variant";
/// The file that describes the header.
const HEADER_FILE: &str = "sinew_bag.proto";

// Types of fields in `descriptor.proto`.
const DOUBLE: u64 = 1;
const FLOAT: u64 = 2;
const UINT64: u64 = 4;
const BOOL: u64 = 8;
const STRING: u64 = 9;
const MESSAGE: u64 = 11;
const BYTES: u64 = 12;
const UINT32: u64 = 13;
const ENUM: u64 = 14;
const SINT32: u64 = 17;
const SINT64: u64 = 18;

// Labels of fields.
const SINGLE: u64 = 1;
const REPEATED: u64 = 3;

/// A `FieldDescriptorProto`.
#[derive(Default)]
struct Described<'d> {
    name: &'d str,
    number: u32,
    label: u64,
    kind: u64,
    type_name: Option<String>,
    /// The group of which it is one.
    one_of: Option<u64>,
    /// Whether it was declared as `optional`. It then is alone in its group.
    is_optional: bool,
}

impl Described<'_> {
    fn write(&self, out: &mut Output) {
        out.message(2, |field| {
            field.text(1, self.name);
            field.unsigned(3, self.number.into());
            field.unsigned(4, self.label);
            field.unsigned(5, self.kind);
            if let Some(name) = &self.type_name {
                field.text(6, name);
            }
            if let Some(group) = self.one_of {
                field.unsigned(9, group);
            }
            if self.is_optional {
                field.unsigned(17, 1);
            }
        });
    }
}

/// Returns the description of the view, and of the header that it refers to.
pub(super) fn of_view(view: &View) -> Vec<u8> {
    let mut out = Output::default();
    out.message(1, header_file);
    out.message(1, |file| {
        let root = &view.messages[0].name;
        file.text(1, &format!("{}/{root}.proto", view.package.replace('.', "/")));
        file.text(2, &view.package);
        file.text(3, HEADER_FILE);
        file.message(4, |message| {
            fields(view, &view.messages[0], true, message);
            for nested in &view.messages[1..] {
                message.message(3, |message| fields(view, nested, false, message));
            }
            for nested in &view.enums {
                message.message(3, |message| values(nested, message));
            }
            groups(&view.messages[0], message);
        });
        file.text(12, "proto3");
    });
    out.0
}

/// Returns the description of the header alone.
pub(super) fn of_header() -> Vec<u8> {
    let mut out = Output::default();
    out.message(1, header_file);
    out.0
}

fn header_file(file: &mut Output) {
    let (package, name) = HEADER_TYPE.split_once('.').unwrap_or(("", HEADER_TYPE));
    file.text(1, HEADER_FILE);
    file.text(2, package);
    file.message(4, |message| {
        message.text(1, name);
        for (number, name) in HEADER_FIELDS {
            let kind = match name {
                "age_ns" => SINT64,
                "misfit" => STRING,
                _ => UINT64,
            };
            Described { name, number, label: SINGLE, kind, ..Described::default() }.write(message);
        }
    });
    file.text(12, "proto3");
}

/// Writes the name and the fields of a `DescriptorProto`; of a nested one its groups, too.
fn fields(view: &View, plan: &MessagePlan, is_root: bool, out: &mut Output) {
    out.text(1, &plan.name);
    let mut optional = 0;
    for (number, field) in (1..).zip(&plan.fields) {
        let mut described = described(view, field, number);
        if plan.form == Form::Variants {
            described.one_of = Some(0);
        } else if described.is_optional {
            described.one_of = Some(optional);
            optional += 1;
        }
        described.write(out);
    }
    if is_root {
        let type_name = Some(format!(".{HEADER_TYPE}"));
        let label = SINGLE;
        Described {
            name: HEADER_NAME,
            number: HEADER_FIELD,
            label,
            kind: MESSAGE,
            type_name,
            ..Described::default()
        }
        .write(out);
    } else {
        groups(plan, out);
    }
}

/// Writes the groups of which a field is one: that of the variants, and one for each optional field.
fn groups(plan: &MessagePlan, out: &mut Output) {
    let mut group = |name: &str| out.message(8, |group| group.text(1, name));
    if plan.form == Form::Variants && !plan.fields.is_empty() {
        return group(ONE_OF);
    }
    for field in plan.fields.iter().filter(|field| has_presence(&field.kind)) {
        group(&format!("_{}", field.name));
    }
}

/// Returns whether a field is declared as `optional`. Messages are absent or present without it.
fn has_presence(kind: &Kind) -> bool {
    matches!(kind, Kind::Optional(inner) if !matches!(**inner, Kind::Message(_)))
}

fn described<'d>(view: &View, field: &'d FieldPlan, number: u32) -> Described<'d> {
    let (label, kind) = match &field.kind {
        Kind::List(inner) => (REPEATED, inner.as_ref()),
        Kind::Optional(inner) => (SINGLE, inner.as_ref()),
        other => (SINGLE, other),
    };
    let root = || format!(".{}.{}", view.package, view.messages[0].name);
    let type_name = match kind {
        Kind::Message(0) => Some(root()),
        Kind::Message(at) => Some(format!("{}.{}", root(), view.messages[*at].name)),
        Kind::Enum(at) => Some(format!("{}.{}.Value", root(), view.enums[*at].name)),
        _ => None,
    };
    let kind = match kind {
        Kind::Bool => BOOL,
        Kind::Signed(64) => SINT64,
        Kind::Signed(_) => SINT32,
        Kind::Unsigned(64) => UINT64,
        Kind::Unsigned(_) => UINT32,
        Kind::Float => FLOAT,
        Kind::Double => DOUBLE,
        Kind::Text | Kind::Wide { .. } | Kind::Json => STRING,
        Kind::Bytes => BYTES,
        Kind::Enum(_) => ENUM,
        Kind::Message(_) | Kind::Optional(_) | Kind::List(_) => MESSAGE,
    };
    let is_optional = has_presence(&field.kind);
    Described { name: &field.name, number, label, kind, type_name, one_of: None, is_optional }
}

/// Writes a message with the enum `Value` in it: names of values are then those of this enum alone.
fn values(plan: &EnumPlan, out: &mut Output) {
    out.text(1, &plan.name);
    out.message(4, |described| {
        described.text(1, "Value");
        for (number, (_, name)) in (0..).zip(&plan.values) {
            described.message(2, |value| {
                value.text(1, name);
                value.unsigned(2, number);
            });
        }
    });
}
