//! Requirements of every form: any of several, counts, patterns, optional ones.

use std::borrow::Cow;

use super::*;

/// Returns the missing names with the reasons, without the times.
pub(super) fn in_words(absences: Vec<Absence>) -> Vec<(String, &'static str)> {
    let pair = |absence: Absence| match absence.why {
        Cow::Borrowed(why) => (absence.name, why),
        Cow::Owned(why) => panic!("of the start-up barrier there are fixed words: {why}"),
    };
    absences.into_iter().map(pair).collect()
}

fn texts(missing: &[(String, &'static str)]) -> Vec<String> {
    missing.iter().map(|(part, why)| format!("{part}: {why}")).collect()
}

#[test]
fn any_of_several_alternatives_is_enough() {
    let mut bench = Bench::new();
    assert_eq!(bench.registers(0, "gait", &["hip.imu | knee.imu"]), []);
    bench.registers(1, "hip.imu", &[]);
    bench.registers(2, "knee.imu", &[]);
    assert_eq!(
        texts(&bench.missing()),
        [
            "hip.imu | knee.imu (0 ready): hip.imu: registered, not ready",
            "hip.imu | knee.imu (0 ready): knee.imu: registered, not ready",
        ]
    );
    assert_eq!(bench.ready(2), [release(0)]);
    bench.ready(0);
    assert_eq!(bench.ready(1), []);
    assert!(
        !bench.down(2).contains(&lost(0, "hip.imu | knee.imu", Reason::Failed)),
        "the other one is ready"
    );
    assert!(bench.down(1).contains(&lost(0, "hip.imu | knee.imu", Reason::Failed)));
    assert_eq!(bench.ready(2), [met(0, "hip.imu | knee.imu")]);
}

#[test]
fn matching_count_is_enough_on_any_nodes() {
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["2 of *.drive"]);
    bench.registers(1, "hip.drive", &[]);
    bench.registers(2, "driver", &[]);
    bench.ready(2);
    assert_eq!(bench.ready(1), []);
    assert_eq!(
        texts(&bench.missing()),
        ["2 of *.drive (1 ready): not there"],
        "of a second one nothing is known"
    );
    bench.links(KNEE, INCARNATION);
    let outputs = bench.list(KNEE, list(1, &[("knee.drive", false, &[])]));
    assert!(!outputs.contains(&release(0)));
    assert_eq!(texts(&bench.missing()), ["2 of *.drive (1 ready): knee.drive: registered, not ready"]);
    assert!(bench.list(KNEE, list(2, &[("knee.drive", true, &[])])).contains(&release(0)));
}

#[test]
fn one_name_on_two_nodes_counts_twice() {
    let mut bench = Bench::new();
    bench.registers(0, "a.drive", &["3 of *.drive"]);
    bench.links(KNEE, INCARNATION);
    bench.links(ANKLE, INCARNATION);
    let outputs = bench.list(KNEE, list(1, &[("b.drive", true, &[])]));
    assert!(!outputs.contains(&release(0)));
    assert_eq!(texts(&bench.missing()), ["3 of *.drive (2 ready): not there"]);
    assert_eq!(bench.core.missing_in_brief(app(0)), bench.missing());
    assert!(bench.list(ANKLE, list(1, &[("b.drive", true, &[])])).contains(&release(0)));
    bench.ready(0);
    let outputs = bench.lost(ANKLE, LossReason::LinkDown);
    assert!(outputs.contains(&lost(0, "3 of *.drive", Reason::NodeLost)), "{outputs:?}");
}

// spec: SYNC-7
#[test]
fn application_never_waits_for_itself() {
    for requires in [&["a.drive"][..], &["*.drive"], &["a.drive | b.drive"], &["a.drive at homed", "a.drive"]]
    {
        let mut bench = Bench::new();
        assert_eq!(bench.registers(0, "a.drive", requires), [release(0)], "{requires:?}");
        bench.ready(0);
        assert_eq!(bench.down(0), [release(0)], "{requires:?}");
    }
    let mut bench = Bench::new();
    bench.registers(0, "a.drive", &["2 of *.drive"]);
    bench.registers(1, "b.drive", &["*.drive"]);
    assert_eq!(bench.ready(1), [release(0)], "but for others it does");
}

#[test]
fn optional_requirement_is_waited_for_until_its_limit() {
    let mut bench = Bench::new();
    assert_eq!(bench.registers(0, "gait", &["camera ?500ms", "knee"]), []);
    assert_eq!(bench.core.next_wake(), Some(bench.now + Duration::from_millis(500)));
    assert_eq!(bench.passes(Duration::from_millis(500)), [], "the knee cannot be done without");
    assert_ne!(bench.core.next_wake(), Some(bench.now), "it does not turn in place");
    bench.registers(1, "knee", &[]);
    assert_eq!(bench.ready(1), [release(0)]);
    let event = RequirementEvent::Without { name: "camera ?500ms".to_owned() };
    let without = |why| Output::Notify { app: app(0), event: event.clone(), why: Some(why) };
    assert_eq!(bench.ready(0), [without(Reason::NotThere)]);
    bench.registers(2, "camera", &[]);
    assert_eq!(bench.ready(2), [met(0, "camera ?500ms")]);
    assert_eq!(bench.down(2), [without(Reason::Failed), release(2)]);
}

// spec: SYNC-8
#[test]
fn each_life_is_notified_of_its_missing_optional_requirements() {
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["camera ?500ms"]);
    let event = RequirementEvent::Without { name: "camera ?500ms".to_owned() };
    let without = Output::Notify { app: app(0), event, why: Some(Reason::NotThere) };
    for life in 1..=3 {
        assert_eq!(bench.passes(Duration::from_millis(500)), [release(0)], "life {life}");
        assert_eq!(bench.ready(0), std::slice::from_ref(&without), "life {life}");
        assert_eq!(bench.down(0), [], "it waits for a camera anew");
    }
}

