//! A network between hosts that loses and delays each frame independently, as radio does, for kernels without
//! `netem`.
//!
//! A host's interface is a TAP device that ends in this process. One thread carries the frames. Each frame is
//! dropped at random, or forwarded after a random delay, so that a later frame may overtake it, as with
//! `netem`.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BinaryHeap},
    fs::File,
    io,
    os::fd::AsFd,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use fastrand::Rng;
use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    thread::{LinkNameSpaceType, move_into_link_name_space},
};
use tun_rs::{DeviceBuilder, Layer, SyncDevice};

/// Maximum length of a frame: an Ethernet header and 1,500 bytes.
const FRAME_MAX: usize = 1_514;
/// Frames read from one host before the other hosts get their turn.
const FRAMES_A_TURN: usize = 64;
/// Maximum number of frames in flight. Further frames are dropped, as with a full queue.
const UNDER_WAY_MAX: usize = 16_384;
/// Maximum sleep of the thread between checks for shutdown.
const LOOK: Duration = Duration::from_millis(20);
/// Length of a MAC address, in bytes.
const MAC: usize = 6;
/// MAC address prefixes of IPv4 multicast (RFC 1112) and of IPv6 multicast (RFC 2464).
const MULTICAST: [&[u8]; 2] = [&[0x01, 0x00, 0x5e], &[0x33, 0x33]];

/// Loss and delay of each frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Weather {
    /// Fraction of frames that are lost, 0 to 1.
    pub loss: f64,
    /// Mean delay.
    pub delay: Duration,
    /// Maximum deviation from the mean delay, uniformly distributed.
    pub jitter: Duration,
}

/// Frame counters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Carried {
    /// Delivered frames.
    pub arrived: u64,
    /// Frames lost at random.
    pub lost: u64,
    /// Frames dropped because a queue was full.
    pub dropped: u64,
}

/// The network. Dropping it removes the interfaces.
#[derive(Debug)]
pub struct Radio {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    weather: Mutex<Weather>,
    ends: AtomicBool,
    drops_multicast: AtomicBool,
    arrived: AtomicU64,
    lost: AtomicU64,
    dropped: AtomicU64,
}

impl Radio {
    /// Creates in each of the namespaces an interface called `interface` on one network. The interfaces are
    /// down and have no address. `seed` seeds all random decisions.
    ///
    /// # Errors
    /// A sentence: missing privileges, or a kernel without TAP devices.
    pub fn between(namespaces: &[File], interface: &str, seed: u64) -> Result<Self, String> {
        let taps =
            namespaces.iter().map(|namespace| tap_in(namespace, interface)).collect::<Result<_, _>>()?;
        let shared = Arc::new(Shared::default());
        let carrier = Carrier {
            taps,
            homes: BTreeMap::new(),
            under_way: BinaryHeap::new(),
            chance: Rng::with_seed(seed),
            number: 0,
            shared: shared.clone(),
        };
        let thread = thread::Builder::new().name("radio".to_owned()).spawn(move || carrier.run());
        let thread = thread.map_err(|error| format!("no thread for a network: {error}"))?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// Applies this weather to every frame from now on.
    pub fn set(&self, weather: Weather) {
        *self.shared.weather.lock().unwrap_or_else(PoisonError::into_inner) = weather;
    }

    /// Drops all multicast from now on, as many access points do. ARP is broadcast and is still forwarded.
    /// Dropped frames count as lost.
    pub fn drop_multicast(&self) {
        self.shared.drops_multicast.store(true, Ordering::Relaxed);
    }

    /// The frame counters so far.
    #[must_use]
    pub fn carried(&self) -> Carried {
        let [arrived, lost, dropped] = [&self.shared.arrived, &self.shared.lost, &self.shared.dropped]
            .map(|counter| counter.load(Ordering::Relaxed));
        Carried { arrived, lost, dropped }
    }
}

impl Drop for Radio {
    fn drop(&mut self) {
        self.shared.ends.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // The result of the thread carries no information.
            let _ = thread.join();
        }
    }
}

