//! A process that starts with a member's node address in a later incarnation, with lost datagrams. A living member
//! stays, and only a living newcomer replaces it.

use std::{collections::BTreeMap, time::Duration};

use sinew_model::facts::{LinkFact, MembershipFact};
use sinew_runtime::{tid::Incarnation, time::Time};
use sinew_sim::{Chance, Hunt, Seeds};

use super::{
    seeds,
    world::{PERIOD, Spec, World, ms, node, udp},
};
use crate::core::{
    Output, address_conflict::Party, grace_period::IN_A_ROW_MAX, incarnations::AcceptedAnswer,
};

/// The observing nodes are 1 to this at most.
const OTHERS_MAX: u16 = 3;
/// The two processes with node address 9.
const HOLDER: u16 = 11;
const NEWCOMER: u16 = 12;
const BOTH: u32 = 9;
/// The step at which the state is checked when much happens. An answer that makes a process a member was in flight for
/// a tenth of it.
const STEP: Duration = ms(1);
/// Maximum delay between the answer of a tried newcomer and the replacement: a third of its 100 ms.
const ANSWER_COUNTS_FOR: Duration = ms(34);
/// The seeds of an ordinary run.
const SEEDS: Seeds = seeds(
    "core::tests::address_conflicts::living_member_stays",
    if cfg!(debug_assertions) { 50 } else { 200 },
);
/// Seeds within which each fault must be found.
const SEEDS_FOR_A_FAULT: u64 = 300;

const fn incarnation_of(index: u16) -> Incarnation {
    Incarnation(index as u64)
}

/// A rule that is broken on purpose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// A newcomer that answered once need not answer again.
    NewcomerNotQueried,
    /// A newcomer that replaces a lost member is accepted by any earlier answer.
    OldAnswerAccepted,
    /// The member gets one query only.
    MemberQueriedOnce,
    /// A connected member, or one with a liveness hint, gets no more time than another.
    TimeNotRestarted,
    /// Liveness hints of GNCL about the member do not count.
    HintsIgnored,
    /// Liveness hints of GNCL about the member do not count while the newcomer is tried.
    LateHintsIgnored,
    /// No newcomer is ever tried.
    NewcomerNeverTried,
}

/// The plan of a seed.
#[derive(Debug)]
struct Plan {
    others: u16,
    /// Connections deliver, and any number of datagrams may be lost; or they do not, and each fifth datagram of a pair
    /// is lost, or none.
    is_linked: bool,
    /// The random loss, and the regular loss of each n-th datagram of a pair.
    loses_per_mille: u64,
    loses_each: Option<u64>,
    /// Minimum and maximum time of a liveness hint on a connection. The last choice is after the end of the member's
    /// own time.
    hints_after: (Duration, Duration),
    /// No datagram of the first node arrives at the holder.
    is_cut: bool,
    /// The two with one address do not receive each other's datagrams.
    is_apart: bool,
    /// Time after the beginning, each.
    starts: Duration,
    holder_dies: Option<Duration>,
    /// Its host stays up, and ends its connections.
    breaks: bool,
    newcomer_dies: Option<Duration>,
}

impl Plan {
    fn of(chance: &mut Chance) -> Self {
        let is_linked = chance.happens(500);
        let starts = chance.between(ms(500), ms(2_500));
        let loses_each = if is_linked { None } else { chance.of(&[None, Some(5)]) };
        Self {
            others: 1 + chance.index(OTHERS_MAX.into()) as u16,
            is_linked,
            loses_per_mille: if is_linked { chance.of(&[0, 100, 300, 500]) } else { 0 },
            loses_each,
            hints_after: chance.of(&[(ms(0), ms(1)), (ms(0), ms(20)), (ms(0), ms(300)), (ms(405), ms(420))]),
            is_cut: is_linked && chance.happens(300),
            is_apart: chance.happens(700),
            starts,
            holder_dies: chance.happens(600).then(|| chance.between(Duration::ZERO, starts + ms(300))),
            breaks: chance.happens(700),
            newcomer_dies: chance.happens(500).then(|| starts + chance.between(Duration::ZERO, ms(300))),
        }
    }

    /// Returns whether each query to a living process is answered.
    fn is_lossless(&self) -> bool {
        self.loses_per_mille == 0 && self.loses_each.is_none() && !self.is_cut
    }
}

