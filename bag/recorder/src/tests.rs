//! The recorder, with journals that the tests write.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use sinew_bag::{BagWriter, Options, Origin, Totals};
use sinew_record::{
    Channel, ClockFact, Entry, Fact, Form, LogFact, MessageEntry, NodeFact, OutcomeEntry, PeerClock,
    Selection, fact, lost_channel, message_head,
};
use sinew_runtime::{
    outcome::{Outcome, Rejection, Ticket},
    protection::{DataId, Stamp, seal},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Class, Header, Kind},
};
use sinew_schema::{Field, Schema, Shape};
use sinew_shm::journal::{self, Journal, JournalReader, Start};

use crate::{Names, Recorder, Setup};

const NODE: NodeAddress = NodeAddress::new(0x7f00_0002);
const SECOND: u64 = 1_000_000_000;
const RING: u64 = 64 * 1024;
/// The payload `{"x": 5}`.
const PAYLOAD: &[u8] = b"\x81\xa1x\x05";

fn tid(app: u32) -> Tid {
    Tid::new(NODE, AppAddress::new(app))
}

/// A channel from the hip to the knee.
fn angles() -> Channel {
    Channel {
        source: tid(0x1001),
        destination: tid(0x1002),
        kind: Kind::named("test.angle"),
        class: Class::Stream,
        form: Form::Sent,
        refused: None,
    }
}

fn header(channel: &Channel, sequence: u64) -> Header {
    Header {
        class: channel.class,
        sequence,
        ..Header::new(channel.kind, channel.source, channel.destination)
    }
}

/// A journal and the file of its recording.
struct Bench {
    folder: PathBuf,
    journal: Journal,
    recorder: Recorder,
}

