//! Reconnection: an endpoint without a connection registers again, within the calls of its user.
//!
//! There is no thread for it. [`receive`](Endpoint::receive) waits for the node's return as it waits for a
//! message. A send tries once, and waits at most 20 ms for a node that has just been asked. Without this
//! wait, an endpoint with rare calls would be too late for each step. Between two tries there is a pause,
//! from 10 ms doubling to 1 s.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::PathBuf,
    task::Poll,
    thread,
    time::Duration,
};

use sinew_protocol::payload::{self, Group, Register};
use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Flags, Kind, Message},
};

use super::{
    ApiError, Endpoint,
    direct::{Direct, Terms},
    endpoint::LNCL,
    link::{Ended, Link, LinkOptions, RegistrationHandshake, Writer, ring::CHECK_INTERVAL},
    node_link::NodeLink,
    reactor::Until,
    requests::Requests,
    wait_mode::WaitMode,
};

/// First and longest pause between two tries.
const PAUSE: (Duration, Duration) = (Duration::from_millis(10), Duration::from_secs(1));

/// Time limit for the node's answer within the call that asked it. Later calls check without waiting.
pub(super) const ANSWER_TIMEOUT: Duration = Duration::from_millis(20);

/// Interval at which a registration on another thread checks whether it is still wanted.
pub(super) const WANTED_CHECK: Duration = Duration::from_millis(100);

/// Maximum number of group re-joins that request a confirmation after a reconnection. The node stops reading
/// from a client that does not read its replies, and a reconnecting client sends all joins before it reads
/// any reply. This many, sent last, fit into the smallest ring even if the node reads none of them. spec:
/// LNCL-16
const CONFIRMED_MAX: usize = 32;

/// Whether an endpoint registers again when its connection has ended through no fault of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ReconnectPolicy {
    Always,
    Never,
}

/// The data that an endpoint needs to register again, and its progress.
pub(super) struct Reconnect {
    path: PathBuf,
    pub(super) register: Register,
    pub(super) options: LinkOptions,
    policy: ReconnectPolicy,
    /// The groups that it is a member of.
    pub(super) groups: BTreeSet<AppAddress>,
    /// The re-joined groups with pending answers, by request number.
    pub(super) rejoining: BTreeMap<u64, AppAddress>,
    /// How often it has registered.
    pub(super) registrations: u64,
    attempt: Option<ReconnectAttempt>,
}

/// A reconnection in progress.
struct ReconnectAttempt {
    pause: Duration,
    /// When the next try is due.
    next: Time,
    /// The try that the node has not answered yet.
    handshake: Option<RegistrationHandshake>,
    /// Whether `receive` has notified the caller.
    is_reported: bool,
}

impl ReconnectAttempt {
    const fn new() -> Self {
        Self { pause: PAUSE.0, next: Time::ZERO, handshake: None, is_reported: false }
    }
}

impl Reconnect {
    pub(super) const fn new(
        path: PathBuf,
        register: Register,
        options: LinkOptions,
        policy: ReconnectPolicy,
    ) -> Self {
        Self {
            path,
            register,
            options,
            policy,
            groups: BTreeSet::new(),
            rejoining: BTreeMap::new(),
            registrations: 1,
            attempt: None,
        }
    }

    /// Returns the reconnection, which starts with the first call.
    fn attempt(&mut self) -> &mut ReconnectAttempt {
        self.attempt.get_or_insert_with(ReconnectAttempt::new)
    }

    /// Tries to register. Returns `None` if it has not succeeded by the deadline, or if the next try is not
    /// due. A new try waits for its answer for `answer_timeout` at least.
    fn try_register(&mut self, until: Time, answer_timeout: Duration) -> Option<Link> {
        let attempt = self.attempt.get_or_insert_with(ReconnectAttempt::new);
        if attempt.handshake.is_none() && Time::now() < attempt.next {
            return None;
        }
        let (answer, until) = match attempt.handshake.take() {
            Some(handshake) => (Ok(handshake), until),
            None => {
                let until = until.max(Time::now() + answer_timeout);
                let options = self.options.clone();
                (RegistrationHandshake::begin(&self.path, &self.register, options, until), until)
            }
        };
        let answer = answer.and_then(|mut handshake| match handshake.wait(until)? {
            None => {
                attempt.handshake = Some(handshake);
                Ok(None)
            }
            link => Ok(link),
        });
        answer.unwrap_or_else(|why| {
            sinew_runtime::log::here!(debug: %why, "not registered again yet");
            attempt.next = Time::now() + attempt.pause;
            attempt.pause = (attempt.pause * 2).min(PAUSE.1);
            None
        })
    }

