//! Collects the reports of all nodes that can be asked, through every accessible socket of this host.

mod many;
mod mismatches;
mod queried;

use std::{collections::BTreeMap, time::Duration};

use sinew::{
    AppAddress, NodeAddress, Tid, Time,
    audit::Place,
    inspect::{
        AccessReport, AppReport, AppsReport, AskAccess, AskApps, AskAudit, AskNode, AskTree, AuditReport,
        GroupReport, NodeReport, Ping, StreamReport, TreeReport,
    },
    payload,
};

use super::{
    facts::{App, Facts, Namesakes, TrafficEnd, Unreported},
    resolve::{Resolved, sort_by_reachability},
};
use crate::{
    ping,
    system::{System, SystemError},
};
use queried::{Queried, doubles, first};

/// Every node that was asked.
pub(super) struct Collected<'a> {
    first: &'a mut System,
    others: Vec<System>,
    nodes: Vec<Queried>,
}

impl<'a> Collected<'a> {
    /// Asks the nodes behind these sockets, and all nodes that they know.
    pub(super) fn from(first: &'a mut System, others: Vec<System>) -> Result<Self, SystemError> {
        let mut collected = Self { first, others, nodes: Vec::new() };
        let mut heres = vec![(0, collected.first.here()?)];
        for (at, other) in collected.others.iter_mut().enumerate() {
            // A node that does not answer is known from the reports of others.
            heres.extend(other.here().ok().map(|here| (at + 1, here)));
        }
        for (through, here) in &heres {
            let own = (here.node, here.name.clone());
            collected.add(Queried::new(*through, &here.project, own, Ok(here.clone())).at_its_socket());
        }
        for (through, here) in heres {
            let unknown = |node: NodeAddress| {
                let mut asked = collected.nodes.iter().filter(|asked| asked.result.is_ok());
                !asked.any(|asked| asked.node == node && asked.project == here.project)
            };
            let peers = here.peers.iter().filter(|peer| unknown(peer.node));
            let peers: Vec<_> =
                peers.map(|peer| (peer.node, peer.name.clone().unwrap_or_default())).collect();
            for answer in collected.system(through).ask_these::<AskNode, NodeReport>(peers) {
                let peer = (answer.node, answer.name);
                collected.add(Queried::new(through, &here.project, peer, answer.result));
            }
        }
        for at in 0..collected.nodes.len() {
            let asked = &collected.nodes[at];
            if asked.result.is_err() {
                continue;
            }
            let (through, destination) = (asked.through, (asked.node, asked.name.clone()));
            let answer = collected.system(through).ask_these::<AskApps, AppsReport>(vec![destination]).pop();
            collected.nodes[at].apps =
                answer.map_or_else(|| Err("no answer".to_owned()), |answer| answer.result);
        }
        Ok(collected)
    }

    /// Releases the addresses that it had at other nodes.
    pub(super) fn leave(self) {
        self.others.into_iter().for_each(System::leave);
    }

    /// Adds the answer of a node, unless it is known already.
    fn add(&mut self, new: Queried) {
        let same = |other: &Queried| other.is_at_address_of(&new);
        let is_new = match &new.result {
            // Two incarnations with one address are two nodes.
            Ok(report) => self.nodes.iter().filter(|other| same(other)).all(|other| {
                other.result.as_ref().is_ok_and(|other| other.incarnation != report.incarnation)
            }),
            Err(_) => !self.nodes.iter().any(same),
        };
        if is_new {
            self.nodes.push(new);
        } else if new.result.is_ok() {
            // A node that did not answer one requester has answered now.
            for other in self.nodes.iter_mut().filter(|other| same(other) && other.result.is_err()) {
                (other.result, other.through) = (new.result.clone(), new.through);
            }
        }
    }

    fn system(&mut self, through: usize) -> &mut System {
        match through.checked_sub(1) {
            None => self.first,
            Some(at) => &mut self.others[at],
        }
    }

