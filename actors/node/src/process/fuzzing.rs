//! Fuzz target: any frame between a node and a process that it started, against the protocol's invariants.

use bytes::Bytes;
use sinew_runtime::{
    fuzzing::is_read_as_written,
    supervision::Reason,
    tid::Tid,
    wire::{Header, Kind, Message, decode},
};

use super::protocol::{Beat, ExitReport, NameLookup, Names, Progress, TEXT_BYTES_MAX, Welcome};

pub fn sent_frames() -> Vec<Vec<u8>> {
    let welcome = Welcome { tid: 1, first_wait: 2, sequence: 3, beat_us: 4, names: Names::default() };
    let written = [
        rmp_serde::to_vec_named(&welcome),
        rmp_serde::to_vec_named(&NameLookup { name: "hip".to_owned() }),
        rmp_serde::to_vec_named(&Beat { stalled_since: 5 }),
        rmp_serde::to_vec_named(&ExitReport::Panic("it broke".to_owned())),
    ];
    written
        .into_iter()
        .map(|frame| frame.expect("texts and numbers can be written"))
        .chain([vec![0]])
        .collect()
}

pub fn frames(bytes: &[u8]) -> bool {
    let message =
        Message::new(Header::new(Kind::HOST_TURN, Tid::NONE, Tid::NONE), Bytes::copy_from_slice(bytes));
    let is_turn = Progress::read(&message).is_some();
    if let Ok(ending) = decode::<ExitReport>(bytes) {
        let again = ExitReport::from(&Reason::from(ending));
        if let ExitReport::Panic(text) | ExitReport::Hung(text) | ExitReport::Other(text) = again {
            // The reason's display adds its own short text around this one.
            assert!(text.len() <= TEXT_BYTES_MAX);
        }
    }
    let known = [
        is_read_as_written::<Welcome>(bytes),
        is_read_as_written::<Names>(bytes),
        is_read_as_written::<Beat>(bytes),
        is_read_as_written::<NameLookup>(bytes),
        is_read_as_written::<ExitReport>(bytes),
    ];
    is_turn || known.contains(&true)
}
