//! `sinew view`: serves the state of all nodes as a page and as metrics.
//!
//! Each snapshot has endpoints of its own: one that stayed would leave unread each broadcast between two snapshots, and
//! its node would report a client that does not read. They are dropped without a wait for the node, which may have died
//! meanwhile. So have the questions about parameters and the readers of messages.

mod live;
mod messages;
mod questions;

use std::{
    collections::{BTreeMap, BTreeSet},
    net::SocketAddr,
    path::PathBuf,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use clap::Args;
use serde_json::json;
use sinew::{
    Endpoint, NodeAddress, NodeApi, Tid, Time,
    inspect::{AskNode, NodeReport, Selection},
    parameters::{ParameterOutcome, SetParameters},
    stop::StopReport,
};
use sinew_view::{
    AppParameters, Live, NODES_MAX, NodeAnswers, Reads, Server, Snapshot, Source, StopAct, Tap, Writes,
};

use crate::{
    Report,
    arguments::Arguments,
    output, param, sockets, stop,
    system::{REQUESTERS_MAX, System, SystemError, present, register},
    table::clean,
};
use live::Channels;
use messages::Messages;
use questions::Questions;

/// Time limit for a snapshot, below that of a request.
const SNAPSHOT_WITHIN: Duration = Duration::from_secs(4);

/// The arguments of `sinew view`.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// The address and port to listen on. Any other address than one of loopback can be read by each program on that
    /// network
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:9464")]
    listen: SocketAddr,
    /// Also serves Foxglove, Lichtblick and other clients of its protocol, on this port of the same address
    #[arg(long, value_name = "PORT", num_args = 0..=1, default_missing_value = "8765")]
    foxglove: Option<u16>,
    /// Offers Foxglove only messages from or to applications of this name, with `*` for any text; may be repeated
    #[arg(long = "foxglove-app", value_name = "NAME", requires = "foxglove")]
    foxglove_apps: Vec<String>,
    /// Lets programs of this host read without the token, for clients that take none, such as PlotJuggler. Pages of
    /// browsers need it, and so do sets
    #[arg(long, requires = "foxglove")]
    foxglove_open: bool,
    /// Lets Foxglove set parameters, as far as the nodes let this command
    #[arg(long, requires = "foxglove")]
    foxglove_writes: bool,
}

impl Order {
    /// Binds the server for Foxglove, if it is wanted. Returns its address, with the token.
    fn bind_foxglove(&self, server: &mut Server) -> Result<Option<String>, SystemError> {
        let Some(port) = self.foxglove else { return Ok(None) };
        let writes = if self.foxglove_writes { Writes::Allowed } else { Writes::Refused };
        let reads = if self.foxglove_open { Reads::OnThisHost } else { Reads::WithToken };
        let bound = server.bind_foxglove(port, reads, writes).map_err(|why| {
            let ip = self.listen.ip();
            SystemError::View(format!(
                "port {port} of {ip} cannot be listened on for Foxglove: {why}; end the program that has it, or choose another one with --foxglove PORT"
            ))
        });
        bound.map(Some)
    }

    /// Returns the selection of the messages that Foxglove is offered.
    fn shown(&self) -> Result<Selection, SystemError> {
        let shown = Selection { apps: self.foxglove_apps.clone(), ..Selection::default() };
        shown
            .check()
            .map_err(|why| SystemError::Usage(format!("--foxglove-app: {}", clean(&why.to_string()))))?;
        Ok(shown)
    }
}

/// Serves the page and the metrics until the user ends it.
pub(crate) fn show(order: &Order, arguments: &Arguments) -> Result<Report, SystemError> {
    let shown = order.shown()?;
    let (mut nodes, _) = Nodes::enter(arguments)?;
    nodes.shown = shown;
    let path = nodes.path();
    let mut server = Server::bind(order.listen).map_err(|why| {
        let listen = order.listen;
        SystemError::View(format!("{listen} cannot be listened on: {why}; choose another one with --listen"))
    })?;
    let address = server.address();
    if !address.ip().is_loopback() {
        output::note(format_args!(
            "sinew: warning: {address} is not loopback: every program that reaches it can read the metrics of all nodes, and the page and its token travel without encryption"
        ));
    }
    let foxglove = order.bind_foxglove(&mut server)?;
    if order.foxglove_open {
        output::note(format_args!(
            "sinew: warning: every program and user of this host can read the messages and parameters that are offered to Foxglove"
        ));
    }
    output::line(&announcement(&server, &path, foxglove.as_deref(), arguments.json));
    let end = server.run(nodes);
    end.map_err(|why| {
        SystemError::View(format!("the system gives no thread or descriptor: {why}; free some"))
    })?;
    Ok(Report { text: String::new(), json: serde_json::Value::Null, is_fine: true })
}