/// The observations of one run, step by step.
struct Watch {
    plan: Plan,
    begin: Time,
    fault: Option<Fault>,
    /// The time from which the newcomer was silent for good: it died, or gave up.
    newcomer_silent: Option<Time>,
    /// The party that each node tries, where it is to be accepted later.
    tried: BTreeMap<u16, AcceptedAnswer>,
}

impl Watch {
    fn is_over(at: Option<Duration>, elapsed: Duration) -> bool {
        at.is_some_and(|at| at <= elapsed)
    }

    fn holder_lives(&self, now: Time) -> bool {
        !Self::is_over(self.plan.holder_dies, now.since(self.begin))
    }

    fn step(&mut self, world: &mut World, step: Duration) -> Result<(), String> {
        let elapsed = world.now.since(self.begin);
        if Self::is_over(self.plan.holder_dies, elapsed) && world.is_alive(HOLDER) {
            self.end_holder(world);
        }
        if elapsed >= self.plan.starts && self.newcomer_silent.is_none() {
            if !world.processes.contains_key(&udp(NEWCOMER)) {
                world.start(NEWCOMER, &Spec { incarnation: incarnation_of(NEWCOMER).0, ..Spec::of(BOTH) });
            }
            let dies = Self::is_over(self.plan.newcomer_dies, elapsed);
            if dies {
                world.kill(NEWCOMER);
            }
            if dies || world.gave_up(NEWCOMER) {
                self.newcomer_silent = Some(world.now);
            }
        }
        world.run(step);
        for index in 1..=self.plan.others {
            self.break_it(world, index);
            self.judge(world, index, step)?;
        }
        Ok(())
    }

    fn end_holder(&self, world: &mut World) {
        world.kill(HOLDER);
        let (node, incarnation) = (node(BOTH), incarnation_of(HOLDER));
        for index in (1..=self.plan.others).filter(|_| self.plan.is_linked && self.plan.breaks) {
            world.link(index, LinkFact::LinkBroken { node, incarnation });
        }
    }

    fn break_it(&mut self, world: &mut World, index: u16) {
        let Some(fault) = self.fault else { return };
        let before = self.tried.remove(&index);
        let mut tried = None;
        world.with(udp(index), |core, now| {
            let Some(conflict) = core.conflicts.get_mut(node(BOTH)) else {
                let is_lost = !core.members.contains_key(&node(BOTH));
                if let Some(newcomer) = before.filter(|_| is_lost && fault == Fault::OldAnswerAccepted) {
                    core.arrive(now, newcomer);
                }
                return;
            };
            let newcomer = conflict.newcomer.clone();
            match fault {
                Fault::NewcomerNotQueried => {
                    if conflict.tried == Party::Newcomer {
                        core.replace(now, newcomer);
                    }
                }
                Fault::OldAnswerAccepted => tried = Some(newcomer),
                Fault::MemberQueriedOnce => conflict.again = 0,
                Fault::TimeNotRestarted => conflict.put_off = IN_A_ROW_MAX,
                Fault::NewcomerNeverTried => core.conflicts.remove(node(BOTH)),
                Fault::LateHintsIgnored => {
                    if conflict.has_answered {
                        core.replace(now, newcomer);
                    }
                }
                Fault::HintsIgnored => {}
            }
        });
        self.tried.extend(tried.map(|newcomer| (index, newcomer)));
    }

    fn judge(&self, world: &mut World, index: u16, step: Duration) -> Result<(), String> {
        let now = world.now;
        let others = std::mem::take(&mut world.process(index).others);
        let is_restart = self.plan.holder_dies.is_some_and(|dies| dies + STEP < self.plan.starts);
        if is_restart && others.iter().any(|output| matches!(output, Output::Collision { .. })) {
            return Err(format!("{index} names two, and the holder had ended before the newcomer came"));
        }
        for fact in std::mem::take(&mut world.process(index).facts) {
            match fact {
                MembershipFact::NodeLost { incarnation, why, .. }
                    if incarnation == incarnation_of(HOLDER) && self.holder_lives(now) =>
                {
                    return Err(format!("{index} lost the holder, which lives, as {why:?}"));
                }
                MembershipFact::NodeFound { incarnation, .. } if incarnation == incarnation_of(NEWCOMER) => {
                    let silent = self.newcomer_silent.map(|at| now.since(at));
                    if silent.is_some_and(|silent| silent > ANSWER_COUNTS_FOR + step * 2) {
                        return Err(format!(
                            "{index} found the newcomer, which had been silent for {silent:?}"
                        ));
                    }
                }
                MembershipFact::NodeLost { .. } | MembershipFact::NodeFound { .. } => {}
            }
        }
        Ok(())
    }