/// Creates an interface in a namespace, and returns the TAP device at its other end.
fn tap_in(namespace: &File, interface: &str) -> Result<SyncDevice, String> {
    // In a dedicated thread: it stays in the namespace that it has entered.
    let made = thread::scope(|scope| {
        let make = || -> io::Result<SyncDevice> {
            move_into_link_name_space(namespace.as_fd(), Some(LinkNameSpaceType::Network))?;
            let device =
                DeviceBuilder::new().name(interface).layer(Layer::L2).inherit_enable_state().build_sync()?;
            device.set_nonblocking(true)?;
            Ok(device)
        };
        scope
            .spawn(make)
            .join()
            .unwrap_or_else(|_| Err(io::Error::other("the maker of a TAP device panicked")))
    });
    made.map_err(|error| format!("no TAP device {interface}: {error}"))
}

/// A delayed frame: due time, sequence number, destination, bytes.
type Waiting = Reverse<(Instant, u64, usize, Vec<u8>)>;

struct Carrier {
    taps: Vec<SyncDevice>,
    /// The interface at which each MAC address was last seen.
    homes: BTreeMap<[u8; MAC], usize>,
    under_way: BinaryHeap<Waiting>,
    chance: Rng,
    number: u64,
    shared: Arc<Shared>,
}

impl Carrier {
    fn run(mut self) {
        while !self.shared.ends.load(Ordering::Relaxed) {
            self.deliver(Instant::now());
            self.wait();
            for from in 0..self.taps.len() {
                self.read(from);
            }
        }
    }

    fn wait(&self) {
        let next =
            self.under_way.peek().map(|Reverse((due, ..))| due.saturating_duration_since(Instant::now()));
        let sleep = next.unwrap_or(LOOK).min(LOOK);
        let mut watched: Vec<PollFd<'_>> =
            self.taps.iter().map(|tap| PollFd::new(tap, PollFlags::IN)).collect();
        let sleep = Timespec { tv_sec: 0, tv_nsec: i64::from(sleep.subsec_nanos()) };
        // If interrupted, the loop checks again.
        let _ = poll(&mut watched, Some(&sleep));
    }

    /// Reads the frames that a host has sent.
    fn read(&mut self, from: usize) {
        let mut frame = [0; FRAME_MAX];
        // Bounded, so that a host that sends continuously does not block the others.
        for _ in 0..FRAMES_A_TURN {
            let Ok(length) = self.taps[from].recv(&mut frame) else { return };
            // Read after the frame, so that a frame sent after `set` gets the new weather.
            let weather = *self.shared.weather.lock().unwrap_or_else(PoisonError::into_inner);
            let Some((to, rest)) = frame[..length].split_first_chunk::<MAC>() else { continue };
            let Some(source) = rest.first_chunk::<MAC>() else { continue };
            self.homes.insert(*source, from);
            let is_multicast = MULTICAST.iter().any(|begin| to.starts_with(begin));
            if is_multicast && self.shared.drops_multicast.load(Ordering::Relaxed) {
                self.shared.lost.fetch_add(1, Ordering::Relaxed);
                continue;
            }
            match self.homes.get(to).copied() {
                Some(home) if home != from => self.send(home, &frame[..length], weather),
                Some(_) => {}
                // Broadcast, or an unknown destination. Each receiver gets or loses the frame independently.
                None => (0..self.taps.len())
                    .filter(|other| *other != from)
                    .for_each(|other| self.send(other, &frame[..length], weather)),
            }
        }
    }

    fn send(&mut self, to: usize, frame: &[u8], weather: Weather) {
        if self.chance.f64() < weather.loss {
            self.shared.lost.fetch_add(1, Ordering::Relaxed);
            return;
        }
        if weather.delay.is_zero() && weather.jitter.is_zero() {
            self.hand_over(to, frame);
            return;
        }
        if self.under_way.len() >= UNDER_WAY_MAX {
            self.shared.dropped.fetch_add(1, Ordering::Relaxed);
            return;
        }
        let spread = weather.jitter.mul_f64(2.0 * self.chance.f64());
        let delay = (weather.delay + spread).saturating_sub(weather.jitter);
        self.number += 1;
        self.under_way.push(Reverse((Instant::now() + delay, self.number, to, frame.to_vec())));
    }

    fn deliver(&mut self, now: Instant) {
        while let Some(Reverse((due, ..))) = self.under_way.peek()
            && *due <= now
            && let Some(Reverse((_, _, to, frame))) = self.under_way.pop()
        {
            self.hand_over(to, &frame);
        }
    }

    fn hand_over(&self, to: usize, frame: &[u8]) {
        // An interface that is down accepts no frames.
        let counter =
            if self.taps[to].send(frame).is_ok() { &self.shared.arrived } else { &self.shared.dropped };
        counter.fetch_add(1, Ordering::Relaxed);
    }
}
