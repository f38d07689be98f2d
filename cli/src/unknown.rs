//! The report for an unknown name: similar names, and the reasons why it may exist nevertheless.

use sinew::{
    Tid,
    inspect::{AppsReport, LostReport, NodeReport},
    name::check_name,
    nearest::nearest,
};

use crate::{
    system::Answer,
    table::{short, time},
};

/// The kind of target that a command looks for by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Target {
    /// A node.
    Node,
    /// An application or a node.
    One,
    /// An application, a node or a group.
    OneOrGroup,
}

/// The names that the nodes of a system know.
#[derive(Debug, Default)]
pub(crate) struct Known {
    /// Names of applications, each with its node.
    apps: Vec<(String, String)>,
    nodes: Vec<String>,
    lost: Vec<LostReport>,
    /// Nodes that have not listed all their applications.
    incomplete: Vec<String>,
}

impl Known {
    pub(crate) fn of(here: &NodeReport, answers: Vec<Answer<AppsReport>>) -> Self {
        let mut known = Self { lost: here.lost.clone(), ..Self::default() };
        for Answer { node, name, result } in answers {
            let label = if name.is_empty() { node.to_string() } else { name.clone() };
            if !name.is_empty() {
                known.nodes.push(name);
            }
            match result {
                Ok(report) => {
                    known.incomplete.extend((report.left_out > 0).then(|| label.clone()));
                    let names = report.apps.into_iter().filter_map(|app| app.name);
                    known.apps.extend(names.map(|name| (name, label.clone())));
                }
                Err(_) => known.incomplete.push(label),
            }
        }
        known
    }

    /// Returns that nothing has this name, as text for users.
    pub(crate) fn report(&self, name: &str, sought: Target) -> String {
        let shown = short(name);
        let mut text = match sought {
            Target::Node => format!("no node is called `{shown}` or has this address"),
            Target::One => format!("no application and no node is called `{shown}`"),
            Target::OneOrGroup => {
                format!("no application, no node and no group with members is called `{shown}`")
            }
        };
        text += &as_address(name);
        if let Some(lost) = self.lost.iter().find(|lost| lost.name == name) {
            text += &format!("; a node of this name was lost {} ago ({})", time(lost.lost_us), lost.why);
        }
        let exact = self.apps.iter().find(|(app, _)| app == name).filter(|_| sought == Target::Node);
        if let Some((_, node)) = exact {
            text += &format!("; it is an application of node {}", short(node));
        } else {
            text += &self.nearest(name, sought);
        }
        if !self.incomplete.is_empty() && sought != Target::Node {
            let nodes: Vec<_> = self.incomplete.iter().take(NODES_SHOWN).map(|node| short(node)).collect();
            let more = self.incomplete.len() - nodes.len();
            let more = if more > 0 { format!(" and {more} more") } else { String::new() };
            text += &format!("; not all applications are known of {}{more}", nodes.join(", "));
        }
        let command = if sought == Target::Node {
            "`sinew nodes` lists"
        } else {
            "`sinew apps` and `sinew nodes` list"
        };
        format!("{text}. {command} those that are there")
    }

    fn nearest(&self, name: &str, sought: Target) -> String {
        let apps = self.apps.iter().map(|(app, _)| (app.as_str(), "application"));
        let apps = apps.filter(|_| sought != Target::Node);
        let nodes = self.nodes.iter().map(|node| (node.as_str(), "node"));
        let near = nearest(name, apps.chain(nodes), |(known, _)| known);
        let near: Vec<_> = near.iter().map(|(known, what)| format!("{} ({what})", short(known))).collect();
        if near.is_empty() { String::new() } else { format!("; nearest: {}", near.join(", ")) }
    }
}

/// Maximum number of listed nodes.
const NODES_SHOWN: usize = 4;

/// Returns why the name is invalid for applications and nodes, if it is.
pub(crate) fn not_a_name(name: &str) -> Option<String> {
    let why = check_name(name).err()?;
    Some(format!("no application can be called `{}`: {why}{}", short(name), as_address(name)))
}