    /// Returns the facts for the rules.
    pub(super) fn facts(&mut self, wanted: [&str; 2]) -> Facts {
        let found = self.find_both(wanted);
        let ends = [self.end(wanted[0], &found[0]), self.end(wanted[1], &found[1])];
        // An application that waits for its start answers no ping, and that is known.
        let targets = [0, 1].map(|at: usize| found[at].target().filter(|_| ends[at].not_ready().is_none()));
        let pings = [self.ping(found[0].at, targets[1]), self.ping(found[1].at, targets[0])];
        let access = [self.access(&found[0], &found[1]), self.access(&found[1], &found[0])];
        let waits = self.nodes.iter().flat_map(Queried::named_apps).filter(|app| !app.ready);
        let waits: BTreeMap<_, _> = waits
            .filter_map(|app| {
                Some((app.name.clone()?, app.missing.iter().map(|missing| missing.name.clone()).collect()))
            })
            .collect();
        let lacked = self.nodes.iter().flat_map(Queried::named_apps).flat_map(|app| &app.missing);
        let lacked = lacked.filter(|missing| wanted.contains(&missing.name.as_str())).cloned().collect();
        let unreported =
            self.nodes.iter().filter_map(|asked| Some((asked.label(), asked.unreported()?))).collect();
        let apps = self.nodes.iter().flat_map(Queried::named_apps).filter_map(|app| app.name.clone());
        let names = apps.chain(self.nodes.iter().map(|asked| asked.name.clone())).collect();
        let streams = [self.stream(found[0].at, found[1].node), self.stream(found[1].at, found[0].node)];
        let mismatches = self.mismatches(&found);
        let many = self.many(wanted, &found);
        let by_groups = [
            self.by_groups(access[0].as_ref(), (&found[0], &found[1])),
            self.by_groups(access[1].as_ref(), (&found[1], &found[0])),
        ];
        Facts {
            ends,
            pings,
            streams,
            access,
            by_groups,
            mismatches,
            many,
            waits,
            lacked,
            names,
            groups: self.groups(),
            unreported,
            shut: Vec::new(),
        }
    }

    /// Returns the groups with members, as far as they are reported, and the number of members of each.
    fn groups(&self) -> BTreeMap<AppAddress, u64> {
        let mut groups = BTreeMap::new();
        let reported =
            self.nodes.iter().filter_map(|asked| asked.apps.as_ref().ok()).flat_map(|report| &report.groups);
        for GroupReport { group, members } in reported {
            *groups.entry(*group).or_default() += members;
        }
        groups
    }

    /// Resolves both words. A name of several applications means the one that the other end's messages reach. If that
    /// is ambiguous too, the first word is resolved from the entry node.
    fn find_both(&self, wanted: [&str; 2]) -> [Found; 2] {
        let here = &self.nodes[0];
        let is_open = wanted.map(|wanted| self.resolved(wanted, &here.project).len() > 1);
        if is_open == [true, false] {
            let second = self.find(wanted[1], here);
            return [self.find(wanted[0], self.seen_from(&second)), second];
        }
        let first = self.find(wanted[0], here);
        let second = self.find(wanted[1], self.seen_from(&first));
        [first, second]
    }

    /// Returns the node of that end; if it cannot be asked, the entry node.
    fn seen_from(&self, end: &Found) -> &Queried {
        let asked = end.at.map(|at| &self.nodes[at]);
        asked.filter(|asked| asked.result.is_ok()).unwrap_or(&self.nodes[0])
    }

    /// Returns the applications with this name: those in the project, if it has any.
    fn resolved(&self, name: &str, project: &str) -> Vec<Resolved> {
        let all = self
            .nodes
            .iter()
            .enumerate()
            .flat_map(|(at, asked)| asked.named_apps().iter().map(move |app| (at, app)));
        let named = all.filter(|(_, app)| app.name.as_deref() == Some(name));
        let mut resolved: Vec<_> =
            named.map(|(at, app)| Resolved { at, tid: app.tid, is_ready: app.ready }).collect();
        let is_of_project = |one: &Resolved| self.nodes[one.at].project == project;
        if resolved.iter().any(is_of_project) {
            resolved.retain(is_of_project);
        }
        resolved
    }

