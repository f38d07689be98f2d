//! What a recording costs the sender of a message: nanoseconds of a call, beside the same call without a recording.
//!
//! `cargo bench -p sinew-record --bench tap`. One thread, back to back, a ring of 64 MiB; the median of 21 runs of
//! 20,000 messages each. Nothing here asserts a time.

use std::{hint::black_box, path::Path, sync::Arc, time::Instant};

use bytes::Bytes;
use sinew_record::{RecordTap, Selection};
use sinew_runtime::{
    outcome::Rejection,
    router::{LocalRoute, MessageSink, Router, SubmitError, tap::TapOf},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Header, Kind, Message},
};
use sinew_shm::journal::{ChannelKey, Journal, Options};

const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
const RUNS: usize = 21;
const MESSAGES: u32 = 20_000;

/// Takes every message, and drops it.
struct Nowhere;

impl MessageSink for Nowhere {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        if black_box(&message).payload.is_empty() {
            return Err(SubmitError::new(message, Rejection::Closed));
        }
        Ok(())
    }
}

/// Prints the median and the spread of one call, in nanoseconds.
fn measure(name: &str, mut call: impl FnMut()) {
    let mut runs = [0.0; RUNS];
    for run in &mut runs {
        let began = Instant::now();
        (0..MESSAGES).for_each(|_| call());
        *run = began.elapsed().as_nanos() as f64 / f64::from(MESSAGES);
    }
    runs.sort_by(f64::total_cmp);
    println!("{name:40} {:7.1} ns ({:.1} to {:.1})", runs[RUNS / 2], runs[0], runs[RUNS - 1]);
}

fn main() {
    let folder = Path::new("/dev/shm");
    let folder = if folder.is_dir() { folder.to_owned() } else { std::env::temp_dir() };
    let path = folder.join(format!("sinew-bench-{}.journal", std::process::id()));
    let journal = Arc::new(Journal::create(&path, &Options::default()).expect("it is made"));
    let router = Router::new(NODE);
    let [source, destination] = [0x1001, 0x1002].map(|app| Tid::new(NODE, AppAddress::new(app)));
    for app in [source, destination] {
        router.set_local(app.app, LocalRoute { sink: Arc::new(Nowhere), events: Arc::new([]) });
    }
    let header = Header::new(Kind::named("bench.message"), source, destination);
    println!("{}", sinew_figures::machine());
    measure("reading the clock", || _ = black_box(Time::now()));
    for bytes in [100, 1_000] {
        let whole = vec![7_u8; bytes];
        let head = sinew_record::message_head(sinew_record::Form::Sent, &header, bytes, None);
        let key = ChannelKey([source.bits(), destination.bits(), 1]);
        measure(&format!("{bytes} bytes: write into the journal"), || {
            journal.write(key, 1, &[&head, &whole]);
        });
        let send = || router.send(Message::new(header, Bytes::from(whole.clone()))).expect("it is taken");
        measure(&format!("{bytes} bytes: send, no recording"), send);
        let all = Selection::default().chosen([], []);
        router.set_tap(TapOf::Recording, Some(Arc::new(RecordTap::new(NODE, journal.clone(), all))));
        measure(&format!("{bytes} bytes: send, recorded"), send);
        let selection = Selection { apps: vec!["other".into()], ..Selection::default() };
        let none = selection.chosen([], []);
        router.set_tap(TapOf::Recording, Some(Arc::new(RecordTap::new(NODE, journal.clone(), none))));
        measure(&format!("{bytes} bytes: send, not selected"), send);
        router.set_tap(TapOf::Recording, None);
    }
    std::fs::remove_file(path).expect("it is there");
}
