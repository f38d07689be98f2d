use std::path::PathBuf;

use super::*;

fn node(last: u8) -> NodeAddress {
    NodeAddress::from([127, 0, 0, last])
}

fn channel(source_node: NodeAddress, source: &str, kind: u32) -> ViewChannel {
    let metadata = [
        ("sinew.source", "127.0.0.1/80000001".to_owned()),
        ("sinew.source_name", source.to_owned()),
        ("sinew.source_node", source_node.to_string()),
        ("sinew.type", "exo.angle".to_owned()),
        ("sinew.kind", kind.to_string()),
    ];
    let metadata = metadata.map(|(key, value)| (key.to_owned(), value)).into();
    ViewChannel { topic: format!("/{source}/exo.angle/view"), metadata, ..ViewChannel::default() }
}

fn origin(source: &str, type_name: &str, last: u8) -> Origin {
    Origin { source: source.to_owned(), type_name: type_name.to_owned(), is_named: true, node: node(last) }
}

/// Returns channels of two local nodes and of one out of reach.
fn channels() -> Channels {
    let entry = Arc::new(Entry::new(PathBuf::new()));
    let shown = Selection { apps: vec!["*".to_owned()], ..Selection::default() };
    let mut channels = Channels::new(entry, Duration::ZERO, shown);
    channels.fixed = ViewWriter::fixed_channels().into_iter().map(|channel| channel.topic).collect();
    for (topic, origin) in [
        ("/hip/a/view", origin("hip", "a", 1)),
        ("/knee/b/view", origin("knee", "b", 2)),
        ("/far/c/view", origin("far", "c", 3)),
    ] {
        channels.origins.insert(topic.to_owned(), origin);
    }
    channels
}

#[test]
fn message_is_read_at_the_node_of_its_source() {
    let here = BTreeSet::from([node(1), node(2)]);
    let kind = Kind::named("exo.angle").bits();
    let of = |source_node, at| origin_of(&channel(source_node, "hip", kind), at, &here);
    assert_eq!(of(node(1), node(1)), Some(origin("hip", "exo.angle", 1)));
    assert_eq!(of(node(1), node(2)), None, "the hip's node has the copy of the sender");
    assert_eq!(of(node(3), node(2)), Some(origin("hip", "exo.angle", 3)));
    // And: a node selects messages only by names
    let unnamed = [channel(node(1), "hip", kind + 1), channel(node(1), "", kind)];
    for channel in unnamed {
        assert_eq!(origin_of(&channel, node(1), &here).map(|origin| origin.is_named), Some(false));
    }
}

#[test]
fn only_nodes_with_wanted_topics_record() {
    let mut channels = channels();
    let here = BTreeSet::from([node(1), node(2)]);
    let selected = |channels: &Channels, last| {
        let selection = channels.selection(&channels.wanted_of(node(last), &here))?;
        Some((selection.apps, selection.types))
    };
    assert_eq!((selected(&channels, 1), selected(&channels, 2)), (None, None));
    let names = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
    channels.wanted.insert("/knee/b/view".to_owned());
    assert_eq!(selected(&channels, 1), None);
    assert_eq!(selected(&channels, 2), Some((names(&["knee"]), names(&["b"]))));
    // And: messages of a node out of reach are read at their destinations
    channels.wanted.insert("/far/c/view".to_owned());
    assert_eq!(selected(&channels, 1), Some((names(&["far"]), names(&["c"]))));
    assert_eq!(selected(&channels, 2), Some((names(&["far", "knee"]), names(&["b", "c"]))));
    // And: counters and outcomes are of all messages
    for topic in ABOUT_ALL {
        assert!(channels.fixed.contains(topic), "{topic}");
        channels.wanted.insert(topic.to_owned());
        assert_eq!(selected(&channels, 1), Some((names(&["*"]), Vec::new())));
        channels.wanted.remove(topic);
    }
    // And: log lines need no message
    channels.wanted.insert("/sinew/log".to_owned());
    assert_eq!(selected(&channels, 1), Some((names(&["far"]), names(&["c"]))));
    channels.wanted = BTreeSet::from(["/sinew/log".to_owned()]);
    assert_eq!(selected(&channels, 1), Some((Vec::new(), names(&[NO_TYPE]))));
}

#[test]
fn more_names_than_a_selection_has_select_all() {
    let mut channels = channels();
    for number in 0..100 {
        let topic = format!("/{number}/a/view");
        channels.origins.insert(topic.clone(), origin(&number.to_string(), "a", 1));
        channels.wanted.insert(topic);
    }
    let wanted = channels.wanted_of(node(1), &BTreeSet::from([node(1)]));
    assert_eq!(channels.selection(&wanted).map(|selection| selection.apps), Some(vec!["*".to_owned()]));
}
