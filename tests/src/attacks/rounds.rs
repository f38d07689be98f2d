//! Live traffic's times by turns: left alone, with an attack on the decoy, with the same attack on the node. Whatever else the machine does
//! meanwhile falls on all three, and what the decoy shows the node has no part in.

use std::{
    collections::BTreeMap,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use super::{
    Attack, EndsIt, Happened, LATE_AT_REST, Plan, Scene,
    robot::{Decoys, Target, Window},
};

/// What is measured in no round.
pub(super) const BETWEEN: &str = "between";
/// Time after each attack, in which a node has done with the connections that still wait for it in the kernel: 1,024 at most, one each
/// millisecond.
const PAUSE: Duration = Duration::from_millis(1_100);

/// How often each thing was done.
pub type Done = BTreeMap<&'static str, u64>;

/// Live traffic's times with an attack on somebody, in all rounds.
#[derive(Clone, Debug, Default)]
pub struct Attacked {
    /// Its times.
    pub window: Window,
    /// What the attacker did meanwhile.
    pub done: Done,
}

impl Attacked {
    /// What he did in a second.
    #[must_use]
    pub fn done_per_s(&self) -> BTreeMap<&'static str, f64> {
        let seconds = self.window.lasted.as_secs_f64().max(f64::MIN_POSITIVE);
        self.done.iter().map(|(what, count)| (*what, *count as f64 / seconds)).collect()
    }

    /// He did something.
    #[must_use]
    pub fn is_attack(&self) -> bool {
        self.done.values().any(|count| *count > 0)
    }
}

/// Live traffic's times, in all rounds.
#[derive(Clone, Debug, Default)]
pub struct Rounds {
    /// Left alone.
    pub before: Window,
    /// With the decoy attacked, where one can stand in for the node.
    pub decoy: Option<Attacked>,
    /// With the node attacked.
    pub node: Attacked,
    /// Messages to the node in the sender's own name.
    pub(super) own_sent: u64,
    /// The same on links that broke.
    pub(super) own_perhaps: u64,
    /// What must not have been for however short a time: who was let in by the node, say.
    pub(super) let_in: Vec<String>,
}

impl Rounds {
    /// The machine was at rest where nobody was attacked: else times say nothing.
    pub(super) fn was_at_rest(&self) -> bool {
        self.before.missed() as f64 <= LATE_AT_REST * self.before.asked() as f64
    }
}

/// Measures them with this attack.
pub(super) fn play(attack: &Attack, plan: &Plan, scene: &Scene<'_>, decoys: Option<&Decoys>) -> Rounds {
    let lasts = plan.timed / plan.rounds.max(1);
    let mut rounds = Rounds { decoy: decoys.map(|_| Attacked::default()), ..Rounds::default() };
    for _ in 0..plan.rounds.max(1) {
        scene.robot.window(BETWEEN);
        thread::sleep(lasts);
        rounds.before = scene.robot.window("before");
        if let Some((decoys, attacked)) = decoys.zip(rounds.decoy.as_mut()) {
            go_on(attack, "decoy", &aimed(scene, decoys.target(), lasts), attacked);
        }
        let at_node = aimed(scene, scene.robot.target(), lasts);
        let happened = go_on(attack, "node", &at_node, &mut rounds.node);
        rounds.own_sent += happened.own_sent;
        rounds.own_perhaps += happened.own_perhaps;
        rounds.let_in.extend(happened.let_in);
    }
    rounds
}

/// The same against this one, for so long.
fn aimed<'a>(scene: &Scene<'a>, target: Target, lasts: Duration) -> Scene<'a> {
    Scene { target, lasts, ..*scene }
}

/// One round of an attack, and the pause after it.
fn go_on(attack: &Attack, name: &str, scene: &Scene<'_>, attacked: &mut Attacked) -> Happened {
    let (over, attack) = (AtomicBool::new(false), attack.goes_on.unwrap_or(attack.run));
    let scene = Scene { over: &over, ..*scene };
    let happened = thread::scope(|scope| {
        let _ends = EndsIt(&over);
        scene.robot.window(BETWEEN);
        let attacking = scope.spawn(|| attack(&scene));
        thread::sleep(scene.lasts);
        attacked.window = scene.robot.window(name);
        over.store(true, Ordering::Relaxed);
        attacking.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    });
    for (what, count) in &happened.done {
        *attacked.done.entry(what).or_default() += count;
    }
    thread::sleep(PAUSE);
    happened
}
