//! TCP: connections to a listener, forwarded to its destination node.

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
    faults::{Cut, Side},
    listeners::{Conditions, Port, Shared, reopen, sleep_until},
    stream::StreamWay,
};

/// Maximum length of one read, in bytes.
const READ_LEN: usize = 16 << 10;
/// Delay after the system has run out of resources.
const BACK_OFF: Duration = Duration::from_millis(10);

/// Accepts connections as long as the network runs.
pub(super) async fn serve(
    port: Port,
    listener: TcpListener,
    shared: Arc<Shared>,
    mut conditions: watch::Receiver<Conditions>,
) {
    let mut open = Some(listener);
    loop {
        if conditions.borrow_and_update().refusing {
            open = None;
        } else if open.is_none() {
            open = reopen(&port).ok();
        }
        let Some(listener) = &open else {
            // The listener refuses connections, or the port is not free yet.
            tokio::select! {
                changed = conditions.changed() => if changed.is_err() { return },
                () = tokio::time::sleep(BACK_OFF) => {}
            }
            continue;
        };
        tokio::select! {
            changed = conditions.changed() => if changed.is_err() { return },
            accepted = listener.accept() => match accepted {
                Ok((from, _)) => drop(tokio::spawn(forward(port, from, shared.clone(), conditions.clone()))),
                Err(_) => tokio::time::sleep(BACK_OFF).await,
            },
        }
    }
}

/// The end of a connection.
enum End {
    /// Both sides have finished.
    Orderly,
    /// One side failed, so the other is reset as well.
    Failed,
    /// It was cut.
    Cut(Cut),
}

async fn forward(port: Port, from: TcpStream, shared: Arc<Shared>, conditions: watch::Receiver<Conditions>) {
    let number = shared.made.fetch_add(1, Ordering::Relaxed) + 1;
    shared.open.fetch_add(1, Ordering::Relaxed);
    let to = match shared.target(port.number) {
        Some(target) => TcpStream::connect(target).await,
        None => Err(io::ErrorKind::NotConnected.into()),
    };
    match to {
        Ok(to) => {
            let end =
                pass(&Pair { number, side: port.listener.side, from: &from, to: &to }, &shared, conditions)
                    .await;
            if let End::Cut(_) = end {
                shared.cut.fetch_add(1, Ordering::Relaxed);
            }
            if matches!(end, End::Failed | End::Cut(Cut::Reset)) {
                reset(&from);
                reset(&to);
            }
        }
        // The destination is not reachable.
        Err(_) => reset(&from),
    }
    shared.open.fetch_sub(1, Ordering::Relaxed);
}

/// Makes the close of the socket send RST to the peer.
fn reset(socket: &TcpStream) {
    // An error means that the connection is already gone, which is the goal.
    let _ = SockRef::from(socket).set_linger(Some(Duration::ZERO));
}

/// The two directions of a connection.
struct Pair<'a> {
    number: u64,
    side: Side,
    from: &'a TcpStream,
    to: &'a TcpStream,
}

async fn pass(pair: &Pair<'_>, shared: &Shared, mut conditions: watch::Receiver<Conditions>) -> End {
    let Pair { number, side, from, to } = *pair;
    if from.set_nodelay(true).and_then(|()| to.set_nodelay(true)).is_err() {
        return End::Failed;
    }
    let faults = conditions.borrow_and_update().faults;
    let way = |side: Side| StreamWay::new(faults[side.index()], shared.random(number, side));
    let there = pump(Half { from, to, side, way: way(side) }, shared, conditions.clone());
    let side = side.other();
    let back = pump(Half { from: to, to: from, side, way: way(side) }, shared, conditions.clone());
    let both = async { tokio::try_join!(there, back) };
    let cut = async {
        loop {
            {
                let conditions = conditions.borrow_and_update();
                if number <= conditions.cut_upto {
                    return conditions.how;
                }
            }
            if conditions.changed().await.is_err() {
                return Cut::Reset;
            }
        }
    };
    tokio::select! {
        passed = both => if passed.is_ok() { End::Orderly } else { End::Failed },
        how = cut => End::Cut(how),
    }
}

/// One direction of one connection.
struct Half<'a> {
    from: &'a TcpStream,
    to: &'a TcpStream,
    side: Side,
    way: StreamWay,
}

/// Forwards bytes until the end of the stream.
async fn pump(
    half: Half<'_>,
    shared: &Shared,
    mut conditions: watch::Receiver<Conditions>,
) -> io::Result<()> {
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
            // A new fault takes effect with the next byte.
            biased;
            changed = conditions.changed() => {
                changed.map_err(|_| io::ErrorKind::ConnectionAborted)?;
                way.set(conditions.borrow_and_update().faults[side.index()]);
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
