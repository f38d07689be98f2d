//! The names of payload types by their IDs, for types that this process sends or handles: for logs, which
//! show names and not numbers.

use std::sync::OnceLock;

use super::{Kind, Payload};

/// Number of entries in the table. A program with more types shows the IDs of the others.
const PLACES: usize = 512;
/// Number of entries that are searched for a name, starting at that of its ID.
const PROBES: usize = 8;

struct Names {
    kind: Kind,
    name: &'static str,
    rust: &'static str,
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
        let names =
            place.get_or_init(|| Names { kind: P::KIND, name: P::NAME, rust: std::any::type_name::<P>() });
        if names.kind == P::KIND {
            return;
        }
    }
}

fn find(kind: Kind) -> Option<&'static Names> {
    places(kind).map_while(OnceLock::get).find(|names| names.kind == kind)
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
        remember::<Angle>();
        remember::<Angle>();
        assert_eq!(Angle::KIND.type_name(), Some("test.type_names.angle"));
        assert_eq!(Angle::KIND.rust_name(), Some("Angle"));
    }
}
