//! Sends the messages, each when it is due.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew::{Endpoint, NodeAddress, Tid, Time, client::ApiError, message::Kind};
use sinew_player::{Playback, Recorded};

use super::{
    Order,
    pace::Pace,
    route::{self, LeftOut, Route, Sender, To},
    sources::{self, Sources},
    target::Target,
};
use crate::{record::stop::StopRequest, system::SystemError};

/// Longest sleep between two looks at the endpoints and at Ctrl-C.
const LOOK: Duration = Duration::from_millis(5);
/// Time after which the address of a destination is asked for again.
const KNOWN_FOR: Duration = Duration::from_secs(1);
/// Time between two looks for a destination that is not there.
const ABSENT_FOR: Duration = Duration::from_millis(100);
/// Time at the end for reports of messages that were not delivered: a node collects them for 100 ms.
const REPORTS_WITHIN: Duration = Duration::from_millis(300);

/// The result of a channel.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Row {
    pub(crate) topic: String,
    /// Messages that the node has accepted.
    pub(crate) sent: u64,
    /// Messages that the node or the receiver has refused.
    pub(crate) rejected: u64,
    /// Messages that were sent later than they were due.
    pub(crate) late: u64,
    /// Messages to an application that is not there, or that this command plays itself: no program receives them.
    pub(crate) absent: u64,
}

/// Why it has ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum End {
    /// The recording is over.
    Complete,
    /// The user has asked for it.
    Asked,
    /// The node is lost, for this reason.
    Lost(String),
}

/// The result.
#[derive(Debug)]
pub(crate) struct Played {
    pub(crate) project: String,
    pub(crate) is_own: bool,
    pub(crate) end: End,
    /// The passes that have begun.
    pub(crate) passes: u64,
    pub(crate) sources: usize,
    pub(crate) rows: Vec<Row>,
    pub(crate) left_out: BTreeMap<LeftOut, u64>,
    /// Names of destinations that were not there.
    pub(crate) absent: BTreeSet<String>,
    /// Names of destinations that this command plays itself.
    pub(crate) own: BTreeSet<String>,
    /// Reasons of rejections, each with its number. A reason is one of a few.
    pub(crate) reasons: BTreeMap<String, u64>,
    pub(crate) damage: Vec<String>,
    /// The unfinished files: a killed recorder leaves one, and its messages are played.
    pub(crate) missing_ends: Vec<String>,
    /// Nodes that were lost when the names were compared, at most as many as a node reports.
    pub(crate) lost: BTreeSet<NodeAddress>,
}

/// Plays the recording to its end.
pub(crate) fn play(
    order: &Order,
    playback: Playback,
    target: &mut Target,
    stop: &StopRequest,
) -> Result<Played, SystemError> {
    let is_own = target.is_own();
    let routes: Vec<_> = playback.channels().iter().map(|channel| route::of(channel, is_own)).collect();
    let chosen = playback.channels().iter().zip(&routes).filter(|(channel, _)| order.chooses(channel));
    let senders: BTreeSet<_> =
        chosen.clone().filter_map(|(_, route)| Some(&route.as_ref().ok()?.sender)).collect();
    let wanted: BTreeSet<_> = chosen.filter_map(|(_, route)| wanted(route, &senders)).collect();
    let lost = sources::check_names(target, &senders, &BTreeSet::new())?;
    let mut sources = Sources::register(&target.api()?, senders.clone())?;
    let topics =
        playback.channels().iter().map(|channel| Row { topic: channel.topic.clone(), ..Row::default() });
    let mut session = Session {
        order,
        stop,
        played: Played {
            project: target.project.clone(),
            is_own,
            end: End::Complete,
            passes: 0,
            sources: senders.len(),
            rows: topics.collect(),
            left_out: BTreeMap::new(),
            absent: BTreeSet::new(),
            own: BTreeSet::new(),
            reasons: BTreeMap::new(),
            damage: playback.damage().to_vec(),
            missing_ends: playback.missing_ends().to_vec(),
            lost: lost.into_iter().collect(),
        },
        due: 0,
        destinations: Destinations::default(),
        sent: BTreeMap::new(),
        drained: Time::now(),
    };
    let result = session.wait_for(target, &mut sources, &wanted).and_then(|()| {
        session.played.lost.extend(sources::check_names(target, &senders, &sources.addresses())?);
        session.all(playback, &routes, (target, &mut sources))
    });
    session.settle(&mut sources);
    sources.leave();
    result.map(|()| session.played)
}

