//! The claim: processes that are killed at any instant, with loans in their hands, leave nothing behind, and the others do not
//! feel it.
//!
//! Times in which nobody ends, in which processes end in order, and in which they are killed follow each other in short segments of one
//! length, each first as often as the others: what the machine does besides is in all of them alike.

mod felt;

use std::{
    collections::BTreeSet,
    fmt,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, sync_channel},
    },
    thread,
    time::{Duration, Instant},
};

use rustix::process::setpriority_process;

use super::{
    Performer, Stage, StageLimits,
    held::{Held, files_of_the_host},
    steady::{ECHO, PARTS, SINK, Window},
};
use crate::{DEADLINE, dice::Dice, until};

pub use felt::{Felt, Verdict};

/// Processes that are killed.
const VICTIMS: u16 = 4;
/// Kills before anything is measured.
const WARM_UP: u32 = 20;
/// Processes that end in one segment. Those that take their places are started while nothing is measured, since what starting a program
/// costs a machine of two CPUs is not what is asked here.
const ENDS_A_SEGMENT: u32 = 20;
/// Of so many kills one waits until its victim holds loans: on a machine that is slow none would come so far by itself.
const HOLDS_EACH: u32 = 4;
/// Growth of the memory of one process that its allocator may have for itself.
const GROWTH_MAX_KIB: u64 = 2 * 1024;

/// What is to be done.
#[derive(Clone, Debug)]
pub struct Plan {
    /// A program whose `main` calls [`play`](super::play) first.
    pub program: PathBuf,
    /// How often a process is killed.
    pub kills: u32,
    /// One process ends in each such time, at any instant of it.
    pub spacing: Duration,
    /// Of so many segments with kills one has a segment with orderly ends beside it, and one in which nobody ends.
    pub reference_each: u32,
    /// Decides who is killed when.
    pub seed: u64,
    /// Those that are killed have the lowest priority, as programs beside a control loop should: what is measured is what they cost
    /// the node and its other clients, not what four busy processes cost a machine of two CPUs.
    pub yields: bool,
}

/// What was seen.
#[derive(Debug)]
pub struct Report {
    kills: u32,
    seconds: f64,
    /// Killed while all its addresses held messages that they had received, and lent memory.
    pub held_loans: u32,
    /// Ended by themselves, which none should have.
    pub ended_by_themselves: u32,
    /// Of each process that lives on: before and after the kills.
    pub held: Vec<(&'static str, Held, Held)>,
    /// Round trips of others, in all segments of each sort: nobody ends, as many as are killed end in order, they are killed.
    pub windows: [Window; 3],
    /// Those in which nobody ends, every other one of them: two figures that would be one, were there enough of them and no chance.
    pub halves: [Window; 2],
    spacing: Duration,
    /// Files that were not there before.
    pub left: Vec<PathBuf>,
}

impl Report {
    /// Everything was given back, nothing was left, and everybody was served. How fast is not asked: that is [`felt`](Self::felt).
    #[must_use]
    pub fn holds(&self) -> bool {
        let is_back = |(_, before, after): &(&str, Held, Held)| {
            after.is_back_at(before) && after.own_kib <= before.own_kib + GROWTH_MAX_KIB
        };
        self.left.is_empty()
            && self.held_loans > 0
            && self.ended_by_themselves == 0
            && self.held.iter().all(is_back)
            && self.windows.iter().all(|window| window.failed == 0)
    }

    /// Whether others felt the kills.
    #[must_use]
    pub fn felt(&self) -> Felt {
        Felt::new(&self.windows, &self.halves, self.spacing)
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kills, seconds, held_loans, ended_by_themselves, held, windows, left, spacing, .. } = self;
        writeln!(
            f,
            "{kills} kills, one in {spacing:?}, in {seconds:.1} s; {held_loans} of them while every address held loans"
        )?;
        writeln!(f, "{ended_by_themselves} processes ended by themselves")?;
        for (who, before, after) in held {
            writeln!(f, "{who:<8} before {before}\n{:<8} after  {after}", "")?;
        }
        for (what, window) in ["nobody ends", "they end in order", "they are killed"].iter().zip(windows) {
            writeln!(f, "{what:<18} {window}")?;
        }
        writeln!(f, "{}", self.felt())?;
        write!(
            f,
            "expected: descriptors and mappings back to the start, at most {GROWTH_MAX_KIB} KiB more, no file left, no \
             round trip failed; seen: {}, files left: {left:?}",
            if self.holds() { "so" } else { "NOT SO" }
        )
    }
}

