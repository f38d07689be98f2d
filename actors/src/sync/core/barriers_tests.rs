//! Run-time barriers, as one node sees them: what it keeps in mind, whom it believes, whose wait is over.

use sinew_runtime::app::Requirement;

use super::*;
use crate::sync::{
    arrivals::{Arrival, Arrivals, BARRIERS_MAX, BarrierSaid, GENERATION_MAX, Member, Passed},
    core::rendezvous::GRACE,
    list::Ended,
    words::{BarrierKind, OnPartyLoss},
};

/// A younger life of a process with the same address.
const DOUBLE: Incarnation = Incarnation(9);

fn name(text: &str) -> Name {
    Name::try_from(text.to_owned()).unwrap()
}

/// A barrier of the hip and the knee at which nobody waits.
fn idle(text: &str, generation: u64) -> BarrierSaid {
    let parties = vec![Requirement::name("hip"), Requirement::name("knee")];
    let (members, earlier, arrivals) = (Vec::new(), Vec::new(), Vec::new());
    BarrierSaid { name: name(text), parties, generation, members, earlier, arrivals }
}

/// One at which the knee waits behind this generation.
pub(super) fn awaited(text: &str, generation: u64) -> BarrierSaid {
    let knee = Arrival { party: 1, app: app(0), name: Some(name("knee")), after: generation };
    BarrierSaid { arrivals: vec![knee], ..idle(text, generation) }
}

pub(super) fn answered(correlation: u64, answer: BarrierAnswer) -> Output {
    Output::AnswerBarrier { app: app(0), correlation, answer }
}

impl Bench {
    /// Application 0 is "hip".
    pub(super) fn of_the_hip() -> Self {
        let mut bench = Self::new();
        bench.registers(0, "hip", &[]);
        bench.ready(0);
        bench
    }

    /// The knee has said of as many barriers as a node keeps in mind.
    fn that_has_no_room() -> Self {
        let mut bench = Self::of_the_hip();
        bench.links(KNEE, LIFE);
        bench.links(ANKLE, LIFE);
        let barriers = (0..BARRIERS_MAX).map(|number| idle(&format!("round {number}"), 1)).collect();
        bench.is_told(KNEE, LIFE, 1, barriers);
        bench.passes(SPACING);
        bench
    }

    pub(super) fn is_told(
        &mut self,
        from: NodeAddress,
        incarnation: Incarnation,
        version: u64,
        barriers: Vec<BarrierSaid>,
    ) -> Vec<Output> {
        let payload = Arrivals { incarnation, version, barriers }.encode();
        self.hears(Input::ArrivalsReceived { from, payload })
    }

    /// The hip arrives, and does not wait for a lost party's return.
    pub(super) fn arrives(&mut self, barrier: &str, correlation: u64) -> Vec<Output> {
        let asked = ArriveAtBarrier {
            kind: BarrierKind::Meeting,
            barrier: barrier.to_owned(),
            parties: ["hip", "knee"].map(str::to_owned).to_vec(),
            within_ms: 60_000,
            on_loss: OnPartyLoss::Fail,
        };
        self.hears(Input::Arrived { app: app(0), correlation, asked })
    }

    fn leaves(&mut self, correlation: Option<u64>) {
        let barrier = "calibrated".to_owned();
        self.hears(Input::Left { app: app(0), barrier, correlation });
    }

    fn barriers(&self) -> usize {
        self.core.barriers(self.now).len()
    }
}

// spec: SYNC-10
#[test]
fn nothing_is_forgotten_for_a_barrier_that_only_others_know() {
    let mut bench = Bench::that_has_no_room();
    let outputs = bench.is_told(ANKLE, LIFE, 1, vec![idle("other", 5)]);
    assert_eq!((outputs.len(), bench.passes(SPACING).len()), (0, 0), "nor is anything said on");
}

// spec: SYNC-12
#[test]
fn who_arrives_at_a_barrier_for_which_there_was_no_room_meets_those_who_wait_there() {
    let mut bench = Bench::that_has_no_room();
    bench.list(ANKLE, list(1, &[("knee", true, &[])]));
    bench.is_told(ANKLE, LIFE, 1, vec![awaited("other", 5)]);
    let outputs = bench.arrives("other", 7);
    assert!(outputs.contains(&answered(7, BarrierAnswer::Opened { generation: 6 })), "{outputs:?}");
}

