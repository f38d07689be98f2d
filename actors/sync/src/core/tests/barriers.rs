//! Run-time barriers as one node sees them: the state that it keeps, the reports that it believes, and the waits that
//! end.

use sinew_model::barrier::{BarrierKind, OnPartyLoss};
use sinew_runtime::app::Requirement;

use super::{
    barrier_fixture::{answered, awaited, idle},
    *,
};
use crate::{
    arrivals::{Arrivals, GENERATION_MAX, Member, Passed, PublishedBarrier},
    core::barriers::rendezvous::GRACE,
    list::Ended,
};

/// A younger incarnation of a process with the same address.
const DOUBLE: Incarnation = Incarnation(9);

// spec: SYNC-10
#[test]
fn barrier_known_only_to_others_displaces_no_state() {
    let mut bench = Bench::that_has_no_room();
    let outputs = bench.receives_arrivals(ANKLE, INCARNATION, 1, vec![idle("other", 5)]);
    assert_eq!((outputs.len(), bench.passes(SPACING).len()), (0, 0), "nothing is published");
}

// spec: SYNC-12
#[test]
fn late_arrival_meets_others_at_an_unkept_barrier() {
    let mut bench = Bench::that_has_no_room();
    bench.list(ANKLE, list(1, &[("knee", true, &[])]));
    bench.receives_arrivals(ANKLE, INCARNATION, 1, vec![awaited("other", 5)]);
    let outputs = bench.arrives("other", 7);
    assert!(outputs.contains(&answered(7, BarrierAnswer::Opened { generation: 6 })), "{outputs:?}");
}

// spec: SYNC-11
#[test]
fn linked_incarnation_counts_despite_a_duplicate() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, DOUBLE);
    bench.receives_arrivals(KNEE, DOUBLE, 7, vec![idle("calibrated", 0)]);
    bench.handle(Input::LinkChanged(LinkFact::LinkBroken { node: KNEE, incarnation: DOUBLE }));
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.receives_arrivals(KNEE, INCARNATION, 1, vec![awaited("calibrated", 0)]);
    let outputs = bench.arrives("calibrated", 7);
    assert!(outputs.contains(&answered(7, BarrierAnswer::Opened { generation: 1 })), "{outputs:?}");
}

// spec: SYNC-11
#[test]
fn rejected_frame_is_sent_to_the_new_incarnation_again() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.arrives("calibrated", 7);
    bench.breaks(KNEE);
    bench.links(KNEE, NEXT_INCARNATION);
    bench.handle(Input::ArrivalsRejected { to: KNEE });
    bench.lost(KNEE, LossReason::Restarted);
    let outputs = bench.passes(RETRY);
    assert!(
        outputs.iter().any(|output| matches!(output, Output::PublishArrivals { to: KNEE, .. })),
        "{outputs:?}"
    );
}

#[test]
fn end_of_an_unlinked_duplicate_is_no_loss() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, DOUBLE);
    bench.handle(Input::LinkChanged(LinkFact::LinkBroken { node: KNEE, incarnation: DOUBLE }));
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    let (node, incarnation, why) = (KNEE, DOUBLE, LossReason::Duplicate);
    bench.handle(Input::MembershipChanged(MembershipFact::NodeLost { node, incarnation, why }));
    let is_ready = |entry: &DirectoryEntry| entry.name == "knee" && entry.ready;
    assert!(bench.core.directory().iter().any(is_ready), "{:?}", bench.core.directory());
}

// spec: SYNC-13
#[test]
fn remote_failure_or_stop_ends_fail_on_loss_waits() {
    for (ended, why) in
        [(Ended::Failed, "failed, not ready again"), (Ended::Stopped, "stopped in order, not ready again")]
    {
        let mut bench = Bench::of_the_hip();
        bench.links(KNEE, INCARNATION);
        bench.list(KNEE, list(1, &[("knee", true, &[])]));
        bench.arrives("calibrated", 7);
        let mut changed = list(2, &[("knee", false, &[])]);
        changed.entries[0].ended = Some(ended);
        bench.list(KNEE, changed);
        let outputs = bench.passes(GRACE);
        let missing = vec![("knee".to_owned(), why.to_owned())];
        assert!(outputs.contains(&answered(7, BarrierAnswer::Lost { missing })), "{outputs:?}");
    }
}

