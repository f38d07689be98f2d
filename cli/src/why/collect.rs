//! What all nodes say that can be asked, through every socket of this host that lets us in.

mod many;

use std::{collections::BTreeMap, time::Duration};

use sinew::{
    AppAddress, NodeAddress, Tid, Time,
    audit::Place,
    inspect::{
        AccessReport, AppReport, AppsReport, AskAccess, AskApps, AskAudit, AskNode, AskTree, AuditReport,
        NodeReport, Ping, StreamReport, TreeReport,
    },
    payload,
};

use super::{
    facts::{App, End, Facts, Namesakes, Unsaid},
    resolve::{Called, by_whom_is_reached},
};
use crate::{
    ping,
    system::{Fault, System},
};

/// Every node that was asked.
pub(super) struct Gathered<'a> {
    first: &'a mut System,
    others: Vec<System>,
    nodes: Vec<Asked>,
}

/// A node that was asked, or could not be.
struct Asked {
    node: NodeAddress,
    name: String,
    said: Result<NodeReport, String>,
    /// Asked for where it has said who it is.
    apps: Result<AppsReport, String>,
    /// Through which socket.
    through: usize,
    /// Whether that is its own.
    is_own_door: bool,
}

impl Asked {
    fn new(through: usize, (node, name): (NodeAddress, String), said: Result<NodeReport, String>) -> Self {
        let name = said.as_ref().map_or(name, |said| said.name.clone());
        let apps = Err("it was not asked".to_owned());
        Self { node, name, said, apps, through, is_own_door: false }
    }

    fn at_its_door(self) -> Self {
        Self { is_own_door: true, ..self }
    }

    fn label(&self) -> String {
        if self.name.is_empty() { self.node.to_string() } else { self.name.clone() }
    }

    /// The applications that it has named.
    fn named_apps(&self) -> &[AppReport] {
        self.apps.as_ref().map_or(&[][..], |said| said.apps.as_slice())
    }

    /// Why it may have others, too.
    fn unsaid(&self) -> Option<Unsaid> {
        match self.said.as_ref().and(self.apps.as_ref()) {
            Ok(said) => (said.left_out > 0).then_some(Unsaid::LeftOut(said.left_out)),
            Err(why) => Some(Unsaid::Silent(why.clone())),
        }
    }

    /// What it says of an application that it is to have; if nothing, why that may be there all the same.
    fn app(&self, tid: Tid) -> (Option<AppReport>, Option<Unsaid>) {
        let report = self.named_apps().iter().find(|app| app.tid == tid).cloned();
        let unsaid = if report.is_none() { self.unsaid() } else { None };
        (report, unsaid)
    }
}

impl<'a> Gathered<'a> {
    /// Asks the nodes behind these sockets, and all that they know.
    pub(super) fn from(first: &'a mut System, others: Vec<System>) -> Result<Self, Fault> {
        let mut gathered = Self { first, others, nodes: Vec::new() };
        let mut heres = vec![(0, gathered.first.here()?)];
        for (at, other) in gathered.others.iter_mut().enumerate() {
            // One that does not answer is known by what the others say of it.
            heres.extend(other.here().ok().map(|here| (at + 1, here)));
        }
        for (through, here) in &heres {
            gathered
                .add(Asked::new(*through, (here.node, here.name.clone()), Ok(here.clone())).at_its_door());
        }
        for (through, here) in heres {
            let unknown = |node: NodeAddress| {
                gathered.nodes.iter().all(|asked| asked.node != node || asked.said.is_err())
            };
            let peers = here.peers.iter().filter(|peer| unknown(peer.node));
            let peers: Vec<_> =
                peers.map(|peer| (peer.node, peer.name.clone().unwrap_or_default())).collect();
            for answer in gathered.system(through).ask_these::<AskNode, NodeReport>(peers) {
                gathered.add(Asked::new(through, (answer.node, answer.name), answer.said));
            }
        }
        for at in 0..gathered.nodes.len() {
            let asked = &gathered.nodes[at];
            if asked.said.is_err() {
                continue;
            }
            let (through, whom) = (asked.through, (asked.node, asked.name.clone()));
            let answer = gathered.system(through).ask_these::<AskApps, AppsReport>(vec![whom]).pop();
            gathered.nodes[at].apps =
                answer.map_or_else(|| Err("no answer".to_owned()), |answer| answer.said);
        }
        Ok(gathered)
    }

