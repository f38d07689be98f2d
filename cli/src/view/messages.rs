//! Copies of the messages of applications, for the page.
//!
//! A node of this host records them into its journal, which is read here, if this user may use its socket. Any other
//! node is asked for them over the network, as `sinew watch` does. In both cases no sender waits, and the copies end
//! within seconds of the last call.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::Duration,
};

use sinew::{
    AppAddress, NodeAddress, Tid, Time,
    inspect::{AskRecord, AskWatch, RecordReport, SeenMessage, Selection, WatchReport},
};
use sinew_recorder::{Connection, Follower, Seen};
use sinew_view::{Sighting, Tap};

use super::{Entry, Names};
use crate::{
    param,
    system::{System, in_words},
};

/// Time between two looks at the addresses of the applications: one may be restarted elsewhere.
const RESOLVED_EVERY: Duration = Duration::from_secs(2);
/// Time between two questions to a node with a journal out of reach.
const WATCHED_EVERY: Duration = Duration::from_millis(50);
/// Questions to such a node in a row, while it has more.
const WATCHED_MAX: usize = 8;
/// Time limit for each question: meanwhile nothing else is read.
pub(super) const ASKED_WITHIN: Duration = Duration::from_millis(500);

/// Reads messages, with the connections that this takes.
pub(super) struct Messages {
    entry: Arc<Entry>,
    within: Duration,
    /// The connection to the entry node, through which applications are found and other nodes are asked.
    system: Option<System>,
    apps: BTreeSet<String>,
    /// The applications that were found.
    found: BTreeMap<String, Tid>,
    /// Their addresses.
    read: BTreeSet<Tid>,
    /// Applications that were not found, and nodes that refuse, with the reason.
    faults: BTreeMap<String, String>,
    resolve_due: Time,
    watch_due: Time,
    journals: BTreeMap<NodeAddress, Follower<Own>>,
    /// Nodes with a journal out of reach.
    others: BTreeSet<NodeAddress>,
    /// Those that gave no answer: they are asked again after the next look at the addresses, since nothing else is read
    /// meanwhile.
    silent: BTreeSet<NodeAddress>,
}

/// The connection to a node of this host.
pub(super) struct Own {
    system: System,
    entry: Arc<Entry>,
}

impl Own {
    /// Takes a connection with addresses that the entry knows.
    pub(super) const fn new(system: System, entry: Arc<Entry>) -> Self {
        Self { system, entry }
    }
}

impl Drop for Own {
    fn drop(&mut self) {
        // The end of the connection releases the address.
        let own = &self.system.own;
        self.entry.own().retain(|tid| !own.contains(tid));
    }
}

impl Connection for Own {
    fn ask(&mut self, question: &AskRecord, within: Duration) -> Result<RecordReport, String> {
        self.system.discard();
        let to = Tid::new(self.node(), AppAddress::INSPECT);
        self.system.endpoint.message(to, question).ask(within).map_err(|error| in_words(&error))
    }

    fn node(&self) -> NodeAddress {
        self.system.endpoint.tid().node
    }

    fn own(&self) -> Vec<Tid> {
        self.entry.own().iter().copied().collect()
    }

    fn patience(&self) -> Duration {
        ASKED_WITHIN
    }
}

impl Messages {
    pub(super) fn new(entry: Arc<Entry>, within: Duration) -> Self {
        let now = Time::now();
        Self {
            entry,
            within: within.min(ASKED_WITHIN),
            system: None,
            apps: BTreeSet::new(),
            found: BTreeMap::new(),
            read: BTreeSet::new(),
            faults: BTreeMap::new(),
            resolve_due: now,
            watch_due: now,
            journals: BTreeMap::new(),
            others: BTreeSet::new(),
            silent: BTreeSet::new(),
        }
    }

    /// Finds the applications, and fits the readers to them.
    fn resolve(&mut self, now: Time) -> Result<(), String> {
        self.resolve_due = now + RESOLVED_EVERY;
        self.faults.clear();
        self.silent.clear();
        let mut system = match self.system.take() {
            Some(system) => system,
            None => self.entry.enter(self.within)?,
        };
        system.discard();
        if let Err(why) = self.find(&mut system) {
            self.entry.leave(system);
            return Err(why);
        }
        self.read = self.found.values().copied().collect();
        let nodes: BTreeSet<_> = self.read.iter().map(|tid| tid.node).collect();
        self.journals.retain(|node, _| nodes.contains(node));
        self.others.retain(|node| nodes.contains(node));
        for node in nodes {
            self.open(&mut system, node);
        }
        self.system = Some(system);
        Ok(())
    }

