//! Asks other nodes, and answers them. Not for who holds a lock of the node's.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread,
    time::Duration,
};

use bytes::Bytes;
use sinew_runtime::{
    outcome::Rejection,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Class, Header, Kind, Message},
};

use super::{
    answering::{self, Waiting},
    reading::{self, NodeAudit},
    system::Audit,
    words::{self, ANSWER_BYTES_MAX},
};
use crate::stores::{Stores, lock};

/// Questions at most that are open at once, from all threads. A further one is refused.
const OPEN_MAX: usize = 16;
/// A node is answered so often at most in [`PERIOD`], which an audit asks twice; further questions are refused, and counted.
const ANSWERS_MAX: u32 = 16;
/// All of them together so often: an answer of a node with many applications takes a CPU for milliseconds.
const ANSWERS_ALL_MAX: u32 = 64;
const PERIOD: Duration = Duration::from_secs(1);
/// This node asks so often in [`PERIOD`], and waits for its turn else. Half as often as it is answered: questions that wait on the way come
/// closer to each other than they were asked, those of two periods in one at the worst.
const ASKS_MAX: usize = 8;
/// Bytes at most of answers that nobody has read yet, to all questions together. What finds no room is not kept, and its node counts as silent.
const UNREAD_BYTES_MAX: usize = 16 << 20;
/// Of a node whose longest payload is shorter than an answer: it is tried with half so many bytes, down to this.
const ANSWER_BYTES_MIN: usize = 1 << 10;

/// Which questions are open, and who was answered. It outlives the sync manager.
#[derive(Default)]
pub(crate) struct Questions {
    open: Mutex<Open>,
    /// Bytes of answers that nobody has read yet.
    unread: Arc<AtomicUsize>,
    /// Those of other nodes.
    pub(super) waiting: Mutex<Waiting>,
}

#[derive(Default)]
struct Open {
    /// Number of the last question.
    last: u64,
    open: BTreeMap<u64, Question>,
    /// When it was asked within the last [`PERIOD`], in turn.
    asked: VecDeque<Time>,
    /// Who asked lately: since when, and how often it was answered. Of each node that is linked one at most.
    askers: BTreeMap<NodeAddress, (Time, u32)>,
}

struct Question {
    /// Who has not answered.
    awaited: BTreeSet<NodeAddress>,
    answers: SyncSender<Answer>,
}

/// Who answers, and the bytes; whoever has asked reads them, on his own thread.
#[derive(Debug)]
struct Answer {
    from: NodeAddress,
    bytes: Bytes,
    _share: Share,
}

/// What an answer takes of [`UNREAD_BYTES_MAX`], until it is dropped.
#[derive(Debug)]
struct Share {
    unread: Arc<AtomicUsize>,
    bytes: usize,
}

