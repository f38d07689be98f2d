//! The references: bare rings and bare sockets, with the same payload and the same roles.

use std::{
    io::{Read, Write},
    os::unix::net::UnixStream,
    time::{Duration, Instant},
};

use rustix::{
    event::{PollFd, PollFlags, poll},
    stdio::stdin,
};
use sinew_figures::{
    End, Figures, Pinning, Rounds,
    process::{Process, print_ready},
    stream,
};
use sinew_runtime::time::Time;
use sinew_shm::bare::{self, Waiting};

use crate::{
    case::Reference,
    crowds::{ANSWERED_EACH, Ages, PACKET, SENDERS, WINDOW, paced},
    ends::TABLE_ONE,
};

/// Round trips of a reference.
pub(crate) fn round_trips(reference: Reference, bytes: usize, rounds: Rounds, pinning: Pinning) -> Figures {
    let role = format!("raw_echo {} {bytes} {}", reference.name(), pinning.name());
    let mut buffer = vec![7; bytes];
    match reference {
        Reference::BareFutex | Reference::BarePoll => {
            let memory = bare::memory(bytes);
            let mut end = bare::End::first(&memory, bytes, waiting(reference));
            let _echo = Process::start_on(&role, memory);
            rounds.time(|| {
                end.send(&buffer);
                end.receive(&mut buffer);
            })
        }
        Reference::UnixStream => {
            let (socket, theirs) = UnixStream::pair().expect("a pair of sockets");
            let _echo = Process::start_on(&role, theirs.into());
            stream::round_trips(socket, rounds)
        }
    }
}

/// The echoing end: until the measuring end ends this process.
pub(crate) fn echo(reference: Reference, bytes: usize) {
    let mut buffer = vec![0; bytes];
    match reference {
        Reference::BareFutex | Reference::BarePoll => {
            let mut end = bare::End::second(stdin(), bytes, waiting(reference));
            print_ready();
            loop {
                end.receive(&mut buffer);
                end.send(&buffer);
            }
        }
        Reference::UnixStream => stream::echo(bytes),
    }
}

/// The paper's test by a reference: how old each of the first 1024 packets is when it is received.
pub(crate) fn table_one(reference: Reference, pinning: Pinning) -> Ages {
    let role = format!("raw_aged_echo {} {}", reference.name(), pinning.name());
    match reference {
        Reference::BareFutex | Reference::BarePoll => {
            let memory = bare::memory(PACKET);
            let mut end = bare::End::first(&memory, PACKET, waiting(reference));
            let _echo = Process::start_on(&role, memory);
            ages(|packet| {
                end.send(packet);
                end.receive(packet);
            })
        }
        Reference::UnixStream => {
            let (mut socket, theirs) = UnixStream::pair().expect("a pair of sockets");
            let _echo = Process::start_on(&role, theirs.into());
            ages(|packet| {
                socket.write_all(packet).expect("the echo reads");
                socket.read_exact(packet).expect("the echo answers");
            })
        }
    }
}

/// Ages of packets that are sent one after the other, as reported by the other end.
fn ages(mut round_trip: impl FnMut(&mut [u8])) -> Ages {
    let mut packet = [7; PACKET];
    let ages = (0..TABLE_ONE).map(|_| {
        stamp(&mut packet);
        round_trip(&mut packet);
        word(&packet)
    });
    Ages::of(&ages.collect::<Vec<_>>())
}

/// The end that reports the age of each received packet, until the measuring end ends this process.
pub(crate) fn aged_echo(reference: Reference) {
    let mut packet = [0; PACKET];
    match reference {
        Reference::BareFutex | Reference::BarePoll => {
            let mut end = bare::End::second(stdin(), PACKET, waiting(reference));
            print_ready();
            loop {
                end.receive(&mut packet);
                put_age(&mut packet);
                end.send(&packet);
            }
        }
        Reference::UnixStream => {
            let mut socket = input();
            print_ready();
            while socket.read_exact(&mut packet).is_ok() {
                put_age(&mut packet);
                if socket.write_all(&packet).is_err() {
                    return;
                }
            }
        }
    }
}

/// Puts the time into a packet's first eight bytes.
fn stamp(packet: &mut [u8]) {
    packet[..8].copy_from_slice(&Time::now().as_nanos().to_le_bytes());
}

