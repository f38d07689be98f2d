//! The user's request to stop: Ctrl-C, or SIGTERM.

use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use sinew::signals::StopSignals;

/// Whether the user has asked for the end.
pub(crate) struct StopRequest(Arc<AtomicBool>);

impl StopRequest {
    /// Handles the signals from now on.
    pub(crate) fn listen() -> io::Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let mut signals = {
            let _inside = runtime.enter();
            StopSignals::listen()?
        };
        let asked = Arc::new(AtomicBool::new(false));
        let ours = Arc::clone(&asked);
        // It ends with the process, where no signal comes.
        std::thread::Builder::new().name("signals".to_owned()).spawn(move || {
            runtime.block_on(signals.recv());
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
