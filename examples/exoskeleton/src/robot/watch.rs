//! The application `X.watch` of each node: tells who waits for whom, and writes down which nodes come and go.

use std::sync::{Arc, OnceLock};

use sinew::NodeHandle;
use sinew::prelude::*;

use super::edges::{BarrierStatus, STATUS};
use super::trace::{EventRow, Trace};
use crate::part::Part;

const STATUS_PERIOD: Duration = Duration::from_millis(100);

/// What the watch is made with, in each of its lives.
#[derive(Clone)]
pub struct WatchParts {
    /// The node; empty until it has started.
    pub node: Arc<OnceLock<NodeHandle>>,
    /// Where it writes down what happens.
    pub events: Trace<EventRow>,
}

/// The watch of a node.
pub struct Watch(WatchParts);

/// Declares the watch of a node. It requires nothing: it speaks while the others wait.
#[must_use]
pub fn spec(part: Part, parts: WatchParts) -> AppSpec<Watch> {
    AppSpec::new(format!("{part}.watch"), move || Watch(parts.clone())).handles::<NodeEvent>()
}

impl Watch {
    fn tell(&self, context: &AppContext<Self>) {
        let Some(node) = self.0.node.get() else { return };
        let waiting = node.waiting().iter().map(ToString::to_string).collect();
        // Nobody may want to know.
        let _ = context.send(Tid::group(STATUS), &BarrierStatus { waiting });
    }
}

impl Actor for Watch {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(STATUS_PERIOD, |this, _, context| this.tell(context));
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
        tracing::info!(what, whom, how, "a change in who is there");
        self.0.events.note(EventRow { t_ns: Time::now().as_nanos(), what: what.to_owned(), whom, how });
    }
}
