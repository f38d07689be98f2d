//! The thread `stop`, its inbox, and the thread that looks at the known nodes for it.
//!
//! A press takes no lock of a layer: a layer that hangs does not delay it. So the nodes that the discovery knows are
//! read by a thread of their own.

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Weak,
        mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel},
    },
    thread,
};

use sinew_model::{facts::LossReason, thread_priority::lower_priority};
use sinew_runtime::{
    log,
    outcome::Rejection,
    protection::SAFE_OUTPUT_PRIORITY,
    router::{LocalRoute, MessageSink, SubmitError},
    stop::PressStop,
    supervision::request_stop_priority,
    tid::AppAddress,
    time::Time,
    wire::{Message, Payload},
};

use super::{
    core::SeenNode,
    shell::{Event, Shell, look_period},
};
use crate::NodeState;

/// Maximum number of messages that wait.
const WAITING_MAX: usize = 256;

/// The queue of the thread.
struct Inbox {
    put: SyncSender<Event>,
    state: Weak<NodeState>,
    /// Dropped with the route: then both threads end.
    _route: Arc<()>,
}

impl MessageSink for Inbox {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        let is_press = message.header.kind == PressStop::KIND;
        self.put.try_send(Event::Message(message)).map_err(|refused| {
            let (event, why) = match refused {
                TrySendError::Full(event) => (event, Rejection::QueueFull),
                TrySendError::Disconnected(event) => (event, Rejection::Closed),
            };
            // The thread finds the latch pressed, and tells the other nodes.
            if is_press && let Some(state) = self.state.upgrade() {
                state.ctx.router.stop().press();
            }
            let Event::Message(message) = event else { unreachable!("a full queue returns what was put") };
            SubmitError::new(message, why)
        })
    }
}

/// Obeys and tells the stop until the routing table removes the address, or the node ends.
///
/// # Errors
/// A thread cannot be started.
pub(crate) fn begin(state: &Arc<NodeState>) -> io::Result<()> {
    let (put, events) = sync_channel(WAITING_MAX);
    let mut shell = Shell::new(state, Time::now());
    // Before any application: it is held from its start.
    shell.turn(state, Time::now(), None);
    let route = Arc::new(());
    let of = Of { state: Arc::downgrade(state), route: Arc::downgrade(&route) };
    let (of_serve, of_look, nodes) = (of.clone(), of, put.clone());
    thread::Builder::new().name("stop".to_owned()).spawn(move || serve(&of_serve, &events, shell))?;
    thread::Builder::new().name("stop-nodes".to_owned()).spawn(move || look(&of_look, &nodes))?;
    let sink = Arc::new(Inbox { put, state: Arc::downgrade(state), _route: route });
    state.ctx.router.set_local(AppAddress::STOP, LocalRoute { sink, events: Arc::new([]) });
    Ok(())
}

/// The node of the two threads, while it runs.
#[derive(Clone)]
struct Of {
    state: Weak<NodeState>,
    route: Weak<()>,
}

impl Of {
    fn state(&self) -> Option<Arc<NodeState>> {
        self.state.upgrade().filter(|_| self.route.strong_count() > 0)
    }
}

fn serve(of: &Of, events: &Receiver<Event>, mut shell: Shell) {
    // A control loop that never sleeps must not keep it from running.
    request_stop_priority(SAFE_OUTPUT_PRIORITY - 1);
    let mut stopped_since = None;
    loop {
        let now = Time::now();
        let event = match events.recv_timeout(shell.rests(now, stopped_since)) {
            Ok(event) => Some(event),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return,
        };
        let Some(state) = of.state() else { return };
        let turn = AssertUnwindSafe(|| shell.turn(&state, Time::now(), event));
        if catch_unwind(turn).is_err() {
            // Its state may be wrong: stopped is the safe side.
            log::error!("the thread `stop` panicked: the outputs of this node are stopped");
            state.ctx.router.stop().press();
        }
        let is_stopped = state.ctx.router.stop().read().is_stopped();
        stopped_since = if is_stopped { stopped_since.or_else(|| Some(Time::now())) } else { None };
    }
}

/// Reads the known nodes, until the node ends.
fn look(of: &Of, events: &SyncSender<Event>) {
    lower_priority();
    let mut known = None;
    while let Some(state) = of.state() {
        let nodes = nodes(&state);
        if known.as_ref() != Some(&nodes) {
            match events.try_send(Event::Nodes(nodes.clone())) {
                Ok(()) => known = Some(nodes),
                // It is told at the next look.
                Err(TrySendError::Full(_)) => {}
                Err(TrySendError::Disconnected(_)) => return,
            }
        }
        let period = look_period(&state.ctx.config);
        drop(state);
        thread::sleep(period);
    }
}

/// Returns the present nodes, and those that were lost without a farewell.
fn nodes(state: &NodeState) -> Vec<SeenNode> {
    let Some(members) = state.ctx.ports.members() else { return Vec::new() };
    let present = members.present().into_iter().map(|member| SeenNode {
        node: member.node,
        incarnation: member.incarnation,
        name: member.name,
        lost: None,
    });
    let mut nodes: Vec<_> = present.filter(|node| node.node != state.ctx.node).collect();
    for lost in members.lost() {
        let is_known = nodes.iter().any(|node| node.node == lost.node);
        if !is_known && lost.why != LossReason::Left {
            let (node, incarnation) = (lost.node, lost.incarnation);
            nodes.push(SeenNode { node, incarnation, name: String::new(), lost: Some(lost.why.to_string()) });
        }
    }
    nodes
}