// spec: SYNC-11
#[test]
fn the_linked_life_of_a_node_is_heard_also_after_a_younger_double_of_it_has_spoken() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, DOUBLE);
    bench.is_told(KNEE, DOUBLE, 7, vec![idle("calibrated", 0)]);
    bench.hears(Input::LinkChanged(LinkFact::LinkBroken { node: KNEE, incarnation: DOUBLE }));
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.is_told(KNEE, LIFE, 1, vec![awaited("calibrated", 0)]);
    let outputs = bench.arrives("calibrated", 7);
    assert!(outputs.contains(&answered(7, BarrierAnswer::Opened { generation: 1 })), "{outputs:?}");
}

// spec: SYNC-11
#[test]
fn what_a_nodes_new_life_did_not_take_is_said_again_also_where_its_former_one_is_lost_meanwhile() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.arrives("calibrated", 7);
    bench.breaks(KNEE);
    bench.links(KNEE, NEXT_LIFE);
    bench.hears(Input::ArrivalsNotTaken { to: KNEE });
    bench.lost(KNEE, LossReason::Restarted);
    let outputs = bench.passes(RETRY);
    assert!(
        outputs.iter().any(|output| matches!(output, Output::PublishArrivals { to: KNEE, .. })),
        "{outputs:?}"
    );
}

#[test]
fn the_end_of_a_double_that_is_linked_with_nobody_any_more_is_no_loss_of_the_node() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, DOUBLE);
    bench.hears(Input::LinkChanged(LinkFact::LinkBroken { node: KNEE, incarnation: DOUBLE }));
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    let (node, incarnation, why) = (KNEE, DOUBLE, LossReason::Duplicate);
    bench.hears(Input::MembershipChanged(MembershipFact::NodeLost { node, incarnation, why }));
    let is_ready = |entry: &DirectoryEntry| entry.name == "knee" && entry.ready;
    assert!(bench.core.directory().iter().any(is_ready), "{:?}", bench.core.directory());
}

// spec: SYNC-13
#[test]
fn who_does_not_wait_for_a_lost_party_hears_of_its_failure_and_stop_on_another_node() {
    for (ended, why) in
        [(Ended::Failed, "failed, not ready again"), (Ended::Stopped, "stopped in order, not ready again")]
    {
        let mut bench = Bench::of_the_hip();
        bench.links(KNEE, LIFE);
        bench.list(KNEE, list(1, &[("knee", true, &[])]));
        bench.arrives("calibrated", 7);
        let mut news = list(2, &[("knee", false, &[])]);
        news.entries[0].ended = Some(ended);
        bench.list(KNEE, news);
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
        bench.hears(Input::Arrived { app: app(0), correlation: 7, asked });
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
fn a_node_says_how_an_application_ended_until_it_is_ready_again() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, LIFE);
    let says = |bench: &mut Bench| published(&bench.passes(SPACING))[0].entries[0].ended;
    bench.down(0);
    assert_eq!(says(&mut bench), Some(Ended::Failed));
    bench.hears(Input::AppChanged(AppFact::Stopped { app: app(0) }));
    assert_eq!(says(&mut bench), Some(Ended::Stopped));
    bench.ready(0);
    assert_eq!(says(&mut bench), None);
}

// spec: SYNC-12
#[test]
fn who_counted_passes_also_when_its_node_hears_of_a_later_generation_first() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.arrives("calibrated", 7);
    let (node, incarnation) = (HERE, Incarnation(1));
    let hip = Member { node, incarnation, party: 1 };
    let later = BarrierSaid { earlier: vec![Passed::new(hip, 2)], ..idle("calibrated", 3) };
    let outputs = bench.is_told(KNEE, LIFE, 1, vec![later]);
    assert!(outputs.contains(&answered(7, BarrierAnswer::Opened { generation: 2 })), "{outputs:?}");
    // Its next visit is behind the third, whoever repeats what it has passed.
    bench.arrives("calibrated", 8);
    let again = BarrierSaid { earlier: vec![Passed::new(hip, 2)], ..idle("calibrated", 4) };
    let outputs = bench.is_told(KNEE, LIFE, 2, vec![again]);
    assert!(!outputs.iter().any(|output| matches!(output, Output::AnswerBarrier { .. })), "{outputs:?}");
}

