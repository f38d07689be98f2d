//! What must hold, whatever the scenario. The judge knows the truth and the network, and of a core what it sends and says.
//!
//! 1. No false loss: who is called silent did not answer `missed_max` questions in a row, each of which had half a
//!    period, at each address where it has answered since it was found. An answer counts from when it is in the asker's socket: that it
//!    was not read yet is the asker's own stall.
//! 2. A loss is seen within `missed_max` plus one periods of the last sign, and the asker's own stalls; by one whose timer is always late within
//!    [`Plan::silence_max`].
//! 3. A goodbye counts when it is heard, and is said to everybody who is known.
//! 4. A life that ended never comes back after its loss or its goodbye, a former life never after a later one.
//! 5. Found and lost alternate. Refused, left and restarted are said of lives that ended.
//! 6. A clock is as far from ours as is said, within the bound that is said.
//! 7. A stall of one's own is reported.
//! 8. A loss by silence is classed as what has been so for long: hung, crashed, or out of reach with its host.
//! 9. No loss by silence while the connection delivers, nor for as long after that, or after a question of the other's, as answers may be missed.
//! 10. When the network is well again, everybody knows exactly who is there, and a way there in each network.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    net::SocketAddr,
    time::Duration,
};

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::plan::Plan;
use crate::{
    clocks::ClockOffset,
    ndl::{LossReason, core::Host},
};

/// Questions to one address of which the judge knows when they were asked.
const QUESTIONS_KEPT: usize = 64;
/// What clocks and rounding add to a period, for each period: drifts are below 100 ppm.
const DRIFT_PER_MILLE: u32 = 1;

/// A question, and whether its answer has been in the asker's socket.
struct Question {
    correlation: u64,
    asked: Time,
    is_answered: bool,
    /// Within a period; a core that has asked often since takes a later answer for none.
    is_answered_in_time: bool,
}

/// What one process has of another one.
struct Sight {
    is_member: bool,
    /// It ended before its loss, or its goodbye was heard: it cannot come back.
    is_over: bool,
    /// The last answer within a period of its question: when it was in the socket.
    answered: Time,
    /// Where it answered so since it was found.
    places: BTreeSet<SocketAddr>,
    /// The last sign of life that was read.
    read: Time,
    /// The last time that anything of it was read, a question to all too.
    heard: Time,
    /// The last one that was read on a connection.
    sign: Option<Time>,
}

struct Life {
    node: NodeAddress,
    incarnation: Incarnation,
    /// One in each network.
    addresses: Vec<SocketAddr>,
    ended: Option<Time>,
    sights: BTreeMap<usize, Sight>,
    questions: BTreeMap<SocketAddr, VecDeque<Question>>,
    newest: BTreeMap<NodeAddress, Incarnation>,
    /// When it got no processor, and for how long.
    stalls: Vec<(Time, Duration)>,
    shells: Vec<Time>,
    has_reported_a_stall: bool,
}

pub(super) struct Judge {
    period: Duration,
    missed_max: u32,
    /// The node that is watched at another pace.
    watched: Option<(NodeAddress, Duration, u32)>,
    plan: Plan,
    lives: Vec<Life>,
    /// Which of them is whose.
    numbers: BTreeMap<(NodeAddress, Incarnation), usize>,
    pub(super) violations: Vec<String>,
}

impl Judge {
    pub(super) fn new(plan: &Plan) -> Self {
        Self {
            period: plan.period,
            missed_max: plan.missed_max,
            watched: plan
                .watched
                .map(|(node, period, missed)| (super::world::node_address(node), period, missed)),
            plan: plan.clone(),
            lives: Vec::new(),
            numbers: BTreeMap::new(),
            violations: Vec::new(),
        }
    }

    /// How `other` is watched.
    fn pace(&self, other: usize) -> (Duration, u32) {
        match self.watched {
            Some((node, period, missed_max)) if node == self.lives[other].node => (period, missed_max),
            Some(_) | None => (self.period, self.missed_max),
        }
    }

    /// A process starts; they are counted from 0.
    pub(super) fn started(
        &mut self,
        node: NodeAddress,
        incarnation: Incarnation,
        addresses: Vec<SocketAddr>,
    ) {
        self.numbers.insert((node, incarnation), self.lives.len());
        self.lives.push(Life {
            node,
            incarnation,
            addresses,
            ended: None,
            sights: BTreeMap::new(),
            questions: BTreeMap::new(),
            newest: BTreeMap::new(),
            stalls: Vec::new(),
            shells: Vec::new(),
            has_reported_a_stall: false,
        });
    }

