//! Phases as one node sees them: counted parties, released waits, and reports.

use sinew_model::barrier::{BarrierKind, OnPartyLoss};

use super::*;
use crate::{
    core::barriers::rendezvous::GRACE,
    list::{Ended, PHASES_MAX},
};

const SECOND: Duration = Duration::from_secs(1);
const MINUTE: Duration = Duration::from_secs(60);

fn answered(index: u32, correlation: u64, answer: BarrierAnswer) -> Output {
    Output::AnswerBarrier { app: app(index), correlation, answer }
}

fn opened(index: u32, correlation: u64) -> Output {
    answered(index, correlation, BarrierAnswer::Opened { generation: 1 })
}

/// A list of the knee in which its drive has reached these phases.
fn reached(version: u64, phases: &[&str]) -> List {
    let mut list = list(version, &[("knee.drive", true, &[])]);
    list.entries[0].phases =
        phases.iter().map(|phase| Name::try_from((*phase).to_owned()).unwrap()).collect();
    list
}

impl Bench {
    /// Creates a bench in which application 0 is "hip.drive"; the knee's drive has reached nothing.
    fn of_two_drives() -> Self {
        let mut bench = Self::new();
        bench.registers(0, "hip.drive", &[]);
        bench.links(KNEE, INCARNATION);
        bench.list(KNEE, reached(1, &[]));
        bench
    }

    fn reaches(&mut self, index: u32, phase: &str, correlation: u64) -> Vec<Output> {
        let asked = ArriveAtBarrier {
            barrier: phase.to_owned(),
            parties: ["hip.drive", "knee.drive"].map(str::to_owned).to_vec(),
            within_ms: 60_000,
            on_loss: OnPartyLoss::Fail,
            kind: BarrierKind::Phase,
        };
        self.handle(Input::Arrived { app: app(index), correlation, asked })
    }
}

// spec: SYNC-15
#[test]
fn phase_counts_until_the_life_ends() {
    let mut bench = Bench::of_two_drives();
    bench.passes(SPACING);
    let outputs = bench.reaches(0, "homed", 7);
    assert_eq!(published(&outputs)[0].entries[0].phases.len(), 1, "others are notified: {outputs:?}");
    assert!(!outputs.contains(&opened(0, 7)));
    assert!(bench.list(KNEE, reached(2, &["homed"])).contains(&opened(0, 7)));
    // The knee's drive continues, and the hip's is started again: neither waits.
    bench.ready(0);
    bench.list(KNEE, reached(3, &["homed", "armed"]));
    bench.down(0);
    assert_eq!(published(&bench.passes(SPACING))[0].entries[0].phases, [], "its next life has not homed yet");
    assert!(bench.reaches(0, "homed", 8).contains(&opened(0, 8)));
}

// spec: SYNC-15
#[test]
fn phase_requirement_releases_when_reached_and_reports_its_loss() {
    let mut bench = Bench::of_two_drives();
    assert_eq!(bench.registers(1, "gait", &["2 of *.drive at homed"]), []);
    bench.reaches(0, "homed", 7);
    let missing = [("2 of *.drive at homed (1 there): knee.drive".to_owned(), "has not reached this phase")];
    assert_eq!(in_words(bench.core.missing(bench.now, app(1))), missing);
    assert_eq!(bench.core.missing_in_brief(app(1)), missing);
    // Neither drive is ready.
    let mut homed = reached(2, &["homed"]);
    homed.entries[0].ready = false;
    assert!(bench.list(KNEE, homed).contains(&release(1)));
    bench.ready(1);
    let mut failed = reached(3, &[]);
    (failed.entries[0].ready, failed.entries[0].ended) = (false, Some(Ended::Failed));
    assert!(bench.list(KNEE, failed).contains(&lost(1, "2 of *.drive at homed", Reason::Failed)));
    assert!(bench.list(KNEE, reached(4, &["homed"])).contains(&met(1, "2 of *.drive at homed")));
}

