//! Applications that no node has named: there is none such only where all have named all that they have.

use sinew::inspect::Missing;

use super::{
    super::facts::{Facts, Unsaid},
    Steps, address, asked, is_on_loopback, keys,
};
use crate::table::time;

/// Nodes that are told of at most.
const NODES_SHOWN: usize = 4;

/// Before the similar names, in what an application says of one that it waits for.
const NEAREST: &str = "nearest: ";

fn nearest(why: &str) -> Option<&str> {
    why.split_once(NEAREST).map(|(_, names)| names)
}

fn respell(name: &str, nearest: &str) -> String {
    format!("is '{name}' misspelt in `requires`? There is {nearest}. Else start '{name}'")
}

/// The remedy for an application that waits for these.
pub(super) fn mend_of_wait(missing: &[Missing]) -> String {
    if missing.is_empty() {
        return "`sinew tree` shows how its last life ended, its log says more".to_owned();
    }
    let misspelt = missing.iter().find_map(|missing| Some(respell(&missing.name, nearest(&missing.why)?)));
    misspelt.unwrap_or_else(|| {
        let names: Vec<_> = missing.iter().map(|missing| missing.name.as_str()).collect();
        let names = names.join(", ");
        format!("start what it waits for: {names}; `sinew why` from it to each says what stands there")
    })
}

/// That the only node that could be asked has found no other one, and where it looks.
fn alone(wanted: &str, facts: &Facts) -> Option<(String, String)> {
    let mut reports = facts.ends.iter().filter_map(|end| end.report.as_ref());
    let report = reports.next()?;
    if reports.next().is_some()
        || !facts.unsaid.is_empty()
        || !report.peers.is_empty()
        || !report.lost.is_empty()
    {
        return None;
    }
    let refused = keys::refused_of_anybody(report);
    let seen = format!(
        "no node that has '{wanted}' is found: {} finds no other node; it looks in {}{refused}",
        report.name,
        asked(report)
    );
    let foreign = report.foreign.iter().map(|other| {
        format!("node {} at {} is of project '{}', this one of '{}'; set the same `project` under [node] if they belong together. ", other.name, other.udp, other.project, report.project)
    });
    let foreign: String = foreign.collect();
    let mend = if is_on_loopback(&report.interface) {
        format!(
            "{foreign}Is its node started on this host? If it is on another one: {} looks on its own host alone; set `interface` under [ndl] to the \
             address of the interface between the hosts, in both",
            report.name
        )
    } else {
        format!(
            "{foreign}Is its node started, with the same project and multicast group, and with its `interface` under [ndl] between the hosts (by itself \
             that is loopback)? Does multicast pass between the hosts? `sinew doctor --interface {}` tries it within one host alone; where it \
             does not pass (WiFi, VPN, containers, most clouds): [ndl] seeds = [\"ITS_ADDRESS:PORT\"], with a fixed `ndl.port` there",
            report.interface
        )
    };
    Some((seen, mend))
}

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
        if let Some((seen, mend)) = address::not_let_in(wanted, facts).or_else(|| alone(wanted, facts)) {
            return self.blocked(what, format!("{seen}{shut}"), mend);
        }
        if let Some(Missing { why, since_us, .. }) =
            facts.lacked.iter().find(|missing| missing.name == wanted)
        {
            let ago = since_us.map_or_else(String::new, |since| format!(", {} ago", time(since)));
            let seen = format!("the applications that require '{wanted}' report: {why}{ago}{shut}");
            let mend = "`sinew nodes` shows lost nodes and the reason; start its node again, or register the application. `sinew barriers` \
                        shows which applications wait for it";
            return self.blocked(
                what,
                seen,
                nearest(why).map_or_else(|| mend.to_owned(), |near| respell(wanted, near)),
            );
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
