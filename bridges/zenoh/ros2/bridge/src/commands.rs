//! Topics with commands: a message passes by a rule alone, and protected where the receiver guards the type.

use std::{collections::BTreeSet, path::PathBuf, sync::Arc, time::Duration};

use sinew::{
    AppAddress, Class, NodeApi, Tid,
    client::ApiError,
    message::Kind,
    protection::{
        Protection,
        raw::{Protected, Reads},
    },
};
use sinew_bridge_node::{Destination, NodeClient, Options, Outgoing};
use sinew_ros2_core::{
    Cause, EndpointKind, GraphNode, Incoming, Receiver, Refusal, SealLimits, SendClass, topic_key, type_hash,
};
use tokio::{
    sync::mpsc,
    time::{Instant, sleep, sleep_until},
};
use tracing::{info, warn};
use zenoh::{
    Wait as _,
    pubsub::Subscriber,
    sample::{Sample, SampleKind},
};

use crate::{clock, counts::Counts, graph::Graph};

/// Maximum number of commands that wait for the node. Further ones are refused.
const QUEUE: usize = 256;
/// Time after which a node is tried again.
const RETRIED_AFTER: Duration = Duration::from_secs(1);
/// Time limit of the registration.
const REGISTERED_WITHIN: Duration = Duration::from_secs(10);
/// Time between two questions to nodes for the types that their applications guard, and its limit for each node.
const GUARDS_ASKED_EVERY: Duration = Duration::from_secs(5);
const GUARDS_ASKED_WITHIN: Duration = Duration::from_millis(500);

/// A rule, as commands are sent by it.
struct Route {
    topic: String,
    to: Destination,
    type_name: String,
    kind: Kind,
    class: Class,
    expires_after: Option<Duration>,
    protected: Option<Protected>,
}

/// A command that waits for the node.
struct Command {
    route: Arc<Route>,
    payload: Vec<u8>,
}

/// The subscriptions and the task that sends.
pub(crate) struct Commands {
    counts: Counts,
    queue: mpsc::Receiver<Command>,
    /// They end with this.
    _subscribers: Vec<Subscriber<()>>,
    routes: Vec<Arc<Route>>,
    name: String,
    address: Option<u32>,
}

/// The name and the fixed address of the sender.
pub(crate) struct SenderName {
    pub(crate) name: String,
    pub(crate) address: Option<u32>,
}

impl Commands {
    /// Subscribes to the topics of the rules, and to the watched namespaces. `published` are the topics of the bridge
    /// itself.
    ///
    /// # Errors
    /// The session is closed.
    pub(crate) fn subscribe(
        rules: Vec<Incoming>,
        (graph, node): (&Graph, &GraphNode),
        (watched, published): (&[String], BTreeSet<String>),
        sender: SenderName,
        counts: &Counts,
    ) -> Result<Self, String> {
        let (sending, queue) = mpsc::channel(QUEUE);
        let (mut subscribers, mut routes) = (Vec::new(), Vec::new());
        let mut ruled = published;
        ruled.extend(rules.iter().map(|rule| rule.topic.clone()));
        for rule in rules {
            let route = Arc::new(Route::of(&rule));
            routes.push(Arc::clone(&route));
            subscribers.push(subscribe(rule, route, (graph, node), (sending.clone(), counts.clone()))?);
        }
        for namespace in watched {
            subscribers.push(watch(namespace, ruled.clone(), graph, counts.clone())?);
        }
        let SenderName { name, address } = sender;
        Ok(Self { counts: counts.clone(), queue, _subscribers: subscribers, routes, name, address })
    }

    /// Sends commands until the program ends. A lost node is tried again each second.
    pub(crate) async fn run(mut self, socket: PathBuf) -> Result<(), String> {
        let mut last = String::new();
        loop {
            let ended = match self.register(&socket).await {
                Ok(client) => self.serve(client).await,
                Err(why) => why,
            };
            let why = ended.to_string();
            if why != last {
                warn!("commands: {why}; tries again each second");
                last = why;
            }
            self.refuse_waiting(&last);
            sleep(RETRIED_AFTER).await;
        }
    }