    /// Gives back the addresses that it had at other nodes.
    pub(super) fn leave(self) {
        self.others.into_iter().for_each(System::leave);
    }

    /// Takes down what one said who was asked, unless it is known already.
    fn add(&mut self, new: Asked) {
        let same = |other: &Asked| other.node == new.node;
        let is_new =
            match &new.said {
                // Two lives with one address are two.
                Ok(said) => self.nodes.iter().filter(|other| same(other)).all(|other| {
                    other.said.as_ref().is_ok_and(|other| other.incarnation != said.incarnation)
                }),
                Err(_) => !self.nodes.iter().any(same),
            };
        if is_new {
            self.nodes.push(new);
        } else if new.said.is_ok() {
            // Who did not answer one of the others has answered now.
            for other in self.nodes.iter_mut().filter(|other| same(other) && other.said.is_err()) {
                (other.said, other.through) = (new.said.clone(), new.through);
            }
        }
    }

    fn system(&mut self, through: usize) -> &mut System {
        match through.checked_sub(1) {
            None => self.first,
            Some(at) => &mut self.others[at],
        }
    }

    /// What the rules look at.
    pub(super) fn facts(&mut self, wanted: [&str; 2]) -> Facts {
        let found = self.find_both(wanted);
        let ends = [self.end(wanted[0], &found[0]), self.end(wanted[1], &found[1])];
        // What waits for its start answers no ping, and that is known.
        let targets = [0, 1].map(|at: usize| found[at].target().filter(|_| ends[at].not_ready().is_none()));
        let pings = [self.ping(found[0].at, targets[1]), self.ping(found[1].at, targets[0])];
        let access = [self.access(&found[0], &found[1]), self.access(&found[1], &found[0])];
        let waits = self.nodes.iter().flat_map(Asked::named_apps).filter(|app| !app.ready);
        let waits: BTreeMap<_, _> = waits
            .filter_map(|app| {
                Some((app.name.clone()?, app.missing.iter().map(|missing| missing.name.clone()).collect()))
            })
            .collect();
        let lacked = self.nodes.iter().flat_map(Asked::named_apps).flat_map(|app| &app.missing);
        let lacked = lacked.filter(|missing| wanted.contains(&missing.name.as_str())).cloned().collect();
        let unsaid = self.nodes.iter().filter_map(|asked| Some((asked.label(), asked.unsaid()?))).collect();
        let streams = [self.stream(found[0].at, found[1].node), self.stream(found[1].at, found[0].node)];
        let many = self.many(wanted, &found);
        let by_groups = [
            self.by_groups(access[0].as_ref(), (&found[0], &found[1])),
            self.by_groups(access[1].as_ref(), (&found[1], &found[0])),
        ];
        Facts { ends, pings, streams, access, by_groups, many, waits, lacked, unsaid, shut: Vec::new() }
    }

    /// Whom two words mean. A name that several applications have stands for the one that the other end's messages reach; where that is open, too,
    /// the first word is resolved from the node through which we came.
    fn find_both(&self, wanted: [&str; 2]) -> [Found; 2] {
        let is_open = wanted.map(|wanted| self.called(wanted).len() > 1);
        let here = &self.nodes[0];
        if is_open == [true, false] {
            let second = self.find(wanted[1], here);
            return [self.find(wanted[0], self.seen_from(&second)), second];
        }
        let first = self.find(wanted[0], here);
        let second = self.find(wanted[1], self.seen_from(&first));
        [first, second]
    }

    /// The node where that end is; if it cannot be asked, the one through which we came.
    fn seen_from(&self, end: &Found) -> &Asked {
        let asked = end.at.map(|at| &self.nodes[at]);
        asked.filter(|asked| asked.said.is_ok()).unwrap_or(&self.nodes[0])
    }

