//! Every state of the session's halves, times every input: the new state and the answer, as the file
//! `table.txt`.
//!
//! A change of behaviour shows as a difference. `SINEW_WRITE_TABLE=1 cargo test -p sinew-session table`
//! rewrites the file for a review.

use super::*;

const FILE: &str = "src/table.txt";
const WRITE_VARIABLE: &str = "SINEW_WRITE_TABLE";
const WINDOW: Window = Window { messages: 2, bytes: 1_000 };
const LIMITS: BacklogLimits =
    BacklogLimits { queues: 2, queue_messages: 2, queue_bytes: 1_000, messages: 3, bytes: 1_000 };
/// The epoch of the sending half, and the peer's memory that it knows.
const EPOCH: u64 = 7;
const RECEIVER: u64 = 3;

/// No message of the table loses its use.
impl Expires for char {}

#[test]
fn session_matches_the_transition_table() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(FILE);
    let table =
        [sending(), sending_with_room(), receiving(), receiving_with_room(), backlog(), held()].concat();
    if std::env::var_os(WRITE_VARIABLE).is_some() {
        std::fs::write(&path, &table).expect("the source tree can be written");
    }
    let golden = std::fs::read_to_string(&path).expect("the table is in the source tree");
    let differences: String = golden
        .lines()
        .zip(table.lines())
        .filter(|(then, now)| then != now)
        .map(|(then, now)| format!("\n- {then}\n+ {now}"))
        .collect();
    assert!(differences.is_empty(), "the table has changed:{differences}");
    assert_eq!(golden.lines().count(), table.lines().count(), "the table has another length");
}

/// An input: its name, and a function that applies it and describes the effect.
type Input<'a, H> = (&'a str, fn(&mut H) -> String);

