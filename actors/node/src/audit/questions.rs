//! Sends audit questions to other nodes and answers theirs. Must not be called with a lock of the node held.

use std::sync::Weak;
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
    lock,
    outcome::Rejection,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Class, Header, Kind, Message},
};
use sinew_sync::FrameHandler;

use super::{
    answer_thread::{self, PendingAnswer},
    protocol::{self, ANSWER_BYTES_MAX},
    reading::{self, NodeAudit},
    system::Audit,
};
use crate::NodeState;

/// Maximum number of open questions, over all threads. A further question is refused.
const OPEN_MAX: usize = 16;
/// Maximum number of answers to one node per [`PERIOD`]; an audit asks twice. Further questions are refused,
/// and counted.
const ANSWERS_MAX: u32 = 16;
/// Maximum number of answers to all nodes per [`PERIOD`]: an answer of a node with many applications takes a
/// CPU for milliseconds.
const ANSWERS_ALL_MAX: u32 = 64;
const PERIOD: Duration = Duration::from_secs(1);
/// Maximum number of questions that this node sends per [`PERIOD`]; further ones wait. It is half of the
/// answer limit, because delays in transit can bunch the questions of two periods into one at the worst.
const ASKS_MAX: usize = 8;
/// Maximum bytes of unread answers to all questions. An answer that does not fit is dropped, and its node
/// counts as silent.
const UNREAD_BYTES_MAX: usize = 16 << 20;
/// Minimum bytes of an answer. If a node's longest payload is shorter than an answer, the answer is halved
/// until it fits or reaches this minimum.
const ANSWER_BYTES_MIN: usize = 1 << 10;

/// The open questions, and the nodes that were answered. This state outlives the sync manager.
#[derive(Default)]
pub(crate) struct Questions {
    open: Mutex<Open>,
    /// Bytes of unread answers.
    unread: Arc<AtomicUsize>,
    /// The pending questions of other nodes.
    pub(super) waiting: Mutex<PendingAnswer>,
}

#[derive(Default)]
struct Open {
    /// Number of the last question.
    last: u64,
    open: BTreeMap<u64, PendingAudit>,
    /// When questions were sent within the last [`PERIOD`], in order.
    asked: VecDeque<Time>,
    /// The nodes that asked lately: since when, and how often each was answered. At most one entry per linked node.
    requesters: BTreeMap<NodeAddress, (Time, u32)>,
}

struct PendingAudit {
    /// The nodes that have not answered.
    awaited: BTreeSet<NodeAddress>,
    answers: SyncSender<Answer>,
}

/// The answering node, and the bytes; the asking thread decodes them.
#[derive(Debug)]
struct Answer {
    from: NodeAddress,
    bytes: Bytes,
    _share: NodeAnswer,
}

/// The share of an answer in [`UNREAD_BYTES_MAX`], until it is dropped.
#[derive(Debug)]
struct NodeAnswer {
    unread: Arc<AtomicUsize>,
    bytes: usize,
}

impl NodeAnswer {
    fn of(unread: &Arc<AtomicUsize>, bytes: usize) -> Option<Self> {
        let grown = |unread: usize| unread.checked_add(bytes).filter(|sum| *sum <= UNREAD_BYTES_MAX);
        // SYNC: Relaxed; no other data depends on it.
        unread.fetch_update(Ordering::Relaxed, Ordering::Relaxed, grown).ok()?;
        Some(Self { unread: unread.clone(), bytes })
    }
}