    /// The applications that have this name.
    fn called(&self, name: &str) -> Vec<Called> {
        let all = self
            .nodes
            .iter()
            .enumerate()
            .flat_map(|(at, asked)| asked.named_apps().iter().map(move |app| (at, app)));
        let named = all.filter(|(_, app)| app.name.as_deref() == Some(name));
        named.map(|(at, app)| Called { at, tid: app.tid, is_ready: app.ready }).collect()
    }

    /// An application's TID, a node's address, an application's name as it is resolved from a node, a node's name: the first that it is.
    fn find(&self, wanted: &str, seen_from: &Asked) -> Found {
        let at_address = |node| self.nodes.iter().position(|asked| asked.node == node);
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
        let mut called = self.called(wanted);
        if let Ok(report) = &seen_from.said {
            by_whom_is_reached(&mut called, report);
        }
        if let Some((&Called { at, tid, .. }, others)) = called.split_first() {
            // Two processes with one address are told apart elsewhere.
            let others: Vec<_> = others.iter().map(|other| other.tid).filter(|other| *other != tid).collect();
            let namesakes = Namesakes { tid, seen_from: seen_from.name.clone(), others };
            let namesakes = Some(namesakes).filter(|namesakes| !namesakes.others.is_empty());
            return Found { at: Some(at), node: Some(tid.node), app: Some(tid), namesakes, many: None };
        }
        if let Some(at) = self.nodes.iter().position(|asked| asked.name == wanted) {
            return Found { at: Some(at), node: Some(self.nodes[at].node), ..Found::default() };
        }
        // Nobody who answers: one that was lost, or is of another project.
        let reports = || self.nodes.iter().filter_map(|asked| asked.said.as_ref().ok());
        let lost =
            reports().flat_map(|report| &report.lost).find(|lost| lost.name == wanted).map(|lost| lost.node);
        let foreign = || reports().flat_map(|report| &report.foreign).find(|other| other.name == wanted);
        Found { node: lost.or_else(|| foreign().map(|other| other.node)), ..Found::default() }
    }

    fn end(&mut self, wanted: &str, found: &Found) -> End {
        let (wanted, namesakes) = (wanted.to_owned(), found.namesakes.clone());
        let mut end = End { wanted, node: found.node, namesakes, ..End::default() };
        let Some(at) = found.at else {
            end.app = found.app.map(|_| App::default());
            return end;
        };
        let asked = &self.nodes[at];
        match &asked.said {
            Ok(report) => end.report = Some(report.clone()),
            Err(why) => end.silence = Some(why.clone()),
        }
        let others = self.nodes.iter().enumerate().filter(|(other, _)| *other != at);
        let others = others.filter(|(_, other)| other.node == asked.node);
        end.doubles = others
            .filter_map(|(_, other)| other.said.as_ref().ok())
            .map(|other| format!("node {} (process {})", other.name, other.pid))
            .collect();
        if let Some(tid) = found.app {
            let said = asked.app(tid);
            end.app = Some(self.application(at, tid, said));
        }
        end
    }

    fn application(
        &mut self,
        at: usize,
        tid: Tid,
        (report, unsaid): (Option<AppReport>, Option<Unsaid>),
    ) -> App {
        let asked = &self.nodes[at];
        let (through, whom) = (asked.through, (asked.node, asked.name.clone()));
        let system = self.system(through);
        let tree = system.ask_these::<AskTree, TreeReport>(vec![whom.clone()]).pop();
        let lines = tree.and_then(|answer| answer.said.ok()).map_or_else(Vec::new, |said| said.lines);
        let audit = system.ask_these::<AskAudit, AuditReport>(vec![whom]).pop();
        let entries =
            audit.and_then(|answer| answer.said.ok()).map_or_else(Vec::new, |said| said.audit.entries);
        let is_its = |place: &Place| match place {
            Place::Mailbox { app, .. } | Place::Client { app, .. } => *app == tid.app,
            Place::ToNode { .. }
            | Place::FromNode { .. }
            | Place::OtherMailboxes
            | Place::OtherClients
            | Place::ToFormerNodes
            | Place::FromFormerNodes => false,
        };
        let refused =
            entries.iter().filter(|entry| is_its(&entry.place)).map(|entry| entry.account.refused).sum();
        App { report, unsaid, line: lines.into_iter().find(|line| line.tid == Some(tid)), refused }
    }

