//! Outgoing messages that wait for an answer.

use std::time::Duration;

use sinew_runtime::{
    outcome::{MemberOutcome, MemberTable, Outcome, Rejection},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Class, Flags, Header, Message},
};

use super::{
    ApiError, Endpoint, Received,
    direct::{PEER_END_TIMEOUT, Resolution},
    dispatch::ROOM_PAUSE,
    inbox::{Answer, Awaited},
    incoming::{Wanted, WhenFull},
    loan::{Draft, LoanedMessage},
    reconnect::ANSWER_TIMEOUT,
    routes::LinkNumber,
    stall_timeout::Limit,
    wait_mode::WaitMode,
};

/// Number of polls for the final frames of a node after the end of its connection.
const FINAL_POLLS: usize = 64;

/// A call that waits for an answer. If it is dropped before the answer arrives, the endpoint forgets the
/// link.
struct RequestGuard<'endpoint>(&'endpoint mut Endpoint);

impl Drop for RequestGuard<'_> {
    fn drop(&mut self) {
        self.0.direct.set_in_flight(None);
    }
}

impl Endpoint {
    /// Sends `message` and waits for its outcome, at most for the message's time to live.
    pub(super) async fn confirm(
        &mut self,
        mut message: Draft,
        limit: Limit,
        within: Duration,
    ) -> Result<Outcome, ApiError> {
        if message.header.class == Class::Stream {
            // For a Stream the newest value supersedes the others, so an older one has no outcome of its own.
            return Ok(Outcome::Rejected(Rejection::Unsupported));
        }
        if is_many(message.header.destination) {
            return Err(ApiError::ToMany(message.header.destination));
        }
        let within = message.header.limit_time_to_live(within);
        let wait = (Awaited::Outcome, within);
        match self.request_within(message, wait, Flags::CONFIRM, limit).await? {
            Some(Answer::Outcome(outcome)) => Ok(outcome),
            Some(Answer::Members(_) | Answer::Reply(_) | Answer::Resolved(..)) | None => Ok(Outcome::Unknown),
        }
    }

    /// Sends `message` to many and waits for the outcome of each, at most for the message's time to live.
    pub(super) async fn confirm_by_each(
        &mut self,
        mut message: Draft,
        limit: Limit,
        within: Duration,
    ) -> Result<Vec<MemberOutcome>, ApiError> {
        let tid = self.absolute(message.header.destination);
        if !is_many(tid) {
            let outcome = self.confirm(message, limit, within).await?;
            return Ok(vec![MemberOutcome { tid, outcome }]);
        }
        if message.header.class == Class::Stream {
            return Err(ApiError::Ended(Outcome::Rejected(Rejection::Unsupported)));
        }
        let within = message.header.limit_time_to_live(within);
        let asked = self.put(message, (Awaited::Members, within), Flags::CONFIRM, limit).await?;
        let table = MemberTable::new(tid, self.tid.node);
        RequestGuard(self).0.await_members(table, asked).await
    }

    /// Collects reports until no outcome is missing. Outcomes that are missing when the message has ended, or
    /// at the deadline, are set from that end.
    async fn await_members(
        &mut self,
        mut table: MemberTable,
        mut asked: SentRequest,
    ) -> Result<Vec<MemberOutcome>, ApiError> {
        loop {
            match self.await_answer(asked).await? {
                Some(Answer::Members(reports)) => table.note(&reports),
                // Reports may follow it if the queue of this endpoint was full.
                Some(Answer::Outcome(Outcome::Delivered)) => {}
                // No member has a copy.
                Some(Answer::Outcome(why @ Outcome::Rejected(_))) => return Err(ApiError::Ended(why)),
                Some(Answer::Outcome(last)) => return Ok(table.finish(Some(last))),
                Some(Answer::Reply(_) | Answer::Resolved(..)) | None => return Ok(table.finish(None)),
            }
            asked.now = Time::now();
            if table.is_complete() || asked.now >= asked.deadline {
                return Ok(table.finish(None));
            }
        }
    }

