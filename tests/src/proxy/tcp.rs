//! Connections: made to a door, carried to the node that it leads to.

use std::{
    io,
    net::Shutdown,
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use sinew::Time;
use socket2::SockRef;
use tokio::{
    net::{TcpListener, TcpStream},
    sync::watch,
};

use super::{
    doors::{Room, Shared, Weather, reopen, sleep_until},
    faults::{Cut, Side},
    stream::StreamWay,
};

/// Bytes that are read at once at most.
const READ_LEN: usize = 16 << 10;
/// How long to wait where the system has no more to give.
const BACK_OFF: Duration = Duration::from_millis(10);

/// Takes connections for as long as the proxy runs.
pub(super) async fn serve(
    room: Room,
    listener: TcpListener,
    shared: Arc<Shared>,
    mut weather: watch::Receiver<Weather>,
) {
    let mut open = Some(listener);
    loop {
        if weather.borrow_and_update().refusing {
            open = None;
        } else if open.is_none() {
            open = reopen(&room).ok();
        }
        let Some(listener) = &open else {
            // Refusing, or the port is not free yet.
            tokio::select! {
                changed = weather.changed() => if changed.is_err() { return },
                () = tokio::time::sleep(BACK_OFF) => {}
            }
            continue;
        };
        tokio::select! {
            changed = weather.changed() => if changed.is_err() { return },
            accepted = listener.accept() => match accepted {
                Ok((from, _)) => drop(tokio::spawn(carry(room, from, shared.clone(), weather.clone()))),
                Err(_) => tokio::time::sleep(BACK_OFF).await,
            },
        }
    }
}

/// How a connection ended.
enum End {
    /// Both sides have finished.
    Orderly,
    /// One of them failed, so the other is to fail as well.
    Failed,
    /// It was cut.
    Cut(Cut),
}

async fn carry(room: Room, from: TcpStream, shared: Arc<Shared>, weather: watch::Receiver<Weather>) {
    let number = shared.made.fetch_add(1, Ordering::Relaxed) + 1;
    shared.open.fetch_add(1, Ordering::Relaxed);
    let to = match shared.target(room.number) {
        Some(target) => TcpStream::connect(target).await,
        None => Err(io::ErrorKind::NotConnected.into()),
    };
    match to {
        Ok(to) => {
            let end =
                pass(&Pair { number, side: room.door.side, from: &from, to: &to }, &shared, weather).await;
            if let End::Cut(_) = end {
                shared.cut.fetch_add(1, Ordering::Relaxed);
            }
            if matches!(end, End::Failed | End::Cut(Cut::Reset)) {
                reset(&from);
                reset(&to);
            }
        }
        // Nobody is there.
        Err(_) => reset(&from),
    }
    shared.open.fetch_sub(1, Ordering::Relaxed);
}

/// When it is closed, the peer is told by RST.
fn reset(socket: &TcpStream) {
    // An error says that the connection is gone, which is what is wanted.
    let _ = SockRef::from(socket).set_linger(Some(Duration::ZERO));
}

/// A connection's two halves.
struct Pair<'a> {
    number: u64,
    side: Side,
    from: &'a TcpStream,
    to: &'a TcpStream,
}

async fn pass(pair: &Pair<'_>, shared: &Shared, mut weather: watch::Receiver<Weather>) -> End {
    let Pair { number, side, from, to } = *pair;
    if from.set_nodelay(true).and_then(|()| to.set_nodelay(true)).is_err() {
        return End::Failed;
    }
    let faults = weather.borrow_and_update().faults;
    let way = |side: Side| StreamWay::new(faults[side.index()], shared.dice(number, side));
    let there = pump(Half { from, to, side, way: way(side) }, shared, weather.clone());
    let side = side.other();
    let back = pump(Half { from: to, to: from, side, way: way(side) }, shared, weather.clone());
    let both = async { tokio::try_join!(there, back) };
    let cut = async {
        loop {
            {
                let weather = weather.borrow_and_update();
                if number <= weather.cut_upto {
                    return weather.how;
                }
            }
            if weather.changed().await.is_err() {
                return Cut::Reset;
            }
        }
    };
    tokio::select! {
        passed = both => if passed.is_ok() { End::Orderly } else { End::Failed },
        how = cut => End::Cut(how),
    }
}

/// One way of one connection.
struct Half<'a> {
    from: &'a TcpStream,
    to: &'a TcpStream,
    side: Side,
    way: StreamWay,
}

/// Carries bytes until there are no more.
async fn pump(half: Half<'_>, shared: &Shared, mut weather: watch::Receiver<Weather>) -> io::Result<()> {
    let Half { from, to, side, mut way } = half;
    let mut buffer = vec![0; READ_LEN];
    let mut is_over = false;
    loop {
        let now = Time::now();
        if is_over && way.is_empty() {
            return SockRef::from(to).shutdown(Shutdown::Write);
        }
        let room = way.room().min(READ_LEN);
        let is_ready = !way.ready(now).is_empty();
        let wake = way.next_wake().filter(|_| !is_ready);
        tokio::select! {
            // What is told to go wrong goes wrong with the next byte.
            biased;
            changed = weather.changed() => {
                changed.map_err(|_| io::ErrorKind::ConnectionAborted)?;
                way.set(weather.borrow_and_update().faults[side.index()]);
            }
            writable = to.writable(), if is_ready => {
                writable?;
                match to.try_write(way.ready(now)) {
                    Ok(count) => {
                        way.passed(now, count);
                        shared.passed[side.index()].fetch_add(count as u64, Ordering::Relaxed);
                    }
                    Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                    Err(error) => return Err(error),
                }
            }
            readable = from.readable(), if !is_over && room > 0 => {
                readable?;
                match from.try_read(&mut buffer[..room]) {
                    Ok(0) => is_over = true,
                    Ok(count) => way.take(now, &buffer[..count]),
                    Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                    Err(error) => return Err(error),
                }
                shared.flips.fetch_add(way.new_flips(), Ordering::Relaxed);
            }
            () = sleep_until(wake, now) => {}
        }
    }
}