fn announcement(server: &Server, path: &str, foxglove: Option<&str>, is_json: bool) -> String {
    let (address, page) = (server.address(), server.page());
    if is_json {
        let listens = address.to_string();
        return json!({ "listens": listens, "through": path, "page": page, "foxglove": foxglove })
            .to_string();
    }
    let mut text = format!(
        "http://{address}/metrics has the metrics of all nodes, through {}; Ctrl-C ends it\n{page} is the page, for its bearer alone",
        clean(path)
    );
    if let Some(foxglove) = foxglove {
        text += &format!("\n{foxglove} is for Foxglove and its like, for their bearer alone");
    }
    text
}

/// All nodes, asked through one of them.
pub(crate) struct Nodes {
    /// The selection of the messages that Foxglove is offered.
    shown: Selection,
    api: NodeApi,
    /// Time limit for each answer.
    within: Duration,
    entry: Arc<Entry>,
}

/// The names of applications.
type Names = BTreeMap<Tid, String>;

/// The entry node, and the knowledge that the parts of this program share.
struct Entry {
    socket: PathBuf,
    /// The addresses of this program, which are no part of the system, except those of the present snapshot.
    own: Mutex<BTreeSet<Tid>>,
    /// The names of all applications in the latest snapshot.
    names: Mutex<Arc<Names>>,
}

impl Entry {
    fn new(socket: PathBuf) -> Self {
        Self { socket, own: Mutex::default(), names: Mutex::default() }
    }