/// The rows of one half: each of its states with each input.
fn rows<H: Clone>(
    head: &str,
    states: &[(&str, H)],
    inputs: &[Input<'_, H>],
    describe: fn(&H) -> String,
) -> String {
    let mut rows = format!("# {head}\n");
    for (state, half) in states {
        for (input, act) in inputs {
            let mut half = half.clone();
            let answer = act(&mut half);
            rows.push_str(format!("{state} + {input} -> {}: {answer}", describe(&half)).trim_end());
            rows.push('\n');
        }
    }
    rows
}

fn ack(receiver_id: u64, peer_epoch: u64, next: u64) -> Ack {
    Ack { receiver_id, epoch: 1, peer_epoch, next, change: 0, held: Vec::new(), room: None }
}

fn sending() -> String {
    let fresh = Sending::new(EPOCH, WINDOW);
    let mut flowing = fresh.clone();
    flowing.on_ack(&ack(RECEIVER, EPOCH, 1));
    let mut keeping = flowing.clone();
    keeping.keep('a', 10);
    let mut full = keeping.clone();
    full.keep('b', 10);
    let mut paused = full.clone();
    paused.link_ended();
    let mut resuming = paused.clone();
    resuming.on_ack(&ack(RECEIVER, EPOCH, 1));
    // Its first message has arrived, so numbers below its base are detectable.
    let mut later = full.clone();
    later.on_ack(&ack(RECEIVER, EPOCH, 2));
    let mut unannounced = paused.clone();
    unannounced.on_ack(&ack(RECEIVER + 1, 0, 1));
    let states = [
        ("fresh", fresh),
        ("flowing", flowing),
        ("flowing, 1 kept", keeping),
        ("flowing, 2 kept: full", full),
        ("flowing, 1 arrived, 1 kept", later),
        ("paused, 2 kept", paused),
        ("resuming, 2 kept", resuming),
        ("new epoch, not announced", unannounced),
    ];
    rows(
        "Sending: state + input -> epoch, kept, to be written again, room: answer",
        &states,
        &[
            ("Ack, takes 1 next", |half| format!("{:?}", half.on_ack(&ack(RECEIVER, EPOCH, 1)))),
            ("Ack, takes 2 next", |half| format!("{:?}", half.on_ack(&ack(RECEIVER, EPOCH, 2)))),
            ("Ack, takes 3 next", |half| format!("{:?}", half.on_ack(&ack(RECEIVER, EPOCH, 3)))),
            ("Ack, takes 9 next", |half| format!("{:?}", half.on_ack(&ack(RECEIVER, EPOCH, 9)))),
            ("Ack, knows no epoch", |half| format!("{:?}", half.on_ack(&ack(RECEIVER, 0, 1)))),
            ("Ack, knows another epoch", |half| format!("{:?}", half.on_ack(&ack(RECEIVER, EPOCH - 1, 5)))),
            ("Ack of another receiver", |half| format!("{:?}", half.on_ack(&ack(RECEIVER + 1, EPOCH, 1)))),
            ("announced epoch 7", |half| half.epoch_announced(EPOCH).to_string()),
            ("announced epoch 8", |half| half.epoch_announced(EPOCH + 1).to_string()),
            ("again", |half| format!("{:?}", half.again())),
            ("take_back", |half| {
                half.take_back();
                String::new()
            }),
            ("void of the oldest", |half| format!("{:?}", half.void(|message| *message == 'a'))),
            ("link_ended", |half| {
                half.link_ended();
                String::new()
            }),
            ("drain", |half| format!("{:?}", half.drain())),
        ],
        |half| {
            let (epoch, room) = (half.epoch(), half.has_room());
            let kept = half.clone().drain().into_iter().collect::<String>();
            format!("epoch {epoch}, kept '{kept}', again {}, room {room}", half.behind())
        },
    )
}

/// The sending half with the peer's stated room, in messages and in bytes. spec: CREDIT-5
fn sending_with_room() -> String {
    let with_room =
        |next, messages, bytes| Ack { room: Some((messages, bytes)), ..ack(RECEIVER, EPOCH, next) };
    let mut of_one_message = Sending::new(EPOCH, WINDOW);
    of_one_message.on_ack(&with_room(1, 1, 1_000));
    let mut of_ten_bytes = Sending::new(EPOCH, WINDOW);
    of_ten_bytes.on_ack(&with_room(1, 9, 10));
    let [mut one_full, mut ten_full, mut ten_begun] =
        [of_one_message.clone(), of_ten_bytes.clone(), of_ten_bytes.clone()];
    one_full.keep('a', 10);
    ten_full.keep('a', 10);
    ten_begun.keep('a', 9);
    let mut paused = one_full.clone();
    paused.link_ended();
    let states = [
        ("room for 1 message", of_one_message),
        ("room for 1 message, 1 kept", one_full),
        ("room for 10 bytes", of_ten_bytes),
        ("room for 10 bytes, 9 kept", ten_begun),
        ("room for 10 bytes, 10 kept", ten_full),
        ("room for 1 message, 1 kept, paused", paused),
    ];
    rows(
        "Sending, room announced: state + input -> kept, room: answer",
        &states,
        &[
            ("Ack, takes 1 next, no room announced", |half| {
                format!("{:?}", half.on_ack(&ack(RECEIVER, EPOCH, 1)))
            }),
            ("Ack, takes 1 next, room for 1 message", |half| acked_with_room(half, 1, (1, 1_000))),
            ("Ack, takes 1 next, room for 2 messages", |half| acked_with_room(half, 1, (2, 1_000))),
            ("Ack, takes 1 next, room for 10 bytes", |half| acked_with_room(half, 1, (9, 10))),
            ("Ack, takes 1 next, room for 11 bytes", |half| acked_with_room(half, 1, (9, 11))),
            ("Ack, takes 2 next, no room announced", |half| {
                format!("{:?}", half.on_ack(&ack(RECEIVER, EPOCH, 2)))
            }),
            ("Ack, takes 2 next, room for 1 message", |half| acked_with_room(half, 2, (1, 1_000))),
            ("Ack, takes 2 next, room for 1 byte", |half| acked_with_room(half, 2, (9, 1))),
            ("Ack of another receiver, room for 1 message", |half| {
                let room = Some((1, 1_000));
                let effect = half.on_ack(&Ack { room, ..ack(RECEIVER + 1, EPOCH, 1) });
                half.epoch_announced(EPOCH + 1);
                format!("{effect:?}, then announced epoch 8")
            }),
            ("void of the oldest", |half| format!("{:?}", half.void(|message| *message == 'a'))),
            ("take_back", |half| {
                half.take_back();
                String::new()
            }),
        ],
        |half| {
            let kept = half.clone().drain().into_iter().collect::<String>();
            format!("kept '{kept}', room {}", half.has_room())
        },
    )
}

fn acked_with_room(half: &mut Sending<char>, next: u64, room: (u64, u64)) -> String {
    format!("{:?}", half.on_ack(&Ack { room: Some(room), ..ack(RECEIVER, EPOCH, next) }))
}

fn receiving() -> String {
    let fresh = Receiving::new(RECEIVER);
    let mut attached = fresh.clone();
    attached.attach(5);
    let mut taking = attached.clone();
    taking.on_epoch(5, 20);
    let mut taken = taking.clone();
    taken.arrive(5, 1, 10);
    let mut replaced = taken.clone();
    replaced.attach(6);
    let states = [
        ("fresh", fresh),
        ("on link 5, epoch unknown", attached),
        ("on link 5, epoch 20", taking),
        ("on link 5, epoch 20, 1 taken", taken),
        ("on link 6 after 5, epoch unknown, 1 taken", replaced),
    ];
    rows(
        "Receiving: state + input -> its Ack, unacknowledged: answer",
        &states,
        &[
            ("attach 7", |half| {
                half.attach(7);
                String::new()
            }),
            ("epoch 20 on link 5", |half| half.on_epoch(5, 20).to_string()),
            ("epoch 20 on link 6", |half| half.on_epoch(6, 20).to_string()),
            ("epoch 21 on link 6", |half| half.on_epoch(6, 21).to_string()),
            ("epoch 19 on link 6", |half| half.on_epoch(6, 19).to_string()),
            ("message 1 on link 5", |half| format!("{:?}", half.arrive(5, 1, 10))),
            ("message 2 on link 5", |half| format!("{:?}", half.arrive(5, 2, 10))),
            ("message 1 on link 6", |half| format!("{:?}", half.arrive(6, 1, 10))),
            ("message 2 on link 6", |half| format!("{:?}", half.arrive(6, 2, 10))),
            ("message 2 of 64 KiB on link 5", |half| format!("{:?}", half.arrive(5, 2, 64 << 10))),
        ],
        |half| {
            let Ack { receiver_id, peer_epoch, next, .. } = half.clone().ack(1, None);
            format!(
                "receiver {receiver_id}, epoch {peer_epoch}, next {next}, unacknowledged {}",
                half.has_unacknowledged()
            )
        },
    )
}

/// Announcements of room to a sender, and the acknowledgement delay of one with little room. spec: CREDIT-5
fn receiving_with_room() -> String {
    let announced = |room| {
        let mut half = Receiving::new(RECEIVER);
        half.attach(5);
        half.on_epoch(5, 20);
        half.ack(1, room);
        half
    };
    let window = |messages, bytes| Some(Window { messages, bytes });
    let states = [
        ("no room announced", announced(None)),
        ("announced 1 message, 1 byte", announced(window(1, 1))),
        ("announced 4 messages, 100 bytes", announced(window(4, 100))),
        ("announced 100 messages, 1 MB", announced(window(100, 1_000_000))),
    ];
    rows(
        "Receiving, room announced: state + input -> unacknowledged: answer",
        &states,
        &[
            ("room for 1 message, 1 byte", |half| must_announce_room(half, 1, 1)),
            ("room for 4 messages, 100 bytes", |half| must_announce_room(half, 4, 100)),
            ("room for 7 messages, 199 bytes", |half| must_announce_room(half, 7, 199)),
            ("room for 8 messages, 100 bytes", |half| must_announce_room(half, 8, 100)),
            ("room for 4 messages, 200 bytes", |half| must_announce_room(half, 4, 200)),
            ("message 1 of 10 bytes", |half| format!("{:?}", half.arrive(5, 1, 10))),
            ("message 1 of 50 bytes", |half| format!("{:?}", half.arrive(5, 1, 50))),
            ("messages 1 and 2 of 10 bytes", |half| {
                half.arrive(5, 1, 10);
                format!("{:?}", half.arrive(5, 2, 10))
            }),
        ],
        |half| half.has_unacknowledged().to_string(),
    )
}

fn must_announce_room(half: &Receiving, messages: usize, bytes: usize) -> String {
    half.must_announce_room(Window { messages, bytes }).to_string()
}

fn backlog() -> String {
    let empty = ReceiveBacklog::<u64, char>::new(LIMITS);
    let mut one = empty.clone();
    one.put(1, 'a', 10).expect("there is room");
    let mut offered = one.clone();
    offered.offer(1);
    let mut full = one.clone();
    full.put(1, 'b', 10).expect("there is room");
    let mut two = full.clone();
    two.put(2, 'c', 10).expect("there is room");
    let states = [
        ("empty", empty),
        ("1 in queue 1", one),
        ("1 of queue 1 offered", offered),
        ("2 in queue 1: full", full),
        ("2 in queue 1, 1 in queue 2: all full", two),
    ];
    rows(
        "ReceiveBacklog: state + input -> held, change, messages, bytes: answer",
        &states,
        &[
            ("put 'x' in queue 1", |half| format!("{:?}", half.put(1, 'x', 10))),
            ("put 'x' in queue 2", |half| format!("{:?}", half.put(2, 'x', 10))),
            ("put 'x' in queue 3", |half| format!("{:?}", half.put(3, 'x', 10))),
            ("offer queue 1", |half| format!("{:?}", half.offer(1))),
            ("taken of queue 1", |half| format!("{:?}", half.taken(1))),
            ("put back 'y' in queue 1", |half| {
                half.put_back(1, 'y', 10);
                String::new()
            }),
            ("forget_offers", |half| {
                half.forget_offers();
                String::new()
            }),
        ],
        |half| {
            let (held, change) = (half.held(), half.change());
            format!("{held:?}, change {change}, {} messages, {} bytes", half.messages(), half.bytes())
        },
    )
}

fn held() -> String {
    let fresh = SendBacklog::<u64, char>::new(LIMITS);
    let mut holding = fresh.clone();
    holding.on_held(4, [1]);
    let mut waiting = holding.clone();
    waiting.put(1, 'a', 10).expect("there is room");
    let mut ended = waiting.clone();
    ended.link_ended();
    let states = [
        ("none held", fresh),
        ("1 held by change 4", holding),
        ("1 held by change 4, 'a' waits", waiting),
        ("1 held, 'a' waits, link ended", ended),
    ];
    rows(
        "SendBacklog: state + input -> holds 1, holds 2, messages: answer",
        &states,
        &[
            ("change 3: none", |half| format!("{:?}", half.on_held(3, []))),
            ("change 4: none", |half| format!("{:?}", half.on_held(4, []))),
            ("change 5: none", |half| format!("{:?}", half.on_held(5, []))),
            ("change 5: 1 and 2", |half| format!("{:?}", half.on_held(5, [1, 2]))),
            ("change 5: 2", |half| format!("{:?}", half.on_held(5, [2]))),
            ("put 'x' for 1", |half| format!("{:?}", half.put(1, 'x', 10))),
            ("useless", |half| format!("{:?}", half.take_useless(|_| true))),
            ("link_ended", |half| {
                half.link_ended();
                String::new()
            }),
        ],
        |half| format!("{}, {}, {}", half.holds(1), half.holds(2), half.messages()),
    )
}
