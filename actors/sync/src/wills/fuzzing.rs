//! Fuzz target for lists of wills.

use sinew_runtime::{fuzzing::is_read_as_written, tid::Incarnation, wire::decode};

use super::protocol::Testament;

pub fn sent_frames() -> Vec<Vec<u8>> {
    let none = Testament { incarnation: Incarnation(1), version: 2, wills: Vec::new() };
    vec![rmp_serde::to_vec_named(&none).expect("numbers can be written")]
}

pub fn frames(bytes: &[u8]) -> bool {
    if let Ok(Testament { wills, .. }) = decode::<Testament>(bytes) {
        for will in wills.iter().filter(|will| will.is_legal()) {
            assert!(will.class().is_some() && will.payload().len() <= will.bytes_max());
            // A will may have no recipient.
            let _ = will.recipient();
        }
    }
    is_read_as_written::<Testament>(bytes)
}
