//! All parts of the bridge, and their threads.

use std::{
    collections::BTreeSet,
    fmt,
    path::PathBuf,
    sync::{Arc, mpsc},
    thread,
    time::Duration,
};

use sinew_ros2_core::{GraphNode, mapping::Mapping};
use sinew_zenoh::{
    config::Tls,
    session::{Role, open},
};
use tracing::info;

use crate::{
    commands::{Commands, SenderName},
    counts::{self, Counts},
    graph::Graph,
    load::Loaded,
    parameters,
    service::{Requests, serve},
    stop,
    topics::Topics,
};

/// Time without a sign of life after which a router is lost.
const LEASE: Duration = Duration::from_secs(2);
/// Requests that wait for the thread of a service.
const PARAMETERS_QUEUED: usize = 32;
const STOPS_QUEUED: usize = 8;

/// Ends of threads that wait to be reported: one ends the bridge.
const ENDS: usize = 8;

/// Why the bridge has ended.
#[derive(Debug)]
pub struct RunError(String);

impl fmt::Display for RunError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for RunError {}

impl From<String> for RunError {
    fn from(why: String) -> Self {
        Self(why)
    }
}

/// Runs the bridge, until one of its parts ends. A node or a router that is away is waited for.
#[must_use]
pub fn run(loaded: Loaded) -> RunError {
    // The tokens end with the graph.
    start(loaded).map_or_else(RunError::from, |(ended, _graph)| {
        // Each thread has a sender.
        RunError(ended.recv().unwrap_or_else(|_| "all parts have ended".to_owned()))
    })
}

/// The threads: the first one that ends ends the bridge.
struct Threads {
    ended: mpsc::SyncSender<String>,
}

/// Reports the end of a thread, also after a panic.
struct Ended {
    name: &'static str,
    why: String,
    ended: mpsc::SyncSender<String>,
}

impl Drop for Ended {
    fn drop(&mut self) {
        // The first one is enough.
        let _ = self.ended.try_send(format!("the part `{}` has ended: {}", self.name, self.why));
    }
}

impl Threads {
    fn spawn(
        &self,
        name: &'static str,
        part: impl FnOnce() -> Result<(), String> + Send + 'static,
    ) -> Result<(), String> {
        let report = Ended { name, why: "it has panicked".to_owned(), ended: self.ended.clone() };
        let part = move || {
            let mut report = report;
            report.why = part().err().unwrap_or_else(|| "without a reason".to_owned());
        };
        let spawned = thread::Builder::new().name(name.to_owned()).spawn(part);
        spawned.map(drop).map_err(|why| format!("no thread for `{name}`: {why}"))
    }
}

fn start(loaded: Loaded) -> Result<(mpsc::Receiver<String>, Arc<Graph>), String> {
    let Loaded { mapping, services, catalog } = loaded;
    let tls = Tls {
        root_ca_certificate: mapping.tls.root_ca_certificate.clone(),
        connect_certificate: mapping.tls.connect_certificate.clone(),
        connect_private_key: mapping.tls.connect_private_key.clone(),
    };
    info!("waits for one of {:?}", mapping.routers);
    let session =
        open(Role::Client { routers: &mapping.routers, tls: &tls }, LEASE).map_err(|why| why.to_string())?;
    let graph = Arc::new(Graph::new(session, mapping.domain));
    let node = graph.node(&mapping.namespace, &mapping.node)?;
    info!("is {node} in domain {}", mapping.domain);
    let counts = Counts::default();
    let (ended, ends) = mpsc::sync_channel(ENDS);
    let threads = Threads { ended };
    start_stop(&mapping, (&graph, &node), &services.trigger, (&threads, &counts))?;
    start_parameters(&mapping, &graph, &services, (&threads, &counts))?;
    let app = mapping.name.clone();
    let is_diagnosed = mapping.diagnostics;
    start_topics(mapping, (&graph, &node), (&threads, &counts))?;
    if is_diagnosed {
        let graph = Arc::clone(&graph);
        threads.spawn("diagnostics", move || counts::publish(&counts, &graph, &node, (&app, &catalog)))?;
    }
    info!("runs");
    Ok((ends, graph))
}

fn start_stop(
    mapping: &Mapping,
    (graph, node): (&Graph, &GraphNode),
    trigger: &sinew_ros2_core::Service,
    (threads, counts): (&Threads, &Counts),
) -> Result<(), String> {
    let Some(rule) = &mapping.stop else { return Ok(()) };
    let (queue, requests) = mpsc::sync_channel(STOPS_QUEUED);
    let of = Duration::from_millis(rule.within_ms);
    let service =
        serve((graph, node), (&rule.service, trigger), of, Requests { queue, counts: counts.clone() })?;
    let (socket, name, counts) = (mapping.socket.clone(), format!("{}.stop", mapping.name), counts.clone());
    threads.spawn("stop", move || {
        let _service = service;
        stop::run(&socket, &name, &requests, &counts)
    })
}

fn start_parameters(
    mapping: &Mapping,
    graph: &Graph,
    services: &crate::load::Services,
    (threads, counts): (&Threads, &Counts),
) -> Result<(), String> {
    if mapping.parameters.is_empty() {
        return Ok(());
    }
    let (queue, requests) = mpsc::sync_channel(PARAMETERS_QUEUED);
    let served = Requests { queue, counts: counts.clone() };
    let declared = parameters::declare(&mapping.parameters, &mapping.namespace, graph, (services, &served))?;
    let (socket, name) = (mapping.socket.clone(), format!("{}.parameters", mapping.name));
    let counts = counts.clone();
    threads.spawn("parameters", move || {
        let _services = declared;
        parameters::run(&socket, &name, &requests, &counts)
    })
}

fn start_topics(
    mapping: Mapping,
    (graph, node): (&Graph, &GraphNode),
    (threads, counts): (&Threads, &Counts),
) -> Result<(), String> {
    let Mapping { socket, name, address, watched, to_ros, from_ros, .. } = mapping;
    let published: BTreeSet<_> = to_ros.iter().map(|rule| rule.topic.clone()).collect();
    if !from_ros.is_empty() || !watched.is_empty() {
        let sender = SenderName { name, address };
        let commands = Commands::subscribe(from_ros, (graph, node), (&watched, published), sender, counts)?;
        let socket: PathBuf = socket.clone();
        threads.spawn("commands", move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            runtime.map_err(|why| format!("no runtime: {why}"))?.block_on(commands.run(socket))
        })?;
    }
    if !to_ros.is_empty() {
        let topics = Topics::declare(to_ros, graph, node, counts.clone())?;
        threads.spawn("topics", move || topics.run(&socket))?;
    }
    Ok(())
}