    /// Finds the addresses of the applications.
    fn find(&mut self, system: &mut System) -> Result<(), String> {
        let known: BTreeMap<_, _> =
            self.entry.names().iter().map(|(tid, name)| (name.clone(), *tid)).collect();
        self.found.clear();
        for app in &self.apps {
            let tid = match known.get(app) {
                Some(tid) => Some(*tid),
                None => system.endpoint.resolve(app, self.within).map_err(|why| why.to_string())?,
            };
            match tid {
                Some(tid) => drop(self.found.insert(app.clone(), tid)),
                None => drop(self.faults.insert(app.clone(), "no application has this name now".to_owned())),
            }
        }
        Ok(())
    }

    /// Begins to read the messages of a node, or selects others.
    fn open(&mut self, system: &mut System, node: NodeAddress) {
        let of_node = self.found.iter().filter(|(_, tid)| tid.node == node);
        let apps = of_node.map(|(app, _)| app.clone()).collect();
        let selection = Selection { apps, ..Selection::default() };
        if let Some(journal) = self.journals.get_mut(&node) {
            if journal.select(selection).is_err() {
                self.journals.remove(&node);
            }
            return;
        }
        if self.others.contains(&node) {
            return;
        }
        let own = if node == system.endpoint.tid().node {
            self.entry.enter(self.within).ok()
        } else {
            param::enter_node(system, node).inspect(|own| self.entry.add(own))
        };
        let journal = own.map(|system| Own::new(system, Arc::clone(&self.entry)));
        match journal.and_then(|own| Follower::begin(own, selection).ok()) {
            Some(journal) => drop(self.journals.insert(node, journal)),
            None => drop(self.others.insert(node)),
        }
    }

