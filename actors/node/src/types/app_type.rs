//! A payload type of an application of this node: a Rust type of this process, or the declaration of another process.

use std::{
    ops::Deref,
    sync::{Arc, OnceLock},
};

use sinew_model::facts::TypeDeclaration;
use sinew_runtime::wire::{Kind, MismatchPolicy, PayloadType, SchemaHash};
use sinew_schema::{SCHEMA_BYTES_MAX, Schema};

/// The structure of a type of this node.
#[derive(Clone, Debug)]
pub(crate) enum Structure {
    /// Of a Rust type of this process.
    Own(&'static Schema),
    /// Of a declaration.
    Declared(Arc<Schema>),
}

impl Deref for Structure {
    type Target = Schema;

    fn deref(&self) -> &Schema {
        match self {
            Self::Own(schema) => schema,
            Self::Declared(schema) => schema,
        }
    }
}

/// A type of an application.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum AppType {
    /// A Rust type of this process.
    Own(PayloadType),
    /// A type of an application in another process.
    Declared(Arc<DeclaredType>),
}

/// A type as another process has declared it. Its bytes are read at the first question for its structure.
#[derive(Debug)]
pub(crate) struct DeclaredType {
    kind: Kind,
    policy: MismatchPolicy,
    is_protected: bool,
    bytes: Vec<u8>,
    /// `None`: the bytes are invalid.
    schema: OnceLock<Option<(Arc<Schema>, SchemaHash)>>,
}

impl PartialEq for DeclaredType {
    fn eq(&self, other: &Self) -> bool {
        (self.kind, self.policy, self.is_protected, &self.bytes)
            == (other.kind, other.policy, other.is_protected, &other.bytes)
    }
}

impl Eq for DeclaredType {}

impl DeclaredType {
    /// Returns the type of this declaration.
    ///
    /// # Errors
    /// The declaration is of a layer's type, or too long.
    pub(super) fn new(declaration: TypeDeclaration) -> Result<Self, String> {
        let TypeDeclaration { kind, handles: _, sends: _, policy, protected, schema } = declaration;
        if !kind.is_user() {
            return Err(format!("it declares kind {kind}, which is a layer's"));
        }
        if schema.len() > SCHEMA_BYTES_MAX {
            return Err(format!(
                "it declares kind {kind} by {} bytes; {SCHEMA_BYTES_MAX} are read at most",
                schema.len()
            ));
        }
        Ok(Self {
            kind,
            policy: MismatchPolicy::of_word(&policy).unwrap_or_default(),
            is_protected: protected,
            bytes: schema,
            schema: OnceLock::new(),
        })
    }

    /// Returns the ID of the type.
    pub(super) const fn kind(&self) -> Kind {
        self.kind
    }

    /// Returns the number of bytes of its structure.
    pub(super) const fn bytes(&self) -> usize {
        self.bytes.len()
    }

    fn read(&self) -> Option<(&Arc<Schema>, SchemaHash)> {
        let read = self.schema.get_or_init(|| {
            let schema = Schema::parse(&self.bytes).ok()?;
            let hash = schema.hash();
            Some((Arc::new(schema), hash))
        });
        read.as_ref().map(|(schema, hash)| (schema, *hash))
    }
}

impl AppType {
    pub(super) fn kind(&self) -> Kind {
        match self {
            Self::Own(one) => one.kind(),
            Self::Declared(one) => one.kind(),
        }
    }

    /// Returns the treatment of messages from a sender with another version of the type.
    pub(super) fn policy(&self) -> MismatchPolicy {
        match self {
            Self::Own(one) => one.mismatch(),
            Self::Declared(one) => one.policy,
        }
    }

    /// Returns whether messages of the type have end-to-end protection.
    pub(super) fn is_protected(&self) -> bool {
        match self {
            Self::Own(one) => one.is_protected(),
            Self::Declared(one) => one.is_protected,
        }
    }

    /// Returns the structure and its hash. `None`: it has none that can be traced, or its declaration is invalid. The
    /// first call for a type takes up to some milliseconds.
    pub(super) fn schema(&self) -> Option<(Structure, SchemaHash)> {
        match self {
            Self::Own(one) => {
                let traced = one.schema().ok()?;
                Some((Structure::Own(traced.schema()), traced.hash()))
            }
            Self::Declared(one) => {
                let (schema, hash) = one.read()?;
                Some((Structure::Declared(schema.clone()), hash))
            }
        }
    }

    /// Returns the hash of the structure. Like [`schema`](Self::schema) it may take some milliseconds.
    pub(super) fn hash(&self) -> Option<SchemaHash> {
        match self {
            Self::Own(one) => Some(one.schema().ok()?.hash()),
            Self::Declared(one) => Some(one.read()?.1),
        }
    }

    /// Returns whether it is a declaration with invalid bytes.
    pub(super) fn is_invalid(&self) -> bool {
        matches!(self, Self::Declared(one) if one.read().is_none())
    }
}