// spec: SYNC-12
#[test]
fn who_passed_in_a_life_that_an_earlier_clock_gave_its_number_is_said_on() {
    // Given: the knee was there in a later life, as its clock had it
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, DOUBLE);
    bench.is_told(KNEE, DOUBLE, 7, vec![idle("calibrated", 0)]);
    bench.hears(Input::LinkChanged(LinkFact::LinkBroken { node: KNEE, incarnation: DOUBLE }));
    bench.links(ANKLE, LIFE);
    // When: in its present one it has passed, as another node says that has met it, and it has not heard of that
    let knee = Member { node: KNEE, incarnation: LIFE, party: 1 };
    let passed = BarrierSaid { members: vec![knee], ..idle("calibrated", 1) };
    bench.is_told(ANKLE, LIFE, 1, vec![passed]);
    bench.is_told(ANKLE, LIFE, 2, vec![idle("calibrated", 2)]);
    // Then
    let words = bench.passes(Duration::from_secs(2));
    let said = words.iter().rev().find_map(|output| {
        let Output::PublishArrivals { said, .. } = output else { return None };
        Some(Arrivals::parse(said).expect("a word of this node's"))
    });
    let said = said.expect("it is said again and again");
    assert_eq!(said.barriers[0].earlier, [Passed::new(knee, 1)]);
}

#[test]
fn since_when_a_party_is_missing_is_known_also_where_many_are_there() {
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
        bench.hears(Input::Arrived { app: app(index), correlation: 7, asked });
    }
    // When: one leaves after a second
    bench.passes(Duration::from_secs(1));
    let barrier = "calibrated".to_owned();
    bench.hears(Input::Left { app: app(39), barrier, correlation: None });
    bench.passes(GRACE);
    // Then
    let status = bench.core.barriers(bench.now).remove(0);
    let since: Vec<_> = status.missing.iter().map(|absence| (absence.name.as_str(), absence.since)).collect();
    assert_eq!(since, [("drive.39", GRACE), ("gait", Duration::from_secs(1) + GRACE)]);
}

// spec: SYNC-12
#[test]
fn who_gave_a_visit_up_does_not_pass_in_its_next_one_by_a_late_word_about_that() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.arrives("calibrated", 7);
    let is_over = |output: &Output| {
        matches!(output, Output::AnswerBarrier { correlation: 7, answer: BarrierAnswer::TimedOut { .. }, .. })
    };
    assert!(bench.passes(Duration::from_secs(61)).iter().any(is_over));
    bench.arrives("calibrated", 8);
    // The knee's node had opened it for the first visit, and could not say so.
    let hip = Member { node: HERE, incarnation: Incarnation(1), party: 1 };
    let late = BarrierSaid { members: vec![hip], ..idle("calibrated", 1) };
    let outputs = bench.is_told(KNEE, LIFE, 1, vec![late]);
    assert!(!outputs.iter().any(|output| matches!(output, Output::AnswerBarrier { .. })), "{outputs:?}");
}

