use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use sinew_record::{Channel, Form, RecordedType, message_head};
use sinew_runtime::wire::{Class, Header};
use sinew_schema::{Field, Schema, Shape};
use sinew_shm::journal::{Journal, Options};

use super::*;
use crate::{Follower, LiveViews, Recording, ViewItem};

const NODE: NodeAddress = NodeAddress::new(0x7f00_0002);
/// The watchdog of a test that waits.
const WATCHDOG: Duration = Duration::from_secs(60);

fn tid(app: u32) -> Tid {
    Tid::new(NODE, AppAddress::new(app))
}

/// A node with a journal, and with two payload types: it knows the structure of the first one.
struct Node {
    folder: PathBuf,
    journal: Journal,
    asked: Arc<Mutex<Vec<AskRecord>>>,
}

/// The connection to it.
struct Link {
    journal: PathBuf,
    asked: Arc<Mutex<Vec<AskRecord>>>,
}

fn kinds() -> [Kind; 2] {
    ["test.angle", "test.torque"].map(Kind::named)
}

fn structure() -> Vec<u8> {
    let field = Field { name: "x".to_owned(), shape: Shape::U8, optional: false };
    Schema { root: Shape::Struct(vec![field]), types: BTreeMap::new() }.encode()
}

fn lock(asked: &Mutex<Vec<AskRecord>>) -> MutexGuard<'_, Vec<AskRecord>> {
    asked.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Connection for Link {
    fn ask(&mut self, question: &AskRecord, _: Duration) -> Result<RecordReport, String> {
        lock(&self.asked).push(question.clone());
        if question.ends {
            return Ok(RecordReport::default());
        }
        let schema = |kind| question.schemas.contains(&kind).then(structure);
        let [angle, torque] = kinds();
        Ok(RecordReport {
            path: Some(self.journal.display().to_string()),
            node: Some(NODE),
            name: "leg".to_owned(),
            types: vec![
                RecordedType { kind: angle, name: "test.angle".to_owned(), schema: schema(angle) },
                RecordedType { kind: torque, name: "test.torque".to_owned(), schema: None },
            ],
            ..RecordReport::default()
        })
    }

    fn node(&self) -> NodeAddress {
        NODE
    }

    fn own(&self) -> Vec<Tid> {
        vec![tid(0x1009)]
    }
}

