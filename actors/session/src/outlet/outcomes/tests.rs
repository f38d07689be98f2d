//! The entries of frames with outcomes: written, read, and refused.

use proptest::prelude::*;

use super::*;

const FRAMES: [Kind; 2] = [Kind::GNCL_OUTCOMES, Kind::GNCL_OUTCOME_RUNS];

fn app(number: u32) -> AppAddress {
    AppAddress::new(number)
}

/// Returns the queued message with these outcomes.
fn outcome(reported: &ReportedOutcome) -> Message {
    let ticket = Ticket {
        source: Tid::new(NodeAddress::new(2), reported.source),
        destination: Tid::new(NodeAddress::new(1), reported.destination),
        correlation: reported.correlation,
    };
    let mut message = Message::outcome(ticket, reported.outcome.expect("it has a code"));
    message.header.sequence = u64::from(reported.count) - 1;
    message
}

/// Runs of any messages; as many from the start as one frame may have.
fn runs() -> impl Strategy<Value = Vec<ReportedOutcome>> {
    let count = prop_oneof![3 => Just(1_u8), 2 => 1..10_u8, 1 => 1..=128_u8];
    let run = (any::<u32>(), any::<u32>(), any::<u64>(), count, 0..=27_u8);
    proptest::collection::vec(run, 1..40).prop_map(|all| {
        let mut room = OUTCOMES_MAX;
        let runs = all.into_iter().filter_map(|(destination, source, correlation, count, code)| {
            let outcome = Some(Outcome::from_code(code)?);
            let correlation = correlation.min(u64::MAX - 127);
            Some(ReportedOutcome {
                destination: app(destination),
                source: app(source),
                correlation,
                count,
                outcome,
            })
        });
        let fits = |run: &ReportedOutcome| {
            let left = room.checked_sub(usize::from(run.count));
            room = left.unwrap_or(0);
            left.is_some()
        };
        runs.take_while(fits).collect::<Vec<_>>()
    })
}

fn written(runs: &[ReportedOutcome], kind: Kind) -> Message {
    let mut payload = Vec::new();
    runs.iter().for_each(|run| write(&outcome(run), kind, &mut payload));
    Message::new(Header::new(kind, Tid::NONE, Tid::NONE), payload.into())
}

/// Returns the outcome of each message alone.
fn each(runs: &[ReportedOutcome]) -> Vec<ReportedOutcome> {
    let each = |run: &ReportedOutcome| {
        let run = *run;
        (0..u64::from(run.count)).map(move |at| ReportedOutcome {
            correlation: run.correlation + at,
            count: 1,
            ..run
        })
    };
    runs.iter().flat_map(each).collect()
}

proptest! {
    #[test]
    fn any_bytes_give_a_bounded_number_of_outcomes(bytes in proptest::collection::vec(any::<u8>(), 0..3_000)) {
        match read(Kind::GNCL_OUTCOMES, &bytes) {
            Some(outcomes) => prop_assert_eq!(outcomes.count() * EACH, bytes.len()),
            None => prop_assert!(bytes.is_empty() || bytes.len() % EACH != 0 || bytes.len() > OUTCOMES_MAX * EACH),
        }
        if let Some(runs) = read(Kind::GNCL_OUTCOME_RUNS, &bytes) {
            let counts: Vec<usize> = runs.map(|run| usize::from(run.count)).collect();
            prop_assert_eq!(counts.len() * RUN, bytes.len());
            prop_assert!(counts.iter().all(|count| *count > 0));
            prop_assert!((1..=OUTCOMES_MAX).contains(&counts.iter().sum::<usize>()));
        }
    }

    #[test]
    fn encoded_outcomes_are_decoded(runs in runs()) {
        prop_assume!(!runs.is_empty());
        for kind in FRAMES {
            let frame = written(&runs, kind);
            let expected = if kind == Kind::GNCL_OUTCOME_RUNS { runs.clone() } else { each(&runs) };
            prop_assert_eq!(read(kind, &frame.payload).expect("whole outcomes").collect::<Vec<_>>(), expected);
            prop_assert_eq!(messages_in(&frame), each(&runs).len() as u64);
            prop_assert!(read(kind, &frame.payload[1..]).is_none(), "a part of an entry");
        }
    }

    #[test]
    fn one_invalid_count_refuses_the_frame(runs in runs(), at in any::<proptest::sample::Index>(), over in 0..127_u8) {
        prop_assume!(!runs.is_empty());
        let frame = written(&runs, Kind::GNCL_OUTCOME_RUNS);
        let entry = at.index(runs.len());
        for count in [0, 129 + over] {
            let mut payload = frame.payload.to_vec();
            payload[entry * RUN + EACH] = count;
            prop_assert!(read(Kind::GNCL_OUTCOME_RUNS, &payload).is_none(), "a run of {}", count);
        }
    }
}

#[test]
fn frame_has_outcomes_of_at_most_128_messages() {
    let one = ReportedOutcome {
        destination: app(1),
        source: app(2),
        correlation: 1,
        count: 64,
        outcome: Some(Outcome::Delivered),
    };
    let two = [one, ReportedOutcome { correlation: 65, ..one }];
    let three = [two[0], two[1], ReportedOutcome { correlation: 129, count: 1, ..one }];
    for kind in FRAMES {
        assert!(read(kind, &written(&two, kind).payload).is_some(), "{kind}");
        assert!(read(kind, &written(&three, kind).payload).is_none(), "{kind}");
    }
}

#[test]
fn run_behind_the_last_correlation_is_refused() {
    for (first, count, is_valid) in [(u64::MAX, 1, true), (u64::MAX, 2, false), (u64::MAX - 127, 128, true)] {
        let mut entry = vec![0; RUN];
        entry[8..16].copy_from_slice(&first.to_le_bytes());
        entry[EACH] = count;
        assert_eq!(read(Kind::GNCL_OUTCOME_RUNS, &entry).is_some(), is_valid, "{count} from {first}");
    }
}

/// Returns the bytes of a block of the protocol's page.
fn documented(block: &str) -> Vec<u8> {
    let page = include_str!("../../../../../docs/protocol/gncl.md");
    let shown = page.split_once(&format!("```{block}\n")).expect("the block begins").1;
    let shown = shown.split_once("```").expect("the block ends").0;
    let bytes = shown.lines().map(|line| line.split("  ").next().unwrap_or_default());
    bytes
        .flat_map(str::split_whitespace)
        .map(|byte| u8::from_str_radix(byte, 16).expect("two hexadecimal digits"))
        .collect()
}

#[test]
fn documentation_shows_the_bytes_of_outcomes_and_of_runs() {
    let first = ReportedOutcome {
        destination: app(0x1001),
        source: app(0x1002),
        correlation: 7,
        count: 1,
        outcome: Some(Outcome::Delivered),
    };
    let full = Some(Outcome::Rejected(sinew_runtime::outcome::Rejection::QueueFull));
    let read = |kind, block| read(kind, &documented(block)).expect("whole outcomes").collect::<Vec<_>>();
    let second = ReportedOutcome { correlation: 8, outcome: full, ..first };
    assert_eq!(read(Kind::GNCL_OUTCOMES, "outcomes"), [first, second]);
    let runs = [ReportedOutcome { count: 3, ..first }, ReportedOutcome { correlation: 10, ..second }];
    assert_eq!(read(Kind::GNCL_OUTCOME_RUNS, "outcome-runs"), runs);
}