impl Bench {
    fn new(name: &str, selection: Selection) -> Self {
        let folder = std::env::temp_dir().join(format!("sinew-recorder-{name}-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let path = folder.join("node.journal");
        let journal =
            Journal::create(&path, &journal::Options { ring_bytes: RING, ..journal::Options::default() })
                .unwrap();
        // Messages before the beginning are in no counter.
        write(&journal, &angles(), 1, SECOND);
        let reader = JournalReader::open(&path, Start::Oldest).unwrap();
        let origin = Origin { node: "leg".into(), address: NODE.to_string(), ..Origin::default() };
        let bag = BagWriter::create(folder.join("leg.mcap"), Options::default(), origin).unwrap();
        let mut names = Names::default();
        for (app, name) in [(0x1001, "hip"), (0x1002, "knee")] {
            names.add_app(tid(app), name);
        }
        names.add_type(Kind::named("test.angle"), "test.angle");
        // Its structure is not known, and the recorder does not wait for it.
        names.add_schema(Kind::named("test.angle"), None);
        let setup = Setup { node: NODE, selection, names, left_out: vec![tid(0x1009)] };
        let recorder = Recorder::begin(reader, bag, setup).unwrap();
        Self { folder, journal, recorder }
    }

    /// Reads all records. Messages that wait for names get none.
    fn read(&mut self, now_ns: u64) {
        while !self.recorder.pump(now_ns).unwrap() {}
    }

    /// Ends the recording, and checks the file. Returns the topics with messages, too.
    fn finish(mut self) -> (Totals, Vec<String>) {
        self.recorder.stop().unwrap();
        self.read(8 * SECOND);
        let totals = self.recorder.finish(9 * SECOND).unwrap();
        assert_eq!(totals.seen, totals.written + totals.dropped);
        let file = self.folder.join("leg.mcap");
        let report = sinew_bag::check(&[&file]).unwrap();
        assert!(report.is_fine(), "{:?}", report.findings);
        let info = sinew_bag::info(&file).unwrap();
        fs::remove_dir_all(&self.folder).unwrap();
        (totals, info.channels.into_iter().map(|channel| channel.topic).collect())
    }
}

fn write(journal: &Journal, channel: &Channel, sequence: u64, at_ns: u64) {
    write_payload(journal, channel, PAYLOAD, (sequence, at_ns));
}

fn write_payload(journal: &Journal, channel: &Channel, payload: &[u8], (sequence, at_ns): (u64, u64)) {
    let head = message_head(channel.form, &header(channel, sequence), payload.len(), channel.refused);
    assert!(journal.write(channel.key(), at_ns, &[&head, payload]));
}

fn write_fact<F: Fact>(journal: &Journal, of: &F) {
    let (source, destination) = (Tid::new(NODE, AppAddress::NONE), Tid::NONE);
    let (kind, class) = (Kind::from_bits(0), Class::Control);
    let channel = Channel { source, destination, kind, class, form: F::FORM, refused: None };
    assert!(journal.write(channel.key(), SECOND, &[&fact(of)]));
}

#[test]
fn gap_is_counted_and_named() {
    let mut bench = Bench::new("gap", Selection::default());
    for sequence in 2..=10 {
        write(&bench.journal, &angles(), sequence, SECOND + sequence);
    }
    // Three messages that were too long for the ring, say.
    bench.journal.count(angles().key(), 3);
    write(&bench.journal, &angles(), 14, 2 * SECOND);
    assert!(bench.recorder.pump(2 * SECOND).unwrap());
    let Totals { seen, written, .. } = bench.recorder.totals();
    assert_eq!((seen, written), (9, 9), "the last one waits for those before");
    assert!(bench.recorder.pump(3 * SECOND).unwrap());
    assert_eq!(bench.recorder.totals().seen, 13);
    // These are at the end, and after it.
    bench.journal.count(angles().key(), 2);
    bench.recorder.stop().unwrap();
    assert!(!bench.recorder.is_drained());
    write(&bench.journal, &angles(), 17, 3 * SECOND);
    let (totals, topics) = bench.finish();
    assert_eq!((totals.seen, totals.written, totals.dropped), (15, 10, 5));
    assert!(topics.iter().any(|topic| topic == "/hip/test.angle"), "{topics:?}");
}

#[test]
fn overtaken_reader_counts_the_overwritten_messages() {
    let mut bench = Bench::new("overtaken", Selection::default());
    let count = 3 * RING / 64;
    for sequence in 2..=count {
        write(&bench.journal, &angles(), sequence, SECOND);
    }
    bench.recorder.pump(SECOND).unwrap();
    let (totals, _) = bench.finish();
    assert_eq!(totals.seen, count - 1);
    assert!(totals.dropped > 0 && totals.written > 0, "{totals:?}");
}

#[test]
fn numbers_in_another_order_are_not_missing() {
    let mut bench = Bench::new("order", Selection::default());
    bench.journal.count(angles().key(), 5);
    let table = JournalReader::open(bench.journal.path(), Start::Newest).unwrap().channels().unwrap();
    let place = table.iter().find(|channel| channel.key == Some(angles().key())).unwrap().place;
    for number in [3, 2, 6, 4, 5, 5] {
        let found = journal::Record { place, number, time: SECOND, position: 0 };
        let message = MessageEntry {
            form: Form::Sent,
            header: header(&angles(), number),
            length: 1,
            payload: Some(&[5]),
            refused: None,
        };
        bench.recorder.take(&found, &Entry::Message(message)).unwrap();
    }
    let (totals, _) = bench.finish();
    assert_eq!((totals.seen, totals.written, totals.dropped), (5, 5, 0));
}

#[test]
fn messages_of_others_and_recorder_are_left_out() {
    let selection = Selection { apps: vec!["hip".to_owned()], ..Selection::default() };
    let mut bench = Bench::new("selected", selection);
    let arm = Channel { source: tid(0x1003), destination: tid(0x1004), ..angles() };
    let own = Channel { source: tid(0x1009), ..angles() };
    write(&bench.journal, &angles(), 2, SECOND);
    write(&bench.journal, &arm, 1, SECOND);
    write(&bench.journal, &own, 1, SECOND);
    bench.journal.count(lost_channel(tid(0x1001)).key(), 4);
    bench.journal.count(lost_channel(tid(0x1003)).key(), 4);
    bench.read(SECOND);
    let (totals, _) = bench.finish();
    assert_eq!((totals.seen, totals.written, totals.dropped), (5, 1, 4));
}

#[test]
fn name_that_comes_later_chooses_the_messages_after_it() {
    let selection = Selection { apps: vec!["arm".to_owned()], ..Selection::default() };
    let mut bench = Bench::new("later", selection);
    let arm = Channel { source: tid(0x1003), destination: tid(0x1004), ..angles() };
    write(&bench.journal, &arm, 1, SECOND);
    let (node, app, name) = (NODE, AppAddress::new(0x1003), "arm".to_owned());
    write_fact(&bench.journal, &NodeFact::AppNamed { node, app, name, is_ready: true });
    write(&bench.journal, &arm, 2, SECOND);
    bench.read(SECOND);
    let (totals, topics) = bench.finish();
    assert_eq!((totals.seen, totals.written), (1, 1));
    assert!(topics.iter().any(|topic| topic == "/arm/test.angle"), "{topics:?}");
}

#[test]
fn span_of_a_dead_journal_is_complete_in_itself() {
    let Bench { folder, journal, recorder } = Bench::new("span", Selection::default());
    drop(recorder);
    fs::remove_file(folder.join("leg.mcap")).unwrap();
    for sequence in 2..=20 {
        write(&journal, &angles(), sequence, sequence * SECOND);
    }
    // Two messages that were too long for the ring, say.
    journal.count(angles().key(), 2);
    for sequence in 23..=40 {
        write(&journal, &angles(), sequence, sequence * SECOND);
    }
    let span = crate::Span::scan(journal.path(), &(5 * SECOND..=30 * SECOND)).unwrap();
    assert_eq!((span.records, span.first_ns, span.last_ns), (24, 5 * SECOND, 30 * SECOND));
    let reader = JournalReader::open(journal.path(), Start::Oldest).unwrap();
    let origin = Origin { node: "leg".into(), address: NODE.to_string(), ..Origin::default() };
    let file = folder.join("leg.mcap");
    let bag = BagWriter::create(file.clone(), Options::default(), origin).unwrap();
    let (selection, names) = (Selection::default(), Names::default());
    let setup = Setup { node: NODE, selection, names, left_out: Vec::new() };
    let mut recorder = Recorder::of_span(reader, bag, setup, &span);
    while !recorder.pump(span.last_ns).unwrap() {}
    let totals = recorder.finish(span.last_ns).unwrap();
    assert_eq!((totals.seen, totals.written, totals.dropped), (26, 24, 2));
    let report = sinew_bag::check(&[&file]).unwrap();
    assert!(report.is_fine(), "{:?}", report.findings);
    fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn facts_are_events_and_log_lines() {
    let mut bench = Bench::new("facts", Selection::default());
    let (node, name, incarnation) = (NodeAddress::new(9), "hip".to_owned(), Incarnation(1));
    write_fact(&bench.journal, &NodeFact::NodeFound { node, name, incarnation });
    let (waiting, missing) = (vec!["hip".to_owned()], vec!["knee".to_owned()]);
    write_fact(&bench.journal, &NodeFact::Barrier { name: "go".to_owned(), generation: 1, waiting, missing });
    let line = LogFact { level: "warn".to_owned(), target: "test".to_owned(), text: "slow".to_owned() };
    write_fact(&bench.journal, &line);
    let peer = PeerClock {
        node,
        incarnation,
        theirs_minus_ours_ns: -7,
        bound_ns: 80,
        drift_ppb: -1_500,
        drift_bound_ppb: 200,
    };
    write_fact(&bench.journal, &ClockFact { wall_offset_ns: 0, peers: vec![peer] });
    bench.read(SECOND);
    bench.recorder.pump(3 * SECOND).unwrap();
    let clocks = read_file(&bench.folder.join("leg.mcap"), "/sinew/clock");
    let clock: serde_json::Value = serde_json::from_slice(&clocks[0].1).unwrap();
    let drift = serde_json::json!([clock["offset_ns"], clock["drift_ppb"], clock["drift_bound_ppb"]]);
    assert_eq!(drift, serde_json::json!([-7, -1_500, 200]));
    let (_, topics) = bench.finish();
    for topic in ["/sinew/events", "/sinew/barriers", "/sinew/log"] {
        assert!(topics.iter().any(|found| found == topic), "{topic}: {topics:?}");
    }
}

/// Returns the metadata of the channels with this topic, and the data of their messages.
fn read_file(file: &Path, topic: &str) -> Vec<(BTreeMap<String, String>, Vec<u8>)> {
    let mut reader = sinew_bag::read::Reader::open(file).unwrap();
    let mut found = Vec::new();
    while let Some(item) = reader.next_item().unwrap() {
        if let sinew_bag::read::Item::Message(message) = item
            && message.channel.topic == topic
        {
            found.push((message.channel.metadata.clone(), message.data.to_vec()));
        }
    }
    found
}

fn write_outcome(journal: &Journal, source: Tid, correlation: u64, outcome: Outcome) {
    let ticket = Ticket { source, destination: tid(0x1002), correlation };
    let record = OutcomeEntry { ticket, outcome }.record();
    journal.write(Channel::of_node(NODE, Form::Outcome).key(), SECOND, &[&record]);
}

#[test]
fn chosen_outcomes_are_written_and_lost_ones_counted() {
    let mut bench = Bench::new("outcomes", Selection { apps: vec!["hip".into()], ..Selection::default() });
    let full = Outcome::Rejected(Rejection::QueueFull);
    write_outcome(&bench.journal, tid(0x1001), 7, full);
    write_outcome(&bench.journal, tid(0x1003), 8, Outcome::Delivered);
    write_outcome(&bench.journal, tid(0x1009), 9, Outcome::Delivered);
    // Two that were overwritten before they were read, say.
    bench.journal.count(Channel::of_node(NODE, Form::Outcome).key(), 2);
    bench.read(SECOND);
    let file = bench.folder.join("leg.mcap");
    bench.recorder.pump(3 * SECOND).unwrap();
    let outcomes = read_file(&file, "/sinew/outcomes");
    assert_eq!(outcomes.len(), 1, "one is of another application, and one of the recorder");
    let event: serde_json::Value = serde_json::from_slice(&outcomes[0].1).unwrap();
    let expected = serde_json::json!({
        "source": tid(0x1001).to_string(), "source_name": "hip",
        "destination": tid(0x1002).to_string(), "destination_name": "knee",
        "correlation": 7, "outcome": "Rejected", "why": "QueueFull",
    });
    assert_eq!(event["data"], expected);
    assert_eq!(event["message"], "message 7 from hip to knee: Rejected (QueueFull)");
    let (totals, _) = bench.finish();
    assert_eq!((totals.seen, totals.events_lost), (0, 2));
}

#[test]
fn first_message_waits_for_the_structure_of_its_type() {
    let mut bench = Bench::new("waits", Selection::default());
    let torque = Channel { kind: Kind::named("test.torque"), ..angles() };
    write(&bench.journal, &torque, 1, SECOND);
    write(&bench.journal, &torque, 2, SECOND);
    assert!(!bench.recorder.pump(SECOND).unwrap());
    assert_eq!((bench.recorder.wanted(8), bench.recorder.totals().seen), (vec![torque.kind], 0));
    // When: the node has answered.
    let field = Field { name: "x".to_owned(), shape: Shape::U8, optional: false };
    let schema = Schema { root: Shape::Struct(vec![field]), types: BTreeMap::new() };
    bench.recorder.names_mut().add_type(torque.kind, "test.torque");
    bench.recorder.names_mut().add_schema(torque.kind, Some(&schema.encode()));
    assert!(bench.recorder.pump(SECOND).unwrap());
    assert_eq!((bench.recorder.wanted(8), bench.recorder.totals().written), (vec![], 2));
    // Then: the view has the name and the structure from the first message on.
    let file = bench.folder.join("leg.mcap");
    bench.recorder.pump(3 * SECOND).unwrap();
    let views = read_file(&file, "/hip/test.torque/view");
    assert_eq!(views.len(), 2);
    assert_eq!(views[0].0["sinew.role"], "view");
    // Field 1, a varint: 5.
    assert_eq!(views[0].1[..2], [8, 5]);
    let (totals, _) = bench.finish();
    assert_eq!((totals.seen, totals.written, totals.misfits), (2, 2, 0));
}

#[test]
fn message_of_unknown_type_is_written_without_an_answer() {
    let mut bench = Bench::new("unanswered", Selection::default());
    let torque = Channel { kind: Kind::named("test.torque"), ..angles() };
    let other = Channel { destination: tid(0x1003), ..torque };
    write(&bench.journal, &torque, 1, SECOND);
    write(&bench.journal, &other, 1, SECOND);
    assert!(!bench.recorder.pump(SECOND).unwrap());
    // A type is waited for once, and an application is.
    assert!(!bench.recorder.pump(SECOND).unwrap() && bench.recorder.is_waiting());
    assert!(bench.recorder.wanted(8).contains(&torque.kind), "it is still not known");
    assert!(bench.recorder.pump(SECOND).unwrap());
    let (totals, topics) = bench.finish();
    assert_eq!((totals.seen, totals.written), (2, 2));
    let topic = format!("/hip/{}", torque.kind);
    assert!(topics.contains(&topic), "{topics:?}");
}

#[test]
fn first_message_waits_for_the_name_of_its_sender() {
    let mut bench = Bench::new("sender", Selection::default());
    let arm = Channel { source: tid(0x1003), ..angles() };
    let own = Channel { source: tid(0x1009), destination: tid(0x1004), ..angles() };
    write(&bench.journal, &own, 1, SECOND);
    write(&bench.journal, &arm, 1, SECOND);
    assert!(!bench.recorder.pump(SECOND).unwrap());
    assert!(bench.recorder.is_waiting() && bench.recorder.wanted(8).is_empty());
    bench.recorder.names_mut().add_app(arm.source, "arm");
    assert!(bench.recorder.pump(SECOND).unwrap() && !bench.recorder.is_waiting());
    let (totals, topics) = bench.finish();
    assert_eq!(totals.written, 1, "messages of the recorder wait for nothing, and are in no file");
    assert!(topics.iter().any(|topic| topic == "/arm/test.angle"), "{topics:?}");
}

#[test]
fn protected_payload_is_shown_without_its_envelope() {
    let mut bench = Bench::new("protected", Selection::default());
    let command = Channel { destination: tid(0x1003), ..angles() };
    let data_id = DataId { source: command.source, destination: command.destination, name: "test.angle" };
    let stamp = Stamp { counter: 103, incarnation: 7, echo: Time::ZERO };
    let sealed = seal(&data_id, stamp, PAYLOAD);
    write_payload(&bench.journal, &command, &sealed, (1, SECOND));
    write(&bench.journal, &angles(), 2, SECOND);
    bench.read(2 * SECOND);
    let file = bench.folder.join("leg.mcap");
    bench.recorder.pump(4 * SECOND).unwrap();
    let raw = read_file(&file, "/hip/test.angle");
    assert_eq!((raw[0].0["sinew.protected"].as_str(), &raw[0].1[..]), ("true", &sealed[..]));
    let view = read_file(&file, "/hip/test.angle/view");
    let view: serde_json::Value = serde_json::from_slice(&view[0].1).unwrap();
    assert_eq!(view["x"], 5);
    let open = read_file(&file, "/hip/test.angle/to/knee");
    assert_eq!((open[0].0["sinew.protected"].as_str(), &open[0].1[..]), ("false", PAYLOAD));
    bench.finish();
}
