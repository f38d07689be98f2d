//! The launcher as an application of central's node in a process of its own: it receives the statuses.

use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use exoskeleton_model::joint::{Joint, PerJoint};
use exoskeleton_model::message::DriveStatus;
use exoskeleton_model::part::Part;
use sinew::{
    NodeAddress, NodeApi, Payload, Registration, Time,
    client::{ApiError, Received},
};

use crate::robot::edges::{BarrierStatus, GaitStatus, STATUS};
use crate::robot::topology::Topology;

/// Time between two attempts to connect to a node that is not running.
const RETRY_PERIOD: Duration = Duration::from_millis(100);
/// Longest time until an order to stop is seen.
const RECEIVE_PERIOD: Duration = Duration::from_millis(100);
/// Maximum age of a status that is shown.
const NEWS: Duration = Duration::from_millis(250);

/// The newest statuses.
#[derive(Debug, Clone, Default)]
pub struct View {
    gait: Option<(Time, GaitStatus)>,
    drives: PerJoint<Option<(Time, DriveStatus)>>,
    barrier: BTreeMap<Part, (Time, BarrierStatus)>,
}

/// The thread that receives.
#[derive(Debug)]
pub struct Console {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    view: Mutex<View>,
    stop: AtomicBool,
}

impl View {
    /// The waiting applications and the ones they wait for, as received within the last quarter of a second.
    #[must_use]
    pub fn waiting(&self) -> Vec<String> {
        self.barrier
            .values()
            .filter(|(at, _)| is_news(*at))
            .flat_map(|(_, status)| status.waiting.clone())
            .collect()
    }

    /// Central's status of the last quarter of a second.
    #[must_use]
    pub fn gait(&self) -> Option<GaitStatus> {
        self.gait.filter(|(at, _)| is_news(*at)).map(|(_, status)| status)
    }

    /// A drive's status of the last quarter of a second.
    #[must_use]
    pub fn drive(&self, joint: Joint) -> Option<DriveStatus> {
        self.drives[joint.index()].filter(|(at, _)| is_news(*at)).map(|(_, status)| status)
    }
}

fn is_news(at: Time) -> bool {
    Time::now().since(at) < NEWS
}

impl Console {
    /// Starts the thread, which connects to central as soon as that runs.
    ///
    /// # Errors
    /// The system provides no thread.
    pub fn start(topology: &Topology) -> io::Result<Self> {
        let shared = Arc::<Shared>::default();
        let parts = Part::ALL.map(|part| (topology.place(part).address, part));
        let listen = |socket| {
            let listener = Listener { socket, parts, shared: shared.clone() };
            std::thread::Builder::new().name("console".to_owned()).spawn(move || listener.run())
        };
        let thread = topology.central.socket.clone().map(listen).transpose()?;
        Ok(Self { shared, thread })
    }

    /// Returns the newest statuses.
    #[must_use]
    pub fn view(&self) -> View {
        self.shared.view.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Ends the thread.
    pub fn stop(&mut self) {
        // SYNC: Relaxed, no other data depends on the flag.
        self.shared.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // It has no result.
            let _ = thread.join();
        }
    }
}

impl Drop for Console {
    fn drop(&mut self) {
        self.stop();
    }
}

struct Listener {
    socket: PathBuf,
    parts: [(NodeAddress, Part); 4],
    shared: Arc<Shared>,
}

impl Listener {
    fn run(&self) {
        while !self.shared.stop.load(Ordering::Relaxed) {
            // Central is not running yet, or is being restarted: then there is nothing to show of it.
            let _ = self.listen();
            if !self.shared.stop.load(Ordering::Relaxed) {
                std::thread::sleep(RETRY_PERIOD);
            }
        }
    }

    fn listen(&self) -> Result<(), ApiError> {
        let registration = Registration::new().name("console").deadline(Duration::from_secs(2));
        let mut endpoint = NodeApi::connect(&self.socket)?.register_transport_address(registration)?;
        endpoint.join(STATUS)?;
        while !self.shared.stop.load(Ordering::Relaxed) {
            if let Some(message) = endpoint.receive(RECEIVE_PERIOD)? {
                self.heed(&message);
            }
        }
        endpoint.unregister()
    }

    fn heed(&self, message: &Received) {
        let Some((_, part)) = self.parts.iter().find(|(address, _)| *address == message.source().node) else {
            return;
        };
        let (kind, now) = (message.kind(), Time::now());
        let mut view = self.shared.view.lock().unwrap_or_else(PoisonError::into_inner);
        // Payloads that cannot be read are not shown.
        if kind == GaitStatus::KIND {
            view.gait = message.decode().ok().map(|status| (now, status));
        } else if kind == BarrierStatus::KIND
            && let Ok(status) = message.decode()
        {
            view.barrier.insert(*part, (now, status));
        } else if kind == DriveStatus::KIND
            && let Part::Joint(joint) = part
        {
            view.drives[joint.index()] = message.decode().ok().map(|status| (now, status));
        }
    }
}
