//! The connection to the system: an endpoint at one node, from which all nodes are asked.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    time::Duration,
};

use sinew::{
    AppAddress, Endpoint, NodeAddress, NodeApi, Outcome, Payload, Registration, Tid, Time,
    client::ApiError,
    inspect::{AppsReport, AskApps, AskNode, AskReach, NodeReport, ReachReport},
    message::Rejection,
};

use crate::{
    EXIT_FINDING, EXIT_NO_NODE, EXIT_USAGE,
    sockets::{self, NoSocketError, OtherSockets},
    table::clean,
    unknown::{Known, Target, not_a_name},
};

/// Maximum number of endpoints that ask at the same time: a node that does not answer delays only a part of the others.
pub(crate) const REQUESTERS_MAX: usize = 8;
/// Time limit to ask the further nodes of this host for their projects. One answers within a few milliseconds.
const PROJECTS_WITHIN: Duration = Duration::from_millis(300);
/// Maximum number of messages to all applications that are dropped at once.
const DISCARDED_MAX: usize = 4_096;
/// Time limit for the registration.
const REGISTERED_WITHIN: Duration = Duration::from_secs(5);

/// Why a command failed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SystemError {
    /// No socket of a node was found.
    #[error(transparent)]
    NoSocket(#[from] NoSocketError),
    /// The node does not register this client.
    #[error(
        "the node at {0} does not register this command now: {1}. It may be stopping: try again, or another one with --socket PATH"
    )]
    NotRegistered(String, ApiError),
    /// The node does not answer.
    #[error("the node at {0}: {1}")]
    NoAnswer(String, String),
    /// The node of the requested application does not answer or refuses.
    #[error("the application's node {0}: {1}")]
    ItsNode(String, String),
    /// No application or node has this name.
    #[error("{0}")]
    Unknown(String),
    /// Keys cannot be created or read.
    #[error("{0}")]
    Keys(String),
    /// A recording cannot be read or written.
    #[error("{0}")]
    Bag(String),
    /// The metrics cannot be served, or the terminal cannot be used.
    #[error("{0}")]
    View(String),
    /// A robot cannot be started, changed or stopped.
    #[error("{0}")]
    Up(String),
    /// A manual page cannot be written.
    #[error("{0}")]
    Man(String),
    /// The command line is invalid.
    #[error("{0}")]
    Usage(String),
}

impl SystemError {
    /// Adds a remedy, if the error is an unknown name.
    pub(crate) fn with_remedy(self, remedy: &str) -> Self {
        if let Self::Unknown(why) = &self {
            return Self::Unknown(format!("{why}; {remedy}"));
        }
        self
    }

    /// Returns the exit code: see [`Arguments`](crate::arguments::Arguments).
    pub(crate) const fn code(&self) -> u8 {
        match self {
            Self::ItsNode(..)
            | Self::Unknown(_)
            | Self::Keys(_)
            | Self::Bag(_)
            | Self::View(_)
            | Self::Up(_)
            | Self::Man(_) => EXIT_FINDING,
            Self::Usage(_) => EXIT_USAGE,
            Self::NoSocket(_) | Self::NotRegistered(..) | Self::NoAnswer(..) => EXIT_NO_NODE,
        }
    }
}

/// A running system, seen from one node.
pub(crate) struct System {
    api: NodeApi,
    /// The endpoint at the entry node.
    pub(crate) endpoint: Endpoint,
    /// Its socket.
    pub(crate) path: String,
    /// Time limit for the answer of each node.
    pub(crate) within: Duration,
    /// Current and former addresses of this program, which are not shown as part of the system.
    pub(crate) own: BTreeSet<Tid>,
}

/// The answer of a node, or why there is none.
pub(crate) struct Answer<R> {
    pub(crate) node: NodeAddress,
    /// Its name, as other nodes report it.
    pub(crate) name: String,
    pub(crate) result: Result<R, String>,
}

impl System {
    /// Registers through the named socket, else through the first that accepts this command.
    pub(crate) fn enter(socket: Option<&Path>, within: Duration) -> Result<Self, SystemError> {
        let (path, api) = sockets::find(socket)?;
        Self::through(&path, api, within, REGISTERED_WITHIN)
    }

    /// Registers through each further socket of this host. Also returns those that refuse, or are not asked, with the
    /// reason.
    pub(crate) fn beside(first: &Self, named: &[PathBuf]) -> (Vec<Self>, Vec<String>) {
        let OtherSockets { nodes, left_out } = sockets::others(Path::new(&first.path), named);
        let (mut inside, mut shut) = (Vec::new(), left_out);
        for (path, api) in nodes {
            // A stopped one delays the command no longer than a node that does not answer.
            match Self::through(&path, api, first.within, first.within.min(REGISTERED_WITHIN)) {
                Ok(system) => inside.push(system),
                Err(why) => {
                    shut.push(format!("the socket {} does not accept this command: {why}", path.display()))
                }
            }
        }
        (inside, shut)
    }

