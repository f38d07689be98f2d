//! Topics that are published: messages of applications, read from the journal of the node. No sender waits for them.

use std::{path::Path, thread, time::Duration};

use sinew::{NodeApi, Registration, message::Kind, protection::unsealed};
use sinew_recorder::{Follower, Seen, Selection};
use sinew_ros2_core::{Attachment, Cause, EndpointKind, GraphNode, Outgoing, Refusal};
use tracing::{info, warn};
use zenoh::{Wait as _, bytes::Encoding, pubsub::Publisher, qos::CongestionControl};

use crate::{
    clock,
    counts::Counts,
    graph::{Declared, Graph},
};

/// Time between two looks at the journal.
const POLLED_EVERY: Duration = Duration::from_millis(2);
/// Time after which a node is tried again.
const RETRIED_AFTER: Duration = Duration::from_secs(1);
/// Time limit of the registration.
const REGISTERED_WITHIN: Duration = Duration::from_secs(10);
/// Maximum names in a selection of messages. With more, messages of all applications or types are read.
const SELECTED_MAX: usize = 64;

/// The published topics.
pub(crate) struct Topics {
    counts: Counts,
    all: Vec<Topic>,
}

struct Topic {
    rule: Outgoing,
    kinds: Vec<Kind>,
    declared: Declared,
    publisher: Publisher<'static>,
    sequence: i64,
}

impl Topics {
    /// Declares the topics.
    ///
    /// # Errors
    /// The session is closed.
    pub(crate) fn declare(
        rules: Vec<Outgoing>,
        graph: &Graph,
        node: &GraphNode,
        counts: Counts,
    ) -> Result<Self, String> {
        let declare = |rule: Outgoing| {
            let of = (&rule.message.name, &*rule.message);
            let declared = graph.endpoint(node, EndpointKind::Publisher, &rule.topic, of)?;
            let publisher = graph
                .session
                .declare_publisher(declared.key.clone())
                .encoding(Encoding::APPLICATION_CDR)
                // A full connection with the router delays nothing here.
                .congestion_control(CongestionControl::Drop)
                .express(true)
                .wait()
                .map_err(|why| format!("zenoh: {}: {why}", rule.topic))?;
            info!("publishes {} under {}", rule.topic, declared.key);
            let kinds = rule.inputs.iter().map(|input| Kind::named(&input.type_name)).collect();
            Ok(Topic { rule, kinds, declared, publisher, sequence: 0 })
        };
        Ok(Self { counts, all: rules.into_iter().map(declare).collect::<Result<_, String>>()? })
    }

    /// Reads and publishes until the program ends. A lost node is tried again each second.
    pub(crate) fn run(mut self, socket: &Path) -> Result<(), String> {
        let mut last = String::new();
        loop {
            let why = self.follow(socket);
            if why != last {
                warn!("topics: {why}; tries again each second");
                last = why;
            }
            thread::sleep(RETRIED_AFTER);
        }
    }

    /// Reads the messages of a node until its connection ends. Returns the reason.
    fn follow(&mut self, socket: &Path) -> String {
        let registered = NodeApi::connect(socket).and_then(|node| {
            node.register_transport_address(
                Registration::new().deadline(REGISTERED_WITHIN).without_reconnect(),
            )
        });
        let endpoint = match registered {
            Ok(endpoint) => endpoint,
            Err(why) => return why.to_string(),
        };
        let name = endpoint.node_name().to_owned();
        let mut follower = match Follower::begin(endpoint, self.selection()) {
            Ok(follower) => follower,
            Err(why) => return why.to_string(),
        };
        info!("reads the messages of node {name}");
        loop {
            if let Err(why) = follower.poll(&mut |seen| self.take(seen)) {
                return why.to_string();
            }
            self.publish();
            thread::sleep(POLLED_EVERY);
        }
    }

    fn selection(&self) -> Selection {
        let inputs = || self.all.iter().flat_map(|topic| &topic.rule.inputs);
        let unique = |mut names: Vec<String>| {
            names.sort();
            names.dedup();
            if names.len() > SELECTED_MAX { Vec::new() } else { names }
        };
        let apps = unique(inputs().map(|input| input.app.clone()).collect());
        let types = unique(inputs().map(|input| input.type_name.clone()).collect());
        Selection { apps, types, ..Selection::default() }
    }

    fn take(&mut self, seen: &Seen<'_>) {
        let Some(app) = seen.names.app(seen.header.source) else { return };
        // A protected payload is in an envelope.
        let payload = unsealed(seen.payload).map_or(seen.payload, |unsealed| unsealed.payload);
        let at = Duration::from_nanos(seen.at.as_nanos());
        for Topic { rule, kinds, .. } in &mut self.all {
            for (input, kind) in kinds.iter().enumerate() {
                if *kind != seen.header.kind || rule.inputs[input].app != app {
                    continue;
                }
                if let Err(why) = rule.take(input, payload, at) {
                    let refusal = Refusal::new(Cause::Malformed, format!("of {app}: {why}"));
                    self.counts.refuse(&rule.topic, &refusal, 1);
                }
            }
        }
    }

    fn publish(&mut self) {
        for Topic { rule, declared, publisher, sequence, .. } in &mut self.all {
            let (now, time_ns) = (clock::now(), clock::wall_ns());
            match rule.poll(now, time_ns) {
                Ok(None) => {}
                Ok(Some(bytes)) => {
                    *sequence += 1;
                    let attachment = Attachment { sequence: *sequence, time_ns, gid: declared.gid }.encode();
                    match publisher.put(bytes).attachment(&attachment[..]).wait() {
                        Ok(()) => self.counts.pass(&rule.topic),
                        Err(why) => {
                            self.counts.refuse(
                                &rule.topic,
                                &Refusal::new(Cause::NotSent, why.to_string()),
                                1,
                            );
                        }
                    }
                }
                Err(why) => {
                    self.counts.refuse(&rule.topic, &Refusal::new(Cause::TooLong, why.to_string()), 1);
                }
            }
        }
    }
}