// spec: SYNC-13
#[test]
fn each_lost_party_has_its_own_time_to_return() {
    let part = GRACE / 5;
    for kind in [BarrierKind::Meeting, BarrierKind::Phase] {
        let mut bench = Bench::of_the_hip();
        for (index, name) in [(1, "knee"), (2, "ankle")] {
            bench.registers(index, name, &[]);
            bench.ready(index);
        }
        let asked = ArriveAtBarrier {
            kind,
            barrier: "calibrated".to_owned(),
            parties: ["hip", "knee", "ankle"].map(str::to_owned).to_vec(),
            within_ms: 60_000,
            on_loss: OnPartyLoss::Fail,
        };
        bench.handle(Input::Arrived { app: app(0), correlation: 7, asked });
        bench.down(1);
        bench.passes(part);
        bench.down(2);
        bench.passes(part);
        bench.ready(1);
        let is_lost = |outputs: Vec<Output>| {
            let is_lost = |output: &Output| {
                matches!(output, Output::AnswerBarrier { answer: BarrierAnswer::Lost { .. }, .. })
            };
            outputs.iter().any(is_lost)
        };
        assert!(
            !is_lost(bench.passes(GRACE - 2 * part)),
            "{kind:?}: the knee is back, and the ankle has time"
        );
        assert!(is_lost(bench.passes(part)), "{kind:?}");
    }
}

#[test]
fn end_of_an_application_is_published_until_ready() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, INCARNATION);
    let ended = |bench: &mut Bench| published(&bench.passes(SPACING))[0].entries[0].ended;
    bench.down(0);
    assert_eq!(ended(&mut bench), Some(Ended::Failed));
    bench.handle(Input::AppChanged(AppFact::Stopped { app: app(0) }));
    assert_eq!(ended(&mut bench), Some(Ended::Stopped));
    bench.ready(0);
    assert_eq!(ended(&mut bench), None);
}

// spec: SYNC-12
#[test]
fn counted_member_passes_after_a_later_generation_is_known() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.arrives("calibrated", 7);
    let (node, incarnation) = (HERE, Incarnation(1));
    let hip = Member { node, incarnation, party: 1 };
    let later = PublishedBarrier { earlier: vec![Passed::new(hip, 2)], ..idle("calibrated", 3) };
    let outputs = bench.receives_arrivals(KNEE, INCARNATION, 1, vec![later]);
    assert!(outputs.contains(&answered(7, BarrierAnswer::Opened { generation: 2 })), "{outputs:?}");
    // Its next visit is behind the third generation, even if a node repeats that it has passed an earlier one.
    bench.arrives("calibrated", 8);
    let again = PublishedBarrier { earlier: vec![Passed::new(hip, 2)], ..idle("calibrated", 4) };
    let outputs = bench.receives_arrivals(KNEE, INCARNATION, 2, vec![again]);
    assert!(!outputs.iter().any(|output| matches!(output, Output::AnswerBarrier { .. })), "{outputs:?}");
}

// spec: SYNC-12
#[test]
fn passed_members_are_published_despite_a_reset_clock() {
    // Given: the knee was there in a later incarnation, by its clock
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, DOUBLE);
    bench.receives_arrivals(KNEE, DOUBLE, 7, vec![idle("calibrated", 0)]);
    bench.handle(Input::LinkChanged(LinkFact::LinkBroken { node: KNEE, incarnation: DOUBLE }));
    bench.links(ANKLE, INCARNATION);
    // When: in its present incarnation it has passed, as another node that has met it reports, and the knee does not
    // know of it
    let knee = Member { node: KNEE, incarnation: INCARNATION, party: 1 };
    let passed = PublishedBarrier { members: vec![knee], ..idle("calibrated", 1) };
    bench.receives_arrivals(ANKLE, INCARNATION, 1, vec![passed]);
    bench.receives_arrivals(ANKLE, INCARNATION, 2, vec![idle("calibrated", 2)]);
    // Then
    let outputs = bench.passes(Duration::from_secs(2));
    let frame = outputs.iter().rev().find_map(|output| {
        let Output::PublishArrivals { frame, .. } = output else { return None };
        Some(Arrivals::parse(frame).expect("a frame of this node"))
    });
    let frame = frame.expect("it is sent repeatedly");
    assert_eq!(frame.barriers[0].earlier, [Passed::new(knee, 1)]);
}

