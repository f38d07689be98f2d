//! What applications of this node have asked for: the reply to that comes to them whatever the rules say.
//!
//! A note is taken by the first message that is a reply to it. What is flagged as a reply and answers nothing is a message as any other,
//! or else the flag would be a way past the list.
//!
//! Guests, users whom the access list lets in, have places of their own beside those of the robot's own: neither push out the other's.

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
/// Notes of the robot's own in one part at most; of more those that end first go.
const PART_MAX: usize = 4_096;
/// Notes of all guests in one part at most, beside those; of more those of guests that end first go. Half as many, as guests have half of
/// the places that there are for applications.
const GUESTS_MAX: usize = PART_MAX / 2;
/// Notes of one application of the robot's own at most, and in one part of all applications of one guest user; of more its own go that end
/// first. As many as an application can wait for, unless its mailbox was made larger.
const EACH_MAX: usize = 1_024;
/// How long a note is kept of a question that says no time to live: the longest that one can say, 71 minutes.
const LONGEST: Duration = Duration::from_micros(u32::MAX as u64);

/// Questions of this node's applications that were not answered yet.
#[derive(Debug, Default)]
pub(super) struct Asked([Mutex<Part>; PARTS]);

#[derive(Debug, Default)]
struct Part {
    /// The applications of guests that are here, and their users. As many as may be registered: who notes looks here, under the lock that it
    /// has in any case.
    guests: BTreeMap<AppAddress, u32>,
    of_own: Notes,
    of_guests: Notes,
}

/// Some notes, which make room for each other and for none else.
#[derive(Debug, Default)]
struct Notes {
    by_asker: BTreeMap<Asker, Share>,
    by_end: BTreeSet<(Time, Asker, Question)>,
}

/// Who has a share of notes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Asker {
    /// One application of the robot's own.
    App(AppAddress),
    /// All applications of this user, a guest.
    User(u32),
}

#[derive(Debug, Default)]
struct Share {
    until: BTreeMap<Question, Time>,
    by_end: BTreeSet<(Time, Question)>,
}

/// Ordered by who asks: one application's questions stand together.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Question {
    source: AppAddress,
    /// Who was asked.
    target: Tid,
    /// The number of the question.
    number: u64,
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
        let (source, target, number) = (question.source.app, question.destination, question.correlation);
        lock(self.part(source)).note(now, Question { source, target, number }, now + lasts);
    }

    /// Whether `reply` answers a question of the application at `target`; the next one does not.
    pub(super) fn take(&self, now: Time, reply: &Header, target: AppAddress) -> bool {
        let question = Question { source: target, target: reply.source, number: reply.correlation };
        let until = lock(self.part(target)).remove(question);
        until.is_some_and(|until| now <= until)
    }

    /// A guest, of `uid`, has this address; said before it can ask anything.
    pub(super) fn guest_came(&self, source: AppAddress, uid: u32) {
        let mut part = lock(self.part(source));
        part.forget(source);
        part.guests.insert(source, uid);
    }

    /// The application at `source` has gone: whoever has its address next has asked nothing, and is no guest until that is said.
    pub(super) fn forget(&self, source: AppAddress) {
        let mut part = lock(self.part(source));
        part.forget(source);
        part.guests.remove(&source);
    }
}

impl Part {
    /// Where the notes of this application are, whose share they are of, and how many there may be of all there.
    fn place_of(&mut self, source: AppAddress) -> (&mut Notes, Asker, usize) {
        match self.guests.get(&source) {
            Some(uid) => (&mut self.of_guests, Asker::User(*uid), GUESTS_MAX),
            None => (&mut self.of_own, Asker::App(source), PART_MAX),
        }
    }

    fn note(&mut self, now: Time, question: Question, until: Time) {
        let (notes, asker, max) = self.place_of(question.source);
        notes.remove(asker, question);
        notes.make_room(now, asker, max);
        notes.insert(asker, question, until);
    }

    fn remove(&mut self, question: Question) -> Option<Time> {
        let (notes, asker, _) = self.place_of(question.source);
        notes.remove(asker, question)
    }

    fn forget(&mut self, source: AppAddress) {
        let (notes, asker, _) = self.place_of(source);
        notes.forget(asker, source);
    }
}

impl Notes {
    /// Room for one more of `asker`, and for one more of all, of whom there are `max` at most.
    fn make_room(&mut self, now: Time, asker: Asker, max: usize) {
        let share = self.by_asker.get(&asker).filter(|share| share.until.len() >= EACH_MAX);
        if let Some((_, first)) = share.and_then(|share| share.by_end.first().copied()) {
            self.remove(asker, first);
        }
        while let Some((end, of, which)) = self.by_end.first().copied()
            && (end < now || self.by_end.len() >= max)
        {
            self.remove(of, which);
        }
    }

    fn insert(&mut self, asker: Asker, question: Question, until: Time) {
        let share = self.by_asker.entry(asker).or_default();
        share.until.insert(question, until);
        share.by_end.insert((until, question));
        self.by_end.insert((until, asker, question));
    }

    fn remove(&mut self, asker: Asker, question: Question) -> Option<Time> {
        let share = self.by_asker.get_mut(&asker)?;
        let until = share.until.remove(&question)?;
        share.by_end.remove(&(until, question));
        if share.until.is_empty() {
            self.by_asker.remove(&asker);
        }
        self.by_end.remove(&(until, asker, question));
        Some(until)
    }

