//! What sync managers say to each other about lives; byte by byte in `docs/protocol/sync.md`.

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    monitor::DownClass,
    supervision::Reason,
    tid::{AppAddress, Incarnation},
};

use crate::sync::at_most;

/// Applications of one node that another one watches at most.
pub(crate) const WATCHED_MAX: usize = 1_024;
/// Bytes of one of these words beside its entries, at most.
const WORD: usize = 64;
/// Bytes of a watched application in a `Watch`.
const WATCHED: usize = 5;
/// Bytes of an application in `Lives`, at most.
const LIFE: usize = 360;
/// Longest reason in bytes.
const WHY_BYTES_MAX: usize = 256;

/// Whom the sender watches on the receiver's node. It replaces what it said before.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Watch {
    /// Which life of the sender's node says so.
    pub(crate) incarnation: Incarnation,
    /// Counts up with each one.
    pub(crate) version: u64,
    /// Whom.
    #[serde(deserialize_with = "at_most::<_, _, WATCHED_MAX>")]
    pub(crate) apps: Vec<AppAddress>,
}

/// The lives of applications that the receiver watches.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Lives {
    /// Which life of the sender's node says so.
    pub(crate) incarnation: Incarnation,
    /// Counts up with each one: of what is said of one application, the highest is true.
    pub(crate) version: u64,
    /// One entry each.
    #[serde(deserialize_with = "at_most::<_, _, WATCHED_MAX>")]
    pub(crate) lives: Vec<LifeState>,
}

/// How many applications of one node can be watched, if who watches them stand in one word of `bytes_max`.
pub(super) fn watched_max(bytes_max: usize) -> usize {
    (bytes_max.saturating_sub(WORD) / WATCHED).min(WATCHED_MAX)
}

impl Lives {
    /// The same in words of at most `bytes_max`, each about one application at least.
    pub(super) fn in_parts(self, bytes_max: usize) -> Vec<Self> {
        let Self { incarnation, version, lives } = self;
        let each = (bytes_max.saturating_sub(WORD) / LIFE).max(1);
        lives.chunks(each).map(|lives| Self { incarnation, version, lives: lives.to_vec() }).collect()
    }
}

/// The life of one application.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct LifeState {
    pub(crate) app: AppAddress,
    /// Its present life; 0 = nobody has the address. Grows from life to life, also from holder to holder.
    pub(crate) life: u64,
    /// Time since that life began, or since the last one ended.
    pub(crate) age_us: u64,
    /// How the last life at this address ended, as far as it is remembered.
    #[serde(default)]
    pub(crate) ended: Option<Ended>,
}

/// How a life ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Ended {
    /// Which one.
    pub(crate) life: u64,
    /// How.
    pub(crate) cause: Cause,
}

/// How a life ended, for programs and for people.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Cause {
    pub(crate) class: DownClass,
    /// At most 256 bytes.
    why: String,
}

impl Cause {
    /// A cause in these words, as far as there is room for them.
    pub(crate) fn new(class: DownClass, why: impl Into<String>) -> Self {
        let mut why: String = why.into();
        why.truncate(why.floor_char_boundary(WHY_BYTES_MAX));
        Self { class, why }
    }

    /// The words; what came from another node may be longer than it may.
    pub(crate) fn why(&self) -> &str {
        &self.why[..self.why.floor_char_boundary(WHY_BYTES_MAX)]
    }
}

impl From<&Reason> for Cause {
    fn from(reason: &Reason) -> Self {
        Self::new(DownClass::of(reason), reason.to_string())
    }
}

/// The bytes of a frame's payload.
pub(crate) fn write<P: Serialize>(words: &P) -> Bytes {
    rmp_serde::to_vec_named(words).expect("these types have no map with equal keys").into()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn life(app: u32) -> LifeState {
        let cause = Cause::new(DownClass::NoSuchAddress, "x".repeat(WHY_BYTES_MAX));
        let ended = Some(Ended { life: u64::MAX, cause });
        LifeState { app: AppAddress::fixed(app).unwrap(), life: u64::MAX, age_us: u64::MAX, ended }
    }

    #[test]
    fn what_does_not_fit_into_one_word_about_lives_is_said_in_several() {
        let lives: Vec<_> = (0..1_024).map(life).collect();
        let whole = Lives { incarnation: Incarnation(u64::MAX), version: u64::MAX, lives: lives.clone() };
        assert_eq!(whole.clone().in_parts(1 << 20).len(), 1);
        for bytes_max in [500, 10_000] {
            let parts = whole.clone().in_parts(bytes_max);
            assert!(parts.iter().all(|part| write(part).len() <= bytes_max), "{bytes_max}");
            assert_eq!(parts.into_iter().flat_map(|part| part.lives).collect::<Vec<_>>(), lives);
        }
    }

    #[test]
    fn as_many_applications_are_watched_as_one_word_names() {
        for bytes_max in [64, 1_000, 5_000] {
            let apps =
                (0..watched_max(bytes_max) as u32).map(|app| AppAddress::fixed(app).unwrap()).collect();
            let watch = Watch { incarnation: Incarnation(u64::MAX), version: u64::MAX, apps };
            assert!(write(&watch).len() <= bytes_max, "{bytes_max}");
        }
        assert_eq!(watched_max(1 << 20), WATCHED_MAX);
    }
}
