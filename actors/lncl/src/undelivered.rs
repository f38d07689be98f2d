//! Reports rejected unconfirmed messages to their senders, and warns of types that a receiver does not handle.
//!
//! Any thread records a rejection in a table of fixed size ([`Core`]). LNCL's thread sends the reports that are due: to
//! an application of this node as an event, to a client as LNCL_UNDELIVERED, and to another node as GNCL_UNDELIVERED.
//! Without rejections, no message path is affected.

mod log_lines;
mod report;
mod report_table;

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
};

use sinew_model::periodic_checks::PeriodicChecks;
use sinew_runtime::{
    event_queue::EventQueue,
    lock,
    outcome::{Outcome, Rejection},
    protection::raw::ECHO,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    undelivered::{RefusalSink, is_reported},
    wire::{Header, Kind},
};

use self::{
    log_lines::{LogLine, LogLines},
    report_table::ReportTable,
};
pub use self::{
    report::{kind_name, note, remedy, report},
    report_table::Entry,
};

/// Maximum number of senders and nodes with stored rejections. Rejections for further ones are only counted.
const READERS_MAX: usize = 1_024;

/// Returns whether a rejection is a fault that the sender of an unconfirmed message must learn of. A group without
/// members is no fault; the empty destination is one.
pub fn is_fault(destination: Tid, why: Rejection) -> bool {
    let is_to_many = !destination.is_single() && destination.app != AppAddress::NONE;
    !is_to_many || why != Rejection::NoSuchApplication
}

/// Reader of a report.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Recipient {
    /// An application of this node.
    App(AppAddress),
    /// Another node, for its applications.
    Node(NodeAddress),
}

/// Receiver of a message that it does not handle or cannot read, type of the message, and [`Outcome::code`] of the
/// reason.
type Unhandled = (AppAddress, Kind, u8);
/// Receiver and sender of protected messages that the receiver does not guard, and their type.
type Unguarded = (AppAddress, Tid, Kind);
/// Receiver of protected messages, and the sender to which its echoes were not delivered.
type LostEcho = (AppAddress, Tid);
/// Sender, receiver on another node, type of the message, and [`Outcome::code`] of the reason.
type UnhandledElsewhere = (AppAddress, Tid, Kind, u8);
/// Sender, destination, type and reason of messages that were not delivered.
type Warned = (AppAddress, Tid, Option<Kind>, u8);

/// The rejections that were not yet reported. Pure.
#[derive(Debug, Default)]
struct Core {
    readers: BTreeMap<Recipient, ReportTable>,
    unhandled: LogLines<Unhandled, Tid>,
    unguarded: LogLines<Unguarded, ()>,
    lost_echoes: LogLines<LostEcho, Rejection>,
    warned: LogLines<Warned, Entry>,
    without_room: u64,
    /// Whether LNCL was notified of due reports, and has not processed them.
    is_posted: bool,
}

impl Core {
    /// Adds rejected messages for a reader. Returns whether LNCL must be notified of a due report.
    fn add(&mut self, now: Time, reader: Recipient, entry: Entry) -> bool {
        if let Recipient::App(app) = reader
            && entry.kind == Some(ECHO)
        {
            self.lost_echoes.note(now, (app, entry.destination), entry.count, entry.why);
        }
        if !self.readers.contains_key(&reader) && self.readers.len() >= READERS_MAX {
            self.without_room = self.without_room.saturating_add(entry.count);
            return false;
        }
        let table = self.readers.entry(reader).or_default();
        let without_room = table.add(entry);
        self.without_room = self.without_room.saturating_add(without_room);
        table.is_due(now) && !std::mem::replace(&mut self.is_posted, true)
    }

    /// Adds messages that `receiver`, an application of this node or a group of it, rejected.
    fn refused(
        &mut self,
        now: Time,
        here: NodeAddress,
        (source, receiver): (Tid, Tid),
        (entry, is_reported): (Entry, bool),
    ) -> bool {
        let is_of_type = matches!(entry.why, Rejection::UnknownKind | Rejection::Malformed);
        if let Some(kind) = entry.kind.filter(|_| is_of_type && receiver.is_single()) {
            let key = (receiver.app, kind, Outcome::Rejected(entry.why).code());
            let is_due = self.unhandled.note(now, key, entry.count, source);
            if !is_reported {
                // Its sender gets the outcome.
                return is_due && !std::mem::replace(&mut self.is_posted, true);
            }
        }
        if !is_reported {
            return false;
        }
        // An application refuses no other unconfirmed message for this reason.
        if let Some(kind) = entry.kind.filter(|_| entry.why == Rejection::Unsupported && receiver.is_single())
        {
            self.unguarded.note(now, (receiver.app, source, kind), entry.count, ());
        }
        let reader =
            if source.node == here { Recipient::App(source.app) } else { Recipient::Node(source.node) };
        self.add(now, reader, entry)
    }

