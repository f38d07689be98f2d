//! A node that records: from its start, and while a program asks for it.

use std::{path::Path, sync::mpsc::sync_channel};

use sinew_lncl::{LocalApp, register_local};
use sinew_model::config::NodeConfig;
use sinew_record::{Channel, ClockFact, Entry, Fact as _, Form};
use sinew_runtime::{
    incident::{self, IncidentKind},
    outcome::{Outcome, Ticket},
    router::{LocalRoute, MessageSink, SubmitError},
    supervision::ActorRestart,
    tid::{AppAddress, Incarnation},
    wire::{Header, Message, Payload},
};
use sinew_shm::journal::{JournalReader, Start};

use super::*;
use crate::inspect::{AskRecord, RecordedType, recorded};

/// The watchdog of a test that waits.
const WATCHDOG: Duration = Duration::from_secs(60);

/// Takes every message.
struct Sink;

impl MessageSink for Sink {
    fn submit(&self, _: Message) -> Result<(), SubmitError> {
        Ok(())
    }
}

/// A node without layers, of a project of its own.
fn node(name: &str, edit: impl FnOnce(&mut NodeConfig)) -> Arc<NodeState> {
    let mut config = NodeConfig::new("knee");
    config.project = format!("test {name} {}", std::process::id());
    config.record.keep_bytes = 256 * 1024;
    edit(&mut config);
    NodeState::for_test(config, Incarnation(1))
}

/// Registers an application of the node.
fn app(node: &NodeState, name: &str) -> Tid {
    let sink: Arc<dyn MessageSink> = Arc::new(Sink);
    let own = LocalApp {
        name: Some(name.to_owned()),
        address: None,
        requires: Vec::new(),
        kinds: Vec::new(),
        sink: sink.clone(),
        events: Arc::new([]),
    };
    let tid = register_local(&node.lncl, own).expect("the name is free");
    node.ctx.router.set_local(tid.app, LocalRoute { sink, events: Arc::new([]) });
    tid
}

fn send(node: &NodeState, source: Tid, destination: Tid, payload: &'static [u8]) {
    let header = Header::new(Kind::named("test.any"), source, destination);
    node.ctx.router.send(Message::new(header, bytes::Bytes::from_static(payload))).expect("it is taken");
}

/// Returns the payloads of all messages in the journal, and the forms of the facts before them.
fn read(path: &Path) -> (Vec<Vec<u8>>, Vec<Form>) {
    let mut reader = JournalReader::open(path, Start::Oldest).expect("it is there");
    let (mut bytes, mut messages, mut facts) = (Vec::new(), Vec::new(), Vec::new());
    while let Some(record) = reader.next(0, &mut bytes).expect("it is whole") {
        let channels = reader.channels().expect("it is there");
        let channel = channels.iter().find(|channel| channel.place == record.place).expect("its place");
        let form = Channel::of(channel.key.expect("its key")).expect("a channel").form;
        match Entry::read(&bytes).expect("a record") {
            Entry::Message(message) => messages.push(message.payload.expect("it is there").to_vec()),
            Entry::Node(_) | Entry::Clock(_) | Entry::Log(_) | Entry::Outcome(_) => facts.push(form),
        }
    }
    (messages, facts)
}

#[test]
fn program_has_its_messages_recorded_until_it_leaves() {
    let node = node("asked", |_| {});
    let (hip, knee) = (app(&node, "hip"), app(&node, "knee"));
    send(&node, hip, knee, b"before");
    let path = node.recording.ask(&node, hip, Selection::default(), Time::now()).expect("it begins");
    send(&node, hip, knee, b"first");
    send(&node, knee, hip, b"second");
    let reader = JournalReader::open(&path, Start::Oldest).expect("it is there");
    assert!(reader.is_writer_alive());
    let (messages, facts) = read(&path);
    assert_eq!(messages, [b"first".to_vec(), b"second".to_vec()]);
    assert_eq!(facts[0], Form::Node, "the beginning");
    node.recording.leave(&node, hip);
    assert!(!path.exists() && node.recording.path().is_none());
    assert!(!node.ctx.router.is_observed(hip), "no tap is left");
    let deadline = Time::now() + WATCHDOG;
    // The thread lets the journal go.
    while reader.is_writer_alive() {
        assert!(Time::now() < deadline, "waited for the end of the thread");
        std::thread::yield_now();
    }
}