    /// Resolves an application's TID, a node's address, an application's name as seen from a node, or a node's name:
    /// the first match.
    fn find(&self, wanted: &str, seen_from: &Queried) -> Found {
        let at_address = |node| first(&self.nodes, &seen_from.project, |asked| asked.node == node);
        if let Ok(tid) = wanted.parse::<Tid>() {
            if many::is_many(tid) {
                return Found { many: Some(tid), ..Found::default() };
            }
            let (at, node) = (at_address(tid.node), Some(tid.node));
            return Found { at, node, app: Some(tid), ..Found::default() };
        }
        if let Ok(node) = wanted.parse::<NodeAddress>() {
            return Found { at: at_address(node), node: Some(node), ..Found::default() };
        }
        let mut resolved = self.resolved(wanted, &seen_from.project);
        if let Ok(report) = &seen_from.result {
            sort_by_reachability(&mut resolved, report);
        }
        if let Some((&Resolved { at, tid, .. }, others)) = resolved.split_first() {
            // Two processes with one address are distinguished elsewhere.
            let others: Vec<_> = others.iter().map(|other| other.tid).filter(|other| *other != tid).collect();
            let namesakes = Namesakes { tid, seen_from: seen_from.name.clone(), others };
            let namesakes = Some(namesakes).filter(|namesakes| !namesakes.others.is_empty());
            return Found { at: Some(at), node: Some(tid.node), app: Some(tid), namesakes, many: None };
        }
        if let Some(at) = first(&self.nodes, &seen_from.project, |asked| asked.name == wanted) {
            return Found { at: Some(at), node: Some(self.nodes[at].node), ..Found::default() };
        }
        // No answering node: a lost one, or one of another project.
        let reports = || self.nodes.iter().filter_map(|asked| asked.result.as_ref().ok());
        let lost =
            reports().flat_map(|report| &report.lost).find(|lost| lost.name == wanted).map(|lost| lost.node);
        let foreign = || reports().flat_map(|report| &report.foreign).find(|other| other.name == wanted);
        Found { node: lost.or_else(|| foreign().map(|other| other.node)), ..Found::default() }
    }

    fn end(&mut self, wanted: &str, found: &Found) -> TrafficEnd {
        let (wanted, namesakes) = (wanted.to_owned(), found.namesakes.clone());
        let mut end = TrafficEnd { wanted, node: found.node, namesakes, ..TrafficEnd::default() };
        let Some(at) = found.at else {
            end.app = found.app.map(|_| App::default());
            return end;
        };
        let asked = &self.nodes[at];
        match &asked.result {
            Ok(report) => end.report = Some(report.clone()),
            Err(why) => end.silence = Some(why.clone()),
        }
        end.doubles = doubles(&self.nodes, at);
        if let Some(tid) = found.app {
            let report = asked.app(tid);
            end.app = Some(self.application(at, tid, report));
        }
        end
    }

    fn application(
        &mut self,
        at: usize,
        tid: Tid,
        (report, unreported): (Option<AppReport>, Option<Unreported>),
    ) -> App {
        let asked = &self.nodes[at];
        let (through, destination) = (asked.through, (asked.node, asked.name.clone()));
        let system = self.system(through);
        let tree = system.ask_these::<AskTree, TreeReport>(vec![destination.clone()]).pop();
        let lines = tree.and_then(|answer| answer.result.ok()).map_or_else(Vec::new, |report| report.lines);
        let audit = system.ask_these::<AskAudit, AuditReport>(vec![destination]).pop();
        let entries =
            audit.and_then(|answer| answer.result.ok()).map_or_else(Vec::new, |report| report.audit.entries);
        let is_its = |place: &Place| match place {
            Place::Mailbox { app, .. } | Place::Client { app, .. } => *app == tid.app,
            Place::DirectLink { .. }
            | Place::ToNode { .. }
            | Place::FromNode { .. }
            | Place::OtherMailboxes
            | Place::OtherClients
            | Place::OtherDirectLinks
            | Place::ToFormerNodes
            | Place::FromFormerNodes => false,
        };
        let refused =
            entries.iter().filter(|entry| is_its(&entry.place)).map(|entry| entry.account.refused).sum();
        let mut direct = Vec::new();
        for entry in &entries {
            if let Place::DirectLink { from, to, .. } = &entry.place
                && *from == tid.app
            {
                direct.push((*to, entry.account));
            }
        }
        App {
            report,
            unreported,
            line: lines.into_iter().find(|line| line.tid == Some(tid)),
            refused,
            direct,
        }
    }

