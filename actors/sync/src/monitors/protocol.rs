//! The frames about lives that sync managers exchange; `docs/protocol/sync.md` has their bytes.

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use sinew_runtime::tid::{AppAddress, Incarnation};

use sinew_model::{bounded::at_most, cause::Cause};

/// Maximum number of applications of one node that another node monitors.
pub(super) const WATCHED_MAX: usize = 1_024;
/// Maximum size of a frame without its entries, in bytes.
const FRAME_OVERHEAD: usize = 64;
/// Size of an application in a `Watch`, in bytes.
const WATCHED_BYTES: usize = 5;
/// Maximum size of an application in `Lives`, in bytes.
const STATE_BYTES_MAX: usize = 360;

/// The applications that the sender monitors on the receiver's node. It replaces the previous list.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Watch {
    /// The incarnation of the sender's node.
    pub incarnation: Incarnation,
    /// Counter that increases with each list.
    pub version: u64,
    /// The monitored applications.
    #[serde(deserialize_with = "at_most::<_, _, WATCHED_MAX>")]
    pub apps: Vec<AppAddress>,
}

/// The states of applications that the receiver monitors.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Lives {
    /// The incarnation of the sender's node.
    pub incarnation: Incarnation,
    /// Counter that increases with each frame. For each application the state with the highest version is
    /// valid.
    pub version: u64,
    /// One entry for each application.
    #[serde(deserialize_with = "at_most::<_, _, WATCHED_MAX>")]
    pub lives: Vec<LifeState>,
}

/// Returns how many applications of one node can be monitored if their list must fit in one frame of
/// `bytes_max`.
pub(super) fn watched_max(bytes_max: usize) -> usize {
    (bytes_max.saturating_sub(FRAME_OVERHEAD) / WATCHED_BYTES).min(WATCHED_MAX)
}

impl Lives {
    /// Splits the states into frames of at most `bytes_max` bytes. Each frame has at least one application.
    pub(super) fn in_parts(self, bytes_max: usize) -> Vec<Self> {
        let Self { incarnation, version, lives } = self;
        let each = (bytes_max.saturating_sub(FRAME_OVERHEAD) / STATE_BYTES_MAX).max(1);
        lives.chunks(each).map(|lives| Self { incarnation, version, lives: lives.to_vec() }).collect()
    }
}

/// The state of one application.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LifeState {
    pub app: AppAddress,
    /// The current life; 0 if no application has the address. It increases from life to life, also if another
    /// application gets the address.
    pub life: u64,
    /// Time since the current life started, or since the last one ended, in microseconds.
    pub age_us: u64,
    /// How the last life at this address ended, if the node remembers it.
    #[serde(default)]
    pub ended: Option<Ended>,
}

/// The end of a life.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ended {
    /// The life that ended.
    pub life: u64,
    /// The cause of the end.
    pub cause: Cause,
}

/// Returns the encoded payload of a frame.
pub(super) fn write<P: Serialize>(payload: &P) -> Bytes {
    rmp_serde::to_vec_named(payload).expect("these types have no map with equal keys").into()
}

#[cfg(test)]
mod tests {
    use sinew_model::cause::WHY_BYTES_MAX;
    use sinew_runtime::monitor::DownClass;

    use super::*;

    fn life(app: u32) -> LifeState {
        let cause = Cause::new(DownClass::NoSuchAddress, "x".repeat(WHY_BYTES_MAX));
        let ended = Some(Ended { life: u64::MAX, cause });
        LifeState { app: AppAddress::fixed(app).unwrap(), life: u64::MAX, age_us: u64::MAX, ended }
    }

    #[test]
    fn long_list_of_lives_is_split_into_frames() {
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
    fn watch_list_is_limited_to_one_frame() {
        for bytes_max in [64, 1_000, 5_000] {
            let apps =
                (0..watched_max(bytes_max) as u32).map(|app| AppAddress::fixed(app).unwrap()).collect();
            let watch = Watch { incarnation: Incarnation(u64::MAX), version: u64::MAX, apps };
            assert!(write(&watch).len() <= bytes_max, "{bytes_max}");
        }
        assert_eq!(watched_max(1 << 20), WATCHED_MAX);
    }
}
