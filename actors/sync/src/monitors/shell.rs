//! Executes the outputs of the monitor core, on the thread that reports an event.

use sinew_model::facts::{LinkFact, LossReason, MembershipFact};
use sinew_runtime::{
    lock,
    mailbox::About,
    monitor::{Down, DownClass},
    outcome::Rejection,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Header, Kind, Message, Payload, decode},
};

use super::{
    core::{Core, Input, Output},
    protocol::write,
};
use crate::State;

impl From<&MembershipFact> for Input {
    fn from(fact: &MembershipFact) -> Self {
        match fact {
            MembershipFact::NodeFound { node, incarnation, .. } => {
                Self::NodeFound { node: *node, incarnation: *incarnation }
            }
            MembershipFact::NodeLost { node, incarnation, why } => {
                let (node, incarnation) = (*node, *incarnation);
                let why = match why {
                    LossReason::GaveUp(words) => return Self::gave_up(node, incarnation, words),
                    LossReason::Left => "its node left",
                    LossReason::Crashed => "its node was lost: its process ended",
                    LossReason::Hung => "its node was lost: it hangs, while its host answers",
                    LossReason::LinkDown => "its node was lost: neither it nor its host answers",
                    LossReason::Restarted => "its node was restarted",
                    LossReason::Duplicate => "its node is none: another process holds that node address",
                };
                Self::NodeLost { node, incarnation, why: why.into() }
            }
        }
    }
}

impl Input {
    fn gave_up(node: NodeAddress, incarnation: Incarnation, words: &str) -> Self {
        Self::NodeLost { node, incarnation, why: format!("its node gave up: {words}").into() }
    }

    /// Returns the input that a link event is for monitors. Returns `None` if the event does not concern
    /// them.
    pub fn of_link(fact: &LinkFact) -> Option<Self> {
        match *fact {
            LinkFact::LinkUp { node, incarnation } => Some(Self::LinkUp { node, incarnation }),
            LinkFact::LinkBroken { node, incarnation } => Some(Self::LinkBroken { node, incarnation }),
            LinkFact::PeerLeft { node, incarnation, gave_up: Some(ref words) } => {
                Some(Self::gave_up(node, incarnation, words.as_str()))
            }
            LinkFact::PeerLeft { node, incarnation, gave_up: None } => {
                Some(Self::NodeLost { node, incarnation, why: "its node left".into() })
            }
            LinkFact::DialRefused { .. } => None,
        }
    }
}

/// Passes an input to the core and executes the outputs. Callers must hold no lock of the node, because
/// messages are sent.
pub fn feed(state: &State, input: Input) {
    change(state, |core| core.handle(Time::now(), input));
}

/// Changes the core and executes the outputs.
pub fn change<T>(state: &State, change: impl FnOnce(&mut Core) -> T) -> T {
    let (result, is_earlier) = {
        let mut core = lock(&state.monitors);
        let before = core.next_wake();
        let result = change(&mut core);
        (result, core.next_wake().is_some_and(|wake| before.is_none_or(|before| wake < before)))
    };
    drain(state);
    if is_earlier {
        schedule_drain(state);
    }
    result
}

/// Passes an input to the core while the caller holds a lock. The sync manager executes the outputs.
pub fn feed_deferred(state: &State, input: Input) {
    let has_outputs = {
        let mut core = lock(&state.monitors);
        core.handle(Time::now(), input);
        core.has_outputs()
    };
    if has_outputs {
        schedule_drain(state);
    }
}

/// Returns whether outputs are pending for [`drain`].
pub fn has_outputs(state: &State) -> bool {
    lock(&state.monitors).has_outputs()
}

/// Executes the pending outputs of the core.
pub fn drain(state: &State) {
    loop {
        let Some(output) = lock(&state.monitors).poll() else { return };
        match output {
            Output::Notify { watcher, down } => notify(state, watcher, down),
            Output::Watch { to, watch } => send(state, to, Kind::SYNC_WATCH, write(&watch)),
            Output::Lives { to, lives } => {
                for part in lives.in_parts(state.ctx.config.payload_max) {
                    send(state, to, Kind::SYNC_LIVES, write(&part));
                }
            }
        }
    }
}

/// Returns the time at which the sync manager must pass `TimePassed` to the core.
pub fn next_wake(state: &State) -> Option<Time> {
    lock(&state.monitors).next_wake()
}

/// Handles a frame from the sync manager of another node.
///
/// # Errors
/// Returns a description of the fault if the frame is invalid.
pub fn receive(state: &State, from: NodeAddress, message: &Message) -> Result<(), String> {
    let describe = |error: rmp_serde::decode::Error| format!("from {from}: {error}");
    let input = match message.header.kind {
        Kind::SYNC_WATCH => Input::Watch { from, watch: decode(&message.payload).map_err(describe)? },
        Kind::SYNC_LIVES => Input::Lives { from, lives: decode(&message.payload).map_err(describe)? },
        kind => return Err(format!("{from} sent kind {kind}")),
    };
    feed(state, input);
    Ok(())
}

