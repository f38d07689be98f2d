//! Channels and views of messages as recordings have them, for Foxglove.
//!
//! The channels are known before any message is read: the nodes know which application sends which type with which
//! structure. Messages are read from the journals of the nodes of this host, and only while one of their topics is
//! wanted.

mod expected;

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::Duration,
};

use sinew::{NodeAddress, Time, inspect::Selection, message::Kind};
use sinew_bag::ViewWriter;
use sinew_recorder::{LiveViews, ViewChannel, ViewItem};
use sinew_view::{Live, LiveChannel, LiveItem};

use super::{
    Entry,
    messages::{ASKED_WITHIN, Own},
};
use crate::{
    param,
    system::{System, present},
};
use expected::Expected;

/// Time between two looks at the applications and their types, while a client is connected.
const LOOKED_EVERY: Duration = Duration::from_secs(5);
/// Time after which a node is tried again, if its journal was out of reach.
const RETRIED_EVERY: Duration = Duration::from_secs(30);
/// Time after which a node is looked for that has ended a recording.
const RENEWED_AFTER: Duration = Duration::from_secs(1);
/// Maximum number of topics with a known origin: as many as the server for Foxglove offers. Others are left out.
const ORIGINS_MAX: usize = 4_096;

/// The topics that are about all messages: they have all that are shown recorded.
const ABOUT_ALL: [&str; 2] = ["/sinew/tally", "/sinew/outcomes"];
/// Selects no message: none of Sinew's own types has this name. Events, barriers, clocks and log lines are in each
/// journal.
const NO_TYPE: &str = "sinew.view.none";

/// The source, the type and the node of the messages of a topic.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Origin {
    source: String,
    type_name: String,
    /// Whether both are names, by which a node selects messages.
    is_named: bool,
    /// The node of the source.
    node: NodeAddress,
}

/// Reads channels and views, with the connections that this takes.
pub(super) struct Channels {
    entry: Arc<Entry>,
    within: Duration,
    /// The selection of the messages that are shown.
    shown: Selection,
    origins: BTreeMap<String, Origin>,
    fixed: BTreeSet<String>,
    /// Whether the channels that every recording has were handed over.
    is_begun: bool,
    /// The nodes with a journal in reach; `None`: nothing of it is wanted.
    local: BTreeMap<NodeAddress, Option<LiveViews<Own>>>,
    /// Nodes with a journal out of reach: when each is tried again, and its name.
    remote: BTreeMap<NodeAddress, (Time, String)>,
    wanted: BTreeSet<String>,
    look_due: Time,
    /// The last type that the latest look has asked for.
    last_kind: Option<Kind>,
    faults: Vec<String>,
}

impl Channels {
    pub(super) fn new(entry: Arc<Entry>, within: Duration, shown: Selection) -> Self {
        Self {
            entry,
            within: within.min(ASKED_WITHIN),
            shown,
            origins: BTreeMap::new(),
            fixed: BTreeSet::new(),
            is_begun: false,
            local: BTreeMap::new(),
            remote: BTreeMap::new(),
            wanted: BTreeSet::new(),
            look_due: Time::now(),
            last_kind: None,
            faults: Vec::new(),
        }
    }

