//! The claim: processes that are killed at any instant while they hold loans leave nothing behind, and the
//! others are not affected.
//!
//! There are three kinds of segments: no process ends, processes end in order, and processes are killed. They
//! alternate in short segments of one length, and each kind comes first equally often. Other load on the
//! machine affects all of them equally.

mod felt;

use sinew_testkit::NodeProcess;
use sinew_testkit::Resources;
use std::{
    collections::BTreeSet,
    fmt, fs,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use rustix::process::setpriority_process;

use super::{
    FixtureLimits, NodeFixture,
    steady::{ECHO, PARTS, SINK, Window},
};
use sinew_testkit::{DEADLINE, random::SeededRandom, until};

pub use felt::{Felt, Verdict};

/// Processes that are killed.
const VICTIMS: u16 = 4;
/// Kills before the measurement starts.
const WARM_UP: u32 = 20;
/// Processes that end in one segment. Their replacements are started outside of the measurement, because the
/// cost of starting a program on a machine with two CPUs is not the subject here.
const ENDS_A_SEGMENT: u32 = 20;
/// One of this many kills waits until its victim holds loans: on a slow machine no victim would get that far
/// by itself.
const HOLDS_EACH: u32 = 4;
/// Memory growth of one process that its allocator may keep for itself.
const GROWTH_MAX_KIB: u64 = 2 * 1024;

/// The parameters of a run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Number of kills.
    pub kills: u32,
    /// One process ends in each such interval, at a random instant.
    pub spacing: Duration,
    /// One of this many segments with kills is accompanied by a segment with orderly ends, and one without
    /// ends.
    pub reference_each: u32,
    /// Seed of the victims and the instants.
    pub seed: u64,
    /// Runs the victims at the lowest priority, as programs beside a control loop should. The measurement is
    /// about their cost for the node and its other clients, not about four busy processes on a machine with
    /// two CPUs.
    pub yields: bool,
}

/// The results.
#[derive(Debug)]
pub struct Report {
    kills: u32,
    seconds: f64,
    /// Victims killed while all their addresses held received messages and lent memory.
    pub held_loans: u32,
    /// Processes that ended by themselves, which none should.
    pub ended_by_themselves: u32,
    /// Resources of each surviving process, before and after the kills.
    pub held: Vec<(&'static str, Resources, Resources)>,
    /// Round trips of the others in all segments of each kind: no ends, orderly ends, kills.
    pub windows: [Window; 3],
    /// The segments without ends, split into alternate halves. With enough round trips and no noise both
    /// would be equal.
    pub halves: [Window; 2],
    spacing: Duration,
    /// Files that did not exist before.
    pub left: Vec<PathBuf>,
}

impl Report {
    /// Returns whether everything was released, nothing was left behind, and all others were served. Latency
    /// is judged by [`felt`](Self::felt).
    #[must_use]
    pub fn holds(&self) -> bool {
        let is_back = |(_, before, after): &(&str, Resources, Resources)| {
            after.is_back_at(before) && after.own_kib <= before.own_kib + GROWTH_MAX_KIB
        };
        self.left.is_empty()
            && self.held_loans > 0
            && self.ended_by_themselves == 0
            && self.held.iter().all(is_back)
            && self.windows.iter().all(|window| window.failed == 0)
    }

