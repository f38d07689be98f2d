//! A hostile client for tests: `sinew-zenoh-spy ROUTER SECONDS NEEDLE..`. It reads all puts of all projects,
//! looks for the needles in them, and puts altered copies, replays and plain packets under the same keys. It
//! prints `puts N forged N found N`.

use std::{
    io::Write as _,
    process::ExitCode,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    thread,
    time::Duration,
};

use sinew_zenoh::{
    config::Tls,
    session::{Role, SessionError, open},
};
use zenoh::{
    Wait,
    sample::{Locality, Sample},
};

const LEASE: Duration = Duration::from_secs(2);
/// Of so many puts one is forged in three ways.
const FORGED_EVERY: u64 = 8;

#[derive(Default)]
struct Seen {
    puts: AtomicU64,
    forged: AtomicU64,
    found: AtomicU64,
}

fn main() -> ExitCode {
    zenoh::init_log_from_env_or("warn");
    let arguments: Vec<_> = std::env::args().skip(1).collect();
    let [router, seconds, needles @ ..] = &arguments[..] else { return usage() };
    let Ok(time) = seconds.parse().map(Duration::from_secs) else { return usage() };
    match spy(router.clone(), time, needles.to_vec()) {
        Ok(seen) => {
            let [puts, forged, found] =
                [&seen.puts, &seen.forged, &seen.found].map(|counter| counter.load(Ordering::Relaxed));
            // The reader of this line may have ended.
            let _ = writeln!(std::io::stdout(), "puts {puts} forged {forged} found {found}");
            ExitCode::SUCCESS
        }
        Err(error) => {
            tracing::error!("{error}");
            ExitCode::FAILURE
        }
    }
}

fn spy(router: String, time: Duration, needles: Vec<String>) -> Result<Arc<Seen>, SessionError> {
    let session = open(Role::Client { routers: &[router], tls: &Tls::default() }, LEASE)?;
    let seen = Arc::new(Seen::default());
    let (counters, forger) = (seen.clone(), session.clone());
    let callback = move |sample: Sample| {
        let payload = sample.payload().to_bytes();
        let number = counters.puts.fetch_add(1, Ordering::Relaxed);
        let contains = |needle: &String| {
            !needle.is_empty() && payload.windows(needle.len()).any(|bytes| bytes == needle.as_bytes())
        };
        if needles.iter().any(contains) {
            counters.found.fetch_add(1, Ordering::Relaxed);
        }
        if number % FORGED_EVERY != 0 {
            return;
        }
        let mut altered = payload.to_vec();
        if let Some(last) = altered.last_mut() {
            *last ^= 1;
        }
        let plain = [&[0][..], &payload[..]].concat();
        for forged in [altered, payload.to_vec(), plain] {
            let put = forger.put(sample.key_expr(), forged).allowed_destination(Locality::Remote);
            if put.wait().is_ok() {
                counters.forged.fetch_add(1, Ordering::Relaxed);
            }
        }
    };
    let subscriber = session.declare_subscriber("sinew/**").callback(callback).wait()?;
    thread::sleep(time);
    subscriber.undeclare().wait()?;
    Ok(seen)
}

fn usage() -> ExitCode {
    tracing::error!("usage: sinew-zenoh-spy ROUTER SECONDS [NEEDLE..]");
    ExitCode::from(2)
}