    pub(super) fn ended(&mut self, process: usize, now: Time) {
        self.lives[process].ended = Some(now);
    }

    pub(super) fn said_goodbye(&mut self, now: Time, process: usize, to: &BTreeSet<SocketAddr>) {
        let sights = &self.lives[process].sights;
        let forgotten: Vec<usize> = sights
            .iter()
            .filter(|(other, sight)| {
                sight.is_member && !self.lives[**other].addresses.iter().any(|address| to.contains(address))
            })
            .map(|(other, _)| *other)
            .collect();
        for other in forgotten {
            self.violate(now, process, other, "is not told goodbye");
        }
    }

    pub(super) fn shell_restarted(&mut self, process: usize, now: Time) {
        self.lives[process].shells.push(now);
    }

    pub(super) fn stalled(&mut self, process: usize, now: Time, lasts: Duration) {
        self.lives[process].stalls.push((now, lasts));
    }

    pub(super) fn reported_a_stall(&mut self, process: usize) {
        self.lives[process].has_reported_a_stall = true;
    }

    pub(super) fn stall_is_over(&mut self, now: Time, process: usize, lasted: Duration) {
        if lasted > self.period * 2 + self.plan.lateness && !self.lives[process].has_reported_a_stall {
            self.violate(now, process, process, &format!("does not report its own stall of {lasted:?}"));
        }
    }

    pub(super) fn asked(&mut self, now: Time, process: usize, to: SocketAddr, correlation: u64) {
        let questions = self.lives[process].questions.entry(to).or_default();
        if questions.len() == QUESTIONS_KEPT {
            questions.pop_front();
        }
        questions.push_back(Question {
            correlation,
            asked: now,
            is_answered: false,
            is_answered_in_time: false,
        });
    }

    /// An answer is in the asker's socket.
    pub(super) fn answered(
        &mut self,
        now: Time,
        process: usize,
        (by, from): (usize, SocketAddr),
        correlation: u64,
    ) {
        let (period, _) = self.pace(by);
        let life = &mut self.lives[process];
        let questions = life.questions.entry(from).or_default();
        let Some(question) = questions
            .iter_mut()
            .rev()
            .find(|question| question.correlation == correlation && !question.is_answered)
        else {
            return;
        };
        question.is_answered = true;
        question.is_answered_in_time = now.since(question.asked) <= period;
        if question.is_answered_in_time
            && let Some(sight) = life.sights.get_mut(&by)
        {
            sight.answered = now;
            sight.places.insert(from);
        }
    }

    /// An answer was read.
    pub(super) fn read(&mut self, now: Time, process: usize, by: usize) {
        if let Some(sight) = self.lives[process].sights.get_mut(&by) {
            sight.read = now;
        }
    }

    /// Something was read on a connection, or a question to this process.
    pub(super) fn read_a_sign(&mut self, now: Time, process: usize, of: usize) {
        if let Some(sight) = self.lives[process].sights.get_mut(&of) {
            (sight.read, sight.heard, sight.sign) = (now, now, Some(now));
        }
    }

    /// A question or an answer was read.
    pub(super) fn heard(&mut self, now: Time, process: usize, of: usize) {
        if let Some(sight) = self.lives[process].sights.get_mut(&of) {
            sight.heard = now;
        }
    }

    pub(super) fn heard_goodbye(&mut self, now: Time, process: usize, from: usize) {
        let Some(sight) = self.lives[process].sights.get_mut(&from) else { return };
        sight.is_over = true;
        if sight.is_member {
            self.violate(now, process, from, "said goodbye, which was heard, and is still a member");
        }
    }

    pub(super) fn found(&mut self, now: Time, process: usize, node: NodeAddress, incarnation: Incarnation) {
        let Some(other) = self.life(node, incarnation) else {
            self.violations
                .push(format!("{now:?}: {process} found {node} in life {incarnation}, which never was"));
            return;
        };
        let life = &mut self.lives[process];
        let newest = life.newest.entry(node).or_insert(incarnation);
        let is_former = incarnation < *newest;
        *newest = incarnation.max(*newest);
        let sight = life.sights.entry(other).or_insert(Sight {
            is_member: false,
            is_over: false,
            answered: now,
            places: BTreeSet::new(),
            read: now,
            heard: now,
            sign: None,
        });
        let was_member = std::mem::replace(&mut sight.is_member, true);
        let came_back = sight.is_over;
        sight.places.clear();
        (sight.answered, sight.read, sight.heard) = (now, now, now);
        if was_member {
            self.violate(now, process, other, "is found, and was a member already");
        }
        if came_back {
            self.violate(now, process, other, "has ended, which was known, and is found again");
        }
        if is_former {
            self.violate(now, process, other, "is found again in a former life");
        }
    }