#[test]
fn missing_since_is_known_with_many_applications() {
    // Given: 40 applications of this node that wait for each other and for one more
    let mut bench = Bench::new();
    let names: Vec<String> = (0..40).map(|index| format!("drive.{index}")).collect();
    let parties: Vec<String> = names.iter().cloned().chain(["gait".to_owned()]).collect();
    for (index, name) in (0..).zip(&names) {
        bench.registers(index, name, &[]);
        bench.ready(index);
        let asked = ArriveAtBarrier {
            kind: BarrierKind::Meeting,
            barrier: "calibrated".to_owned(),
            parties: parties.clone(),
            within_ms: 60_000,
            on_loss: OnPartyLoss::Wait,
        };
        bench.handle(Input::Arrived { app: app(index), correlation: 7, asked });
    }
    // When: one leaves after a second
    bench.passes(Duration::from_secs(1));
    let barrier = "calibrated".to_owned();
    bench.handle(Input::Left { app: app(39), barrier, correlation: None });
    bench.passes(GRACE);
    // Then
    let status = bench.core.barriers(bench.now).remove(0);
    let since: Vec<_> = status.missing.iter().map(|absence| (absence.name.as_str(), absence.since)).collect();
    assert_eq!(since, [("drive.39", GRACE), ("gait", Duration::from_secs(1) + GRACE)]);
}

// spec: SYNC-12
#[test]
fn late_report_of_an_abandoned_visit_is_ignored() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.arrives("calibrated", 7);
    let is_over = |output: &Output| {
        matches!(output, Output::AnswerBarrier { correlation: 7, answer: BarrierAnswer::TimedOut { .. }, .. })
    };
    assert!(bench.passes(Duration::from_secs(61)).iter().any(is_over));
    bench.arrives("calibrated", 8);
    // The knee's node had opened the barrier for the first visit, and could not report it.
    let hip = Member { node: HERE, incarnation: Incarnation(1), party: 1 };
    let late = PublishedBarrier { members: vec![hip], ..idle("calibrated", 1) };
    let outputs = bench.receives_arrivals(KNEE, INCARNATION, 1, vec![late]);
    assert!(!outputs.iter().any(|output| matches!(output, Output::AnswerBarrier { .. })), "{outputs:?}");
}

// spec: SYNC-11
#[test]
fn barrier_frame_keeps_its_maximum_length() {
    let mut bench = Bench::of_the_hip();
    *bench.core.rendezvous_mut() = Rendezvous::new(HERE, Incarnation(1), 4_000);
    bench.links(KNEE, INCARNATION);
    let barriers = (0..100).map(|number| idle(&format!("round {number}"), 1)).collect();
    bench.receives_arrivals(KNEE, INCARNATION, 1, barriers);
    let outputs = [bench.arrives("calibrated", 7), bench.passes(SPACING)].concat();
    let frame = |output: &Output| {
        let Output::PublishArrivals { frame, .. } = output else { return None };
        Some(frame.clone())
    };
    let frames = outputs.iter().filter_map(frame);
    let frames: Vec<_> = frames.collect();
    assert!(frames.iter().all(|frame| frame.len() <= 4_000) && !frames.is_empty(), "{}", frames.len());
    let last = Arrivals::parse(&frames[frames.len() - 1]).unwrap();
    assert!(
        last.barriers.iter().any(|barrier| &*barrier.name == "calibrated" && barrier.arrivals.len() == 1)
    );
    assert!(last.barriers.len() > 20, "{}", last.barriers.len());
    let receives_arrivals = |output: &Output| matches!(output, Output::Refused { cause: "barriers", .. });
    assert!(outputs.iter().any(receives_arrivals), "that some have no room");
    // The barriers that local applications wait for get room, or the arrival is rejected.
    let refusals = (0..40).filter(|number| {
        let outputs = bench.arrives(&format!("own {number}"), 100 + number);
        outputs.iter().any(|output| {
            matches!(output, Output::AnswerBarrier { answer: BarrierAnswer::Refused { why }, .. } if why.contains("`node.payload_max`"))
        })
    });
    assert!(refusals.count() > 0);
}

