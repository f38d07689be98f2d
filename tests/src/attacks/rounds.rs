//! Latencies of live traffic in alternating rounds: without an attack, with an attack on the decoy, with the
//! same attack on the node. Other load on the machine affects all three equally. The node has no part in the
//! slowdown that the decoy shows.

use std::{
    collections::BTreeMap,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use sinew_testkit::{SetOnDrop, join};

use super::{
    Attack, Happened, LATE_AT_REST, Plan, Scene,
    robot::{Decoys, Target, Window},
};

/// The name of the window between rounds.
pub(super) const BETWEEN: &str = "between";
/// Pause after each attack. In this time a node accepts the connections that still wait in the kernel: at
/// most 1,024, one per millisecond.
const PAUSE: Duration = Duration::from_millis(1_100);

/// Number of times that each action was done.
pub type Done = BTreeMap<&'static str, u64>;

/// Latencies of live traffic with an attack on one target, over all rounds.
#[derive(Clone, Debug, Default)]
pub struct Attacked {
    /// The latencies.
    pub window: Window,
    /// Actions of the attacker meanwhile.
    pub done: Done,
}

impl Attacked {
    /// Actions per second.
    #[must_use]
    pub fn done_per_s(&self) -> BTreeMap<&'static str, f64> {
        let seconds = self.window.lasted.as_secs_f64().max(f64::MIN_POSITIVE);
        self.done.iter().map(|(what, count)| (*what, *count as f64 / seconds)).collect()
    }

    /// Returns whether the attacker did anything.
    #[must_use]
    pub fn is_attack(&self) -> bool {
        self.done.values().any(|count| *count > 0)
    }
}

/// Latencies of live traffic, over all rounds.
#[derive(Clone, Debug, Default)]
pub struct Rounds {
    /// Without an attack.
    pub before: Window,
    /// With the decoy attacked, if a decoy can replace the node.
    pub decoy: Option<Attacked>,
    /// With the node attacked.
    pub node: Attacked,
    /// Messages to the node in the sender's own name.
    pub(super) own_sent: u64,
    /// The same on links that broke.
    pub(super) own_perhaps: u64,
    /// Violations that count however short the attack is, such as an intruder admitted by the node.
    pub(super) let_in: Vec<String>,
}

impl Rounds {
    /// Returns whether the machine was idle without an attack; otherwise latencies are meaningless.
    pub(super) fn was_at_rest(&self) -> bool {
        self.before.missed() as f64 <= LATE_AT_REST * self.before.asked() as f64
    }
}

/// Measures the latencies with this attack.
pub(super) fn measure(attack: &Attack, plan: &Plan, scene: &Scene<'_>, decoys: Option<&Decoys>) -> Rounds {
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

/// The same scene with this target and duration.
fn aimed<'a>(scene: &Scene<'a>, target: Target, lasts: Duration) -> Scene<'a> {
    Scene { target, lasts, ..*scene }
}

/// Runs one round of an attack, and the pause after it.
fn go_on(attack: &Attack, name: &str, scene: &Scene<'_>, attacked: &mut Attacked) -> Happened {
    let (over, attack) = (AtomicBool::new(false), attack.goes_on.unwrap_or(attack.run));
    let scene = Scene { over: &over, ..*scene };
    let happened = thread::scope(|scope| {
        let _ends = SetOnDrop(&over);
        scene.robot.window(BETWEEN);
        let attacking = scope.spawn(|| attack(&scene));
        thread::sleep(scene.lasts);
        attacked.window = scene.robot.window(name);
        over.store(true, Ordering::Relaxed);
        join(attacking)
    });
    for (what, count) in &happened.done {
        *attacked.done.entry(what).or_default() += count;
    }
    thread::sleep(PAUSE);
    happened
}