fn schedule_drain(state: &State) {
    if state.ctx.event_queues.sync.post(crate::Event::Monitors).is_err() {
        sinew_runtime::log::error!(
            "the sync manager's event queue is full; monitors are evaluated late: does it hang?"
        );
    }
}

fn notify(state: &State, watcher: AppAddress, down: Down) {
    let mut message =
        Message::new(header(state, Down::KIND, state.ctx.node, watcher), sinew_runtime::wire::encode(&down));
    message.header.class = Down::CLASS;
    let wakes = state.ctx.room_notifier.wakes();
    let sent = if down.class == DownClass::NodeLost {
        send_behind_messages(state, About::End(down.tid.node), message)
    } else {
        state.ctx.offer_event(message)
    };
    if let Err(Rejection::QueueFull) = sent {
        // Any other rejection means that the watcher has ended, and its monitors with it. The caller of
        // `drain` executes the outputs that follow, outside this call. A thousand rejections therefore need
        // no deep stack.
        lock(&state.monitors).handle(Time::now(), Input::DownRejected { watcher, down });
        if state.ctx.room_notifier.wakes() != wakes {
            state.ctx.room_notifier.sync_events.notify_one();
        }
    }
}

fn send_behind_messages(state: &State, about: About, message: Message) -> Result<(), Rejection> {
    match state.ctx.ports.links() {
        Some(links) => links.notify_after_messages(about, message),
        None => state.ctx.offer_event(message),
    }
}

fn send(state: &State, to: NodeAddress, kind: Kind, payload: bytes::Bytes) {
    // A rejected frame is sent again within 2 s, and when the link is up again.
    let _ = state.ctx.router.send(Message::new(header(state, kind, to, AppAddress::SYNC), payload));
}

fn header(state: &State, kind: Kind, node: NodeAddress, app: AppAddress) -> Header {
    let mut header = Header::new(kind, Tid::new(state.ctx.node, AppAddress::SYNC), Tid::new(node, app));
    header.sequence = lock(&state.core).next_sequence();
    header.sent = Time::now();
    header
}

#[cfg(test)]
mod tests {
    use std::sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    };

    use sinew_runtime::{
        router::{LocalRoute, MessageSink, SubmitError},
        tid::Incarnation,
    };

    use super::*;
    use crate::monitors::core::PER_WATCHER_MAX;
    use sinew_model::{cause::Cause, config::NodeConfig};

    const WATCHERS: u32 = 15;

    /// A full mailbox, which records the stack addresses of the calls.
    #[derive(Default)]
    struct Full {
        refused: AtomicUsize,
        deepest: AtomicUsize,
        highest: AtomicUsize,
    }

    impl MessageSink for Full {
        fn submit(&self, message: Message) -> Result<(), SubmitError> {
            let mark = 0_u8;
            let at = std::ptr::from_ref(&mark).addr();
            self.refused.fetch_add(1, Ordering::Relaxed);
            self.highest.fetch_max(at, Ordering::Relaxed);
            // So that the least value is the first: the stack grows downwards.
            self.deepest.fetch_max(usize::MAX - at, Ordering::Relaxed);
            Err(SubmitError::new(message, Rejection::QueueFull))
        }
    }

    /// All these monitors end at once, and no mailbox has room: each refusal is an event of its own during
    /// the notifications.
    fn rejected_downs() -> Arc<Full> {
        let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
        let (target, full) = (AppAddress::fixed(0).expect("a fixed one"), Arc::new(Full::default()));
        feed(&state, Input::Started { app: target });
        for index in 1..=WATCHERS {
            let watcher = AppAddress::fixed(index).expect("a fixed one");
            state.ctx.router.set_local(watcher, LocalRoute { sink: full.clone(), events: Arc::new([]) });
            for _ in 0..PER_WATCHER_MAX {
                let set = change(&state, |core| {
                    core.monitor(Time::now(), watcher, Tid::new(state.ctx.node, target))
                });
                set.expect("there is room for so many");
            }
        }
        let cause = Cause::new(DownClass::Panic, "its end");
        feed(&state, Input::Ended { app: target, cause, is_gone: true });
        full
    }

    #[test]
    fn refused_ends_do_not_deepen_the_stack() {
        // Room enough, so that a stack that is too deep fails this test and no other.
        let thread = std::thread::Builder::new().stack_size(1 << 28).spawn(rejected_downs);
        let full = thread.expect("a thread").join().expect("it does not panic");
        assert_eq!(full.refused.load(Ordering::Relaxed), WATCHERS as usize * PER_WATCHER_MAX);
        let deepest = usize::MAX - full.deepest.load(Ordering::Relaxed);
        let depth = full.highest.load(Ordering::Relaxed) - deepest;
        assert!(depth < 16 * 1024, "{depth} bytes of stack between the first refusal and the deepest one");
    }
}
