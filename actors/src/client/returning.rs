//! Coming back: an endpoint whose connection ended registers again, within the calls of its user.
//!
//! There is no thread for it. [`receive`](Endpoint::receive) waits for the node's return as it waits for a message; a send
//! tries once, and waits for a node that is there and has just been asked, for 20 ms at most: who calls seldom would else
//! come too late for each step of it. Between two tries there is a pause, from 10 ms doubling to 1 s.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::PathBuf,
    thread,
    time::Duration,
};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Flags, Header, Kind, Message},
};

use super::{
    ApiError, Endpoint,
    direct::{Direct, Terms},
    endpoint::LNCL,
    form::Form,
    link::{Ended, Greeting, Link, LinkOptions},
};
use crate::lncl::payload::{self, Group, Register};

/// First and longest pause between two tries.
const PAUSE: (Duration, Duration) = (Duration::from_millis(10), Duration::from_secs(1));

/// Time that a node has to answer in the call that asked it. Later calls look without waiting.
pub(super) const ANSWERED_WITHIN: Duration = Duration::from_millis(20);

/// How often who registers on another thread looks whether that is still wanted.
pub(super) const LOOK: Duration = Duration::from_millis(100);

/// Memberships of which who comes back asks what becomes of them, at most. A node reads nothing more of who does not take its answers, and who
/// comes back takes none before all is asked: so many, asked last, fit the shortest ring, whether the node reads them or not. spec: LNCL-16
const CONFIRMED_MAX: usize = 32;

/// Whether an endpoint registers again when its connection has ended through no fault of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ReconnectPolicy {
    Always,
    Never,
}

/// What an endpoint needs to register again, and how far it is with it.
pub(super) struct Home {
    pub(super) path: PathBuf,
    pub(super) register: Register,
    pub(super) options: LinkOptions,
    pub(super) returning: ReconnectPolicy,
    /// The groups that it is a member of.
    pub(super) groups: BTreeSet<AppAddress>,
    /// Those that it has asked for when it came back, by the numbers of the questions, and of which the node has said nothing yet.
    pub(super) rejoining: BTreeMap<u64, AppAddress>,
    /// How often it has registered.
    pub(super) registrations: u64,
    way: Option<Way>,
}

/// On the way back.
struct Way {
    pause: Duration,
    /// When the next try is due.
    next: Time,
    /// The try that the node has not answered yet.
    greeting: Option<Greeting>,
    /// Whether `receive` has told the caller.
    is_told: bool,
}

impl Home {
    pub(super) const fn new(
        path: PathBuf,
        register: Register,
        options: LinkOptions,
        returning: ReconnectPolicy,
    ) -> Self {
        Self {
            path,
            register,
            options,
            returning,
            groups: BTreeSet::new(),
            rejoining: BTreeMap::new(),
            registrations: 1,
            way: None,
        }
    }

    /// The way back, which begins with the first question for it.
    fn way(&mut self) -> &mut Way {
        let fresh = || Way { pause: PAUSE.0, next: Time::ZERO, greeting: None, is_told: false };
        self.way.get_or_insert_with(fresh)
    }

    /// Tries to register; `None` if it has not come to that by the deadline, or the next try is not due.
    fn knock(&mut self, until: Time) -> Option<Link> {
        let (path, register, options) = (self.path.clone(), self.register.clone(), self.options.clone());
        let way = self.way();
        if way.greeting.is_none() && Time::now() < way.next {
            return None;
        }
        let (answer, until) = match way.greeting.take() {
            Some(greeting) => (Ok(greeting), until),
            None => {
                let until = until.max(Time::now() + ANSWERED_WITHIN);
                (Greeting::begin(&path, &register, options, until), until)
            }
        };
        let answer = answer.and_then(|mut greeting| match greeting.wait(until)? {
            None => {
                way.greeting = Some(greeting);
                Ok(None)
            }
            link => Ok(link),
        });
        answer.unwrap_or_else(|why| {
            crate::log::here!(debug: %why, "not registered again yet");
            way.next = Time::now() + way.pause;
            way.pause = (way.pause * 2).min(PAUSE.1);
            None
        })
    }
}

impl Home {
    /// The same way, begun anew.
    pub(super) fn another(&self) -> Self {
        Self::new(self.path.clone(), self.register.clone(), self.options.clone(), self.returning)
    }
}

/// Tries until it is registered, or is not wanted any more, which is looked at between two tries. Blocks.
pub(super) fn come_home(mut home: Home, is_wanted: impl Fn() -> bool) -> Option<Link> {
    while is_wanted() {
        let until = Time::now() + LOOK;
        if let Some(link) = home.knock(until) {
            return Some(link);
        }
        let way = home.way();
        if way.greeting.is_none() {
            thread::sleep(way.next.min(until).since(Time::now()));
        }
    }
    None
}

impl Endpoint {
    /// The error of a call that finds the connection ended.
    pub(super) fn gone(&self, ended: &Ended) -> ApiError {
        if self.returns(ended) {
            ApiError::Disconnected(ended.why.clone())
        } else {
            ApiError::Closed(ended.why.clone())
        }
    }

    const fn returns(&self, ended: &Ended) -> bool {
        ended.again && matches!(self.home.returning, ReconnectPolicy::Always)
    }

    /// The connection to the node has ended. What is told is the first reason.
    pub(super) fn end(&mut self, ended: Ended) {
        if self.ended.is_none() {
            self.ended = Some(ended);
            self.direct.node_has_ended(Time::now());
        }
    }

