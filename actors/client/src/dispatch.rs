//! The path of an outgoing message: a direct link, or the node.

use std::{pin::pin, time::Duration};

use sinew_protocol::observed::Observed;
use sinew_runtime::{
    tid::Tid,
    time::Time,
    wire::{Flags, HEADER_LEN},
};

use super::{
    ApiError, Endpoint,
    builder::{Content, SendTerms},
    direct::{InFlightRequest, NodeWriter, Room, Sent, Writing},
    incoming::WhenFull,
    link::ring::CHECK_INTERVAL,
    loan::Draft,
    routes::LinkNumber,
    stall_timeout::{Limit, Waiting},
    wait_mode::{WaitMode, block_ready},
};

/// First pause of a thread between two polls of incoming messages while a direct link has no room; doubled up
/// to `CHECK_INTERVAL`. Room ends the pause.
pub(super) const ROOM_PAUSE: Duration = Duration::from_millis(1);

/// How far a message has come without a wait.
pub(super) enum Dispatch {
    /// It was sent on this link.
    Sent(LinkNumber),
    /// It takes this link, and is not or not completely written.
    OnLink(Box<BegunSend>),
    /// It takes the path through the node.
    ThroughNode { draft: Draft, destination: Tid, now: Time },
}

/// A message that takes a direct link.
pub(super) struct BegunSend {
    destination: Tid,
    room: Room,
    sent: Sent,
    /// Whether an earlier sender has reached its stall timeout.
    was_stalled: bool,
    request: Option<InFlightRequest>,
    report: Option<Observed>,
}

impl Endpoint {
    /// Sends, and blocks if it must wait. Most messages do not, and need no future.
    pub(super) fn send_blocking(&mut self, content: impl Content, terms: SendTerms) -> Result<(), ApiError> {
        let limit = terms.limit(self);
        let mut draft = match content.at_once(self, limit) {
            Ok(draft) => draft?,
            Err(content) => return block_ready(pin!(self.send_as(content, terms))),
        };
        terms.apply(&mut draft.header);
        match self.begin_dispatch(draft, limit)? {
            Dispatch::Sent(_) => Ok(()),
            begun @ (Dispatch::OnLink(_) | Dispatch::ThroughNode { .. }) => {
                block_ready(pin!(self.continue_dispatch(begun, limit))).map(drop)
            }
        }
    }

    /// Sends `message` on the current path, and waits for room as long as `limit` allows. Returns the link,
    /// unless the message went through the node.
    pub(super) async fn dispatch(
        &mut self,
        draft: Draft,
        limit: Limit,
    ) -> Result<Option<LinkNumber>, ApiError> {
        match self.begin_dispatch(draft, limit)? {
            Dispatch::Sent(link) => Ok(Some(link)),
            begun @ (Dispatch::OnLink(_) | Dispatch::ThroughNode { .. }) => {
                self.continue_dispatch(begun, limit).await
            }
        }
    }

    /// Chooses the path of a message. On a direct link the message is sent if there is room at once, which is the
    /// usual case and needs no future.
    pub(super) fn begin_dispatch(&mut self, mut draft: Draft, limit: Limit) -> Result<Dispatch, ApiError> {
        self.prepare_send(limit)?;
        if self.leaves.has_pending() {
            self.send_leaves();
        }
        self.check_length(draft.payload.len())?;
        // A new connection may have another address.
        draft.header.source = self.tid;
        draft.header.sequence = self.requests.next_message();
        let now = Time::now();
        draft.header.sent = now;
        let destination = self.absolute(draft.header.destination);
        if !self.reconnect.rejoining.is_empty() {
            // The node continues to read once its answers about groups are read. An endpoint that only sends
            // reads them here, before the path is chosen.
            let _ = self.poll_node(None, WhenFull::Leave, now);
        }
        let Some(link) = self.route(destination, now) else {
            return Ok(Dispatch::ThroughNode { draft, destination, now });
        };
        draft.header.destination = destination;
        let is_awaited = draft.header.flags.has(Flags::CONFIRM);
        let request = if is_awaited { self.direct.begin_request(link) } else { None };
        let report = self.direct.report_of(&draft);
        if self.direct.send_at_once(link, &mut draft) {
            self.sent_on_link(request, report);
            return Ok(Dispatch::Sent(link));
        }
        let room = Room { link, length: HEADER_LEN + draft.payload.len(), class: draft.header.class };
        let was_stalled = self.direct.is_stalled(link);
        match self.direct.send(link, draft, now)? {
            Sent::Taken => {
                self.sent_on_link(request, report);
                Ok(Dispatch::Sent(link))
            }
            sent @ (Sent::Begun | Sent::Full(_) | Sent::Gone(_)) => {
                let begun = BegunSend { destination, room, sent, was_stalled, request, report };
                Ok(Dispatch::OnLink(Box::new(begun)))
            }
        }
    }

