//! The faulty network causes the commanded faults, and no others.

use std::{
    io::{self, Read, Write},
    net::{SocketAddr, TcpListener, TcpStream, UdpSocket},
    num::{NonZeroU32, NonZeroU64, NonZeroUsize},
    time::Duration,
};

use proptest::prelude::*;
use sinew::Time;

use super::{datagrams, datagrams::DatagramWay, faults::Change, stream, stream::StreamWay, *};
use crate::{DEADLINE, random::SeededRandom, until};

/// An action on one direction.
#[derive(Clone, Debug)]
enum Step {
    Set(Faults),
    /// This many bytes arrive, as far as there is room.
    Take(usize),
    /// Ready bytes pass, at most this many at once.
    Pass(usize),
    Wait(Duration),
}

fn faults() -> impl Strategy<Value = Faults> {
    let ms = |most: u64| (0..=most).prop_map(Duration::from_millis);
    let switches = (prop::bool::weighted(0.2), prop::bool::weighted(0.2));
    let limits = (prop::option::of(1_usize..64), prop::option::of(1_000_u64..1_000_000));
    (switches, ms(20), ms(20), limits).prop_map(|((stalled, parted), delay, jitter, (segment, rate))| {
        Faults {
            stalled,
            parted,
            delay,
            jitter,
            segment_max: segment.and_then(NonZeroUsize::new),
            one_flip_in: None,
            one_loss_in: None,
            bytes_per_second: rate.and_then(NonZeroU64::new),
        }
    })
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        1 => faults().prop_map(Step::Set),
        4 => (1_usize..2_000).prop_map(Step::Take),
        4 => (1_usize..2_000).prop_map(Step::Pass),
        2 => (0_u64..30_000).prop_map(|us| Step::Wait(Duration::from_micros(us))),
    ];
    prop::collection::vec(step, 1..80)
}

/// One direction, and all its input and output, with the times.
struct Played {
    way: StreamWay,
    now: Time,
    faults: Faults,
    taken: Vec<(Time, Duration, u8)>,
    passed: Vec<u8>,
}

impl Played {
    fn new(seed: u64) -> Self {
        let (faults, now) = (Faults::default(), Time::from_nanos(1_000_000_000));
        let way = StreamWay::new(faults, SeededRandom::new(seed));
        Self { way, now, faults, taken: Vec::new(), passed: Vec::new() }
    }

    fn step(&mut self, step: &Step) {
        match *step {
            Step::Set(faults) => {
                self.faults = faults;
                self.way.set(faults);
            }
            Step::Take(count) => {
                let count = count.min(self.way.room());
                let from = self.taken.len();
                let bytes: Vec<u8> = (from..from + count).map(|index| (index % 251) as u8).collect();
                self.taken.extend(bytes.iter().map(|byte| (self.now, self.faults.delay, *byte)));
                self.way.take(self.now, &bytes);
                assert!(self.taken.len() - self.passed.len() <= stream::HELD_MAX);
            }
            Step::Pass(most) => self.pass(most),
            Step::Wait(time) => self.now = self.now + time,
        }
    }

    fn pass(&mut self, most: usize) {
        let ready = self.way.ready(self.now);
        assert!(ready.is_empty() || !(self.faults.stalled || self.faults.parted), "nothing passes");
        assert!(ready.len() <= self.faults.segment_max.map_or(usize::MAX, usize::from));
        let count = ready.len().min(most);
        for (index, byte) in ready[..count].iter().enumerate() {
            let (came, delay, _) = self.taken[self.passed.len() + index];
            assert!(self.now.since(came) >= delay, "byte {byte} is too early");
        }
        self.passed.extend_from_slice(&ready[..count]);
        if count > 0 {
            self.way.passed(self.now, count);
        }
    }

    /// Lets time pass until no bytes are held any more.
    fn finish(&mut self) {
        self.step(&Step::Set(Faults::default()));
        while let Some(wake) = self.way.next_wake() {
            self.now = self.now.max(wake);
            assert!(!self.way.ready(self.now).is_empty(), "it wakes where something is ready");
            self.pass(usize::MAX);
        }
    }
}