/// Its age in the place of that time, in nanoseconds.
fn put_age(packet: &mut [u8]) {
    let age = age(packet).as_nanos() as u64;
    packet[..8].copy_from_slice(&age.to_le_bytes());
}

/// How old a packet is that was stamped.
fn age(packet: &[u8]) -> Duration {
    Time::now().since(Time::from_nanos(word(packet)))
}

fn word(packet: &[u8]) -> u64 {
    packet.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes))
}

const fn waiting(reference: Reference) -> Waiting {
    match reference {
        Reference::BarePoll => Waiting::Poll,
        Reference::BareFutex | Reference::UnixStream => Waiting::Futex,
    }
}

/// The socket that this process was given as its input.
fn input() -> UnixStream {
    stream::input().into()
}

/// Packets a second that a unix stream carries, answered as those of a flood are.
pub(crate) fn flood(packets: u64, pinning: Pinning) -> f64 {
    let (mut socket, theirs) = UnixStream::pair().expect("a pair of sockets");
    let _sink = Process::start_on(&format!("raw_sink {}", pinning.name()), theirs.into());
    let (packet, mut answered) = ([7; PACKET], 0);
    let start = Instant::now();
    for sent in 0..packets {
        while sent - answered >= WINDOW {
            socket.read_exact(&mut [0; 8]).expect("the sink answers");
            answered += ANSWERED_EACH;
        }
        socket.write_all(&packet).expect("the sink reads");
    }
    while answered < packets {
        socket.read_exact(&mut [0; 8]).expect("the sink answers");
        answered += ANSWERED_EACH;
    }
    packets as f64 / start.elapsed().as_secs_f64()
}

/// The sink of a flood: until the measuring end ends this process.
pub(crate) fn sink() {
    let (mut socket, mut packet, mut taken) = (input(), [0; PACKET], 0_u64);
    print_ready();
    while socket.read_exact(&mut packet).is_ok() {
        taken += 1;
        if taken.is_multiple_of(ANSWERED_EACH) && socket.write_all(&taken.to_le_bytes()).is_err() {
            return;
        }
    }
}

/// Ages of the packets that eight processes send, each over its own unix stream.
pub(crate) fn fan_in(packets: u64, pinning: Pinning) -> Figures {
    let role = format!("raw_sender {packets} {}", pinning.name());
    let (mut sockets, mut senders) = (Vec::new(), Vec::new());
    for _ in 0..SENDERS {
        let (socket, theirs) = UnixStream::pair().expect("a pair of sockets");
        senders.push(Process::start_on(&role, theirs.into()));
        sockets.push(socket);
    }
    for socket in &mut sockets {
        socket.write_all(b"go").expect("the sender waits");
    }
    let mut figures = Figures::new();
    while figures.rounds() < packets * SENDERS as u64 {
        let mut fds: Vec<_> = sockets.iter().map(|socket| PollFd::new(socket, PollFlags::IN)).collect();
        poll(&mut fds, None).expect("sockets can be polled");
        let mut ready =
            fds.iter().map(|fd| fd.revents().contains(PollFlags::IN)).collect::<Vec<_>>().into_iter();
        // A sender that has ended was read to its end.
        sockets.retain_mut(|socket| ready.next() != Some(true) || read_packet(socket, &mut figures));
    }
    senders.into_iter().for_each(|sender| drop(sender.wait()));
    figures
}

/// Reads a packet and records its age. Returns whether there was one.
fn read_packet(socket: &mut UnixStream, figures: &mut Figures) -> bool {
    let mut packet = [0; PACKET];
    let is_there = socket.read_exact(&mut packet).is_ok();
    if is_there {
        figures.record(age(&packet));
    }
    is_there
}

/// One of the eight senders.
pub(crate) fn send(packets: u64) {
    let (mut socket, mut packet) = (input(), [7; PACKET]);
    print_ready();
    socket.read_exact(&mut [0; 2]).expect("the word to begin");
    paced(packets, || {
        stamp(&mut packet);
        socket.write_all(&packet).expect("the sink reads");
    });
}

/// Pins a reference's other end.
pub(crate) fn pin(pinning: &str, end: End) {
    Pinning::named(pinning).pin(end);
}
