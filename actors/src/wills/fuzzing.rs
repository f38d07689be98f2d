//! Any list of wills, against what is promised.

use sinew_runtime::{tid::Incarnation, wire::decode};

use super::words::Testament;
use crate::fuzzing::is_read_as_written;

pub(crate) fn said() -> Vec<Vec<u8>> {
    let none = Testament { incarnation: Incarnation(1), version: 2, wills: Vec::new() };
    vec![rmp_serde::to_vec_named(&none).expect("numbers can be written")]
}

pub(crate) fn words(bytes: &[u8]) -> bool {
    if let Ok(Testament { wills, .. }) = decode::<Testament>(bytes) {
        for will in wills.iter().filter(|will| will.is_legal()) {
            assert!(will.class().is_some() && will.payload().len() <= will.bytes_max());
            // Nobody may be named.
            let _ = will.heir();
        }
    }
    is_read_as_written::<Testament>(bytes)
}
