//! A recorded walk is computed again: each torque of the drives is the same, and a changed gain is found.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use exoskeleton::robot::edges::{GaitStatus, TICKS};
use exoskeleton_model::message::{DriveTick, JointSample};
use exoskeleton_recording::replay::{Replayed, replay, spec};
use sinew::replay::{CheckError, Checked};
use sinew_bag::{BagWriter, ChannelInfo, Class, Direction, Options, Origin, Party, Record as BagRecord};
use sinew_player::{Recording as Walked, RecordingError};

use super::*;

/// A file of one test, which is removed at its end.
struct TestFile(PathBuf);

impl TestFile {
    fn new(name: &str) -> Self {
        Self(std::env::temp_dir().join(format!("exoskeleton-replay-{name}-{}.mcap", std::process::id())))
    }
}

impl Drop for TestFile {
    fn drop(&mut self) {
        // The folder of temporary files is cleared by the system, too.
        let _ = std::fs::remove_file(&self.0);
    }
}

/// The walk of all tests here.
pub(super) fn walk_config() -> LockStepConfig {
    let mut config = LockStepConfig::standard(6, 3, Intention::from_curves(3));
    config.start_ms = [1, 1, 1];
    config
}

/// This walk in the loop and in virtual time.
pub(super) fn walks() -> &'static Walks {
    static WALKS: OnceLock<Walks> = OnceLock::new();
    WALKS.get_or_init(|| both(&walk_config()))
}

/// All messages of the walk in virtual time.
fn walk() -> &'static [TimedMessage] {
    &walks().outputs
}

fn party(of: Tid) -> Party {
    let drive = Joint::ALL.into_iter().find(|joint| tid(joint.index(), 2) == of);
    Party {
        tid: of.bits(),
        text: of.to_string(),
        name: drive.map(drive_name),
        node: Some(of.node.to_string()),
    }
}

/// Writes a recording of these messages.
fn write<'m>(path: &Path, messages: impl IntoIterator<Item = &'m TimedMessage>) {
    let options = Options { replace: true, ..Options::default() };
    let mut bag = BagWriter::create(path, options, Origin::default()).expect("a file of this test");
    let (mut channels, mut end_ns) = (BTreeMap::new(), 0);
    for message in messages {
        let TimedMessage { source, destination, kind, .. } = *message;
        let (channel, number) = channels.entry((source, destination, kind.bits())).or_insert_with(|| {
            let channel = bag.channel(&ChannelInfo {
                source: &party(source),
                destination: &party(destination),
                type_name: kind.type_name().unwrap_or("unknown"),
                kind: kind.bits(),
                class: Class::Stream,
                direction: Direction::Sent,
                is_protected: false,
                schema: None,
                refused: None,
                seen_before: 0,
            });
            (channel.expect("there is room for all channels"), 0)
        });
        *number += 1;
        end_ns = message.at.as_nanos();
        let record = BagRecord {
            number: *number,
            sequence: message.sequence,
            sent_ns: message.sent.as_nanos(),
            handed_over_ns: end_ns,
            payload: &message.payload,
            ..BagRecord::default()
        };
        bag.message(*channel, &record).expect("there is room on the disk");
    }
    bag.finish(end_ns).expect("there is room on the disk");
}

pub(super) fn replayed(name: &str, messages: &[&TimedMessage], gain: f64) -> Replayed {
    let file = TestFile::new(name);
    write(&file.0, messages.iter().copied());
    replay(&file.0, gain).expect("it has ticks")
}

/// Checks the drive of the knee as `sinew play --check` does.
pub(super) fn checked(name: &str, messages: &[&TimedMessage], gain: f64) -> Result<Checked, RecordingError> {
    let file = TestFile::new(name);
    write(&file.0, messages.iter().copied());
    let drive = spec(drive_name(Joint::Knee), Tid::group(TICKS), Joint::Knee, gain);
    Walked::read(&[&file.0])?.turns(DriveTick::NAME).check([drive.into()])
}

#[test]
fn recorded_walk_gives_the_same_torques() {
    let all: Vec<_> = walk().iter().collect();
    let replayed = replayed("same", &all, 1.0);
    assert!(replayed.is_same() && replayed.damage.is_empty(), "{replayed}");
    for joint in &replayed.joints {
        assert!(joint.ticks > 5_000 && joint.identical == joint.ticks, "{joint:?}");
    }
}

#[test]
fn walk_that_is_cut_off_is_not_the_same() {
    let file = TestFile::new("cut");
    write(&file.0, walk());
    let bytes = std::fs::read(&file.0).expect("it was written");
    std::fs::write(&file.0, &bytes[..bytes.len() * 9 / 10]).expect("there is room on the disk");
    let replayed = replay(&file.0, 1.0).expect("it has ticks");
    assert!(!replayed.is_same() && replayed.joints.iter().all(|joint| joint.compared > 0), "{replayed}");
    assert!(replayed.damage[0].contains("unfinished: the file ends at byte "), "{replayed}");
}

#[test]
fn one_changed_gain_is_named_at_its_first_tick() {
    let all: Vec<_> = walk().iter().collect();
    let replayed = replayed("gain", &all, 1.001);
    assert!(!replayed.is_same());
    for joint in &replayed.joints {
        let first = joint.first_difference.expect("it assists otherwise");
        let (was, is) = (first.recorded.torque_nm.unwrap(), first.now.torque_nm.unwrap());
        assert!(was != is && (was - is).abs() < 0.1, "{first:?}");
        assert_eq!((first.recorded.state, first.now.state), (DriveState::Walk, DriveState::Walk));
        // Before assistance begins the gain has no effect.
        assert!(joint.identical + 1 >= u64::from(first.tick) && joint.compared == joint.ticks, "{joint:?}");
    }
    let words = replayed.to_string();
    assert!(words.contains("hip") && words.contains(" Nm (Walk") && words.contains("DIFFERENT"), "{words}");
}

