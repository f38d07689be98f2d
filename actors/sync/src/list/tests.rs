use proptest::prelude::*;

use sinew_runtime::wire::SchemaHash;

use super::*;

fn name(text: &str) -> Name {
    Name::try_from(text.to_owned()).unwrap()
}

fn entry(index: u32, text: &str) -> Entry {
    Entry {
        name: name(text),
        app: AppAddress::fixed(index).unwrap(),
        ready: true,
        ended: None,
        phases: Vec::new(),
        requires: Vec::new(),
        kinds: Vec::new(),
        handles: Vec::new(),
        sends: Vec::new(),
    }
}

fn list(entries: Vec<Entry>) -> List {
    List { incarnation: Incarnation(7), version: 1, entries, groups: vec![AppAddress::group("drives")] }
}

fn many(count: u32) -> Vec<Entry> {
    (0..count).map(|n| entry(n, &format!("app{n}"))).collect()
}

fn any_list() -> impl Strategy<Value = List> {
    let entry = ("[a-z.]{1,63}", any::<bool>(), proptest::collection::vec("[a-z]{1,8}", 0..4));
    let entries = proptest::collection::vec(entry, 0..8);
    (any::<u64>(), any::<u64>(), entries).prop_map(|(incarnation, version, entries)| List {
        incarnation: Incarnation(incarnation),
        version,
        entries: (0u32..)
            .zip(entries)
            .map(|(n, (text, ready, requires))| Entry {
                name: name(&format!("{n}{}", &text[..text.len().min(60)])),
                app: AppAddress::fixed(n).unwrap(),
                ready,
                ended: (!ready).then_some(Ended::Failed),
                phases: if ready { vec![name("homed")] } else { Vec::new() },
                requires: requires.iter().map(|text| text.parse().unwrap()).collect(),
                kinds: vec![Kind::named("demo.angle")],
                handles: vec![(Kind::named("demo.angle"), SchemaHash(u64::from(n)))],
                sends: vec![(Kind::named("demo.speed"), SchemaHash(u64::MAX))],
            })
            .collect(),
        groups: Vec::new(),
    })
}

proptest! {
    #[test]
    fn encoded_list_decodes_to_the_same(list in any_list()) {
        let (bytes, left_out) = list.clone().encode(usize::MAX);
        prop_assert_eq!(left_out, 0);
        prop_assert_eq!(List::parse(&bytes).unwrap(), list);
    }

    #[test]
    fn any_bytes_are_a_list_or_an_error(bytes: Vec<u8>) {
        let _ = List::parse(&bytes);
    }

    #[test]
    fn a_damaged_list_is_a_list_or_an_error(list in any_list(), at: prop::sample::Index, byte: u8, cut: prop::sample::Index) {
        let mut bytes = list.encode(usize::MAX).0.to_vec();
        let at = at.index(bytes.len());
        bytes[at] = byte;
        let _ = List::parse(&bytes);
        bytes.truncate(cut.index(bytes.len()));
        let _ = List::parse(&bytes);
    }
}

#[test]
fn the_documented_bytes_are_a_list() {
    let text = include_str!("../../../../docs/protocol/sync.md");
    let block = text.split("```").find(|block| block.starts_with("text\n84")).unwrap();
    let is_byte = |token: &&str| token.len() == 2 && u8::from_str_radix(token, 16).is_ok();
    let tokens = block.lines().flat_map(|line| line.split_whitespace().take_while(is_byte));
    let bytes: Vec<u8> = tokens.map(|token| u8::from_str_radix(token, 16).unwrap()).collect();
    let documented = List { version: 3, groups: Vec::new(), ..list(vec![entry(0, "knee.drive")]) };
    assert_eq!(encode(&documented), bytes);
    assert_eq!(List::parse(&bytes).unwrap(), documented);
}

#[test]
fn false_lengths_reserve_no_memory() {
    // A map with "entries": an array that claims 2^32 - 1 elements.
    let mut bytes = vec![0x81, 0xa7];
    bytes.extend_from_slice(b"entries");
    bytes.extend_from_slice(&[0xdd, 0xff, 0xff, 0xff, 0xff]);
    assert!(List::parse(&bytes).is_err());
    assert!(List::parse(&[0x91; 100_000]).is_err(), "depth without end is refused");
}

#[test]
fn list_holds_exactly_its_maximum_of_entries() {
    assert!(List::parse(&encode(&list(many(ENTRIES_MAX as u32)))).is_ok());
    assert!(List::parse(&encode(&list(many(ENTRIES_MAX as u32 + 1)))).is_err());
}

#[test]
fn names_of_1_to_63_bytes_are_legal() {
    for (text, legal) in
        [("", false), ("a", true), (&"x".repeat(63), true), (&"x".repeat(64), false), ("a\nb", false)]
    {
        assert_eq!(Name::try_from(text.to_owned()).is_ok(), legal, "{text:?}");
    }
}

#[test]
fn duplicates_and_foreign_addresses_are_rejected() {
    let mut layer = entry(0, "a");
    layer.app = AppAddress::SYNC;
    let mut groups = list(Vec::new());
    groups.groups.push(groups.groups[0]);
    let mut no_group = list(Vec::new());
    no_group.groups.push(AppAddress::fixed(0).unwrap());
    let same_name = list(vec![entry(0, "a"), entry(1, "a")]);
    let same_app = list(vec![entry(0, "a"), entry(0, "b")]);
    for bad in [list(vec![layer]), groups, no_group, same_name, same_app] {
        assert!(List::parse(&encode(&bad)).is_err(), "{bad:?}");
    }
}

