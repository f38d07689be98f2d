//! The work of the thread `stop`: each message, and each order of the core.

use std::{sync::Arc, time::Duration};

use sinew_model::{config::NodeConfig, facts::LossReason, leave_reason::LeaveReason, refusals::BY_LIST};
use sinew_runtime::{
    log,
    outcome::{Outcome, Rejection},
    protection::{Latched, StopLatch, stopped_outputs},
    stop::{AcknowledgeStop, AskStop, PressStop, ReleaseStop, StopReport, StopState},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header, Kind, Message, Payload, encode},
};

use super::{
    core::{Core, Input, Output, Own, SeenNode},
    frame::Frame,
    kept::Kept,
    rights::{self, NO_OPERATOR},
};
use crate::NodeState;

/// Time to live of a state between nodes. spec: STOP-4
const LIVES: Duration = Duration::from_secs(1);
/// Time between two looks at outputs that are not safe yet: for the first 50 ms, and later.
const LOOKS: (Duration, Duration) = (Duration::from_micros(200), Duration::from_millis(5));
/// How long looks are that frequent.
const LOOKS_FOR: Duration = Duration::from_millis(50);
/// Longest sleep; messages wake the thread.
const IDLE: Duration = Duration::from_secs(2);
/// Time after which the thread hands over entries again that wait for the disk.
const DISK_RETRY: Duration = Duration::from_millis(20);
/// Time after which the known nodes are read again if the discovery was busy.
const NODES_RETRY: Duration = Duration::from_millis(10);
/// Maximum number of applications that wait for confirmations; a further one is answered at once.
const WAITING_MAX: usize = 32;
/// Maximum wait for confirmations.
const WITHIN_MAX: Duration = Duration::from_secs(60);

/// Returns the time between two looks at the known nodes.
fn look_period(config: &NodeConfig) -> Duration {
    (config.ndl.period / 2).clamp(Duration::from_millis(10), Duration::from_millis(250))
}

/// An application that waits for all nodes.
struct Waiting {
    question: Message,
    until: Time,
    /// Whether it waits for the end of the stop, and not for the stop.
    for_release: bool,
}

/// The state of the thread.
pub(super) struct Shell {
    core: Core,
    kept: Kept,
    waiting: Vec<Waiting>,
    /// When the known nodes are read next.
    nodes_due: Time,
    /// The latch with the presses that the core knows. A release ends only these: a press that an application made
    /// when the queue of the thread `stop` was full stays in force.
    covered: Latched,
    /// Number of frames and answers that were sent.
    sent: u64,
}

impl Shell {
    pub(super) fn new(state: &NodeState, now: Time) -> Self {
        let config = &state.ctx.config;
        let detection = config.ndl.period * (config.ndl.missed_max + 2);
        let (kept, before) = Kept::begin(&state.ctx);
        let own = Own {
            node: state.ctx.node,
            incarnation: state.ctx.incarnation,
            name: config.name.clone(),
            has_lived: before.is_some(),
            hold: config.ndl.period * 2 + look_period(config),
            on_lost: config.stop.on_lost.then_some(detection),
        };
        let core = Core::new(own, before.unwrap_or_default(), now);
        Self {
            core,
            kept,
            waiting: Vec::new(),
            nodes_due: now,
            covered: state.ctx.router.stop().read(),
            sent: 0,
        }
    }

    /// Returns how long the thread may sleep.
    pub(super) fn rests(&self, now: Time, stopped_since: Option<Time>) -> Duration {
        let wakes = self.core.next_wake().into_iter().chain(self.waiting.iter().map(|one| one.until));
        let wakes = wakes.chain([self.nodes_due]);
        let idle = if self.kept.is_pending() { DISK_RETRY } else { IDLE };
        let rests = wakes.map(|at| at.since(now)).min().unwrap_or(idle).min(idle);
        let is_recent = stopped_since.is_some_and(|since| now.since(since) < LOOKS_FOR);
        match (self.core.is_stopped() && !self.core.is_safe(), is_recent) {
            (false, _) => rests,
            (true, true) => rests.min(LOOKS.0),
            (true, false) => rests.min(LOOKS.1),
        }
    }