/// Returns why it is no address: a slash may be meant as that of a TID.
fn as_address(name: &str) -> String {
    let why = name.parse::<Tid>().err().filter(|_| name.contains('/'));
    why.map_or_else(String::new, |why| format!("; as an address: {}", short(&why.to_string())))
}

/// Returns the most similar of these names as text, or an empty text.
pub(crate) fn suggestion<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> String {
    let near: Vec<_> = nearest(name, known, |known| known).into_iter().map(short).collect();
    if near.is_empty() { String::new() } else { format!("; nearest: {}", near.join(", ")) }
}

#[cfg(test)]
mod tests {
    use sinew::{AppAddress, NodeAddress, address::Incarnation, inspect::AppReport};

    use super::*;
    use crate::security::tests::node_report;

    fn app(name: &str) -> AppReport {
        AppReport {
            tid: Tid::new(NodeAddress::new(2), AppAddress::new(0x1001)),
            name: Some(name.to_owned()),
            ready: true,
            waits_us: None,
            missing: Vec::new(),
            missing_left_out: 0,
            ended: None,
            kinds: Vec::new(),
            kinds_left_out: 0,
        }
    }

    /// The knee with its drive, the hip, which does not answer, and the ankle, which was lost.
    fn known() -> Known {
        let answer = |name: &str, result: Result<AppsReport, String>| Answer {
            node: NodeAddress::new(2),
            name: name.to_owned(),
            result,
        };
        let apps = AppsReport {
            name: "knee".to_owned(),
            apps: vec![app("knee.drive"), app("camera")],
            left_out: 0,
            barriers: Vec::new(),
            barriers_left_out: 0,
            groups: Vec::new(),
            groups_left_out: 0,
        };
        let lost = LostReport {
            node: NodeAddress::new(3),
            name: "ankle".to_owned(),
            incarnation: Incarnation(1),
            udp: "10.0.0.3:6911".to_owned(),
            lost_us: 5_000_000,
            why: "crashed".to_owned(),
            silent_us: 0,
            bound_us: None,
            found_by: Vec::new(),
        };
        let here = NodeReport { lost: vec![lost], ..node_report("knee", 2, None) };
        Known::of(&here, vec![answer("knee", Ok(apps)), answer("hip", Err("no answer".to_owned()))])
    }

    #[test]
    fn misspelt_name_is_reported_with_nearest_ones() {
        assert_eq!(
            known().report("kneee", Target::One),
            "no application and no node is called `kneee`; nearest: knee (node), knee.drive (application); not all applications are \
             known of hip. `sinew apps` and `sinew nodes` list those that are there"
        );
        let text = known().report("kneee", Target::OneOrGroup);
        assert!(
            text.starts_with("no application, no node and no group with members is called `kneee`; nearest")
        );
        let text = known().report("zzz", Target::One);
        assert!(!text.contains("nearest"), "{text}");
    }

    #[test]
    fn lost_node_or_wrong_kind_of_name_is_explained() {
        let text = known().report("ankle", Target::One);
        assert!(text.contains("a node of this name was lost 5.0 s ago (crashed)"), "{text}");
        let text = known().report("camera", Target::Node);
        assert!(text.starts_with(
            "no node is called `camera` or has this address; it is an application of node knee"
        ));
        assert!(!known().report("kneee", Target::Node).contains("knee.drive"));
    }

    #[test]
    fn invalid_name_is_refused_with_the_rule_and_truncated() {
        let text = not_a_name(&"k".repeat(4_096)).expect("it is too long");
        assert!(text.contains("4096 bytes") && text.contains("at most 63") && text.len() < 250, "{text}");
        assert!(not_a_name("a|b").is_some_and(|text| text.contains("`a|b`: '|'")));
        assert_eq!(not_a_name("leg/sensor"), None);
    }
}