// spec: SYNC-10
#[test]
fn cancelled_request_leaves_a_later_one_waiting() {
    let mut bench = Bench::of_the_hip();
    bench.arrives("calibrated", 7);
    bench.arrives("calibrated", 8);
    bench.leaves(Some(7));
    assert_eq!(bench.barriers(), 1);
    bench.leaves(Some(8));
    assert_eq!(bench.barriers(), 0);
    bench.arrives("calibrated", 9);
    bench.leaves(None);
    assert_eq!(bench.barriers(), 0, "no correlation means any request");
}

/// Returns the parties missing where the hip waits, with the time in seconds and the reason.
fn missing(bench: &Bench) -> Vec<(String, u64, String)> {
    let missing = bench.core.barriers(bench.now).remove(0).missing.into_iter();
    missing.map(|absence| (absence.name, absence.since.as_secs(), absence.why.into_owned())).collect()
}

#[test]
fn missing_since_starts_when_the_party_left() {
    // given: the knee waits with the hip for the ankle
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    let parties: Vec<_> = ["ankle", "hip", "knee"].map(Requirement::name).to_vec();
    let of_three = |published: PublishedBarrier| PublishedBarrier { parties: parties.clone(), ..published };
    bench.receives_arrivals(KNEE, INCARNATION, 1, vec![of_three(awaited("calibrated", 0))]);
    let (kind, on_loss) = (BarrierKind::Meeting, OnPartyLoss::Wait);
    let (barrier, texts) = ("calibrated".to_owned(), parties.iter().map(ToString::to_string).collect());
    let asked = ArriveAtBarrier { kind, barrier, parties: texts, within_ms: 60_000, on_loss };
    bench.handle(Input::Arrived { app: app(0), correlation: 7, asked });
    bench.passes(Duration::from_secs(10));
    let ankle = |seconds| ("ankle".to_owned(), seconds, "not there".to_owned());
    assert_eq!(missing(&bench), [ankle(10)]);
    // when: the knee gives up
    bench.receives_arrivals(KNEE, INCARNATION, 2, vec![of_three(idle("calibrated", 0))]);
    bench.passes(Duration::from_secs(5));
    // then
    let knee = ("knee".to_owned(), 5, "ready, has not arrived".to_owned());
    assert_eq!(missing(&bench), [ankle(15), knee]);
}

#[test]
fn mutual_wait_at_two_barriers_is_reported() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.arrives("calibrated", 7);
    let why = |bench: &Bench| missing(bench).remove(0).2;
    assert_eq!(why(&bench), "ready, has not arrived");
    bench.receives_arrivals(KNEE, INCARNATION, 1, vec![awaited("homed", 0)]);
    assert_eq!(why(&bench), "waits at 'homed' for hip, which waits here for it");
    // An application may wait at several barriers: while it waits at both, it blocks no other.
    let asked = ArriveAtBarrier {
        kind: BarrierKind::Meeting,
        barrier: "homed".to_owned(),
        parties: ["hip", "knee", "toe"].map(str::to_owned).to_vec(),
        within_ms: 60_000,
        on_loss: OnPartyLoss::Wait,
    };
    let toes = |published: PublishedBarrier| {
        let parties = ["hip", "knee", "toe"].map(Requirement::name).to_vec();
        PublishedBarrier { parties, ..published }
    };
    bench.receives_arrivals(KNEE, INCARNATION, 2, vec![idle("homed", 0), toes(awaited("homed", 0))]);
    bench.handle(Input::Arrived { app: app(0), correlation: 8, asked });
    assert_eq!(why(&bench), "ready, has not arrived");
}

// spec: SYNC-10
#[test]
fn rejected_answer_is_retried_while_the_application_lives() {
    let mut bench = Bench::of_the_hip();
    bench.arrives("calibrated", 7);
    let missing = vec![("knee".to_owned(), "not there".to_owned())];
    let answer = BarrierAnswer::TimedOut { missing };
    let rejected = || Input::AnswerRejected { app: app(0), correlation: 7, answer: answer.clone() };
    assert_eq!(bench.passes(Duration::from_secs(60)), [answered(7, answer.clone())]);
    for _ in 0..3 {
        assert_eq!(bench.handle(rejected()), []);
        assert_eq!(bench.core.next_wake(), Some(bench.now + RETRY));
        assert_eq!(bench.passes(RETRY), [answered(7, answer.clone())]);
    }
    assert_eq!(bench.passes(RETRY), [], "it was taken");
    bench.handle(rejected());
    bench.down(0);
    assert_eq!(bench.passes(RETRY), [], "another life has not asked");
    for _ in 0..16 {
        assert_eq!(bench.handle(rejected()), []);
    }
    assert!(matches!(bench.handle(rejected())[..], [Output::Refused { cause: "barriers", .. }]));
}

