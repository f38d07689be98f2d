//! Reports refused unconfirmed messages to their senders, and warns of types that a receiver does not handle.
//!
//! Each refusal is noted in a table of fixed size ([`Core`]), by any thread. LNCL's thread reports what is due: to an application of this
//! node as an event, to a client as LNCL_UNDELIVERED, to another node as GNCL_UNDELIVERED. No message path is touched where nothing is
//! refused.

mod ledger;
mod lines;
mod report;

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    post::Post,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    undelivered::{RefusalSink, is_reported},
    wire::{Header, Kind},
};

pub(crate) use self::{
    ledger::Entry,
    report::{Report, is_of_an_end, kind_name, reason_of, remedy, report},
};
use self::{
    ledger::Ledger,
    lines::{Line, Lines},
};
use crate::{lncl, stores::lock};

/// Senders and nodes for which refusals are kept at one time, at most. Refusals for one more are counted alone.
const READERS_MAX: usize = 1_024;

/// Whether the sender of an unconfirmed message misses something when nobody takes it. A group without members is no fault, nobody at all is
/// one.
pub(crate) fn is_fault(destination: Tid, why: Rejection) -> bool {
    let is_to_many = !destination.is_single() && destination.app != AppAddress::NONE;
    !is_to_many || why != Rejection::NoSuchApplication
}

/// Reader of a report.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Reader {
    /// An application of this node.
    App(AppAddress),
    /// Another node, for its applications.
    Node(NodeAddress),
}

/// Receiver of a message that it does not handle or cannot read, type of the message, and [`Outcome::code`] of the reason.
type Unhandled = (AppAddress, Kind, u8);
/// Sender, receiver on another node, type of the message, and [`Outcome::code`] of the reason.
type UnhandledElsewhere = (AppAddress, Tid, Kind, u8);
/// Sender, destination, type and reason of messages that were not delivered.
type Warned = (AppAddress, Tid, Option<Kind>, u8);

/// What was refused and not reported. Pure.
#[derive(Debug, Default)]
struct Core {
    readers: BTreeMap<Reader, Ledger>,
    unhandled: Lines<Unhandled, Tid>,
    warned: Lines<Warned, Entry>,
    without_room: u64,
    /// LNCL was told that something is due, and has not looked.
    is_posted: bool,
}

impl Core {
    /// Adds refused messages for a reader. Returns whether LNCL is to be told that something is due.
    fn add(&mut self, now: Time, reader: Reader, entry: Entry) -> bool {
        if !self.readers.contains_key(&reader) && self.readers.len() >= READERS_MAX {
            self.without_room = self.without_room.saturating_add(entry.count);
            return false;
        }
        let ledger = self.readers.entry(reader).or_default();
        let without_room = ledger.add(entry);
        self.without_room = self.without_room.saturating_add(without_room);
        ledger.is_due(now) && !std::mem::replace(&mut self.is_posted, true)
    }

    /// `receiver`, an application of this node or a group of it, refused messages that were sent to it.
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
                // Its sender has the outcome.
                return is_due && !std::mem::replace(&mut self.is_posted, true);
            }
        }
        if !is_reported {
            return false;
        }
        let reader = if source.node == here { Reader::App(source.app) } else { Reader::Node(source.node) };
        self.add(now, reader, entry)
    }

    /// The reports that are due at `now`, each of `max` entries at most.
    fn take(&mut self, now: Time, max: usize) -> Vec<(Reader, Vec<Entry>)> {
        self.is_posted = false;
        let mut due = Vec::new();
        self.readers.retain(|reader, ledger| {
            let max = if matches!(reader, Reader::App(_)) { max } else { usize::MAX };
            let entries = ledger.take(now, max);
            if !entries.is_empty() {
                due.push((*reader, entries));
            }
            !ledger.is_over(now)
        });
        due
    }
}

/// The node's table of refusals. It outlives the layers.
#[derive(Debug)]
pub(crate) struct Undelivered {
    node: NodeAddress,
    core: Mutex<Core>,
    lncl: Post<lncl::Event>,
}

impl Undelivered {
    /// An empty one of the node at `node`, which tells LNCL by `lncl`.
    pub(crate) fn new(node: NodeAddress, lncl: Post<lncl::Event>) -> Arc<Self> {
        Arc::new(Self { node, core: Mutex::default(), lncl })
    }

    /// Refused messages of the application of this node that `entry` names.
    pub(crate) fn count(&self, now: Time, entry: Entry) {
        self.count_for(now, Reader::App(entry.source), entry);
    }

    fn count_for(&self, now: Time, reader: Reader, entry: Entry) {
        let is_due = lock(&self.core).add(now, reader, entry);
        self.tell(is_due);
    }

    fn tell(&self, is_due: bool) {
        if is_due {
            // One that finds the post full is reported at LNCL's next tick.
            let _ = self.lncl.post(lncl::Event::Undelivered);
        }
    }

    /// Types that applications of this node did not handle or could not read, the latest first.
    pub(crate) fn unhandled(&self) -> Vec<(Unhandled, Line<Tid>)> {
        lock(&self.core).unhandled.latest()
    }

    /// Types that applications of other nodes did not handle or could not read when applications of this one sent them, the latest first:
    /// sender, receiver, type, and code of the reason.
    pub(crate) fn unhandled_elsewhere(&self) -> Vec<(UnhandledElsewhere, Line<Entry>)> {
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
        self.tell(is_due);
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
    fn a_sender_of_this_node_and_one_of_another_have_reports_of_their_own() {
        let mut core = Core::default();
        assert!(refuse(&mut core, tid(HERE, 0x1002), Time::ZERO), "LNCL is told");
        assert!(!refuse(&mut core, tid(THERE, 0x1003), Time::ZERO), "it was told");
        let readers: Vec<_> = core.take(Time::ZERO, 8).into_iter().map(|(reader, _)| reader).collect();
        assert_eq!(readers, [Reader::App(AppAddress::new(0x1002)), Reader::Node(THERE)]);
        let lines = core.unhandled.take_due(Time::ZERO);
        assert_eq!(lines.iter().map(|(_, line)| line.unlogged).collect::<Vec<_>>(), [2]);
    }

    #[test]
    fn nothing_is_kept_of_a_reader_that_was_told_all() {
        let mut core = Core::default();
        refuse(&mut core, tid(HERE, 0x1002), Time::ZERO);
        core.take(Time::ZERO, 8);
        core.take(Time::ZERO + ledger::PAUSE, 8);
        assert!(core.readers.is_empty());
    }

    #[test]
    fn so_many_readers_have_room_and_the_rest_is_counted() {
        let mut core = Core::default();
        for app in 0..2_000 {
            refuse(&mut core, tid(HERE, 0x1002 + app), Time::ZERO);
        }
        assert_eq!((core.readers.len(), core.without_room), (READERS_MAX, 2_000 - READERS_MAX as u64));
    }
}
