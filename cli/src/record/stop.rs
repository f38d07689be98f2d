//! The user's request to stop: Ctrl-C, or SIGTERM.

use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use sinew::signals::StopSignals;
use tokio::signal::unix::{SignalKind, signal};

/// Whether the user has asked for the end.
pub(crate) struct StopRequest(Arc<AtomicBool>);

impl StopRequest {
    /// Handles the signals from now on.
    pub(crate) fn listen() -> io::Result<Self> {
        Self::begin(|| {
            let mut signals = StopSignals::listen()?;
            Ok(async move { _ = signals.recv().await })
        })
    }

    /// Same as [`listen`](Self::listen), but a terminal that closes (SIGHUP) ends the process at once: the reader of
    /// its keys does not return any more, as it tries to read behind the end.
    pub(crate) fn listen_on_terminal() -> io::Result<Self> {
        Self::begin(|| {
            let (mut interrupt, mut terminate) =
                (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
            Ok(async move {
                tokio::select! { _ = interrupt.recv() => {}, _ = terminate.recv() => {} }
            })
        })
    }

    fn begin<F>(listen: impl FnOnce() -> io::Result<F>) -> io::Result<Self>
    where
        F: Future<Output = ()> + Send + 'static,
    {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let request = {
            let _inside = runtime.enter();
            listen()?
        };
        let asked = Arc::new(AtomicBool::new(false));
        let ours = Arc::clone(&asked);
        // It ends with the process, where no signal comes.
        std::thread::Builder::new().name("signals".to_owned()).spawn(move || {
            runtime.block_on(request);
            ours.store(true, Ordering::Relaxed);
        })?;
        Ok(Self(asked))
    }

    /// Returns the flag that is true from the request on.
    pub(crate) fn flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.0)
    }

    pub(crate) fn is_there(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}
