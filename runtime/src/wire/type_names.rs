//! Names of payload types by their ids, as far as this process sends or handles them: for logs, which show names and not numbers.

use std::sync::OnceLock;

use super::{Kind, Payload};

/// Places of the table. A program with more types shows the ids of the others.
const PLACES: usize = 512;
/// Places at which a name is looked for, from that of its id on.
const PROBES: usize = 8;

struct Names {
    kind: Kind,
    name: &'static str,
    rust: &'static str,
}

/// Written once each and never taken out, so that a look is one load without a lock.
static NAMES: [OnceLock<Names>; PLACES] = [const { OnceLock::new() }; PLACES];

fn places(kind: Kind) -> impl Iterator<Item = &'static OnceLock<Names>> {
    let first = kind.bits() as usize;
    (0..PROBES).filter_map(move |probe| NAMES.get((first + probe) % PLACES))
}

/// Remembers the names of `P`. After its first call for a type it compares one number.
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
    /// Name of the payload type with this id, if this process has sent it or declared that it handles it.
    #[must_use]
    pub fn type_name(self) -> Option<&'static str> {
        find(self).map(|names| names.name)
    }

    /// The same in Rust, without its module.
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
    fn a_type_that_was_sent_has_its_names() {
        assert_eq!(Kind::named("test.type_names.never").type_name(), None);
        remember::<Angle>();
        remember::<Angle>();
        assert_eq!(Angle::KIND.type_name(), Some("test.type_names.angle"));
        assert_eq!(Angle::KIND.rust_name(), Some("Angle"));
    }
}
