//! The names of payload types by their IDs, for types that this process sends or handles: for logs, which
//! show names and not numbers. Their structure is found when somebody asks for it.

use std::sync::OnceLock;

use sinew_schema::TraceError;

use super::{
    Kind, Payload,
    type_schema::{TypeSchema, trace},
};

/// Number of entries in the table. A program with more types shows the IDs of the others.
const PLACES: usize = 512;
/// Number of entries that are searched for a name, starting at that of its ID.
const PROBES: usize = 8;

struct Names {
    kind: Kind,
    name: &'static str,
    rust: &'static str,
    trace: fn() -> Result<TypeSchema, TraceError>,
    /// Traced at the first question, on the thread that asks. In a box, so that senders read one cache line.
    schema: OnceLock<Box<Result<TypeSchema, TraceError>>>,
}

/// Each entry is written once and never removed, so that a lookup is one load without a lock.
static NAMES: [OnceLock<Names>; PLACES] = [const { OnceLock::new() }; PLACES];

fn places(kind: Kind) -> impl Iterator<Item = &'static OnceLock<Names>> {
    let first = kind.bits() as usize;
    (0..PROBES).filter_map(move |probe| NAMES.get((first + probe) % PLACES))
}

/// Records the names of `P`. After its first call for a type it compares one number.
pub(crate) fn remember<P: Payload>() {
    for place in places(P::KIND) {
        let names = place.get_or_init(|| Names {
            kind: P::KIND,
            name: P::NAME,
            rust: std::any::type_name::<P>(),
            trace: trace::<P>,
            schema: OnceLock::new(),
        });
        if names.kind == P::KIND {
            return;
        }
    }
}

fn find(kind: Kind) -> Option<&'static Names> {
    places(kind).map_while(OnceLock::get).find(|names| names.kind == kind)
}

/// Returns the payload types that this process has sent or declared, with their names; at most 512.
pub fn known_types() -> impl Iterator<Item = (Kind, &'static str)> {
    NAMES.iter().filter_map(|place| place.get().map(|names| (names.kind, names.name)))
}

impl Kind {
    /// Returns the name of the payload type with this ID, if this process has sent it or declared that it handles it.
    #[must_use]
    pub fn type_name(self) -> Option<&'static str> {
        find(self).map(|names| names.name)
    }

    /// Returns the type's name in Rust, without its module.
    #[must_use]
    pub fn rust_name(self) -> Option<&'static str> {
        find(self).map(|names| names.rust.rsplit("::").next().unwrap_or(names.rust))
    }

    /// Returns the structure of the payload type with this ID, if this process has sent it or declared that it handles
    /// it. The first call for a type takes up to some milliseconds: it is not for a thread with deadlines.
    ///
    /// # Errors
    /// [`TraceError`] says why the structure of the type is not known, as for a type with a hand-written `Deserialize`.
    /// The first call logs it once.
    #[must_use]
    pub fn schema(self) -> Option<Result<&'static TypeSchema, &'static TraceError>> {
        let names = find(self)?;
        let traced = names.schema.get_or_init(|| {
            let traced = (names.trace)();
            if let Err(error) = &traced {
                log_untraced(names.name, error);
            }
            Box::new(traced)
        });
        Some(Result::as_ref(traced))
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
        remember::<Angle>();
        remember::<Angle>();
        assert_eq!(known_types().filter(|(kind, _)| *kind == Angle::KIND).count(), 1);
        assert_eq!(Angle::KIND.type_name(), Some("test.type_names.angle"));
        assert_eq!(Angle::KIND.rust_name(), Some("Angle"));
    }

    #[test]
    fn types_that_no_other_package_names_are_traced() {
        remember::<crate::protection::Echo>();
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
        remember::<Speed>();
        let traced = Speed::KIND.schema().expect("it is declared").expect("it has a structure");
        assert_eq!(traced.schema().to_string(), "{\n    value: f32,\n}\n");
        assert_eq!(traced.hash(), traced.schema().hash());
    }
}