// spec: SYNC-11
#[test]
fn a_word_is_no_longer_than_it_may_be() {
    let mut bench = Bench::of_the_hip();
    bench.core.rendezvous = Rendezvous::new(HERE, Incarnation(1), 4_000);
    bench.links(KNEE, LIFE);
    let barriers = (0..100).map(|number| idle(&format!("round {number}"), 1)).collect();
    bench.is_told(KNEE, LIFE, 1, barriers);
    let outputs = [bench.arrives("calibrated", 7), bench.passes(SPACING)].concat();
    let word = |output: &Output| {
        let Output::PublishArrivals { said, .. } = output else { return None };
        Some(said.clone())
    };
    let words = outputs.iter().filter_map(word);
    let words: Vec<_> = words.collect();
    assert!(words.iter().all(|word| word.len() <= 4_000) && !words.is_empty(), "{}", words.len());
    let last = Arrivals::parse(&words[words.len() - 1]).unwrap();
    assert!(last.barriers.iter().any(|said| &*said.name == "calibrated" && said.arrivals.len() == 1));
    assert!(last.barriers.len() > 20, "{}", last.barriers.len());
    let is_told = |output: &Output| matches!(output, Output::Refused { cause: "barriers", .. });
    assert!(outputs.iter().any(is_told), "that some have no room");
    // What the own applications wait for has room, or is refused.
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
fn who_gives_a_request_up_still_waits_by_a_later_one() {
    let mut bench = Bench::of_the_hip();
    bench.arrives("calibrated", 7);
    bench.arrives("calibrated", 8);
    bench.leaves(Some(7));
    assert_eq!(bench.barriers(), 1);
    bench.leaves(Some(8));
    assert_eq!(bench.barriers(), 0);
    bench.arrives("calibrated", 9);
    bench.leaves(None);
    assert_eq!(bench.barriers(), 0, "whoever names no request means any");
}

/// Who is missing where the hip waits, since how many seconds, and why.
fn missing(bench: &Bench) -> Vec<(String, u64, String)> {
    let missing = bench.core.barriers(bench.now).remove(0).missing.into_iter();
    missing.map(|absence| (absence.name, absence.since.as_secs(), absence.why.into_owned())).collect()
}

#[test]
fn since_when_a_party_is_missing_is_since_it_went_not_since_others_wait() {
    // given: the knee waits with the hip for the ankle
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    let parties: Vec<_> = ["ankle", "hip", "knee"].map(Requirement::name).to_vec();
    let of_three = |said: BarrierSaid| BarrierSaid { parties: parties.clone(), ..said };
    bench.is_told(KNEE, LIFE, 1, vec![of_three(awaited("calibrated", 0))]);
    let (kind, on_loss) = (BarrierKind::Meeting, OnPartyLoss::Wait);
    let (barrier, texts) = ("calibrated".to_owned(), parties.iter().map(ToString::to_string).collect());
    let asked = ArriveAtBarrier { kind, barrier, parties: texts, within_ms: 60_000, on_loss };
    bench.hears(Input::Arrived { app: app(0), correlation: 7, asked });
    bench.passes(Duration::from_secs(10));
    let ankle = |seconds| ("ankle".to_owned(), seconds, "not there".to_owned());
    assert_eq!(missing(&bench), [ankle(10)]);
    // when: the knee gives up
    bench.is_told(KNEE, LIFE, 2, vec![of_three(idle("calibrated", 0))]);
    bench.passes(Duration::from_secs(5));
    // then
    let knee = ("knee".to_owned(), 5, "ready, has not arrived".to_owned());
    assert_eq!(missing(&bench), [ankle(15), knee]);
}

#[test]
fn who_waits_for_one_that_waits_for_him_at_another_barrier_is_told_so() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.arrives("calibrated", 7);
    let why = |bench: &Bench| missing(bench).remove(0).2;
    assert_eq!(why(&bench), "ready, has not arrived");
    bench.is_told(KNEE, LIFE, 1, vec![awaited("homed", 0)]);
    assert_eq!(why(&bench), "waits at 'homed' for hip, which waits here for it");
    // An application may wait at several: at both, it keeps nobody.
    let asked = ArriveAtBarrier {
        kind: BarrierKind::Meeting,
        barrier: "homed".to_owned(),
        parties: ["hip", "knee", "toe"].map(str::to_owned).to_vec(),
        within_ms: 60_000,
        on_loss: OnPartyLoss::Wait,
    };
    let toes = |said: BarrierSaid| {
        let parties = ["hip", "knee", "toe"].map(Requirement::name).to_vec();
        BarrierSaid { parties, ..said }
    };
    bench.is_told(KNEE, LIFE, 2, vec![idle("homed", 0), toes(awaited("homed", 0))]);
    bench.hears(Input::Arrived { app: app(0), correlation: 8, asked });
    assert_eq!(why(&bench), "ready, has not arrived");
}

// spec: SYNC-10
#[test]
fn an_answer_for_which_there_was_no_room_is_offered_again_as_long_as_its_application_lives() {
    let mut bench = Bench::of_the_hip();
    bench.arrives("calibrated", 7);
    let missing = vec![("knee".to_owned(), "not there".to_owned())];
    let answer = BarrierAnswer::TimedOut { missing };
    let not_taken = || Input::AnswerNotTaken { app: app(0), correlation: 7, answer: answer.clone() };
    assert_eq!(bench.passes(Duration::from_secs(60)), [answered(7, answer.clone())]);
    for _ in 0..3 {
        assert_eq!(bench.hears(not_taken()), []);
        assert_eq!(bench.core.next_wake(), Some(bench.now + RETRY));
        assert_eq!(bench.passes(RETRY), [answered(7, answer.clone())]);
    }
    assert_eq!(bench.passes(RETRY), [], "it was taken");
    bench.hears(not_taken());
    bench.down(0);
    assert_eq!(bench.passes(RETRY), [], "another life has not asked");
    for _ in 0..16 {
        assert_eq!(bench.hears(not_taken()), []);
    }
    assert!(matches!(bench.hears(not_taken())[..], [Output::Refused { cause: "barriers", .. }]));
}

