//! A process that comes with a member's node address in a later life, where datagrams are lost: a member that lives stays, and no one follows it who
//! is gone himself.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::{tid::Incarnation, time::Time};

use super::world::{PERIOD, Spec, World, ms, node, udp};
use crate::{
    gncl::LinkFact,
    ndl::{
        MembershipFact,
        core::{
            Output,
            contest::Party,
            cycle::IN_A_ROW_MAX,
            lives::Proof,
            simulation::{Chance, SEED_VARIABLE, SEEDS_VARIABLE},
        },
    },
    seeded::{Seed, number},
};

/// The nodes that look on are 1 to this at most.
const OTHERS_MAX: u16 = 3;
/// The two processes with node address 9.
const HOLDER: u16 = 11;
const NEWCOMER: u16 = 12;
const BOTH: u32 = 9;
/// What happens is looked at in such steps where much happens. An answer that makes somebody a member was under way for a tenth of one.
const STEP: Duration = ms(1);
/// A newcomer that is tried and answers follows so much later at most: a third of its 100 ms.
const ANSWER_COUNTS_FOR: Duration = ms(34);
/// Seeds in an ordinary run.
const SEEDS: u64 = if cfg!(debug_assertions) { 50 } else { 200 };
/// Seeds within which each fault must be found.
const SEEDS_FOR_A_FAULT: u64 = 300;

const fn life(index: u16) -> Incarnation {
    Incarnation(index as u64)
}

/// What is broken on purpose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// A newcomer that answered once need not answer again.
    BelievesTheNewcomerUnasked,
    /// Who follows a member that is lost is taken by whatever he said before.
    BelievesAnOldAnswer,
    /// The member has one question to answer.
    AsksTheMemberOnce,
    /// A member whose connection stands, or that gives a sign, has no more time than another.
    GivesNoTimeAnew,
    /// What GNCL hears of the member does not count.
    IgnoresSigns,
    /// What GNCL hears of the member while the newcomer is tried does not count.
    IgnoresLateSigns,
    /// No newcomer is ever tried.
    TriesNobody,
}

/// What a seed says.
#[derive(Debug)]
struct Plan {
    others: u16,
    /// Connections deliver, so that datagrams may be lost without measure; or they do not, and each fifth datagram of a pair is lost, or none.
    is_linked: bool,
    /// By chance; and each so many-th of a pair.
    loses_per_mille: u64,
    loses_each: Option<u64>,
    /// Time that a sign takes on a connection, at least and at most: the last is when all of the member's own time is over.
    signs_after: (Duration, Duration),
    /// No datagram of the first node arrives at the holder.
    is_cut: bool,
    /// The two with one address do not hear each other.
    is_apart: bool,
    /// Behind the beginning, each.
    starts: Duration,
    holder_dies: Option<Duration>,
    /// Its host lives on, and ends its connections.
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
            signs_after: chance.of(&[(ms(0), ms(1)), (ms(0), ms(20)), (ms(0), ms(300)), (ms(405), ms(420))]),
            is_cut: is_linked && chance.happens(300),
            is_apart: chance.happens(700),
            starts,
            holder_dies: chance.happens(600).then(|| chance.between(Duration::ZERO, starts + ms(300))),
            breaks: chance.happens(700),
            newcomer_dies: chance.happens(500).then(|| starts + chance.between(Duration::ZERO, ms(300))),
        }
    }

    /// Whether each question to a living process is answered.
    fn is_lossless(&self) -> bool {
        self.loses_per_mille == 0 && self.loses_each.is_none() && !self.is_cut
    }
}