    /// Removes what `source` has asked, of the share that may be others', too.
    fn forget(&mut self, asker: Asker, source: AppAddress) {
        let Some(share) = self.by_asker.get(&asker) else { return };
        let first = Question { source, target: Tid::from_bits(0), number: 0 };
        let of_source = share.until.range(first..).map(|(question, _)| *question);
        let asked: Vec<_> = of_source.take_while(|question| question.source == source).collect();
        for question in asked {
            self.remove(asker, question);
        }
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
        assert_eq!(part.of_own.by_end.len(), 1 + EACH_MAX);
        drop(part);
        assert!(is_answered(&asked, Time::ZERO, &question(0x1000, 1, 0)));
        // Many that do so, all in that part, are bounded, too.
        (0..10_u32).for_each(|app| {
            (0..2_000).for_each(|number| asked.note(Time::ZERO, &question(0x1020 + 16 * app, number, 0)));
        });
        let part = lock(asked.part(AppAddress::new(0x1000)));
        assert_eq!(counts(&part.of_own), [PART_MAX; 3]);
    }

    /// How many notes there are: by who asks, by their ends, and of each by their ends.
    fn counts(notes: &Notes) -> [usize; 3] {
        let of_each = |count: fn(&Share) -> usize| -> usize { notes.by_asker.values().map(count).sum() };
        [of_each(|share| share.until.len()), notes.by_end.len(), of_each(|share| share.by_end.len())]
    }

    /// Applications that are all in the part of 0x1000, and their users.
    const GUESTS: [(u32, u32); 6] =
        [(0x1010, 1), (0x1020, 2), (0x1030, 3), (0x1040, 4), (0x1050, 5), (0x1060, 5)];

    fn with_guests() -> Asked {
        let asked = Asked::default();
        GUESTS.into_iter().for_each(|(app, uid)| asked.guest_came(AppAddress::new(app), uid));
        asked
    }

    /// The application asks `count` questions that end later than all others.
    fn asks_without_end(asked: &Asked, app: u32, count: u64) {
        (1_000..1_000 + count).for_each(|number| asked.note(Time::ZERO, &question(app, number, 2_000_000)));
    }

    #[test]
    fn guests_who_ask_all_they_may_push_out_no_question_of_the_robots_own() {
        // Given: a question of the robot's own, which ends before all others
        let asked = with_guests();
        asked.note(Time::ZERO, &question(0x1000, 1, 1_000));
        // When: five guest users ask more than the part has room for
        GUESTS.into_iter().for_each(|(app, _)| asks_without_end(&asked, app, 2_000));
        // Then: it is answered, and so is the next one
        asked.note(Time::ZERO, &question(0x1000, 2, 1_000));
        assert_eq!(counts(&lock(asked.part(AppAddress::new(0x1000))).of_guests), [GUESTS_MAX; 3]);
        let is_answered = |number| is_answered(&asked, Time::ZERO, &question(0x1000, number, 0));
        assert!(is_answered(1) && is_answered(2));
    }

    #[test]
    fn the_robots_own_who_ask_all_they_may_push_out_no_question_of_a_guest() {
        // Given
        let asked = with_guests();
        asked.note(Time::ZERO, &question(GUESTS[0].0, 1, 1_000));
        // When: five of the robot's own ask more than the part has room for
        (0..5).for_each(|app| asks_without_end(&asked, 0x2000 + 16 * app, 2_000));
        // Then: it is answered, and so is the next one
        asked.note(Time::ZERO, &question(GUESTS[0].0, 2, 1_000));
        assert_eq!(counts(&lock(asked.part(AppAddress::new(0x1000))).of_own), [PART_MAX; 3]);
        let is_answered = |number| is_answered(&asked, Time::ZERO, &question(GUESTS[0].0, number, 0));
        assert!(is_answered(1) && is_answered(2));
    }

    #[test]
    fn applications_of_one_guest_user_have_one_share_and_another_users_questions_stay() {
        // Given: a question of another user, and one of each of two applications of one user, all in one part
        let asked = with_guests();
        [GUESTS[0].0, 0x1050, 0x1060].into_iter().for_each(|app| {
            asked.note(Time::ZERO, &question(app, 1, 1_000));
        });
        // When: one of these two asks all that the user may
        asks_without_end(&asked, 0x1050, EACH_MAX as u64);
        // Then: that pushed out what its user had asked before, and nothing else
        let is_answered = |app, number| is_answered(&asked, Time::ZERO, &question(app, number, 0));
        assert_eq!(counts(&lock(asked.part(AppAddress::new(0x1000))).of_guests), [EACH_MAX + 1; 3]);
        assert!(is_answered(GUESTS[0].0, 1) && !is_answered(0x1050, 1) && !is_answered(0x1060, 1));
    }

    #[test]
    fn a_guest_that_has_gone_takes_its_own_questions_along_and_leaves_its_address_to_anybody() {
        // Given: two applications of one guest user
        let asked = with_guests();
        [0x1050, 0x1060].into_iter().for_each(|app| asks_without_end(&asked, app, 2));
        // When
        asked.forget(AppAddress::new(0x1050));
        // Then: the other one's are answered, though the share is one
        let is_answered = |app, number| is_answered(&asked, Time::ZERO, &question(app, number, 0));
        assert!(!is_answered(0x1050, 1_000) && is_answered(0x1060, 1_000));
        // And: who has the address next is one of the robot's own, until it is said that it is a guest
        asks_without_end(&asked, 0x1050, 3);
        assert_eq!(counts(&lock(asked.part(AppAddress::new(0x1000))).of_own), [3; 3]);
        asked.guest_came(AppAddress::new(0x1050), 5);
        assert!(!is_answered(0x1050, 1_000), "a guest is told nothing that its predecessor has asked");
        GUESTS.into_iter().for_each(|(app, _)| asked.forget(AppAddress::new(app)));
        let part = lock(asked.part(AppAddress::new(0x1000)));
        assert_eq!((part.guests.len(), counts(&part.of_own), counts(&part.of_guests)), (0, [0; 3], [0; 3]));
    }
}