    /// Returns the reports that are due at `now`, each with at most `max` entries.
    fn take(&mut self, now: Time, max: usize) -> Vec<(Recipient, Vec<Entry>)> {
        self.is_posted = false;
        let mut due = Vec::new();
        self.readers.retain(|reader, table| {
            let max = if matches!(reader, Recipient::App(_)) { max } else { usize::MAX };
            let entries = table.take(now, max);
            if !entries.is_empty() {
                due.push((*reader, entries));
            }
            !table.is_over(now)
        });
        due
    }

    /// Returns whether a report or a line of the log may become due without a further rejection.
    fn is_left(&self) -> bool {
        !self.readers.is_empty() || self.unhandled.has_unlogged() || self.warned.has_unlogged()
    }
}

/// The node's table of rejections. It outlives the layers.
#[derive(Debug)]
pub struct Undelivered {
    node: NodeAddress,
    core: Mutex<Core>,
    lncl: EventQueue<crate::Event>,
    checks: Arc<PeriodicChecks>,
}

impl Undelivered {
    /// Creates an empty table of the node at `node`. It notifies LNCL through `lncl` of reports that are due, and by
    /// `checks` of those that will be.
    pub fn new(node: NodeAddress, lncl: EventQueue<crate::Event>, checks: Arc<PeriodicChecks>) -> Arc<Self> {
        Arc::new(Self { node, core: Mutex::default(), lncl, checks })
    }

    /// Counts rejected messages of the application of this node that `entry` names.
    pub fn count(&self, now: Time, entry: Entry) {
        self.count_for(now, Recipient::App(entry.source), entry);
    }

    fn count_for(&self, now: Time, reader: Recipient, entry: Entry) {
        let is_due = lock(&self.core).add(now, reader, entry);
        self.wake_lncl(is_due);
    }

    fn wake_lncl(&self, is_due: bool) {
        if is_due {
            // If the event queue is full, the report is sent at LNCL's next check.
            let _ = self.lncl.post(crate::Event::Undelivered);
        }
        self.checks.request();
    }

    /// Returns the types that applications of this node did not handle or could not read, the latest first.
    pub fn unhandled(&self) -> Vec<(Unhandled, LogLine<Tid>)> {
        lock(&self.core).unhandled.latest()
    }

    /// Returns the protected messages that applications of this node refused because they do not guard the sender, the
    /// latest first.
    pub fn unguarded(&self) -> Vec<(Unguarded, LogLine<()>)> {
        lock(&self.core).unguarded.latest()
    }

    /// Returns the echoes of this node's applications that were not delivered, the latest first. Each names a sender
    /// that the application guards.
    pub fn lost_echoes(&self) -> Vec<(LostEcho, LogLine<Rejection>)> {
        lock(&self.core).lost_echoes.latest()
    }

    /// Returns the types that applications of this node sent, and applications of other nodes did not handle or could
    /// not read, the latest first. Each has its sender, receiver, type, and code of the reason.
    pub fn unhandled_elsewhere(&self) -> Vec<(UnhandledElsewhere, LogLine<Entry>)> {
        let latest = lock(&self.core).warned.latest().into_iter();
        let of_types =
            [Rejection::UnknownKind, Rejection::Malformed].map(|why| Outcome::Rejected(why).code());
        let elsewhere = latest.filter_map(|((app, to, kind, why), line)| {
            let is_it = of_types.contains(&why) && to.is_single() && to.node != self.node;
            Some(((app, to, kind.filter(|_| is_it)?, why), line))
        });
        elsewhere.collect()
    }
}