fn is_refused(output: &Output) -> bool {
    matches!(output, Output::Refused { cause: "barriers", .. })
}

// spec: SYNC-12
#[test]
fn one_word_of_a_generation_that_cannot_be_does_not_keep_a_barrier_shut() {
    // Given: the hip and the knee meet, and have met five times
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, LIFE);
    bench.links(ANKLE, LIFE);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.is_told(KNEE, LIFE, 1, vec![idle("calibrated", 5)]);
    // When
    let outputs = bench.is_told(ANKLE, LIFE, 1, vec![idle("calibrated", GENERATION_MAX), idle("other", 3)]);
    // Then
    assert!(outputs.iter().any(is_refused), "{outputs:?}");
    bench.is_told(KNEE, LIFE, 2, vec![awaited("calibrated", 5)]);
    let outputs = bench.arrives("calibrated", 7);
    assert!(outputs.contains(&answered(7, BarrierAnswer::Opened { generation: 6 })), "{outputs:?}");
    // And what else that node says is heard
    bench.is_told(KNEE, LIFE, 3, vec![awaited("other", 3)]);
    let outputs = bench.arrives("other", 8);
    assert!(outputs.contains(&answered(8, BarrierAnswer::Opened { generation: 4 })), "{outputs:?}");
}

// spec: SYNC-12
#[test]
fn a_wrong_generation_that_leaves_room_does_not_part_those_who_had_heard_another_one_from_who_comes_later() {
    for heard in [vec![], vec![5]] {
        let mut bench = Bench::of_the_hip();
        bench.links(KNEE, LIFE);
        bench.links(ANKLE, LIFE);
        bench.list(KNEE, list(1, &[("knee", true, &[])]));
        let versions = (1..).zip(heard.iter().copied());
        versions.for_each(|(version, heard)| {
            _ = bench.is_told(KNEE, LIFE, version, vec![idle("calibrated", heard)])
        });
        // When
        let wrong = 1 << 45;
        let outputs = bench.is_told(ANKLE, LIFE, 1, vec![idle("calibrated", wrong)]);
        // Then
        assert!(!outputs.iter().any(is_refused), "{outputs:?}");
        bench.is_told(KNEE, LIFE, 9, vec![awaited("calibrated", wrong)]);
        let outputs = bench.arrives("calibrated", 7);
        assert!(
            outputs.contains(&answered(7, BarrierAnswer::Opened { generation: wrong + 1 })),
            "{outputs:?}"
        );
    }
}

// spec: SYNC-12
#[test]
fn what_was_missed_in_years_is_taken_over() {
    let mut bench = Bench::of_the_hip();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    bench.is_told(KNEE, LIFE, 1, vec![idle("calibrated", 1)]);
    let missed = 1_000 * 60 * 60 * 24 * 365 * 30;
    assert!(!bench.is_told(KNEE, LIFE, 2, vec![awaited("calibrated", missed)]).iter().any(is_refused));
    let outputs = bench.arrives("calibrated", 7);
    assert!(outputs.contains(&answered(7, BarrierAnswer::Opened { generation: missed + 1 })), "{outputs:?}");
}

// spec: SYNC-12
#[test]
fn who_waits_or_arrives_at_a_barrier_that_can_never_open_again_is_told_so() {
    let mut bench = Bench::of_the_hip();
    bench.arrives("calibrated", 7);
    bench.core.rendezvous.known.values_mut().for_each(|known| known.generation = GENERATION_MAX);
    let told = |outputs: &[Output], wanted: u64| {
        let is_it = |output: &Output| {
            matches!(output, Output::AnswerBarrier { correlation, answer: BarrierAnswer::Refused { why }, .. }
                if *correlation == wanted && why.contains("which is the limit"))
        };
        outputs.iter().any(is_it)
    };
    let outputs = bench.passes(SPACING);
    assert!(told(&outputs, 7), "{outputs:?}");
    let outputs = bench.arrives("calibrated", 8);
    assert!(told(&outputs, 8), "{outputs:?}");
}
