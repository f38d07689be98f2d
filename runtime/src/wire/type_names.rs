//! The payload types that this process sends or handles, by their IDs: for logs, which show names and not numbers, and
//! for comparisons with other nodes. The structure of a type is found at the first question for it.

use std::{any::TypeId, fmt, sync::OnceLock};

use sinew_schema::{SchemaHash, TraceError};

use super::{
    Kind, MismatchPolicy, Payload,
    type_schema::{TypeSchema, trace},
};

/// Number of entries in the table. A program with more types shows the IDs of the others.
pub(crate) const PLACES: usize = 512;
/// Number of entries that are searched for a type, starting at that of its ID.
const PROBES: usize = 8;

struct Entry {
    id: TypeId,
    kind: Kind,
    /// In a box, so that senders read one cache line.
    declared: Box<Declared>,
}

struct Declared {
    name: &'static str,
    rust: &'static str,
    mismatch: MismatchPolicy,
    is_protected: bool,
    trace: fn() -> Result<TypeSchema, TraceError>,
    /// Traced at the first question, on the thread that asks.
    schema: OnceLock<Result<TypeSchema, TraceError>>,
}

/// Each entry is written once and never removed, so that a lookup is one load without a lock.
static TYPES: [OnceLock<Entry>; PLACES] = [const { OnceLock::new() }; PLACES];

/// A payload type that this process sends or handles. Two Rust types with one [name](Payload::NAME) are two of them.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PayloadType(u16);

fn places(kind: Kind) -> impl Iterator<Item = usize> {
    let first = kind.bits() as usize;
    (0..PROBES).map(move |probe| (first + probe) % PLACES)
}

/// Records `P`. After its first call for a type it compares one number. Returns `None` if the table is full there.
pub(crate) fn remember<P: Payload>() -> Option<PayloadType> {
    let id = TypeId::of::<P>();
    for place in places(P::KIND) {
        let entry = TYPES[place].get_or_init(|| Entry {
            id,
            kind: P::KIND,
            declared: Box::new(Declared {
                name: P::NAME,
                rust: std::any::type_name::<P>(),
                mismatch: P::MISMATCH,
                is_protected: P::PROTECTION.is_some(),
                trace: trace::<P>,
                schema: OnceLock::new(),
            }),
        });
        if entry.id == id {
            return u16::try_from(place).ok().map(PayloadType);
        }
    }
    None
}

/// Returns the entries of a kind, in the order in which they were recorded.
fn entries(kind: Kind) -> impl Iterator<Item = &'static Entry> {
    places(kind).map_while(|place| TYPES[place].get()).filter(move |entry| entry.kind == kind)
}

impl Declared {
    fn schema(&self) -> Result<&TypeSchema, &TraceError> {
        let traced = self.schema.get_or_init(|| {
            let traced = (self.trace)();
            if let Err(error) = &traced {
                log_untraced(self.name, error);
            }
            traced
        });
        traced.as_ref()
    }
}

impl PayloadType {
    /// Returns the entry of `P`, and makes it at the first call. `None`: the process has more types than its table
    /// holds.
    #[must_use]
    pub fn of<P: Payload>() -> Option<Self> {
        remember::<P>()
    }

    /// Returns the number of its place in the table of types, below [`PLACES`].
    #[inline]
    pub(crate) const fn place(self) -> usize {
        self.0 as usize
    }

    fn entry(self) -> &'static Entry {
        TYPES[self.place()].get().expect("only `remember` makes one, after it has written the entry")
    }

    /// Returns the ID of the type.
    #[must_use]
    pub fn kind(self) -> Kind {
        self.entry().kind
    }

    /// Returns the name of the type.
    #[must_use]
    pub fn name(self) -> &'static str {
        self.entry().declared.name
    }

    /// Returns the treatment of messages from a sender with another version of the type.
    #[must_use]
    pub fn mismatch(self) -> MismatchPolicy {
        self.entry().declared.mismatch
    }

    /// Returns whether the type has end-to-end protection.
    #[must_use]
    pub fn is_protected(self) -> bool {
        self.entry().declared.is_protected
    }

    /// Returns the structure of the type. The first call takes up to some milliseconds, as [`Kind::schema`].
    ///
    /// # Errors
    /// As of [`Kind::schema`].
    pub fn schema(self) -> Result<&'static TypeSchema, &'static TraceError> {
        self.entry().declared.schema()
    }

    /// Returns whether [`schema`](Self::schema) was called before, so that it takes no time.
    #[must_use]
    pub fn is_traced(self) -> bool {
        self.entry().declared.schema.get().is_some()
    }
}

impl fmt::Debug for PayloadType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "PayloadType({})", self.name())
    }
}

/// Returns the payload types that this process has sent or declared, with their names; at most 512.
pub fn known_types() -> impl Iterator<Item = (Kind, &'static str)> {
    TYPES.iter().filter_map(|place| place.get().map(|entry| (entry.kind, entry.declared.name)))
}

