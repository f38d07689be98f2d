//! Sinew's rings: written in place, copied out, every wait with a deadline.

use std::{
    os::{fd::AsFd, unix::net::UnixStream},
    time::Duration,
};

use sinew_figures::Figures;
use sinew_shm::{BellKind, Capacity, Consumer, Offer, Producer, Region, Spin, Terms, Wait};

use crate::{case::Kind, pace::Pace};

pub(crate) fn measure(kind: Kind, socket: &UnixStream, bytes: usize, pace: Pace) -> Figures {
    let (mut producer, mut consumer) = connect(kind, socket);
    let mut buffer = vec![7; bytes];
    pace.time(|| {
        let mut loan = producer.loan(bytes).expect("one message at a time fits");
        loan.copy_from_slice(&buffer);
        loan.publish();
        let lent = consumer.receive_before(&soon()).expect("the echo answers");
        lent.copy_to(&mut buffer);
    })
}

pub(crate) fn echo(kind: Kind, bytes: usize) {
    let (mut producer, mut consumer) = connect(kind, rustix::stdio::stdin());
    let mut buffer = vec![0; bytes];
    while let Ok(lent) = consumer.receive_before(&soon()) {
        lent.copy_to(&mut buffer);
        drop(lent);
        producer.send(&buffer).expect("one message at a time fits");
    }
}

fn soon() -> Wait<'static> {
    Wait::within(Duration::from_secs(5))
}

fn connect(kind: Kind, socket: impl AsFd) -> (Producer, Consumer) {
    let (bell, spin) = match kind {
        Kind::EventFd => (BellKind::EventFd, Spin::Off),
        Kind::Socket => (BellKind::Socket, Spin::Off),
        Kind::Spin => (BellKind::Futex, Spin::For(Duration::from_secs(1))),
        Kind::Adaptive => (BellKind::Futex, Spin::Adaptive { max: Duration::from_micros(50) }),
        Kind::Futex | Kind::BareFutex | Kind::BarePoll | Kind::UnixStream => (BellKind::Futex, Spin::Off),
    };
    let capacity = Capacity::new(256 * 1024).expect("a power of two");
    let (region, offer) = Region::create(capacity, bell).expect("a region");
    offer.send(&socket).expect("an empty socket");
    let peer = Offer::receive(&socket).expect("whole").expect("an offer");
    let terms = Terms { bells: vec![bell], ..Terms::default() };
    let (mut producer, mut consumer) = region.connect(peer, &terms).expect("the same program's");
    producer.set_spin(spin);
    consumer.set_spin(spin);
    (producer, consumer)
}