    /// Whether there is a connection to the node.
    pub(super) fn be_there(&self) -> Result<(), ApiError> {
        self.ended.as_ref().map_or(Ok(()), |ended| Err(self.gone(ended)))
    }

    /// Comes back if that takes no waiting to speak of.
    pub(super) fn try_return(&mut self) {
        if let Some(ended) = &self.ended
            && self.returns(ended)
            && let Some(link) = match &mut self.form {
                Form::Thread => self.home.knock(Time::now()),
                Form::Reactor(reactor) => reactor.look_home(&self.home),
            }
        {
            self.arrive(link);
        }
    }

    /// Tells the caller of the end: once if the endpoint comes back, always if it does not.
    pub(super) fn tell(&mut self, ended: &Ended) -> Result<(), ApiError> {
        if self.returns(ended) && std::mem::replace(&mut self.home.way().is_told, true) {
            return Ok(());
        }
        Err(self.gone(ended))
    }

    /// Comes back, or waits until the next try, until something comes on a direct link, or until `deadline`.
    pub(super) async fn await_return(&mut self, deadline: Time) {
        if let Form::Reactor(reactor) = &mut self.form {
            if let Some(link) = reactor.await_home(&self.home, &mut self.direct, deadline).await {
                self.arrive(link);
            }
            return;
        }
        let has_links = !self.direct.open.is_empty();
        let now = Time::now();
        if let Some(link) = self.home.knock(if has_links { now } else { deadline }) {
            return self.arrive(link);
        }
        let way = self.home.way();
        let due = if way.greeting.is_some() { now + PAUSE.0 } else { way.next };
        let left = due.min(deadline).since(Time::now());
        if has_links {
            self.direct.wait(left);
        } else {
            thread::sleep(left);
        }
    }

    /// Goes on with a new connection, as a member of the same groups.
    fn arrive(&mut self, link: Link) {
        let Link { registered, writer, reader } = link;
        let control = reader.control().filter(|_| self.home.register.direct);
        let own = Tid::new(registered.node, registered.app);
        let terms = Terms::of(&registered, &self.home.options);
        if own == self.tid {
            self.direct.node_is_back(terms, control);
        } else {
            // Another address has no links. What has come on them is received.
            self.take_in_from_links();
            self.direct.end_all();
            self.count_unsent(Time::now());
            self.direct = Direct::new(terms, control);
        }
        self.tid = own;
        self.home.register.former = Some(registered.app);
        self.payload_max = registered.payload_max as usize;
        self.node_name = registered.node_name;
        self.inbox.set_sink(own, writer.clone());
        (self.writer, self.reader) = (writer, reader);
        (self.ended, self.home.way) = (None, None);
        (self.rest, self.stalled) = (None, None);
        self.home.registrations += 1;
        if let Form::Reactor(reactor) = &mut self.form
            && let Err(why) = reactor.change(&self.reader, &self.writer)
        {
            return self.turn_back(why.to_string());
        }
        if let Err(why) = self.join_again() {
            self.turn_back(why.to_string());
        }
    }

    /// Asks for its groups again: for the last [`CONFIRMED_MAX`] of them so that the node says what becomes of that.
    fn join_again(&mut self) -> Result<(), ApiError> {
        self.home.rejoining.clear();
        let unconfirmed = self.home.groups.len().saturating_sub(CONFIRMED_MAX);
        for (index, group) in self.home.groups.iter().enumerate() {
            let membership = Group { group: *group, member: true };
            let mut message: Message = payload::frame(Kind::LNCL_GROUP, self.tid, LNCL, &membership);
            if index >= unconfirmed {
                self.correlation += 1;
                (message.header.flags, message.header.correlation) = (Flags::CONFIRM, self.correlation);
                self.home.rejoining.insert(self.correlation, *group);
            }
            self.writer.write(&message)?;
        }
        Ok(())
    }

    /// Hears what became of a group that it asked for when it came back; whether `message` says that. Nobody waits for the answer: the log says
    /// where it may not join one. That may pass, so it asks for it again when it comes back the next time.
    pub(super) fn heed_rejoined(&mut self, message: &Message) -> bool {
        let Header { kind, source, correlation, .. } = message.header;
        if kind != Kind::OUTCOME || self.absolute(source) != self.absolute(LNCL) {
            return false;
        }
        let Some(group) = self.home.rejoining.remove(&correlation) else { return false };
        let outcome = message.payload.first().and_then(|code| Outcome::from_code(*code));
        // Whose address is not its own any more has no connection for long: it comes back once more, and asks again.
        if let Some(Outcome::Rejected(why)) = outcome
            && why != Rejection::NoSuchApplication
        {
            let remedy = if why == Rejection::QueueFull {
                "its user, or the node, has as many memberships as it may: leave groups, then join this one again"
            } else {
                "the node's access list does not let it: name the group in its `[[client]]`, `sinew reload`, then join it again"
            };
            crate::log::here!(warn: endpoint = %self.tid, %group, remedy, "it came back to its node, and is not in this group any more");
        }
        true
    }

    /// Half a return is none. What has come meanwhile is not taken: to the node who hangs up has not handled it.
    fn turn_back(&mut self, why: String) {
        self.writer.close();
        self.reader.turn_away();
        self.end(Ended { why, again: true });
    }
}
