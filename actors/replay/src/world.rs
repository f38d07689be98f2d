//! The world around the applications under test: it notes their messages, and delivers those for one of them.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    sync::{Arc, Mutex},
    task::Waker,
    time::Duration,
};

use sinew_runtime::{
    clock::Clock,
    lock,
    mailbox::Mailbox,
    outcome::{Outcome, Receipt, Rejection, Ticket},
    pending::AppSink,
    router::{MessageSink, SubmitError},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Kind, Message},
};

use crate::{TimedMessage, misfit::Misfits};

/// Maximum number of requests and confirmed messages that wait for an answer from outside. Beyond it the
/// oldest ends as `Unknown`.
const OPEN_MAX: usize = 65_536;

/// The applications under test, and all messages between them and others.
pub(crate) struct World {
    clock: Clock,
    latency: Duration,
    /// The type by which the applications record their turns.
    turns: Option<Kind>,
    misfits: Arc<Misfits>,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// Whether the replay has ended: nothing is noted or delivered any more.
    is_over: bool,
    outputs: Vec<TimedMessage>,
    /// Messages of each source that a check expects and that were not sent yet.
    expected: BTreeMap<Tid, usize>,
    apps: BTreeMap<Tid, Arc<AppSink<Mailbox>>>,
    groups: BTreeMap<AppAddress, BTreeSet<Tid>>,
    open: VecDeque<Open>,
    /// Messages between applications under test that have not arrived.
    in_flight: BTreeMap<(Time, u64), (Tid, Message)>,
    /// The number of messages that were put there.
    departed: u64,
}

/// A message to an application that is not under test, and that waits for its outcome or its reply.
struct Open {
    receipt: Receipt,
    until: Time,
    is_request: bool,
}

impl World {
    pub(crate) fn new(clock: Clock, latency: Duration, turns: Option<Kind>) -> Self {
        Self { clock, latency, turns, misfits: Arc::default(), state: Mutex::default() }
    }

    /// Returns the inputs that the applications could not decode.
    pub(crate) const fn misfits(&self) -> &Arc<Misfits> {
        &self.misfits
    }

    pub(crate) fn clock(&self) -> &Clock {
        &self.clock
    }

    /// Adds an application under test. Returns `false` if another one has its address.
    pub(crate) fn add(&self, tid: Tid, sink: Arc<AppSink<Mailbox>>) -> bool {
        lock(&self.state).apps.insert(tid, sink).is_none()
    }

    pub(crate) fn set_member(&self, app: Tid, group: AppAddress, member: bool) {
        let mut state = lock(&self.state);
        let members = state.groups.entry(group).or_default();
        if member {
            members.insert(app);
        } else {
            members.remove(&app);
        }
    }

    /// Sets how many messages a check expects of each source.
    pub(crate) fn expect(&self, messages: BTreeMap<Tid, usize>) {
        lock(&self.state).expected = messages;
    }

    /// Returns whether a source has sent fewer messages than a check expects.
    pub(crate) fn lacks_messages(&self) -> bool {
        lock(&self.state).expected.values().any(|rest| *rest > 0)
    }

    /// Returns the outputs so far, and forgets them.
    pub(crate) fn take_outputs(&self) -> Vec<TimedMessage> {
        std::mem::take(&mut lock(&self.state).outputs)
    }

    /// Ends the replay.
    pub(crate) fn end(&self) {
        lock(&self.state).is_over = true;
    }

    /// Returns when the next message between applications under test arrives.
    pub(crate) fn next_arrival(&self) -> Option<Time> {
        lock(&self.state).in_flight.first_key_value().map(|((at, _), _)| *at)
    }

    /// Delivers the next message between applications under test that has arrived by now. Returns `false`
    /// without one.
    pub(crate) fn deliver_next(&self) -> bool {
        let (sink, message) = {
            let mut state = lock(&self.state);
            let Some(first) = state.in_flight.first_entry() else { return false };
            if first.key().0 > self.clock.now() {
                return false;
            }
            let (to, message) = first.remove();
            (state.apps.get(&to).cloned(), message)
        };
        // The receipt reports a refusal to the sender.
        if let Some(Err(refused)) = sink.map(|sink| sink.submit(message)) {
            refused.message.reject(refused.why);
        }
        true
    }

