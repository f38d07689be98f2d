//! The recording of one incarnation of a node, through its client socket.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use sinew::{Endpoint, NodeApi, Registration, Tid, Time};
use sinew_recorder::{
    Compression, End, FileOptions, RecordingError, RecordingOptions, Session, Summary, Totals,
};

use super::KnownNames;

/// Maximum bytes of one file: a long walk must not fill the disk. Messages beyond it are counted as dropped.
const SIZE_MAX: u64 = 2 << 30;
/// Time limit for the registration.
const BEGUN_WITHIN: Duration = Duration::from_secs(2);
/// Time for the node to know the names of all applications. The journal keeps the messages meanwhile: they are few
/// before the walk.
const NAMED_WITHIN: Duration = Duration::from_secs(5);
/// Interval at which the node is asked for them.
const NAMED_PERIOD: Duration = Duration::from_millis(50);

/// The file of one incarnation.
#[derive(Debug)]
pub(super) struct NodeFile {
    pub(super) path: PathBuf,
    pub(super) totals: Totals,
}

/// Starts the recording of the node at this socket; `None`: no node is there.
pub(super) fn begin(
    socket: &Path,
    path: &Path,
    known: &KnownNames,
) -> Result<Option<Session<Endpoint>>, RecordingError> {
    let Ok(node) = NodeApi::connect(socket) else { return Ok(None) };
    let registration = Registration::new().deadline(BEGUN_WITHIN).without_reconnect();
    let endpoint = node
        .register_transport_address(registration)
        .map_err(|why| RecordingError::NoAnswer(format!("{why}; a node that is ending is no fault")))?;
    // The robot walks on the same CPUs: the least work counts, not the smallest file. A file of this name is that of
    // an attempt which failed below.
    let file = FileOptions {
        compression: Compression::Lz4,
        size_max: Some(SIZE_MAX),
        replace: true,
        ..FileOptions::default()
    };
    let options = RecordingOptions {
        path: Some(path.to_owned()),
        file,
        goes_on_when_full: true,
        program: concat!("exoskeleton ", env!("CARGO_PKG_VERSION")).to_owned(),
        ..RecordingOptions::default()
    };
    let mut session = Session::begin(endpoint, options)?;
    let names = session.names_mut();
    known.groups.iter().for_each(|group| names.add_app(Tid::group(group), group));
    known.types.iter().for_each(|(kind, name)| names.add_type(*kind, name));
    Ok(Some(session))
}

/// Records until the node ends or `stop` is set, and finishes the file.
pub(super) fn run(
    mut session: Session<Endpoint>,
    known: &KnownNames,
    stop: &AtomicBool,
    fault: &mut impl FnMut(String),
) -> NodeFile {
    await_names(&mut session, known, stop);
    let end = loop {
        if stop.load(Ordering::Relaxed) {
            break End::Asked;
        }
        if let Some(end) = session.step() {
            break end;
        }
    };
    let Summary { file: path, end, totals, faults, .. } = session.finish(end);
    faults.into_iter().for_each(&mut *fault);
    if let End::Unreadable(_) = end {
        fault(end.to_string());
    }
    NodeFile { path, totals }
}

/// Asks for names until the node knows all applications. A channel keeps the names of its first message.
fn await_names(session: &mut Session<Endpoint>, known: &KnownNames, stop: &AtomicBool) {
    let until = Time::now() + NAMED_WITHIN;
    while Time::now() < until && !stop.load(Ordering::Relaxed) {
        let names = session.names_mut();
        if known.apps.iter().all(|app| names.has_app(app)) {
            return;
        }
        std::thread::sleep(NAMED_PERIOD);
        session.refresh_names();
    }
}