    /// Handles a message, and all that has become due.
    pub(super) fn turn(&mut self, state: &Arc<NodeState>, now: Time, message: Option<Message>) {
        match message {
            Some(message) => self.receive(state, now, message),
            None => self.handle(state, now, Input::TimePassed),
        }
        self.read_nodes(state, now);
        if state.ctx.router.stop().read().is_stopped() && !self.core.is_stopped() {
            // An application has set the latch itself, and its message is not there yet, or was refused. Or it did so
            // while another stop was in force that is released now.
            let by = Tid::new(state.ctx.node, AppAddress::STOP);
            let reason = LeaveReason::of("an application of this node pressed");
            self.handle(state, now, Input::Pressed { by, reason });
        }
        let latch = state.ctx.router.stop();
        // An output that is made meanwhile obeys the latch from its start.
        let outputs = stopped_outputs(latch);
        self.handle(state, now, Input::OutputsSeen(outputs, latch.not_safe()));
        self.kept.retry();
        self.answer_waiting(state, now);
    }

    /// Reads the known nodes, if that is due. It waits for no layer: while the discovery has its lock, it tries again.
    fn read_nodes(&mut self, state: &Arc<NodeState>, now: Time) {
        if now < self.nodes_due {
            return;
        }
        self.nodes_due = now + NODES_RETRY;
        let Some(nodes) = nodes(state) else { return };
        let next = now + look_period(&state.ctx.config);
        let hold = self.core.hold_ends();
        self.nodes_due = if hold > now { hold.min(next) } else { next };
        self.handle(state, now, Input::NodesSeen(nodes));
    }

    fn handle(&mut self, state: &Arc<NodeState>, now: Time, input: Input) {
        let latch = state.ctx.router.stop();
        if matches!(input, Input::Pressed { .. }) {
            // It stands for those that applications have set so far.
            self.covered = latch.read();
        }
        self.core.handle(now, input);
        let mut is_pressed = false;
        while let Some(order) = self.core.poll() {
            match order {
                Output::SetLatch(StopState::Stopped) => {
                    self.covered = press_once(latch).unwrap_or(self.covered);
                    is_pressed = true;
                }
                Output::SetLatch(to) => self.end_stop(latch, to),
                Output::PassStop => {
                    // A press of an application before or meanwhile stays.
                    if let Some(passed) = press_once(latch) {
                        latch.release(passed);
                    }
                    latch.hold(self.core.latched() == StopState::Held);
                    log::warn!(
                        "a stop was pressed and released while this node was away: its outputs become safe"
                    );
                }
                Output::Send(to, frame) => self.send(state, to, &frame),
                Output::Keep => self.kept.keep(self.core.stops()),
            }
        }
        if is_pressed {
            // After the other nodes know.
            self.note_press(state, now);
        }
    }

    /// Notes a press in the log and in the flight recorder.
    fn note_press(&self, state: &NodeState, now: Time) {
        let report = self.core.report();
        let press = report.presses.first();
        let by = press.map_or(Tid::NONE, |press| press.by);
        let reason = press.map_or_else(String::new, |press| press.reason.clone());
        log::warn!(%by, reason, "the stop is pressed: guarded outputs become safe");
        if let Some(flight) = state.recording.flight() {
            flight.happened(now, &format!("the stop is pressed by {by}: {reason}"));
        }
    }

    fn end_stop(&self, latch: &StopLatch, to: StopState) {
        if latch.release(self.covered) {
            log::warn!("the stop is released: outputs stay safe until their applications acknowledge it");
        }
        latch.hold(to == StopState::Held);
    }