    /// Returns whether the others were slowed down by the kills.
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
        for (role, before, after) in held {
            writeln!(f, "{role:<8} before {before}\n{:<8} after  {after}", "")?;
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

struct Scenario {
    plan: Plan,
    fixture: NodeFixture,
    steady: Vec<(&'static str, NodeProcess)>,
    victims: Vec<Option<Victim>>,
    understudies: Vec<Victim>,
    started: u64,
    random: SeededRandom,
    held_loans: u32,
    ended_by_themselves: u32,
}

/// A process to be killed, and its reports.
struct Victim {
    process: NodeProcess,
    /// It runs, and waits for its slot.
    waits: Arc<AtomicBool>,
    /// All its addresses hold loans.
    holds: Arc<AtomicBool>,
}

/// The way a victim ends.
#[derive(Clone, Copy)]
enum End {
    Killed,
    InOrder,
}

/// The parts of the measurement.
#[derive(Clone, Copy)]
enum Part {
    NobodyEnds,
    /// Every other segment without ends.
    NobodyEndsEither,
    InOrder,
    Killed,
}

const _: () = assert!(Part::Killed as usize + 1 == PARTS, "the pinger distinguishes as many");

impl Part {
    const fn ends(self) -> Option<End> {
        match self {
            Self::NobodyEnds | Self::NobodyEndsEither => None,
            Self::InOrder => Some(End::InOrder),
            Self::Killed => Some(End::Killed),
        }
    }
}

impl Scenario {
    fn new(plan: Plan) -> Self {
        let limits = FixtureLimits { mailbox_capacity: 256, payload_max: 1 << 20, clients_max: 256 };
        let fixture = NodeFixture::new(limits);
        let start = |role: &'static str, arguments: &[&str]| {
            let mut process = fixture.start(role, arguments);
            process.expect("up");
            process
        };
        let steady = vec![
            (ECHO, start("taker", &[ECHO])),
            (SINK, start("taker", &[SINK])),
            ("pinger", start("pinger", &[])),
        ];
        let (random, victims) = (SeededRandom::new(plan.seed), (0..VICTIMS).map(|_| None).collect());
        let mut scenario = Self {
            plan,
            fixture,
            steady,
            victims,
            understudies: Vec::new(),
            started: 0,
            random,
            held_loans: 0,
            ended_by_themselves: 0,
        };
        if scenario.plan.yields {
            // Inherited by every process that this thread starts from now on.
            setpriority_process(None, 19).expect("anybody may be nicer");
        }
        scenario.fill();
        scenario
    }

    /// Starts processes that wait for their slot.
    fn prepare(&mut self, how_many: u32) {
        for _ in 0..how_many {
            self.started += 1;
            let (waits, holds) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
            let (says_it_waits, says_it_holds) = (waits.clone(), holds.clone());
            let take = move |line: &str| {
                match line {
                    "waits" => says_it_waits.store(true, Ordering::Relaxed),
                    "holds" => says_it_holds.store(true, Ordering::Relaxed),
                    _ => panic!("no victim prints {line:?}"),
                }
                true
            };
            let [all, seed] =
                [u64::from(VICTIMS), self.plan.seed ^ self.started].map(|number| number.to_string());
            let process = self.fixture.start_with("victim", &[&all, &seed], take);
            self.understudies.push(Victim { process, waits, holds });
        }
        until("all understudies wait", || {
            self.understudies.iter().all(|one| one.waits.load(Ordering::Relaxed)).then_some(())
        });
    }

    /// Fills every slot.
    fn fill(&mut self) {
        self.prepare(VICTIMS.into());
        (0..VICTIMS).for_each(|place| self.take_place(place));
    }

    fn take_place(&mut self, place: u16) {
        let mut victim = self.understudies.pop().expect("as many were started as end");
        victim.process.send_line(&place.to_string());
        self.victims[usize::from(place)] = Some(victim);
    }

    fn wait_until_it_holds(&self, place: u16) {
        let Some(victim) = &self.victims[usize::from(place)] else { return };
        until("a victim holds loans in all its addresses", || {
            victim.holds.load(Ordering::Relaxed).then_some(())
        });
    }

    fn end(&mut self, place: u16, how: End) {
        let Some(Victim { mut process, holds, .. }) = self.victims[usize::from(place)].take() else { return };
        match how {
            End::Killed => {
                self.ended_by_themselves += u32::from(!process.kill());
                self.held_loans += u32::from(holds.load(Ordering::Relaxed));
            }
            End::InOrder => self.ended_by_themselves += u32::from(!process.stop().success()),
        }
    }

    /// Runs one segment: each process ends at a random instant of its interval, and another one takes its
    /// slot at once.
    fn measure(&mut self, part: Part, times: u32) {
        self.tell_pinger(&format!("measure {}", part as usize));
        let (began, spacing) = (Instant::now(), self.plan.spacing);
        for time in 0..times {
            let instant = spacing * time + self.random.time_below(spacing);
            thread::sleep((began + instant).saturating_duration_since(Instant::now()));
            let Some(how) = part.ends() else { continue };
            let place = self.random.below(VICTIMS.into()) as u16;
            if time % HOLDS_EACH == HOLDS_EACH - 1 && matches!(how, End::Killed) {
                self.wait_until_it_holds(place);
            }
            self.end(place, how);
            self.take_place(place);
        }
        // Effects of the last end must fall into this segment, not into the next one.
        thread::sleep((began + spacing * (times + 1)).saturating_duration_since(Instant::now()));
        self.tell_pinger("rest");
    }

    /// Runs all segments.
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
        self.pinger().send_line(order);
    }

    fn pinger(&mut self) -> &mut NodeProcess {
        &mut self.steady.last_mut().expect("it is the pinger").1
    }

    /// Measurements of the pinger in these parts.
    fn window(&mut self, parts: &[Part]) -> Window {
        let parts: Vec<_> = parts.iter().map(|part| (*part as usize).to_string()).collect();
        Window::read(&self.pinger().ask(&format!("window {}", parts.join(" "))))
    }

    /// The resources of all surviving processes once all victims are gone.
    fn held_at_rest(&mut self, before: Option<&[Resources]>) -> Vec<Resources> {
        (0..VICTIMS).for_each(|victim| self.end(victim, End::Killed));
        let processes: Vec<u32> = [self.fixture.node().id()]
            .into_iter()
            .chain(self.steady.iter().map(|(_, one)| one.id()))
            .collect();
        let now = || -> Vec<Resources> { processes.iter().map(|process| Resources::of(*process)).collect() };
        let end = Instant::now() + DEADLINE;
        let is_back = |now: &[Resources]| {
            before.is_none_or(|before| now.iter().zip(before).all(|(now, before)| now.is_back_at(before)))
        };
        // Samples until stable, so that links being made or closed do not count.
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
        files_of_the_host().into_iter().chain(self.fixture.files()).collect()
    }
}

/// Kills processes and reports the effects.
///
/// # Panics
/// If a process does not start, or one that was not killed exits.
#[must_use]
pub fn run(plan: Plan) -> Report {
    let (kills, spacing) = (plan.kills, plan.spacing);
    let mut scenario = Scenario::new(plan);
    scenario.prepare(WARM_UP);
    scenario.measure(Part::Killed, WARM_UP);
    let before = scenario.held_at_rest(None);
    let files = scenario.files();
    scenario.fill();
    scenario.tell_pinger("forget");

    scenario.held_loans = 0;
    let began = Instant::now();
    scenario.measure_all();
    let (seconds, held_loans) = (began.elapsed().as_secs_f64(), scenario.held_loans);
    let halves = [Part::NobodyEnds, Part::NobodyEndsEither].map(|part| scenario.window(&[part]));
    let windows = [&[Part::NobodyEnds, Part::NobodyEndsEither][..], &[Part::InOrder], &[Part::Killed]];
    let windows = windows.map(|parts| scenario.window(parts));
    let ended_by_themselves = scenario.ended_by_themselves;

    let after = scenario.held_at_rest(Some(&before));
    let left = scenario.files().difference(&files).cloned().collect();
    let names = ["node"].into_iter().chain(scenario.steady.iter().map(|(name, _)| *name));
    let held = names.zip(before.into_iter().zip(after)).map(|(name, (before, after))| (name, before, after));
    let held = held.collect();
    // The requesting client ends first.
    for (role, process) in scenario.steady.into_iter().rev() {
        let status = process.stop();
        assert!(status.success(), "{role} ended with {status}");
    }
    scenario.fixture.end();
    Report { kills, seconds, held_loans, ended_by_themselves, held, windows, halves, spacing, left }
}

/// Files that outlive the process that made them: named shared memory, and Sinew's temporary files.
fn files_of_the_host() -> BTreeSet<PathBuf> {
    let list = |path: &str| fs::read_dir(path).into_iter().flatten().flatten().map(|entry| entry.path());
    let is_ours = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        // Other tests of this run have directories of their own.
        name.contains("sinew") && !name.starts_with("sinew-test-")
    };
    list("/dev/shm").chain(list("/tmp").filter(is_ours)).collect()
}