proptest! {
    #[test]
    fn bytes_pass_complete_and_in_order_despite_faults(steps in steps(), seed in any::<u64>()) {
        let mut played = Played::new(seed);
        for step in &steps {
            played.step(step);
            let so_far: Vec<u8> = played.taken.iter().map(|(_, _, byte)| *byte).collect();
            prop_assert_eq!(&played.passed[..], &so_far[..played.passed.len()]);
        }
        played.finish();
        prop_assert_eq!(played.passed.len(), played.taken.len());
        prop_assert!(played.way.is_empty());
        prop_assert_eq!(played.way.new_flips(), 0);
    }

    #[test]
    fn same_seed_gives_same_faults(steps in steps(), seed in any::<u64>()) {
        let play = || {
            let mut played = Played::new(seed);
            let mut ready = Vec::new();
            for step in &steps {
                played.step(step);
                ready.push((played.way.ready(played.now).len(), played.way.next_wake()));
            }
            ready
        };
        prop_assert_eq!(play(), play());
    }

    #[test]
    fn flipped_bits_are_counted(seed in any::<u64>(), one_in in 1_u32..200, length in 1_usize..4_000) {
        let flipping = Faults { one_flip_in: NonZeroU32::new(one_in), ..Faults::default() };
        let mut way = StreamWay::new(flipping, SeededRandom::new(seed));
        let (now, bytes) = (Time::ZERO, vec![0x5a; length]);
        way.take(now, &bytes);
        let differ: u32 = way.ready(now).iter().map(|byte| (byte ^ 0x5a).count_ones()).sum();
        prop_assert_eq!(u64::from(differ), way.new_flips());
        prop_assert!(one_in > 1 || differ as usize == length);
    }

    #[test]
    fn rate_limit_is_never_exceeded(rate in 1_u64..100_000, looks in prop::collection::vec(0_u64..50_000, 1..60)) {
        let slow = Faults { bytes_per_second: NonZeroU64::new(rate), ..Faults::default() };
        let mut way = StreamWay::new(slow, SeededRandom::new(1));
        let (began, mut now, mut passed) = (Time::ZERO, Time::ZERO, 0_u64);
        way.take(now, &vec![7; 100_000]);
        for look in looks {
            now = now + Duration::from_micros(look);
            let ready = way.ready(now).len();
            way.passed(now, ready);
            passed += ready as u64;
            let in_a_slice = rate / 1_000 + 1;
            let allowed = (rate as f64 * now.since(began).as_secs_f64()) as u64 + in_a_slice;
            prop_assert!(passed <= allowed, "{} of {}", passed, allowed);
        }
    }

    #[test]
    fn each_datagram_passes_once_or_counts_as_lost(steps in steps(), seed in any::<u64>()) {
        let mut way = DatagramWay::new(Faults::default(), SeededRandom::new(seed));
        let (mut now, mut taken, mut passed) = (Time::ZERO, 0_u64, Vec::new());
        for step in steps {
            match step {
                Step::Set(faults) => way.set(faults),
                Step::Take(length) => {
                    way.take(now, taken, vec![0; length]);
                    taken += 1;
                }
                Step::Pass(_) => passed.extend(way.pass(now).map(|(number, _)| number)),
                Step::Wait(time) => now = now + time,
            }
        }
        way.set(Faults::default());
        while let Some(wake) = way.next_wake() {
            now = now.max(wake);
            passed.extend(way.pass(now).map(|(number, _)| number));
        }
        let (lost, _) = way.new_lost_and_flips();
        prop_assert_eq!(passed.len() as u64 + lost, taken);
        passed.sort_unstable();
        passed.dedup();
        prop_assert_eq!(passed.len() as u64 + lost, taken);
    }
}

#[test]
fn datagrams_beyond_the_queue_limit_are_lost() {
    let stalled = Faults { stalled: true, ..Faults::default() };
    let mut way = DatagramWay::new(stalled, SeededRandom::new(1));
    for number in 0..datagrams::HELD_MAX + 3 {
        way.take(Time::ZERO, number, vec![1]);
    }
    assert_eq!(way.new_lost_and_flips(), (3, 0));
    assert_eq!(way.pass(Time::MAX), None, "stalled");
    way.set(Faults::default());
    assert_eq!(way.pass(Time::MAX), Some((0, vec![1])));
}

#[test]
fn commands_are_parsed_and_nonsense_is_rejected() {
    let second = Change::Delay(Duration::from_secs(1));
    for (text, word) in [
        ("cut", NetworkCommand::Cut(Cut::Reset)),
        ("cut fin", NetworkCommand::Cut(Cut::Finish)),
        ("refuse", NetworkCommand::Refuse(true)),
        ("accept", NetworkCommand::Refuse(false)),
        ("heal", NetworkCommand::Heal),
        ("stall", NetworkCommand::Change(None, Change::Stall)),
        ("left stall", NetworkCommand::Change(Some(Side::Left), Change::Stall)),
        ("right part", NetworkCommand::Change(Some(Side::Right), Change::Part)),
        ("right delay 1000", NetworkCommand::Change(Some(Side::Right), second)),
        ("lose 20", NetworkCommand::Change(None, Change::Lose(NonZeroU32::new(20)))),
        ("jitter 5", NetworkCommand::Change(None, Change::Jitter(Duration::from_millis(5)))),
        ("chop 1", NetworkCommand::Change(None, Change::Chop(NonZeroUsize::new(1)))),
        ("corrupt 0", NetworkCommand::Change(None, Change::Corrupt(None))),
        ("throttle 9", NetworkCommand::Change(None, Change::Throttle(NonZeroU64::new(9)))),
        ("left heal", NetworkCommand::Change(Some(Side::Left), Change::Heal)),
    ] {
        assert_eq!(text.parse(), Ok(word), "{text}");
    }
    for nonsense in ["", "cut it", "delay", "delay -1", "left", "up stall", "chop x"] {
        assert!(nonsense.parse::<NetworkCommand>().unwrap_err().contains("legal is"), "{nonsense}");
    }
}

