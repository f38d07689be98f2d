//! The launcher as an application of central's node in a process of its own: it listens to how things stand.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use sinew::{
    NodeAddress, NodeApi, Payload, Registration, Time,
    client::{ApiError, Received},
};

use crate::joint::{Joint, PerJoint};
use crate::message::DriveStatus;
use crate::part::Part;
use crate::robot::edges::{BarrierStatus, GaitStatus, STATUS};
use crate::robot::topology::Topology;

/// Between two tries to reach a node that is not there.
const RETRY_PERIOD: Duration = Duration::from_millis(100);
/// Longest time until an order to stop is seen.
const RECEIVE_PERIOD: Duration = Duration::from_millis(100);
/// Older news is no news.
const NEWS: Duration = Duration::from_millis(250);

/// The newest that was heard.
#[derive(Debug, Clone, Default)]
pub(super) struct View {
    pub(super) gait: Option<(Time, GaitStatus)>,
    pub(super) drives: PerJoint<Option<(Time, DriveStatus)>>,
    barrier: BTreeMap<Part, (Time, BarrierStatus)>,
}

/// The thread that listens.
pub(super) struct Console {
    view: Arc<Mutex<View>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl View {
    /// Who waits for whom, as told within the last quarter of a second.
    pub(super) fn waiting(&self) -> Vec<String> {
        self.barrier
            .values()
            .filter(|(at, _)| is_news(*at))
            .flat_map(|(_, status)| status.waiting.clone())
            .collect()
    }

    pub(super) fn gait(&self) -> Option<GaitStatus> {
        self.gait.filter(|(at, _)| is_news(*at)).map(|(_, status)| status)
    }

    pub(super) fn drive(&self, joint: Joint) -> Option<DriveStatus> {
        self.drives[joint.index()].filter(|(at, _)| is_news(*at)).map(|(_, status)| status)
    }
}

fn is_news(at: Time) -> bool {
    Time::now().since(at) < NEWS
}

impl Console {
    pub(super) fn start(topology: &Topology) -> io::Result<Self> {
        let view = Arc::new(Mutex::new(View::default()));
        let stop = Arc::new(AtomicBool::new(false));
        let thread = match topology.central.socket.clone() {
            None => None,
            Some(socket) => {
                let listener = Listener {
                    socket,
                    parts: Part::ALL.map(|part| (topology.place(part).address, part)),
                    view: view.clone(),
                    stop: stop.clone(),
                };
                Some(std::thread::Builder::new().name("console".to_owned()).spawn(move || listener.run())?)
            }
        };
        Ok(Self { view, stop, thread })
    }

    pub(super) fn view(&self) -> View {
        self.view.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(super) fn stop(&mut self) {
        // SYNC: Relaxed, the flag carries nothing but itself.
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // It has nothing left to say.
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
    view: Arc<Mutex<View>>,
    stop: Arc<AtomicBool>,
}

impl Listener {
    fn run(&self) {
        while !self.stop.load(Ordering::Relaxed) {
            // Central is not there yet, or is being started again: then there is nothing to show of it.
            let _ = self.listen(&self.socket);
            if !self.stop.load(Ordering::Relaxed) {
                std::thread::sleep(RETRY_PERIOD);
            }
        }
    }

    fn listen(&self, socket: &Path) -> Result<(), ApiError> {
        let registration = Registration::new().name("console").deadline(Duration::from_secs(2));
        let mut endpoint = NodeApi::connect(socket)?.register_transport_address(registration)?;
        endpoint.join(STATUS)?;
        while !self.stop.load(Ordering::Relaxed) {
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
        let mut view = self.view.lock().unwrap_or_else(PoisonError::into_inner);
        // What cannot be read is not shown.
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