    /// Sends `message` as a request and waits for the reply, at most for the message's time to live.
    pub(super) async fn await_reply(
        &mut self,
        mut message: Draft,
        limit: Limit,
        within: Duration,
    ) -> Result<Message, ApiError> {
        message.header.class = Class::Control;
        let within = message.header.limit_time_to_live(within);
        let wait = (Awaited::Reply, within);
        match self.request_within(message, wait, Flags::CONFIRM.with(Flags::ASK), limit).await? {
            Some(Answer::Reply(reply)) => Ok(reply),
            Some(Answer::Outcome(outcome)) => Err(ApiError::Ended(outcome)),
            Some(Answer::Members(_) | Answer::Resolved(..)) | None => Err(ApiError::NoReply(within)),
        }
    }

    /// Sends `message` as the reply to `request`.
    pub(super) async fn answer(
        &mut self,
        request: Request,
        mut message: Draft,
        limit: Limit,
    ) -> Result<(), ApiError> {
        message.header.destination = request.source;
        message.header.class = Class::Control;
        message.header.flags = Flags::REPLY;
        message.header.correlation = request.correlation;
        self.dispatch(message, limit).await.map(drop)
    }

    /// Sends `message` and waits for its answer, or returns `None` at the deadline.
    pub(super) async fn request(
        &mut self,
        message: Draft,
        awaited: Awaited,
        flags: Flags,
        within: Duration,
    ) -> Result<Option<Answer>, ApiError> {
        self.request_within(message, (awaited, within), flags, self.stall_timeout()).await
    }

    /// The same, and waits for room as long as `limit` and the wait for the answer allow.
    async fn request_within(
        &mut self,
        message: Draft,
        wait: (Awaited, Duration),
        flags: Flags,
        limit: Limit,
    ) -> Result<Option<Answer>, ApiError> {
        let asked = self.put(message, wait, flags, limit).await?;
        RequestGuard(self).0.await_answer(asked).await
    }

    /// Sends `message` and registers the wait for its answer.
    async fn put(
        &mut self,
        mut message: Draft,
        (awaited, within): (Awaited, Duration),
        flags: Flags,
        limit: Limit,
    ) -> Result<SentRequest, ApiError> {
        let number = self.requests.next_request();
        message.header.correlation = number;
        message.header.flags = message.header.flags.with(flags);
        let asked = message.header.destination;
        let now = Time::now();
        let deadline = now + within;
        // A caller does not wait longer for room than for the answer.
        let link = self.dispatch(message, limit.and_in_all(within)).await?;
        let wanted = Wanted { number, what: awaited, of: self.absolute(asked) };
        Ok(SentRequest { wanted, link, deadline, now })
    }

    /// Waits for the answer to the message that was sent on this path, or returns `None` at the deadline.
    async fn await_answer(
        &mut self,
        SentRequest { wanted, link, mut deadline, mut now }: SentRequest,
    ) -> Result<Option<Answer>, ApiError> {
        // The link has ended; without a report by the deadline the outcome is unknown.
        let mut has_ended = false;
        loop {
            if let Some(answer) = self.poll_incoming(Some(wanted), WhenFull::Refuse, now)? {
                return Ok(Some(answer));
            }
            match link.map_or(Resolution::Open, |link| self.direct.resolution(link)) {
                Resolution::Open => {}
                Resolution::Known(outcome) => return Ok(Some(Answer::Outcome(outcome))),
                Resolution::Unknown if self.node.ended.is_some() || (has_ended && now >= deadline) => {
                    return Ok(Some(Answer::Outcome(Outcome::Unknown)));
                }
                Resolution::Unknown if !has_ended => {
                    (has_ended, deadline) = (true, deadline.min(now + PEER_END_TIMEOUT));
                }
                Resolution::Unknown => {}
            }
            if link.is_none() && self.node.ended.is_some() {
                // No report can arrive any more.
                return Ok(Some(Answer::Outcome(Outcome::Unknown)));
            }
            // Checked here, because a flood keeps the link readable forever.
            if now >= deadline {
                return Ok(None);
            }
            self.wait(deadline, now).await;
            now = Time::now();
        }
    }

