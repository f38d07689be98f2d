//! Fuzz targets for the frames of monitors.

use sinew_model::cause::Cause;
use sinew_runtime::{
    fuzzing::is_read_as_written,
    monitor::DownClass,
    tid::{AppAddress, Incarnation},
};

use super::protocol::{Ended, LifeState, Lives, Watch, write};

pub fn sent_frames() -> Vec<Vec<u8>> {
    let (incarnation, app) = (Incarnation(1), AppAddress::new(0x8000_0001));
    let ended = Some(Ended {
        life: 1,
        cause: Cause::new(DownClass::of(&sinew_runtime::supervision::Reason::Killed), "it panicked"),
    });
    let life = LifeState { app, life: 2, age_us: 3, ended };
    let watch = write(&Watch { incarnation, version: 1, apps: vec![app] });
    vec![watch.to_vec(), write(&Lives { incarnation, version: 1, lives: vec![life] }).to_vec()]
}

pub fn frames(bytes: &[u8]) -> bool {
    if let Ok(Lives { lives, .. }) = sinew_runtime::wire::decode::<Lives>(bytes) {
        let causes = lives.iter().filter_map(|life| life.ended.as_ref());
        assert!(causes.map(|ended| ended.cause.why().len()).all(|length| length <= 256));
    }
    let is_watch = is_read_as_written::<Watch>(bytes);
    is_read_as_written::<Lives>(bytes) || is_watch
}