fn is_refused(output: &Output) -> bool {
    matches!(output, Output::Refused { cause: "barriers", .. })
}

// spec: SYNC-12
#[test]
fn impossible_generation_does_not_keep_a_barrier_shut() {
    // Given: the hip and the knee meet, and have met five times
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, INCARNATION);
    bench.links(ANKLE, INCARNATION);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.receives_arrivals(KNEE, INCARNATION, 1, vec![idle("calibrated", 5)]);
    // When
    let outputs = bench.receives_arrivals(
        ANKLE,
        INCARNATION,
        1,
        vec![idle("calibrated", GENERATION_MAX), idle("other", 3)],
    );
    // Then
    assert!(outputs.iter().any(is_refused), "{outputs:?}");
    bench.receives_arrivals(KNEE, INCARNATION, 2, vec![awaited("calibrated", 5)]);
    let outputs = bench.arrives("calibrated", 7);
    assert!(outputs.contains(&answered(7, BarrierAnswer::Opened { generation: 6 })), "{outputs:?}");
    // And: other reports of that node still count
    bench.receives_arrivals(KNEE, INCARNATION, 3, vec![awaited("other", 3)]);
    let outputs = bench.arrives("other", 8);
    assert!(outputs.contains(&answered(8, BarrierAnswer::Opened { generation: 4 })), "{outputs:?}");
}

// spec: SYNC-12
#[test]
fn wrong_generation_with_room_does_not_separate_later_arrivals() {
    for received in [vec![], vec![5]] {
        let mut bench = Bench::of_the_hip();
        bench.links(KNEE, INCARNATION);
        bench.links(ANKLE, INCARNATION);
        bench.list(KNEE, list(1, &[("knee", true, &[])]));
        let versions = (1..).zip(received.iter().copied());
        versions.for_each(|(version, generation)| {
            _ = bench.receives_arrivals(KNEE, INCARNATION, version, vec![idle("calibrated", generation)])
        });
        // When
        let wrong = 1 << 45;
        let outputs = bench.receives_arrivals(ANKLE, INCARNATION, 1, vec![idle("calibrated", wrong)]);
        // Then
        assert!(!outputs.iter().any(is_refused), "{outputs:?}");
        bench.receives_arrivals(KNEE, INCARNATION, 9, vec![awaited("calibrated", wrong)]);
        let outputs = bench.arrives("calibrated", 7);
        assert!(
            outputs.contains(&answered(7, BarrierAnswer::Opened { generation: wrong + 1 })),
            "{outputs:?}"
        );
    }
}

// spec: SYNC-12
#[test]
fn generations_missed_for_years_are_adopted() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.receives_arrivals(KNEE, INCARNATION, 1, vec![idle("calibrated", 1)]);
    let missed = 1_000 * 60 * 60 * 24 * 365 * 30;
    assert!(
        !bench
            .receives_arrivals(KNEE, INCARNATION, 2, vec![awaited("calibrated", missed)])
            .iter()
            .any(is_refused)
    );
    let outputs = bench.arrives("calibrated", 7);
    assert!(outputs.contains(&answered(7, BarrierAnswer::Opened { generation: missed + 1 })), "{outputs:?}");
}

// spec: SYNC-12
#[test]
fn waits_at_an_exhausted_barrier_are_rejected() {
    let mut bench = Bench::of_the_hip();
    bench.arrives("calibrated", 7);
    bench.core.rendezvous_mut().barriers.values_mut().for_each(|known| known.generation = GENERATION_MAX);
    let is_rejected = |outputs: &[Output], wanted: u64| {
        let is_it = |output: &Output| {
            matches!(output, Output::AnswerBarrier { correlation, answer: BarrierAnswer::Refused { why }, .. }
                if *correlation == wanted && why.contains("which is the limit"))
        };
        outputs.iter().any(is_it)
    };
    let outputs = bench.passes(SPACING);
    assert!(is_rejected(&outputs, 7), "{outputs:?}");
    let outputs = bench.arrives("calibrated", 8);
    assert!(is_rejected(&outputs, 8), "{outputs:?}");
}
