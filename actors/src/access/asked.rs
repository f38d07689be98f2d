//! What applications of this node have asked for: the reply to that comes to them whatever the rules say.
//!
//! A note is taken by the first message that is a reply to it. What is flagged as a reply and answers nothing is a message as any other,
//! or else the flag would be a way past the list.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Mutex,
    time::Duration,
};

use sinew_runtime::{
    tid::{AppAddress, Tid},
    time::Time,
    wire::Header,
};

use crate::stores::lock;

/// Parts of the table, each with a lock of its own: two that ask at once seldom wait for each other.
const PARTS: usize = 16;
/// Notes in one part at most; of more those that end first go.
const PART_MAX: usize = 4_096;
/// Notes of one application at most; of more its own go that end first. As many as it can wait for, unless its mailbox was made larger.
const EACH_MAX: usize = 1_024;
/// How long a note is kept of a question that says no time to live: the longest that one can say, 71 minutes.
const LONGEST: Duration = Duration::from_micros(u32::MAX as u64);

/// Questions of this node's applications that were not answered yet.
#[derive(Debug, Default)]
pub(super) struct Asked([Mutex<Part>; PARTS]);

/// Who was asked, and the number of the question.
type Key = (Tid, u64);

#[derive(Debug, Default)]
struct Part {
    by_source: BTreeMap<AppAddress, Source>,
    by_end: BTreeSet<(Time, AppAddress, Key)>,
}

#[derive(Debug, Default)]
struct Source {
    until: BTreeMap<Key, Time>,
    by_end: BTreeSet<(Time, Key)>,
}

impl Asked {
    fn part(&self, source: AppAddress) -> &Mutex<Part> {
        &self.0[source.bits() as usize % PARTS]
    }

    /// An application of this node asks.
    pub(super) fn note(&self, now: Time, question: &Header) {
        let lasts = match question.time_to_live_us {
            0 => LONGEST,
            micros => Duration::from_micros(u64::from(micros)),
        };
        let key = (question.destination, question.correlation);
        lock(self.part(question.source.app)).note(now, question.source.app, key, now + lasts);
    }

    /// Whether `reply` answers a question of the application at `target`; the next one does not.
    pub(super) fn take(&self, now: Time, reply: &Header, target: AppAddress) -> bool {
        let key = (reply.source, reply.correlation);
        let until = lock(self.part(target)).remove(target, key);
        until.is_some_and(|until| now <= until)
    }

    /// The application at `source` has gone: whoever has its address next has asked nothing.
    pub(super) fn forget(&self, source: AppAddress) {
        let mut part = lock(self.part(source));
        for (key, until) in part.by_source.remove(&source).unwrap_or_default().until {
            part.by_end.remove(&(until, source, key));
        }
    }
}

impl Part {
    fn note(&mut self, now: Time, source: AppAddress, key: Key, until: Time) {
        self.remove(source, key);
        let own = self.by_source.get(&source).filter(|own| own.until.len() >= EACH_MAX);
        if let Some((_, first)) = own.and_then(|own| own.by_end.first().copied()) {
            self.remove(source, first);
        }
        while let Some((end, of, which)) = self.by_end.first().copied()
            && (end < now || self.by_end.len() >= PART_MAX)
        {
            self.remove(of, which);
        }
        let own = self.by_source.entry(source).or_default();
        own.until.insert(key, until);
        own.by_end.insert((until, key));
        self.by_end.insert((until, source, key));
    }

    fn remove(&mut self, source: AppAddress, key: Key) -> Option<Time> {
        let own = self.by_source.get_mut(&source)?;
        let until = own.until.remove(&key)?;
        own.by_end.remove(&(until, key));
        if own.until.is_empty() {
            self.by_source.remove(&source);
        }
        self.by_end.remove(&(until, source, key));
        Some(until)
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::{tid::NodeAddress, wire::Kind};

    use super::*;

    const HERE: NodeAddress = NodeAddress::new(0x0a00_0002);
    const THERE: NodeAddress = NodeAddress::new(0x0a00_0004);

    fn question(from: u32, correlation: u64, lasts_us: u32) -> Header {
        let tid = |node, app| Tid::new(node, AppAddress::new(app));
        let mut header = Header::new(Kind::named("test"), tid(HERE, from), tid(THERE, 0x1001));
        (header.correlation, header.time_to_live_us) = (correlation, lasts_us);
        header
    }

    fn is_answered(asked: &Asked, now: Time, question: &Header) -> bool {
        let mut reply = Header::new(question.kind, question.destination, question.source);
        reply.correlation = question.correlation;
        asked.take(now, &reply, question.source.app)
    }

    #[test]
    fn a_question_is_answered_once_by_whom_it_was_for_and_in_time() {
        let (asked, end) = (Asked::default(), Time::from_nanos(5_000));
        for (number, lasts) in [(1, 5), (2, 5), (3, 0), (4, 5)] {
            asked.note(Time::ZERO, &question(0x1000, number, lasts));
        }
        assert!(is_answered(&asked, end, &question(0x1000, 1, 0)));
        assert!(!is_answered(&asked, end, &question(0x1000, 1, 0)), "the second one");
        assert!(!is_answered(&asked, end + Duration::from_nanos(1), &question(0x1000, 2, 0)), "too late");
        assert!(is_answered(&asked, Time::ZERO + LONGEST, &question(0x1000, 3, 0)));
        let mut other = question(0x1000, 4, 0);
        other.destination.app = AppAddress::new(0x1002);
        assert!(!is_answered(&asked, end, &other), "somebody else was asked");
        asked.forget(AppAddress::new(0x1000));
        assert!(!is_answered(&asked, end, &question(0x1000, 4, 0)), "the application has gone");
    }

    #[test]
    fn whoever_asks_without_end_pushes_out_its_own_questions() {
        let asked = Asked::default();
        asked.note(Time::ZERO, &question(0x1000, 1, 1_000));
        // It is in the same part, and asks much more than there is room for.
        (0..20_000).for_each(|number| asked.note(Time::ZERO, &question(0x1010, number, 2_000)));
        let part = lock(asked.part(AppAddress::new(0x1000)));
        assert_eq!(part.by_end.len(), 1 + EACH_MAX);
        drop(part);
        assert!(is_answered(&asked, Time::ZERO, &question(0x1000, 1, 0)));
        // Many that do so, all in that part, are bounded, too.
        (0..10_u32).for_each(|app| {
            (0..2_000).for_each(|number| asked.note(Time::ZERO, &question(0x1020 + 16 * app, number, 0)));
        });
        let part = lock(asked.part(AppAddress::new(0x1000)));
        assert_eq!(part.by_end.len(), PART_MAX);
        assert_eq!(part.by_source.values().map(|source| source.until.len()).sum::<usize>(), PART_MAX);
    }
}
