//! What the library says of itself while it works: lines on the standard error.

use std::{
    io::{IsTerminal, stderr},
    sync::Once,
};

use tracing_subscriber::EnvFilter;

/// The environment variable that says how much.
const WANTED: &str = "SINEW_LOG";
/// If it says nothing, or nothing that can be read.
const USUAL: &str = "warn";

/// Begins at the first call. A process that has a log of Rust's already keeps that one.
pub(crate) fn begin() {
    static BEGUN: Once = Once::new();
    BEGUN.call_once(|| {
        let wanted = EnvFilter::try_from_env(WANTED).unwrap_or_else(|_| EnvFilter::new(USUAL));
        let log = tracing_subscriber::fmt().with_env_filter(wanted).with_writer(stderr);
        // An error means that there is one.
        let _ = log.with_ansi(stderr().is_terminal()).try_init();
    });
}