    /// Delivers an input. Messages from an application under test are ignored, as the replay makes them itself: except
    /// the records of its turns, which it gets back.
    pub(crate) fn deliver(&self, input: TimedMessage) {
        let own = lock(&self.state).apps.get(&input.source).cloned();
        if let Some(own) = own {
            if self.turns == Some(input.kind) {
                // A full mailbox refuses it, as it does other messages.
                let _ = own.submit(input.into_message());
            }
            return;
        }
        let is_answer = input.is_answer();
        let mut message = input.into_message();
        if is_answer && !self.answer(&mut message) {
            return;
        }
        let receivers = lock(&self.state).receivers(message.header.destination, message.header.source);
        for sink in receivers {
            // A full mailbox refuses a message in a replay as it does in a node.
            let _ = sink.submit(Message::new(message.header, message.payload.clone()));
        }
    }

    /// Settles the message that this answers. Returns whether the answer must be delivered too: it is a reply.
    fn answer(&self, answer: &mut Message) -> bool {
        let is_reply = answer.header.flags.has(Flags::REPLY);
        let open = lock(&self.state).take_open(answer, is_reply);
        let Some(open) = open else { return is_reply };
        answer.header.correlation = open.receipt.ticket().correlation;
        let outcome = answer.payload.first().and_then(|code| Outcome::from_code(*code));
        // The wait of a request ends with its reply, not with the outcome.
        open.receipt.settle(if is_reply { Outcome::Delivered } else { outcome.unwrap_or(Outcome::Unknown) });
        is_reply
    }

    /// Hands a message over to an application under test, now or after the latency.
    fn hand_over(&self, to: Tid, sink: &AppSink<Mailbox>, message: Message) -> Result<(), SubmitError> {
        if self.latency.is_zero() {
            return sink.submit(message);
        }
        let mut state = lock(&self.state);
        state.departed += 1;
        let key = (self.clock.now() + self.latency, state.departed);
        state.in_flight.insert(key, (to, message));
        Ok(())
    }
}

impl MessageSink for World {
    /// Accepts a message of an application under test.
    fn submit(&self, mut message: Message) -> Result<(), SubmitError> {
        let (header, now) = (message.header, self.clock.now());
        if is_removal(&message) {
            // As in a node, the removal of a retained value reaches no member and no recording. spec: FRAME-8.3
            message.settle(Outcome::Delivered);
            return Ok(());
        }
        let destination = header.destination;
        let (receivers, late) = {
            let mut state = lock(&self.state);
            if state.is_over {
                return Ok(());
            }
            state.note(TimedMessage::new(now, &header, message.payload.clone()), self.turns);
            let receivers = state.named_receivers(destination, header.source);
            // The receipt of a message to one application under test travels with it.
            let stays = receivers.is_empty() || !destination.is_single();
            let late = message.receipt.take_if(|_| stays).map(|receipt| {
                let is_request = header.flags.has(Flags::ASK);
                state.keep(Open { receipt, until: header.expiry(), is_request }, now)
            });
            (receivers, late)
        };
        // Settled without the lock.
        late.into_iter().flatten().for_each(|open| open.receipt.settle(Outcome::Unknown));
        let mut receivers = receivers.into_iter();
        match receivers.next() {
            Some((to, sink)) if destination.is_single() => return self.hand_over(to, &sink, message),
            Some((to, sink)) => {
                for (to, sink) in std::iter::once((to, sink)).chain(receivers) {
                    // A group has more members: one that is full does not fail the send.
                    let _ = self.hand_over(to, &sink, Message::new(header, message.payload.clone()));
                }
            }
            None => {}
        }
        Ok(())
    }

