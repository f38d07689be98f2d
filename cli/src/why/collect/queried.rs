//! The nodes that were asked, and their answers.

use sinew::{
    NodeAddress, Tid,
    inspect::{AppReport, AppsReport, NodeReport},
};

use super::super::facts::Unreported;

/// A node that was asked, or could not be.
pub(super) struct Queried {
    pub(super) node: NodeAddress,
    pub(super) name: String,
    /// Its project; without a report, that of the node through which it was asked. Nodes of several projects may have
    /// one address.
    pub(super) project: String,
    pub(super) result: Result<NodeReport, String>,
    /// Asked only if the node's own report arrived.
    pub(super) apps: Result<AppsReport, String>,
    /// The socket through which it was asked.
    pub(super) through: usize,
    /// Whether that is its own socket.
    pub(super) is_own_socket: bool,
}

impl Queried {
    /// `project` is that of the node through which it was asked.
    pub(super) fn new(
        through: usize,
        project: &str,
        (node, name): (NodeAddress, String),
        result: Result<NodeReport, String>,
    ) -> Self {
        let (name, project) = match &result {
            Ok(report) => (report.name.clone(), report.project.clone()),
            Err(_) => (name, project.to_owned()),
        };
        let apps = Err("it was not asked".to_owned());
        Self { node, name, project, result, apps, through, is_own_socket: false }
    }

    /// Returns whether it has the address of the other one, in the same project.
    pub(super) fn is_at_address_of(&self, other: &Self) -> bool {
        (self.node, &self.project) == (other.node, &other.project)
    }

    pub(super) fn at_its_socket(self) -> Self {
        Self { is_own_socket: true, ..self }
    }

    pub(super) fn label(&self) -> String {
        if self.name.is_empty() { self.node.to_string() } else { self.name.clone() }
    }

    /// Returns the applications that it has listed.
    pub(super) fn named_apps(&self) -> &[AppReport] {
        self.apps.as_ref().map_or(&[][..], |report| report.apps.as_slice())
    }

    /// Returns why it may have further ones.
    pub(super) fn unreported(&self) -> Option<Unreported> {
        match self.result.as_ref().and(self.apps.as_ref()) {
            Ok(report) => (report.left_out > 0).then_some(Unreported::LeftOut(report.left_out)),
            Err(why) => Some(Unreported::Silent(why.clone())),
        }
    }

    /// Returns its report about an application; or, without one, why the application may exist nevertheless.
    pub(super) fn app(&self, tid: Tid) -> (Option<AppReport>, Option<Unreported>) {
        let report = self.named_apps().iter().find(|app| app.tid == tid).cloned();
        let unreported = if report.is_none() { self.unreported() } else { None };
        (report, unreported)
    }
}

/// Returns the index of the first such node: one of the project, if there is one.
pub(super) fn first(nodes: &[Queried], project: &str, is_wanted: impl Fn(&Queried) -> bool) -> Option<usize> {
    let wanted = || nodes.iter().enumerate().filter(|(_, asked)| is_wanted(asked));
    let found = wanted().find(|(_, asked)| asked.project == project).or_else(|| wanted().next());
    found.map(|(at, _)| at)
}

/// Returns the other nodes with the address of this one. Those of another project are none: they ignore each other.
pub(super) fn doubles(nodes: &[Queried], at: usize) -> Vec<String> {
    let others = nodes.iter().enumerate().filter(|(other, _)| *other != at);
    others
        .filter(|(_, other)| other.is_at_address_of(&nodes[at]))
        .filter_map(|(_, other)| other.result.as_ref().ok())
        .map(|other| format!("node {} (process {})", other.name, other.pid))
        .collect()
}

#[cfg(test)]
mod tests {
    use sinew::AppAddress;

    use super::*;
    use crate::security;

    #[test]
    fn application_is_absent_only_after_a_complete_report() {
        let report = security::tests::node_report("knee", 2, None);
        let destination = || (report.node, report.name.clone());
        let tid = Tid::new(report.node, AppAddress::new(0x1001));
        let apps = |left_out| AppsReport {
            name: "knee".to_owned(),
            apps: Vec::new(),
            left_out,
            barriers: Vec::new(),
            barriers_left_out: 0,
            groups: Vec::new(),
            groups_left_out: 0,
        };
        let of =
            |apps| Queried { apps, ..Queried::new(0, "leg", destination(), Ok(report.clone())) }.app(tid);
        assert_eq!(of(Ok(apps(0))), (None, None));
        assert_eq!(of(Ok(apps(3))), (None, Some(Unreported::LeftOut(3))));
        let full = || "its queue is full".to_owned();
        assert_eq!(of(Err(full())), (None, Some(Unreported::Silent(full()))));
        let silent = Queried::new(0, "leg", destination(), Err("no answer".to_owned()));
        assert_eq!(silent.app(tid), (None, Some(Unreported::Silent("no answer".to_owned()))));
    }

    #[test]
    fn address_in_another_project_is_another_one() {
        // Given: a node of another project with the knee's address, which was asked first
        let knee = |project: &str| NodeReport {
            project: project.to_owned(),
            ..security::tests::node_report("knee", 2, None)
        };
        let asked = |project: &str| {
            let report = knee(project);
            Queried::new(0, project, (report.node, report.name.clone()), Ok(report))
        };
        let nodes = [asked("arm"), asked("leg")];
        let node = nodes[0].node;
        // Then: none has the address twice, and the address means that of the own project
        assert_eq!((doubles(&nodes, 0).len(), doubles(&nodes, 1).len()), (0, 0));
        assert_eq!(first(&nodes, "leg", |asked| asked.node == node), Some(1));
        assert_eq!(first(&nodes, "arm", |asked| asked.name == "knee"), Some(0));
        assert_eq!(first(&nodes, "hand", |asked| asked.node == node), Some(0), "else the first one");
        // And: two of one project have it twice
        let nodes = [asked("leg"), asked("leg")];
        assert!(matches!(&doubles(&nodes, 1)[..], [one] if one.starts_with("node knee (process ")));
    }
}
