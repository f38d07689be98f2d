//! Names of protected types, kept for the life of the process: a codename is compared for ever.

use std::{
    collections::BTreeSet,
    sync::{Mutex, PoisonError},
};

use crate::status::{Fault, Status};

/// Names of protected types of one process at most.
const NAMES_MAX: usize = 1024;

static NAMES: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());

/// The same name, which stays.
pub(crate) fn kept(name: &str) -> Result<&'static str, Fault> {
    let mut names = NAMES.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(kept) = names.get(name) {
        return Ok(kept);
    }
    if names.len() >= NAMES_MAX {
        let sentence = format!("this process has {NAMES_MAX} names of protected types already");
        return Err(Fault::new(Status::SinewErrorTooMany, sentence));
    }
    let kept: &'static str = Box::leak(name.to_owned().into_boxed_str());
    names.insert(kept);
    Ok(kept)
}
