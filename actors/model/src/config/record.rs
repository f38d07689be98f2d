//! The settings of the recording that a node makes by itself.

use std::{path::PathBuf, time::Duration};

/// The recording that a node makes from its start: the newest messages in a file that outlives the node's process, and
/// the spans around faults that are kept. Programs of the node's user can record without it, too.
///
/// # Examples
///
/// ```
/// use sinew::NodeConfig;
///
/// let mut config = NodeConfig::new("knee");
/// config.record.folder = Some("/dev/shm".into());
/// config.record.apps = vec!["knee.*".into()];
/// config.validate()?;
/// # Ok::<(), sinew::config::ConfigError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecordConfig {
    /// Folder of the file; 1 to 4,096 bytes. It should lie in memory, as `/dev/shm`: on a disk the system may stop a
    /// sender while it stores a page. Default: none, the node records only while a program asks for it.
    pub folder: Option<PathBuf>,
    /// Bytes of the newest records that are kept, rounded up to a power of two; also for the recording of a program. 64
    /// KiB to 4 GiB; default 64 MiB.
    pub keep_bytes: usize,
    /// Time before a trigger that is frozen, as far as the newest bytes reach. 1 s to 10 min, and not less than
    /// `after`; default 30 s.
    pub keep: Duration,
    /// Time after a trigger that is frozen, too. Triggers within this time of one another have one span. 1 to 60 s;
    /// default 2 s.
    pub after: Duration,
    /// Maximum number of frozen spans. The oldest stay until they are fetched; without room a further one is not
    /// frozen. 0 to 64, default 4; 0 freezes none.
    pub frozen_max: usize,
    /// Folder of the frozen spans; 1 to 4,096 bytes. It may lie on a disk. Default: none, they lie in `folder`.
    pub frozen_folder: Option<PathBuf>,
    /// Names of the node's applications of which messages are recorded; `*` matches any text. At most 64 names of 1
    /// to 255 bytes; default none, all applications.
    pub apps: Vec<String>,
    /// Names of the payload types that are recorded, in the same way. Default none, all types.
    pub types: Vec<String>,
}

impl Default for RecordConfig {
    fn default() -> Self {
        Self {
            folder: None,
            keep_bytes: 64 << 20,
            keep: Duration::from_secs(30),
            after: Duration::from_secs(2),
            frozen_max: 4,
            frozen_folder: None,
            apps: Vec::new(),
            types: Vec::new(),
        }
    }
}