    /// Whether the access list of the target's node lets the source send to it, where both are applications.
    fn access(&mut self, source: &Found, target: &Found) -> Option<AccessReport> {
        let asked = AskAccess { source: source.app?, target: target.app? };
        let there = &self.nodes[target.at?];
        if there.said.is_err() {
            return None;
        }
        let through = there.through;
        let system = self.system(through);
        let inspection = Tid::new(asked.target.node, AppAddress::INSPECT);
        // A node of an older version does not know the question, and has no list.
        system.endpoint.message(inspection, &asked).ask(system.within).ok()
    }

    /// A ping from the very node, if it has a door here.
    fn ping(&mut self, from: Option<usize>, to: Option<Tid>) -> Option<Result<u64, String>> {
        let (asked, to) = (&self.nodes[from?], to?);
        if !asked.is_own_door {
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
    /// A sign of life that goes as a value of class Stream does.
    struct Value {}
);

/// Time between two looks whether a value has arrived.
const LOOK: Duration = Duration::from_millis(10);
/// Time for its acknowledgement: it comes a millisecond and a round trip after it, and is asked for again where it was lost.
const VALUE_WITHIN: Duration = Duration::from_millis(500);

impl Gathered<'_> {
    /// Sends a value of class Stream from the very node, if it has a door here, and gives what it has counted when it has arrived, or when
    /// it should have.
    fn stream(&mut self, from: Option<usize>, to: Option<NodeAddress>) -> Option<StreamReport> {
        let (asked, to) = (&self.nodes[from?], to?);
        let of = |said: &NodeReport| said.peers.iter().find(|peer| peer.node == to)?.stream.clone();
        let before = of(asked.said.as_ref().ok()?).filter(|stream| stream.is_agreed)?;
        if !asked.is_own_door || asked.node == to {
            return None;
        }
        let (through, whom) = (asked.through, (asked.node, asked.name.clone()));
        let system = self.system(through);
        let until = Time::now() + VALUE_WITHIN.min(system.within);
        system.endpoint.send(Tid::new(to, AppAddress::INSPECT), &Value {}).ok()?;
        loop {
            let answer = system.ask_these::<AskNode, NodeReport>(vec![whom.clone()]).pop()?;
            let after = of(&answer.said.ok()?)?;
            if after.arrived > before.arrived || Time::now() >= until {
                return Some(after);
            }
            std::thread::sleep(LOOK);
        }
    }
}

/// Whom a word means.
#[derive(Default)]
struct Found {
    /// Among those that were asked.
    at: Option<usize>,
    node: Option<NodeAddress>,
    app: Option<Tid>,
    namesakes: Option<Namesakes>,
    /// If a TID was given that stands for many; then it is nothing else.
    many: Option<Tid>,
}

impl Found {
    /// Whom a message goes to that is for it.
    fn target(&self) -> Option<Tid> {
        Some(Tid::new(self.node?, self.app.map_or(AppAddress::INSPECT, |tid| tid.app)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::security;

    #[test]
    fn an_application_that_is_not_named_is_known_to_be_absent_only_where_its_node_has_named_all() {
        let report = security::tests::said("knee", 2, None);
        let whom = || (report.node, report.name.clone());
        let tid = Tid::new(report.node, AppAddress::new(0x1001));
        let apps = |left_out| AppsReport {
            name: "knee".to_owned(),
            apps: Vec::new(),
            left_out,
            barriers: Vec::new(),
            barriers_left_out: 0,
        };
        let of = |apps| Asked { apps, ..Asked::new(0, whom(), Ok(report.clone())) }.app(tid);
        assert_eq!(of(Ok(apps(0))), (None, None));
        assert_eq!(of(Ok(apps(3))), (None, Some(Unsaid::LeftOut(3))));
        let full = || "its queue is full".to_owned();
        assert_eq!(of(Err(full())), (None, Some(Unsaid::Silent(full()))));
        let silent = Asked::new(0, whom(), Err("no answer".to_owned()));
        assert_eq!(silent.app(tid), (None, Some(Unsaid::Silent("no answer".to_owned()))));
    }
}
