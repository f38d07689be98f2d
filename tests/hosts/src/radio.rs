//! A network between hosts that loses and delays packets, as radio does: each frame by itself, for kernels without `netem`.
//!
//! A host's interface is a TAP device whose other end is here. One thread carries the frames: each is lost by chance, or goes on after
//! a delay of its own, so that a later one may overtake it, as with `netem`.

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

/// Longest frame: an Ethernet header and 1,500 bytes.
const FRAME_MAX: usize = 1_514;
/// Frames that are taken of a host before the others have their turn.
const FRAMES_A_TURN: usize = 64;
/// Frames that are on their way at most; what comes then is lost, as in a full queue.
const UNDER_WAY_MAX: usize = 16_384;
/// Longest sleep of the thread: it looks whether it is to end.
const LOOK: Duration = Duration::from_millis(20);
/// Bytes of a hardware address.
const MAC: usize = 6;
/// How the hardware addresses of IPv4 multicast begin (RFC 1112), and of IPv6 multicast (RFC 2464).
const MULTICAST: [&[u8]; 2] = [&[0x01, 0x00, 0x5e], &[0x33, 0x33]];

/// What happens to each frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Weather {
    /// Share of frames that are lost, 0 to 1.
    pub loss: f64,
    /// Mean time on the way.
    pub delay: Duration,
    /// How much more or less it is at most, evenly spread.
    pub jitter: Duration,
}

/// What became of the frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Carried {
    /// They arrived.
    pub arrived: u64,
    /// They were lost by chance.
    pub lost: u64,
    /// They found no room.
    pub dropped: u64,
}

/// The network. It ends, and the interfaces with it, when this is dropped.
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
    /// Gives each of the namespaces an interface called `interface` at one network. They are down, and have no address. All chance comes
    /// from `seed`.
    ///
    /// # Errors
    /// A sentence: no right to, or a kernel without TAP devices.
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

    /// From now on this happens to each frame.
    pub fn set(&self, weather: Weather) {
        *self.shared.weather.lock().unwrap_or_else(PoisonError::into_inner) = weather;
    }

    /// Carries no multicast from now on, as many an access point does not. ARP, which is broadcast, it carries. What it drops counts as lost.
    pub fn drop_multicast(&self) {
        self.shared.drops_multicast.store(true, Ordering::Relaxed);
    }

    /// What became of the frames so far.
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
            // It says nothing that anybody could use.
            let _ = thread.join();
        }
    }
}

/// An interface in a namespace, whose other end is the device.
fn tap_in(namespace: &File, interface: &str) -> Result<SyncDevice, String> {
    // On a thread of its own: it stays in the namespace that it has entered.
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

/// A frame that waits for its time: when, in which order, to whom.
type Waiting = Reverse<(Instant, u64, usize, Vec<u8>)>;

struct Carrier {
    taps: Vec<SyncDevice>,
    /// At which interface a hardware address was seen last.
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
        // Interrupted: it looks again.
        let _ = poll(&mut watched, Some(&sleep));
    }

    /// Takes what a host has sent.
    fn read(&mut self, from: usize) {
        let mut frame = [0; FRAME_MAX];
        // Others have their turn after some: one that sends on and on holds up none.
        for _ in 0..FRAMES_A_TURN {
            let Ok(length) = self.taps[from].recv(&mut frame) else { return };
            // Looked at only now: what is sent after `set` meets what was set.
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
                // To all, or to one who was never heard. Each hears it, or does not, by itself.
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
        // An interface that is down takes nothing.
        let counter =
            if self.taps[to].send(frame).is_ok() { &self.shared.arrived } else { &self.shared.dropped };
        counter.fetch_add(1, Ordering::Relaxed);
    }
}