    fn receive(&mut self, state: &Arc<NodeState>, now: Time, mut message: Message) {
        let source = message.header.source;
        let received = match message.header.kind {
            Kind::PING => Ok(()),
            Kind::STOP_STATE if source.app != AppAddress::STOP || source.node == state.ctx.node => {
                let detail = format_args!("{source} sent a state of the stop, and is no node");
                state.ctx.refusals.count(now, "stop", &detail);
                Err(Rejection::ForgedSource)
            }
            Kind::STOP_STATE => self.receive_frame(state, now, &message),
            AcknowledgeStop::KIND if source.node != state.ctx.node => Err(Rejection::ForgedSource),
            AcknowledgeStop::KIND => {
                let is_taken = state.ctx.router.acknowledge_stop(source.app);
                if is_taken { Ok(()) } else { Err(Rejection::ByHandler) }
            }
            PressStop::KIND => return self.press(state, now, message),
            ReleaseStop::KIND | AskStop::KIND if !message.header.flags.has(Flags::ASK) => {
                Err(Rejection::Unsupported)
            }
            ReleaseStop::KIND => return self.release(state, now, message),
            AskStop::KIND => self.reply(state, &message, &self.core.report()),
            _ => Err(Rejection::UnknownKind),
        };
        message.settle(received.map_or_else(Outcome::Rejected, |()| Outcome::Delivered));
    }

    fn receive_frame(
        &mut self,
        state: &Arc<NodeState>,
        now: Time,
        message: &Message,
    ) -> Result<(), Rejection> {
        let from = message.header.source.node;
        let frame = Frame::of(message).map_err(|fault| {
            state.ctx.refusals.count(now, "stop", &format_args!("from {from}, {fault}"));
            Rejection::Malformed
        })?;
        let operators = rights::operators(state, &frame.entries);
        self.handle(state, now, Input::FrameReceived { from, frame, operators });
        Ok(())
    }

    /// spec: STOP-9
    fn press(&mut self, state: &Arc<NodeState>, now: Time, mut question: Message) {
        // A press that cannot be read is one, too.
        let order = question.decode::<PressStop>().unwrap_or_default();
        let reason = if order.reason.trim().is_empty() { "no reason given" } else { order.reason.trim() };
        let by = question.header.source;
        self.handle(state, now, Input::Pressed { by, reason: LeaveReason::of(reason) });
        if !question.header.flags.has(Flags::ASK) {
            // It stops, and nothing waits for the report.
            return question.settle(Outcome::Delivered);
        }
        self.wait(state, now, question, (order.within_ms, false));
    }

    /// spec: STOP-3
    fn release(&mut self, state: &Arc<NodeState>, now: Time, mut question: Message) {
        let Ok(order) = question.decode::<ReleaseStop>() else {
            return question.settle(Outcome::Rejected(Rejection::Malformed));
        };
        let by = question.header.source;
        if !rights::may_release(state, by) {
            let detail = format_args!("{by} is no operator, and may not release the stop");
            state.ctx.refusals.count(now, BY_LIST, &detail);
            let report = StopReport { refused: Some(NO_OPERATOR.to_owned()), ..self.core.report() };
            let replied = self.reply(state, &question, &report);
            return question.settle(replied.map_or_else(Outcome::Rejected, |()| Outcome::Delivered));
        }
        self.handle(state, now, Input::Released { by });
        self.wait(state, now, question, (order.within_ms, true));
    }

    fn wait(
        &mut self,
        state: &Arc<NodeState>,
        now: Time,
        question: Message,
        (within_ms, for_release): (u32, bool),
    ) {
        let within = Duration::from_millis(within_ms.into()).min(WITHIN_MAX);
        let until = if self.waiting.len() < WAITING_MAX { now + within } else { now };
        self.waiting.push(Waiting { question, until, for_release });
        self.answer_waiting(state, now);
    }

    fn answer_waiting(&mut self, state: &Arc<NodeState>, now: Time) {
        let (is_stopped, is_released) = (self.core.is_confirmed(), self.core.is_released_everywhere());
        for mut one in std::mem::take(&mut self.waiting) {
            let is_done = if one.for_release { is_released } else { is_stopped };
            if !is_done && now < one.until {
                self.waiting.push(one);
                continue;
            }
            let replied = self.reply(state, &one.question, &self.core.report());
            one.question.settle(replied.map_or_else(Outcome::Rejected, |()| Outcome::Delivered));
        }
    }

    fn reply(&mut self, state: &NodeState, question: &Message, report: &StopReport) -> Result<(), Rejection> {
        let mut report = report.clone();
        let asked = question.header;
        let mut message = Message::typed(asked.destination, asked.source, &report);
        while message.payload.len() > state.ctx.config.payload_max && report.nodes.len() > 1 {
            report.nodes.truncate(report.nodes.len() / 2);
            report.presses.truncate(1);
            message = Message::typed(asked.destination, asked.source, &report);
        }
        message.header.flags = Flags::REPLY;
        message.header.correlation = asked.correlation;
        self.dispatch(state, message)
    }

