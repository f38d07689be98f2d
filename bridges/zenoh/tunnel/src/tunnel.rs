//! The shell around the link: the TUN device, the session with a router, and the log.

use std::{
    collections::BTreeMap,
    fmt, io,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        mpsc::{RecvTimeoutError, SyncSender, sync_channel},
    },
    thread,
    time::{Duration, Instant},
};

use ring::rand::{SecureRandom, SystemRandom};
use sinew_zenoh_link::{Class, Counts, HostFact, Input, Instance, Link, Output, Target, key};
use tracing::{info, warn};
use tun_rs::{DeviceBuilder, Layer, SyncDevice};
use zenoh::{
    Session, Wait,
    key_expr::KeyExpr,
    qos::CongestionControl,
    sample::{Sample, SampleKind},
};

use crate::{
    config::Config,
    session::{Role, SessionError, open, priority},
};

/// Maximum bytes of a packet, of any MTU.
const PACKET_MAX: usize = 65_535;
/// Maximum number of kept key expressions. At more targets all are made again.
const KEYS_MAX: usize = 4_096;
/// Time between two reports of dropped packets.
const REPORT_EVERY: Duration = Duration::from_secs(60);

/// The cause for which the tunnel ended, or did not start.
#[derive(Debug)]
pub enum TunnelError {
    /// The device cannot be opened.
    Device {
        /// Name of the device.
        interface: String,
        /// The system's error.
        error: io::Error,
    },
    /// The device has ended: it was removed.
    Read(io::Error),
    /// There is no session.
    Session(SessionError),
    /// The system has no random bytes.
    Random,
    /// The system makes no further thread.
    Thread(io::Error),
}

impl fmt::Display for TunnelError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Device { interface, error } => write!(
                f,
                "no TUN device {interface}: {error}; make it once: sudo ip tuntap add dev {interface} mode tun user $USER"
            ),
            Self::Read(error) => write!(f, "the TUN device was removed: {error}; make it again and restart"),
            Self::Session(error) => write!(f, "{error}; check `routers` and `[tls]` in the file"),
            Self::Random => f.write_str("the system gives no random bytes; is /dev/urandom there?"),
            Self::Thread(error) => {
                write!(f, "no thread for the device: {error}; raise the limit of processes")
            }
        }
    }
}

impl std::error::Error for TunnelError {}

impl From<SessionError> for TunnelError {
    fn from(error: SessionError) -> Self {
        Self::Session(error)
    }
}

impl From<zenoh::Error> for TunnelError {
    fn from(error: zenoh::Error) -> Self {
        Self::Session(error.into())
    }
}

/// The parts that the threads of zenoh and of the device share.
struct Shared {
    link: Mutex<Link>,
    keys: Mutex<BTreeMap<Target, KeyExpr<'static>>>,
    device: SyncDevice,
    session: Session,
    config: Config,
    start: Instant,
}

/// Carries packets until the device or the session ends.
///
/// # Errors
/// Returns the cause of the end.
pub fn run(config: Config) -> Result<(), TunnelError> {
    let instance = instance()?;
    let device = device(&config.interface)?;
    info!("waits for one of {:?}", config.routers);
    let session = open(Role::Client { routers: &config.routers, tls: &config.tls }, config.lease)?;
    let link = Mutex::new(Link::new(config.settings.clone(), instance));
    let start = Instant::now();
    let shared = Arc::new(Shared { link, keys: Mutex::default(), device, session, config, start });
    let (project, address) = (&shared.config.settings.project, shared.config.settings.address);

    let receive = |target| {
        let receiver = shared.clone();
        let subscriber = shared.session.declare_subscriber(key::puts_to(project, target));
        subscriber.callback(move |sample| receiver.put_received(&sample)).wait()
    };
    let _own = receive(Target::Host(address))?;
    let _all = receive(Target::All)?;
    let watcher = shared.clone();
    let hosts = shared.session.liveliness().declare_subscriber(key::tokens(project)).history(true);
    let _hosts = hosts.callback(move |sample| watcher.token_changed(&sample)).wait()?;
    // Declared last: hosts that receive it can send at once.
    let _token = shared.session.liveliness().declare_token(key::token(project, address, instance)).wait()?;
    info!("carries {address} over {:?}", shared.config.routers);

    let (ended, end) = sync_channel(1);
    let reader = shared.clone();
    let thread = thread::Builder::new().name("device".to_owned());
    thread.spawn(move || reader.read_packets(&ended)).map_err(TunnelError::Thread)?;
    let mut reported = Counts::default();
    loop {
        match end.recv_timeout(REPORT_EVERY) {
            Ok(error) => return Err(error),
            Err(RecvTimeoutError::Disconnected) => {
                return Err(TunnelError::Read(io::Error::other("its thread panicked")));
            }
            Err(RecvTimeoutError::Timeout) => reported = shared.report(reported),
        }
    }
}