struct Cast {
    plan: Plan,
    stage: Stage,
    steady: Vec<(&'static str, Performer)>,
    answers: Receiver<String>,
    victims: Vec<Option<Victim>>,
    understudies: Vec<Victim>,
    started: u64,
    dice: Dice,
    held_loans: u32,
    ended_by_themselves: u32,
}

/// A process that is killed, and what it has said.
struct Victim {
    performer: Performer,
    /// It runs, and waits for its place.
    waits: Arc<AtomicBool>,
    /// All its addresses hold loans.
    holds: Arc<AtomicBool>,
}

/// How a victim ends.
#[derive(Clone, Copy)]
enum End {
    Killed,
    InOrder,
}

/// What is measured by itself.
#[derive(Clone, Copy)]
enum Part {
    NobodyEnds,
    /// Every other segment of these.
    NobodyEndsEither,
    InOrder,
    Killed,
}

const _: () = assert!(Part::Killed as usize + 1 == PARTS, "the pinger tells so many apart");

impl Part {
    const fn ends(self) -> Option<End> {
        match self {
            Self::NobodyEnds | Self::NobodyEndsEither => None,
            Self::InOrder => Some(End::InOrder),
            Self::Killed => Some(End::Killed),
        }
    }
}

impl Cast {
    fn new(plan: Plan) -> Self {
        let limits = StageLimits { mailbox_capacity: 256, payload_max: 1 << 20, clients_max: 256 };
        let stage = Stage::new(&plan.program, limits);
        let (say, answers) = sync_channel(64);
        let start = |role: &'static str, arguments: &[&str]| {
            let say = say.clone();
            let arguments: Vec<_> = arguments.iter().map(|&argument| argument.to_owned()).collect();
            // Nobody hears it any more when the director has gone.
            let performer = stage.start(role, &arguments, move |line| drop(say.send(line.to_owned())));
            assert_eq!(answers.recv_timeout(DEADLINE).as_deref(), Ok("up"), "{role} comes up");
            performer
        };
        let steady = vec![
            (ECHO, start("taker", &[ECHO])),
            (SINK, start("taker", &[SINK])),
            ("pinger", start("pinger", &[])),
        ];
        let (dice, victims) = (Dice::new(plan.seed), (0..VICTIMS).map(|_| None).collect());
        let mut cast = Self {
            plan,
            stage,
            steady,
            answers,
            victims,
            understudies: Vec::new(),
            started: 0,
            dice,
            held_loans: 0,
            ended_by_themselves: 0,
        };
        if cast.plan.yields {
            // Inherited by every process that this thread starts from now on.
            setpriority_process(None, 19).expect("anybody may be nicer");
        }
        cast.fill();
        cast
    }

    /// Starts processes that wait for their place.
    fn prepare(&mut self, how_many: u32) {
        for _ in 0..how_many {
            self.started += 1;
            let (waits, holds) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
            let (says_it_waits, says_it_holds) = (waits.clone(), holds.clone());
            let hear = move |line: &str| match line {
                "waits" => says_it_waits.store(true, Ordering::Relaxed),
                "holds" => says_it_holds.store(true, Ordering::Relaxed),
                _ => panic!("no victim says {line:?}"),
            };
            let seed = (self.plan.seed ^ self.started).to_string();
            let performer = self.stage.start("victim", &[VICTIMS.to_string(), seed], hear);
            self.understudies.push(Victim { performer, waits, holds });
        }
        until("all understudies wait", || {
            self.understudies.iter().all(|one| one.waits.load(Ordering::Relaxed)).then_some(())
        });
    }

    /// Every place is taken.
    fn fill(&mut self) {
        self.prepare(VICTIMS.into());
        (0..VICTIMS).for_each(|place| self.take_place(place));
    }

    fn take_place(&mut self, place: u16) {
        let mut victim = self.understudies.pop().expect("as many were started as end");
        victim.performer.tell(&place.to_string());
        self.victims[usize::from(place)] = Some(victim);
    }

    fn wait_until_it_holds(&self, place: u16) {
        let Some(victim) = &self.victims[usize::from(place)] else { return };
        until("a victim holds loans in all its addresses", || {
            victim.holds.load(Ordering::Relaxed).then_some(())
        });
    }

    fn end(&mut self, place: u16, how: End) {
        let Some(Victim { performer, holds, .. }) = self.victims[usize::from(place)].take() else { return };
        match how {
            End::Killed => {
                self.ended_by_themselves += u32::from(!performer.kill());
                self.held_loans += u32::from(holds.load(Ordering::Relaxed));
            }
            End::InOrder => self.ended_by_themselves += u32::from(!performer.end().success()),
        }
    }

