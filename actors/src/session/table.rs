//! Every state of the session's halves, times every input: the new state and the answer, as the file `table.txt`.
//!
//! A change of behaviour shows as a difference; `SINEW_WRITE_TABLE=1 cargo test -p sinew session::table` writes the file anew, for a person
//! to read.

use super::*;

const FILE: &str = "src/session/table.txt";
const WRITE_VARIABLE: &str = "SINEW_WRITE_TABLE";
const WINDOW: Window = Window { messages: 2, bytes: 1_000 };
const LIMITS: ShelfLimits =
    ShelfLimits { lines: 2, line_messages: 2, line_bytes: 1_000, messages: 3, bytes: 1_000 };
/// The epoch of the sending half, and the peer's memory that it knows.
const EPOCH: u64 = 7;
const MEMORY: u64 = 3;

/// No message of the table loses its use.
impl Waits for char {}

#[test]
fn every_state_of_the_session_answers_every_input_as_the_table_says() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(FILE);
    let table =
        [sending(), sending_with_room(), receiving(), receiving_with_room(), shelf(), held()].concat();
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

/// An input: its name, and what it does and says.
type Input<'a, H> = (&'a str, fn(&mut H) -> String);

/// The rows of one half: each of its states with each input.
fn rows<H: Clone>(
    head: &str,
    states: &[(&str, H)],
    inputs: &[Input<'_, H>],
    word: fn(&H) -> String,
) -> String {
    let mut rows = format!("# {head}\n");
    for (state, half) in states {
        for (input, act) in inputs {
            let mut half = half.clone();
            let answer = act(&mut half);
            rows.push_str(format!("{state} + {input} -> {}: {answer}", word(&half)).trim_end());
            rows.push('\n');
        }
    }
    rows
}

fn ack(memory: u64, of: u64, next: u64) -> Ack {
    Ack { memory, epoch: 1, of, next, change: 0, held: Vec::new(), room: None }
}

fn sending() -> String {
    let fresh = Sending::new(EPOCH, WINDOW);
    let mut flowing = fresh.clone();
    flowing.heard(&ack(MEMORY, EPOCH, 1));
    let mut keeping = flowing.clone();
    keeping.keep('a', 10);
    let mut full = keeping.clone();
    full.keep('b', 10);
    let mut paused = full.clone();
    paused.link_ended();
    let mut resuming = paused.clone();
    resuming.heard(&ack(MEMORY, EPOCH, 1));
    // Its first message has arrived: what is below its base can be told from what is not.
    let mut later = full.clone();
    later.heard(&ack(MEMORY, EPOCH, 2));
    let mut anew = paused.clone();
    anew.heard(&ack(MEMORY + 1, 0, 1));
    let states = [
        ("fresh", fresh),
        ("flowing", flowing),
        ("flowing, 1 kept", keeping),
        ("flowing, 2 kept: full", full),
        ("flowing, 1 arrived, 1 kept", later),
        ("paused, 2 kept", paused),
        ("resuming, 2 kept", resuming),
        ("begun anew, untold", anew),
    ];
    rows(
        "Sending: state + input -> epoch, kept, to be written again, room: answer",
        &states,
        &[
            ("Ack, takes 1 next", |half| format!("{:?}", half.heard(&ack(MEMORY, EPOCH, 1)))),
            ("Ack, takes 2 next", |half| format!("{:?}", half.heard(&ack(MEMORY, EPOCH, 2)))),
            ("Ack, takes 3 next", |half| format!("{:?}", half.heard(&ack(MEMORY, EPOCH, 3)))),
            ("Ack, takes 9 next", |half| format!("{:?}", half.heard(&ack(MEMORY, EPOCH, 9)))),
            ("Ack, knows no epoch", |half| format!("{:?}", half.heard(&ack(MEMORY, 0, 1)))),
            ("Ack, knows another epoch", |half| format!("{:?}", half.heard(&ack(MEMORY, EPOCH - 1, 5)))),
            ("Ack of another memory", |half| format!("{:?}", half.heard(&ack(MEMORY + 1, EPOCH, 1)))),
            ("told of epoch 7", |half| half.told(EPOCH).to_string()),
            ("told of epoch 8", |half| half.told(EPOCH + 1).to_string()),
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

/// What the peer says of the room that it has, in messages and in bytes. spec: CREDIT-5
fn sending_with_room() -> String {
    let with_room = |next, messages, bytes| Ack { room: Some((messages, bytes)), ..ack(MEMORY, EPOCH, next) };
    let mut of_one_message = Sending::new(EPOCH, WINDOW);
    of_one_message.heard(&with_room(1, 1, 1_000));
    let mut of_ten_bytes = Sending::new(EPOCH, WINDOW);
    of_ten_bytes.heard(&with_room(1, 9, 10));
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
        "Sending, room said: state + input -> kept, room: answer",
        &states,
        &[
            ("Ack, takes 1 next, no room said", |half| format!("{:?}", half.heard(&ack(MEMORY, EPOCH, 1)))),
            ("Ack, takes 1 next, room for 1 message", |half| heard_with_room(half, 1, (1, 1_000))),
            ("Ack, takes 1 next, room for 2 messages", |half| heard_with_room(half, 1, (2, 1_000))),
            ("Ack, takes 1 next, room for 10 bytes", |half| heard_with_room(half, 1, (9, 10))),
            ("Ack, takes 1 next, room for 11 bytes", |half| heard_with_room(half, 1, (9, 11))),
            ("Ack, takes 2 next, no room said", |half| format!("{:?}", half.heard(&ack(MEMORY, EPOCH, 2)))),
            ("Ack, takes 2 next, room for 1 message", |half| heard_with_room(half, 2, (1, 1_000))),
            ("Ack, takes 2 next, room for 1 byte", |half| heard_with_room(half, 2, (9, 1))),
            ("Ack of another memory, room for 1 message", |half| {
                let room = Some((1, 1_000));
                let heard = half.heard(&Ack { room, ..ack(MEMORY + 1, EPOCH, 1) });
                half.told(EPOCH + 1);
                format!("{heard:?}, then told of epoch 8")
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

fn heard_with_room(half: &mut Sending<char>, next: u64, room: (u64, u64)) -> String {
    format!("{:?}", half.heard(&Ack { room: Some(room), ..ack(MEMORY, EPOCH, next) }))
}

fn receiving() -> String {
    let fresh = Receiving::new(MEMORY);
    let mut attached = fresh.clone();
    attached.attach(5);
    let mut taking = attached.clone();
    taking.heard(5, 20);
    let mut taken = taking.clone();
    taken.arrive(5, 1, 10);
    let mut replaced = taken.clone();
    replaced.attach(6);
    let states = [
        ("fresh", fresh),
        ("on link 5, epoch unsaid", attached),
        ("on link 5, epoch 20", taking),
        ("on link 5, epoch 20, 1 taken", taken),
        ("on link 6 after 5, epoch unsaid, 1 taken", replaced),
    ];
    rows(
        "Receiving: state + input -> its Ack, owes one: answer",
        &states,
        &[
            ("attach 7", |half| {
                half.attach(7);
                String::new()
            }),
            ("epoch 20 on link 5", |half| half.heard(5, 20).to_string()),
            ("epoch 20 on link 6", |half| half.heard(6, 20).to_string()),
            ("epoch 21 on link 6", |half| half.heard(6, 21).to_string()),
            ("epoch 19 on link 6", |half| half.heard(6, 19).to_string()),
            ("message 1 on link 5", |half| format!("{:?}", half.arrive(5, 1, 10))),
            ("message 2 on link 5", |half| format!("{:?}", half.arrive(5, 2, 10))),
            ("message 1 on link 6", |half| format!("{:?}", half.arrive(6, 1, 10))),
            ("message 2 on link 6", |half| format!("{:?}", half.arrive(6, 2, 10))),
            ("message 2 of 64 KiB on link 5", |half| format!("{:?}", half.arrive(5, 2, 64 << 10))),
        ],
        |half| {
            let Ack { memory, of, next, .. } = half.clone().ack(1, None);
            format!("memory {memory}, of {of}, next {next}, owes {}", half.owes_ack())
        },
    )
}

/// When a sender is told of room, and how soon it is acknowledged that has little. spec: CREDIT-5
fn receiving_with_room() -> String {
    let told = |room| {
        let mut half = Receiving::new(MEMORY);
        half.attach(5);
        half.heard(5, 20);
        half.ack(1, room);
        half
    };
    let window = |messages, bytes| Some(Window { messages, bytes });
    let states = [
        ("no room said", told(None)),
        ("said 1 message, 1 byte", told(window(1, 1))),
        ("said 4 messages, 100 bytes", told(window(4, 100))),
        ("said 100 messages, 1 MB", told(window(100, 1_000_000))),
    ];
    rows(
        "Receiving, room said: state + input -> owes an Ack: answer",
        &states,
        &[
            ("room for 1 message, 1 byte", |half| owes_room(half, 1, 1)),
            ("room for 4 messages, 100 bytes", |half| owes_room(half, 4, 100)),
            ("room for 7 messages, 199 bytes", |half| owes_room(half, 7, 199)),
            ("room for 8 messages, 100 bytes", |half| owes_room(half, 8, 100)),
            ("room for 4 messages, 200 bytes", |half| owes_room(half, 4, 200)),
            ("message 1 of 10 bytes", |half| format!("{:?}", half.arrive(5, 1, 10))),
            ("message 1 of 50 bytes", |half| format!("{:?}", half.arrive(5, 1, 50))),
            ("messages 1 and 2 of 10 bytes", |half| {
                half.arrive(5, 1, 10);
                format!("{:?}", half.arrive(5, 2, 10))
            }),
        ],
        |half| half.owes_ack().to_string(),
    )
}

fn owes_room(half: &Receiving, messages: usize, bytes: usize) -> String {
    half.owes_room(Window { messages, bytes }).to_string()
}

fn shelf() -> String {
    let empty = Shelf::<u64, char>::new(LIMITS);
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
        ("1 in line 1", one),
        ("1 of line 1 offered", offered),
        ("2 in line 1: full", full),
        ("2 in line 1, 1 in line 2: all full", two),
    ];
    rows(
        "Shelf: state + input -> held, change, messages, bytes: answer",
        &states,
        &[
            ("put 'x' in line 1", |half| format!("{:?}", half.put(1, 'x', 10))),
            ("put 'x' in line 2", |half| format!("{:?}", half.put(2, 'x', 10))),
            ("put 'x' in line 3", |half| format!("{:?}", half.put(3, 'x', 10))),
            ("offer line 1", |half| format!("{:?}", half.offer(1))),
            ("taken of line 1", |half| format!("{:?}", half.taken(1))),
            ("put back 'y' in line 1", |half| {
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
    let fresh = Held::<u64, char>::new(LIMITS);
    let mut holding = fresh.clone();
    holding.heard(4, [1]);
    let mut waiting = holding.clone();
    waiting.put(1, 'a', 10).expect("there is room");
    let mut ended = waiting.clone();
    ended.link_ended();
    let states = [
        ("nobody held", fresh),
        ("1 held by change 4", holding),
        ("1 held by change 4, 'a' waits", waiting),
        ("1 held, 'a' waits, link ended", ended),
    ];
    rows(
        "Held: state + input -> holds 1, holds 2, messages: answer",
        &states,
        &[
            ("change 3: nobody", |half| format!("{:?}", half.heard(3, []))),
            ("change 4: nobody", |half| format!("{:?}", half.heard(4, []))),
            ("change 5: nobody", |half| format!("{:?}", half.heard(5, []))),
            ("change 5: 1 and 2", |half| format!("{:?}", half.heard(5, [1, 2]))),
            ("change 5: 2", |half| format!("{:?}", half.heard(5, [2]))),
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
