//! The application `X.watch` of each node: reports waiting applications, and records nodes that appear and
//! disappear.

use std::sync::{Arc, OnceLock};

use exoskeleton_model::part::Part;
use sinew::NodeHandle;
use sinew::prelude::*;

use super::edges::{BarrierStatus, STATUS};
use super::trace::{EventRow, Trace};

const STATUS_PERIOD: Duration = Duration::from_millis(100);

/// The constructor arguments of the watch, the same for each incarnation.
#[derive(Clone)]
pub struct WatchParts {
    /// The node; empty until it has started.
    pub node: Arc<OnceLock<NodeHandle>>,
    /// Trace of the events.
    pub events: Trace<EventRow>,
}

/// The watch of a node.
pub struct Watch(WatchParts);

/// Declares the watch of a node. It has no requirements: it reports while the others wait.
#[must_use]
pub fn spec(part: Part, parts: WatchParts) -> AppSpec<Watch> {
    AppSpec::new(format!("{part}.watch"), move || Watch(parts.clone())).handles::<NodeEvent>()
}

impl Watch {
    fn send_status(&self, context: &AppContext<Self>) {
        let Some(node) = self.0.node.get() else { return };
        let waiting = node.waiting().iter().map(ToString::to_string).collect();
        // There may be no receiver.
        let _ = context.send(Tid::group(STATUS), &BarrierStatus { waiting });
    }
}

impl Actor for Watch {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(STATUS_PERIOD, |this, _, context| this.send_status(context));
    }
}

impl Handler<Delivery<NodeEvent>> for Watch {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        let (what, whom, how) = match event.payload {
            NodeEvent::NodeFound { name, incarnation, .. } => ("node_found", name, incarnation.0.to_string()),
            NodeEvent::NodeRestarted { name, incarnation, .. } => {
                ("node_restarted", name, incarnation.0.to_string())
            }
            NodeEvent::AppStalled { name, app_name, trouble, .. } => {
                ("app_stalled", name, format!("{app_name}: {trouble:?}"))
            }
            NodeEvent::AppResumed { name, app_name, .. } => ("app_resumed", name, app_name),
            NodeEvent::NodeLost { name, why, silent_us, bound_us, .. } => {
                ("node_lost", name, format!("{why:?}, silent for {silent_us} us of {bound_us} us"))
            }
        };
        tracing::info!(what, whom, how, "a part has appeared, changed or gone");
        self.0.events.event(what, &whom, how);
    }
}