/// What is seen of one run, step by step.
struct Watch {
    plan: Plan,
    begin: Time,
    fault: Option<Fault>,
    /// When the newcomer was silent for good: it died, or gave up.
    newcomer_silent: Option<Time>,
    /// Who each tries, where that is to be believed later.
    tried: BTreeMap<u16, Proof>,
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
                world.start(NEWCOMER, &Spec { incarnation: life(NEWCOMER).0, ..Spec::of(BOTH) });
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
        let (node, incarnation) = (node(BOTH), life(HOLDER));
        for index in (1..=self.plan.others).filter(|_| self.plan.is_linked && self.plan.breaks) {
            world.link(index, LinkFact::LinkBroken { node, incarnation });
        }
    }

    fn break_it(&mut self, world: &mut World, index: u16) {
        let Some(fault) = self.fault else { return };
        let before = self.tried.remove(&index);
        let mut tried = None;
        world.with(udp(index), |core, now| {
            let Some(contest) = core.contests.get_mut(&node(BOTH)) else {
                let is_lost = !core.members.contains_key(&node(BOTH));
                if let Some(newcomer) = before.filter(|_| is_lost && fault == Fault::BelievesAnOldAnswer) {
                    core.arrive(now, newcomer);
                }
                return;
            };
            let newcomer = contest.newcomer.clone();
            match fault {
                Fault::BelievesTheNewcomerUnasked => {
                    if contest.tried == Party::Newcomer {
                        core.replace(now, newcomer);
                    }
                }
                Fault::BelievesAnOldAnswer => tried = Some(newcomer),
                Fault::AsksTheMemberOnce => contest.again = 0,
                Fault::GivesNoTimeAnew => contest.put_off = IN_A_ROW_MAX,
                Fault::TriesNobody => drop(core.contests.remove(&node(BOTH))),
                Fault::IgnoresLateSigns => {
                    if contest.has_answered {
                        core.replace(now, newcomer);
                    }
                }
                Fault::IgnoresSigns => {}
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
                    if incarnation == life(HOLDER) && self.holder_lives(now) =>
                {
                    return Err(format!("{index} lost the holder, which lives, as {why:?}"));
                }
                MembershipFact::NodeFound { incarnation, .. } if incarnation == life(NEWCOMER) => {
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

    /// Where no datagram is lost, who is restarted is told long before it would be lost by silence.
    fn judge_time(&self, world: &World) -> Result<(), String> {
        let Some(dies) = self.plan.holder_dies else { return Ok(()) };
        let due = self.begin + dies.max(self.plan.starts) + PERIOD * 2;
        let is_due =
            self.plan.is_lossless() && self.plan.newcomer_dies.is_none() && self.newcomer_silent.is_none();
        if !is_due || world.now < due {
            return Ok(());
        }
        self.all_have(world, Some(life(NEWCOMER)))
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

/// All have a connection with the holder.
fn connect(world: &mut World, plan: &Plan, fault: Option<Fault>) {
    if !plan.is_linked {
        return;
    }
    world.signs_after = (fault != Some(Fault::IgnoresSigns)).then_some(plan.signs_after);
    for index in 1..=plan.others {
        world.link(index, LinkFact::LinkUp { node: node(BOTH), incarnation: life(HOLDER) });
    }
}

fn compete(seed: u64, fault: Option<Fault>) -> Result<(), String> {
    let mut chance = Chance::new(seed);
    let plan = Plan::of(&mut chance);
    let mut world = World::new().seeded(!seed);
    for index in (1..=plan.others).chain([HOLDER]) {
        let address = if index == HOLDER { BOTH } else { index.into() };
        world.start(index, &Spec { incarnation: life(index).0, ..Spec::of(address) });
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
        // Nothing is lost any more; a loss, and the longest wait before a lost node's address is asked again.
        (world.loses_per_mille, world.loses_each) = (0, None);
        world.mend();
        part(&mut world);
        for _ in 0..(4 + 18) * 50 {
            watch.step(&mut world, PERIOD / 50)?;
        }
        let owner = match (watch.holder_lives(world.now), watch.newcomer_silent) {
            (true, _) => Some(life(HOLDER)),
            (false, None) => Some(life(NEWCOMER)),
            (false, Some(_)) => None,
        };
        watch.all_have(&world, owner)
    })();
    judged.map_err(|error: String| format!("{error}\n{words}"))
}

// spec: NDL-5.3
#[test]
fn whatever_is_lost_a_member_that_lives_stays_and_who_follows_it_lives() {
    let (only, seeds) = (number(SEED_VARIABLE), number(SEEDS_VARIABLE).unwrap_or(SEEDS));
    for number in only.map_or(0..seeds, |only| only..only + 1) {
        let test = "ndl::core::tests::contests::whatever_is_lost";
        let seed = Seed { number, variable: SEED_VARIABLE, package: "sinew", test };
        if let Err(words) = seed.run(|| compete(number, None)) {
            panic!("{words}\n{seed}");
        }
    }
    println!("{} seeds", only.map_or(seeds, |_| 1));
}

// spec: NDL-5.3
#[test]
fn each_rule_of_a_contest_that_is_taken_away_is_missed() {
    let faults = [
        Fault::BelievesTheNewcomerUnasked,
        Fault::BelievesAnOldAnswer,
        Fault::AsksTheMemberOnce,
        Fault::GivesNoTimeAnew,
        Fault::IgnoresSigns,
        Fault::IgnoresLateSigns,
        Fault::TriesNobody,
    ];
    for fault in faults {
        let found = (0..SEEDS_FOR_A_FAULT).find_map(|seed| {
            let words = compete(seed, Some(fault)).err()?;
            compete(seed, None).is_ok().then_some((seed, words))
        });
        let Some((seed, words)) = found else { panic!("{fault:?} is not found") };
        println!("{fault:?}: seed {seed}: {words}");
    }
}
