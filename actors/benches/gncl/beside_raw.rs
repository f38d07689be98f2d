//! The same over bare TCP: round trips on one connection, alone and beside a flood on another one.

use std::{
    io::Write,
    net::{SocketAddrV4, TcpListener, TcpStream},
    thread,
    time::Duration,
};

use sinew_figures::{Alone, Pace, Rounds, process::print_ready, stream};

/// Bytes of a question.
const ASKED: usize = 64;
/// Round trips before any is counted.
const WARM_UP: u32 = 20;

/// Echoes data of the first connection, and discards data of the second.
pub(crate) fn echo(address: SocketAddrV4) {
    let listener = TcpListener::bind(address).expect("a free port");
    print_ready();
    let (questions, _) = listener.accept().expect("the measuring end");
    questions.set_nodelay(true).expect("TCP has no delay");
    thread::spawn(move || {
        let (mut flood, _) = listener.accept().expect("the measuring end floods");
        // Ends with the connection.
        let _ = std::io::copy(&mut flood, &mut std::io::sink());
    });
    let (mut reader, mut writer) = (&questions, &questions);
    // Ends with the connection.
    let _ = std::io::copy(&mut reader, &mut writer);
}

/// Runs `alone` round trips, then `beside` ones with a flood that writes `flooded` bytes at once.
pub(crate) fn measure(case: &str, address: SocketAddrV4, flooded: usize, [alone, beside]: [u64; 2]) {
    let rounds = |counted: u64| Rounds {
        bytes: ASKED,
        pace: Pace::EveryMillisecond,
        warm_up: WARM_UP,
        counted: u32::try_from(counted).expect("a bench does not last for days"),
    };
    let connect = || {
        let connection = TcpStream::connect(address).expect("the echo listens");
        connection.set_nodelay(true).expect("TCP has no delay");
        connection.set_write_timeout(Some(Duration::from_secs(60))).expect("a second is not zero");
        connection
    };
    let questions = connect();
    let alone = stream::round_trips(&questions, rounds(alone));
    let mut flood = connect();
    // Ends with the process.
    thread::spawn(move || {
        let message = vec![7; flooded];
        while flood.write_all(&message).is_ok() {}
    });
    let beside = stream::round_trips(&questions, rounds(beside));
    let ratio = beside.p99().as_nanos() * 100 / alone.p99().as_nanos().max(1);
    let counts = [("p99_ratio_percent", u64::try_from(ratio).unwrap_or(u64::MAX))];
    let none: &[(&str, u64)] = &[];
    for (figure, seen, counts) in
        [("raw TCP alone", &alone, none), ("raw TCP beside a flood", &beside, &counts)]
    {
        Alone { bench: "gncl", case, figure, seen, counts }.report();
    }
}
