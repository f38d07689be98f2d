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
use sinew_model::config::NodeConfig;
use sinew_runtime::log;

use crate::{
    RecordingError,
    session::{Connection, End, RecordingOptions, Session, Summary},
};

/// Time limit for the end of a recording: 10 s for the rest of the journal, the rest for the file.
const FINISHED_WITHIN: Duration = Duration::from_secs(15);
/// Time limit for the connection to a node that has started.
const CONNECTED_WITHIN: Duration = Duration::from_secs(2);

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

    /// Starts the recording that the configuration of a running node asks for, through its socket; `None` without
    /// `record.file`. The program states it to its node before: `NodeBuilder::writes_recording`.
    ///
    /// # Errors
    /// `lncl.socket` is not set, the node does not record, or the file cannot be made.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew_model::config::NodeConfig;
    /// use sinew_recorder::Recording;
    ///
    /// /// Runs in the program of the node, from its start to its end.
    /// fn record(config: &NodeConfig, wait_for_end: impl FnOnce()) -> Result<(), Box<dyn std::error::Error>> {
    ///     let recording = Recording::configured(config)?;
    ///     wait_for_end();
    ///     if let Some(recording) = recording {
    ///         println!("{} messages", recording.finish()?.totals.written);
    ///     }
    ///     Ok(())
    /// }
    /// ```
    pub fn configured(config: &NodeConfig) -> Result<Option<Self>, RecordingError> {
        let Some(mut options) = RecordingOptions::configured(&config.record) else { return Ok(None) };
        options.program = concat!("sinew-recorder ", env!("CARGO_PKG_VERSION")).to_owned();
        let Some(socket) = &config.lncl.socket else {
            let why = "record.file is set, and lncl.socket is not: set it, the recorder connects through it";
            return Err(RecordingError::NoAnswer(why.to_owned()));
        };
        let node = NodeApi::connect_trusted(socket, CONNECTED_WITHIN)
            .map_err(|why| RecordingError::NoAnswer(why.to_string()))?;
        Self::begin(&node, options).map(Some)
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
    let file = session.file().display().to_string();
    let mut logged = 0;
    let end = loop {
        if is_over.load(Ordering::Relaxed) {
            break End::Asked;
        }
        let end = session.step();
        for fault in &session.faults()[logged..] {
            log::warn!(file, "recording: {fault}");
        }
        logged = session.faults().len();
        if let Some(end) = end {
            log::info!(file, "the recording has ended: {end}");
            break end;
        }
    };
    session.finish(end)
}
