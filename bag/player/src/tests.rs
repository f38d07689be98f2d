//! Recordings that are written, played in order, and checked against a controller.

use std::{
    fs,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU32, Ordering},
    },
};

use sinew::{prelude::*, schema::schema_of};
use sinew_bag::{BagError, BagWriter, ChannelId, ChannelInfo, Direction, Options, Origin, Party, Record};
use sinew_replay::CheckError;

use crate::{Order, Playback, Recording, RecordingError};

payload!("player.angle", Stream => #[derive(Debug, Clone, Copy)] struct Angle { degrees: f64 });
payload!("player.torque", Stream => #[derive(Debug, Clone, Copy)] struct Torque { newton_metres: f64 });
// Other versions of the type of angles, as other builds of a program have them.
payload!("player.angle", Stream => struct LaterAngle { degrees: f64, velocity: f64 });
payload!("player.angle", Stream => struct GradualAngle { degrees: f64, #[serde(default)] velocity: f64 });

const MS: u64 = 1_000_000;
/// Wall clock minus monotonic clock.
const OFFSET_NS: i64 = 1_000_000_000_000;

/// A folder of one test, which is removed at its end.
struct TestFolder(PathBuf);

impl TestFolder {
    fn new() -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let folder = std::env::temp_dir().join(format!("sinew-player-{}-{number}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        Self(folder)
    }
}

impl Drop for TestFolder {
    fn drop(&mut self) {
        // The folder of temporary files is cleared by the system, too.
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn tid(node: u8, app: u32) -> Tid {
    Tid::new(NodeAddress::from([127, 0, 0, node]), AppAddress::new(0x1000 + app))
}

fn party(tid: Tid, name: &str) -> Party {
    let node = Some(tid.node.to_string()).filter(|_| tid.is_single());
    Party { tid: tid.bits(), text: tid.to_string(), name: Some(name.to_owned()), node }
}

fn bag(folder: &TestFolder, name: &str, node: u8) -> (BagWriter, PathBuf) {
    let path = folder.0.join(name);
    let origin = Origin {
        node: format!("node{node}"),
        address: format!("127.0.0.{node}"),
        incarnation: 1,
        wall_offset_ns: OFFSET_NS,
        ..Origin::default()
    };
    (BagWriter::create(&path, Options::default(), origin).unwrap(), path)
}

/// Adds a channel of `P`.
fn channel<P: Payload>(
    bag: &mut BagWriter,
    (source, destination): (&Party, &Party),
    direction: Direction,
) -> ChannelId {
    let schema = schema_of::<P>().and_then(Result::ok).map(|schema| schema.schema());
    bag.channel(&ChannelInfo {
        source,
        destination,
        type_name: P::NAME,
        kind: P::KIND.bits(),
        class: sinew_bag::Class::Stream,
        direction,
        is_protected: false,
        schema,
        refused: None,
        seen_before: 0,
    })
    .unwrap()
}

fn write(
    bag: &mut BagWriter,
    channel: ChannelId,
    number: u64,
    (sent_ns, age_ns): (u64, u64),
    payload: &[u8],
) {
    let (sequence, handed_over_ns) = (number, sent_ns + age_ns);
    let record = Record { number, sequence, sent_ns, handed_over_ns, payload, ..Record::default() };
    bag.message(channel, &record).unwrap();
}

/// The bytes of a struct with one field of 64 bits, as it is sent.
fn field(name: &str, value: f64) -> Vec<u8> {
    let mut bytes = vec![0x81, 0xa0 | name.len() as u8];
    bytes.extend(name.as_bytes());
    bytes.push(0xcb);
    bytes.extend(value.to_be_bytes());
    bytes
}

/// A walk: 50 angles from the hip to the knee, and for each a torque from the knee to the motor, by this gain.
fn walk(folder: &TestFolder, gain: f64) -> PathBuf {
    let (mut bag, path) = bag(folder, "walk.mcap", 2);
    let (hip, knee, motor) = (party(tid(1, 1), "hip"), party(tid(2, 1), "knee"), party(tid(2, 2), "motor"));
    let angles = channel::<Angle>(&mut bag, (&hip, &knee), Direction::Received);
    let torques = channel::<Torque>(&mut bag, (&knee, &motor), Direction::Sent);
    for number in 1..=50 {
        let (degrees, at_ns) = (number as f64 / 3.0, 1_000 * MS + number * MS);
        write(&mut bag, angles, number, (at_ns - MS / 10, MS / 10), &field("degrees", degrees));
        write(&mut bag, torques, number, (at_ns + 500, 100), &field("newton_metres", gain * degrees));
    }
    bag.finish(2_000 * MS).unwrap();
    path
}

struct Knee<A> {
    gain: f64,
    degrees: fn(&A) -> f64,
}

impl<A: Payload> Actor for Knee<A> {
    type Context = AppContext<Self>;
}

impl<A: Payload> Handler<Delivery<A>> for Knee<A> {
    type Result = ();

    fn handle(&mut self, angle: Delivery<A>, ctx: &mut Self::Context) {
        let newton_metres = self.gain * (self.degrees)(&angle.payload);
        ctx.send("motor", &Torque { newton_metres }).unwrap();
    }
}

fn knee<A: Payload>(gain: f64, degrees: fn(&A) -> f64) -> AppSpec<Knee<A>> {
    AppSpec::new("knee", move || Knee { gain, degrees }).handles::<A>()
}

fn own(gain: f64) -> AppSpec<Knee<Angle>> {
    knee::<Angle>(gain, |angle| angle.degrees)
}

#[test]
fn recorded_controller_sends_the_same_again() {
    let folder = TestFolder::new();
    let recording = Recording::read(&[walk(&folder, 0.3)]).unwrap();
    assert_eq!(recording.address("hip"), Some(tid(1, 1)));
    let checked = recording.check([own(0.3).into()]).unwrap();
    assert_eq!((checked.messages, checked.sources, checked.misfits.len()), (50, 1, 0));
}

#[test]
fn changed_gain_names_the_first_difference() {
    let folder = TestFolder::new();
    let recording = Recording::read(&[walk(&folder, 0.3)]).unwrap();
    let error = recording.check([own(0.25).into()]).expect_err("the gain differs");
    let RecordingError::Check(CheckError::Differs(difference)) = &error else { panic!("{error}") };
    assert_eq!((difference.number, difference.sender), (1, tid(2, 1)));
    // In the monotonic clock of the node.
    assert_eq!(difference.at.as_nanos(), 1_001 * MS + 500);
    assert!(error.to_string().contains("`newton_metres` was "), "{error}");
    recording.ignoring("newton_metres").check([own(0.25).into()]).expect("the field is ignored");
}

#[test]
fn later_build_with_a_default_reads_the_older_recording() {
    let folder = TestFolder::new();
    let recording = Recording::read(&[walk(&folder, 0.3)]).unwrap();
    let gradual = knee::<GradualAngle>(0.3, |angle| angle.degrees + angle.velocity);
    assert_eq!(recording.check([gradual.into()]).unwrap().messages, 50);
}

#[test]
fn field_that_the_recording_lacks_is_reported_in_words() {
    let folder = TestFolder::new();
    let recording = Recording::read(&[walk(&folder, 0.3)]).unwrap();
    let later = knee::<LaterAngle>(0.3, |angle| angle.degrees + angle.velocity);
    let error = recording.check([later.into()]).expect_err("no angle is decoded");
    let RecordingError::Check(CheckError::Misfit(misfit, difference)) = &error else { panic!("{error}") };
    assert_eq!((misfit.count, misfit.sender, misfit.receiver), (50, tid(1, 1), tid(2, 1)));
    assert_eq!(difference.number, 1);
    assert!(error.to_string().contains("50 recorded messages of type player.angle"), "{error}");
    assert!(error.to_string().contains("serde(default)"), "{error}");
}

#[test]
fn unknown_application_is_refused_with_the_known_ones() {
    let folder = TestFolder::new();
    let recording = Recording::read(&[walk(&folder, 0.3)]).unwrap();
    let still = || Knee::<Angle> { gain: 1.0, degrees: |angle| angle.degrees };
    let ankle = AppSpec::new("ankle", still);
    let error = recording.check([ankle.into()]).expect_err("there is no ankle").to_string();
    assert!(error.contains("no application called ankle") && error.contains("hip, knee, motor"), "{error}");
    let motor = AppSpec::new("motor", still);
    let error = recording.check([motor.into()]).expect_err("the motor sends nothing");
    assert!(matches!(error, RecordingError::NothingSent), "{error}");
}

#[test]
fn end_of_a_check_is_that_of_its_messages() {
    let folder = TestFolder::new();
    let files = [walk(&folder, 0.3)];
    let recording = Recording::read_until(&files, Some(Duration::from_millis(10))).unwrap();
    let checked = recording.check([own(0.3).into()]).unwrap();
    assert!((9..=11).contains(&checked.messages), "{checked:?}");
}

#[test]
fn check_of_an_unfinished_file_is_no_proof() {
    let folder = TestFolder::new();
    let path = walk(&folder, 0.3);
    let bytes = fs::read(&path).unwrap();
    // When: its end is cut off
    fs::write(&path, &bytes[..bytes.len() - 20]).unwrap();
    let recording = Recording::read(&[&path]).unwrap();
    // Then
    assert!(matches!(recording.damage(), [line] if line.contains("the file ends at byte")));
    let error = recording.check([own(0.3).into()]).expect_err("it proves nothing about the rest");
    assert!(
        matches!(&error, RecordingError::NotWhole { messages: 1.., damage } if damage.contains("unfinished")),
        "{error}"
    );
    // And: an end before that is proved
    let recording = Recording::read_until(&[&path], Some(Duration::from_millis(10))).unwrap();
    assert!(recording.damage().is_empty());
    recording.check([own(0.3).into()]).expect("these messages are the same");
    // And: a difference is named
    let recording = Recording::read(&[&path]).unwrap();
    assert!(matches!(recording.check([own(0.2).into()]), Err(RecordingError::Check(_))));
}

#[test]
fn messages_are_in_the_order_of_sending() {
    let folder = TestFolder::new();
    let (mut bag, path) = bag(&folder, "walk.mcap", 2);
    let (hip, knee) = (party(tid(1, 1), "hip"), party(tid(2, 1), "knee"));
    let angles = channel::<Angle>(&mut bag, (&hip, &knee), Direction::Received);
    // The first one waits 50 ms for its receiver.
    let times = [(2, 0), (3, 0), (1, 50)];
    for (number, (at_ms, age_ms)) in (1..).zip(times) {
        write(&mut bag, angles, number, (at_ms * MS, age_ms * MS), &field("degrees", at_ms as f64));
    }
    bag.finish(100 * MS).unwrap();
    let read = |order| {
        let mut playback = Playback::open(&[&path], order).unwrap();
        let mut numbers = Vec::new();
        while let Some(message) = playback.next_message().unwrap() {
            numbers.push((message.header.sequence, message.header.age_ns / MS as i64));
        }
        (numbers, playback.offset_ns(OFFSET_NS as u64 + 3 * MS))
    };
    assert_eq!(read(Order::Sent), (vec![(3, 50), (1, 0), (2, 0)], MS));
    assert_eq!(read(Order::Arrived), (vec![(1, 0), (2, 0), (3, 50)], MS));
}

#[test]
fn stopped_playback_skips_no_further_message() {
    let folder = TestFolder::new();
    let path = walk(&folder, 0.3);
    for order in [Order::Sent, Order::Arrived] {
        let stop = Arc::new(AtomicBool::new(false));
        let mut playback = Playback::open(&[&path], order).unwrap();
        playback.stop_at(stop.clone());
        assert!(playback.next_message().unwrap().is_some());
        // When
        stop.store(true, Ordering::Relaxed);
        assert_eq!(playback.next_message().unwrap(), None);
    }
    // And: not even to the first wanted one
    let mut playback = Playback::open(&[&path], Order::Arrived).unwrap();
    playback.retain(|_| false);
    playback.stop_at(Arc::new(AtomicBool::new(true)));
    assert_eq!(playback.next_message().unwrap(), None);
    assert_eq!(playback.offset_ns(u64::MAX), 0, "no message was read");
}

#[test]
fn merged_file_has_each_message_once() {
    let folder = TestFolder::new();
    let (hip, knee) = (party(tid(1, 1), "hip"), party(tid(2, 1), "knee"));
    let mut files = Vec::new();
    for (node, direction) in [(1, Direction::Sent), (2, Direction::Received)] {
        let (mut bag, path) = bag(&folder, &format!("node{node}.mcap"), node);
        let angles = channel::<Angle>(&mut bag, (&hip, &knee), direction);
        for number in 1..=20 {
            write(&mut bag, angles, number, (number * MS, MS / 2), &field("degrees", 1.0));
        }
        let peer = format!("127.0.0.{}", 3 - node);
        let reading = sinew_bag::ClockReading {
            peer,
            incarnation: 1,
            bound_ns: 500,
            ..sinew_bag::ClockReading::default()
        };
        bag.clock(MS, &reading).unwrap();
        bag.finish(100 * MS).unwrap();
        files.push(path);
    }
    let merged = folder.0.join("leg.mcap");
    sinew_bag::merge(&files, &merged).unwrap();
    for (order, direction) in [(Order::Sent, Direction::Sent), (Order::Arrived, Direction::Received)] {
        let mut playback = Playback::open(&[&merged], order).unwrap();
        let mut sequences = Vec::new();
        while let Some(message) = playback.next_message().unwrap() {
            assert_eq!(message.channel.direction, direction);
            sequences.push(message.header.sequence);
        }
        assert_eq!(sequences, (1..=20).collect::<Vec<_>>());
    }
    let error = Playback::open(&files, Order::Sent).expect_err("they are of two nodes");
    assert!(matches!(&error, BagError::Unfit(text) if text.contains("sinew bag merge")), "{error}");
}