/// A network with a listener for connections and one for datagrams, both to the right.
fn network() -> FaultyNetwork {
    let listen = SocketAddr::from(([127, 0, 0, 1], 0));
    let listener = |datagrams| Listener { side: Side::Right, listen, datagrams };
    FaultyNetwork::start(&[listener(false), listener(true)], 7).unwrap()
}

/// Both ends of a connection through it.
fn connection(network: &FaultyNetwork) -> (TcpStream, TcpStream) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    network.set_destination(0, listener.local_addr().unwrap());
    let near = TcpStream::connect(network.address(0)).unwrap();
    let (far, _) = listener.accept().unwrap();
    for end in [&near, &far] {
        end.set_read_timeout(Some(DEADLINE)).unwrap();
    }
    (near, far)
}

fn exchange(near: &mut TcpStream, far: &mut TcpStream) {
    let exchange = |from: &mut TcpStream, to: &mut TcpStream| {
        from.write_all(b"hello").unwrap();
        let mut received = [0; 5];
        to.read_exact(&mut received).unwrap();
        assert_eq!(&received, b"hello");
    };
    exchange(near, far);
    exchange(far, near);
}

#[test]
fn proxy_forwards_both_directions_and_half_close() {
    let network = network();
    let (mut near, mut far) = connection(&network);
    exchange(&mut near, &mut far);
    near.shutdown(std::net::Shutdown::Write).unwrap();
    assert_eq!(far.read(&mut [0]).unwrap(), 0);
    far.write_all(b"last").unwrap();
    let mut received = [0; 4];
    near.read_exact(&mut received).unwrap();
    assert_eq!(&received, b"last");
    until("all is counted", || (network.counts().passed == [9, 5]).then_some(()));
}

#[test]
fn cut_ends_only_existing_connections() {
    let network = network();
    let (mut near, mut far) = connection(&network);
    exchange(&mut near, &mut far);
    network.cut(Cut::Reset);
    for end in [&mut near, &mut far] {
        assert_eq!(end.read(&mut [0]).unwrap_err().kind(), io::ErrorKind::ConnectionReset);
    }
    let (mut near, mut far) = connection(&network);
    exchange(&mut near, &mut far);
    network.cut(Cut::Finish);
    assert_eq!((near.read(&mut [0]).unwrap(), far.read(&mut [0]).unwrap()), (0, 0));
    until("both are counted", || (network.counts().cut == 2 && network.counts().open == 0).then_some(()));
    assert_eq!(network.counts().made, 2);
}

#[test]
fn parted_direction_delivers_after_healing() {
    let network = network();
    let (mut near, mut far) = connection(&network);
    exchange(&mut near, &mut far);
    network.execute("right part".parse().unwrap());
    near.write_all(b"later").unwrap();
    far.write_all(b"now").unwrap();
    let mut received = [0; 3];
    near.read_exact(&mut received).unwrap();
    far.set_nonblocking(true).unwrap();
    assert_eq!(far.read(&mut [0; 5]).unwrap_err().kind(), io::ErrorKind::WouldBlock);
    far.set_nonblocking(false).unwrap();
    network.heal();
    let mut received = [0; 5];
    far.read_exact(&mut received).unwrap();
    assert_eq!(&received, b"later");
}

#[test]
fn refused_client_can_connect_again_later() {
    let network = network();
    let (mut near, mut far) = connection(&network);
    network.execute("refuse".parse().unwrap());
    let refused = || match TcpStream::connect(network.address(0)) {
        Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => Some(()),
        Ok(_) | Err(_) => None,
    };
    until("nobody listens", refused);
    exchange(&mut near, &mut far);
    network.execute("accept".parse().unwrap());
    until("somebody listens", || TcpStream::connect(network.address(0)).ok());
}

#[test]
fn unreachable_destination_resets_the_client() {
    let network = network();
    let mut near = TcpStream::connect(network.address(0)).unwrap();
    near.set_read_timeout(Some(DEADLINE)).unwrap();
    assert_eq!(near.read(&mut [0]).unwrap_err().kind(), io::ErrorKind::ConnectionReset);
}

#[test]
fn datagram_answers_come_from_the_door() {
    let (network, node) = (network(), UdpSocket::bind("127.0.0.1:0").unwrap());
    network.set_destination(1, node.local_addr().unwrap());
    let asks = UdpSocket::bind("127.0.0.1:0").unwrap();
    for socket in [&node, &asks] {
        socket.set_read_timeout(Some(DEADLINE)).unwrap();
    }
    let mut buffer = [0; 16];
    for round in 0..3 {
        asks.send_to(&[round], network.address(1)).unwrap();
        let (length, from) = node.recv_from(&mut buffer).unwrap();
        assert_eq!(&buffer[..length], &[round]);
        node.send_to(&[round, round], from).unwrap();
        assert_eq!(asks.recv_from(&mut buffer).unwrap(), (2, network.address(1)));
    }
    network.change(Side::Right, |faults| faults.parted = true);
    until("one is lost", || {
        asks.send_to(&[9], network.address(1)).unwrap();
        (network.counts().lost > 0).then_some(())
    });
}