    async fn register(&self, socket: &PathBuf) -> Result<NodeClient, ApiError> {
        let node = NodeApi::connect(socket)?;
        // Without direct links: a guard sends its echoes through the node, which can stop them.
        let options = Options {
            name: Some(self.name.clone()),
            address: self.address.map(AppAddress::new),
            types: self.routes.iter().map(|route| route.type_name.clone()).collect(),
            has_events: false,
            within: REGISTERED_WITHIN,
        };
        let client = NodeClient::register(&node, &options).await?;
        info!("sends commands as {} ({}) of node {}", self.name, client.tid(), client.node_name());
        Ok(client)
    }

    /// Sends commands until the connection ends. Returns the reason.
    async fn serve(&mut self, mut client: NodeClient) -> ApiError {
        // Before the first answer no unprotected command passes.
        let (mut guarded, mut ask_due) = (None, Instant::now());
        loop {
            tokio::select! {
                () = sleep_until(ask_due) => {
                    ask_due = Instant::now() + GUARDS_ASKED_EVERY;
                    match client.protected_types(GUARDS_ASKED_WITHIN).await {
                        Ok(types) => guarded = Some(types.names),
                        Err(why) => warn!("commands: the guarded types are unknown: {why}"),
                    }
                }
                command = self.queue.recv() => {
                    // The senders are in the subscriptions, which this keeps.
                    let Some(command) = command else { return ApiError::Closed("no subscription".to_owned()) };
                    self.send(&mut client, &command, guarded.as_ref()).await;
                }
                seen = client.receive() => {
                    // Answers of applications are for nobody. To be here is enough for the echoes of guards.
                    if let Err(why) = seen && !matches!(why, ApiError::Disconnected(_)) {
                        return why;
                    }
                }
            }
            while let Some(report) = client.take_undelivered() {
                let is_to = |route: &&Arc<Route>| report.kind.is_none_or(|kind| kind == route.kind);
                let topic = self.routes.iter().find(is_to).map_or("commands", |route| route.topic.as_str());
                self.counts.refuse(topic, &Refusal::new(Cause::Refused, report.to_string()), report.count);
            }
        }
    }

    async fn send(&self, client: &mut NodeClient, command: &Command, guarded: Option<&BTreeSet<String>>) {
        let Command { route, payload } = command;
        let Route { topic, to, type_name, kind, class, expires_after, protected } = &**route;
        if protected.is_none() && guarded.is_none_or(|names| names.contains(type_name)) {
            let why = match guarded {
                Some(_) => {
                    format!("{type_name} is guarded; give the rule the limits of the type as `protected`")
                }
                None => "the nodes have not yet reported which types are guarded".to_owned(),
            };
            return self.counts.refuse(topic, &Refusal::new(Cause::Unprotected, why), 1);
        }
        let message = Outgoing { to, kind: *kind, class: *class, payload, expires_after: *expires_after };
        let sent = match protected {
            Some(protected) => client.send_protected(&message, protected).await,
            None => client.send(&message).await,
        };
        match sent {
            Ok(()) => self.counts.pass(topic),
            Err(why) => self.counts.refuse(topic, &Refusal::new(Cause::NotSent, why.to_string()), 1),
        }
    }

    /// Refuses the commands that wait: they would be old when the node is back.
    fn refuse_waiting(&mut self, why: &str) {
        while let Ok(command) = self.queue.try_recv() {
            self.counts.refuse(&command.route.topic, &Refusal::new(Cause::NotSent, why), 1);
        }
    }
}

impl Route {
    fn of(rule: &Incoming) -> Self {
        let to = match &rule.to {
            Receiver::App(name) => Destination::Name(name.clone()),
            Receiver::Group(name) => Destination::Tid(Tid::group(name)),
        };
        let class = match rule.class {
            SendClass::Control => Class::Control,
            SendClass::Stream => Class::Stream,
            SendClass::Bulk => Class::Bulk,
        };
        let kind = Kind::named(&rule.type_name);
        Self {
            topic: rule.topic.clone(),
            to,
            type_name: rule.type_name.clone(),
            kind,
            class,
            expires_after: rule.max_age(),
            protected: rule.protected.map(|limits| protected(&rule.type_name, kind, limits)),
        }
    }
}

