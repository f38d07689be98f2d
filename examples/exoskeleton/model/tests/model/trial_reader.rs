//! The trial reader on the real file and on hostile ones.

use exoskeleton_model::gait::trial::Trial;
use proptest::prelude::*;

const FILE: &str = include_str!("../../../data/gait_trial_moore2015_s15_pre.csv");
const EVENTS: &str = include_str!("../../../data/gait_trial_moore2015_s15_pre_events.csv");

/// A short trial that is still valid: comments, header and the first 12 seconds.
fn short() -> String {
    FILE.lines().take(1212).collect::<Vec<_>>().join("\n")
}

#[test]
fn heel_strikes_agree_with_the_event_file() {
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
fn garbled_number_is_rejected_with_line_and_remedy() {
    let text = short().replacen("\n5.0,", "\nfive,", 1);
    let line = 1 + text.lines().position(|l| l.starts_with("five")).unwrap();
    let error = Trial::parse(&text).unwrap_err().to_string();
    assert!(error.contains(&format!("line {line}")) && error.contains("repair"), "{error}");
}

#[test]
fn nan_and_infinity_are_rejected() {
    for bad in ["NaN", "inf", "-inf", ""] {
        let text = short().replacen("\n5.0,", &format!("\n{bad},"), 1);
        assert!(Trial::parse(&text).is_err(), "{bad}");
    }
}

#[test]
fn time_jump_is_rejected_with_its_line() {
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
fn trial_without_heel_strikes_is_rejected() {
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
    fn damaged_file_gives_a_trial_or_an_error(
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

const COLUMNS: [&str; 6] = ["time_s", "hip_r_deg", "knee_r_deg", "ankle_r_deg", "grf_v_r", "stance_r"];

/// The recording's text with changes to rows (time in seconds): values in the order of [`COLUMNS`].
fn changed(gap: impl Fn(f64) -> bool, change: impl Fn(f64, &mut [f64; 6])) -> String {
    let mut reader = csv::ReaderBuilder::new().comment(Some(b'#')).from_reader(FILE.as_bytes());
    let header = reader.headers().expect("a header").clone();
    let places = COLUMNS.map(|column| header.iter().position(|name| name == column).expect("its column"));
    let mut text = format!("{},gap\n", COLUMNS.join(","));
    for record in reader.records() {
        let record = record.expect("a row");
        let mut values = places.map(|place| record[place].parse::<f64>().expect("a number"));
        let time_s = values[0];
        change(time_s, &mut values);
        let fields: Vec<String> = values.iter().map(f64::to_string).collect();
        text += &format!("{},{}\n", fields.join(","), u8::from(gap(time_s)));
    }
    text
}

fn refusal(text: &str) -> String {
    Trial::parse(text).expect_err("it is refused").to_string()
}

fn assert_says(text: &str, words: &[&str]) {
    let refusal = refusal(text);
    assert!(words.iter().all(|word| refusal.contains(word)), "{refusal}");
}

fn within(from_s: f64, to_s: f64) -> impl Fn(f64) -> bool + Copy {
    move |time_s| time_s >= from_s && time_s < to_s
}

/// The line of this time in a changed text: a header, and 100 rows a second.
fn line(time_s: f64) -> String {
    format!("line {}:", (time_s * 100.0).round() as u64 + 2)
}

#[test]
fn lost_markers_are_rejected_with_their_line() {
    let lost = within(20.0, 20.3);
    let zeros = changed(|_| false, |t, row| row[1..4].iter_mut().filter(|_| lost(t)).for_each(|x| *x = 0.0));
    assert_says(&zeros, &[&line(20.0), "all joints are exactly the same for 30 samples", "gap"]);
    let jump = changed(|_| false, |t, row| row[2] += if within(19.995, 20.005)(t) { 20.0 } else { 0.0 });
    assert_says(&jump, &[&line(20.0), "the knee turns by", "deg/s"]);
    let one = changed(|_| false, |t, row| row[3] = if lost(t) { -5.0 } else { row[3] });
    assert_says(&one, &[&line(20.0), "the ankle is exactly the same for 30 samples"]);
    let still = changed(
        |_| false,
        |t, row| {
            if t < 0.05 {
                row[1..4].copy_from_slice(&[3.7, 11.0, -0.1]);
            }
        },
    );
    assert_says(&still, &["line 2:", "all joints are exactly the same for 5 samples"]);
}

#[test]
fn radians_and_other_signs_and_swapped_columns_are_named() {
    let radians = changed(|_| false, |_, row| row[1..4].iter_mut().for_each(|x| *x = x.to_radians()));
    assert_says(&radians, &["`knee_r_deg` spans only", "radians"]);
    assert_says(&changed(|_| false, |_, row| row[2] = -row[2]), &["`knee_r_deg` is negative in", "sign"]);
    for place in [1, 3] {
        let other_sign = changed(|_| false, |_, row| row[place] = -row[place]);
        assert_says(&other_sign, &[COLUMNS[place], "check its sign"]);
    }
    for (a, b) in [(1, 2), (2, 3), (1, 3)] {
        let swapped = changed(|_| false, |_, row| row.swap(a, b));
        assert_says(&swapped, &["swapped"]);
    }
    let newtons = changed(|_| false, |_, row| row[4] *= 779.0);
    assert_says(&newtons, &["grf_v_r", "check the unit"]);
    assert_says(&changed(|_| false, |_, row| row[4] = -row[4]), &["`grf_v_r` is", "sign"]);
    assert!(
        Trial::parse(&changed(|_| false, |_, row| row[5] = 1.0 - row[5])).is_err(),
        "stance the other way"
    );
}

#[test]
fn separators_and_units_of_time_are_named() {
    assert_says(&short().replace(',', "\t"), &["separated by tabs"]);
    assert_says(&short().replace(',', ";"), &["separated by semicolons"]);
    assert_says(&short().replace(',', ";").replace('.', ","), &["separated by semicolons", "decimal points"]);
    assert_says(&short().replacen("\n5.0,", "\n\"5,0\",", 1), &["decimal comma"]);
    assert_says(&changed(|_| false, |_, row| row[0] *= 1e3), &["steps by 10", "milliseconds"]);
    assert_says(&changed(|_| false, |_, row| row[0] = (row[0] * 100.0).round()), &["steps by 1,", "frames"]);
    assert_says(&changed(|_| false, |_, row| row[0] *= 10.0), &["steps by 0.1", "40 Hz"]);
    let twice = changed(|_| false, |t, row| row[0] = if within(6.995, 7.005)(t) { t - 0.01 } else { t });
    assert_says(&twice, &[&line(7.0), "has to rise"]);
    assert_says(&short().replacen("grf_ap_r", "hip_r_deg", 1), &["`hip_r_deg`", "2 times"]);
}

#[test]
fn byte_order_mark_and_windows_line_ends_change_nothing() {
    let trial = Trial::parse(&format!("\u{feff}{}", short().replace('\n', "\r\n"))).unwrap();
    assert_eq!(trial.heel_strikes_s(), Trial::parse(&short()).unwrap().heel_strikes_s());
}

#[test]
fn marked_gap_splits_and_the_longest_part_is_used() {
    // Force plates that drop out near the end: no load, no stance.
    let out = within(50.0, 54.4);
    let dropped = changed(out, |t, row| row[4..6].iter_mut().filter(|_| out(t)).for_each(|x| *x = 0.0));
    let trial = Trial::parse(&dropped).unwrap();
    let strikes = trial.heel_strikes_s();
    assert!(strikes.len() > 30 && strikes.iter().all(|t| *t < 50.0), "{strikes:?}");
    assert!(trial.notes()[0].contains("gaps at 50.00 to 54.39 s"), "{:?}", trial.notes());
    // The contents of a gap do not matter, except for its times.
    let empty = dropped.replace(",0,0,1\n", ",,,1\n");
    assert_eq!(Trial::parse(&empty).unwrap().heel_strikes_s(), strikes);
    // Without the mark it is no stride.
    let unmarked =
        changed(|_| false, |t, row| row[4..6].iter_mut().filter(|_| out(t)).for_each(|x| *x = 0.0));
    assert_says(&unmarked, &["heel strike"]);
    // Two gaps: the part between them is the longest.
    let two = |t: f64| within(10.0, 10.5)(t) || out(t);
    let trial = Trial::parse(&changed(two, |_, _| {})).unwrap();
    assert!(trial.heel_strikes_s().iter().all(|t| (10.5..50.0).contains(t)), "{:?}", trial.heel_strikes_s());
}

#[test]
fn interpolated_short_gaps_are_used_and_mentioned() {
    let trial = Trial::parse(FILE).unwrap();
    assert_eq!(trial.heel_strikes_s().len(), 43);
    assert!(
        trial.notes()[0].contains("12 marked gaps of up to 140 ms are interpolated"),
        "{:?}",
        trial.notes()
    );
}
