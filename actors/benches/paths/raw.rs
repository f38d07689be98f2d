//! The references: bare sockets and bare actix, the same payload there and back.

use std::{
    io::{Read, Write},
    net::{TcpListener, TcpStream},
    os::unix::net::{UnixListener, UnixStream},
    path::Path,
    time::Instant,
};

use actix::{Actor, Context, Handler, Message};
use actix_rt::Arbiter;
use sinew_figures::{End, Figures, Pinning};

use crate::{WARM_UP, rounds};

/// Echoes on a unix stream at `path`: blocks of the length that comes first.
pub(crate) fn echo_unix(path: &str) {
    let listener = UnixListener::bind(path).expect("a free path");
    println!("listening");
    let (stream, _) = listener.accept().expect("the measuring end");
    echo(stream);
}

/// Echoes on TCP at a free port, which it prints.
pub(crate) fn echo_tcp() {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    println!("{}", listener.local_addr().expect("it is bound"));
    let (stream, _) = listener.accept().expect("the measuring end");
    stream.set_nodelay(true).expect("TCP has no delay");
    echo(stream);
}

fn echo(mut stream: impl Read + Write) {
    let mut length = [0; 8];
    if stream.read_exact(&mut length).is_err() {
        return;
    }
    let mut buffer =
        vec![0; usize::try_from(u64::from_le_bytes(length)).expect("a length of this program's own")];
    while stream.read_exact(&mut buffer).is_ok() {
        if stream.write_all(&buffer).is_err() {
            return;
        }
    }
}

/// Round trips against an echo.
pub(crate) fn measure(kind: &str, path: &Path, line: &str, bytes: usize) -> Figures {
    if kind == "raw_unix" {
        round_trips(UnixStream::connect(path).expect("the echo listens"), bytes)
    } else {
        let stream = TcpStream::connect(line).expect("the echo listens");
        stream.set_nodelay(true).expect("TCP has no delay");
        round_trips(stream, bytes)
    }
}

fn round_trips(mut stream: impl Read + Write, bytes: usize) -> Figures {
    let (mut figures, mut buffer) = (Figures::new(), vec![7; bytes]);
    stream.write_all(&(bytes as u64).to_le_bytes()).expect("the echo reads");
    for round in 0..WARM_UP + rounds() {
        let start = Instant::now();
        stream.write_all(&buffer).expect("the echo reads");
        stream.read_exact(&mut buffer).expect("the echo answers");
        if round >= WARM_UP {
            figures.record(start.elapsed());
        }
    }
    figures
}

struct Bare;

impl Actor for Bare {
    type Context = Context<Self>;
}

struct Block(Vec<u8>);

impl Message for Block {
    type Result = Vec<u8>;
}

impl Handler<Block> for Bare {
    type Result = Vec<u8>;

    fn handle(&mut self, block: Block, _: &mut Context<Self>) -> Vec<u8> {
        block.0
    }
}

/// Round trips by actix's own `Addr::send`, a payload allocated for each.
pub(crate) fn actix_send(bytes: usize, pinning: Pinning, same_arbiter: bool) -> Figures {
    let system = actix::System::new();
    system.block_on(async move {
        let (first, second) = (arbiter(pinning, End::Measuring), arbiter(pinning, End::Echoing));
        let there = if same_arbiter { first.handle() } else { second.handle() };
        let bare = Bare::start_in_arbiter(&there, |_| Bare);
        let (give, given) = tokio::sync::oneshot::channel();
        first.spawn(async move {
            let mut figures = Figures::new();
            for round in 0..WARM_UP + rounds() {
                let start = Instant::now();
                let block = bare.send(Block(vec![7; bytes])).await.expect("the actor lives");
                assert_eq!(block.len(), bytes);
                if round >= WARM_UP {
                    figures.record(start.elapsed());
                }
            }
            // The receiver waits for it.
            let _ = give.send(figures);
        });
        given.await.expect("the rounds end")
    })
}

fn arbiter(pinning: Pinning, end: End) -> Arbiter {
    Arbiter::with_tokio_rt(move || {
        pinning.pin(end);
        tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a reactor")
    })
}
