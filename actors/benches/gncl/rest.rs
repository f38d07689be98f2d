//! The first message after a pause over bare TCP: on a connection that has stayed open, and on a new one.

use std::{
    io::{Read, Write},
    net::{SocketAddrV4, TcpListener, TcpStream},
    thread,
    time::{Duration, Instant},
};

use sinew_figures::{Alone, Figures, process::print_ready};

/// Pause before each message; the connection that stays open pauses twice as long.
const REST: Duration = Duration::from_millis(100);
/// Bytes of a message.
const MESSAGE: usize = 1000;
/// Bytes of the handshake of two nodes before the first message: HELLO, and WELCOME back.
const HELLO: usize = 200;

/// Echoes data until this process is ended. A thread of its own serves the first connection, which stays
/// open; further ones are served one after the other.
pub(crate) fn echo(address: SocketAddrV4) {
    let listener = TcpListener::bind(address).expect("a free port");
    print_ready();
    let (stays, _) = listener.accept().expect("the measuring end");
    thread::spawn(move || send_back(&stays));
    listener.incoming().for_each(|connection| send_back(&connection.expect("a descriptor")));
}

fn send_back(connection: &TcpStream) {
    connection.set_nodelay(true).expect("TCP has no delay");
    let (mut reader, mut writer) = (connection, connection);
    // Ends with the connection.
    let _ = std::io::copy(&mut reader, &mut writer);
}

/// Both in turn, so often each.
pub(crate) fn measure(address: SocketAddrV4, count: u64) {
    let mut open = dial(address);
    round_trip(&mut open, MESSAGE);
    let [mut stayed, mut dialled] = [Figures::new(), Figures::new()];
    for _ in 0..count {
        thread::sleep(REST);
        let asked = Instant::now();
        round_trip(&mut open, MESSAGE);
        stayed.record(asked.elapsed());
        thread::sleep(REST);
        let asked = Instant::now();
        let mut anew = dial(address);
        round_trip(&mut anew, HELLO);
        round_trip(&mut anew, MESSAGE);
        dialled.record(asked.elapsed());
    }
    for (figure, seen) in
        [("first message after a rest", &stayed), ("the same on a new connection", &dialled)]
    {
        Alone { bench: "gncl", case: "rest_raw_tcp", figure, seen, counts: &[("messages", count)] }.report();
    }
}

fn dial(address: SocketAddrV4) -> TcpStream {
    let connection = TcpStream::connect(address).expect("the echo listens");
    connection.set_nodelay(true).expect("TCP has no delay");
    connection
}

fn round_trip(connection: &mut TcpStream, bytes: usize) {
    let mut buffer = vec![7; bytes];
    connection.write_all(&buffer).expect("the echo reads");
    connection.read_exact(&mut buffer).expect("the echo answers");
}
