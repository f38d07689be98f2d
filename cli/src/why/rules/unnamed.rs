//! Applications that no node lists: one is only known to be missing if all nodes have listed all their applications.

use sinew::inspect::Missing;

use super::{
    super::facts::{Facts, Unreported},
    Steps, address, keys,
    nearest_group::nearest_group,
    places::is_on_loopback,
    unfound::asked,
};
use crate::{table::time, unknown::suggestion};

/// Maximum number of listed nodes.
const NODES_SHOWN: usize = 4;

/// The text before the similar names in the report of a waiting application.
const NEAREST: &str = "nearest: ";

fn nearest(why: &str) -> Option<&str> {
    why.split_once(NEAREST).map(|(_, names)| names)
}

fn respell(name: &str, nearest: &str) -> String {
    format!("is '{name}' misspelt in `requires`? There is {nearest}. Else start '{name}'")
}

/// Returns the remedy for an application that waits for these.
pub(super) fn fix_of_wait(missing: &[Missing]) -> String {
    if missing.is_empty() {
        return "`sinew tree` shows how its last incarnation ended, its log says more".to_owned();
    }
    let misspelt = missing.iter().find_map(|missing| Some(respell(&missing.name, nearest(&missing.why)?)));
    misspelt.unwrap_or_else(|| {
        let names: Vec<_> = missing.iter().map(|missing| missing.name.as_str()).collect();
        let names = names.join(", ");
        format!("start what it waits for: {names}; `sinew why` from it to each looks for the reason")
    })
}

/// Reports that the only asked node has found no other one, and where it looks.
fn alone(wanted: &str, facts: &Facts) -> Option<(String, String)> {
    let mut reports = facts.ends.iter().filter_map(|end| end.report.as_ref());
    let report = reports.next()?;
    if reports.next().is_some()
        || !facts.unreported.is_empty()
        || !report.peers.is_empty()
        || !report.lost.is_empty()
    {
        return None;
    }
    let refused = keys::refused_of_anybody(report);
    let detail = format!(
        "no node that has '{wanted}' is found: {} finds no other node; it looks in {}{refused}",
        report.name,
        asked(report)
    );
    let foreign = report.foreign.iter().map(|other| {
        format!("node {} at {} is of project '{}', this one of '{}'; set the same `project` under [node] if they belong together. ", other.name, other.udp, other.project, report.project)
    });
    let foreign: String = foreign.collect();
    let fix = if is_on_loopback(&report.interface) {
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
    Some((detail, fix))
}

/// Reports that a group with members has nearly this name.
fn misspelt_group(wanted: &str, facts: &Facts) -> Option<(String, String)> {
    // An application that is required by this name is none of the groups.
    if facts.lacked.iter().any(|missing| missing.name == wanted) {
        return None;
    }
    let (group, members) = nearest_group(wanted, &facts.groups)?;
    let members = if members == 1 { "1 member".to_owned() } else { format!("{members} members") };
    let near = suggestion(wanted, facts.names.iter().map(String::as_str));
    let detail = format!(
        "no asked node knows an application, a node or a group with members called '{wanted}'; nearest group: {group} ({members}){near}"
    );
    Some((detail, format!("is '{wanted}' misspelt? The group {group} has {members}: name that one")))
}

impl Unreported {
    fn detail(&self) -> String {
        match self {
            Self::Silent(why) => format!("did not report its applications: {why}"),
            Self::LeftOut(count) => {
                format!("has {count} further applications that had no room in its answer")
            }
        }
    }

    const fn fix(&self) -> &'static str {
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
    /// Adds the step of an application that its node has not listed.
    pub(super) fn unnamed(
        &mut self,
        what: String,
        unreported: Option<&Unreported>,
        ping: Option<&Result<u64, String>>,
    ) {
        let Some(unreported) = unreported else {
            let fix = "is it registered, and spelled right? `sinew apps` shows all that are there";
            return self.blocked(what, "its node has no such application now", fix);
        };
        let detail = format!("whether it is there is not known: its node {}", unreported.detail());
        // An application that confirms a message exists, regardless of its node's report.
        if ping.is_some_and(Result::is_ok) {
            self.note(what, detail, unreported.fix());
        } else {
            self.blocked(what, detail, unreported.fix());
        }
    }

    /// Adds the step of a name that no node has listed.
    pub(super) fn nowhere(&mut self, what: String, wanted: &str, facts: &Facts, shut: &str) {
        if let Some((detail, fix)) = address::not_let_in(wanted, facts)
            .or_else(|| misspelt_group(wanted, facts))
            .or_else(|| alone(wanted, facts))
        {
            return self.blocked(what, format!("{detail}{shut}"), fix);
        }
        if let Some(Missing { why, since_us, .. }) =
            facts.lacked.iter().find(|missing| missing.name == wanted)
        {
            let ago = since_us.map_or_else(String::new, |since| format!(", {} ago", time(since)));
            let detail = format!("the applications that require '{wanted}' report: {why}{ago}{shut}");
            let fix = "`sinew nodes` shows lost nodes and the reason; start its node again, or register the application. `sinew barriers` \
                        shows which applications wait for it";
            return self.blocked(
                what,
                detail,
                nearest(why).map_or_else(|| fix.to_owned(), |near| respell(wanted, near)),
            );
        }
        let unreported = &facts.unreported;
        let near = suggestion(wanted, facts.names.iter().map(String::as_str));
        let remedy = "is it spelled right (`sinew apps`, `sinew nodes`)? Is its node started? If its socket is elsewhere on this host: \
                    --other-socket PATH";
        if unreported.is_empty() {
            let detail = format!(
                "no node and no application called '{wanted}' is known to any node that was asked, and no group of that name has members there{near}{shut}"
            );
            return self.blocked(what, detail, remedy);
        }
        let shown = unreported.iter().take(NODES_SHOWN);
        let mut words: Vec<_> =
            shown.map(|(node, unreported)| format!("node {node} {}", unreported.detail())).collect();
        let more = unreported.len() - words.len();
        words.extend((more > 0).then(|| format!("and so it is with {more} more")));
        let detail = format!(
            "whether something is called '{wanted}' is not known: no node has named it, and {}{near}{shut}",
            words.join("; ")
        );
        let fix =
            format!("ask again, with more time if need be (--deadline-ms), or by its TID. Else: {remedy}");
        self.blocked(what, detail, fix);
    }
}