impl Node {
    fn new(name: &str) -> Self {
        let folder = std::env::temp_dir().join(format!("sinew-session-{name}-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let journal = Self::journal(&folder);
        Self { folder, journal, asked: Arc::default() }
    }

    fn journal(folder: &Path) -> Journal {
        let options = Options { ring_bytes: 64 * 1024, ..Options::default() };
        Journal::create(&folder.join("node.journal"), &options).unwrap()
    }

    fn link(&self) -> Link {
        Link { journal: self.folder.join("node.journal"), asked: self.asked.clone() }
    }

    fn options(&self) -> RecordingOptions {
        RecordingOptions { path: Some(self.folder.join("{node}.mcap")), ..RecordingOptions::default() }
    }

    /// Writes the message `{"x": 5}`.
    fn write(&self, kind: Kind, sequence: u64) {
        let (source, destination, class) = (tid(0x1001), tid(0x1002), Class::Stream);
        let channel = Channel { source, destination, kind, class, form: Form::Sent, refused: None };
        let header = Header { class, sequence, ..Header::new(kind, source, destination) };
        let payload = b"\x81\xa1x\x05";
        let head = message_head(channel.form, &header, payload.len(), None);
        assert!(self.journal.write(channel.key(), Time::now().as_nanos(), &[&head, payload]));
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        // The system clears the folder of temporary files, too.
        let _ = fs::remove_dir_all(&self.folder);
    }
}

/// Returns the roles of the channels beside payloads, by topic.
fn roles(file: &Path) -> BTreeMap<String, String> {
    let mut reader = sinew_bag::read::Reader::open(file).unwrap();
    let mut found = BTreeMap::new();
    while let Some(item) = reader.next_item().unwrap() {
        if let sinew_bag::read::Item::Message(message) = item
            && message.channel.topic.ends_with("/view")
        {
            found.insert(message.channel.topic.clone(), message.channel.value("role").to_owned());
        }
    }
    found
}

// spec: BAG-6
#[test]
fn structures_are_asked_for_before_the_first_message() {
    let node = Node::new("structures");
    let mut session = Session::begin(node.link(), node.options()).unwrap();
    let [angle, torque] = kinds();
    node.write(angle, 1);
    node.write(torque, 1);
    node.write(angle, 2);
    let deadline = Time::now() + WATCHDOG;
    while session.totals().written < 3 {
        assert!(Time::now() < deadline, "waited for three messages");
        assert_eq!(session.step(), None);
    }
    let summary = session.finish(End::Asked);
    assert_eq!((summary.totals.seen, summary.totals.dropped), (3, 0));
    assert!(summary.faults.is_empty(), "{:?}", summary.faults);
    assert_eq!((&*summary.node, summary.file), ("leg", node.folder.join("leg.mcap")));
    let roles = roles(&node.folder.join("leg.mcap"));
    let own: Vec<_> = roles.iter().map(|(topic, role)| (&**topic, &**role)).collect();
    let source = tid(0x1001);
    let topics = [format!("/{source}/test.angle/view"), format!("/{source}/test.torque/view")];
    assert_eq!(own, [(&*topics[0], "view"), (&*topics[1], "json")]);
    let asked = lock(&node.asked);
    let structures: Vec<_> = asked.iter().filter(|question| !question.schemas.is_empty()).collect();
    assert_eq!(structures.len(), 1, "both types with one question: {asked:?}");
    assert!(asked.last().is_some_and(|question| question.ends), "the node ends it at once");
}

#[test]
fn names_are_learned_before_the_first_step() {
    let node = Node::new("names");
    let mut session = Session::begin(node.link(), node.options()).unwrap();
    session.names_mut().add_app(tid(0x1001), "knee.sensor");
    assert!(session.names_mut().has_app("knee.sensor") && session.refresh_names());
    assert_eq!(lock(&node.asked).len(), 2, "the begin, and one more");
    node.write(kinds()[1], 1);
    let file = session.finish(End::Asked).file;
    let topics: Vec<_> = roles(&file).into_keys().collect();
    assert_eq!(topics, ["/knee.sensor/test.torque/view"]);
}

#[test]
fn recording_of_a_program_ends_with_its_file() {
    let node = Node::new("thread");
    let recording = Recording::through(node.link(), node.options()).unwrap();
    node.write(kinds()[0], 1);
    let file = recording.file().to_owned();
    let summary = recording.finish_within(WATCHDOG).unwrap();
    assert_eq!((summary.totals.seen, summary.totals.written, summary.end), (1, 1, End::Asked));
    assert!(sinew_bag::check(&[&file]).unwrap().is_fine());
}

#[test]
fn node_that_refuses_leaves_no_file() {
    struct Refusing;
    impl Connection for Refusing {
        fn ask(&mut self, _: &AskRecord, _: Duration) -> Result<RecordReport, String> {
            Ok(RecordReport { refused: Some("8 programs record".to_owned()), ..RecordReport::default() })
        }
        fn node(&self) -> NodeAddress {
            NODE
        }
        fn own(&self) -> Vec<Tid> {
            Vec::new()
        }
    }
    let node = Node::new("refused");
    let refused = Session::begin(Refusing, node.options()).map(drop).unwrap_err();
    assert_eq!(refused.to_string(), "the node does not record: 8 programs record");
    assert!(!node.folder.join("leg.mcap").exists());
    // And: a file that cannot be made ends the recording at the node.
    let path = Some(node.folder.join("absent/leg.mcap"));
    let failed = Session::begin(node.link(), RecordingOptions { path, ..RecordingOptions::default() });
    assert!(matches!(failed.map(drop), Err(RecordingError::File(_))));
    assert!(lock(&node.asked).last().is_some_and(|question| question.ends));
}

#[test]
fn journal_that_ends_with_its_node_ends_the_recording() {
    let mut node = Node::new("closed");
    let mut session = Session::begin(node.link(), node.options()).unwrap();
    node.write(kinds()[0], 1);
    let other = Journal::create(&node.folder.join("other.journal"), &Options::default()).unwrap();
    drop(std::mem::replace(&mut node.journal, other));
    let deadline = Time::now() + WATCHDOG;
    let end = loop {
        assert!(Time::now() < deadline, "waited for the end");
        if let Some(end) = session.step() {
            break end;
        }
    };
    assert_eq!(end, End::Closed);
    assert_eq!(session.finish(end).totals.written, 1);
}

#[test]
fn messages_beyond_the_maximum_size_are_counted() {
    let node = Node::new("full");
    let file = sinew_bag::Options {
        compression: Compression::None,
        size_max: Some(64 * 1024),
        ..sinew_bag::Options::default()
    };
    let options = RecordingOptions { file, goes_on_when_full: true, ..node.options() };
    let mut session = Session::begin(node.link(), options).unwrap();
    let deadline = Time::now() + WATCHDOG;
    for sequence in 1..=2_000 {
        node.write(kinds()[0], sequence);
        // The journal keeps some hundred messages.
        while sequence % 100 == 0 && session.totals().seen < sequence {
            assert!(Time::now() < deadline, "waited for all messages");
            assert_eq!(session.step(), None);
        }
    }
    let summary = session.finish(End::Asked);
    let Totals { seen, written, dropped, .. } = summary.totals;
    assert!(seen == 2_000 && written > 0 && dropped > 0 && seen == written + dropped, "{summary:?}");
    assert!(summary.is_whole(), "its limit is no fault: {summary:?}");
    let last = lock(&node.asked).last().and_then(|question| question.counts);
    assert_eq!(last, Some(RecordCounts { seen, dropped }), "the node reports them");
}

#[test]
fn recordings_of_one_second_have_numbers() {
    let node = Node::new("second");
    let origin = Origin { node: "leg".to_owned(), ..Origin::default() };
    let create_at = |name: &str| {
        let path = Some(node.folder.join(name));
        create(&RecordingOptions { path, ..RecordingOptions::default() }, &origin).map(|bag| bag.path())
    };
    let names = [(); 2].map(|()| create_at("{node}-{time}.mcap").unwrap());
    assert!(names[0].display().to_string().ends_with("/leg-1970-01-01-000000.mcap"), "{names:?}");
    assert!(names[1].display().to_string().ends_with("/leg-1970-01-01-000000-2.mcap"), "{names:?}");
    // And: a name without the time is not changed
    assert!(create_at("leg.mcap").is_ok() && create_at("leg.mcap").is_err());
}

#[test]
fn follower_hands_over_messages_and_writes_no_file() {
    let node = Node::new("follower");
    let mut follower = Follower::begin(node.link(), Selection::default()).unwrap();
    let [angle, torque] = kinds();
    node.write(angle, 7);
    node.write(torque, 8);
    let mut seen = Vec::new();
    follower
        .poll(&mut |message| {
            assert!(message.is_sent);
            let name = message.names.type_name(message.header.kind).map(str::to_owned);
            seen.push((message.header.sequence, message.destination, name, message.payload.to_vec()));
        })
        .unwrap();
    let payload = b"\x81\xa1x\x05".to_vec();
    let message = |sequence, name: &str| (sequence, tid(0x1002), Some(name.to_owned()), payload.clone());
    assert_eq!(seen, [message(7, "test.angle"), message(8, "test.torque")]);
    // And: another selection reaches the node at once
    let apps = vec!["knee".to_owned()];
    follower.select(Selection { apps: apps.clone(), ..Selection::default() }).unwrap();
    assert_eq!(lock(&node.asked).last().map(|question| question.selection.apps.clone()), Some(apps));
    drop(follower.finish());
    assert!(lock(&node.asked).last().is_some_and(|question| question.ends && question.counts.is_none()));
    assert!(!node.folder.join("leg.mcap").exists());
}

#[test]
fn follower_reads_the_journal_that_replaces_a_closed_one() {
    let mut node = Node::new("replaced");
    let mut follower = Follower::begin(node.link(), Selection::default()).unwrap();
    let [angle, _] = kinds();
    node.write(angle, 1);
    // When: the node closes its journal, and begins another one for the next question
    node.journal = Node::journal(&node.folder);
    follower.select(Selection { apps: vec!["knee".to_owned()], ..Selection::default() }).unwrap();
    node.write(angle, 2);
    let mut seen = Vec::new();
    follower.poll(&mut |message| seen.push(message.header.sequence)).unwrap();
    assert_eq!(seen, [2]);
}

#[test]
fn live_views_have_the_schema_that_the_node_knows() {
    let node = Node::new("live");
    let mut live = LiveViews::begin(node.link(), Selection::default(), Selection::default()).unwrap();
    let [angle, torque] = kinds();
    let topic = |name: &str| format!("/{}/{name}/view", tid(0x1001));
    live.want(&BTreeSet::from([topic("test.angle")]));
    // Given: three messages, of which the node counts one and does not have it any more
    node.write(angle, 7);
    node.journal.count(
        Channel {
            source: tid(0x1001),
            destination: tid(0x1002),
            kind: angle,
            class: Class::Stream,
            form: Form::Sent,
            refused: None,
        }
        .key(),
        1,
    );
    node.write(angle, 9);
    node.write(torque, 10);
    // When
    let mut items = Vec::new();
    // The last one waits for the one before.
    let until = Time::now() + WATCHDOG;
    while !items.iter().any(|item| matches!(item, ViewItem::Missed { .. })) {
        assert!(Time::now() < until, "{items:?}");
        live.poll(&mut |item| items.push(item)).unwrap();
    }
    // Then
    let channels: Vec<_> = items
        .iter()
        .filter_map(|item| match item {
            ViewItem::Channel(channel) => Some((channel.topic.clone(), channel.encoding)),
            ViewItem::Message { .. } | ViewItem::Missed { .. } => None,
        })
        .collect();
    assert_eq!(channels, [(topic("test.angle"), "protobuf"), (topic("test.torque"), "json")]);
    let of_angles = items.iter().filter_map(|item| match item {
        ViewItem::Message { topic, data, .. } => Some((**topic == *channels[0].0, data[..2].to_vec())),
        ViewItem::Channel(_) | ViewItem::Missed { .. } => None,
    });
    // The field x is 5.
    assert_eq!(of_angles.collect::<Vec<_>>(), vec![(true, vec![0x08, 5]); 2]);
    assert!(items.iter().any(|item| matches!(item, ViewItem::Missed { count: 1, .. })), "{items:?}");
    // And: another selection reaches the node at once, and the recording ends
    let types = vec!["test.angle".to_owned()];
    live.select(Selection { types: types.clone(), ..Selection::default() }).unwrap();
    assert_eq!(lock(&node.asked).last().map(|question| question.selection.types.clone()), Some(types));
    drop(live.finish());
    assert!(lock(&node.asked).last().is_some_and(|question| question.ends && question.counts.is_none()));
}