impl Kind {
    /// Returns the name of the payload type with this ID, if this process has sent it or declared that it handles it.
    #[must_use]
    pub fn type_name(self) -> Option<&'static str> {
        entries(self).next().map(|entry| entry.declared.name)
    }

    /// Returns the type's name in Rust, without its module.
    #[must_use]
    pub fn rust_name(self) -> Option<&'static str> {
        let rust = entries(self).next()?.declared.rust;
        Some(rust.rsplit("::").next().unwrap_or(rust))
    }

    /// Returns the structure of the payload type with this ID, if this process has sent it or declared that it handles
    /// it. The first call for a type takes up to some milliseconds: it is not for a thread with deadlines.
    ///
    /// # Errors
    /// [`TraceError`] says why the structure of the type is not known, as for a type with a hand-written `Deserialize`.
    /// The first call logs it once.
    #[must_use]
    pub fn schema(self) -> Option<Result<&'static TypeSchema, &'static TraceError>> {
        entries(self).next().map(|entry| entry.declared.schema())
    }

    /// Returns the structure with this hash that a payload type of this ID has in this process. Like
    /// [`schema`](Self::schema) it is not for a thread with deadlines.
    #[must_use]
    pub fn schema_of_hash(self, hash: SchemaHash) -> Option<&'static TypeSchema> {
        let mut traced = entries(self).filter_map(|entry| entry.declared.schema().ok());
        traced.find(|schema| schema.hash() == hash)
    }
}

/// Logs a type without a known structure. No user can change Sinew's own types.
fn log_untraced(name: &str, error: &TraceError) {
    if name.starts_with("sinew.") {
        crate::log::debug!("the structure of {name} is not known: {error}");
    } else {
        crate::log::info!("the structure of {name} is not known, and is not compared between nodes: {error}");
    }
}

#[cfg(test)]
mod tests {
    use serde::{Deserialize, Serialize};

    use super::*;

    #[derive(Serialize, Deserialize)]
    struct Angle {}

    impl Payload for Angle {
        const NAME: &'static str = "test.type_names.angle";
    }

    #[test]
    fn sent_type_has_its_names() {
        assert_eq!(Kind::named("test.type_names.never").type_name(), None);
        assert!(known_types().all(|(kind, _)| kind != Angle::KIND));
        let angle = remember::<Angle>();
        assert_eq!(remember::<Angle>(), angle);
        assert_eq!(angle.map(PayloadType::name), Some("test.type_names.angle"));
        assert_eq!(known_types().filter(|(kind, _)| *kind == Angle::KIND).count(), 1);
        assert_eq!(Angle::KIND.type_name(), Some("test.type_names.angle"));
        assert_eq!(Angle::KIND.rust_name(), Some("Angle"));
    }

    #[test]
    fn types_that_no_other_package_names_are_traced() {
        let _ = remember::<crate::protection::Echo>();
        let echo =
            crate::protection::Echo::KIND.schema().expect("it is declared").expect("it has a structure");
        assert!(echo.schema().to_string().contains("at_ns: u64"), "{}", echo.schema());
    }

    #[test]
    fn structure_is_known_of_declared_types_alone() {
        #[derive(Serialize, Deserialize)]
        struct Speed {
            value: f32,
        }
        impl Payload for Speed {
            const NAME: &'static str = "test.type_names.speed";
        }
        assert!(Speed::KIND.schema().is_none());
        let _ = remember::<Speed>();
        let traced = Speed::KIND.schema().expect("it is declared").expect("it has a structure");
        assert_eq!(traced.schema().to_string(), "{\n    value: f32,\n}\n");
        assert_eq!(traced.hash(), traced.schema().hash());
    }

    #[test]
    fn two_types_of_one_name_keep_their_structures() {
        #[derive(Serialize, Deserialize)]
        struct Old {
            kp: f32,
        }
        impl Payload for Old {
            const NAME: &'static str = "test.type_names.gains";
        }
        #[derive(Serialize, Deserialize)]
        struct New {
            kp: f32,
            kd: f32,
        }
        impl Payload for New {
            const NAME: &'static str = "test.type_names.gains";
            const MISMATCH: MismatchPolicy = MismatchPolicy::Warn;
        }
        let [old, new] = [remember::<Old>(), remember::<New>()].map(|one| one.expect("there is room"));
        assert_eq!(old.kind(), new.kind());
        assert_eq!([old.mismatch(), new.mismatch()], [MismatchPolicy::AcceptAdditions, MismatchPolicy::Warn]);
        let [old, new] = [old, new].map(|one| one.schema().expect("it has a structure"));
        assert_ne!(old.hash(), new.hash());
        assert_eq!(Old::KIND.schema_of_hash(new.hash()).map(TypeSchema::hash), Some(new.hash()));
        assert_eq!(Old::KIND.schema_of_hash(SchemaHash(1)).map(TypeSchema::hash), None);
    }
}