impl RefusalSink for Undelivered {
    fn refused(&self, receiver: Tid, header: &Header, why: Rejection, count: u64) {
        let now = Time::now();
        let entry = Entry::of(header, why, count, now);
        let noted = (entry, is_reported(header, why));
        let is_due = lock(&self.core).refused(now, self.node, (header.source, receiver), noted);
        self.wake_lncl(is_due);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HERE: NodeAddress = NodeAddress::new(1);
    const THERE: NodeAddress = NodeAddress::new(2);

    fn tid(node: NodeAddress, app: u32) -> Tid {
        Tid::new(node, AppAddress::new(app))
    }

    fn refuse(core: &mut Core, source: Tid, now: Time) -> bool {
        let knee = tid(HERE, 0x1001);
        let header = Header::new(Kind::named("demo.angle"), source, knee);
        core.refused(now, HERE, (source, knee), (Entry::of(&header, Rejection::UnknownKind, 1, now), true))
    }

    #[test]
    fn local_and_remote_senders_have_separate_reports() {
        let mut core = Core::default();
        assert!(refuse(&mut core, tid(HERE, 0x1002), Time::ZERO), "LNCL is notified");
        assert!(!refuse(&mut core, tid(THERE, 0x1003), Time::ZERO), "it was notified already");
        let readers: Vec<_> = core.take(Time::ZERO, 8).into_iter().map(|(reader, _)| reader).collect();
        assert_eq!(readers, [Recipient::App(AppAddress::new(0x1002)), Recipient::Node(THERE)]);
        let lines = core.unhandled.take_due(Time::ZERO);
        assert_eq!(lines.iter().map(|(_, line)| line.unlogged).collect::<Vec<_>>(), [2]);
    }

    #[test]
    fn unguarded_and_lost_echoes_are_kept_per_pair() {
        // Given: the knee refuses a command of a sender that it does not guard
        let (mut core, torque) = (Core::default(), Kind::named("demo.torque"));
        let (hip, knee, guarded) = (tid(THERE, 0x8000_0000), tid(HERE, 0x1001), tid(THERE, 0x1001));
        let header = Header::new(torque, hip, knee);
        let entry = Entry::of(&header, Rejection::Unsupported, 3, Time::ZERO);
        core.refused(Time::ZERO, HERE, (hip, knee), (entry, true));
        core.refused(Time::ZERO, HERE, (hip, knee), (entry, true));
        // And: its echo to the guarded sender was not delivered
        let echo = Header::new(ECHO, knee, guarded);
        let lost = Entry::of(&echo, Rejection::NoSuchApplication, 1, Time::ZERO);
        core.add(Time::ZERO, Recipient::App(knee.app), lost);
        // Then
        let unguarded: Vec<_> =
            core.unguarded.latest().iter().map(|(key, line)| (*key, line.count)).collect();
        assert_eq!(unguarded, [((knee.app, hip, torque), 6)]);
        let lost: Vec<_> = core.lost_echoes.latest().iter().map(|(key, line)| (*key, line.about)).collect();
        assert_eq!(lost, [((knee.app, guarded), Rejection::NoSuchApplication)]);
        assert!(core.unhandled.latest().is_empty());
    }

    #[test]
    fn reader_without_pending_reports_is_removed() {
        let mut core = Core::default();
        assert!(!core.is_left());
        refuse(&mut core, tid(HERE, 0x1002), Time::ZERO);
        core.take(Time::ZERO, 8);
        assert!(core.is_left(), "the line of the log, and the pause of the reader");
        core.unhandled.take_due(Time::ZERO);
        assert!(core.is_left(), "the pause of the reader");
        core.take(Time::ZERO + report_table::PAUSE, 8);
        assert!(core.readers.is_empty() && !core.is_left());
    }

    #[test]
    fn unlogged_refusal_is_left_until_its_line() {
        let mut core = Core::default();
        for _ in 0..2 {
            refuse(&mut core, tid(HERE, 0x1002), Time::ZERO);
            core.unhandled.take_due(Time::ZERO);
        }
        let later = Time::ZERO + report_table::PAUSE;
        core.take(later, 8);
        core.take(later + report_table::PAUSE, 8);
        assert!(core.readers.is_empty() && core.is_left());
        core.unhandled.take_due(Time::ZERO + log_lines::LOG_INTERVAL);
        assert!(!core.is_left());
    }

    #[test]
    fn readers_are_bounded_and_the_excess_is_counted() {
        let mut core = Core::default();
        for app in 0..2_000 {
            refuse(&mut core, tid(HERE, 0x1002 + app), Time::ZERO);
        }
        assert_eq!((core.readers.len(), core.without_room), (READERS_MAX, 2_000 - READERS_MAX as u64));
    }
}
