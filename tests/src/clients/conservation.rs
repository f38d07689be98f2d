//! The claim: of what 8 processes with 64 addresses send each other, and applications of the node besides, every message has
//! one fate that is true, whichever of the processes are killed.

use std::{
    fmt,
    path::PathBuf,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use sinew::audit::Audit;

use super::{
    Performer, Stage, StageLimits,
    entry::{Entry, Poster},
    ledger::{Account, Fate, Ledger},
    poster::{CAPACITY, POSTERS},
};
use crate::{dice::Dice, until};

/// Posters in the node's own process, besides those in processes of their own.
const RESIDENTS: Poster = 8;

/// What is to be done.
#[derive(Clone, Debug)]
pub struct Plan {
    /// A program whose `main` calls [`play`](super::play) first.
    pub program: PathBuf,
    /// Processes, each with 8 addresses.
    pub processes: Poster,
    /// How often a process is killed.
    pub kills: u32,
    /// Mean time between two kills.
    pub spacing: Duration,
    /// How long a poster waits for messages before it sends again, at most.
    pub pause: Duration,
    /// Decides who is killed when, and who sends what to whom.
    pub seed: u64,
}

/// What was seen.
#[derive(Debug)]
pub struct Report {
    /// What became of the messages.
    pub account: Account,
    seconds: f64,
    seed: u64,
    refused: u64,
    /// What the node itself says of all messages, at the end.
    pub audit: Audit,
}

impl Report {
    /// The law held, in the history and in the node's own counters, and every kind of message was there.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.audit.missing() == 0
            && self.account.holds()
            && self.account.of(Fate::Delivered) > 0
            && self.account.confirmed_delivered > 0
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { account, seconds, seed, refused, audit } = self;
        let rate = account.sent() as f64 / seconds;
        writeln!(
            f,
            "seed {seed}: {} messages in {seconds:.1} s, {rate:.0} a second; the node refused {refused}",
            account.sent()
        )?;
        write!(f, "{account}")?;
        // A line for each of so many applications is read when something is wrong.
        if audit.missing() > 0 {
            write!(f, "\n{audit}")
        } else {
            write!(f, "\nthe audit explains every message")
        }
    }
}

type Shared = Arc<Mutex<Ledger>>;

fn lock(ledger: &Shared) -> MutexGuard<'_, Ledger> {
    ledger.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The processes, with the number of the life that each is in.
struct Cast {
    plan: Plan,
    stage: Stage,
    ledger: Shared,
    lives: Vec<(u32, Option<Performer>)>,
}

impl Cast {
    fn new(plan: Plan) -> Self {
        let limits = StageLimits { mailbox_capacity: CAPACITY, payload_max: 1 << 20, clients_max: 256 };
        let (ledger, first) = (Shared::default(), plan.processes * POSTERS);
        let arguments =
            [u64::from(first), u64::from(first + RESIDENTS), plan.seed].map(|number| number.to_string());
        let residents = ledger.clone();
        let stage =
            Stage::with_residents(&plan.program, limits, &arguments, move |line| note(&residents, 1, line));
        let lives = (0..plan.processes).map(|_| (0, None)).collect();
        let mut cast = Self { plan, stage, ledger, lives };
        (0..cast.plan.processes).for_each(|process| cast.start(process));
        cast
    }

    fn start(&mut self, process: Poster) {
        let Plan { processes, seed, pause, .. } = self.plan;
        let place = &mut self.lives[usize::from(process)];
        place.0 += 1;
        let (life, ledger) = (place.0, self.ledger.clone());
        let all = processes * POSTERS + RESIDENTS;
        let arguments = [u64::from(process), life.into(), all.into(), seed, pause.as_millis() as u64];
        let arguments = arguments.map(|number| number.to_string());
        place.1 = Some(self.stage.start("poster", &arguments, move |line| note(&ledger, life, line)));
    }

    fn kill(&mut self, process: Poster) {
        let place = &mut self.lives[usize::from(process)];
        let lived = place.1.take().expect("it was started").kill();
        let mut ledger = lock(&self.ledger);
        if !lived {
            let why = Entry::Broken("its process ended by itself".to_owned());
            ledger.note(process * POSTERS, place.0, why);
        }
        posters_of(process).for_each(|poster| ledger.killed(poster, place.0));
    }

    /// Whether every poster has its address.
    fn is_up(&self) -> bool {
        let ledger = lock(&self.ledger);
        (0..)
            .zip(&self.lives)
            .all(|(process, (life, _))| posters_of(process).all(|poster| ledger.is_up(poster, *life)))
    }

    fn kill_some(&mut self) {
        let mut dice = Dice::new(self.plan.seed);
        for _ in 0..self.plan.kills {
            std::thread::sleep(dice.time_below(self.plan.spacing * 2));
            let process = dice.below(self.plan.processes.into()) as Poster;
            self.kill(process);
            self.start(process);
        }
        until("every poster has its address", || self.is_up().then_some(()));
        // What is sent when all are there is owed to all.
        std::thread::sleep(self.plan.spacing);
    }

    fn come_to_rest(&mut self) {
        for (_, performer) in &mut self.lives {
            performer.as_mut().expect("it was started").tell("quiet");
        }
        self.stage.quiet();
        until("the posters send no more", || lock(&self.ledger).is_quiet().then_some(()));
        // What is on its way after that is in the report.
        let end = Instant::now() + crate::DEADLINE;
        while lock(&self.ledger).account().of(Fate::InFlight) > 0 && Instant::now() < end {
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    fn end(self) -> Stage {
        for (_, performer) in self.lives {
            let status = performer.expect("it was started").end();
            assert!(status.success(), "a poster ended with {status}");
        }
        self.stage
    }
}

fn posters_of(process: Poster) -> std::ops::Range<Poster> {
    process * POSTERS..(process + 1) * POSTERS
}

fn note(ledger: &Shared, life: u32, line: &str) {
    let (who, entry) = line.split_once(' ').unwrap_or((line, ""));
    let (who, entry): (Poster, Entry) = match (who.parse(), entry.parse()) {
        (Ok(who), Ok(entry)) => (who, entry),
        (who, entry) => panic!("{line:?}: {who:?} {entry:?}"),
    };
    lock(ledger).note(who, life, entry);
}

/// Lets the processes send and be killed, and says what became of the messages.
///
/// # Panics
/// If one does not start, or does not come to rest.
#[must_use]
pub fn run(plan: Plan) -> Report {
    let (seed, began) = (plan.seed, Instant::now());
    let mut cast = Cast::new(plan);
    until("every poster has its address", || cast.is_up().then_some(()));
    cast.kill_some();
    cast.come_to_rest();
    let ledger = cast.ledger.clone();
    let mut stage = cast.end();
    let refused = stage.refused();
    let audit = stage.audit();
    stage.end();
    let account = lock(&ledger).account();
    Report { account, seconds: began.elapsed().as_secs_f64(), seed, refused, audit }
}