    /// Returns the projects of further nodes of this host, except `project`. A node that does not answer at once is
    /// left out, and the command does not wait for it.
    pub(crate) fn other_projects(&self, project: &str) -> BTreeSet<String> {
        let until = Time::now() + PROJECTS_WITHIN;
        let OtherSockets { nodes, .. } = sockets::others_within(Path::new(&self.path), &[], PROJECTS_WITHIN);
        let mut projects = BTreeSet::new();
        for (path, api) in nodes {
            let left = until.since(Time::now());
            if left.is_zero() {
                break;
            }
            let Ok(mut system) = Self::through(&path, api, left, left) else { continue };
            projects.extend(system.here().ok().map(|here| here.project));
            system.leave();
        }
        projects.remove(project);
        projects
    }

    fn through(
        path: &Path,
        api: NodeApi,
        within: Duration,
        registered_within: Duration,
    ) -> Result<Self, SystemError> {
        let path = path.display().to_string();
        let endpoint =
            register(&api, registered_within).map_err(|why| SystemError::NotRegistered(path.clone(), why))?;
        let own = BTreeSet::from([endpoint.tid()]);
        Ok(Self { api, endpoint, path, within, own })
    }

    /// Disconnects from the system.
    pub(crate) fn leave(self) {
        leave(self.endpoint);
    }

    /// Reads and drops messages to all applications. A command that stays does so between its questions: a node reports
    /// clients that do not read, and without room further messages are refused.
    pub(crate) fn discard(&mut self) {
        for _ in 0..DISCARDED_MAX {
            if !matches!(self.endpoint.receive(Duration::ZERO), Ok(Some(_))) {
                return;
            }
        }
    }

    /// Returns the report of the entry node about itself and the nodes that it knows.
    pub(crate) fn here(&mut self) -> Result<NodeReport, SystemError> {
        let node = self.endpoint.tid().node;
        let within = self.within;
        ask::<AskNode, NodeReport>(&mut self.endpoint, node, within)
            .map_err(|why| SystemError::NoAnswer(self.path.clone(), why))
    }

    /// Resolves an application's TID, a node's address, an application's name, or a node's name: the first match. A
    /// node resolves to its inspection.
    ///
    /// # Errors
    /// No application or node has this name; the error lists similar names.
    pub(crate) fn find(&mut self, target: &str) -> Result<Tid, SystemError> {
        match self.resolve(target)? {
            Some(tid) => Ok(tid),
            None => Err(self.unknown(target, Target::One)),
        }
    }

    /// Like [`find`](Self::find), and finally a group of this name, whether it has members or not.
    pub(crate) fn find_or_group(&mut self, target: &str) -> Result<Tid, SystemError> {
        Ok(self.resolve(target)?.unwrap_or_else(|| Tid::group(target)))
    }

    fn resolve(&mut self, target: &str) -> Result<Option<Tid>, SystemError> {
        if let Ok(tid) = target.parse::<Tid>() {
            return Ok(Some(tid));
        }
        let inspection = |node: NodeAddress| Tid::new(node, AppAddress::INSPECT);
        if let Ok(node) = target.parse::<NodeAddress>() {
            return Ok(Some(inspection(node)));
        }
        if let Some(why) = not_a_name(target) {
            return Err(SystemError::Unknown(why));
        }
        let resolved = self.endpoint.resolve(target, self.within);
        if let Some(tid) =
            resolved.map_err(|why| SystemError::NoAnswer(self.path.clone(), why.to_string()))?
        {
            return Ok(Some(tid));
        }
        let here = self.here()?;
        let node = chosen(&here, Some(target)).and_then(|nodes| nodes.first().map(|(node, _)| *node));
        Ok(node.map(inspection))
    }

    /// Returns the error for an unknown name, with similar ones.
    pub(crate) fn unknown(&mut self, name: &str, sought: Target) -> SystemError {
        match self.here() {
            Ok(here) => {
                let known = Known::of(&here, self.ask_all::<AskApps, AppsReport>(&here));
                SystemError::Unknown(known.report(name, sought))
            }
            Err(why) => why,
        }
    }

    /// Returns the members of a group, of all applications or of an address on all nodes; and the nodes that did not
    /// report theirs, with the reason.
    pub(crate) fn members(&mut self, to: Tid) -> Result<(Vec<Tid>, Vec<String>), SystemError> {
        let here = self.here()?;
        let question = AskReach { source: self.endpoint.tid(), to: to.app };
        let own = if to.node == NodeAddress::HERE { here.node } else { to.node };
        let (mut members, mut silent) = (Vec::new(), Vec::new());
        for (node, name) in all(&here) {
            if own != NodeAddress::ALL && own != node {
                continue;
            }
            let inspection = Tid::new(node, AppAddress::INSPECT);
            match self.endpoint.message(inspection, &question).ask::<ReachReport>(self.within) {
                Ok(report) => members.extend(report.reached.iter().map(|one| one.app)),
                Err(why) => silent.push(format!("{node} {}: {}", clean(&name), in_words(&why))),
            }
        }
        members.retain(|member| !self.own.contains(member));
        Ok((members, silent))
    }

    /// Asks this node and all nodes that it knows, in the order of their addresses.
    pub(crate) fn ask_all<Q, R>(&mut self, here: &NodeReport) -> Vec<Answer<R>>
    where
        Q: Payload + Default,
        R: Payload,
    {
        self.ask_these::<Q, R>(all(here))
    }

