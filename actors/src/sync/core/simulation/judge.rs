//! What must hold after quiet, by what each application's own node knows of it: nothing of the cores but what they say.

use std::collections::{BTreeMap, BTreeSet};

use super::{super::reason::Reason, APPS, Core, Fault, Life, NODES, Wanted, World, app_address, name};
use crate::sync::facts::Absence;

impl World {
    /// The applications that can run: all that they require can.
    fn possible(&self) -> BTreeSet<usize> {
        let mut possible = BTreeSet::new();
        for index in 0..NODES * APPS {
            let is_met = |wanted: &Wanted| wanted.is_met_by(|index| possible.contains(&index));
            if self.life_of(index).is_some_and(|life| life.requires.iter().all(is_met)) {
                possible.insert(index);
            }
        }
        possible
    }

    fn life_of(&self, index: usize) -> Option<&Life> {
        self.apps[index / APPS].get(&(index % APPS))
    }

    /// All links are up, and everything that could happen has.
    pub(super) fn verdict(&self) -> Result<(), String> {
        // Who was released and lost a requirement since is not stopped, so it may run without being possible.
        for index in self.possible() {
            let is_well = self.life_of(index).is_some_and(|life| life.released == 1 && life.running);
            require(is_well, || format!("{} can run, and does not", name(index)))?;
        }
        (0..NODES * APPS).try_for_each(|index| self.check_reasons(index))?;
        self.check_directories()
    }

    /// Who waits is told for whom and why, and that is so.
    fn check_reasons(&self, index: usize) -> Result<(), String> {
        let Some(life) = self.life_of(index).filter(|life| life.released == 0) else { return Ok(()) };
        let (core, who) = (&self.cores[index / APPS], name(index));
        let missing: Vec<Absence> = if self.fault == Some(Fault::ReasonsKept) {
            Vec::new()
        } else {
            core.missing(self.now, app_address(index % APPS))
        };
        require(!missing.is_empty(), || format!("{who} waits, and no reason is given"))?;
        // Of a requirement with several names each that is not ready is told behind it.
        let named: BTreeMap<&str, &str> = missing
            .iter()
            .map(|Absence { name, why, .. }| (name.rsplit(": ").next().unwrap_or(name), &**why))
            .collect();
        for other in 0..NODES * APPS {
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
                format!("{who} is told that {other_name} {why}, and that is not so: {life:?}")
            })?;
        }
        for wanted in &life.requires {
            let Wanted::AtLeast { count: 1, of } = wanted else { continue };
            let runs = |index: &usize| self.life_of(*index).is_some_and(|life| life.running);
            let [only] = of.iter().copied().collect::<Vec<_>>()[..] else { continue };
            let is_told = runs(&only) || named.contains_key(&*name(only));
            require(is_told, || format!("{who} waits for {} and is told of {missing:?}", name(only)))?;
        }
        Ok(())
    }

    /// All nodes have the same directory, which says what is so, and their watchers were told of it.
    fn check_directories(&self) -> Result<(), String> {
        let directories: Vec<_> = self.cores.iter().map(Core::directory).collect();
        let is_one = directories.iter().all(|directory| *directory == directories[0]);
        require(is_one, || format!("nodes have different directories: {directories:?}"))?;
        for (core, view) in self.cores.iter().zip(&self.views) {
            let known = core.directory().into_iter().map(|entry| ((entry.name, entry.tid), entry.ready));
            let known: BTreeMap<_, _> = known.collect();
            require(known == *view, || format!("a watcher was told {view:?}, and {known:?} is there"))?;
        }
        let said: BTreeMap<String, bool> =
            directories[0].iter().map(|entry| (entry.name.clone(), entry.ready)).collect();
        let there: BTreeMap<String, bool> =
            (0..NODES * APPS).filter_map(|index| Some((name(index), self.life_of(index)?.running))).collect();
        require(said == there, || format!("the directory has {said:?}, and {there:?} is there"))?;
        for entry in &directories[0] {
            let is_one = self.cores.iter().all(|core| core.called(&entry.name).first() == Some(&entry.tid));
            require(is_one, || format!("{} is not the same for all", entry.name))?;
        }
        Ok(())
    }
}

pub(super) fn require(is_so: bool, words: impl FnOnce() -> String) -> Result<(), String> {
    if is_so { Ok(()) } else { Err(words()) }
}