    pub(super) fn lost(
        &mut self,
        now: Time,
        process: usize,
        (node, incarnation): (NodeAddress, Incarnation),
        why: LossReason,
    ) {
        let Some(other) = self.life(node, incarnation) else {
            self.violations
                .push(format!("{now:?}: {process} lost {node} in life {incarnation}, which never was"));
            return;
        };
        self.check_reason(now, process, other, why);
        self.check_in_time(now, process, other);
        let has_ended = self.lives[other].ended.is_some();
        let was_member = self.lives[process].sights.get_mut(&other).is_some_and(|sight| {
            sight.is_over |= has_ended;
            std::mem::replace(&mut sight.is_member, false)
        });
        if !was_member {
            self.violate(now, process, other, "is lost, and was no member");
        }
    }

    /// An application is told for how long it was silent, and within which time that is a loss.
    pub(super) fn told_of_a_loss(
        &mut self,
        now: Time,
        process: usize,
        (node, incarnation): (NodeAddress, Incarnation),
        [silent, bound]: [Duration; 2],
    ) {
        let Some(other) = self.life(node, incarnation) else { return };
        let (period, missed_max) = self.pace(other);
        if bound != period * (missed_max + 1) {
            self.violate(now, process, other, &format!("is told to be lost within {bound:?}"));
        }
        let Some(heard) = self.lives[process].sights.get(&other).map(|sight| sight.heard) else { return };
        let least = now.since(heard) * (1_000 - DRIFT_PER_MILLE) / 1_000;
        if silent + Duration::from_micros(2) < least {
            let words = format!("is told to have been silent for {silent:?}, and was for {least:?} and more");
            self.violate(now, process, other, &words);
        }
    }

    /// The same of a life that is there now: for how long the one before it was silent.
    pub(super) fn told_of_a_restart(
        &mut self,
        now: Time,
        process: usize,
        (node, incarnation): (NodeAddress, Incarnation),
        said: [Duration; 2],
    ) {
        let sights = self.lives[process].sights.iter().map(|(other, sight)| (&self.lives[*other], sight));
        let before = sights.filter(|(life, _)| life.node == node && life.incarnation != incarnation);
        let last = before.max_by_key(|(_, sight)| sight.heard).map(|(life, _)| life.incarnation);
        if let Some(last) = last {
            self.told_of_a_loss(now, process, (node, last), said);
        }
    }

    fn check_reason(&mut self, now: Time, process: usize, other: usize, why: LossReason) {
        let lives = self.lives[other].ended.is_none();
        match why {
            LossReason::Left | LossReason::GaveUp(_) | LossReason::Crashed | LossReason::Restarted
                if lives =>
            {
                self.violate(now, process, other, &format!("lives, and is lost as {why:?}"));
            }
            LossReason::Left
            | LossReason::GaveUp(_)
            | LossReason::Crashed
            | LossReason::Restarted
            | LossReason::Duplicate => {}
            LossReason::Hung | LossReason::LinkDown => {
                let (most, least) = self.unanswered(now, process, other);
                let missed_max = self.pace(other).1 as usize;
                if lives && (most < missed_max || least.is_some_and(|least| least < missed_max)) {
                    let words = format!(
                        "lives, did not answer {most} questions at one address and {least:?} at each where it has answered, and is \
                         lost as silent"
                    );
                    self.violate(now, process, other, &words);
                }
                self.check_sign(now, process, other);
            }
        }
    }

    fn check_sign(&mut self, now: Time, process: usize, other: usize) {
        let (period, missed_max) = self.pace(other);
        let counts = period * missed_max * (1_000 - DRIFT_PER_MILLE) / 1_000;
        let sign = self.lives[process].sights.get(&other).and_then(|sight| sight.sign);
        let age = sign.map(|sign| now.since(sign)).filter(|age| *age < counts);
        if let Some(age) = age {
            let words = format!("is lost as silent, and asked or was read of on its connection {age:?} ago");
            self.violate(now, process, other, &words);
        }
    }

    /// `host` is what the other's host has been saying for so long that it must be known.
    pub(super) fn check_class(
        &mut self,
        now: Time,
        process: usize,
        (node, incarnation): (NodeAddress, Incarnation),
        (why, host): (LossReason, Option<Host>),
    ) {
        let (Some(other), Some(host)) = (self.life(node, incarnation), host) else { return };
        let is_right = match why {
            LossReason::Left | LossReason::GaveUp(_) | LossReason::Restarted | LossReason::Duplicate => true,
            LossReason::Crashed => host == Host::Refuses,
            LossReason::Hung => host == Host::Accepts,
            LossReason::LinkDown => host == Host::IsSilent,
        };
        if !is_right {
            self.violate(
                now,
                process,
                other,
                &format!("is lost as {why:?}, and {host:?} is what its host says"),
            );
        }
    }

