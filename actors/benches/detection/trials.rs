//! Repeated trials of one way to leave: the act, the first event, and the return.

use std::{thread, time::Duration};

use fastrand::Rng;
use rustix::process::Signal;
use sinew::{Time, events::NodeEvent};
use sinew_figures::{
    Alone, Figures,
    process::{self, Process},
};
use sinew_testkit::Hosts;

use crate::{
    nodes::At,
    observer::{Observer, Told},
    setting::Setting,
    starved,
    way::{Turn, Way},
};

/// The hosts of the two nodes.
const OBSERVER: usize = 0;
const SUBJECT: usize = 1;
/// Settling time: two nodes that have just met still measure clocks and exchange names.
pub(crate) const SETTLED: Duration = Duration::from_millis(200);
/// Time by which a turn exceeds the stall bound.
const HELD_LONGER: Duration = Duration::from_millis(300);

/// A case.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Plan {
    pub(crate) way: Way,
    pub(crate) setting: Setting,
    pub(crate) trials: u32,
    pub(crate) seed: u64,
}

/// The time of an act: a signal takes effect at once, a system program takes some milliseconds.
#[derive(Clone, Copy, Debug)]
struct Act {
    began: Time,
    over: Time,
}

/// The results of all trials.
#[derive(Default)]
struct Seen {
    told: Figures,
    new_life: Figures,
    right: u64,
    held: u64,
    in_time: u64,
    over: Duration,
    surprises: u64,
}

/// The two nodes.
struct Scene<'a> {
    case: &'a str,
    plan: Plan,
    observer: Observer,
    /// `None` only between two incarnations.
    subject: Option<Process>,
    hosts: Hosts,
    at: At,
    chance: Rng,
    seen: Seen,
}

/// Creates the hosts, and runs the trials; reports the reason if that is not possible. Returns whether all
/// completed trials went well.
pub(crate) fn measure(case: &str, plan: Plan) -> bool {
    let hosts = match Hosts::new(2) {
        Ok(hosts) => hosts,
        Err(why) => {
            eprintln!("{case}: skipped: no hosts can be made here: {why}");
            return true;
        }
    };
    starved::listen();
    let mut scene = Scene::set(case, plan, hosts);
    for trial in 1..=plan.trials {
        scene.trial(trial);
    }
    scene.report();
    true
}

impl<'a> Scene<'a> {
    fn set(case: &'a str, plan: Plan, hosts: Hosts) -> Self {
        let at = At::loopback();
        let here = &hosts.all()[OBSERVER];
        let observer = here.run(|| Observer::start(plan.setting, at.on(here.address)));
        let (chance, seen) = (Rng::with_seed(plan.seed), Seen::default());
        let mut scene = Self { case, plan, observer, subject: None, hosts, at, chance, seen };
        scene.start_subject();
        let first = scene.observer.next("the subject's first life");
        assert!(matches!(first.event, NodeEvent::NodeFound { .. }), "found first: {first:?}");
        scene
    }

    fn start_subject(&mut self) {
        let host = &self.hosts.all()[SUBJECT];
        let Plan { way, setting, .. } = self.plan;
        let role = format!("subject {} {} {}", way.ports().name(), setting.name(), self.at.on(host.address));
        self.subject = Some(Process::start_command(host.moved(&process::command(&role)), &role));
    }

    fn trial(&mut self, trial: u32) {
        let Plan { way, .. } = self.plan;
        self.observer.reaches_subject();
        thread::sleep(SETTLED + self.plan.setting.asked_every().mul_f64(self.chance.f64()));
        for event in self.observer.rest() {
            self.surprise(trial, &event);
        }
        let act = self.act();
        let first = self.observer.next(&format!("{}: trial {trial}", self.case));
        self.judge(trial, act, &first);
        self.undo();
        let mut told = first;
        while !way.is_ended_by(&told.event) {
            told = self.observer.next(&format!("{}: the end of trial {trial}", self.case));
            if !way.is_ended_by(&told.event) {
                self.surprise(trial, &told.event);
            }
        }
        self.seen.new_life.record(told.at.since(act.began));
    }

