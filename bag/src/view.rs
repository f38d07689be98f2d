//! Views: payloads as protocol buffers with a schema, for the tools of the field.
//!
//! A [`View`] is made from a [`Schema`] once. It has the description of the message (a `FileDescriptorSet`) and writes
//! each payload as such a message, in one pass and without a tree in between.

mod compile;
mod descriptor;
mod encode;
mod names;
#[cfg(test)]
mod tests;

use sinew_schema::Schema;

use crate::{messagepack::MisfitError, protobuf::Output, terms::Record};

/// The number of the field with Sinew's own header, above all fields of payloads.
pub(crate) const HEADER_FIELD: u32 = 15_000;
/// The name of the message in that field.
pub(crate) const HEADER_TYPE: &str = "sinew_bag.Header";

/// The type of a field.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Kind {
    Bool,
    /// `i8` to `i64`, with its bits.
    Signed(u32),
    /// `u8` to `u64`, with its bits.
    Unsigned(u32),
    Float,
    Double,
    /// Text or `char`.
    Text,
    /// `i128` and `u128`, as decimal text.
    Wide {
        is_signed: bool,
    },
    Bytes,
    /// A map, or a type that is nested too deeply: JSON text.
    Json,
    /// The enum without data of this number.
    Enum(usize),
    /// The message of this number.
    Message(usize),
    Optional(Box<Self>),
    List(Box<Self>),
}

/// A field of a message.
#[derive(Clone, Debug)]
struct FieldPlan {
    /// The name in the payload.
    wire: String,
    /// The name in the view.
    name: String,
    kind: Kind,
    /// Whether a payload may lack it.
    is_optional: bool,
}

/// The form of a message's payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    /// A map from names to values, or the values in order.
    Struct,
    /// The values in order.
    Tuple,
    /// One value, without anything around it.
    Single,
    /// A variant: its name, or a map from its name to its data.
    Variants,
    /// Nothing.
    Unit,
}

/// A message of the view. Its fields have the numbers from 1 on, in their order.
#[derive(Clone, Debug)]
struct MessagePlan {
    name: String,
    form: Form,
    fields: Vec<FieldPlan>,
}

/// An enum without data. Its values have the numbers from 0 on, in their order.
#[derive(Clone, Debug)]
struct EnumPlan {
    name: String,
    /// Names in the payload, and in the view.
    values: Vec<(String, String)>,
}

/// The view of one payload type.
#[derive(Clone, Debug)]
pub(crate) struct View {
    /// The package of the messages, such as `sinew.exo`.
    package: String,
    /// The first one is the payload itself; the others are nested in it.
    messages: Vec<MessagePlan>,
    enums: Vec<EnumPlan>,
}

impl View {
    /// Makes the view of a type. `None` where it has more fields or types than a view can.
    pub(crate) fn new(type_name: &str, schema: &Schema) -> Option<Self> {
        compile::compile(type_name, schema)
    }

    /// Returns the full name of the message, such as `sinew.exo.Angle`.
    pub(crate) fn name(&self) -> String {
        format!("{}.{}", self.package, self.messages[0].name)
    }

    /// Returns the `FileDescriptorSet` of the message.
    pub(crate) fn descriptor(&self) -> Vec<u8> {
        descriptor::of_view(self)
    }

    /// Writes the payload as a message, without the header.
    ///
    /// # Errors
    /// The payload does not fit the schema. `out` then has a part of it.
    pub(crate) fn encode(&self, payload: &[u8], out: &mut Output) -> Result<(), MisfitError> {
        encode::payload(self, payload, out)
    }
}

/// Returns the `FileDescriptorSet` of the header alone, for recordings without views.
pub(crate) fn header_descriptor() -> Vec<u8> {
    descriptor::of_header()
}

/// The fields of the header, each with its number and its name. They have the type `uint64`, except the age (`sint64`)
/// and the misfit (`string`).
pub(crate) const HEADER_FIELDS: [(u32, &str); 8] = [
    (1, "sequence"),
    (2, "correlation"),
    (3, "number"),
    (4, "age_ns"),
    (5, "error_ns"),
    (6, "flags"),
    (7, "time_to_live_us"),
    (8, "misfit"),
];

/// Writes the fields of the header.
pub(crate) fn header(record: &Record<'_>, misfit: Option<MisfitError>, out: &mut Output) {
    out.unsigned(1, record.sequence);
    out.unsigned(2, record.correlation);
    out.unsigned(3, record.number);
    out.signed(4, record.handed_over_ns.wrapping_sub(record.sent_ns) as i64);
    out.unsigned(5, record.sent_error_ns);
    out.unsigned(6, record.flags.into());
    out.unsigned(7, record.time_to_live_us.into());
    if let Some(MisfitError { expected }) = misfit {
        out.text(8, expected);
    }
}
