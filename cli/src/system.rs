//! The way into the system: an endpoint at one node, from which all nodes are asked.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    time::Duration,
};

use sinew::{
    AppAddress, Endpoint, NodeAddress, NodeApi, Outcome, Payload, Registration, Tid,
    client::ApiError,
    inspect::{AskNode, AskReach, NodeReport, ReachReport},
    message::Rejection,
    name::check_name,
};

use crate::{
    EXIT_FINDING, EXIT_NO_NODE, EXIT_USAGE,
    door::{self, NoDoor, Others},
    table::clean,
};

/// Endpoints that ask at the same time at most: a node that does not answer holds up a part of the others only.
const ASKERS_MAX: usize = 8;
/// Time for the registration.
const REGISTERED_WITHIN: Duration = Duration::from_secs(5);

/// Why a command cannot be carried out.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Fault {
    /// No way in.
    #[error(transparent)]
    NoDoor(#[from] NoDoor),
    /// The node lets nobody in.
    #[error(
        "the node at {0} lets nobody in now: {1}. It may be stopping: try again, or another one with --socket PATH"
    )]
    NotTaken(String, ApiError),
    /// The node does not answer.
    #[error("the node at {0}: {1}")]
    NoAnswer(String, String),
    /// The node where the application is that was asked for, another one perhaps, does not answer or refuses.
    #[error("the application's node {0}: {1}")]
    ItsNode(String, String),
    /// Nobody is called so.
    #[error("{0}")]
    Whom(String),
    /// Keys cannot be made or read.
    #[error("{0}")]
    Keys(String),
    /// What was said on the command line cannot be meant.
    #[error("{0}")]
    Usage(String),
}

impl Fault {
    /// What the command ends with: see [`Arguments`](crate::arguments::Arguments).
    pub(crate) const fn code(&self) -> u8 {
        match self {
            Self::ItsNode(..) | Self::Whom(_) | Self::Keys(_) => EXIT_FINDING,
            Self::Usage(_) => EXIT_USAGE,
            Self::NoDoor(_) | Self::NotTaken(..) | Self::NoAnswer(..) => EXIT_NO_NODE,
        }
    }
}

/// A running system, seen from one node.
pub(crate) struct System {
    api: NodeApi,
    /// At the node through which we came.
    pub(crate) endpoint: Endpoint,
    /// Its socket.
    pub(crate) path: String,
    /// How long each node has for its answer.
    pub(crate) within: Duration,
    /// Addresses that this program has or had: no part of the system that it shows.
    pub(crate) own: BTreeSet<Tid>,
}

/// What a node has answered, or why it has not.
pub(crate) struct Answer<R> {
    pub(crate) node: NodeAddress,
    /// As the others call it.
    pub(crate) name: String,
    pub(crate) said: Result<R, String>,
}

impl System {
    /// Enters through the socket that was named, else through the first that lets us in.
    pub(crate) fn enter(socket: Option<&Path>, within: Duration) -> Result<Self, Fault> {
        let (path, api) = door::find(socket)?;
        Self::through(&path, api, within, REGISTERED_WITHIN)
    }

    /// Enters through each further socket of this host; returns also those that let nobody in, or are not asked, with the reason.
    pub(crate) fn beside(first: &Self, named: &[PathBuf]) -> (Vec<Self>, Vec<String>) {
        let Others { doors, left_out } = door::others(Path::new(&first.path), named);
        let (mut inside, mut shut) = (Vec::new(), left_out);
        for (path, api) in doors {
            // One that is stopped does not keep us for longer than a node that does not answer.
            match Self::through(&path, api, first.within, first.within.min(REGISTERED_WITHIN)) {
                Ok(system) => inside.push(system),
                Err(why) => shut.push(format!("the socket {} lets nobody in: {why}", path.display())),
            }
        }
        (inside, shut)
    }

    fn through(
        path: &Path,
        api: NodeApi,
        within: Duration,
        registered_within: Duration,
    ) -> Result<Self, Fault> {
        let path = path.display().to_string();
        let endpoint = register(&api, registered_within).map_err(|why| Fault::NotTaken(path.clone(), why))?;
        let own = BTreeSet::from([endpoint.tid()]);
        Ok(Self { api, endpoint, path, within, own })
    }

    /// Leaves the system as if we had not been there.
    pub(crate) fn leave(self) {
        leave(self.endpoint);
    }

    /// What the node through which we came says of itself and of those that it knows.
    pub(crate) fn here(&mut self) -> Result<NodeReport, Fault> {
        let node = self.endpoint.tid().node;
        let within = self.within;
        ask::<AskNode, NodeReport>(&mut self.endpoint, node, within)
            .map_err(|why| Fault::NoAnswer(self.path.clone(), why))
    }