    fn own(&self) -> MutexGuard<'_, BTreeSet<Tid>> {
        self.own.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn names(&self) -> Arc<Names> {
        Arc::clone(&self.names.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn set_names(&self, names: Names) {
        *self.names.lock().unwrap_or_else(PoisonError::into_inner) = Arc::new(names);
    }

    /// Registers at the entry node.
    fn enter(&self, within: Duration) -> Result<System, String> {
        let system = System::enter(Some(self.socket.as_path()), within).map_err(|why| why.to_string())?;
        self.add(&system);
        Ok(system)
    }

    fn add(&self, system: &System) {
        self.own().extend(&system.own);
    }

    fn leave(&self, system: System) {
        let own = system.own.clone();
        system.leave();
        self.own().retain(|tid| !own.contains(tid));
    }

    /// Disconnects without a wait for the node.
    fn abandon(&self, system: System) {
        self.own().retain(|tid| !system.own.contains(tid));
    }
}

impl Source for Nodes {
    fn snapshot(&self) -> Snapshot {
        let taken = Time::now();
        let until = taken + SNAPSHOT_WITHIN;
        let questions = Questions { within: self.within, until };
        let mut snapshot =
            self.ask_all(questions, taken).unwrap_or_else(|why| Snapshot::without_entry(taken, why));
        snapshot.own.extend(self.entry.own().iter());
        self.entry.set_names(names(&snapshot));
        snapshot
    }

    fn parameters(&self) -> Result<Vec<AppParameters>, String> {
        let mut system = self.entry.enter(self.within)?;
        let all = param::all(&mut system);
        self.entry.leave(system);
        all.map_err(|why| why.to_string())
    }

    fn set(&self, app: &str, set: &SetParameters) -> Result<ParameterOutcome, String> {
        let mut system = self.entry.enter(self.within)?;
        let (outcome, text) = param::set(&mut system, app, set);
        self.entry.leave(system);
        output::note(format_args!("sinew: a set through sinew view: {}", text.trim_end()));
        outcome
    }

    fn stop(&self, act: StopAct) -> Result<StopReport, String> {
        let mut system = self.entry.enter(self.within)?;
        let report = stop::act(&mut system, act);
        match &report {
            Ok(_) => self.entry.leave(system),
            // A node without an answer gives none to this either.
            Err(_) => self.entry.abandon(system),
        }
        if act != StopAct::Ask {
            output::note(format_args!("sinew: the stop, by the page: {act:?}: {}", stop::line(&report)));
        }
        report.map_err(|why| why.to_string())
    }

    fn tap(&self) -> Box<dyn Tap> {
        Box::new(Messages::new(Arc::clone(&self.entry), self.within))
    }

    fn live(&self) -> Box<dyn Live> {
        Box::new(Channels::new(Arc::clone(&self.entry), self.within, self.shown.clone()))
    }
}

/// Returns the names of all applications.
fn names(snapshot: &Snapshot) -> Names {
    let answers = snapshot.nodes.iter().filter_map(|node| node.result.as_ref().ok());
    let apps = answers.flat_map(|answers| &answers.apps.apps);
    apps.filter_map(|app| Some((app.tid, app.name.clone()?))).collect()
}

impl Nodes {
    /// Finds the socket of a node, and returns the first snapshot.
    ///
    /// # Errors
    /// As with other commands: a node that refuses or is silent at the start.
    pub(crate) fn enter(arguments: &Arguments) -> Result<(Self, Snapshot), SystemError> {
        let (socket, api) = sockets::find(arguments.socket.as_deref())?;
        let entry = Arc::new(Entry::new(socket));
        let nodes = Self { shown: Selection::default(), api, within: arguments.within(), entry };
        let snapshot = nodes.snapshot();
        match &snapshot.entry {
            Ok(_) => Ok((nodes, snapshot)),
            Err(why) => Err(SystemError::NoAnswer(nodes.path(), why.clone())),
        }
    }

    /// Returns the socket of the entry node.
    pub(crate) fn path(&self) -> String {
        self.entry.socket.display().to_string()
    }

    fn ask_all(&self, questions: Questions, taken: Time) -> Result<Snapshot, String> {
        let mut first = register(&self.api, questions.left()?).map_err(|why| why.to_string())?;
        let entry = first.tid().node;
        let here = questions.ask::<AskNode, NodeReport>(&mut first, entry)?;
        let mut nodes = present(&here);
        let left_out = nodes.len().saturating_sub(NODES_MAX) as u64;
        nodes.truncate(NODES_MAX);
        let (own, nodes) = self.ask_nodes(first, &here, &nodes, questions);
        let took = Time::now().since(taken);
        Ok(Snapshot { taken, took, entry: Ok(here), nodes, left_out, own })
    }

    /// Asks these nodes, several at the same time: one that does not answer delays only a part of the others.
    fn ask_nodes(
        &self,
        first: Endpoint,
        here: &NodeReport,
        nodes: &[(NodeAddress, String)],
        questions: Questions,
    ) -> (BTreeSet<Tid>, Vec<NodeAnswers>) {
        let mut own = BTreeSet::from([first.tid()]);
        let mut endpoints = vec![first];
        while endpoints.len() < nodes.len().min(REQUESTERS_MAX) {
            let next = questions.left().ok().and_then(|left| register(&self.api, left).ok());
            // With fewer endpoints it takes longer.
            let Some(next) = next else { break };
            own.insert(next.tid());
            endpoints.push(next);
        }
        let count = endpoints.len();
        let mut answers = std::thread::scope(|scope| {
            let parts = endpoints.iter_mut().enumerate().map(|(number, endpoint)| {
                let part = nodes.iter().skip(number).step_by(count);
                scope.spawn(move || {
                    part.map(|node| questions.ask_node(endpoint, here, node)).collect::<Vec<_>>()
                })
            });
            let parts: Vec<_> = parts.collect();
            let joined = parts.into_iter().map(|part| part.join().expect("a requester does not panic"));
            joined.flatten().collect::<Vec<_>>()
        });
        answers.sort_by_key(|answer| answer.node);
        (own, answers)
    }
}
