//! Any word between a node and a process that it started, against what is promised.

use bytes::Bytes;
use sinew_runtime::{
    supervision::Reason,
    tid::Tid,
    wire::{Header, Kind, Message, decode},
};

use super::words::{Beat, Ending, Look, Names, TEXT_BYTES_MAX, Turn, Welcome};
use crate::fuzzing::is_read_as_written;

pub(crate) fn said() -> Vec<Vec<u8>> {
    let welcome = Welcome { tid: 1, first_wait: 2, sequence: 3, beat_us: 4, names: Names::default() };
    let written = [
        rmp_serde::to_vec_named(&welcome),
        rmp_serde::to_vec_named(&Look { name: "hip".to_owned() }),
        rmp_serde::to_vec_named(&Beat { stalled_since: 5 }),
        rmp_serde::to_vec_named(&Ending::Panic("it broke".to_owned())),
    ];
    written
        .into_iter()
        .map(|words| words.expect("texts and numbers can be written"))
        .chain([vec![0]])
        .collect()
}

pub(crate) fn words(bytes: &[u8]) -> bool {
    let message =
        Message::new(Header::new(Kind::HOST_TURN, Tid::NONE, Tid::NONE), Bytes::copy_from_slice(bytes));
    let is_turn = Turn::read(&message).is_some();
    if let Ok(ending) = decode::<Ending>(bytes) {
        let again = Ending::from(&Reason::from(ending));
        if let Ending::Panic(text) | Ending::Hung(text) | Ending::Other(text) = again {
            // What it says of how it ended has its own words around it, which are short.
            assert!(text.len() <= TEXT_BYTES_MAX);
        }
    }
    let known = [
        is_read_as_written::<Welcome>(bytes),
        is_read_as_written::<Names>(bytes),
        is_read_as_written::<Beat>(bytes),
        is_read_as_written::<Look>(bytes),
        is_read_as_written::<Ending>(bytes),
    ];
    is_turn || known.contains(&true)
}