    /// Does it.
    fn act(&mut self) -> Act {
        let began = Time::now();
        match self.plan.way {
            Way::Kill => self.signal(Signal::KILL),
            Way::Leave => self.signal(Signal::TERM),
            Way::Stop => self.signal(Signal::STOP),
            Way::LinkDown => self.hosts.cut(SUBJECT),
            Way::SilentCut => self.hosts.swallow(SUBJECT),
            Way::Stall(turn) => {
                let lasts = self.plan.setting.stall_bound() + HELD_LONGER;
                let began = self.observer.hold(turn == Turn::Spins, lasts);
                return Act { began, over: began };
            }
            Way::Restart(_) => {
                // Dropped, it is killed and collected.
                self.subject = None;
                let over = Time::now();
                self.start_subject();
                return Act { began, over };
            }
        }
        Act { began, over: Time::now() }
    }

    fn signal(&self, signal: Signal) {
        self.subject.as_ref().expect("it is there between acts").signal(signal);
    }

    fn undo(&mut self) {
        match self.plan.way {
            Way::Kill | Way::Leave => {
                let former = self.subject.take().expect("it is there between acts");
                // Its remaining events are not needed.
                let _ = former.wait();
                self.start_subject();
            }
            Way::Stop => self.signal(Signal::CONT),
            Way::LinkDown => self.hosts.join(SUBJECT),
            Way::SilentCut => self.hosts.carry(SUBJECT),
            // Both end by themselves.
            Way::Stall(_) | Way::Restart(_) => {}
        }
    }

    fn judge(&mut self, trial: u32, act: Act, Told { at, sent, event }: &Told) {
        let Plan { way, setting, .. } = self.plan;
        let after = at.since(act.began);
        let (silent, bound) = match event {
            // The event's own values.
            NodeEvent::NodeLost { silent_us, bound_us, .. }
            | NodeEvent::NodeRestarted { silent_us, bound_us, .. } => {
                (Duration::from_micros(*silent_us), Duration::from_micros(*bound_us))
            }
            NodeEvent::NodeFound { .. } | NodeEvent::AppStalled { .. } | NodeEvent::AppResumed { .. } => {
                (Duration::ZERO, way.bound(setting))
            }
        };
        let since_the_act = at.since(act.over);
        self.seen.told.record(after);
        if way.is_told_by(event) {
            self.seen.right += 1;
        } else {
            let lasted = act.over.since(act.began);
            eprintln!("{}: trial {trial}: wrong {after:?} after an act of {lasted:?}: {event:?}", self.case);
        }
        self.seen.held += u64::from(silent <= bound);
        self.seen.in_time += u64::from(since_the_act <= bound);
        let over = silent.max(since_the_act).saturating_sub(bound);
        if over > self.seen.over {
            self.seen.over = over;
            let waited = at.since(*sent);
            eprintln!(
                "{}: trial {trial}: {over:?} above its bound after {after:?}, {waited:?} of it on the way here: {event:?}",
                self.case
            );
        }
    }

    fn surprise(&mut self, trial: u32, event: &NodeEvent) {
        self.seen.surprises += 1;
        eprintln!("{}: trial {trial}: a surprise: {event:?}", self.case);
    }

    fn report(&self) {
        let (case, Plan { way, setting, seed, .. }, seen) = (self.case, self.plan, &self.seen);
        let micros = |time: Duration| u64::try_from(time.as_micros()).unwrap_or(u64::MAX);
        let counts = [
            ("right", seen.right),
            ("bound_us", micros(way.bound(setting))),
            ("held", seen.held),
            ("in_time", seen.in_time),
            ("over_us", micros(seen.over)),
            ("surprises", seen.surprises),
            ("own_stalls", starved::told().0),
            ("seed", seed),
        ];
        Alone { bench: "detection", case, figure: "act to event", seen: &seen.told, counts: &counts }
            .report();
        if matches!(way, Way::Restart(_)) {
            let figure = "act to new life";
            Alone { bench: "detection", case, figure, seen: &seen.new_life, counts: &[] }.report();
        }
    }
}
