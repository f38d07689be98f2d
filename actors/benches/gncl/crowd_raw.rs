//! The same as [`crowd`](crate::crowd) over bare sockets: the machine's own costs with this number of
//! processes.
//!
//! Each process has one thread during the measurement, a connection to every other process, and a task that
//! reads it.

use std::{
    cell::RefCell,
    io::ErrorKind,
    net::{Ipv4Addr, SocketAddrV4},
    rc::Rc,
    time::{Duration, Instant},
};

use sinew_figures::process::print_ready;
use tokio::{
    net::{TcpListener, TcpStream},
    task::LocalSet,
    time::{MissedTickBehavior, interval, sleep},
};

use crate::crowd::{PACKET, Seen, Share, WARM_UP, hand_over};

/// A frame: a packet with its direction and its send time.
const FRAME: usize = 9 + PACKET;
const THERE: u8 = 1;
const BACK: u8 = 2;

struct Member {
    others: Vec<Rc<TcpStream>>,
    clock: Instant,
    seen: Option<Seen>,
}

type Shared = Rc<RefCell<Member>>;

/// One member, in its own process: writes its results to the standard output.
pub(crate) fn member(share: Share, port: u16) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a reactor");
    LocalSet::new().block_on(&runtime, run(share, port));
}

/// The address of member `index`.
const fn address(index: usize, port: u16) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(127, 0, 1, index as u8 + 1), port)
}

async fn run(share: Share, port: u16) {
    let Share { index, count, seconds, .. } = share;
    let listener = TcpListener::bind(address(index, port)).await.expect("a free port");
    let mut others = Vec::new();
    for other in 0..index {
        others.push(TcpStream::connect(address(other, port)).await.expect("it was there before"));
    }
    print_ready();
    while others.len() < count - 1 {
        others.push(listener.accept().await.expect("one that comes later").0);
    }
    let others = others.into_iter().map(|other| {
        other.set_nodelay(true).expect("TCP has no delay");
        Rc::new(other)
    });
    let member = Member { others: others.collect(), clock: Instant::now(), seen: None };
    let member = Rc::new(RefCell::new(member));
    for other in member.borrow().others.clone() {
        tokio::task::spawn_local(read(member.clone(), other));
    }
    if let Some(period) = share.period() {
        tokio::task::spawn_local(ask(member.clone(), index, period));
    }
    sleep(WARM_UP).await;
    member.borrow_mut().seen = Some(Seen::begin());
    sleep(Duration::from_secs(seconds)).await;
    let seen = member.borrow_mut().seen.take().expect("it was begun").end();
    // The others may not be through: they are answered until they are.
    tokio::task::spawn_blocking(move || hand_over(seen)).await.expect("what was seen is handed over");
}

async fn ask(member: Shared, first: usize, period: Duration) {
    let mut ticks = interval(period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Burst);
    for next in first.. {
        ticks.tick().await;
        let member = member.borrow();
        write(&member.others[next % member.others.len()], THERE, now_ns(&member));
    }
}

fn now_ns(member: &Member) -> u64 {
    u64::try_from(member.clock.elapsed().as_nanos()).expect("a bench does not last for centuries")
}

/// Writes a packet. If there is no room, or the receiver has ended, the packet is missing among the times.
fn write(to: &TcpStream, kind: u8, sent_ns: u64) {
    let mut frame = [7; FRAME];
    frame[0] = kind;
    frame[1..9].copy_from_slice(&sent_ns.to_le_bytes());
    match to.try_write(&frame) {
        Ok(FRAME) => {}
        // The next packet would be parsed as its remainder, and the results would be meaningless.
        Ok(written) => fail(&format!("only {written} of {FRAME} bytes had room: a member is too slow")),
        Err(error) if is_missing(error.kind()) => {}
        Err(error) => fail(&format!("a packet cannot be written: {error}")),
    }
}

/// Whether the packet is lost without ending the measurement.
const fn is_missing(error: ErrorKind) -> bool {
    matches!(error, ErrorKind::WouldBlock | ErrorKind::BrokenPipe | ErrorKind::ConnectionReset)
}

/// Ends this process, not only the task: the parent process notices the missing results, and reports a
/// failure.
fn fail(words: &str) -> ! {
    eprintln!("raw_member: {words}");
    std::process::exit(1)
}

async fn read(member: Shared, from: Rc<TcpStream>) {
    let mut buffer = Vec::with_capacity(4 * FRAME);
    loop {
        from.readable().await.expect("the other one lives");
        match from.try_read_buf(&mut buffer) {
            // It has ended.
            Ok(0) => return,
            Ok(_) => {}
            Err(error) if error.kind() == ErrorKind::WouldBlock => continue,
            Err(_) => return,
        }
        let whole = buffer.len() / FRAME * FRAME;
        for frame in buffer[..whole].chunks_exact(FRAME) {
            came(&member, &from, frame);
        }
        buffer.drain(..whole);
    }
}

fn came(member: &Shared, from: &TcpStream, frame: &[u8]) {
    let sent_ns = u64::from_le_bytes(frame[1..9].try_into().expect("eight bytes"));
    if frame[0] == THERE {
        return write(from, BACK, sent_ns);
    }
    let mut member = member.borrow_mut();
    let took = now_ns(&member) - sent_ns;
    if let Some(seen) = &mut member.seen {
        seen.record(took);
    }
}