    /// Returns whether the access list of the target's node lets the source send to it, if both are applications.
    fn access(&mut self, source: &Found, target: &Found) -> Option<AccessReport> {
        let asked = AskAccess { source: source.app?, target: target.app? };
        let there = &self.nodes[target.at?];
        if there.result.is_err() {
            return None;
        }
        let through = there.through;
        let system = self.system(through);
        let inspection = Tid::new(asked.target.node, AppAddress::INSPECT);
        // A node of an older version does not know the question, and has no list.
        system.endpoint.message(inspection, &asked).ask(system.within).ok()
    }

    /// Sends a ping from the node itself, if it has a socket here.
    fn ping(&mut self, from: Option<usize>, to: Option<Tid>) -> Option<Result<u64, String>> {
        let (asked, to) = (&self.nodes[from?], to?);
        if !asked.is_own_socket {
            return None;
        }
        let through = asked.through;
        let system = self.system(through);
        let began = Time::now();
        let outcome = system.endpoint.message(to, &Ping {}).confirmed(system.within);
        let took = u64::try_from(Time::now().since(began).as_micros()).unwrap_or(u64::MAX);
        let judged = outcome
            .map_err(|error| error.to_string())
            .and_then(|outcome| ping::judged(outcome, system.within));
        Some(judged.map(|()| took))
    }
}

payload!("sinew.ping", Stream =>
    /// A sign of life that is sent as a value of class Stream.
    struct Value {}
);

/// Interval between two checks whether a value has arrived.
const LOOK: Duration = Duration::from_millis(10);
/// Time limit for its acknowledgement: it arrives a millisecond and a round trip later, and is requested again if lost.
const VALUE_WITHIN: Duration = Duration::from_millis(500);

impl Collected<'_> {
    /// Sends a value of class Stream from the node itself, if it has a socket here. Returns its counts when the value
    /// has arrived, or after the time limit.
    fn stream(&mut self, from: Option<usize>, to: Option<NodeAddress>) -> Option<StreamReport> {
        let (asked, to) = (&self.nodes[from?], to?);
        let of = |report: &NodeReport| report.peers.iter().find(|peer| peer.node == to)?.stream.clone();
        let before = of(asked.result.as_ref().ok()?).filter(|stream| stream.is_agreed)?;
        if !asked.is_own_socket || asked.node == to {
            return None;
        }
        let (through, destination) = (asked.through, (asked.node, asked.name.clone()));
        let system = self.system(through);
        let until = Time::now() + VALUE_WITHIN.min(system.within);
        system.endpoint.send(Tid::new(to, AppAddress::INSPECT), &Value {}).ok()?;
        loop {
            let answer = system.ask_these::<AskNode, NodeReport>(vec![destination.clone()]).pop()?;
            let after = of(&answer.result.ok()?)?;
            if after.arrived > before.arrived || Time::now() >= until {
                return Some(after);
            }
            std::thread::sleep(LOOK);
        }
    }
}

/// The meaning of a word.
#[derive(Default)]
struct Found {
    /// Its index among the asked nodes.
    at: Option<usize>,
    node: Option<NodeAddress>,
    app: Option<Tid>,
    namesakes: Option<Namesakes>,
    /// Set if a TID of many was given; then the other fields are empty.
    many: Option<Tid>,
}

impl Found {
    /// Returns the destination of a message for it.
    fn target(&self) -> Option<Tid> {
        Some(Tid::new(self.node?, self.app.map_or(AppAddress::INSPECT, |tid| tid.app)))
    }
}