    /// Returns the same settings for a new reconnection.
    pub(super) fn another(&self) -> Self {
        Self::new(self.path.clone(), self.register.clone(), self.options.clone(), self.policy)
    }

    /// Whether the endpoint registers again after this end of its connection.
    const fn applies(&self, ended: &Ended) -> bool {
        ended.again && matches!(self.policy, ReconnectPolicy::Always)
    }

    /// Returns the error of a call that finds the connection ended.
    pub(super) fn end_error(&self, ended: &Ended) -> ApiError {
        if self.applies(ended) {
            ApiError::Disconnected(ended.why.clone())
        } else {
            ApiError::Closed(ended.why.clone())
        }
    }

    /// Reports the end to the caller: once if the endpoint reconnects, always if it does not.
    pub(super) fn report_end(&mut self, ended: &Ended) -> Result<(), ApiError> {
        if self.applies(ended) && std::mem::replace(&mut self.attempt().is_reported, true) {
            return Ok(());
        }
        Err(self.end_error(ended))
    }

    /// Re-joins the groups: the last [`CONFIRMED_MAX`] of them with a confirmation.
    fn rejoin_groups(&mut self, own: Tid, writer: &Writer, requests: &mut Requests) -> Result<(), ApiError> {
        self.rejoining.clear();
        let unconfirmed = self.groups.len().saturating_sub(CONFIRMED_MAX);
        for (index, group) in self.groups.iter().enumerate() {
            let membership = Group { group: *group, member: true };
            let mut message: Message = payload::frame(Kind::LNCL_GROUP, own, LNCL, &membership);
            if index >= unconfirmed {
                requests.correlation += 1;
                (message.header.flags, message.header.correlation) = (Flags::CONFIRM, requests.correlation);
                self.rejoining.insert(requests.correlation, *group);
            }
            writer.write(&message)?;
        }
        Ok(())
    }

    /// Handles LNCL's answer to a re-join. Returns whether `message` is one. No call waits for the answer: a
    /// rejection is logged. The rejection may be temporary, so the next reconnection asks again.
    pub(super) fn on_rejoin_outcome(&mut self, message: &Message, own: Tid) -> bool {
        let Some(group) = self.rejoining.remove(&message.header.correlation) else { return false };
        let outcome = message.payload.first().and_then(|code| Outcome::from_code(*code));
        // An endpoint that has lost its address does not keep its connection for long: it reconnects once
        // more, and asks again.
        if let Some(Outcome::Rejected(why)) = outcome
            && why != Rejection::NoSuchApplication
        {
            let remedy = if why == Rejection::QueueFull {
                "its user, or the node, has as many memberships as it may: leave groups, then join this one again"
            } else {
                "the node's access list does not let it: name the group in its `[[client]]`, `sinew reload`, then join it again"
            };
            sinew_runtime::log::here!(warn: endpoint = %own, %group, remedy, "it came back to its node, and is not in this group any more");
        }
        true
    }
}

/// Tries until it is registered, or is not wanted any more, which is checked between two tries. Blocks.
pub(super) fn reconnect_blocking(mut reconnect: Reconnect, is_wanted: impl Fn() -> bool) -> Option<Link> {
    while is_wanted() {
        let until = Time::now() + WANTED_CHECK;
        if let Some(link) = reconnect.try_register(until, ANSWER_TIMEOUT) {
            return Some(link);
        }
        let attempt = reconnect.attempt();
        if attempt.handshake.is_none() {
            thread::sleep(attempt.next.min(until).since(Time::now()));
        }
    }
    None
}

impl Endpoint {
    /// Records the end of the connection to the node. The first reason is reported.
    pub(super) fn end(&mut self, ended: Ended) {
        if self.node.end(ended) {
            self.direct.on_node_end(Time::now());
        }
    }