#[test]
fn optional_requirement_met_in_time_is_not_reported_missing() {
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["camera ?500ms"]);
    bench.registers(1, "camera", &[]);
    assert_eq!(bench.ready(1), [release(0)]);
    assert_eq!(bench.ready(0), []);
}

#[test]
fn cycle_through_a_choice_is_refused_only_without_alternative() {
    let mut bench = Bench::new();
    bench.registers(0, "a", &["b | c"]);
    bench.registers(1, "b", &["a"]);
    let outputs = bench.registers(2, "c", &["a"]);
    let names = ["a", "b", "a"].map(str::to_owned).to_vec();
    assert_eq!(outputs, [Output::Cycle { names }]);
    bench.links(KNEE, INCARNATION);
    assert!(bench.list(KNEE, list(1, &[("c", true, &[])])).contains(&release(0)));
}

#[test]
fn brief_lists_the_current_requirements() {
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["2 of *.drive", "hip.imu | knee.imu", "camera"]);
    bench.registers(1, "hip.drive", &[]);
    bench.registers(2, "knee.imu", &[]);
    bench.ready(1);
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("knee.drive", false, &[]), ("knee.eye", true, &[])]));
    assert_eq!(bench.core.missing_in_brief(app(0)), bench.missing());
    bench.list(KNEE, list(2, &[("knee.drive", true, &[]), ("hip.imu", true, &[])]));
    assert_eq!(texts(&bench.core.missing_in_brief(app(0))), ["camera: not there"]);
    assert_eq!(bench.core.missing_in_brief(app(1)), [], "it does not wait");
}

#[test]
fn expensive_pattern_search_stops_at_its_bound() {
    // Given: many names, and an application that requires more of them than there are, by the maximum number of
    // patterns.
    let mut bench = Bench::new();
    (1..=200).for_each(|index| drop(bench.registers(index, &format!("name{index}"), &[])));
    let all: Vec<String> = (0..16)
        .map(|index| format!("*{}", ["n", "a", "m", "e"][index % 4].to_owned() + &"*".repeat(index / 4 + 1)))
        .collect();
    let patterns = all.join(" | ");
    let requires: Vec<String> = (0..64).map(|index| format!("{} of {patterns}", 1_000 + index)).collect();
    let requires: Vec<&str> = requires.iter().map(String::as_str).collect();
    bench.registers(0, "gait", &requires);
    // Then:
    let [(what, why)] = &bench.core.missing_in_brief(app(0))[..] else { panic!("the first one is too much") };
    assert!(what.starts_with("1000 of") && why.starts_with("not checked"), "{what}: {why}");
    // And: of many examined names, only this many are listed.
    let many: Vec<String> = (0..64).map(|index| format!("none{index}")).collect();
    let many: Vec<&str> = many.iter().map(String::as_str).collect();
    bench.registers(201, "knee", &many);
    assert_eq!(bench.core.missing_in_brief(app(201)).len(), 16);
}

#[test]
fn missing_since_starts_when_the_name_was_lost() {
    let mut bench = Bench::new();
    bench.registers(1, "sensor", &[]);
    bench.ready(1);
    bench.registers(0, "gait", &["sensor", "drive"]);
    bench.passes(Duration::from_secs(10));
    bench.down(1);
    bench.passes(Duration::from_secs(2));
    let since = |bench: &Bench| -> Vec<(String, u64)> {
        let missing = bench.core.waiting(bench.now).remove(0).missing;
        missing.into_iter().map(|absence| (absence.name, absence.since.as_secs())).collect()
    };
    assert_eq!(since(&bench), [("sensor".to_owned(), 2), ("drive".to_owned(), 12)]);
    // It registers again and continues to wait, and the same names are missing.
    bench.registers(0, "gait", &["drive"]);
    bench.ready(1);
    assert_eq!(since(&bench), [("drive".to_owned(), 12)]);
}
