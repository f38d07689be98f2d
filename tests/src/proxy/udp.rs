//! Datagrams: sent to a door, carried to the node that it leads to, its answers carried back to whoever was first.

use std::{
    collections::BTreeMap,
    net::{IpAddr, SocketAddr},
    sync::{Arc, atomic::Ordering},
};

use sinew::Time;
use socket2::SockRef;
use tokio::{
    net::UdpSocket,
    sync::{mpsc, watch},
};

use super::{
    datagrams::DatagramWay,
    doors::{Room, Shared, Weather, sleep_until},
};

/// Senders that are known at a door at most. What further ones send is lost.
const SENDERS_MAX: usize = 256;
/// Longest datagram.
const DATAGRAM_MAX: usize = 65_536;
/// Answers that wait to be looked at, at most. Further ones are lost.
const ANSWERS_MAX: usize = 1_024;

/// Who has sent something to the door, and the socket by which the node knows him.
type Senders = BTreeMap<SocketAddr, Arc<UdpSocket>>;

/// Carries datagrams for as long as the proxy runs.
pub(super) async fn serve(
    room: Room,
    socket: UdpSocket,
    shared: Arc<Shared>,
    mut weather: watch::Receiver<Weather>,
) {
    let side = room.door.side;
    let faults = weather.borrow_and_update().faults;
    // Connections count from 1, doors from the other end.
    let number = u64::MAX >> 1 & !(room.number as u64);
    let mut there: DatagramWay<Arc<UdpSocket>> =
        DatagramWay::new(faults[side.index()], shared.dice(number, side));
    let mut back = DatagramWay::new(faults[side.other().index()], shared.dice(number, side.other()));
    let mut senders = Senders::new();
    let (answer, mut answers) = mpsc::channel(ANSWERS_MAX);
    let mut buffer = vec![0; DATAGRAM_MAX];
    loop {
        let now = Time::now();
        while let Some((inner, datagram)) = there.pass(now) {
            let Some(target) = shared.target(room.number) else { continue };
            send(&inner, &datagram, target);
            shared.passed[side.index()].fetch_add(datagram.len() as u64, Ordering::Relaxed);
        }
        while let Some((outer, datagram)) = back.pass(now) {
            send(&socket, &datagram, outer);
            shared.passed[side.other().index()].fetch_add(datagram.len() as u64, Ordering::Relaxed);
        }
        let wake = [there.next_wake(), back.next_wake()].into_iter().flatten().min();
        tokio::select! {
            // What is told to go wrong goes wrong with the next datagram.
            biased;
            changed = weather.changed() => {
                if changed.is_err() {
                    return;
                }
                let faults = weather.borrow_and_update().faults;
                there.set(faults[side.index()]);
                back.set(faults[side.other().index()]);
            }
            // An error is about one that was sent before: its destination does not listen, which the sender will notice.
            received = socket.recv_from(&mut buffer) => {
                if let Ok((length, outer)) = received
                    && let Some(inner) = meet(&mut senders, outer, room.address.ip(), &answer).await
                {
                    there.take(Time::now(), inner, buffer[..length].to_vec());
                }
            }
            Some((outer, datagram)) = answers.recv() => back.take(Time::now(), outer, datagram),
            () = sleep_until(wake, now) => {}
        }
        for way in [there.new_lost_and_flips(), back.new_lost_and_flips()] {
            shared.lost.fetch_add(way.0, Ordering::Relaxed);
            shared.flips.fetch_add(way.1, Ordering::Relaxed);
        }
    }
}

fn send(socket: &UdpSocket, datagram: &[u8], to: SocketAddr) {
    // Sent at once, whatever the reactor knows of the socket. What the system does not take is lost, as datagrams are.
    let _ = SockRef::from(socket).send_to(datagram, &to.into());
}

/// The socket by which the node knows the sender at `outer`; a new one if need be.
async fn meet(
    senders: &mut Senders,
    outer: SocketAddr,
    ip: IpAddr,
    answer: &mpsc::Sender<(SocketAddr, Vec<u8>)>,
) -> Option<Arc<UdpSocket>> {
    if let Some(known) = senders.get(&outer) {
        return Some(known.clone());
    }
    if senders.len() >= SENDERS_MAX {
        return None;
    }
    let inner = Arc::new(UdpSocket::bind((ip, 0)).await.ok()?);
    tokio::spawn(hear(inner.clone(), outer, answer.clone()));
    senders.insert(outer, inner.clone());
    Some(inner)
}

async fn hear(inner: Arc<UdpSocket>, outer: SocketAddr, answer: mpsc::Sender<(SocketAddr, Vec<u8>)>) {
    let mut buffer = vec![0; DATAGRAM_MAX];
    while !answer.is_closed() {
        if let Ok((length, _)) = inner.recv_from(&mut buffer).await {
            // What has no room is lost, as datagrams are.
            let _ = answer.try_send((outer, buffer[..length].to_vec()));
        }
    }
}
