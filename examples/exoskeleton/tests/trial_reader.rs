//! The trial reader on the real file and on hostile ones.

use exoskeleton::gait::trial::Trial;
use proptest::prelude::*;

const FILE: &str = include_str!("../data/gait_trial_moore2015_s15_pre.csv");
const EVENTS: &str = include_str!("../data/gait_trial_moore2015_s15_pre_events.csv");

/// A short trial that is still valid: comments, header and the first 12 seconds.
fn short() -> String {
    FILE.lines().take(1212).collect::<Vec<_>>().join("\n")
}

#[test]
fn heel_strikes_from_the_stance_column_agree_with_the_event_file() {
    let trial = Trial::parse(FILE).unwrap();
    let events: Vec<f64> = EVENTS
        .lines()
        .skip(2)
        .filter_map(|line| line.split(',').nth(3).and_then(|field| field.parse().ok()))
        // The other events of the last line have no right heel strike beside them.
        .filter(|time_s: &f64| time_s.is_finite())
        .collect();
    assert_eq!(trial.heel_strikes_s().len(), events.len());
    for (ours, theirs) in trial.heel_strikes_s().iter().zip(&events) {
        assert!((ours - theirs).abs() <= 0.011, "{ours} {theirs}");
    }
}

#[test]
fn garbled_number_is_refused_with_its_line_and_a_remedy() {
    let text = short().replacen("\n5.0,", "\nfive,", 1);
    let line = 1 + text.lines().position(|l| l.starts_with("five")).unwrap();
    let error = Trial::parse(&text).unwrap_err().to_string();
    assert!(error.contains(&format!("line {line}")) && error.contains("repair"), "{error}");
}

#[test]
fn not_a_number_and_infinity_are_refused() {
    for bad in ["NaN", "inf", "-inf", ""] {
        let text = short().replacen("\n5.0,", &format!("\n{bad},"), 1);
        assert!(Trial::parse(&text).is_err(), "{bad}");
    }
}

#[test]
fn time_that_jumps_is_refused_with_its_line() {
    let text = short().replacen("\n5.0,", "\n5.5,", 1);
    let error = Trial::parse(&text).unwrap_err().to_string();
    assert!(error.contains("resample"), "{error}");
}

#[test]
fn missing_column_is_named() {
    let error = Trial::parse(&short().replace("stance_r", "stance_x")).unwrap_err().to_string();
    assert!(error.contains("`stance_r`"), "{error}");
}

#[test]
fn trial_without_heel_strikes_is_refused() {
    let text: Vec<&str> = FILE.lines().take(250).collect();
    assert!(Trial::parse(&text.join("\n")).is_err());
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_text_gives_a_trial_or_an_error(text in "\\PC{0,400}") {
        let _ = Trial::parse(&text);
    }

    #[test]
    fn any_damage_to_a_real_file_gives_a_trial_or_an_error(
        at in 0usize..100_000, junk in prop::collection::vec(any::<u8>(), 1..40),
    ) {
        let mut bytes = short().into_bytes();
        let start = at % bytes.len();
        let end = (start + junk.len()).min(bytes.len());
        bytes.splice(start..end, junk);
        if let Ok(trial) = Trial::parse(&String::from_utf8_lossy(&bytes)) {
            prop_assert!(trial.heel_strikes_s().windows(2).all(|w| w[1] > w[0]));
        }
    }
}
