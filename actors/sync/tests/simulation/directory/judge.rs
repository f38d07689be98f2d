//! The rules that must hold after quiet, by each node's knowledge of its own applications. Of the cores only
//! their reports are used.

use sinew_model::directory::Absence;
use sinew_sync::core::Reason;

use super::{apps::Life, *};

impl World {
    /// Returns the applications that can run: all their requirements can run.
    fn possible(&self) -> BTreeSet<usize> {
        let is_shared = |index: &usize| index % SLOTS == SHARED;
        let all = 0..self.nodes * SLOTS;
        // An application that is required by the shared name requires none.
        let shared = all.clone().filter(is_shared).filter(|index| self.life_of(*index).is_some());
        let mut possible: BTreeSet<usize> = shared.collect();
        for index in all.filter(|index| !is_shared(index)) {
            let state = |index: usize| {
                if possible.contains(&index) { AppState::PhaseReached } else { AppState::NotRunning }
            };
            let is_met =
                |wanted: &Wanted| wanted.wait_limit().is_some() || wanted.is_met_by(self.nodes, state);
            if self.life_of(index).is_some_and(|life| life.requires.iter().all(is_met)) {
                possible.insert(index);
            }
        }
        possible
    }

    fn life_of(&self, index: usize) -> Option<&Life> {
        self.apps[index / SLOTS].get(&(index % SLOTS))
    }

    /// Checks the state in which all links are up and every possible event has happened.
    pub(super) fn verdict(&self) -> Result<(), String> {
        // A released application that has lost a requirement is not stopped, so it may run without being
        // possible.
        for index in self.possible() {
            let is_well = self.life_of(index).is_some_and(|life| life.released == 1 && life.running);
            require(is_well, || format!("{} of node {} can run, and does not", name(index), index / SLOTS))?;
        }
        (0..self.nodes * SLOTS).try_for_each(|index| self.check_reasons(index))?;
        (0..self.nodes * SLOTS).try_for_each(|index| self.check_notified(index))?;
        self.check_directories()
    }

    /// Checks that a running application knows exactly its missing requirements, whether or not it kept the
    /// notifications of earlier lives.
    fn check_notified(&self, index: usize) -> Result<(), String> {
        let Some(life) = self.life_of(index).filter(|life| life.running) else { return Ok(()) };
        let state = |index: usize| self.life_of(index).map_or(AppState::NotRunning, Life::state);
        let lacks = life.requires.iter().filter(|wanted| !wanted.is_met_by(self.nodes, state));
        let lacks: BTreeSet<String> = lacks.map(|wanted| wanted.requirement().to_string()).collect();
        let Life { notified, inherited, .. } = life;
        require(lacks == *notified && lacks == *inherited, || {
            format!(
                "{} lacks {lacks:?}, and was notified of {notified:?}, in all lives {inherited:?}",
                name(index)
            )
        })
    }

    /// Checks that a waiting application is given its missing requirements with true reasons.
    fn check_reasons(&self, index: usize) -> Result<(), String> {
        let Some(life) = self.life_of(index).filter(|life| life.released == 0) else { return Ok(()) };
        let (core, who) = (&self.cores[index / SLOTS], name(index));
        let missing: Vec<Absence> = if self.fault == Some(Fault::ReasonsKept) {
            Vec::new()
        } else {
            core.missing(self.now, app_address(index % SLOTS))
        };
        require(!missing.is_empty(), || format!("{who} waits, and no reason is given"))?;
        // Of a requirement with several names, each that is not ready is listed behind it.
        let named: BTreeMap<&str, &str> = missing
            .iter()
            .map(|Absence { name, why, .. }| (name.rsplit(": ").next().unwrap_or(name), &**why))
            .collect();
        // The shared name belongs to more than one application.
        for other in (0..self.nodes * SLOTS).filter(|other| other % SLOTS != SHARED) {
            let other_name = name(other);
            let life = self.life_of(other);
            let Some(why) = named.get(&*other_name) else { continue };
            let is_so = match life {
                Some(life) if life.running => false,
                Some(_) => [Reason::NotReady, Reason::Failed].map(Reason::words).contains(why),
                None => ![Reason::NotReady, Reason::Failed, Reason::LinkDown, Reason::ListAwaited]
                    .map(Reason::words)
                    .contains(why),
            };
            require(is_so, || {
                format!("{who} is given the reason that {other_name} {why}, and that is not so: {life:?}")
            })?;
        }
        for wanted in &life.requires {
            let Wanted::AtLeast { count: 1, of } = wanted else { continue };
            let runs = |index: &usize| self.life_of(*index).is_some_and(|life| life.running);
            let [only] = of.iter().copied().collect::<Vec<_>>()[..] else { continue };
            let is_reported = runs(&only) || named.contains_key(&*name(only));
            require(is_reported, || format!("{who} waits for {} and is given {missing:?}", name(only)))?;
        }
        Ok(())
    }

    /// Checks that all nodes have the same, true directory, and that their subscribers were notified of it.
    fn check_directories(&self) -> Result<(), String> {
        let first = self.cores[0].directory();
        for (node, core) in self.cores.iter().enumerate().skip(1) {
            let other = core.directory();
            require(other == first, || {
                format!("nodes 0 and {node} have different directories: {first:?} and {other:?}")
            })?;
        }
        let known: BTreeMap<_, _> =
            first.iter().map(|entry| ((entry.name.clone(), entry.tid), entry.ready)).collect();
        for (node, view) in self.views.iter().enumerate().filter(|(node, _)| self.is_watched(*node)) {
            require(known == *view, || {
                format!("a watcher of node {node} received {view:?}, and {known:?} is there")
            })?;
        }
        let listed: BTreeMap<usize, bool> =
            first.iter().map(|entry| (index_of(entry.tid), entry.ready)).collect();
        let there = (0..self.nodes * SLOTS).filter_map(|index| Some((index, self.life_of(index)?.running)));
        let there: BTreeMap<usize, bool> = there.collect();
        require(listed == there, || format!("the directory has {listed:?}, and {there:?} is there"))?;
        self.check_names(&there)
    }

    /// Checks the resolution of names, for all nodes: first to the node itself, then to a ready application,
    /// then to the lowest address.
    fn check_names(&self, there: &BTreeMap<usize, bool>) -> Result<(), String> {
        let mut names: BTreeMap<String, Vec<usize>> = BTreeMap::new();
        for index in there.keys() {
            names.entry(name(*index)).or_default().push(index / SLOTS);
        }
        for (node, core) in self.cores.iter().enumerate() {
            for (name, nodes) in &names {
                let is_ready = |other: usize| {
                    let mut of_it = there.iter().filter(|(index, _)| self::name(**index) == *name);
                    of_it.any(|(index, is_ready)| index / SLOTS == other && *is_ready)
                };
                let mut right = nodes.clone();
                right.sort_by_key(|other| (*other != node, !is_ready(*other), *other));
                let right: Vec<NodeAddress> = right.into_iter().map(address).collect();
                let called: Vec<NodeAddress> = core.called(name).iter().map(|tid| tid.node).collect();
                require(called == right, || {
                    format!("for node {node} {name} is of {called:?}, and is to be of {right:?}")
                })?;
            }
        }
        Ok(())
    }
}

pub(super) fn require(is_so: bool, words: impl FnOnce() -> String) -> Result<(), String> {
    if is_so { Ok(()) } else { Err(words()) }
}