    /// Checks, if no datagram is lost, that a restart is reported long before a loss by silence.
    fn judge_time(&self, world: &World) -> Result<(), String> {
        let Some(dies) = self.plan.holder_dies else { return Ok(()) };
        let due = self.begin + dies.max(self.plan.starts) + PERIOD * 2;
        let is_due =
            self.plan.is_lossless() && self.plan.newcomer_dies.is_none() && self.newcomer_silent.is_none();
        if !is_due || world.now < due {
            return Ok(());
        }
        self.all_have(world, Some(incarnation_of(NEWCOMER)))
    }

    fn all_have(&self, world: &World, owner: Option<Incarnation>) -> Result<(), String> {
        for index in 1..=self.plan.others {
            let has =
                world.at(index).core.members.get(&node(BOTH)).map(|member| member.announcement.incarnation);
            if has != owner {
                return Err(format!("{index} has {has:?} and not {owner:?}"));
            }
        }
        Ok(())
    }
}

/// Connects all nodes with the holder.
fn connect(world: &mut World, plan: &Plan, fault: Option<Fault>) {
    if !plan.is_linked {
        return;
    }
    world.hints_after = (fault != Some(Fault::HintsIgnored)).then_some(plan.hints_after);
    for index in 1..=plan.others {
        world.link(index, LinkFact::LinkUp { node: node(BOTH), incarnation: incarnation_of(HOLDER) });
    }
}

fn compete(seed: u64, fault: Option<Fault>) -> Result<(), String> {
    let mut chance = Chance::new(seed);
    let plan = Plan::of(&mut chance);
    let mut world = World::new().seeded(!seed);
    for index in (1..=plan.others).chain([HOLDER]) {
        let address = if index == HOLDER { BOTH } else { index.into() };
        world.start(index, &Spec { incarnation: incarnation_of(index).0, ..Spec::of(address) });
    }
    world.run(PERIOD * 5);
    world.forget_the_past();
    let is_apart = plan.is_apart;
    let part = |world: &mut World| {
        if is_apart {
            world.cut(HOLDER, NEWCOMER);
            world.cut(NEWCOMER, HOLDER);
        }
    };
    part(&mut world);
    if plan.is_cut {
        world.cut(1, HOLDER);
    }
    (world.loses_per_mille, world.loses_each) = (plan.loses_per_mille, plan.loses_each);
    connect(&mut world, &plan, fault);
    let words = format!("{plan:?}");
    let mut watch = Watch { plan, begin: world.now, fault, newcomer_silent: None, tried: BTreeMap::new() };
    let judged = (|| {
        for _ in 0..4_000 {
            watch.step(&mut world, STEP)?;
            watch.judge_time(&world)?;
        }
        // No datagram is lost any more. Time for a loss, and the longest interval before a lost node's address is
        // queried again.
        (world.loses_per_mille, world.loses_each) = (0, None);
        world.mend();
        part(&mut world);
        for _ in 0..(4 + 18) * 50 {
            watch.step(&mut world, PERIOD / 50)?;
        }
        let owner = match (watch.holder_lives(world.now), watch.newcomer_silent) {
            (true, _) => Some(incarnation_of(HOLDER)),
            (false, None) => Some(incarnation_of(NEWCOMER)),
            (false, Some(_)) => None,
        };
        watch.all_have(&world, owner)
    })();
    judged.map_err(|error: String| format!("{error}\n{words}"))
}

// spec: NDL-5.3
#[test]
fn living_member_stays_under_any_loss() {
    SEEDS.run(|seed, _| compete(seed, None));
}

// spec: NDL-5.3
#[test]
fn each_removed_rule_of_a_conflict_is_detected() {
    let faults = [
        Fault::NewcomerNotQueried,
        Fault::OldAnswerAccepted,
        Fault::MemberQueriedOnce,
        Fault::TimeNotRestarted,
        Fault::HintsIgnored,
        Fault::LateHintsIgnored,
        Fault::NewcomerNeverTried,
    ];
    let hunt = Hunt { seeds: &SEEDS, faults: &faults, within: SEEDS_FOR_A_FAULT, found_last: &[] };
    hunt.run(|seed, fault, _| compete(seed, fault));
}