// spec: SYNC-15
#[test]
fn phase_wait_and_missing_parties_are_listed_and_reported() {
    let mut bench = Bench::of_two_drives();
    bench.reaches(0, "homed", 7);
    let missing = vec![("knee.drive at homed".to_owned(), "has not reached this phase".to_owned())];
    let status = bench.core.barriers(bench.now).remove(0);
    assert_eq!(
        (status.barrier.as_str(), status.kind, in_words(status.missing)),
        ("homed", BarrierKind::Phase, vec![("knee.drive at homed".to_owned(), "has not reached this phase")])
    );
    assert_eq!(status.waiting, [("hip.drive".to_owned(), Duration::ZERO)]);
    bench.passes(SECOND);
    let [absence] = &bench.core.barriers(bench.now).remove(0).missing[..] else { panic!("one is missing") };
    assert_eq!(absence.since, SECOND, "since somebody waits for it");
    let (apps, _) = bench.core.own_apps(bench.now, 1);
    assert_eq!((apps[0].missing.len(), apps[0].waits), (1, Some(SECOND)));
    let timed_out = answered(0, 7, BarrierAnswer::TimedOut { missing });
    assert!(bench.passes(MINUTE).contains(&timed_out));
    assert_eq!(bench.core.barriers(bench.now), []);
}

#[test]
fn missing_since_is_that_of_the_first_wait() {
    let mut bench = Bench::of_two_drives();
    bench.registers(1, "foot.drive", &[]);
    for index in [1, 0] {
        let asked = ArriveAtBarrier {
            barrier: "homed".to_owned(),
            parties: ["*.drive", "knee.drive"].map(str::to_owned).to_vec(),
            within_ms: 60_000,
            on_loss: OnPartyLoss::Wait,
            kind: BarrierKind::Phase,
        };
        bench.handle(Input::Arrived { app: app(index), correlation: 7, asked });
        bench.passes(SECOND);
    }
    let status = bench.core.barriers(bench.now).remove(0);
    assert_eq!((status.waiting.len(), status.missing.len()), (2, 1), "{status:?}");
    assert_eq!(status.missing[0].since, 2 * SECOND);
}

// spec: SYNC-15
#[test]
fn fail_on_loss_wait_at_a_phase_is_notified() {
    let mut bench = Bench::of_two_drives();
    bench.reaches(0, "homed", 7);
    bench.lost(KNEE, LossReason::Crashed);
    let missing = vec![("knee.drive at homed".to_owned(), "its node was lost".to_owned())];
    bench.passes(SPACING);
    let rest = GRACE - SPACING;
    assert_eq!(bench.core.next_wake(), Some(bench.now + rest));
    assert!(bench.passes(rest).contains(&answered(0, 7, BarrierAnswer::Lost { missing })));
}

// spec: SYNC-15
#[test]
fn leaving_or_ending_ends_the_wait_at_a_phase() {
    let mut bench = Bench::of_two_drives();
    bench.reaches(0, "homed", 7);
    let left = |correlation| Input::Left { app: app(0), barrier: "homed".to_owned(), correlation };
    bench.handle(left(Some(6)));
    assert_eq!(bench.core.barriers(bench.now).len(), 1);
    bench.handle(left(Some(7)));
    assert_eq!(bench.core.barriers(bench.now), []);
    assert!(bench.list(KNEE, reached(2, &["homed"])).iter().all(|output| *output != opened(0, 7)));
    bench.reaches(0, "armed", 8);
    bench.handle(Input::AppChanged(AppFact::Unregistered { app: app(0) }));
    assert_eq!(bench.core.barriers(bench.now), []);
}

// spec: SYNC-15
#[test]
fn invalid_phases_and_parties_are_rejected_with_a_reason() {
    let mut bench = Bench::of_two_drives();
    bench.registers(1, "gait", &[]);
    let refused = |outputs: Vec<Output>| match outputs.last() {
        Some(Output::AnswerBarrier { answer: BarrierAnswer::Refused { why }, .. }) => why.clone(),
        other => panic!("{other:?}"),
    };
    assert!(refused(bench.reaches(0, "two words", 7)).contains("one word"));
    assert!(refused(bench.reaches(1, "homed", 7)).contains("`*.drive at homed`"));
    for phase in 0..PHASES_MAX {
        bench.reaches(0, &phase.to_string(), 7);
    }
    assert!(refused(bench.reaches(0, "one more", 7)).contains("one word"));
    assert!(refused(bench.reaches(0, "more", 7)).contains("16 phases"));
}