    fn sent_on_link(&mut self, request: Option<InFlightRequest>, report: Option<Observed>) {
        self.direct.report_sent(report, &self.node.writer);
        self.direct.set_in_flight(request);
    }

    /// Continues where [`begin_dispatch`](Self::begin_dispatch) has ended.
    pub(super) async fn continue_dispatch(
        &mut self,
        begun: Dispatch,
        limit: Limit,
    ) -> Result<Option<LinkNumber>, ApiError> {
        let (draft, destination, now) = match begun {
            Dispatch::Sent(link) => return Ok(Some(link)),
            Dispatch::ThroughNode { draft, destination, now } => (draft, destination, now),
            Dispatch::OnLink(begun) => {
                let BegunSend { destination, room, sent, was_stalled, request, report } = *begun;
                let Some(returned) = self.send_on(room, sent, was_stalled, limit).await? else {
                    self.sent_on_link(request, report);
                    return Ok(Some(room.link));
                };
                (returned, destination, Time::now())
            }
        };
        self.ensure_connected()?;
        if self.node.reader.has_ended(now) {
            return Err(self.explain(ApiError::Closed("the node has gone".to_owned())));
        }
        let written = self.node.write(draft, limit, &mut self.wait_mode).await;
        written.map_err(|error| self.explain(error))?;
        self.direct.sent_through_node(destination, now);
        Ok(None)
    }

    /// Returns the link for a message to `destination` now, or `None` for the path through the node.
    pub(super) fn route(&mut self, destination: Tid, now: Time) -> Option<LinkNumber> {
        let mut node = NodeWriter { writer: &self.node.writer, correlation: &mut self.requests.correlation };
        self.direct.check(now, &mut node);
        if self.direct.must_poll_node(now) {
            // An endpoint that only sends reads here what the node says about links. A read failure is reported
            // when it receives.
            let _ = self.poll_node(None, WhenFull::Leave, now);
        }
        let mut node = NodeWriter { writer: &self.node.writer, correlation: &mut self.requests.correlation };
        self.direct.route(destination, now, &mut node)
    }

    /// Continues to send on a direct link, and returns the message if the peer has gone. While there is no room, this
    /// endpoint reads its incoming messages: two endpoints that wait for room in each other's rings would
    /// otherwise deadlock.
    ///
    /// # Errors
    /// [`ApiError::Stalled`]: the peer receives nothing of it. The written part of a long message is
    /// withdrawn.
    async fn send_on(
        &mut self,
        room: Room,
        mut sent: Sent,
        was_stalled: bool,
        limit: Limit,
    ) -> Result<Option<Draft>, ApiError> {
        let link = room.link;
        // A peer that does not read costs one stall timeout, not one per message.
        let mut waiting = if was_stalled { Waiting::after_stall(limit) } else { Waiting::new(limit) };
        let (mut has_begun, mut pause) = (false, ROOM_PAUSE);
        loop {
            // `None`: the message is partly written.
            let left = match sent {
                Sent::Taken => return Ok(None),
                Sent::Gone(returned) => return Ok(Some(returned)),
                Sent::Full(returned) => Some(returned),
                Sent::Begun => {
                    if was_stalled && !has_begun && !limit.is_in_all() {
                        // The peer reads again.
                        waiting = Waiting::new(limit);
                    }
                    has_begun = true;
                    None
                }
            };
            let now = Time::now();
            let Some(until) = waiting.until(self.direct.taken(link), now) else {
                if waiting.has_stalled(now) {
                    self.direct.mark_stalled(link);
                }
                if left.is_none() {
                    self.direct.withdraw(link);
                }
                return Err(waiting.error());
            };
            self.poll_while_writing(link, now);
            match self.wait_mode {
                WaitMode::Blocking => self.direct.await_room(room, pause.min(until.since(now))),
                // Woken for room and for incoming messages.
                WaitMode::Async(_) | WaitMode::Polled(_) => self.wait_for_room(room, until, now).await,
            }
            pause = (pause * 2).min(CHECK_INTERVAL);
            sent = match left {
                Some(draft) => self.direct.send(link, draft, now)?,
                None => match self.direct.write_on(link) {
                    Writing::Whole => Sent::Taken,
                    Writing::Part => Sent::Begun,
                    Writing::Cut(returned) => Sent::Gone(returned),
                },
            };
        }
    }

    fn poll_while_writing(&mut self, link: LinkNumber, now: Time) {
        self.direct.is_writing_on(Some(link));
        // A read failure is reported when the endpoint receives.
        let _ = self.poll_incoming(None, WhenFull::Leave, now);
        self.direct.is_writing_on(None);
    }
}