/// Calls a function with each record in the journal. Facts and outcomes of other tests of this process are there, too.
fn each_entry(path: &Path, mut each: impl FnMut(Entry<'_>)) {
    let mut reader = JournalReader::open(path, Start::Oldest).expect("it is there");
    let mut bytes = Vec::new();
    while reader.next(0, &mut bytes).expect("it is whole").is_some() {
        each(Entry::read(&bytes).expect("a record"));
    }
}

#[test]
fn restart_of_an_own_actor_is_a_fact() {
    const NAME: &str = "a hip that restarts";
    let node = node("restarts", |_| {});
    let hip = app(&node, "hip");
    let path = node.recording.ask(&node, hip, Selection::default(), Time::now()).expect("it begins");
    let writer = FactWriter { node: node.ctx.node, journal: lock_journal(&node) };
    let elsewhere = Tid::new(sinew_runtime::tid::NodeAddress::new(9), hip.app);
    for (tid, restarts) in [(Some(hip), 3), (Some(elsewhere), 1), (None, 2)] {
        let (name, supervisor, why) = (NAME, "applications", "panicked\nat night");
        writer.restarted(&ActorRestart { name, supervisor, tid, restarts, why });
    }
    let mut found = Vec::new();
    each_entry(&path, |entry| match entry {
        Entry::Node(NodeFact::Restarted { app, restarts, why, name, .. }) if name == NAME => {
            assert_eq!(why, "panicked at night");
            found.push((app, restarts));
        }
        Entry::Message(_) | Entry::Node(_) | Entry::Clock(_) | Entry::Log(_) | Entry::Outcome(_) => {}
    });
    assert_eq!(found, [(Some(hip.app), 3), (None, 2)]);
    node.recording.leave(&node, hip);
}

#[test]
fn outcomes_are_recorded_from_the_begin_on() {
    const NUMBER: u64 = 0x7707_7077;
    let node = node("outcomes", |_| {});
    let hip = app(&node, "hip");
    let show = |outcome| {
        outcome::show(Ticket { source: hip, destination: hip, correlation: NUMBER }, outcome);
    };
    show(Outcome::Failed);
    let path = node.recording.ask(&node, hip, Selection::default(), Time::now()).expect("it begins");
    show(Outcome::Delivered);
    let mut found = Vec::new();
    each_entry(&path, |entry| match entry {
        Entry::Outcome(entry) if entry.ticket.correlation == NUMBER => found.push(entry.outcome),
        Entry::Message(_) | Entry::Node(_) | Entry::Clock(_) | Entry::Log(_) | Entry::Outcome(_) => {}
    });
    assert_eq!(found, [Outcome::Delivered]);
    node.recording.leave(&node, hip);
}

// spec: INSPECT-9
#[test]
fn only_programs_of_the_node_have_it_record() {
    let node = node("question", |_| {});
    let knee = app(&node, "knee");
    let ask = |source: Tid, question: &AskRecord| {
        recorded(&node, &Message::typed(source, Tid::NONE, question)).expect("it is a question")
    };
    let elsewhere = Tid::new(sinew_runtime::tid::NodeAddress::new(9), knee.app);
    assert!(ask(elsewhere, &AskRecord::default()).refused.is_some() && node.recording.path().is_none());
    let wrong = Selection { groups: vec!["all*".to_owned()], ..Selection::default() };
    assert!(ask(knee, &AskRecord { selection: wrong, ..AskRecord::default() }).refused.is_some());
    let report = ask(knee, &AskRecord::default());
    assert_eq!((report.refused, report.node), (None, Some(node.ctx.node)));
    assert_eq!(report.path.map(PathBuf::from), node.recording.path());
    assert_eq!(ask(knee, &AskRecord { ends: true, ..AskRecord::default() }).path, None);
    assert!(node.recording.path().is_none());
}

// spec: INSPECT-9
#[test]
fn type_only_sent_has_its_name_and_structure() {
    #[derive(serde::Serialize, serde::Deserialize)]
    struct Torque {
        newton_metres: f32,
    }
    impl Payload for Torque {
        const NAME: &'static str = "test.recording.torque";
    }
    let node = node("types", |_| {});
    let (hip, knee) = (app(&node, "hip"), app(&node, "knee"));
    let ask = |schemas: Vec<Kind>| -> Vec<RecordedType> {
        let question = AskRecord { schemas, ..AskRecord::default() };
        recorded(&node, &Message::typed(hip, Tid::NONE, &question)).expect("it is a question").types
    };
    let named = |types: &[RecordedType]| types.iter().find(|one| one.kind == Torque::KIND).cloned();
    assert_eq!(named(&ask(Vec::new())), None, "no application has sent it yet");
    let torque = Message::typed(hip, knee, &Torque { newton_metres: 1.5 });
    node.ctx.router.send(torque).expect("it is taken");
    let known = named(&ask(Vec::new())).expect("it was sent");
    assert_eq!((&*known.name, known.schema), (Torque::NAME, None));
    let types = ask(vec![Kind::named("test.recording.never"), Torque::KIND]);
    assert_eq!(types[0].kind, Torque::KIND, "those of the question stand first");
    let structure = Torque::KIND.schema().expect("it is known").expect("it has a structure");
    assert_eq!(types[0].schema, Some(structure.schema().encode()));
    // And: types that no application of this node has sent have names, if they are of Sinew
    let names = KnownNames::of(&node).kinds;
    for name in ["sinew.echo", "sinew.ping", "sinew.param.set", "sinew.barrier.arrive"] {
        assert_eq!(names.get(&Kind::named(name)).map(String::as_str), Some(name));
    }
    // And: its name can be selected.
    assert_eq!(KnownNames::of(&node).kinds.get(&Torque::KIND).map(String::as_str), Some(Torque::NAME));
    node.recording.close(&node);
}

// The directory of this node is empty: its sync manager has received no registration.
#[test]
fn application_has_its_name_from_its_registration_on() {
    let node = node("names", |_| {});
    let (hip, knee) = (app(&node, "hip"), app(&node, "knee"));
    let report = recorded(&node, &Message::typed(hip, Tid::NONE, &AskRecord::default())).expect("a question");
    let named: Vec<_> = report.apps.iter().map(|app| (&*app.name, app.tid)).collect();
    assert_eq!(named, [("hip", hip), ("knee", knee)]);
    assert_eq!(KnownNames::of(&node).apps, [("hip".to_owned(), hip), ("knee".to_owned(), knee)]);
    node.recording.close(&node);
}

#[test]
fn program_that_asks_no_more_is_forgotten() {
    let node = node("lease", |_| {});
    let knee = app(&node, "knee");
    let begin = Time::now();
    node.recording.ask(&node, knee, Selection::default(), begin).expect("it begins");
    let journal = lock_journal(&node);
    assert!(node.recording.refresh(&node, &journal, begin + LEASE / 2));
    assert!(!node.recording.refresh(&node, &journal, begin + LEASE));
    assert!(node.recording.path().is_none());
}

fn lock_journal(node: &NodeState) -> Arc<Journal> {
    node.recording.lock().active.as_ref().expect("it records").journal.clone()
}

#[test]
fn file_of_another_user_names_setting_as_remedy() {
    let path = PathBuf::from("/dev/shm/sinew-leg-10.0.0.2.journal");
    let taken = CreateJournalError::Taken { path, owner: 1_001, own: 1_000 };
    let text = RecordError::from(taken).to_string();
    assert!(text.contains("user with the number 1001") && text.contains("record.folder"), "{text}");
    assert!(!RecordError::from(CreateJournalError::Unsupported).to_string().contains("record.folder"));
}

#[test]
fn programs_are_bounded() {
    let node = node("bounded", |_| {});
    let now = Time::now();
    let ask = |number| {
        let program = Tid::new(node.ctx.node, AppAddress::new(0x8000_0000 + number));
        node.recording.ask(&node, program, Selection::default(), now)
    };
    (0..PROGRAMS_MAX as u32).for_each(|number| drop(ask(number).expect("there is room")));
    assert!(matches!(ask(PROGRAMS_MAX as u32), Err(RecordError::Programs)));
    ask(0).expect("it is renewed");
    node.recording.close(&node);
    assert!(node.recording.path().is_none());
}

#[test]
fn configured_recording_outlives_the_node() {
    let folder = std::env::temp_dir().join(format!("sinew-recording-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    // Whatever the user's mask is.
    std::fs::set_permissions(&folder, std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
    let node = node("configured", |config| config.record.folder = Some(folder.clone()));
    node.recording.begin_configured(&node).expect("it begins");
    let path = node.recording.path().expect("it records");
    let (hip, knee) = (app(&node, "hip"), app(&node, "knee"));
    send(&node, hip, knee, b"kept");
    // A program comes and goes.
    node.recording.ask(&node, hip, Selection::default(), Time::now()).expect("it joins");
    node.recording.leave(&node, hip);
    send(&node, hip, knee, b"last");
    node.recording.close(&node);
    drop(node);
    assert_eq!(read(&path).0, [b"kept".to_vec(), b"last".to_vec()]);
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn journal_of_a_configured_file_ends_with_the_node() {
    let node = node("file", |config| config.record.file = Some("/nowhere/{node}.mcap".into()));
    node.recording.begin_configured(&node).expect("it begins");
    let path = node.recording.path().expect("it records, for the program that writes the file");
    assert!(path.starts_with(MEMORY) || path.starts_with(std::env::temp_dir()), "{path:?}");
    let facts = path.with_extension("facts");
    let deadline = Time::now() + WATCHDOG;
    while !facts.exists() {
        assert!(Time::now() < deadline, "waited for the names beside the journal");
        std::thread::yield_now();
    }
    // And: a thread that has begun a turn before the end of the node
    let (flight, journal) = (node.recording.flight().expect("it has one").clone(), lock_journal(&node));
    node.recording.close(&node);
    assert!(!path.exists() && !facts.exists());
    let changes = facts::Changes { has_new_names: true, ..facts::Changes::default() };
    app(&node, "knee");
    flight.turn(&node, &journal, Time::now(), &changes);
    assert!(!facts.exists(), "it removes the names that it has written");
}

#[test]
fn log_of_the_process_is_recorded() {
    let node = node("log", |_| {});
    let knee = app(&node, "knee");
    let path = node.recording.ask(&node, knee, Selection::default(), Time::now()).expect("it begins");
    log::error!(word = "lost", "the knee has no torque");
    log::flush(WATCHDOG);
    let mut reader = JournalReader::open(&path, Start::Oldest).expect("it is there");
    let (mut bytes, mut lines) = (Vec::new(), Vec::new());
    while reader.next(0, &mut bytes).expect("it is whole").is_some() {
        if let Entry::Log(line) = Entry::read(&bytes).expect("a record") {
            lines.push((line.level, line.text));
        }
    }
    let line = ("error".to_owned(), "the knee has no torque word=\"lost\"".to_owned());
    assert!(lines.contains(&line), "{lines:?}");
    node.recording.close(&node);
}

#[test]
fn clocks_are_written_each_second() {
    let node = node("clocks", |_| {});
    let knee = app(&node, "knee");
    let path = node.recording.ask(&node, knee, Selection::default(), Time::now()).expect("it begins");
    let (done, finished) = sync_channel(1);
    let of = path.clone();
    std::thread::spawn(move || {
        while !read(&of).1.contains(&ClockFact::FORM) {
            std::thread::yield_now();
        }
        done.send(()).expect("the test waits");
    });
    finished.recv_timeout(WATCHDOG).expect("the clocks are there");
    node.recording.close(&node);
}

#[test]
fn cause_freezes_the_messages_around_it() {
    let folder = std::env::temp_dir().join(format!("sinew-freezing-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::set_permissions(&folder, std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
    let node = node("freezing", |config| {
        config.record.folder = Some(folder.clone());
        config.record.after = Duration::from_secs(1);
    });
    node.recording.begin_configured(&node).expect("it begins");
    let (hip, knee) = (app(&node, "hip"), app(&node, "knee"));
    send(&node, hip, knee, b"before");
    let flight = node.recording.flight().expect("it records from its start").clone();
    let id = flight.happened(Time::now(), "the knee slips").expect("there is room").to_string();
    let again = flight.happened(Time::now(), "the hip slips").expect("there is room").to_string();
    assert_eq!(again, id, "both are in one span");
    send(&node, hip, knee, b"behind");
    let deadline = Time::now() + WATCHDOG;
    let spans = loop {
        let spans = flight.store().spans();
        if !spans.is_empty() {
            break spans;
        }
        assert!(Time::now() < deadline, "waited for the frozen span");
        std::thread::yield_now();
    };
    // An incident of another test of this process may have been the first cause.
    assert_eq!((spans.len(), &spans[0].id), (1, &id));
    let files: Vec<_> = std::fs::read_dir(&folder).unwrap().map(|file| file.unwrap().path()).collect();
    let frozen = files.iter().find(|path| path.extension().is_some_and(|ending| ending == "frozen"));
    let (messages, facts) = read(frozen.expect("its journal"));
    assert_eq!(messages, [b"before".to_vec(), b"behind".to_vec()]);
    assert!(facts.contains(&Form::Node), "the trigger is an event of the span");
    node.recording.close(&node);
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn node_that_ends_freezes_an_incomplete_span() {
    let folder = std::env::temp_dir().join(format!("sinew-ending-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::set_permissions(&folder, std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
    let node = node("ending", |config| {
        config.record.folder = Some(folder.clone());
        config.record.after = Duration::from_secs(30);
    });
    node.recording.begin_configured(&node).expect("it begins");
    let (hip, knee) = (app(&node, "hip"), app(&node, "knee"));
    send(&node, hip, knee, b"last");
    let flight = node.recording.flight().expect("it records from its start").clone();
    let id = flight.happened(Time::now(), "the knee slips").expect("there is room").to_string();
    assert!(flight.store().spans().is_empty());
    node.recording.close(&node);
    let spans = flight.store().spans();
    assert!(spans.len() == 1 && spans[0].id == id, "{spans:?}");
    assert!(spans[0].end_ns <= Time::now().as_nanos(), "it ends with the node: {spans:?}");
    std::fs::remove_dir_all(folder).unwrap();
}

/// Returns a node that records in this folder, which is its own.
fn flying(name: &str, folder: &Path) -> Arc<NodeState> {
    std::fs::create_dir_all(folder).unwrap();
    std::fs::set_permissions(folder, std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
    let node = node(name, |config| {
        config.record.folder = Some(folder.to_owned());
        config.record.after = Duration::from_secs(30);
        config.record.frozen_max = 1;
    });
    node.recording.begin_configured(&node).expect("it begins");
    node
}

#[test]
fn failure_at_the_end_of_node_has_span() {
    let folder = std::env::temp_dir().join(format!("sinew-failing-{}", std::process::id()));
    let node = flying("failing", &folder);
    let flight = node.recording.flight().expect("it records from its start").clone();
    node.recording.stop_ordered();
    // The thread `record` takes it before the end, or the end does.
    incident::report(Time::now(), IncidentKind::Failure, format_args!("test: the knee failed"));
    node.recording.close(&node);
    let spans = flight.store().spans();
    assert_eq!(spans.len(), 1, "{spans:?}");
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn symptoms_of_an_ordered_stop_make_no_trigger() {
    let folder = std::env::temp_dir().join(format!("sinew-stopping-{}", std::process::id()));
    let node = flying("stopping", &folder);
    let flight = node.recording.flight().expect("it records from its start").clone();
    node.recording.stop_ordered();
    incident::report(Time::now(), IncidentKind::Symptom, format_args!("test of stopping: an input is late"));
    node.recording.close(&node);
    // Failures of other tests of this process are causes, too.
    let known = flight.known();
    assert!(known.iter().all(|trigger| !trigger.cause.as_str().contains("test of stopping")), "{known:?}");
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn slow_copy_does_not_hold_the_recording() {
    let folder = std::env::temp_dir().join(format!("sinew-slow-{}", std::process::id()));
    let node = flying("slow", &folder);
    let (flight, knee) = (node.recording.flight().expect("it records").clone(), app(&node, "knee"));
    flight.happened(Time::now(), "the knee slips").expect("there is room");
    // As a disk that takes its time: the copy waits for this lock.
    let store = flight.store();
    let ending = node.recording.end(&node);
    let ask = node.recording.ask(&node, knee, Selection::default(), Time::now());
    assert!(matches!(ask, Err(RecordError::Closed)) && !flight.wait(Duration::ZERO));
    assert!(flight.try_store().is_none());
    drop(store);
    ending.wait();
    assert_eq!(flight.store().spans().len(), 1);
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn counters_of_a_program_stay_after_its_end() {
    let node = node("counters", |_| {});
    let (hip, knee) = (app(&node, "hip"), app(&node, "knee"));
    let ask = |program| node.recording.ask(&node, program, Selection::default(), Time::now()).map(drop);
    ask(hip).expect("it begins");
    node.recording.note_counts(hip, RecordCounts { seen: 10, dropped: 2 });
    ask(hip).expect("it is renewed");
    ask(knee).expect("it joins");
    node.recording.note_counts(knee, RecordCounts { seen: 5, dropped: 0 });
    let report = node.recording.report_state();
    assert_eq!((report.programs, report.seen, report.dropped), (2, 15, 2));
    node.recording.leave(&node, hip);
    node.recording.leave(&node, knee);
    let report = node.recording.report_state();
    assert_eq!((report.programs, report.seen, report.dropped), (0, 15, 2));
    // A program that does not record has no counters.
    node.recording.note_counts(hip, RecordCounts { seen: 99, dropped: 99 });
    assert_eq!(node.recording.report_state().seen, 15);
}