    fn read_journals(&mut self, take: &mut dyn FnMut(&Sighting<'_>)) {
        let names = self.entry.names();
        let (faults, read) = (&mut self.faults, &self.read);
        self.journals.retain(|node, journal| {
            let polled = journal.poll(&mut |seen| {
                // The journal of a node has one copy of a message between two of its applications.
                if seen.destination.node == *node
                    || !has_another_copy(seen.is_sent && !seen.is_rejected, seen.destination, read)
                {
                    hand_over(seen, &names, take);
                }
            });
            polled.map_err(|why| faults.insert(node.to_string(), why.to_string())).is_ok()
        });
    }

    fn ask_others(&mut self, take: &mut dyn FnMut(&Sighting<'_>)) {
        let Some(system) = &mut self.system else { return };
        let (names, read) = (self.entry.names(), &self.read);
        for (app, tid) in self.found.iter().filter(|(_, tid)| self.others.contains(&tid.node)) {
            if self.silent.contains(&tid.node) {
                continue;
            }
            let question = AskWatch { app: *tid, received: true, sent: true };
            let to = Tid::new(tid.node, AppAddress::INSPECT);
            for _ in 0..WATCHED_MAX {
                let asked = system.endpoint.message(to, &question).ask::<WatchReport>(self.within);
                let report = match asked {
                    Ok(WatchReport { refused: Some(why), .. }) => Err(why),
                    Ok(report) => Ok(report),
                    Err(why) => {
                        self.silent.insert(tid.node);
                        Err(in_words(&why))
                    }
                };
                match report {
                    Ok(report) => {
                        let now = Time::now();
                        let shown = |seen: &&SeenMessage| {
                            !has_another_copy(seen.is_sent && seen.refused.is_none(), seen.target, read)
                        };
                        report.seen.iter().filter(shown).for_each(|seen| {
                            show_watched(seen, now, &names, take);
                        });
                        if !report.more {
                            break;
                        }
                    }
                    Err(why) => {
                        self.faults.insert(app.clone(), why);
                        break;
                    }
                }
            }
        }
    }
}

impl Tap for Messages {
    fn poll(&mut self, apps: &BTreeSet<String>, take: &mut dyn FnMut(&Sighting<'_>)) -> Vec<String> {
        let now = Time::now();
        if self.apps != *apps {
            self.apps.clone_from(apps);
            self.resolve_due = now;
        }
        if now >= self.resolve_due
            && let Err(why) = self.resolve(now)
        {
            return vec![why];
        }
        self.read_journals(take);
        if now >= self.watch_due && !self.others.is_empty() {
            self.watch_due = now + WATCHED_EVERY;
            self.ask_others(take);
        }
        self.faults.iter().map(|(subject, why)| format!("{subject}: {why}")).collect()
    }
}

impl Drop for Messages {
    fn drop(&mut self) {
        while let Some((_, journal)) = self.journals.pop_first() {
            // Ends the recording now, and not with its lease.
            drop(journal.finish());
        }
        if let Some(system) = self.system.take() {
            self.entry.leave(system);
        }
    }
}

/// Returns whether a copy of the sender has another one at the destination, which is read: that one has the age of the
/// message, and the sender's is left out. A message that was rejected at its sender has none.
fn has_another_copy(has_left: bool, destination: Tid, read: &BTreeSet<Tid>) -> bool {
    has_left && read.contains(&destination)
}

/// Returns the name of an address, or its text.
fn name_of(tid: Tid, names: &Names) -> String {
    names.get(&tid).cloned().unwrap_or_else(|| tid.to_string())
}

fn hand_over(seen: &Seen<'_>, names: &Names, take: &mut dyn FnMut(&Sighting<'_>)) {
    let name = |tid| seen.names.app(tid).map_or_else(|| name_of(tid, names), str::to_owned);
    let kind = seen.names.type_name(seen.header.kind);
    take(&Sighting {
        source: &name(seen.header.source),
        destination: &name(seen.destination),
        kind: &kind.map_or_else(|| seen.header.kind.to_string(), str::to_owned),
        at: seen.at,
        age: seen.header.age(seen.at),
        is_rejected: seen.is_rejected,
        payload: seen.payload,
    });
}

/// Hands over a message that another node has reported. Its time is that of this host, less the age of the report.
fn show_watched(seen: &SeenMessage, now: Time, names: &Names, take: &mut dyn FnMut(&Sighting<'_>)) {
    let ago = Duration::from_micros(seen.seen_us);
    let at =
        Time::from_nanos(now.as_nanos().saturating_sub(u64::try_from(ago.as_nanos()).unwrap_or(u64::MAX)));
    take(&Sighting {
        source: &name_of(seen.source, names),
        destination: &name_of(seen.target, names),
        kind: &seen.name.clone().unwrap_or_else(|| seen.kind.to_string()),
        at,
        age: seen.age_ns.map(Duration::from_nanos),
        is_rejected: seen.refused.is_some(),
        payload: &seen.payload,
    });
}

#[cfg(test)]
mod tests {
    use sinew::message::{Class, Kind};

    use super::*;

    #[test]
    fn message_between_chosen_applications_is_shown_once() {
        let [sender, receiver] =
            [0x0a00_0001, 0x0a00_0002].map(|node| Tid::new(NodeAddress::new(node), AppAddress::new(0x1001)));
        let (both, one) = (BTreeSet::from([sender, receiver]), BTreeSet::from([sender]));
        let copies = |read| [true, false].map(|has_left| !has_another_copy(has_left, receiver, read));
        assert_eq!(copies(&both), [false, true]);
        // Only the sender's node is asked.
        assert!(copies(&one)[0]);
    }

    #[test]
    fn watched_message_has_a_time_of_this_host() {
        let tid = |app| Tid::new(NodeAddress::new(0x0a00_0002), AppAddress::new(app));
        let seen = SeenMessage {
            seen_us: 2_000,
            age_ns: Some(1_500),
            age_error_ns: Some(0),
            is_sent: false,
            source: tid(0x1001),
            target: tid(0x1002),
            kind: Kind::named("exo.angle"),
            name: None,
            class: Class::Stream,
            sequence: 1,
            wants: None,
            length: 1,
            payload: vec![0xc0],
            refused: None,
        };
        let names = Names::from([(tid(0x1001), "knee.sensor".to_owned())]);
        let mut count = 0;
        show_watched(&seen, Time::from_nanos(5_000_000), &names, &mut |shown| {
            count += 1;
            assert_eq!(
                (shown.at, shown.age),
                (Time::from_nanos(3_000_000), Some(Duration::from_nanos(1_500)))
            );
            assert_eq!((shown.source, shown.destination), ("knee.sensor", tid(0x1002).to_string().as_str()));
            assert_eq!(
                (shown.kind, shown.payload),
                (Kind::named("exo.angle").to_string().as_str(), &[0xc0][..])
            );
            assert!(!shown.is_rejected);
        });
        assert_eq!(count, 1);
    }
}