impl Drop for NodeAnswer {
    fn drop(&mut self) {
        // SYNC: see `of`.
        self.unread.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

/// Too many questions are open, or were sent within the last period, for one more in its time.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct TooManyQuestionsError;

impl Questions {
    fn open(&self, awaited: BTreeSet<NodeAddress>) -> Result<(u64, Receiver<Answer>), TooManyQuestionsError> {
        let mut questions = lock(&self.open);
        if questions.open.len() >= OPEN_MAX {
            return Err(TooManyQuestionsError);
        }
        questions.last += 1;
        let number = questions.last;
        // Each of them answers once.
        let (answers, answered) = sync_channel(awaited.len());
        questions.open.insert(number, PendingAudit { awaited, answers });
        Ok((number, answered))
    }

    /// Takes a turn to send a question at `now`.
    ///
    /// # Errors
    /// Returns the time of the next turn.
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

    /// Accepts an answer if it is awaited; a late answer is dropped.
    ///
    /// # Errors
    /// Returns why the answer is awaited but dropped; its node counts as silent.
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
        let share = NodeAnswer::of(&self.unread, answer.len());
        let share = share
            .ok_or_else(|| format!("from {from}, an audit behind {UNREAD_BYTES_MAX} bytes that wait"))?;
        question.awaited.remove(&from);
        // A copy, so that it does not keep a longer buffer alive.
        let answer = Answer { from, bytes: Bytes::copy_from_slice(answer), _share: share };
        // The asking thread may have stopped waiting.
        let _ = question.answers.try_send(answer);
        Ok(())
    }

    /// Returns whether `requester` is answered at `now`.
    fn admits(&self, requester: NodeAddress, now: Time) -> bool {
        let requesters = &mut lock(&self.open).requesters;
        requesters.retain(|_, (since, _)| now.since(*since) < PERIOD);
        let answered: u32 = requesters.values().map(|(_, answered)| answered).sum();
        let (_, theirs) = requesters.entry(requester).or_insert((now, 0));
        let is_answered = *theirs < ANSWERS_MAX && answered < ANSWERS_ALL_MAX;
        *theirs += u32::from(is_answered);
        is_answered
    }
}

/// Returns the location of every message of the system, as far as these nodes and this one report within this time.
///
/// # Errors
/// Too many such questions are open; nothing changed.
pub(crate) fn audit(
    state: &NodeState,
    others: &BTreeSet<NodeAddress>,
    within: Duration,
) -> Result<Audit, TooManyQuestionsError> {
    let began = Time::now();
    let mut before = ask(state, others, within / 2)?;
    before.push(reading::read(state));
    let answered = before.iter().map(|node| node.node).filter(|node| *node != state.ctx.node).collect();
    // All nodes were read once before any node is read again.
    let mut after = vec![reading::read(state)];
    after.extend(ask(state, &answered, within.saturating_sub(Time::now().since(began)))?);
    Ok(Audit::of_readings(state.ctx.node, others, &before, after))
}

/// Returns the reports of the other nodes within this time, which includes the wait for a turn to ask them.
fn ask(
    state: &NodeState,
    others: &BTreeSet<NodeAddress>,
    within: Duration,
) -> Result<Vec<NodeAudit>, TooManyQuestionsError> {
    if others.is_empty() {
        return Ok(Vec::new());
    }
    let began = Time::now();
    while let Err(at) = state.questions.turn(Time::now()) {
        if at.since(began) >= within {
            return Err(TooManyQuestionsError);
        }
        thread::sleep(at.since(Time::now()));
    }
    let (number, answered) = state.questions.open(others.clone())?;
    // A node to which the question cannot be sent does not answer.
    let sent =
        |other: &&NodeAddress| send(state, **other, (Kind::SYNC_AUDIT_ASK, number), Bytes::new()).is_ok();
    let asked = others.iter().filter(sent).count();
    let mut answers = Vec::new();
    for _ in 0..asked {
        let left = within.saturating_sub(Time::now().since(began));
        let Ok(Answer { from, bytes, .. }) = answered.recv_timeout(left) else { break };
        match read(from, &bytes) {
            Ok(answer) => answers.push(answer),
            // A node that answers so counts as silent.
            Err(fault) => state.ctx.refusals.count(Time::now(), "audit", &fault),
        }
    }
    state.questions.close(number);
    Ok(answers)
}

/// The frames of audits, which travel to the sync manager's TID.
pub(crate) struct Frames(pub(crate) Weak<NodeState>);

impl FrameHandler for Frames {
    fn receive(&self, from: NodeAddress, message: &Message) -> Result<(), String> {
        self.0.upgrade().map_or(Ok(()), |state| receive(&state, from, message))
    }
}

/// Handles another node's question, or its answer. A refused question gets an empty answer, so that its
/// sender does not wait.
///
/// # Errors
/// Returns the reason if the message is invalid.
fn receive(state: &Arc<NodeState>, from: NodeAddress, message: &Message) -> Result<(), String> {
    let number = message.header.correlation;
    if message.header.kind != Kind::SYNC_AUDIT_ASK {
        return state.questions.answered(number, from, &message.payload);
    }
    let taken = if state.questions.admits(from, Time::now()) {
        answer_thread::queue_question(state, from, number)
    } else {
        Err(format!(
            "from {from}, more than {ANSWERS_MAX} questions for an audit in {PERIOD:?}, or of all more than {ANSWERS_ALL_MAX}"
        ))
    };
    taken.inspect_err(|_| refuse(state, from, number))
}

/// Notifies the asking node that there will be no answer.
fn refuse(state: &NodeState, to: NodeAddress, number: u64) {
    // If this cannot be sent, the asking node waits for its full timeout.
    let _ = send(state, to, (Kind::SYNC_AUDIT, number), Bytes::new());
}

/// Decodes the report that `from` sent about itself.
fn read(from: NodeAddress, answer: &Bytes) -> Result<NodeAudit, String> {
    if answer.is_empty() {
        return Err(format!(
            "{from} refuses the question: it answers {ANSWERS_MAX} in {PERIOD:?} at most, and none that has no room in \
             `node.payload_max` bytes, nor in {ANSWER_BYTES_MAX}"
        ));
    }
    let audit = protocol::read(answer).map_err(|error| format!("from {from}, {error}"))?;
    if audit.node == from { Ok(audit) } else { Err(format!("from {from}, an audit of {}", audit.node)) }
}

/// Answers a question of another node, or refuses it. An answer takes longer the more places the node has.
///
/// # Errors
/// Returns why it was not answered.
pub(super) fn answer(state: &NodeState, to: NodeAddress, number: u64) -> Result<(), String> {
    try_to_answer(state, to, number).inspect_err(|_| refuse(state, to, number))
}

fn try_to_answer(state: &NodeState, to: NodeAddress, number: u64) -> Result<(), String> {
    let (audit, mut bytes_max) = (reading::read(state), state.ctx.config.payload_max);
    loop {
        let bytes = protocol::write(&audit, bytes_max).ok_or("an audit has no room in an answer")?;
        let length = bytes.len();
        match send(state, to, (Kind::SYNC_AUDIT, number), bytes) {
            Ok(()) => return Ok(()),
            // The bound of that node.
            Err(Rejection::TooLong) if length > ANSWER_BYTES_MIN => bytes_max = length / 2,
            Err(why) => return Err(format!("an answer to {to}: {why}")),
        }
    }
}

fn send(
    state: &NodeState,
    to: NodeAddress,
    (kind, number): (Kind, u64),
    payload: Bytes,
) -> Result<(), Rejection> {
    let source = Tid::new(state.ctx.node, AppAddress::SYNC);
    let mut header = Header::new(kind, source, Tid::new(to, AppAddress::SYNC));
    // An answer is long and not urgent.
    header.class = Class::Bulk;
    header.correlation = number;
    header.sequence = lock(&state.sync.core).next_sequence();
    header.sent = Time::now();
    state.ctx.router.send(Message::new(header, payload))
}

#[cfg(test)]
mod tests {
    use super::*;
    use sinew_model::config::NodeConfig;
    use sinew_runtime::{
        router::{MessageSink, SubmitError},
        tid::Incarnation,
    };

