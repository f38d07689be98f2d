//! Messages on their way out: the way that is right now, and what is waited for then.

use std::time::Duration;

use sinew_runtime::{
    outcome::{MemberOutcome, MemberTable, Outcome, Rejection},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Class, Flags, HEADER_LEN, Header, Message},
};

use super::{
    ApiError, Endpoint, Received,
    direct::{Fate, GONE_WITHIN, Room, Sent, ToNode, Writing},
    form::Form,
    inbox::{Answer, Awaited},
    incoming::{Wanted, WhenFull},
    link::ring::NAP,
    loan::{Draft, LoanedMessage},
    returning::ANSWERED_WITHIN,
    routes::LinkNumber,
    stall_timeout::{Limit, Waiting},
};

/// Looks for the last words of a node that has gone.
const LAST_LOOKS: usize = 64;
/// First pause of a thread between two looks at what others send while a direct link has no room; doubled up to a nap. Room ends it.
const ROOM_PAUSE: Duration = Duration::from_millis(1);

/// Whoever waits for an answer; also one that is dropped before it comes keeps no link.
struct Asking<'endpoint>(&'endpoint mut Endpoint);

impl Drop for Asking<'_> {
    fn drop(&mut self) {
        self.0.direct.awaits(None);
    }
}

impl Endpoint {
    /// Sends `message` and waits for its outcome, no longer than a message can live.
    pub(super) async fn confirm(
        &mut self,
        mut message: Draft,
        limit: Limit,
        within: Duration,
    ) -> Result<Outcome, ApiError> {
        if message.header.class == Class::Stream {
            // Of a Stream the newest wins, so an older one has no outcome of its own.
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

    /// Sends `message` to many and waits for the outcome of each, no longer than a message can live.
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
        Asking(self).0.await_members(table, asked).await
    }

    /// Collects reports until no outcome is missing; what is missing when the message has ended, or at the deadline, ends as that says.
    async fn await_members(
        &mut self,
        mut table: MemberTable,
        mut asked: Asked,
    ) -> Result<Vec<MemberOutcome>, ApiError> {
        loop {
            match self.await_answer(asked).await? {
                Some(Answer::Members(reports)) => table.note(&reports),
                // Reports may be behind it, where the queue of this endpoint was full.
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

    /// Sends `message` as a request and waits for the reply, no longer than a message can live.
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

    /// Sends `message` and waits for its answer; `None` at the deadline.
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
        Asking(self).0.await_answer(asked).await
    }

    /// Sends `message` and registers the wait for its answer.
    async fn put(
        &mut self,
        mut message: Draft,
        (awaited, within): (Awaited, Duration),
        flags: Flags,
        limit: Limit,
    ) -> Result<Asked, ApiError> {
        self.correlation += 1;
        self.asked = self.correlation;
        message.header.correlation = self.correlation;
        message.header.flags = message.header.flags.with(flags);
        let (number, asked) = (self.correlation, message.header.destination);
        let now = Time::now();
        let deadline = now + within;
        // Who waits so long for the answer waits no longer for room.
        let way = self.dispatch(message, limit.and_in_all(within)).await?;
        let wanted = Wanted { number, what: awaited, of: self.absolute(asked) };
        Ok(Asked { wanted, way, deadline, now })
    }

    /// Waits for the answer to what went this `way`; `None` at the deadline.
    async fn await_answer(
        &mut self,
        Asked { wanted, way, mut deadline, mut now }: Asked,
    ) -> Result<Option<Answer>, ApiError> {
        // The link has ended, and what is not said by the deadline nobody knows.
        let mut has_ended = false;
        loop {
            if let Some(answer) = self.take_in(Some(wanted), WhenFull::Refuse, now)? {
                return Ok(Some(answer));
            }
            match way.map_or(Fate::Open, |link| self.direct.fate(link)) {
                Fate::Open => {}
                Fate::Known(outcome) => return Ok(Some(Answer::Outcome(outcome))),
                Fate::Unsaid if self.ended.is_some() || (has_ended && now >= deadline) => {
                    return Ok(Some(Answer::Outcome(Outcome::Unknown)));
                }
                Fate::Unsaid if !has_ended => {
                    (has_ended, deadline) = (true, deadline.min(now + GONE_WITHIN));
                }
                Fate::Unsaid => {}
            }
            if way.is_none() && self.ended.is_some() {
                // Nobody can say any more.
                return Ok(Some(Answer::Outcome(Outcome::Unknown)));
            }
            // The clock is asked by us: a flood keeps the link readable for ever.
            if now >= deadline {
                return Ok(None);
            }
            self.wait(deadline, now).await;
            now = Time::now();
        }
    }

    /// Lends memory for a payload of `length` bytes: in the ring that a message to `destination` goes into now, if it can.
    pub(super) fn lend(&mut self, header: Header, length: usize) -> Result<LoanedMessage, ApiError> {
        if self.leaves.are_to_be_told() {
            self.tell_leaves();
        }
        let loan = self.lender.lend()?;
        let destination = self.absolute(header.destination);
        // Who has no link asks for one now: while the ring to the node is lent it cannot.
        let link = self.direct.link_to(destination).or_else(|| self.way(destination, Time::now()));
        let room = match link {
            Some(link) => self.direct.lend(link, length),
            None => self.writer.lend(length),
        };
        Ok(LoanedMessage::new(loan, header, room, length))
    }

    /// Comes back first, where `limit` leaves the time for it.
    pub(super) fn be_ready(&mut self, limit: Limit) -> Result<(), ApiError> {
        self.lender.be_free()?;
        let leaves_time = match self.form {
            // To register takes that long.
            Form::Thread => limit.leaves(ANSWERED_WITHIN),
            // That goes on beside it.
            Form::Reactor(_) => !limit.is_in_all(),
        };
        if leaves_time {
            self.try_return();
        }
        Ok(())
    }

    /// Sends `message` the way that is right now, and waits for room as long as `limit` allows; the link, if it did not go
    /// through the node.
    pub(super) async fn dispatch(
        &mut self,
        mut draft: Draft,
        limit: Limit,
    ) -> Result<Option<LinkNumber>, ApiError> {
        self.be_ready(limit)?;
        if self.leaves.are_to_be_told() {
            self.tell_leaves();
        }
        self.check_length(draft.payload.len())?;
        // A new connection may have another address.
        draft.header.source = self.tid;
        self.sequence += 1;
        draft.header.sequence = self.sequence;
        let now = Time::now();
        draft.header.sent = now;
        let destination = self.absolute(draft.header.destination);
        if !self.home.rejoining.is_empty() {
            // The node reads on when its answers about groups are taken, which who only sends does here: before it is settled which way this goes.
            let _ = self.take_in_from_node(None, WhenFull::Leave, now);
        }
        if let Some(link) = self.way(destination, now) {
            draft.header.destination = destination;
            let is_awaited = draft.header.flags.has(Flags::CONFIRM);
            let errand = if is_awaited { self.direct.errand(link) } else { None };
            match self.send_on(link, draft, limit, now).await? {
                None => {
                    self.direct.awaits(errand);
                    return Ok(Some(link));
                }
                Some(back) => draft = back,
            }
        }
        self.be_there()?;
        if self.reader.has_ended(now) {
            return Err(self.explain(ApiError::Closed("the node has gone".to_owned())));
        }
        self.write(draft, limit).await.map(|()| None).map_err(|error| self.explain(error))
    }

    /// The link on which a message to `destination` goes now; `None` for the way through the node.
    fn way(&mut self, destination: Tid, now: Time) -> Option<LinkNumber> {
        let mut node = ToNode { writer: &self.writer, correlation: &mut self.correlation };
        self.direct.look(now, &mut node);
        if self.direct.is_asking(now) {
            // Who only sends looks here for the answer. What it cannot sort in, or read, shows when it receives.
            let _ = self.take_in_from_node(None, WhenFull::Leave, now);
        }
        let mut node = ToNode { writer: &self.writer, correlation: &mut self.correlation };
        self.direct.way(destination, now, &mut node)
    }

    /// Sends on a direct link, and hands the message back if the peer has gone. While there is no room this endpoint takes in
    /// what others send to it: two that wait for room in each other's rings would wait for ever.
    ///
    /// # Errors
    /// [`ApiError::Stalled`]: nothing of it is received. What was written of a long one is taken back.
    async fn send_on(
        &mut self,
        link: LinkNumber,
        draft: Draft,
        limit: Limit,
        mut now: Time,
    ) -> Result<Option<Draft>, ApiError> {
        let room = Room { link, length: HEADER_LEN + draft.payload.len(), class: draft.header.class };
        // Who takes nothing costs a stall timeout once, and not with each message.
        let has_stalled = self.direct.is_stalled(link);
        let mut waiting = if has_stalled { Waiting::after_a_stall(limit) } else { Waiting::new(limit) };
        // `None`: it is begun.
        let (mut left, mut pause) = (Some(draft), ROOM_PAUSE);
        loop {
            left = match left {
                None => match self.direct.write_on(link) {
                    Writing::Whole => return Ok(None),
                    Writing::Part => None,
                    Writing::Cut(back) => return Ok(Some(back)),
                },
                Some(draft) => match self.direct.send(link, draft, now)? {
                    Sent::Taken => return Ok(None),
                    Sent::Gone(back) => return Ok(Some(back)),
                    Sent::Full(back) => Some(back),
                    Sent::Begun => {
                        if has_stalled && !limit.is_in_all() {
                            // It takes something again.
                            waiting = Waiting::new(limit);
                        }
                        None
                    }
                },
            };
            now = Time::now();
            let Some(until) = waiting.until(self.direct.taken(link), now) else {
                if waiting.is_out_of_patience(now) {
                    self.direct.has_stalled(link);
                }
                if left.is_none() {
                    self.direct.withdraw(link);
                }
                return Err(waiting.in_vain());
            };
            self.take_in_while_writing(link, now);
            match self.form {
                Form::Thread => self.direct.await_room(room, pause.min(until.since(now))),
                // Rung for room, and for what comes.
                Form::Reactor(_) => self.wait_for_room(room, until, now).await,
            }
            pause = (pause * 2).min(NAP);
        }
    }

    /// Before this endpoint goes: gives peers that take something the time to take what waits for room, `within` this time.
    /// What comes meanwhile is refused.
    pub(super) async fn part(&mut self, within: Duration) {
        let deadline = Time::now() + within;
        self.direct.flush();
        while self.direct.owes() && Time::now() < deadline {
            match self.form {
                Form::Thread => self.direct.await_owed(ROOM_PAUSE),
                Form::Reactor(_) => self.wait(deadline.min(Time::now() + ROOM_PAUSE), Time::now()).await,
            }
            // A peer that waits for room itself takes nothing until it has that.
            let _ = self.take_in(None, WhenFull::Refuse, Time::now());
            self.inbox.close();
            self.direct.flush();
        }
    }

    fn take_in_while_writing(&mut self, link: LinkNumber, now: Time) {
        self.direct.is_writing_on(Some(link));
        // What it cannot sort in, or read, shows when it receives.
        let _ = self.take_in(None, WhenFull::Leave, now);
        self.direct.is_writing_on(None);
    }

    pub(super) const fn absolute(&self, destination: Tid) -> Tid {
        if matches!(destination.node, NodeAddress::HERE) {
            Tid::new(self.tid.node, destination.app)
        } else {
            destination
        }
    }

    /// What the node said before it closed the connection says more than a broken pipe does.
    fn explain(&mut self, error: ApiError) -> ApiError {
        if !matches!(error, ApiError::Closed(_)) {
            return error;
        }
        for _ in 0..LAST_LOOKS {
            // The error to tell is the first one.
            if self.ended.is_some() || self.take_in(None, WhenFull::Refuse, Time::now()).is_err() {
                break;
            }
        }
        self.ended.as_ref().map_or(error, |ended| self.gone(ended))
    }

    pub(super) fn check_length(&self, length: usize) -> Result<(), ApiError> {
        if length > self.payload_max {
            return Err(ApiError::TooLong { length, limit: self.payload_max });
        }
        Ok(())
    }
}

/// What was sent and is to be answered.
#[derive(Clone, Copy)]
struct Asked {
    wanted: Wanted,
    /// The direct link that it went by.
    way: Option<LinkNumber>,
    deadline: Time,
    now: Time,
}

/// Whether a message to `destination` has an outcome for each of several.
fn is_many(destination: Tid) -> bool {
    !destination.is_single() && destination.app != AppAddress::NONE
}

/// Who has asked, and for what.
#[derive(Clone, Copy)]
pub(super) struct Request {
    pub(super) source: Tid,
    correlation: u64,
}

impl Request {
    /// What `received` asks of `own`: who asked takes the reply of nobody else.
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