    /// One segment: each process ends at any instant of its part of the time, and another one takes its place at once.
    fn measure(&mut self, part: Part, times: u32) {
        self.tell_pinger(&format!("measure {}", part as usize));
        let (began, spacing) = (Instant::now(), self.plan.spacing);
        for time in 0..times {
            let instant = spacing * time + self.dice.time_below(spacing);
            thread::sleep((began + instant).saturating_duration_since(Instant::now()));
            let Some(how) = part.ends() else { continue };
            let place = self.dice.below(VICTIMS.into()) as u16;
            if time % HOLDS_EACH == HOLDS_EACH - 1 && matches!(how, End::Killed) {
                self.wait_until_it_holds(place);
            }
            self.end(place, how);
            self.take_place(place);
        }
        // What the last one has left is felt here, and not in the next segment.
        thread::sleep((began + spacing * (times + 1)).saturating_duration_since(Instant::now()));
        self.tell_pinger("rest");
    }

    /// All segments.
    fn measure_all(&mut self) {
        let mut left = self.plan.kills;
        for round in 0_usize.. {
            let times = left.min(ENDS_A_SEGMENT);
            if times == 0 {
                return;
            }
            left -= times;
            if !round.is_multiple_of(self.plan.reference_each as usize) {
                self.prepare(times);
                self.measure(Part::Killed, times);
                continue;
            }
            self.prepare(2 * times);
            let reference = round / self.plan.reference_each as usize;
            let quiet = if reference.is_multiple_of(2) { Part::NobodyEnds } else { Part::NobodyEndsEither };
            let mut parts = [quiet, Part::InOrder, Part::Killed];
            parts.rotate_left(reference % 3);
            parts.into_iter().for_each(|part| self.measure(part, times));
        }
    }

    fn tell_pinger(&mut self, order: &str) {
        self.steady.last_mut().expect("it is the pinger").1.tell(order);
    }

    /// What the pinger measured in these parts.
    fn window(&mut self, parts: &[Part]) -> Window {
        let parts: Vec<_> = parts.iter().map(|part| (*part as usize).to_string()).collect();
        self.tell_pinger(&format!("window {}", parts.join(" ")));
        Window::read(&self.answers.recv_timeout(DEADLINE).expect("the pinger answers"))
    }

    /// What everybody holds who lives on, when all victims are gone.
    fn held_at_rest(&mut self, before: Option<&[Held]>) -> Vec<Held> {
        (0..VICTIMS).for_each(|victim| self.end(victim, End::Killed));
        let processes: Vec<u32> =
            [self.stage.node_id()].into_iter().chain(self.steady.iter().map(|(_, one)| one.id())).collect();
        let now = || -> Vec<Held> { processes.iter().map(|process| Held::of(*process)).collect() };
        let end = Instant::now() + DEADLINE;
        let is_back = |now: &[Held]| {
            before.is_none_or(|before| now.iter().zip(before).all(|(now, before)| now.is_back_at(before)))
        };
        // Links that are being made or ended count as neither.
        let mut last = Vec::new();
        until("nobody holds more or less than before", || {
            thread::sleep(Duration::from_millis(300));
            let counts: Vec<_> = now().iter().map(|held| (held.descriptors, held.memories)).collect();
            let rests = counts == last;
            last = counts;
            rests.then_some(())
        });
        while !is_back(&now()) && Instant::now() < end {
            thread::sleep(Duration::from_millis(20));
        }
        now()
    }

    fn files(&self) -> BTreeSet<PathBuf> {
        files_of_the_host().into_iter().chain(self.stage.files()).collect()
    }
}

/// Kills processes and says what that left.
///
/// # Panics
/// If one does not start, or those that are not killed end.
#[must_use]
pub fn run(plan: Plan) -> Report {
    let (kills, spacing) = (plan.kills, plan.spacing);
    let mut cast = Cast::new(plan);
    cast.prepare(WARM_UP);
    cast.measure(Part::Killed, WARM_UP);
    let before = cast.held_at_rest(None);
    let files = cast.files();
    cast.fill();
    cast.tell_pinger("forget");

    cast.held_loans = 0;
    let began = Instant::now();
    cast.measure_all();
    let (seconds, held_loans) = (began.elapsed().as_secs_f64(), cast.held_loans);
    let halves = [Part::NobodyEnds, Part::NobodyEndsEither].map(|part| cast.window(&[part]));
    let windows = [&[Part::NobodyEnds, Part::NobodyEndsEither][..], &[Part::InOrder], &[Part::Killed]];
    let windows = windows.map(|parts| cast.window(parts));
    let ended_by_themselves = cast.ended_by_themselves;

    let after = cast.held_at_rest(Some(&before));
    let left = cast.files().difference(&files).cloned().collect();
    let names = ["node"].into_iter().chain(cast.steady.iter().map(|(name, _)| *name));
    let held = names.zip(before.into_iter().zip(after)).map(|(name, (before, after))| (name, before, after));
    let held = held.collect();
    // The one that asks first.
    for (who, performer) in cast.steady.into_iter().rev() {
        let status = performer.end();
        assert!(status.success(), "{who} ended with {status}");
    }
    cast.stage.end();
    Report { kills, seconds, held_loans, ended_by_themselves, held, windows, halves, spacing, left }
}