fn protected(type_name: &str, kind: Kind, limits: SealLimits) -> Protected {
    let SealLimits { within_ms, age_max_ms, lost_max, bad_max, good_min } = limits;
    let protection = Protection {
        within: Duration::from_millis(within_ms.into()),
        age_max: Duration::from_millis(age_max_ms.into()),
        lost_max,
        bad_max,
        good_min,
    };
    // Names in data IDs stay until the process ends. There is one for each rule, and rules are read once.
    let name: &'static str = Box::leak(type_name.into());
    // Only a receiver reads.
    Protected { name, kind, protection, reads: Reads::Any }
}

/// Subscribes to all types and versions of a topic: those of others than the rule's are refused.
fn subscribe(
    mut rule: Incoming,
    route: Arc<Route>,
    (graph, node): (&Graph, &GraphNode),
    (queue, counts): (mpsc::Sender<Command>, Counts),
) -> Result<Subscriber<()>, String> {
    let of = (&rule.message.name, &*rule.message);
    let declared = graph.endpoint(node, EndpointKind::Subscription, &rule.topic, of)?;
    let expected = topic_key(graph.domain(), &rule.topic, &rule.message.name, &type_hash(&rule.message));
    info!("takes {} as {} for {}: {}", rule.topic, rule.type_name, rule.to, declared.key);
    let key = format!("{}{}/*/*", graph.domain(), rule.topic);
    let take = move |sample: Sample| {
        let taken = match sample.kind() {
            // Nothing of a robot is deleted from outside.
            SampleKind::Delete => return,
            SampleKind::Put if sample.key_expr().as_str() != expected => {
                let why = format!("{}, and the rule has {expected}", shown(sample.key_expr().as_str()));
                Err(Refusal::new(Cause::OtherType, why))
            }
            SampleKind::Put => {
                let attachment = sample.attachment().map(|attachment| attachment.to_bytes());
                let (now, wall_ns) = (clock::now(), clock::wall_ns());
                rule.take(&sample.payload().to_bytes(), attachment.as_deref(), now, wall_ns)
            }
        };
        let queued = taken.and_then(|payload| {
            let full = |_| Refusal::new(Cause::QueueFull, format!("{QUEUE} commands wait for the node"));
            queue.try_send(Command { route: Arc::clone(&route), payload }).map_err(full)
        });
        if let Err(refusal) = queued {
            counts.refuse(&route.topic, &refusal, 1);
        }
    };
    let declared = graph.session.declare_subscriber(key).callback_mut(take).wait();
    declared.map_err(|why| format!("zenoh: {why}"))
}

/// Subscribes to all topics of a namespace: messages of those without a rule are refused, and counted.
fn watch(
    namespace: &str,
    ruled: BTreeSet<String>,
    graph: &Graph,
    counts: Counts,
) -> Result<Subscriber<()>, String> {
    let domain = graph.domain().to_string();
    let take = move |sample: Sample| {
        let key = sample.key_expr().as_str();
        let Some(topic) = topic_of(key, &domain) else { return };
        if !ruled.contains(topic) {
            let why = format!("{}; write one into the mapping file if commands may come by it", shown(key));
            counts.refuse(&shown(topic), &Refusal::new(Cause::NoRule, why), 1);
        }
    };
    let key = format!("{}{namespace}/**", graph.domain());
    let declared = graph.session.declare_subscriber(key).callback(take).wait();
    info!("refuses all topics without a rule in {namespace}");
    declared.map_err(|why| format!("zenoh: {why}"))
}

/// Returns the topic of a key: the part between its domain, and its type and hash.
fn topic_of<'k>(key: &'k str, domain: &str) -> Option<&'k str> {
    let rest = key.strip_prefix(domain)?;
    let (rest, _hash) = rest.rsplit_once('/')?;
    let (topic, _of) = rest.rsplit_once('/')?;
    topic.starts_with('/').then_some(topic)
}

/// Returns a text from outside for the log, and for counts.
fn shown(text: &str) -> String {
    text.chars().filter(|character| !character.is_control()).take(160).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topic_is_between_domain_and_type() {
        let topic = |key| topic_of(key, "0");
        assert_eq!(topic("0/exo/knee/std_msgs::msg::dds_::Float64_/RIHS01_1"), Some("/exo/knee"));
        assert_eq!(topic("01/exo/type/hash"), None);
        assert_eq!(topic("0/hash"), None);
        assert_eq!(topic("0/type/hash"), None);
    }
}