    /// Asks this node and all nodes that it knows the same question, one after the other.
    pub(crate) fn ask_one_by_one<Q: Payload, R: Payload>(
        &mut self,
        here: &NodeReport,
        question: &Q,
    ) -> Vec<Answer<R>> {
        let within = self.within;
        let mut ask_one = |node| {
            let to = Tid::new(node, AppAddress::INSPECT);
            self.endpoint.message(to, question).ask::<R>(within).map_err(|error| in_words(&error))
        };
        all(here).into_iter().map(|(node, name)| Answer { node, name, result: ask_one(node) }).collect()
    }

    /// Asks these nodes; the answers are in the order of their addresses.
    pub(crate) fn ask_these<Q, R>(&mut self, nodes: Vec<(NodeAddress, String)>) -> Vec<Answer<R>>
    where
        Q: Payload + Default,
        R: Payload,
    {
        let requesters = nodes.len().min(REQUESTERS_MAX);
        let (api, within) = (&self.api, self.within);
        let parts: Vec<_> = std::thread::scope(|scope| {
            let requesters: Vec<_> = (0..requesters)
                .map(|requester| {
                    nodes.iter().skip(requester).step_by(requesters).cloned().collect::<Vec<_>>()
                })
                .map(|part| scope.spawn(move || ask_each::<Q, R>(api, part, within)))
                .collect();
            requesters
                .into_iter()
                .map(|requester| requester.join().expect("a requester does not panic"))
                .collect()
        });
        let mut answers = Vec::new();
        for (requester, part) in parts {
            self.own.extend(requester);
            answers.extend(part);
        }
        answers.sort_by_key(|answer| answer.node);
        answers
    }
}

/// Returns this node and all nodes that it knows.
fn all(here: &NodeReport) -> Vec<(NodeAddress, String)> {
    let mut nodes = vec![(here.node, here.name.clone())];
    nodes.extend(here.peers.iter().map(|peer| (peer.node, peer.name.clone().unwrap_or_default())));
    nodes.sort();
    nodes
}

/// Returns this node and all nodes that it knows and that answer.
pub(crate) fn present(here: &NodeReport) -> Vec<(NodeAddress, String)> {
    let mut nodes = vec![(here.node, here.name.clone())];
    let peers = here.peers.iter().filter(|peer| peer.is_there);
    nodes.extend(peers.map(|peer| (peer.node, peer.name.clone().unwrap_or_default())));
    nodes
}

/// Returns the nodes with this address or name; all of them if none is wanted; `None` if no node has it.
pub(crate) fn chosen(here: &NodeReport, wanted: Option<&str>) -> Option<Vec<(NodeAddress, String)>> {
    let mut nodes = all(here);
    if let Some(wanted) = wanted {
        nodes.retain(|(node, name)| node.to_string() == wanted || name == wanted);
    }
    (!nodes.is_empty()).then_some(nodes)
}

pub(crate) fn register(api: &NodeApi, within: Duration) -> Result<Endpoint, ApiError> {
    api.register_transport_address(Registration::new().deadline(within))
}

/// Asks these nodes one after the other. Returns the address that was used.
fn ask_each<Q, R>(
    api: &NodeApi,
    nodes: Vec<(NodeAddress, String)>,
    within: Duration,
) -> (Option<Tid>, Vec<Answer<R>>)
where
    Q: Payload + Default,
    R: Payload,
{
    let mut endpoint = register(api, REGISTERED_WITHIN);
    let requester = endpoint.as_ref().ok().map(Endpoint::tid);
    let mut ask_one = |node| match &mut endpoint {
        Ok(endpoint) => ask::<Q, R>(endpoint, node, within),
        Err(why) => Err(why.to_string()),
    };
    let answers =
        nodes.into_iter().map(|(node, name)| Answer { node, name, result: ask_one(node) }).collect();
    endpoint.into_iter().for_each(leave);
    (requester, answers)
}

/// Releases the address and waits for that, so that the next command does not see it.
fn leave(endpoint: Endpoint) {
    // It is released in any case when the connection ends.
    let _ = endpoint.unregister();
}

/// Asks a node's inspection.
pub(crate) fn ask<Q, R>(endpoint: &mut Endpoint, node: NodeAddress, within: Duration) -> Result<R, String>
where
    Q: Payload + Default,
    R: Payload,
{
    let to = Tid::new(node, AppAddress::INSPECT);
    endpoint.message(to, &Q::default()).ask::<R>(within).map_err(|error| in_words(&error))
}

/// Returns the result of a failed question to a node, and the remedy.
pub(crate) fn in_words(error: &ApiError) -> String {
    if let ApiError::Ended(Outcome::Rejected(Rejection::NoSuchApplication)) = error {
        return "it runs a version of Sinew that cannot be asked; update it".to_owned();
    }
    if let ApiError::NoReply(within) = error {
        return format!(
            "no answer within {within:?}; is it stopped, or cut off? `sinew nodes` shows its links"
        );
    }
    error.to_string()
}