    fn send(&mut self, state: &NodeState, to: NodeAddress, frame: &Frame) {
        if !state.ctx.router.linked().contains(&to) {
            return;
        }
        let ends = [state.ctx.node, to].map(|node| Tid::new(node, AppAddress::STOP));
        let header = Header::new(Kind::STOP_STATE, ends[0], ends[1]);
        let mut message = Message::new(header, encode(frame));
        // The frame has no outcome: it is repeated.
        let _ = message.header.set_time_to_live(LIVES);
        let _ = self.dispatch(state, message);
    }

    fn dispatch(&mut self, state: &NodeState, mut message: Message) -> Result<(), Rejection> {
        self.sent += 1;
        message.header.sequence = self.sent;
        message.header.sent = Time::now();
        state.ctx.router.send(message)
    }
}

/// Returns the present nodes, and those that were lost without a farewell; `None` while the discovery is busy.
fn nodes(state: &NodeState) -> Option<Vec<SeenNode>> {
    let (present, lost) = state.ctx.ports.members()?.in_brief()?;
    let present = present.into_iter().map(|member| SeenNode {
        node: member.node,
        incarnation: member.incarnation,
        name: member.name,
        lost: None,
    });
    let mut nodes: Vec<_> = present.filter(|node| node.node != state.ctx.node).collect();
    for lost in lost {
        let is_known = nodes.iter().any(|node| node.node == lost.node);
        if !is_known && lost.why != LossReason::Left {
            let (node, incarnation) = (lost.node, lost.incarnation);
            nodes.push(SeenNode { node, incarnation, name: String::new(), lost: Some(lost.why.to_string()) });
        }
    }
    Some(nodes)
}

/// Presses, and returns the latch by that press; `None`: an application pressed before or meanwhile.
fn press_once(latch: &StopLatch) -> Option<Latched> {
    let before = latch.read();
    if before.is_stopped() {
        return None;
    }
    let pressed = latch.press();
    (pressed.presses() == before.presses() + 1).then_some(pressed)
}

#[cfg(test)]
mod tests {
    use sinew_runtime::tid::Incarnation;

    use super::*;

    fn pressed(state: &Arc<NodeState>) -> Shell {
        let mut shell = Shell::new(state, Time::now());
        shell.turn(state, Time::now(), None);
        press(&mut shell, state);
        assert!(state.ctx.router.stop().read().is_stopped());
        shell
    }

    fn press(shell: &mut Shell, state: &Arc<NodeState>) {
        let (by, reason) = (Tid::NONE, LeaveReason::of("a test"));
        shell.handle(state, Time::now(), Input::Pressed { by, reason });
    }

    fn release(shell: &mut Shell, state: &Arc<NodeState>) {
        shell.handle(state, Time::now(), Input::Released { by: Tid::NONE });
    }

    #[test]
    fn press_whose_message_was_refused_outlasts_a_release() {
        let state = NodeState::new(NodeConfig::new("knee"), Incarnation(1));
        let latch = state.ctx.router.stop();
        let mut shell = pressed(&state);
        // When: an application presses while a stop is in force, and no message of it arrives
        latch.press();
        release(&mut shell, &state);
        assert!(latch.read().is_stopped() && !shell.core.is_stopped());
        // Then: the node presses for it
        shell.turn(&state, Time::now(), None);
        assert!(shell.core.is_stopped());
        release(&mut shell, &state);
        assert!(!latch.read().is_stopped());
    }

    #[test]
    fn press_with_its_message_is_released_with_it() {
        let state = NodeState::new(NodeConfig::new("knee"), Incarnation(1));
        let latch = state.ctx.router.stop();
        let mut shell = pressed(&state);
        latch.press();
        press(&mut shell, &state);
        release(&mut shell, &state);
        assert!(!latch.read().is_stopped());
        shell.turn(&state, Time::now(), None);
        assert!(!shell.core.is_stopped());
    }
}