    const OTHER: NodeAddress = NodeAddress::new(2);

    fn state() -> Arc<NodeState> {
        NodeState::for_test(NodeConfig::new("test"), Incarnation(1))
    }

    #[test]
    fn frequent_requester_is_refused_until_next_second() {
        let questions = Questions::default();
        let begin = Time::ZERO + PERIOD;
        assert!((0..ANSWERS_MAX).all(|_| questions.admits(OTHER, begin)));
        assert!(!questions.admits(OTHER, begin));
        assert!(questions.admits(NodeAddress::new(3), begin), "others are");
        assert!(questions.admits(OTHER, begin + PERIOD));
    }

    #[test]
    fn requester_that_waits_its_turn_is_always_answered() {
        let (here, there) = (Questions::default(), Questions::default());
        let (mut now, mut asked) = (Time::ZERO + PERIOD, 0);
        let end = now + 10 * PERIOD;
        while now < end {
            match here.turn(now) {
                Ok(()) => {
                    // Some requests are delayed in transit.
                    let delay = Duration::from_millis(333) * (asked % 3);
                    assert!(there.admits(OTHER, now + delay), "{asked}");
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
    fn total_answers_are_limited_per_second() {
        let questions = Questions::default();
        let begin = Time::ZERO + PERIOD;
        let asked = (0..1_000).map(|requester| questions.admits(NodeAddress::new(requester), begin));
        assert_eq!(asked.filter(|is_answered| *is_answered).count(), ANSWERS_ALL_MAX as usize);
        assert!(questions.admits(OTHER, begin + PERIOD));
    }

    #[test]
    fn questions_are_bounded_and_accept_one_answer() {
        let (questions, report) = (Questions::default(), Bytes::from_static(b"report"));
        let (number, answered) = questions.open(BTreeSet::from([OTHER])).unwrap();
        questions.answered(number, NodeAddress::new(3), &report).unwrap();
        questions.answered(number + 1, OTHER, &report).unwrap();
        assert!(answered.try_recv().is_err());
        questions.answered(number, OTHER, &report).unwrap();
        questions.answered(number, OTHER, &report).unwrap();
        let answer = answered.try_recv().unwrap();
        assert_eq!((answer.from, answer.bytes), (OTHER, report));
        assert!(answered.try_recv().is_err());
        for _ in 1..OPEN_MAX {
            questions.open(BTreeSet::new()).unwrap();
        }
        assert_eq!(questions.open(BTreeSet::new()).err(), Some(TooManyQuestionsError));
        questions.close(number);
        assert!(questions.open(BTreeSet::new()).is_ok());
    }

    #[test]
    fn unread_answers_are_bounded_each_and_in_total() {
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

    /// An outlet to another node: it keeps sent messages, and answers each question with an empty answer.
    struct Refusing {
        state: Arc<NodeState>,
        sent: Mutex<Vec<(Kind, u64, Bytes)>>,
    }

    impl MessageSink for Refusing {
        fn submit(&self, message: Message) -> Result<(), SubmitError> {
            let Header { kind, correlation, .. } = message.header;
            if kind == Kind::SYNC_AUDIT_ASK {
                self.state.questions.answered(correlation, OTHER, &Bytes::new()).unwrap();
            }
            lock(&self.sent).push((kind, correlation, message.payload));
            Ok(())
        }
    }

    fn refusing(state: &Arc<NodeState>) -> Arc<Refusing> {
        let other = Arc::new(Refusing { state: state.clone(), sent: Mutex::default() });
        state.ctx.router.set_peer(OTHER, other.clone());
        other
    }

    #[test]
    fn refused_question_gets_empty_answer_at_once() {
        // Given
        let state = state();
        let other = refusing(&state);
        let source = Tid::new(OTHER, AppAddress::SYNC);
        let mut header =
            Header::new(Kind::SYNC_AUDIT_ASK, source, Tid::new(state.ctx.node, AppAddress::SYNC));
        header.correlation = 7;
        let question = Message::new(header, Bytes::new());
        let now = Time::now() + Duration::from_secs(3_600);
        assert!(
            (0..ANSWERS_ALL_MAX)
                .all(|requester| state.questions.admits(NodeAddress::new(requester + 9), now))
        );
        // When
        assert!(receive(&state, OTHER, &question).is_err());
        // Then
        assert_eq!(*lock(&other.sent), [(Kind::SYNC_AUDIT, 7, Bytes::new())]);
        // And: a node without room for an answer
        let no_room =
            NodeState::for_test(NodeConfig { payload_max: 8, ..NodeConfig::new("test") }, Incarnation(1));
        let other_there = refusing(&no_room);
        assert!(answer(&no_room, OTHER, 8).is_err());
        assert_eq!(*lock(&other_there.sent), [(Kind::SYNC_AUDIT, 8, Bytes::new())]);
        // And: at the other end
        let audit = audit(&state, &BTreeSet::from([OTHER]), Duration::from_secs(3_600)).unwrap();
        assert_eq!((audit.silent, audit.nodes.len()), (vec![OTHER], 1));
    }

    /// An outlet to a node without audits: its sync manager drops the question.
    struct NoAnswer;

    impl MessageSink for NoAnswer {
        fn submit(&self, _: Message) -> Result<(), SubmitError> {
            Ok(())
        }
    }

    #[test]
    fn node_without_audits_counts_as_silent() {
        let state = state();
        state.ctx.router.set_peer(OTHER, Arc::new(NoAnswer));
        let audit = audit(&state, &BTreeSet::from([OTHER]), Duration::from_millis(20)).unwrap();
        assert_eq!((audit.silent, audit.nodes.len(), audit.unexplained.len()), (vec![OTHER], 1, 0));
    }

    #[test]
    fn unreachable_node_counts_as_silent_without_delay() {
        let state = state();
        let audit = audit(&state, &BTreeSet::from([OTHER]), Duration::from_secs(3_600)).unwrap();
        assert_eq!((audit.silent, audit.nodes.len()), (vec![OTHER], 1));
    }
}