impl Share {
    fn of(unread: &Arc<AtomicUsize>, bytes: usize) -> Option<Self> {
        let grown = |unread: usize| unread.checked_add(bytes).filter(|sum| *sum <= UNREAD_BYTES_MAX);
        // SYNC: Relaxed; nothing else depends on it.
        unread.fetch_update(Ordering::Relaxed, Ordering::Relaxed, grown).ok()?;
        Some(Self { unread: unread.clone(), bytes })
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        // SYNC: see `of`.
        self.unread.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

/// Too many questions are open, or were asked lately for one more within its time.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct TooManyQuestions;

impl Questions {
    fn open(&self, awaited: BTreeSet<NodeAddress>) -> Result<(u64, Receiver<Answer>), TooManyQuestions> {
        let mut questions = lock(&self.open);
        if questions.open.len() >= OPEN_MAX {
            return Err(TooManyQuestions);
        }
        questions.last += 1;
        let number = questions.last;
        // Each of them answers once.
        let (answers, answered) = sync_channel(awaited.len());
        questions.open.insert(number, Question { awaited, answers });
        Ok((number, answered))
    }

    /// Takes a turn to ask at `now`.
    ///
    /// # Errors
    /// When there is one.
    fn turn(&self, now: Time) -> Result<(), Time> {
        let asked = &mut lock(&self.open).asked;
        while asked.front().is_some_and(|at| now.since(*at) >= PERIOD) {
            asked.pop_front();
        }
        match asked.front() {
            Some(first) if asked.len() >= ASKS_MAX => Err(*first + PERIOD),
            Some(_) | None => {
                asked.push_back(now);
                Ok(())
            }
        }
    }

    fn close(&self, number: u64) {
        lock(&self.open).open.remove(&number);
    }

    /// Takes an answer, if it is awaited; a late one is nobody's.
    ///
    /// # Errors
    /// It is awaited and not kept, and its node counts as silent; why, in words.
    fn answered(&self, number: u64, from: NodeAddress, answer: &Bytes) -> Result<(), String> {
        let mut questions = lock(&self.open);
        let question = questions.open.get_mut(&number).filter(|question| question.awaited.contains(&from));
        let Some(question) = question else { return Ok(()) };
        if answer.len() > ANSWER_BYTES_MAX {
            return Err(format!(
                "from {from}, an audit of {} bytes; {ANSWER_BYTES_MAX} are read at most",
                answer.len()
            ));
        }
        let share = Share::of(&self.unread, answer.len());
        let share = share
            .ok_or_else(|| format!("from {from}, an audit behind {UNREAD_BYTES_MAX} bytes that wait"))?;
        question.awaited.remove(&from);
        // A copy, so that it holds no longer buffer.
        let answer = Answer { from, bytes: Bytes::copy_from_slice(answer), _share: share };
        // Whoever asked may wait no more.
        let _ = question.answers.try_send(answer);
        Ok(())
    }

    /// Whether `asker` is answered at `now`.
    fn admits(&self, asker: NodeAddress, now: Time) -> bool {
        let askers = &mut lock(&self.open).askers;
        askers.retain(|_, (since, _)| now.since(*since) < PERIOD);
        let answered: u32 = askers.values().map(|(_, answered)| answered).sum();
        let (_, theirs) = askers.entry(asker).or_insert((now, 0));
        let is_answered = *theirs < ANSWERS_MAX && answered < ANSWERS_ALL_MAX;
        *theirs += u32::from(is_answered);
        is_answered
    }
}

/// Where every message of the system is, as far as these nodes and this one say within this time.
///
/// # Errors
/// Too many such questions are open; nothing changed.
pub(crate) fn audit(
    stores: &Stores,
    others: &BTreeSet<NodeAddress>,
    within: Duration,
) -> Result<Audit, TooManyQuestions> {
    let began = Time::now();
    let mut before = ask(stores, others, within / 2)?;
    before.push(reading::read(stores));
    let answered = before.iter().map(|node| node.node).filter(|node| *node != stores.node).collect();
    // All were read once before any is read again.
    let mut after = vec![reading::read(stores)];
    after.extend(ask(stores, &answered, within.saturating_sub(Time::now().since(began)))?);
    Ok(Audit::of_readings(stores.node, others, &before, after))
}

/// What the others say of themselves within this time, and the wait for a turn to ask them.
fn ask(
    stores: &Stores,
    others: &BTreeSet<NodeAddress>,
    within: Duration,
) -> Result<Vec<NodeAudit>, TooManyQuestions> {
    if others.is_empty() {
        return Ok(Vec::new());
    }
    let began = Time::now();
    while let Err(at) = stores.questions.turn(Time::now()) {
        if at.since(began) >= within {
            return Err(TooManyQuestions);
        }
        thread::sleep(at.since(Time::now()));
    }
    let (number, answered) = stores.questions.open(others.clone())?;
    // One that cannot be sent to does not answer.
    let sent =
        |other: &&NodeAddress| say(stores, **other, (Kind::SYNC_AUDIT_ASK, number), Bytes::new()).is_ok();
    let asked = others.iter().filter(sent).count();
    let mut answers = Vec::new();
    for _ in 0..asked {
        let left = within.saturating_sub(Time::now().since(began));
        let Ok(Answer { from, bytes, .. }) = answered.recv_timeout(left) else { break };
        match read(from, &bytes) {
            Ok(answer) => answers.push(answer),
            // Who answers so counts as silent.
            Err(fault) => stores.refusals.count(Time::now(), "audit", &fault),
        }
    }
    stores.questions.close(number);
    Ok(answers)
}

/// Takes another node's question, or its answer. A question that is not answered is refused with an empty answer, so that nobody waits for one.
///
/// # Errors
/// What is wrong with it, in words.
pub(crate) fn receive(stores: &Arc<Stores>, from: NodeAddress, message: &Message) -> Result<(), String> {
    let number = message.header.correlation;
    if message.header.kind != Kind::SYNC_AUDIT_ASK {
        return stores.questions.answered(number, from, &message.payload);
    }
    let taken = if stores.questions.admits(from, Time::now()) {
        answering::have_answered(stores, from, number)
    } else {
        Err(format!(
            "from {from}, more than {ANSWERS_MAX} questions for an audit in {PERIOD:?}, or of all more than {ANSWERS_ALL_MAX}"
        ))
    };
    taken.inspect_err(|_| refuse(stores, from, number))
}

/// Tells who has asked that there will be no answer.
fn refuse(stores: &Stores, to: NodeAddress, number: u64) {
    // One who cannot be told waits as long as he said.
    let _ = say(stores, to, (Kind::SYNC_AUDIT, number), Bytes::new());
}

/// What `from` says of itself.
fn read(from: NodeAddress, answer: &Bytes) -> Result<NodeAudit, String> {
    if answer.is_empty() {
        return Err(format!(
            "{from} refuses the question: it answers {ANSWERS_MAX} in {PERIOD:?} at most, and none that has no room in \
             `node.payload_max` bytes, nor in {ANSWER_BYTES_MAX}"
        ));
    }
    let said = words::read(answer).map_err(|error| format!("from {from}, {error}"))?;
    if said.node == from { Ok(said) } else { Err(format!("from {from}, an audit of {}", said.node)) }
}

/// Answers a question of another node, which takes the longer the more places there are, or refuses it.
///
/// # Errors
/// It was not answered; why, in words.
pub(super) fn answer(stores: &Stores, to: NodeAddress, number: u64) -> Result<(), String> {
    try_to_answer(stores, to, number).inspect_err(|_| refuse(stores, to, number))
}

fn try_to_answer(stores: &Stores, to: NodeAddress, number: u64) -> Result<(), String> {
    let (audit, mut bytes_max) = (reading::read(stores), stores.config.payload_max);
    loop {
        let bytes = words::write(&audit, bytes_max).ok_or("an audit has no room in an answer")?;
        let length = bytes.len();
        match say(stores, to, (Kind::SYNC_AUDIT, number), bytes) {
            Ok(()) => return Ok(()),
            // That node's own bound.
            Err(Rejection::TooLong) if length > ANSWER_BYTES_MIN => bytes_max = length / 2,
            Err(why) => return Err(format!("an answer to {to}: {why}")),
        }
    }
}

fn say(
    stores: &Stores,
    to: NodeAddress,
    (kind, number): (Kind, u64),
    payload: Bytes,
) -> Result<(), Rejection> {
    let source = Tid::new(stores.node, AppAddress::SYNC);
    let mut header = Header::new(kind, source, Tid::new(to, AppAddress::SYNC));
    // An answer is long, and nothing more urgent waits for it.
    header.class = Class::Bulk;
    header.correlation = number;
    header.sequence = lock(&stores.sync).next_sequence();
    header.sent = Time::now();
    stores.router.send(Message::new(header, payload))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::NodeConfig;
    use sinew_runtime::{
        router::{Outlet, Refused},
        tid::Incarnation,
    };

    const OTHER: NodeAddress = NodeAddress::new(2);

    fn stores() -> Arc<Stores> {
        Stores::for_test(NodeConfig::new("test"), Incarnation(1))
    }

    #[test]
    fn who_asks_too_often_is_not_answered_until_a_second_is_over() {
        let questions = Questions::default();
        let begin = Time::ZERO + PERIOD;
        assert!((0..ANSWERS_MAX).all(|_| questions.admits(OTHER, begin)));
        assert!(!questions.admits(OTHER, begin));
        assert!(questions.admits(NodeAddress::new(3), begin), "others are");
        assert!(questions.admits(OTHER, begin + PERIOD));
    }

    #[test]
    fn who_asks_waits_for_his_turn_and_so_is_answered_each_time() {
        let (here, there) = (Questions::default(), Questions::default());
        let (mut now, mut asked) = (Time::ZERO + PERIOD, 0);
        let end = now + 10 * PERIOD;
        while now < end {
            match here.turn(now) {
                Ok(()) => {
                    // Some wait on the way.
                    let on_the_way = Duration::from_millis(333) * (asked % 3);
                    assert!(there.admits(OTHER, now + on_the_way), "{asked}");
                    asked += 1;
                }
                Err(at) => {
                    assert!(at > now && at <= now + PERIOD);
                    now = at;
                }
            }
        }
        assert_eq!(asked as usize, 10 * ASKS_MAX);
    }

    #[test]
    fn all_together_are_answered_so_often_and_no_more_until_a_second_is_over() {
        let questions = Questions::default();
        let begin = Time::ZERO + PERIOD;
        let asked = (0..1_000).map(|asker| questions.admits(NodeAddress::new(asker), begin));
        assert_eq!(asked.filter(|is_answered| *is_answered).count(), ANSWERS_ALL_MAX as usize);
        assert!(questions.admits(OTHER, begin + PERIOD));
    }

    #[test]
    fn questions_are_bounded_and_an_answer_counts_once_and_from_whom_was_asked() {
        let (questions, said) = (Questions::default(), Bytes::from_static(b"said"));
        let (number, answered) = questions.open(BTreeSet::from([OTHER])).unwrap();
        questions.answered(number, NodeAddress::new(3), &said).unwrap();
        questions.answered(number + 1, OTHER, &said).unwrap();
        assert!(answered.try_recv().is_err());
        questions.answered(number, OTHER, &said).unwrap();
        questions.answered(number, OTHER, &said).unwrap();
        let answer = answered.try_recv().unwrap();
        assert_eq!((answer.from, answer.bytes), (OTHER, said));
        assert!(answered.try_recv().is_err());
        for _ in 1..OPEN_MAX {
            questions.open(BTreeSet::new()).unwrap();
        }
        assert_eq!(questions.open(BTreeSet::new()).err(), Some(TooManyQuestions));
        questions.close(number);
        assert!(questions.open(BTreeSet::new()).is_ok());
    }

    #[test]
    fn an_answer_is_kept_up_to_its_longest_and_all_that_nobody_has_read_up_to_a_bound() {
        let questions = Questions::default();
        let nodes: Vec<_> = (0..100).map(NodeAddress::new).collect();
        let (number, answered) = questions.open(nodes.iter().copied().collect()).unwrap();
        let (longest, longer) = (vec![0; ANSWER_BYTES_MAX].into(), vec![0; ANSWER_BYTES_MAX + 1].into());
        assert!(questions.answered(number, nodes[0], &longer).is_err());
        let room = UNREAD_BYTES_MAX / ANSWER_BYTES_MAX;
        let kept = nodes.iter().filter(|node| questions.answered(number, **node, &longest).is_ok());
        assert_eq!(kept.count(), room);
        drop(answered.recv().unwrap());
        assert!(questions.answered(number, nodes[room], &longest).is_ok(), "one was read");
        questions.close(number);
        drop(answered);
        assert_eq!(questions.unread.load(Ordering::Relaxed), 0);
    }

    /// The way to another node: it keeps what is to go there, and answers a question with nothing.
    struct Refusing {
        stores: Arc<Stores>,
        said: Mutex<Vec<(Kind, u64, Bytes)>>,
    }

    impl Outlet for Refusing {
        fn submit(&self, message: Message) -> Result<(), Refused> {
            let Header { kind, correlation, .. } = message.header;
            if kind == Kind::SYNC_AUDIT_ASK {
                self.stores.questions.answered(correlation, OTHER, &Bytes::new()).unwrap();
            }
            lock(&self.said).push((kind, correlation, message.payload));
            Ok(())
        }
    }

    fn refusing(stores: &Arc<Stores>) -> Arc<Refusing> {
        let other = Arc::new(Refusing { stores: stores.clone(), said: Mutex::default() });
        stores.router.set_peer(OTHER, other.clone());
        other
    }

    #[test]
    fn who_is_refused_an_answer_is_told_and_does_not_wait_for_it() {
        // Given
        let stores = stores();
        let other = refusing(&stores);
        let source = Tid::new(OTHER, AppAddress::SYNC);
        let mut header = Header::new(Kind::SYNC_AUDIT_ASK, source, Tid::new(stores.node, AppAddress::SYNC));
        header.correlation = 7;
        let question = Message::new(header, Bytes::new());
        let now = Time::now() + Duration::from_secs(3_600);
        assert!((0..ANSWERS_ALL_MAX).all(|asker| stores.questions.admits(NodeAddress::new(asker + 9), now)));
        // When
        assert!(receive(&stores, OTHER, &question).is_err());
        // Then
        assert_eq!(*lock(&other.said), [(Kind::SYNC_AUDIT, 7, Bytes::new())]);
        // And: one that has no room for an answer
        let no_room =
            Stores::for_test(NodeConfig { payload_max: 8, ..NodeConfig::new("test") }, Incarnation(1));
        let other_there = refusing(&no_room);
        assert!(answer(&no_room, OTHER, 8).is_err());
        assert_eq!(*lock(&other_there.said), [(Kind::SYNC_AUDIT, 8, Bytes::new())]);
        // And: at the other end
        let audit = audit(&stores, &BTreeSet::from([OTHER]), Duration::from_secs(3_600)).unwrap();
        assert_eq!((audit.silent, audit.nodes.len()), (vec![OTHER], 1));
    }

    #[test]
    fn a_node_that_cannot_be_reached_is_silent_and_costs_no_time() {
        let stores = stores();
        let audit = audit(&stores, &BTreeSet::from([OTHER]), Duration::from_secs(3_600)).unwrap();
        assert_eq!((audit.silent, audit.nodes.len()), (vec![OTHER], 1));
    }
}
