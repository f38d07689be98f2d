//! The choice of files and the report.

use super::*;

fn written(file: &Path) -> Converted {
    Converted {
        file: file.to_owned(),
        node: "knee".to_owned(),
        origin: (NodeAddress::new(1), Some(0x1f)),
        written: 1,
        dropped: 0,
        first_ns: 5,
        last_ns: 9,
        times: 3..=10,
        trigger: None,
        has_died: false,
    }
}

#[test]
fn no_file_of_one_run_replaces_another() {
    let (out, first, second) = (Path::new("out"), NodeAddress::new(1), NodeAddress::new(2));
    let (path, is_new) = path_of(&[], out, ("knee", first), "a-1");
    assert!(is_new && path == Path::new("out/knee-a-1.mcap"), "{path:?}");
    let files = [written(&path)];
    let (other, is_new) = path_of(&files, out, ("knee", second), "a-1");
    assert!(is_new && other == Path::new("out/knee-0.0.0.2-a-1.mcap"), "{other:?}");
    let files = [written(&path), written(&other)];
    assert!(!path_of(&files, out, ("knee", second), "a-1").1);
}

#[test]
fn part_of_a_living_node_is_not_written_again() {
    let ring = |incarnation| DeadRing {
        path: "sinew-leg-0.0.0.1.journal".into(),
        name: "knee".to_owned(),
        address: NodeAddress::new(1),
        facts: FrozenFacts::default(),
        incarnation,
        id: format!("died-{incarnation:x}"),
        is_of_this_boot: true,
    };
    let files = [written(Path::new("knee-a-1.mcap"))];
    assert!(has_ring(&files, &ring(0x1f)));
    assert!(!has_ring(&files, &ring(0x1e)), "the span is of the next incarnation");
    assert!(!has_ring(&[], &ring(0x1f)));
}

#[test]
fn ring_that_no_node_hands_out_is_gathered_whole() {
    assert_eq!(part_of("died-1f", "died-1f", false), Part::Whole);
    assert_eq!(part_of("died-1f", "died-1f", true), Part::None, "its node has started again");
    assert_eq!(part_of("died-1f", "died-20", false), Part::None);
    assert_eq!(part_of("10.0.0.2-1-1", "died-1f", true), Part::Span);
}

#[test]
fn replaced_span_is_another_one() {
    let span = FrozenSpan { begin_ns: 3, end_ns: 9, ..FrozenSpan::default() };
    let facts = |span: &FrozenSpan| FrozenFacts { span: Some(span.clone()), ..FrozenFacts::default() };
    let fetched = FrozenSpan { is_fetched: true, ..span.clone() };
    assert!(is_same(&facts(&span), &facts(&fetched)), "another command has fetched it");
    for other in [FrozenSpan { begin_ns: 2, ..span.clone() }, FrozenSpan { end_ns: 10, ..span.clone() }] {
        assert!(!is_same(&facts(&span), &facts(&other)), "{other:?}");
    }
}

#[test]
fn missing_edges_of_a_span_are_stated() {
    let found = Found::default();
    let report = gathered(&found, &[written(Path::new("knee.mcap"))]);
    assert!(report.text.contains("covers 0 us of 0 us"), "{}", report.text);
    let file = &report.json["files"][0];
    assert_eq!((file["covered_ns"].as_u64(), file["span_ns"].as_u64()), (Some(4), Some(7)));
    let whole = Converted { times: 0..=u64::MAX, ..written(Path::new("knee.mcap")) };
    assert_eq!(whole.json()["span_ns"].as_u64(), None);
}

#[test]
fn ended_node_has_one_line_for_its_spans() {
    let silent = |name: &str| Silent {
        name: name.to_owned(),
        why: "no answer within 1s".to_owned(),
        spans: vec!["a-1".to_owned(), "a-2".to_owned()],
    };
    let nodes = [(NodeAddress::new(1), silent("hip")), (NodeAddress::new(2), silent("knee"))];
    let mut found = Found { silent: BTreeMap::from(nodes), ..Found::default() };
    found.report_silent();
    let report = gathered(&found, &[]);
    assert_eq!(report.text.lines().count(), 2, "{}", report.text);
    for words in ["0.0.0.1 hip has ended, or does not answer any more: no answer", "not fetched: a-1, a-2"] {
        assert!(report.text.contains(words), "{words}: {}", report.text);
    }
    assert!(!report.is_fine);
}