    /// Returns an error unless there is a connection to the node.
    pub(super) fn ensure_connected(&self) -> Result<(), ApiError> {
        self.node.ended.as_ref().map_or(Ok(()), |ended| Err(self.reconnect.end_error(ended)))
    }

    /// Reconnects if that takes only a negligible wait.
    pub(super) fn try_reconnect(&mut self) {
        if let Some(ended) = &self.node.ended
            && self.reconnect.applies(ended)
            && let Some(link) = match &mut self.wait_mode {
                WaitMode::Blocking => self.reconnect.try_register(Time::now(), ANSWER_TIMEOUT),
                WaitMode::Async(reactor) => reactor.poll_reconnect(&self.reconnect),
                WaitMode::Polled(_) => self.reconnect.try_register(Time::now(), Duration::ZERO),
            }
        {
            self.continue_on(link);
        }
    }

    /// Reconnects, or waits until the next try, until a message arrives on a direct link, or until
    /// `deadline`.
    pub(super) async fn await_reconnect(&mut self, deadline: Time) {
        if let WaitMode::Async(reactor) = &mut self.wait_mode {
            if let Some(link) = reactor.await_reconnect(&self.reconnect, &mut self.direct, deadline).await {
                self.continue_on(link);
            }
            return;
        }
        let has_links = !self.direct.open.is_empty();
        let now = Time::now();
        let registered = match &self.wait_mode {
            WaitMode::Polled(_) => self.reconnect.try_register(now, Duration::ZERO),
            WaitMode::Blocking | WaitMode::Async(_) => {
                self.reconnect.try_register(if has_links { now } else { deadline }, ANSWER_TIMEOUT)
            }
        };
        if let Some(link) = registered {
            return self.continue_on(link);
        }
        let attempt = self.reconnect.attempt();
        let due = if attempt.handshake.is_some() { now + PAUSE.0 } else { attempt.next };
        let until = due.min(deadline);
        if let WaitMode::Polled(events) = &self.wait_mode {
            if has_links {
                let deadline = self.direct.wake_by(until.min(now + CHECK_INTERVAL), now, None);
                events.wait_for_links(&mut self.direct, Until { deadline, room: None }).await;
            } else {
                events.until_polled(until, |_| Poll::Pending).await;
            }
        } else if has_links {
            self.direct.wait(until.since(Time::now()));
        } else {
            thread::sleep(until.since(Time::now()));
        }
    }

    /// Continues with a new connection, as a member of the same groups.
    fn continue_on(&mut self, link: Link) {
        let Link { registered, writer, reader } = link;
        let control = reader.control().filter(|_| self.reconnect.options.direct_links.accepts());
        let own = Tid::new(registered.node, registered.app);
        let terms = Terms::of(&registered, &self.reconnect.options, &writer);
        if own == self.tid {
            self.direct.on_reconnect(terms, control);
        } else {
            // A new address has no links. Messages that have arrived on them are received.
            self.drain_links();
            self.direct.end_all();
            self.count_unsent(Time::now());
            self.direct = Direct::new(terms, control);
        }
        self.tid = own;
        self.reconnect.register.former = Some(registered.app);
        self.payload_max = registered.payload_max as usize;
        self.node_name = registered.node_name;
        self.inbox.set_sink(own, writer.clone());
        (self.node, self.reconnect.attempt) = (NodeLink::new(writer, reader), None);
        self.reconnect.registrations += 1;
        let watched = match &mut self.wait_mode {
            WaitMode::Blocking => Ok(()),
            WaitMode::Async(reactor) => reactor.change(&self.node.reader, &self.node.writer),
            WaitMode::Polled(events) => events.watch_link(&self.node.reader, &self.node.writer),
        };
        if let Err(why) = watched {
            return self.abandon_reconnect(why.to_string());
        }
        if let Err(why) = self.reconnect.rejoin_groups(own, &self.node.writer, &mut self.requests) {
            self.abandon_reconnect(why.to_string());
        }
    }

    /// Abandons an incomplete reconnection. Messages that have arrived meanwhile are not taken: for the node,
    /// a client that disconnects has not handled them.
    fn abandon_reconnect(&mut self, why: String) {
        self.node.writer.close();
        self.node.reader.stop_reading();
        self.end(Ended { why, again: true });
    }
}