    /// Finds nodes, applications and the types that they send.
    fn look(&mut self, now: Time, take: &mut dyn FnMut(LiveItem<'_>)) -> Result<(), String> {
        self.look_due = now + LOOKED_EVERY;
        let mut system = self.entry.enter(self.within)?;
        let found = self.find(&mut system, now);
        self.entry.leave(system);
        for Expected { channel, origin } in found? {
            if let Some(known) = self.origins.get_mut(&channel.topic) {
                // The application may run on another node now. Its channel has the structure that the journal has.
                *known = origin;
            } else if self.origins.len() < ORIGINS_MAX {
                self.origins.insert(channel.topic.clone(), origin);
                take(LiveItem::Channel(shown(channel)));
            }
        }
        Ok(())
    }

    fn find(&mut self, system: &mut System, now: Time) -> Result<Vec<Expected>, String> {
        let here = system.here().map_err(|why| why.to_string())?;
        let nodes: BTreeMap<_, _> = present(&here).into_iter().collect();
        self.local.retain(|node, live| live.is_some() || nodes.contains_key(node));
        self.remote.retain(|node, _| nodes.contains_key(node));
        for (node, name) in nodes {
            let is_due = self.remote.get(&node).is_none_or(|(due, _)| now >= *due);
            if self.local.contains_key(&node) || !is_due {
                continue;
            }
            if self.reach(system, node) {
                self.remote.remove(&node);
                self.local.insert(node, None);
            } else {
                self.remote.insert(node, (now + RETRIED_EVERY, name));
            }
        }
        self.faults = self
            .remote
            .values()
            .map(|(_, name)| {
                format!("{name}: only the messages between it and the nodes here are shown; for the others run sinew view on its host, as its user")
            })
            .collect();
        Ok(expected::find(system, &here, &self.shown, &mut self.last_kind))
    }

    /// Returns whether this program can use the socket of a node.
    fn reach(&self, system: &mut System, node: NodeAddress) -> bool {
        if node == system.endpoint.tid().node {
            return true;
        }
        let Some(own) = self.connect(system, node) else { return false };
        self.entry.leave(own);
        true
    }

    /// Registers at a node of this host.
    fn connect(&self, system: &mut System, node: NodeAddress) -> Option<System> {
        if node == system.endpoint.tid().node {
            return self.entry.enter(self.within).ok();
        }
        param::enter_node(system, node).inspect(|own| self.entry.add(own))
    }

    /// Fits the readers to the wanted topics.
    fn fit(&mut self) {
        let nodes: Vec<_> = self.local.keys().copied().collect();
        let here: BTreeSet<_> = nodes.iter().copied().collect();
        for node in nodes {
            let wanted = self.wanted_of(node, &here);
            let selection = self.selection(&wanted);
            let Some(selection) = selection else {
                let idle = self.local.get_mut(&node).and_then(Option::take);
                // Ends the recording now, and not with its lease.
                drop(idle.map(LiveViews::finish));
                continue;
            };
            if let Err(why) = self.read_from(node, selection, &wanted) {
                self.faults.push(format!("{node}: {why}"));
                self.local.remove(&node);
                self.remote.insert(node, (Time::now() + LOOKED_EVERY, node.to_string()));
            }
        }
    }

    /// Returns the wanted topics that are read from a node: those of its applications, and of sources with a node out
    /// of reach.
    fn wanted_of(&self, node: NodeAddress, here: &BTreeSet<NodeAddress>) -> BTreeSet<String> {
        let is_of = |topic: &&String| {
            self.fixed.contains(*topic)
                || self
                    .origins
                    .get(*topic)
                    .is_some_and(|origin| origin.node == node || !here.contains(&origin.node))
        };
        self.wanted.iter().filter(is_of).cloned().collect()
    }

    /// Returns the messages that a node has to record; `None` if nothing of it is wanted.
    fn selection(&self, wanted: &BTreeSet<String>) -> Option<Selection> {
        if wanted.is_empty() {
            return None;
        }
        if ABOUT_ALL.iter().any(|topic| wanted.contains(*topic)) {
            return Some(self.shown.clone());
        }
        let origins: Vec<_> = wanted.iter().filter_map(|topic| self.origins.get(topic)).collect();
        if origins.is_empty() {
            return Some(Selection { types: vec![NO_TYPE.to_owned()], ..Selection::default() });
        }
        let names = |of: fn(&Origin) -> &String| {
            let names: BTreeSet<_> = origins.iter().map(|origin| of(origin).clone()).collect();
            names.into_iter().collect()
        };
        let (apps, types) = (names(|origin| &origin.source), names(|origin| &origin.type_name));
        let selection = Selection { apps, types, ..Selection::default() };
        // A selection has a limited number of names.
        let can_select = origins.iter().all(|origin| origin.is_named) && selection.check().is_ok();
        Some(if can_select { selection } else { self.shown.clone() })
    }

    /// Has a node record these messages, and reads the wanted topics from it.
    fn read_from(
        &mut self,
        node: NodeAddress,
        selection: Selection,
        wanted: &BTreeSet<String>,
    ) -> Result<(), String> {
        if let Some(live) = self.local.get_mut(&node).and_then(Option::as_mut) {
            live.select(selection).map_err(|why| why.to_string())?;
            live.want(wanted);
            return Ok(());
        }
        let mut system = self.entry.enter(self.within)?;
        let own = self.connect(&mut system, node);
        self.entry.leave(system);
        let own = own.ok_or("its socket does not accept this program; run it as the user of the node")?;
        let own = Own::new(own, Arc::clone(&self.entry));
        let live = LiveViews::begin(own, selection, self.shown.clone());
        let mut live = live.map_err(|why| why.to_string())?;
        live.want(wanted);
        self.local.insert(node, Some(live));
        Ok(())
    }

    fn read(&mut self, take: &mut dyn FnMut(LiveItem<'_>)) {
        let here: BTreeSet<_> = self.local.keys().copied().collect();
        let (origins, mut failed) = (&mut self.origins, Vec::new());
        for (node, live) in &mut self.local {
            let Some(live) = live else { continue };
            let polled = live.poll(&mut |item| match item {
                ViewItem::Channel(channel) => {
                    let Some(origin) = origin_of(&channel, *node, &here) else { return };
                    if origins.len() >= ORIGINS_MAX && !origins.contains_key(&channel.topic) {
                        return;
                    }
                    origins.insert(channel.topic.clone(), origin);
                    take(LiveItem::Channel(shown(channel)));
                }
                ViewItem::Message { topic, time_ns, data } => {
                    take(LiveItem::Message { topic: &topic, time_ns, data: &data });
                }
                ViewItem::Missed { count, .. } => take(LiveItem::Missed(count)),
            });
            if let Err(why) = polled {
                failed.push((*node, why.to_string()));
            }
        }
        for (node, why) in failed {
            self.faults.push(format!("{node}: {why}"));
            self.local.remove(&node);
            // The next look finds it, if it is still there.
            self.remote.remove(&node);
            self.look_due = self.look_due.min(Time::now() + RENEWED_AFTER);
        }
    }
}

impl Live for Channels {
    fn poll(&mut self, wanted: &BTreeSet<String>, take: &mut dyn FnMut(LiveItem<'_>)) -> Vec<String> {
        let now = Time::now();
        if !std::mem::replace(&mut self.is_begun, true) {
            for channel in ViewWriter::fixed_channels() {
                self.fixed.insert(channel.topic.clone());
                take(LiveItem::Channel(shown(channel)));
            }
        }
        let is_looked = now >= self.look_due;
        if is_looked && let Err(why) = self.look(now, take) {
            self.faults = vec![why];
        }
        if is_looked || self.wanted != *wanted {
            self.wanted.clone_from(wanted);
            self.fit();
        }
        self.read(take);
        self.faults.clone()
    }
}

impl Drop for Channels {
    fn drop(&mut self) {
        while let Some((_, live)) = self.local.pop_first() {
            drop(live.map(LiveViews::finish));
        }
    }
}

/// Returns the origin of a channel that the journal of `node` has; `None` if the journal of another node here has a
/// copy, that of the sender.
fn origin_of(channel: &ViewChannel, node: NodeAddress, here: &BTreeSet<NodeAddress>) -> Option<Origin> {
    let of = |key: &str| channel.metadata.get(key).filter(|value| !value.is_empty());
    let source_node = of("sinew.source_node").and_then(|text| text.parse().ok()).unwrap_or(node);
    if source_node != node && here.contains(&source_node) {
        return None;
    }
    let type_name = of("sinew.type")?.clone();
    // A type without a known name has its number as text.
    let is_named = of("sinew.kind") == Some(&Kind::named(&type_name).bits().to_string());
    let name = of("sinew.source_name");
    let source = name.or_else(|| of("sinew.source"))?.clone();
    Some(Origin { source, type_name, is_named: is_named && name.is_some(), node: source_node })
}

fn shown(channel: ViewChannel) -> LiveChannel {
    let ViewChannel { topic, encoding, schema_name, schema_encoding, schema, metadata } = channel;
    LiveChannel {
        topic,
        encoding: encoding.to_owned(),
        schema_name,
        schema_encoding: schema_encoding.to_owned(),
        schema,
        metadata,
    }
}

#[cfg(test)]
mod tests;
