//! Checks of the whole state: each 50 ms, and at the end, after a long time without faults.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_runtime::tid::NodeAddress;

use crate::{
    apps::{App, MEMBER, Stage, node_of_name},
    plan::NODES,
    world::{World, node_address},
};

/// Time without a link after which no application of the node counts as ready: longer than any event waits.
const UNLINKED_MAX: Duration = Duration::from_millis(150);

impl World {
    /// Checks that no directory has a ready application of a node without a link.
    pub(crate) fn look(&mut self) {
        let now = self.queue.now();
        for process in self.running() {
            let others = self.nodes().filter(|other| *other != self.node_of(process));
            for address in others.map(node_address).collect::<Vec<_>>() {
                let p = &mut self.processes[process];
                if p.store.0.get(&address).is_some_and(|peer| peer.is_linked()) {
                    p.unlinked_since.remove(&address);
                    continue;
                }
                let since = *p.unlinked_since.entry(address).or_insert(now);
                let directory = p.sync.directory();
                let ready = directory.iter().find(|entry| entry.tid.node == address && entry.ready);
                if let Some(ready) = ready
                    && since + UNLINKED_MAX <= now
                {
                    let name = &ready.name;
                    self.judge.violate(format!(
                        "the directory of process {process} has {name} ready, and no link to its node since {:?}",
                        now.since(since)
                    ));
                }
            }
        }
    }

    /// Checks the state at the end.
    pub(crate) fn judge_rest(&mut self) {
        let running = self.running();
        let truth: BTreeMap<String, bool> = running
            .iter()
            .flat_map(|process| &self.processes[*process].apps)
            .map(|app| (app.name.clone(), app.stage == Stage::Ready))
            .collect();
        for process in running.iter().copied() {
            self.judge_members(process);
            self.judge_directory(process, &truth);
            for app in self.processes[process].apps.clone() {
                self.judge_app(process, &app, &truth);
            }
        }
        self.judge_barrier(&running);
    }

    fn judge_members(&mut self, process: usize) {
        let others = self.running().into_iter().filter(|other| *other != process);
        let others: BTreeMap<NodeAddress, _> =
            others.map(|other| (self.processes[other].address, self.processes[other].incarnation)).collect();
        let members = self.processes[process].ndl.members(self.local(process));
        let members: BTreeMap<_, _> =
            members.iter().map(|member| (member.node, member.incarnation)).collect();
        if members != others {
            self.judge.violate(format!("at rest NDL of {process} has {members:?}, and {others:?} are there"));
        }
        let peers = self.processes[process].store.0.iter().filter(|(_, peer)| peer.is_linked());
        let linked: BTreeMap<_, _> = peers.map(|(node, peer)| (*node, peer.incarnation)).collect();
        if linked != others {
            self.judge.violate(format!(
                "at rest GNCL of {process} has links to {linked:?}, and {others:?} are there"
            ));
        }
    }

    fn judge_directory(&mut self, process: usize, truth: &BTreeMap<String, bool>) {
        let directory = self.processes[process].sync.directory();
        let directory: BTreeMap<_, _> =
            directory.into_iter().map(|entry| (entry.name, entry.ready)).collect();
        if directory != *truth {
            self.judge.violate(format!(
                "at rest the directory of {process} is {directory:?}, and {truth:?} is true"
            ));
        }
    }

    fn judge_app(&mut self, process: usize, app: &App, truth: &BTreeMap<String, bool>) {
        let is_missing = |name: &&String| truth.get(*name) != Some(&true);
        let missing: BTreeSet<String> = app.requires.iter().filter(is_missing).cloned().collect();
        let notified = self.judge.notified_lost_of(process, app);
        if app.stage == Stage::Ready && notified != missing {
            self.judge.violate(format!("{} lacks {missing:?}, and was notified of {notified:?}", app.name));
        }
        let is_free = app.requires.iter().all(|name| self.current(node_of_name(name)).is_some());
        if app.stage != Stage::Ready && is_free && missing.is_empty() {
            self.judge.violate(format!("{} has all that it requires, and is {:?}", app.name, app.stage));
        }
    }

    /// Checks that all members have met, if each node runs.
    fn judge_barrier(&mut self, running: &[usize]) {
        let members: Vec<App> =
            running.iter().map(|process| self.processes[*process].apps[MEMBER].clone()).collect();
        if members.len() < NODES || members.iter().any(|member| member.stage != Stage::Ready) {
            return;
        }
        let waiting: Vec<_> =
            members.iter().filter(|member| member.waits.is_some()).map(|app| &app.name).collect();
        let generations: BTreeSet<_> =
            members.iter().map(|app| self.judge.last_generation(&app.name)).collect();
        if !waiting.is_empty() || generations.len() > 1 {
            self.judge
                .violate(format!("at rest {waiting:?} wait, and the last generations are {generations:?}"));
        }
    }
}
