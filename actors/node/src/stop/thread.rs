//! The thread `stop`, and its inbox.

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Weak,
        mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel},
    },
    thread,
};

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

use super::shell::Shell;
use crate::NodeState;

/// Maximum number of messages that wait.
const WAITING_MAX: usize = 256;

/// The queue of the thread.
struct Inbox {
    put: SyncSender<Message>,
    state: Weak<NodeState>,
    /// Dropped with the route: then the thread ends.
    _route: Arc<()>,
}

impl MessageSink for Inbox {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        let is_press = message.header.kind == PressStop::KIND;
        self.put.try_send(message).map_err(|refused| {
            let (message, why) = match refused {
                TrySendError::Full(message) => (message, Rejection::QueueFull),
                TrySendError::Disconnected(message) => (message, Rejection::Closed),
            };
            // The thread finds the latch pressed, and tells the other nodes.
            if is_press && let Some(state) = self.state.upgrade() {
                state.ctx.router.stop().press();
            }
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
    state.ctx.router.stop().begin();
    shell.turn(state, Time::now(), None);
    let route = Arc::new(());
    let of = Of { state: Arc::downgrade(state), route: Arc::downgrade(&route) };
    thread::Builder::new().name("stop".to_owned()).spawn(move || serve(&of, &events, shell))?;
    let sink = Arc::new(Inbox { put, state: Arc::downgrade(state), _route: route });
    state.ctx.router.set_local(AppAddress::STOP, LocalRoute { sink, events: Arc::new([]) });
    Ok(())
}

/// The node of the thread, while it runs.
struct Of {
    state: Weak<NodeState>,
    route: Weak<()>,
}

impl Of {
    fn state(&self) -> Option<Arc<NodeState>> {
        self.state.upgrade().filter(|_| self.route.strong_count() > 0)
    }
}

fn serve(of: &Of, events: &Receiver<Message>, mut shell: Shell) {
    // A control loop that never sleeps must not keep it from running.
    request_stop_priority(SAFE_OUTPUT_PRIORITY - 1);
    let mut stopped_since = None;
    loop {
        let now = Time::now();
        let message = match events.recv_timeout(shell.rests(now, stopped_since)) {
            Ok(message) => Some(message),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return,
        };
        let Some(state) = of.state() else { return };
        let turn = AssertUnwindSafe(|| shell.turn(&state, Time::now(), message));
        if catch_unwind(turn).is_err() {
            // Its state may be wrong: stopped is the safe side.
            log::error!("the thread `stop` panicked: the outputs of this node are stopped");
            state.ctx.router.stop().press();
        }
        let is_stopped = state.ctx.router.stop().read().is_stopped();
        stopped_since = if is_stopped { stopped_since.or_else(|| Some(Time::now())) } else { None };
    }
}
