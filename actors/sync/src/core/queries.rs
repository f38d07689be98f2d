//! Queries of the core's state, by the shell, other layers and tools.

use sinew_model::{
    barrier::BarrierStatus,
    directory::{Absence, DirectoryEntry, Waiting},
    facts::TypeHash,
};
use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
};
use sinew_security::access::ReportedNames;

use super::{
    Core, Reason,
    apps::{App, State},
    directory::Directory,
    readiness::Readiness,
};
use crate::{
    list::Name,
    own_app::{AppTypes, ListVersion, OwnApp},
};

impl Core {
    const fn all(&self) -> Directory<'_> {
        Directory { apps: &self.apps, peers: &self.peers }
    }

    const fn readiness(&self) -> Readiness<'_> {
        Readiness { directory: self.all(), findings: self.start_barrier.findings() }
    }

    /// Returns the TIDs of the applications called `name`. The local one is first, ready or not, so that a
    /// message to a local name never goes to another node. The others follow: ready ones, then those on
    /// linked nodes, then by address. spec: SYNC-6
    pub fn called(&self, name: &str) -> Vec<Tid> {
        self.all().called(name)
    }

    /// Returns every application with a name, on this node and on all known nodes that are not lost, by name
    /// and address.
    pub fn directory(&self) -> Vec<DirectoryEntry> {
        self.all().entries()
    }

    /// Returns every application with declared types, on this node and on all known nodes that are not lost.
    pub fn declared_types(&self) -> Vec<AppTypes> {
        self.all().declared_types()
    }

    /// Returns every application of this node with declared types.
    pub fn own_declared_types(&self) -> Vec<AppTypes> {
        self.all().own_declared_types().collect()
    }

    /// Returns the version of the list of each known node that is not lost.
    pub fn list_versions(&self) -> Vec<(NodeAddress, ListVersion)> {
        self.peers.list_versions().collect()
    }

    /// Returns every application with declared types of another node, unless that is lost.
    pub fn declared_types_of(&self, node: NodeAddress) -> Vec<AppTypes> {
        self.peers.declared_types(Some(node)).collect()
    }

    /// Returns the name of an application of this node, or of another one that is not lost.
    pub fn name_of(&self, tid: Tid) -> Option<String> {
        self.all().name_of(tid)
    }

    /// Returns whether another node lists that its application handles the type of this structure.
    pub fn lists_handled(&self, tid: Tid, of: TypeHash) -> bool {
        self.peers.listed(tid).is_some_and(|entry| entry.handles.contains(&of))
    }

    /// Returns the names of applications, on this node and on all known nodes that are not lost. The result
    /// has at most `COMPARED_MAX` names.
    pub fn names(&self) -> Vec<Name> {
        self.all().names()
    }

    /// Returns the groups of this node's list.
    pub fn listed_groups(&self) -> Vec<AppAddress> {
        self.own_list.groups().to_vec()
    }

    /// Returns the last published names of other nodes, or of `node` alone.
    pub fn names_elsewhere(&self, node: Option<NodeAddress>) -> impl Iterator<Item = ReportedNames<'_>> {
        self.peers.published_names(node)
    }

    /// Returns the applications that wait at the start-up barrier, with the missing requirements, since when
    /// and why.
    pub fn waiting(&self, now: Time) -> Vec<Waiting> {
        let waiting = self.apps.waiting().map(|(address, ..)| address);
        waiting.filter_map(|app| self.readiness().wait_of(now, app)).collect()
    }

    /// Returns the missing requirements of this application, since when and why. While it runs, these are the
    /// requirements that were reported as lost. The missing parties of its phases follow.
    pub fn missing(&self, now: Time, address: AppAddress) -> Vec<Absence> {
        let readiness = self.readiness();
        if let Some(waiting) = readiness.wait_of(now, address) {
            return waiting.missing;
        }
        let mut missing = readiness.losses_of(now, address);
        if let Some((_, absences)) = self.barriers.absences_at_phases(now, address, readiness) {
            missing.extend(absences);
        }
        missing
    }

    /// Returns the missing requirements of the application at `address`, with bounded effort. Returns nothing
    /// if the application does not wait at the start-up barrier, or is not known.
    pub fn missing_in_brief(&self, address: AppAddress) -> Vec<(String, &'static str)> {
        self.readiness().missing_in_brief(address)
    }

    /// Returns why `name` is missing and since when, if an application of this node requires it by this name
    /// and it is known to be gone.
    pub fn why_required_is_missing(&self, now: Time, name: &str) -> Option<String> {
        let missing = self.apps.iter().flat_map(|(address, _)| self.missing(now, address));
        let unknown = Reason::NotThere.words();
        let mut of_name = missing.filter(|absence| absence.name == name && !absence.why.starts_with(unknown));
        of_name.next().map(|Absence { why, since, .. }| format!("{why} ({:.1} s ago)", since.as_secs_f64()))
    }

    /// Returns at most `max` applications of this node in the order of their addresses, and how many more
    /// there are.
    pub fn own_apps(&self, now: Time, max: usize) -> (Vec<OwnApp>, usize) {
        let at_phases = |app| Some(self.barriers.absences_at_phases(now, app, self.readiness())?.0);
        let view = |(address, app): (AppAddress, &App)| OwnApp {
            app: address,
            name: app.name.as_ref().map(ToString::to_string),
            ready: app.state == State::Ready,
            missing: self.missing(now, address),
            waits: app.wait().map(|wait| now.since(wait.since)).or_else(|| at_phases(address)),
            ended: app.ended.map(|ended| Reason::from(ended).words()),
            kinds: app.kinds.clone(),
        };
        let apps: Vec<_> = self.apps.iter().take(max).map(view).collect();
        let more = self.apps.iter().count() - apps.len();
        (apps, more)
    }

    /// Returns the barriers at which local applications wait, with the missing parties of each.
    pub fn barriers(&self, now: Time) -> Vec<BarrierStatus> {
        self.barriers.statuses(now, self.readiness())
    }

    /// Returns whether this cycle exists, in the notation of [`Output::Cycle`](super::Output::Cycle).
    pub fn has_cycle(&self, closed: &[String]) -> bool {
        self.start_barrier.has_cycle(closed)
    }
}
