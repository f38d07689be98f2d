//! UDP: datagrams to a listener, forwarded to its destination node; answers are forwarded back to the
//! original sender.

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
    listeners::{Conditions, Port, Shared, sleep_until},
};

/// Maximum number of known senders per listener. Datagrams of further ones are lost.
const SENDERS_MAX: usize = 256;
/// Maximum length of a datagram, in bytes.
const DATAGRAM_MAX: usize = 65_536;
/// Maximum number of waiting answers. Further ones are lost.
const ANSWERS_MAX: usize = 1_024;

/// The senders of a listener, each with the socket that represents it to the node.
type Senders = BTreeMap<SocketAddr, Arc<UdpSocket>>;

/// Forwards datagrams as long as the network runs.
pub(super) async fn serve(
    port: Port,
    socket: UdpSocket,
    shared: Arc<Shared>,
    mut conditions: watch::Receiver<Conditions>,
) {
    let side = port.listener.side;
    let faults = conditions.borrow_and_update().faults;
    // Connections count from 1 upwards, listeners from the other end downwards.
    let number = u64::MAX >> 1 & !(port.number as u64);
    let mut there: DatagramWay<Arc<UdpSocket>> =
        DatagramWay::new(faults[side.index()], shared.random(number, side));
    let mut back = DatagramWay::new(faults[side.other().index()], shared.random(number, side.other()));
    let mut senders = Senders::new();
    let (answer, mut answers) = mpsc::channel(ANSWERS_MAX);
    let mut buffer = vec![0; DATAGRAM_MAX];
    loop {
        let now = Time::now();
        while let Some((inner, datagram)) = there.pass(now) {
            let Some(target) = shared.target(port.number) else { continue };
            send(&inner, &datagram, target);
            shared.passed[side.index()].fetch_add(datagram.len() as u64, Ordering::Relaxed);
        }
        while let Some((outer, datagram)) = back.pass(now) {
            send(&socket, &datagram, outer);
            shared.passed[side.other().index()].fetch_add(datagram.len() as u64, Ordering::Relaxed);
        }
        let wake = [there.next_wake(), back.next_wake()].into_iter().flatten().min();
        tokio::select! {
            // A new fault takes effect with the next datagram.
            biased;
            changed = conditions.changed() => {
                if changed.is_err() {
                    return;
                }
                let faults = conditions.borrow_and_update().faults;
                there.set(faults[side.index()]);
                back.set(faults[side.other().index()]);
            }
            // An error is about an earlier datagram: its destination does not listen, which the sender will
            // notice.
            received = socket.recv_from(&mut buffer) => {
                if let Ok((length, outer)) = received
                    && let Some(inner) = socket_for(&mut senders, outer, port.address.ip(), &answer).await
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
    // Sent at once, regardless of the reactor's view of the socket. A datagram that the system rejects is
    // lost.
    let _ = SockRef::from(socket).send_to(datagram, &to.into());
}

/// The socket that represents the sender at `outer` to the node; created if missing.
async fn socket_for(
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
    tokio::spawn(receive_answers(inner.clone(), outer, answer.clone()));
    senders.insert(outer, inner.clone());
    Some(inner)
}

async fn receive_answers(
    inner: Arc<UdpSocket>,
    outer: SocketAddr,
    answer: mpsc::Sender<(SocketAddr, Vec<u8>)>,
) {
    let mut buffer = vec![0; DATAGRAM_MAX];
    while !answer.is_closed() {
        if let Ok((length, _)) = inner.recv_from(&mut buffer).await {
            // An answer without port is lost, as datagrams are.
            let _ = answer.try_send((outer, buffer[..length].to_vec()));
        }
    }
}
