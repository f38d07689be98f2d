//! A recording on a thread of its own.

use std::{
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, RecvTimeoutError, sync_channel},
    },
    time::Duration,
};

use sinew_client::{NodeApi, Registration};

use crate::{
    RecordingError,
    session::{Connection, End, RecordingOptions, Session, Summary},
};

/// Time limit for the end of a recording: 10 s for the rest of the journal, the rest for the file.
const FINISHED_WITHIN: Duration = Duration::from_secs(15);

/// A recording of a node, on a thread of its own. Dropping it ends it, without waiting for the end.
///
/// # Examples
///
/// ```no_run
/// use sinew_client::NodeApi;
/// use sinew_recorder::{Recording, RecordingOptions, Selection};
///
/// let node = NodeApi::connect("/run/sinew/knee.sock")?;
/// let selection = Selection { apps: vec!["knee.*".into()], ..Selection::default() };
/// let options = RecordingOptions { path: Some("walk.mcap".into()), selection, ..RecordingOptions::default() };
/// let recording = Recording::begin(&node, options)?;
/// // The robot walks.
/// std::thread::sleep(std::time::Duration::from_secs(10));
/// let summary = recording.finish()?;
/// println!("{} messages, {} dropped", summary.totals.written, summary.totals.dropped);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Recording {
    file: PathBuf,
    is_over: Arc<AtomicBool>,
    ended: Receiver<Summary>,
}

impl Recording {
    /// Starts a recording of the node, through an address of its own.
    ///
    /// # Errors
    /// The node does not register the recorder or does not record, or the file cannot be made.
    pub fn begin(node: &NodeApi, options: RecordingOptions) -> Result<Self, RecordingError> {
        let endpoint = node
            .register_transport_address(Registration::new())
            .map_err(|why| RecordingError::NoAnswer(why.to_string()))?;
        Self::through(endpoint, options)
    }

    /// Starts a recording through this connection to a node.
    ///
    /// # Errors
    /// The node does not record, or the file cannot be made.
    pub fn through<C>(connection: C, options: RecordingOptions) -> Result<Self, RecordingError>
    where
        C: Connection + Send + 'static,
    {
        let session = Session::begin(connection, options)?;
        let file = session.file().to_owned();
        let is_over = Arc::new(AtomicBool::new(false));
        let (sender, ended) = sync_channel(1);
        let is_asked = is_over.clone();
        let thread = std::thread::Builder::new().name("recorder".to_owned());
        // Without a thread the session is dropped, and its lease at the node ends after 5 s.
        thread
            .spawn(move || {
                let summary = run(session, &is_asked);
                // The owner may wait no more.
                let _ = sender.send(summary);
            })
            .map_err(RecordingError::Thread)?;
        Ok(Self { file, is_over, ended })
    }

    /// Returns the file: that of the first part.
    #[must_use]
    pub fn file(&self) -> &Path {
        &self.file
    }

    /// Ends the recording, and waits until the file is finished: for at most 15 s.
    ///
    /// # Errors
    /// It did not end in time, or its thread has panicked. The file can be read up to its last chunk.
    pub fn finish(self) -> Result<Summary, RecordingError> {
        self.finish_within(FINISHED_WITHIN)
    }

    /// Same as [`finish`](Self::finish), with another time limit.
    ///
    /// # Errors
    /// As of [`finish`](Self::finish).
    pub fn finish_within(self, within: Duration) -> Result<Summary, RecordingError> {
        self.is_over.store(true, Ordering::Relaxed);
        self.ended.recv_timeout(within).map_err(|why| match why {
            RecvTimeoutError::Timeout => RecordingError::NotEnded(within),
            RecvTimeoutError::Disconnected => RecordingError::Panicked,
        })
    }
}

impl Drop for Recording {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
    }
}

fn run<C: Connection>(mut session: Session<C>, is_over: &AtomicBool) -> Summary {
    let end = loop {
        if is_over.load(Ordering::Relaxed) {
            break End::Asked;
        }
        if let Some(end) = session.step() {
            break end;
        }
    };
    session.finish(end)
}