    /// Notes a message that waits for room when it is accepted, not at each attempt. After a latency none waits: its
    /// refusal comes too late for its sender.
    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), SubmitError> {
        let sink = if self.latency.is_zero() && !is_removal(&message) {
            lock(&self.state).receiver(message.header.destination)
        } else {
            None
        };
        let Some(sink) = sink else { return self.submit(message) };
        let output = TimedMessage::new(self.clock.now(), &message.header, message.payload.clone());
        let offered = sink.offer(message, room);
        if offered.as_ref().err().is_none_or(|refused| refused.why != Rejection::QueueFull) {
            lock(&self.state).note(output, self.turns);
        }
        offered
    }

    fn cancel(&self, ticket: Ticket) -> bool {
        let sink = lock(&self.state).apps.get(&ticket.destination).cloned();
        sink.is_some_and(|sink| sink.cancel(ticket))
    }
}

/// Returns whether the message removes a retained value.
fn is_removal(message: &Message) -> bool {
    message.header.flags.has(Flags::KEEP) && message.payload.is_empty()
}

impl State {
    /// Notes a message of an application under test, and that a check need not expect it any more.
    fn note(&mut self, output: TimedMessage, turns: Option<Kind>) {
        let is_expected = turns.is_none_or(|kind| kind == output.kind);
        if let Some(rest) = self.expected.get_mut(&output.source).filter(|_| is_expected) {
            *rest = rest.saturating_sub(1);
        }
        self.outputs.push(output);
    }

    /// Returns the one application under test that a message reaches; `None` after the end of the replay.
    fn receiver(&self, to: Tid) -> Option<Arc<AppSink<Mailbox>>> {
        if self.is_over { None } else { self.apps.get(&to).cloned() }
    }

    /// Returns the applications under test that a message reaches, without its sender.
    fn named_receivers(&self, to: Tid, from: Tid) -> Vec<(Tid, Arc<AppSink<Mailbox>>)> {
        let named = |tid: &Tid| Some((*tid, self.apps.get(tid)?.clone()));
        if to.is_single() {
            return named(&to).into_iter().collect();
        }
        let is_on = |tid: &&Tid| **tid != from && (to.node == NodeAddress::ALL || to.node == tid.node);
        if to.app.is_group() {
            let members = self.groups.get(&to.app).into_iter().flatten();
            return members.filter(is_on).filter_map(named).collect();
        }
        let is_meant = |tid: &&Tid| to.app == AppAddress::ALL || to.app == tid.app;
        self.apps.keys().filter(is_on).filter(is_meant).filter_map(named).collect()
    }

    fn receivers(&self, to: Tid, from: Tid) -> Vec<Arc<AppSink<Mailbox>>> {
        self.named_receivers(to, from).into_iter().map(|(_, sink)| sink).collect()
    }

    /// Keeps a message that waits for its answer. Returns those that wait no more, to be settled as unknown.
    fn keep(&mut self, open: Open, now: Time) -> Vec<Open> {
        let mut late = Vec::new();
        if self.open.iter().any(|open| open.until < now) {
            let (over, kept) = self.open.drain(..).partition::<VecDeque<_>, _>(|open| open.until < now);
            (late, self.open) = (over.into(), kept);
        }
        if self.open.len() >= OPEN_MAX {
            late.extend(self.open.pop_front());
        }
        self.open.push_back(open);
        late
    }

    /// Takes the message that this answers: the one of its number, else the oldest one between these two.
    fn take_open(&mut self, answer: &Message, is_reply: bool) -> Option<Open> {
        let (from, to) = (answer.header.source, answer.header.destination);
        let is_between = |open: &Open| {
            let ticket = open.receipt.ticket();
            ticket.source == to && ticket.destination == from && (open.is_request || !is_reply)
        };
        let is_it = |open: &Open| open.receipt.ticket().correlation == answer.header.correlation;
        let exact = self.open.iter().position(|open| is_between(open) && is_it(open));
        let at = exact.or_else(|| self.open.iter().position(is_between))?;
        self.open.remove(at)
    }
}