    /// An application's TID, a node's address, an application's name, a node's name: the first that it is. A node is its inspection.
    pub(crate) fn find(&mut self, whom: &str) -> Result<Tid, Fault> {
        let tid = whom.parse::<Tid>();
        if let Ok(tid) = tid {
            return Ok(tid);
        }
        let inspection = |node: NodeAddress| Tid::new(node, AppAddress::INSPECT);
        if let Ok(node) = whom.parse::<NodeAddress>() {
            return Ok(inspection(node));
        }
        let resolved = self.endpoint.resolve(whom, self.within);
        if let Some(tid) = resolved.map_err(|why| Fault::NoAnswer(self.path.clone(), why.to_string()))? {
            return Ok(tid);
        }
        let here = self.here()?;
        let nobody = || {
            // Who writes a slash means a TID, where nobody is called so.
            let no_tid = tid.as_ref().err().filter(|_| whom.contains('/'));
            let unknown = || {
                format!(
                    "no application and no node is called '{whom}'; `sinew apps` and `sinew nodes` show those that are there"
                )
            };
            Fault::Whom(clean(&no_tid.map_or_else(unknown, ToString::to_string)))
        };
        let nodes = chosen(&here, Some(whom)).map_err(|_| nobody())?;
        nodes.first().map(|(node, _)| inspection(*node)).ok_or_else(nobody)
    }

    /// As [`find`](Self::find), and last of all a group of this name: one that has members, or the only thing that the name can mean.
    pub(crate) fn find_or_group(&mut self, target: &str) -> Result<Tid, Fault> {
        match self.find(target) {
            Err(Fault::Whom(_)) if check_name(target).is_ok() => Ok(Tid::group(target)),
            found => found,
        }
    }

    /// The members of a group, of every application or of an address on all nodes; and the nodes that have not said theirs, with the reason.
    pub(crate) fn members(&mut self, to: Tid) -> Result<(Vec<Tid>, Vec<String>), Fault> {
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
                Ok(said) => members.extend(said.reached.iter().map(|one| one.app)),
                Err(why) => silent.push(format!("{node} {}: {}", clean(&name), in_words(&why))),
            }
        }
        members.retain(|member| !self.own.contains(member));
        Ok((members, silent))
    }

    /// Asks this node and all that it knows, in the order of their addresses.
    pub(crate) fn ask_all<Q, R>(&mut self, here: &NodeReport) -> Vec<Answer<R>>
    where
        Q: Payload + Default,
        R: Payload,
    {
        self.ask_these::<Q, R>(all(here))
    }

    /// Asks these nodes; the answers come in the order of their addresses.
    pub(crate) fn ask_these<Q, R>(&mut self, nodes: Vec<(NodeAddress, String)>) -> Vec<Answer<R>>
    where
        Q: Payload + Default,
        R: Payload,
    {
        let askers = nodes.len().min(ASKERS_MAX);
        let (api, within) = (&self.api, self.within);
        let parts: Vec<_> = std::thread::scope(|scope| {
            let askers: Vec<_> = (0..askers)
                .map(|asker| nodes.iter().skip(asker).step_by(askers).cloned().collect::<Vec<_>>())
                .map(|part| scope.spawn(move || ask_each::<Q, R>(api, part, within)))
                .collect();
            askers.into_iter().map(|asker| asker.join().expect("an asker does not panic")).collect()
        });
        let mut answers = Vec::new();
        for (asker, part) in parts {
            self.own.extend(asker);
            answers.extend(part);
        }
        answers.sort_by_key(|answer| answer.node);
        answers
    }
}

/// This node and all that it knows.
fn all(here: &NodeReport) -> Vec<(NodeAddress, String)> {
    let mut nodes = vec![(here.node, here.name.clone())];
    nodes.extend(here.peers.iter().map(|peer| (peer.node, peer.name.clone().unwrap_or_default())));
    nodes.sort();
    nodes
}

/// Of all nodes those that have this address or name, at least one; all of them where none is wanted.
pub(crate) fn chosen(here: &NodeReport, wanted: Option<&str>) -> Result<Vec<(NodeAddress, String)>, Fault> {
    let mut nodes = all(here);
    if let Some(wanted) = wanted {
        nodes.retain(|(node, name)| node.to_string() == wanted || name == wanted);
        if nodes.is_empty() {
            let wanted = clean(wanted);
            return Err(Fault::Whom(format!(
                "no node has the address or name '{wanted}'; `sinew nodes` shows those that are there"
            )));
        }
    }
    Ok(nodes)
}

fn register(api: &NodeApi, within: Duration) -> Result<Endpoint, ApiError> {
    api.register_transport_address(Registration::new().deadline(within))
}

/// Asks these one after the other; returns from which address.
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
    let asker = endpoint.as_ref().ok().map(Endpoint::tid);
    let mut ask_one = |node| match &mut endpoint {
        Ok(endpoint) => ask::<Q, R>(endpoint, node, within),
        Err(why) => Err(why.to_string()),
    };
    let answers = nodes.into_iter().map(|(node, name)| Answer { node, name, said: ask_one(node) }).collect();
    endpoint.into_iter().for_each(leave);
    (asker, answers)
}

/// Gives the address back and waits for that, so that the next command does not see it.
fn leave(endpoint: Endpoint) {
    // It is given back in any case when the connection ends.
    let _ = endpoint.unregister();
}

fn ask<Q, R>(endpoint: &mut Endpoint, node: NodeAddress, within: Duration) -> Result<R, String>
where
    Q: Payload + Default,
    R: Payload,
{
    let to = Tid::new(node, AppAddress::INSPECT);
    endpoint.message(to, &Q::default()).ask::<R>(within).map_err(|error| in_words(&error))
}

/// What a question to a node ended with, and what to do.
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
