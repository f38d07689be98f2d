//! The directory: the applications of this node, and those that other nodes published.

use std::collections::BTreeSet;

use sinew_model::{
    directory::DirectoryEntry,
    nearest::{COMPARED_MAX, nearest},
};
use sinew_runtime::{
    app::{Requirement, matches},
    tid::{NodeAddress, Tid},
};

use super::{
    Input, Output, Reason,
    apps::{App, Apps, State},
    outputs::Outputs,
    peers::Peers,
};
use crate::{list::Name, own_app::AppTypes};

/// Maximum number of duplicate names that are reported.
const DUPLICATES_MAX: usize = 1_024;

/// A view of all known applications.
#[derive(Clone, Copy, Debug)]
pub(super) struct Directory<'core> {
    pub(super) apps: &'core Apps,
    pub(super) peers: &'core Peers,
}

impl<'core> Directory<'core> {
    /// Returns the TIDs of the applications called `name`. The local one is first, ready or not, so that a
    /// message to a local name never goes to another node. The others follow: ready ones, then those on
    /// linked nodes, then by address. spec: SYNC-6
    pub(super) fn called(self, name: &str) -> Vec<Tid> {
        let here = self.apps.called(name).map(|(app, _)| Tid::new(self.peers.here(), app));
        here.into_iter().chain(self.peers.resolve(name)).collect()
    }

    /// Returns every application with a name, on this node and on all known nodes that are not lost, by name
    /// and address.
    pub(super) fn entries(self) -> Vec<DirectoryEntry> {
        let here = self.apps.iter().filter_map(|(address, app)| {
            let tid = Tid::new(self.peers.here(), address);
            Some((app.name.as_ref()?, tid, app.state == State::Ready, &app.kinds))
        });
        let mut entries: Vec<_> = here
            .chain(self.peers.directory())
            .map(|(name, tid, ready, kinds)| DirectoryEntry {
                name: name.to_string(),
                tid,
                ready,
                kinds: kinds.clone(),
            })
            .collect();
        entries.sort_by(|a, b| (&a.name, a.tid).cmp(&(&b.name, b.tid)));
        entries
    }

    /// Returns every application of this node with declared types.
    pub(super) fn own_declared_types(self) -> impl Iterator<Item = AppTypes> {
        let declared = self.apps.iter().filter(|(_, app)| !app.types.is_empty());
        declared.map(move |(address, app)| AppTypes {
            tid: Tid::new(self.peers.here(), address),
            name: app.title(address),
            types: app.types.clone(),
        })
    }

    /// Returns every application with declared types, on this node and on all known nodes that are not lost.
    pub(super) fn declared_types(self) -> Vec<AppTypes> {
        self.own_declared_types().chain(self.peers.declared_types(None)).collect()
    }

    /// Returns the name of an application of this node, or of another one that is not lost.
    pub(super) fn name_of(self, tid: Tid) -> Option<String> {
        if tid.node == self.peers.here() {
            return self.apps.get(tid.app).map(|app| app.title(tid.app));
        }
        self.peers.listed(tid).map(|entry| entry.name.to_string())
    }

    /// Returns the names of applications, on this node and on all known nodes that are not lost. The result
    /// has at most `COMPARED_MAX` names.
    pub(super) fn names(self) -> Vec<Name> {
        let here = self.apps.iter().filter_map(|(_, app)| app.name.as_ref());
        here.chain(self.peers.directory().map(|(name, ..)| name)).take(COMPARED_MAX).cloned().collect()
    }

    /// Returns every name that this node or another one has ever published and not withdrawn.
    pub(super) fn all_names(self) -> impl Iterator<Item = &'core Name> {
        self.apps.names().chain(self.peers.names())
    }

    /// Returns the names that match `pattern`.
    pub(super) fn names_like(self, pattern: &str) -> impl Iterator<Item = &'core Name> {
        self.all_names().filter(move |name| matches(pattern, name))
    }

    /// Returns the applications called `name`, and why each is not ready, or has not reached a phase.
    pub(super) fn states(
        self,
        name: &'core str,
        phase: Option<&'core str>,
    ) -> impl Iterator<Item = (Tid, Option<Reason>)> {
        let here = self.apps.called(name);
        let here = here.map(move |(address, app)| (Tid::new(self.peers.here(), address), app.why_not(phase)));
        here.into_iter().chain(self.peers.states(name, phase))
    }

    /// Returns the requirements of each application called `name`, for nodes with valid state.
    pub(super) fn requirements(self, name: &str) -> Vec<Vec<Requirement>> {
        let here = self.apps.called(name).map(|(_, app)| app.requires.clone());
        here.into_iter().chain(self.peers.requirements(name)).collect()
    }

    /// Returns the names of other applications that are similar to `name`, with their states, the most
    /// similar first.
    pub(super) fn nearest(self, name: &str, own: Option<&str>) -> Vec<String> {
        let is_ready = |app: &App| app.state == State::Ready;
        let here = self.apps.iter().filter_map(|(_, app)| Some((app.name.as_ref()?, is_ready(app))));
        let there = self.peers.directory().map(|(name, _, is_ready, _)| (name, is_ready));
        let others = here.chain(there).filter(|(other, _)| Some(&***other) != own);
        nearest(name, others, |(other, _)| other)
            .into_iter()
            .map(|(other, is_ready)| format!("{other} ({})", if is_ready { "ready" } else { "starting" }))
            .collect()
    }
}

/// The names that were reported as duplicate.
#[derive(Debug, Default)]
pub(super) struct DuplicateNames(BTreeSet<String>);

impl DuplicateNames {
    /// Reports, once, that several nodes have an application called `name`.
    pub(super) fn check(&mut self, name: &str, directory: Directory<'_>, outputs: &mut Outputs) {
        let tids = directory.called(name);
        if tids.len() > 1 && self.0.len() < DUPLICATES_MAX && self.0.insert(name.to_owned()) {
            outputs.push(Output::SameName { name: name.to_owned(), tids });
        }
    }
}

/// The nodes with names that an input may change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NamesChanged {
    None,
    Of(NodeAddress),
    All,
}

impl Input {
    /// Returns which other nodes' names this input may change.
    pub(crate) const fn names_changed(&self) -> NamesChanged {
        match self {
            Self::ListReceived { from, .. } => NamesChanged::Of(*from),
            // The new node may replace a lost one in a full table.
            Self::LinkChanged(_) | Self::MembershipChanged(_) => NamesChanged::All,
            Self::AppChanged(_)
            | Self::GroupsChanged(_)
            | Self::Arrived { .. }
            | Self::Left { .. }
            | Self::AnswerRejected { .. }
            | Self::ArrivalsReceived { .. }
            | Self::ArrivalsRejected { .. }
            | Self::ListRejected { .. }
            | Self::DirectoryWanted { .. }
            | Self::DirectoryRejected { .. }
            | Self::ReleaseRejected { .. }
            | Self::EventRejected { .. }
            | Self::RoomMade
            | Self::TimePassed => NamesChanged::None,
        }
    }
}