    /// Lends memory for a payload of `length` bytes: if possible, in the ring of the current path to
    /// `destination`.
    pub(super) fn lend(&mut self, header: Header, length: usize) -> Result<LoanedMessage, ApiError> {
        if self.leaves.has_pending() {
            self.send_leaves();
        }
        let loan = self.lender.lend()?;
        let destination = self.absolute(header.destination);
        // A link is requested now if one is wanted: while the ring to the node is lent, it cannot carry the
        // request.
        let link = self.direct.link_to(destination).or_else(|| self.route(destination, Time::now()));
        let room = match link {
            Some(link) => self.direct.lend(link, length),
            None => self.node.writer.lend(length),
        };
        Ok(LoanedMessage::new(loan, header, room, length))
    }

    /// Returns the default wait of a send.
    pub(super) const fn stall_timeout(&self) -> Limit {
        Limit::stall_timeout(self.reconnect.options.stall_timeout)
    }

    /// Reconnects first, if `limit` leaves the time for it.
    pub(super) fn prepare_send(&mut self, limit: Limit) -> Result<(), ApiError> {
        self.lender.check_free()?;
        let leaves_time = match self.wait_mode {
            // The registration takes that long.
            WaitMode::Blocking | WaitMode::Polled(_) => limit.leaves(ANSWER_TIMEOUT),
            // The registration runs concurrently.
            WaitMode::Async(_) => !limit.is_in_all(),
        };
        if leaves_time {
            self.try_reconnect();
        }
        Ok(())
    }

    /// Gives peers that read up to `within` to read the waiting messages, before this endpoint closes.
    /// Messages that arrive meanwhile are refused.
    pub(super) async fn flush_before_close(&mut self, within: Duration) {
        let deadline = Time::now() + within;
        self.direct.flush();
        while self.direct.has_pending() && Time::now() < deadline {
            match self.wait_mode {
                WaitMode::Blocking => self.direct.await_pending(ROOM_PAUSE),
                WaitMode::Async(_) | WaitMode::Polled(_) => {
                    self.wait(deadline.min(Time::now() + ROOM_PAUSE), Time::now()).await;
                }
            }
            // A peer that waits for room itself reads nothing until it has room.
            let _ = self.poll_incoming(None, WhenFull::Refuse, Time::now());
            self.inbox.close();
            self.direct.flush();
        }
    }

    pub(super) const fn absolute(&self, destination: Tid) -> Tid {
        if matches!(destination.node, NodeAddress::HERE) {
            Tid::new(self.tid.node, destination.app)
        } else {
            destination
        }
    }

    /// Replaces the error by the node's reason for closing the connection, which is more specific than a
    /// broken pipe.
    pub(super) fn explain(&mut self, error: ApiError) -> ApiError {
        if !matches!(error, ApiError::Closed(_)) {
            return error;
        }
        for _ in 0..FINAL_POLLS {
            // The error to report is the first one.
            if self.node.ended.is_some() || self.poll_incoming(None, WhenFull::Refuse, Time::now()).is_err() {
                break;
            }
        }
        self.node.ended.as_ref().map_or(error, |ended| self.reconnect.end_error(ended))
    }

    pub(super) fn check_length(&self, length: usize) -> Result<(), ApiError> {
        if length > self.payload_max {
            return Err(ApiError::TooLong { length, limit: self.payload_max });
        }
        Ok(())
    }
}

/// A sent message that waits for its answer.
#[derive(Clone, Copy)]
struct SentRequest {
    wanted: Wanted,
    /// The direct link on which it was sent.
    link: Option<LinkNumber>,
    deadline: Time,
    now: Time,
}

/// Returns whether a message to `destination` has an outcome for each of several members.
fn is_many(destination: Tid) -> bool {
    !destination.is_single() && destination.app != AppAddress::NONE
}

/// The sender of a request, and its correlation number.
#[derive(Clone, Copy)]
pub(super) struct Request {
    pub(super) source: Tid,
    correlation: u64,
}

impl Request {
    /// Returns the request of `received` to `own`. Its sender accepts the reply only from the requested
    /// address.
    pub(super) fn of(received: &Received, own: Tid) -> Result<Self, ApiError> {
        if !received.wants_reply() {
            return Err(ApiError::NotAsked);
        }
        if received.destination() != own {
            return Err(ApiError::OthersRequest(received.destination()));
        }
        Ok(Self { source: received.source(), correlation: received.correlation() })
    }
}