fn instance() -> Result<Instance, TunnelError> {
    let mut bytes = [0; 16];
    SystemRandom::new().fill(&mut bytes).map_err(|_| TunnelError::Random)?;
    Ok(Instance(bytes))
}

/// Opens the device, which keeps its addresses and its state. If there is none, one is made, which needs
/// privileges.
fn device(interface: &str) -> Result<SyncDevice, TunnelError> {
    let device = DeviceBuilder::new().name(interface).layer(Layer::L3).inherit_enable_state().build_sync();
    device.map_err(|error| TunnelError::Device { interface: interface.to_owned(), error })
}

impl Shared {
    /// Reads the packets of this host's nodes.
    fn read_packets(&self, ended: &SyncSender<TunnelError>) {
        let mut packet = vec![0; PACKET_MAX];
        let end = loop {
            let result = match self.device.recv(&mut packet) {
                Ok(length) => self.handle(Input::PacketRead(&packet[..length])),
                // A signal has come. It is read again.
                Err(error) if error.kind() == io::ErrorKind::Interrupted => Ok(()),
                Err(error) => Err(TunnelError::Read(error)),
            };
            if let Err(error) = result {
                break error;
            }
        };
        // The receiver has ended only with the program.
        let _ = ended.send(end);
    }

    fn put_received(&self, sample: &Sample) {
        let Some((target, source)) = key::parse_put(sample.key_expr().as_str()) else { return };
        let payload = sample.payload().to_bytes();
        self.handle_or_warn(Input::PutReceived { target, source, payload: &payload });
    }

    fn token_changed(&self, sample: &Sample) {
        let Some((host, instance)) = key::parse_token(sample.key_expr().as_str()) else { return };
        self.handle_or_warn(match sample.kind() {
            SampleKind::Put => Input::HostAppeared(host, instance),
            SampleKind::Delete => Input::HostDisappeared(host, instance),
        });
    }

    fn handle_or_warn(&self, input: Input<'_>) {
        if let Err(error) = self.handle(input) {
            warn!("{error}");
        }
    }

    /// Handles an input, and executes its outputs behind the lock.
    fn handle(&self, input: Input<'_>) -> Result<(), TunnelError> {
        let outputs: Vec<_> = {
            let mut link = lock(&self.link);
            link.handle(self.start.elapsed(), input);
            std::iter::from_fn(|| link.poll()).collect()
        };
        outputs.into_iter().try_for_each(|output| self.execute(output))
    }

    fn execute(&self, output: Output) -> Result<(), TunnelError> {
        match output {
            Output::Put { target, class, payload } => self.put(target, class, payload)?,
            // The device is down: its packets are lost, as on any interface.
            Output::Write(packet) => drop(self.device.send(&packet)),
            Output::Host(HostFact::Appeared(host)) => info!("host {host} appeared"),
            Output::Host(HostFact::Disappeared(host)) => info!("host {host} disappeared"),
            Output::Host(HostFact::AddressTaken(instance)) => warn!(
                "another host has this host's address {} (its instance is {instance}); give each host its own",
                self.config.settings.address
            ),
        }
        Ok(())
    }

    /// Puts a packet. A full queue, or no router, drops it, as a full interface does: TCP sends it again.
    fn put(&self, target: Target, class: Class, payload: Vec<u8>) -> Result<(), TunnelError> {
        let key = self.key_of(target)?;
        let put = self.session.put(&key, payload).priority(priority(class));
        let put = put.congestion_control(CongestionControl::Drop).express(class != Class::Bulk);
        match put.wait() {
            Err(error) if self.session.is_closed() => Err(error.into()),
            Ok(()) | Err(_) => Ok(()),
        }
    }

    fn key_of(&self, target: Target) -> Result<KeyExpr<'static>, TunnelError> {
        let mut keys = lock(&self.keys);
        if let Some(key) = keys.get(&target) {
            return Ok(key.clone());
        }
        if keys.len() >= KEYS_MAX {
            keys.clear();
        }
        let settings = &self.config.settings;
        let key = KeyExpr::try_from(key::put(&settings.project, target, settings.address))?;
        keys.insert(target, key.clone());
        Ok(key)
    }

    /// Logs each unexpected cause of drops that occurred since the last report. Returns the present counters.
    fn report(&self, before: Counts) -> Counts {
        let counts = lock(&self.link).counts().clone();
        for (cause, count) in &counts.dropped {
            let new = count - before.dropped_for(*cause);
            if new > 0 && !cause.is_expected() {
                warn!("dropped {new}: {cause}");
            }
        }
        counts
    }
}

fn lock<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}
