//! The structure of a payload type, as the decoder of messages reads it.

use sinew_schema::{Schema, SchemaHash, TraceError, Wire};

#[cfg(doc)]
use super::Kind;
use super::{Payload, PayloadType, decode_as, memory, remember};

/// The structure of a payload type and its hash.
#[derive(Debug)]
pub struct TypeSchema {
    schema: Schema,
    hash: SchemaHash,
}

impl TypeSchema {
    /// Returns the structure.
    #[must_use]
    pub const fn schema(&self) -> &Schema {
        &self.schema
    }

    /// Returns the hash of the structure.
    #[must_use]
    pub const fn hash(&self) -> SchemaHash {
        self.hash
    }
}

/// Returns the structure of `P`. Same as [`Kind::schema`], for a type that this process need not have declared.
///
/// `None`: the process has more types than its table holds.
///
/// # Errors
/// As of [`Kind::schema`].
///
/// # Examples
///
/// ```
/// use sinew::{payload, schema::schema_of};
///
/// payload!("demo.angle", Stream => struct Angle { degrees: f32 });
///
/// let angle = schema_of::<Angle>().expect("there are few types").expect("it has a structure");
/// assert_eq!(angle.schema().to_string(), "{\n    degrees: f32,\n}\n");
/// ```
#[must_use]
pub fn schema_of<P: Payload>() -> Option<Result<&'static TypeSchema, &'static TraceError>> {
    remember::<P>().map(PayloadType::schema)
}

/// Traces `P` with the decoder and the encoder of messages.
pub(super) fn trace<P: Payload>() -> Result<TypeSchema, TraceError> {
    let accepts = |bytes: &[u8]| decode_as::<P>(bytes).is_ok();
    let writes = |value: &P| {
        let written = memory::written(|writer| rmp_serde::encode::write_named(writer, value));
        written.ok().map(|bytes| bytes.to_vec())
    };
    let schema = Schema::traced(&Wire { accepts: &accepts, writes: &writes })?;
    Ok(TypeSchema { hash: schema.hash(), schema })
}
