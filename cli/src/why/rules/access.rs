//! Whether an access list stands in the way.

use sinew::inspect::AccessVerdict;

use super::{
    super::facts::{End, Facts},
    Steps,
};

const MEND: &str = "have a [[rule]] of that list allow it, then `sinew reload` on its host";

impl Steps {
    /// What the list at each end says. Who asks is in the way of what is to go from the first to the second; that nothing may go back is often
    /// meant so, and replies that were asked for need no leave.
    pub(super) fn access(&mut self, a: &End, b: &End, facts: &Facts) {
        let [there, back] = &facts.access;
        for (said, from, to, is_asked_for) in [(there, a, b, true), (back, b, a, false)] {
            let Some(said) = said else { continue };
            let what = may_send(from, to);
            if !said.is_given {
                self.fine(what, format!("node {} has no access list", to.node_label()));
                continue;
            }
            let seen = in_words(&said.verdicts);
            let refused = said.verdicts.iter().filter(|verdict| !verdict.is_allowed).count();
            if refused == 0 {
                self.fine(what, seen);
            } else if is_asked_for && refused == said.verdicts.len() {
                self.blocked(what, seen, MEND);
            } else {
                self.note(what, seen, MEND);
            }
        }
    }
}

/// What is asked of the list of the second.
pub(super) fn may_send(from: &End, to: &End) -> String {
    format!("{} may send to {}", from.label(), to.label())
}

/// What counts for each class, or for all at once where it is the same.
pub(super) fn in_words(verdicts: &[AccessVerdict]) -> String {
    let judged = |verdict: &AccessVerdict| {
        format!("{}: {}", if verdict.is_allowed { "allowed" } else { "refused" }, verdict.why)
    };
    match verdicts.split_first() {
        Some((first, others)) if others.iter().all(|other| judged(other) == judged(first)) => {
            format!("access list of its node: {}", judged(first))
        }
        _ => {
            let each = verdicts.iter().map(|one| format!("{:?} {}", one.class, judged(one)));
            format!("access list of its node: {}", each.collect::<Vec<_>>().join("; "))
        }
    }
}
