//! The payload types of the runtime itself.

use sinew_params::{AskParameters, ParameterList, ParameterOutcome, ParameterVote, SetParameters};

use crate::{protection::Echo, wire::remember};

/// Records the payload types of the runtime that applications exchange with each other's runtimes. A node that records
/// has their names then, also where no application of its process has sent one.
pub fn remember_own_types() {
    // A full table shows their IDs.
    let _ = remember::<Echo>();
    let _ = (remember::<AskParameters>(), remember::<ParameterList>());
    let _ = (remember::<SetParameters>(), remember::<ParameterOutcome>());
    let _ = remember::<ParameterVote>();
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::Kind;

    #[test]
    fn own_types_have_names_and_structures() {
        remember_own_types();
        for name in ["sinew.echo", "sinew.param.set", "sinew.param.outcome", "sinew.param.vote"] {
            let kind = Kind::named(name);
            assert_eq!(kind.type_name(), Some(name));
            assert!(kind.schema().is_some_and(|schema| schema.is_ok()), "{name}");
        }
    }
}