#[test]
fn list_above_the_payload_limit_leaves_out_the_rest() {
    let (bytes, left_out) = list(many(100)).encode(1_000);
    let read = List::parse(&bytes).unwrap();
    assert!(bytes.len() <= 1_000 && bytes.len() > 900, "{}", bytes.len());
    assert_eq!(read.entries.len() + left_out, 100);
    assert_eq!(list(many(2_000)).encode(usize::MAX).1, 2_000 - ENTRIES_MAX);
}

/// Returns this many groups from this one on, each with these members.
fn joined(first: u32, count: usize, members: &[AppAddress]) -> Vec<(AppAddress, Arc<[AppAddress]>)> {
    (first..).take(count).map(|number| (AppAddress::new(0xf000_0000 + number), Arc::from(members))).collect()
}

#[test]
fn groups_of_guests_come_last_and_displace_no_others() {
    let [own, guest] = [0x1000, 0x8000_0000].map(AppAddress::new);
    let guests = BTreeSet::from([guest]);
    // Given: guests in more groups than a list holds, all with lower addresses than the groups of the robot's own
    let low = joined(0, 1_280, &[guest]);
    for (count, room) in [(1, 128), (900, 124), (GROUPS_MAX, 0), (GROUPS_MAX + 3, 0)] {
        let its = joined(10_000, count, &[own]);
        // When
        let published = Published::of([low.clone(), its.clone()].concat(), &guests);
        // Then
        let listed = count.min(GROUPS_MAX);
        assert_eq!((published.groups.len(), published.own), (listed + room, listed));
        assert!(
            its.iter().take(listed).map(|(group, _)| *group).eq(published.groups[..listed].iter().copied())
        );
        assert_eq!((published.own_left_out, published.guests_left_out), (count - listed, 1_280 - room));
        let words = published.left_out().expect("guests have no room").to_string();
        assert!(words.contains("[[client]]") && !words.contains("payload_max"), "{words}");
        assert_eq!(words.contains("more nodes"), count > GROUPS_MAX, "{words}");
    }
}

#[test]
fn group_of_the_robot_stays_own_with_guests() {
    let [own, guest] = [0x1000, 0x8000_0000].map(AppAddress::new);
    let both = [joined(5, 1, &[own, guest]), joined(9, 1, &[guest])].concat();
    let published = Published::of([joined(1, 1, &[guest]), both].concat(), &BTreeSet::from([guest]));
    assert_eq!(published.groups, [5, 1, 9].map(|number| AppAddress::new(0xf000_0000 + number)));
    assert_eq!(published.left_out(), None);
    assert_eq!(Published::of(Vec::new(), &BTreeSet::new()), Published::default());
}

#[test]
fn structures_of_types_go_before_any_name() {
    let kind = |n: u64| Kind::named(&format!("demo.angle{n}"));
    let types = || (0..64).map(|n| (kind(n), SchemaHash(n))).collect::<Vec<_>>();
    let with_types = |n| Entry { handles: types(), sends: types(), ..entry(n, &format!("app{n}")) };
    let all = list((0..10).map(with_types).collect());
    let (bytes, omitted) = all.clone().encode_within(usize::MAX, 1);
    assert_eq!((List::parse(&bytes).unwrap(), omitted), (all.clone(), Omitted::default()));
    // The last entry has no room for its types, and all others have.
    let (bytes, omitted) = all.clone().encode_within(bytes.len() - 1, 1);
    let mut expected = all.clone();
    (expected.entries[9].handles, expected.entries[9].sends) = (Vec::new(), Vec::new());
    assert_eq!(List::parse(&bytes).unwrap(), expected);
    assert_eq!(omitted, Omitted { elements: 0, types_of: 1 });
    // Without room for any types the names stay.
    let names = list(many(10));
    let (bytes, omitted) = all.encode_within(encode(&names).len(), 1);
    assert_eq!((List::parse(&bytes).unwrap(), omitted), (names, Omitted { elements: 0, types_of: 10 }));
}

#[test]
fn second_type_of_a_kind_is_ignored() {
    let kind = Kind::named("demo.angle");
    let twice =
        vec![(kind, SchemaHash(1)), (Kind::named("demo.speed"), SchemaHash(2)), (kind, SchemaHash(3))];
    let sent = list(vec![Entry { handles: twice.clone(), sends: twice.clone(), ..entry(0, "a") }]);
    let read = List::parse(&encode(&sent)).unwrap();
    assert_eq!((&read.entries[0].handles[..], &read.entries[0].sends[..]), (&twice[..2], &twice[..2]));
}

#[test]
fn groups_that_do_not_fit_are_left_out_too() {
    let groups: Vec<_> = (0..100).map(|n| AppAddress::group(&n.to_string())).collect();
    let (bytes, left_out) = List { groups: groups.clone(), ..list(many(10)) }.encode(200);
    let read = List::parse(&bytes).unwrap();
    assert_eq!(read.groups, groups[..read.groups.len()], "the last ones go");
    assert!(bytes.len() <= 200 && bytes.len() > 190, "{}", bytes.len());
    assert_eq!((read.entries.len(), read.groups.len() + left_out), (0, 110));
    assert!(list(Vec::new()).encode(64).0.len() <= 64);
}