/// Returns the name of a destination that is not played itself.
fn wanted<'r>(route: &'r Result<Route, LeftOut>, senders: &BTreeSet<&Sender>) -> Option<&'r str> {
    let Ok(Route { to: To::Name(name), .. }) = route else { return None };
    (!senders.contains(&Sender::Named(name.clone()))).then_some(name.as_str())
}

/// The part of a session that changes.
struct Session<'s> {
    order: &'s Order,
    stop: &'s StopRequest,
    played: Played,
    /// Messages that were due, whether their destinations were there or not.
    due: u64,
    destinations: Destinations,
    /// The channels of sent messages, for reports about them.
    sent: BTreeMap<(Sender, Tid, Kind), usize>,
    /// When the endpoints were looked at.
    drained: Time,
}

impl Session<'_> {
    /// Waits until all destinations are there, or the time for that is over.
    fn wait_for(
        &mut self,
        target: &mut Target,
        sources: &mut Sources,
        wanted: &BTreeSet<&str>,
    ) -> Result<(), SystemError> {
        let until = Time::now() + self.order.wait;
        let mut missing = wanted.clone();
        while !self.stop.is_there() {
            let mut still = BTreeSet::new();
            for name in missing {
                if self
                    .destinations
                    .find(&mut target.system.endpoint, name, Time::now())
                    .map_err(lost)?
                    .is_none()
                {
                    still.insert(name);
                }
            }
            if still.is_empty() || Time::now() >= until {
                break;
            }
            missing = still;
            self.drain(sources).map_err(lost)?;
            std::thread::sleep(LOOK);
        }
        Ok(())
    }

    /// Plays all passes.
    fn all(
        &mut self,
        first: Playback,
        routes: &[Result<Route, LeftOut>],
        (target, sources): (&mut Target, &mut Sources),
    ) -> Result<(), SystemError> {
        let mut playback = first;
        playback.stop_at(self.stop.flag());
        loop {
            self.played.passes += 1;
            let (due, accepted) = (self.due, self.accepted());
            let mut end = self.pass(&mut playback, routes, (&mut target.system.endpoint, &mut *sources))?;
            // A pass without any message would be repeated without a pause.
            let is_over = end != End::Complete || !self.order.is_looped || self.due == due;
            if !is_over && self.accepted() == accepted {
                // No destination is there. With `--rate max` the pass has taken no time.
                end = self.wait_until(Some(Time::now() + ABSENT_FOR), sources).err().unwrap_or(end);
            }
            let is_over = is_over || end != End::Complete;
            self.played.end = end;
            if is_over {
                return Ok(());
            }
            playback = self.order.open()?;
            playback.stop_at(self.stop.flag());
        }
    }

    /// Returns how many messages the node has accepted.
    fn accepted(&self) -> u64 {
        self.played.rows.iter().map(|row| row.sent).sum()
    }

    fn pass(
        &mut self,
        playback: &mut Playback,
        routes: &[Result<Route, LeftOut>],
        (resolver, sources): (&mut Endpoint, &mut Sources),
    ) -> Result<End, SystemError> {
        let from = self.order.from.unwrap_or_default();
        let pace = Pace::new(Time::now(), from, self.order.rate);
        while let Some(message) = playback.next_message()? {
            // Also where messages are left out for a long time.
            if self.stop.is_there() {
                break;
            }
            let offset = Duration::from_nanos(playback.offset_ns(message.sent_ns));
            if self.order.to.is_some_and(|to| offset > to) {
                break;
            }
            // The files may have changed between two passes.
            let Some(route) = routes.get(message.index) else { continue };
            if offset < from {
                continue;
            }
            let route = match route {
                Ok(route) => route::left_out(&message, self.played.is_own).map_or(Ok(route), Err),
                Err(why) => Err(*why),
            };
            let route = match route {
                Ok(route) => route,
                Err(why) => {
                    *self.played.left_out.entry(why).or_default() += 1;
                    continue;
                }
            };
            self.due += 1;
            let due = pace.due(offset);
            if let Err(end) = self.wait_until(due, sources) {
                return Ok(end);
            }
            if let Err(end) = self.send(&message, route, (due, &mut *resolver), sources) {
                return Ok(end);
            }
        }
        // The playback ends early when it is asked to.
        Ok(if self.stop.is_there() { End::Asked } else { End::Complete })
    }

    /// Waits until a message is due. Returns the end if there is a reason for one.
    fn wait_until(&mut self, due: Option<Time>, sources: &mut Sources) -> Result<(), End> {
        loop {
            if self.stop.is_there() {
                return Err(End::Asked);
            }
            let now = Time::now();
            if now.since(self.drained) >= LOOK {
                self.drain(sources).map_err(|why| End::Lost(why.to_string()))?;
            }
            let left = due.map_or(Duration::ZERO, |due| due.since(now));
            if left.is_zero() {
                return Ok(());
            }
            std::thread::sleep(left.min(LOOK));
        }
    }

    fn send(
        &mut self,
        message: &Recorded,
        route: &Route,
        (due, resolver): (Option<Time>, &mut Endpoint),
        sources: &mut Sources,
    ) -> Result<(), End> {
        let now = Time::now();
        let row = &mut self.played.rows[message.index];
        let to = match &route.to {
            To::Tid(tid) => Some(*tid),
            To::Name(name) => {
                let found = self.destinations.find(resolver, name, now);
                found.map_err(|why| End::Lost(why.to_string()))?
            }
        };
        let Some(to) = to else {
            row.absent += 1;
            if let To::Name(name) = &route.to {
                self.played.absent.insert(name.clone());
            }
            return Ok(());
        };
        if let To::Name(name) = &route.to
            && sources.has(to)
        {
            row.absent += 1;
            self.played.own.insert(name.clone());
            return Ok(());
        }
        row.late += u64::from(Pace::is_late(due, now));
        match sources.send(&route.sender, to, message) {
            Ok(()) => {
                row.sent += 1;
                self.sent.insert((route.sender.clone(), to, message.channel.kind), message.index);
            }
            Err(why @ (ApiError::Disconnected(_) | ApiError::Closed(_))) => {
                return Err(End::Lost(why.to_string()));
            }
            Err(why) => {
                row.rejected += 1;
                *self.played.reasons.entry(why.to_string()).or_default() += 1;
            }
        }
        Ok(())
    }

    /// Takes received messages and reports.
    fn drain(&mut self, sources: &mut Sources) -> Result<(), ApiError> {
        self.drained = Time::now();
        for (sender, report) in sources.drain()? {
            // Messages to the endpoint itself, for which it had no room.
            let Some(kind) = report.kind else { continue };
            if let Some(index) = self.sent.get(&(sender, report.destination, kind)) {
                self.played.rows[*index].rejected += report.count;
                *self.played.reasons.entry(report.why.to_string()).or_default() += report.count;
            }
        }
        Ok(())
    }

    /// Waits for the last reports.
    fn settle(&mut self, sources: &mut Sources) {
        let until = Time::now() + REPORTS_WITHIN;
        // A node that is lost has no further reports.
        while self.played.end != End::Asked && Time::now() < until && self.drain(sources).is_ok() {
            std::thread::sleep(LOOK);
        }
    }
}

fn lost(why: ApiError) -> SystemError {
    SystemError::Bag(format!("the node is lost before the first message: {why}"))
}

/// The addresses of names.
#[derive(Debug, Default)]
struct Destinations(BTreeMap<String, (Option<Tid>, Time)>);

impl Destinations {
    /// Returns the address of the application with this name, if there is one.
    ///
    /// # Errors
    /// The node does not answer.
    fn find(&mut self, endpoint: &mut Endpoint, name: &str, now: Time) -> Result<Option<Tid>, ApiError> {
        if let Some((tid, until)) = self.0.get(name)
            && now < *until
        {
            return Ok(*tid);
        }
        let tid = endpoint.resolve(name, KNOWN_FOR)?;
        let until = now + if tid.is_some() { KNOWN_FOR } else { ABSENT_FOR };
        self.0.insert(name.to_owned(), (tid, until));
        Ok(tid)
    }
}