#[test]
fn check_of_a_drive_finds_the_recorded_ticks() {
    let all: Vec<_> = walk().iter().collect();
    let ticks = all.iter().filter(|one| one.source == tid(1, 2) && one.kind == DriveTick::KIND).count();
    let checked = checked("check", &all, 1.0).expect("each tick is the same");
    assert_eq!((checked.messages, checked.sources, checked.misfits.len()), (ticks, 1, 0));
    assert!(ticks > 5_000, "{ticks}");
}

#[test]
fn check_of_drive_names_first_tick_of_changed_gain() {
    let all: Vec<_> = walk().iter().collect();
    let error = checked("check-gain", &all, 1.1).expect_err("it assists otherwise");
    let RecordingError::Check(CheckError::Differs(difference)) = &error else { panic!("{error}") };
    assert_eq!((difference.sender, difference.kind), (tid(1, 2), DriveTick::KIND));
    assert!(difference.what.starts_with("`torque_nm` was "), "{error}");
    // And: the command of the robot itself names the same tick, its first one has the number 1
    let replayed = replayed("check-gain-replay", &all, 1.1);
    let first = replayed.joints[1].first_difference.expect("it assists otherwise");
    assert_eq!(difference.number, usize::try_from(first.tick).expect("some thousand"));
}

#[test]
fn check_of_drive_reports_a_tick_without_input() {
    let is_sample = |one: &TimedMessage| one.kind == JointSample::KIND && one.destination == tid(1, 2);
    let lost = walk().iter().rev().filter(|one| is_sample(one)).nth(300).expect("it walks for longer");
    let kept: Vec<_> = walk().iter().filter(|one| !std::ptr::eq(*one, lost)).collect();
    let error = checked("check-gap", &kept, 1.0).expect_err("a tick is missing");
    assert!(matches!(&error, RecordingError::Check(CheckError::Differs(_))), "{error}");
}

#[test]
fn missing_sample_is_a_gap_and_no_difference() {
    let drive = tid(0, 2);
    let is_sample =
        |message: &TimedMessage| message.kind == JointSample::KIND && message.destination == drive;
    let lost =
        walk().iter().rev().filter(|message| is_sample(message)).nth(300).expect("it walks for longer");
    let kept: Vec<_> = walk().iter().filter(|message| !std::ptr::eq(*message, lost)).collect();
    let replayed = replayed("gap", &kept, 1.0);
    let [hip, knee, _] = &replayed.joints;
    assert!(hip.gap.as_ref().is_some_and(|gap| gap.contains("sample")), "{replayed}");
    assert!(hip.first_difference.is_none() && hip.compared < hip.ticks);
    assert!(knee.identical == knee.ticks && knee.gap.is_none());
    assert!(!replayed.is_same() && replayed.to_string().contains("INCOMPLETE"), "{replayed}");
}

#[test]
fn recording_of_one_node_replays_its_drive() {
    let here: Vec<_> =
        walk().iter().filter(|one| one.source.node == node(1) || one.destination.node == node(1)).collect();
    let replayed = replayed("node", &here, 1.0);
    assert!(replayed.is_same(), "{replayed}");
    assert_eq!(replayed.joints.each_ref().map(|joint| joint.ticks > 0), [false, true, false]);
}

#[test]
fn recording_that_begins_late_is_no_difference() {
    let from = |at: Time| walk().iter().filter(|message| message.at >= at).collect::<Vec<_>>();
    // At rest: it is replayed from there on.
    let early = replayed("early", &from(Time::ZERO + Duration::from_millis(300)), 1.0);
    assert!(early.is_same(), "{early}");
    assert!(early.joints.iter().all(|joint| joint.identical + 2 >= joint.ticks), "{early}");
    // In the middle of the walk the state of the drives is unknown.
    let end = walk().last().expect("it walks").at;
    let late = replayed("late", &from(end - Duration::from_millis(500)), 1.0);
    assert!(!late.is_same() && late.joints.iter().all(|joint| joint.compared == 0), "{late}");
    assert!(late.joints.iter().all(|joint| joint.gap.is_some()), "{late}");
}

#[test]
fn recording_without_ticks_is_an_error_with_a_remedy() {
    let file = TestFile::new("none");
    let is_tick = |message: &&TimedMessage| message.kind == DriveTick::KIND;
    write(&file.0, walk().iter().filter(|message| !is_tick(message)).take(100));
    let error = replay(&file.0, 1.0).expect_err("there is nothing to compare");
    assert!(error.to_string().contains("walk.mcap"), "{error}");
}

#[test]
fn plotted_messages_have_one_channel_each() {
    // The topic of a second one would have its destination, and the layout for Foxglove names none.
    let central = node(CENTRAL);
    let mut channels: BTreeMap<(Tid, u32), Vec<Tid>> = BTreeMap::new();
    for message in walk() {
        let is_plotted = [DriveTick::KIND, GaitStatus::KIND].contains(&message.kind)
            || (message.kind == JointSample::KIND && message.destination.node == central);
        let receivers = channels.entry((message.source, message.kind.bits())).or_default();
        if is_plotted && !receivers.contains(&message.destination) {
            receivers.push(message.destination);
        }
    }
    assert!(channels.values().all(|receivers| receivers.len() <= 1), "{channels:?}");
    assert_eq!(channels.values().filter(|receivers| receivers.len() == 1).count(), 7);
}