    /// Questions since the last answer that had half a period to be answered: at the address where there were the most, and of those
    /// where it has answered before at the one where there were the fewest.
    fn unanswered(&self, now: Time, process: usize, other: usize) -> (usize, Option<usize>) {
        let life = &self.lives[process];
        let Some(sight) = life.sights.get(&other) else { return (0, None) };
        let least = self.pace(other).0 * 49 / 100;
        let is_missed = |question: &&Question| {
            question.asked >= sight.answered
                && now.since(question.asked) >= least
                && !question.is_answered_in_time
        };
        let count = |address: &SocketAddr| {
            life.questions.get(address).map_or(0, |questions| questions.iter().filter(is_missed).count())
        };
        let most = self.lives[other].addresses.iter().map(count).max();
        (most.unwrap_or(0), sight.places.iter().map(count).min())
    }

    /// A member was heard of within the bound.
    fn check_in_time(&mut self, now: Time, process: usize, other: usize) {
        let (life, (period, missed_max)) = (&self.lives[process], self.pace(other));
        let Some(sight) = life.sights.get(&other) else { return };
        let own: Duration = life
            .stalls
            .iter()
            .filter(|(began, lasted)| *began + *lasted >= sight.read)
            .map(|(_, lasted)| *lasted + period)
            .sum();
        let shells = life.shells.iter().filter(|at| **at >= sight.read).count();
        let shells = period * u32::try_from(shells).expect("few restarts");
        let periods = self.plan.silence_max(period, missed_max);
        let bound = periods + periods * DRIFT_PER_MILLE / 1_000 + own + shells;
        let silent = now.since(sight.read);
        if silent > bound {
            let words = format!("was silent for {silent:?} and is lost only now; the bound is {bound:?}");
            self.violate(now, process, other, &words);
        }
    }

    /// `truth` is the peer's clock minus the process's, now.
    pub(super) fn measured(
        &mut self,
        now: Time,
        process: usize,
        (node, offset): (NodeAddress, ClockOffset),
        truth: i64,
    ) {
        let error = u128::from(offset.theirs_minus_ours_ns.abs_diff(truth));
        if error > offset.bound.as_nanos() + 2 {
            self.violations.push(format!(
                "{now:?}: {process} says that {node}'s clock is {} ns ahead, within {:?}: it is wrong by {error} ns",
                offset.theirs_minus_ours_ns, offset.bound
            ));
        }
    }

    /// All has been well for long: `views` are the living processes and whom each core has.
    pub(super) fn at_rest(&mut self, now: Time, views: &[(usize, BTreeSet<(NodeAddress, Incarnation)>)]) {
        let there: BTreeSet<_> = self
            .lives
            .iter()
            .filter(|life| life.ended.is_none())
            .map(|life| (life.node, life.incarnation))
            .collect();
        for (process, view) in views {
            let life = &self.lives[*process];
            let told: BTreeSet<_> = life
                .sights
                .iter()
                .filter(|(_, sight)| sight.is_member)
                .map(|(other, _)| (self.lives[*other].node, self.lives[*other].incarnation))
                .collect();
            let others: BTreeSet<_> = there.iter().copied().filter(|(node, _)| *node != life.node).collect();
            for (whose, has) in [("its core has", view), ("it has said", &told)] {
                if *has != others {
                    let (missing, gone): (Vec<_>, Vec<_>) =
                        (others.difference(has).collect(), has.difference(&others).collect());
                    self.violations.push(format!(
                        "{now:?}: at rest, {process} ({}): {whose} not {missing:?}, who are there, and has {gone:?}, who are not",
                        life.node
                    ));
                }
            }
        }
    }

    /// Which life that is: the number of its process.
    pub(super) fn life(&self, node: NodeAddress, incarnation: Incarnation) -> Option<usize> {
        self.numbers.get(&(node, incarnation)).copied()
    }

    fn violate(&mut self, now: Time, process: usize, other: usize, words: &str) {
        let [own, other] = [process, other].map(|index| {
            let life = &self.lives[index];
            format!("process {index} ({} in life {})", life.node, life.incarnation)
        });
        self.violations.push(format!("{now:?}: to {own}, {other} {words}"));
    }
}
