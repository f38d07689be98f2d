//! Applications that no node has named: there is none such only where all have named all that they have.

use sinew::inspect::Missing;

use super::{
    super::facts::{Facts, Unsaid},
    Steps,
};
use crate::table::time;

/// Nodes that are told of at most.
const NODES_SHOWN: usize = 4;

impl Unsaid {
    fn seen(&self) -> String {
        match self {
            Self::Silent(why) => format!("did not say which applications it has: {why}"),
            Self::LeftOut(count) => {
                format!("has {count} further applications that had no room in its answer")
            }
        }
    }

    const fn mend(&self) -> &'static str {
        match self {
            Self::Silent(_) => {
                "ask again, with more time if need be (--deadline-ms); `sinew ping` says whether it takes messages"
            }
            Self::LeftOut(_) => {
                "`sinew ping` says whether it takes messages; a larger `payload_max` under [node] of its node has room for more, up to 1,024"
            }
        }
    }
}

impl Steps {
    /// An application whose node was asked, and has not named it.
    pub(super) fn unnamed(
        &mut self,
        what: String,
        unsaid: Option<&Unsaid>,
        ping: Option<&Result<u64, String>>,
    ) {
        let Some(unsaid) = unsaid else {
            let mend = "is it registered, and spelled right? `sinew apps` shows all that are there";
            return self.blocked(what, "its node has no such application now", mend);
        };
        let seen = format!("whether it is there is not known: its node {}", unsaid.seen());
        // Who confirms a message is there, whatever else its node says.
        if ping.is_some_and(Result::is_ok) {
            self.note(what, seen, unsaid.mend());
        } else {
            self.blocked(what, seen, unsaid.mend());
        }
    }

    /// A word that means nobody whom a node has named.
    pub(super) fn nowhere(&mut self, what: String, wanted: &str, facts: &Facts, shut: &str) {
        if let Some(Missing { why, since_us, .. }) =
            facts.lacked.iter().find(|missing| missing.name == wanted)
        {
            let ago = since_us.map_or_else(String::new, |since| format!(", {} ago", time(since)));
            let seen = format!("the applications that require '{wanted}' report: {why}{ago}{shut}");
            let mend = "`sinew nodes` shows lost nodes and the reason; start its node again, or register the application. `sinew barriers` \
                        shows which applications wait for it";
            return self.blocked(what, seen, mend);
        }
        let unsaid = &facts.unsaid;
        let look = "is it spelled right (`sinew apps`, `sinew nodes`)? Is its node started? If its socket is elsewhere on this host: \
                    --other-socket PATH";
        if unsaid.is_empty() {
            let seen = format!(
                "no node and no application called '{wanted}' is known to any node that was asked, and no group of that name has members there{shut}"
            );
            return self.blocked(what, seen, look);
        }
        let shown = unsaid.iter().take(NODES_SHOWN);
        let mut words: Vec<_> =
            shown.map(|(node, unsaid)| format!("node {node} {}", unsaid.seen())).collect();
        let more = unsaid.len() - words.len();
        words.extend((more > 0).then(|| format!("and so it is with {more} more")));
        let seen = format!(
            "whether anybody is called '{wanted}' is not known: no node has named it, and {}{shut}",
            words.join("; ")
        );
        let mend =
            format!("ask again, with more time if need be (--deadline-ms), or by its TID. Else: {look}");
        self.blocked(what, seen, mend);
    }
}
