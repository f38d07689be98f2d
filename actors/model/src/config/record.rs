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
    /// File (MCAP) into which the program of the node writes the recorded messages; 1 to 4,096 bytes. `{node}` and
    /// `{time}` in it are replaced. A path without `{time}` has it before its ending, so that no start replaces a file.
    /// `sinew-node` writes it, and other programs by `sinew_recorder::Recording::configured`. It needs
    /// [`LnclConfig::socket`](super::LnclConfig::socket). Default: none.
    pub file: Option<PathBuf>,
    /// Bytes of a file, after which the next one begins. 64 KiB to 1 PiB; default: none.
    pub split_bytes: Option<u64>,
    /// Time span of a file, after which the next one begins. 1 s to 7 days; default: none.
    pub split_time: Option<Duration>,
    /// Maximum bytes of all files of one start. Further messages are counted as dropped. 64 KiB to 1 PiB; default none.
    pub max_bytes: Option<u64>,
    /// Compression of these files. Default [`RecordCompression::Zstd`].
    pub compression: RecordCompression,
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
            file: None,
            split_bytes: None,
            split_time: None,
            max_bytes: None,
            compression: RecordCompression::default(),
        }
    }
}

/// The compression of a recording's file.
///
/// # Examples
///
/// ```
/// use sinew::{NodeConfig, config::RecordCompression};
///
/// let mut config = NodeConfig::new("knee");
/// // The CPU of this host is slow.
/// config.record.compression = RecordCompression::Lz4;
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RecordCompression {
    /// Zstandard: the smallest files.
    #[default]
    Zstd,
    /// LZ4: less work.
    Lz4,
    /// None: the least work, the largest files.
    None,
}

impl RecordCompression {
    /// Returns the value of this compression in a configuration.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Zstd => "zstd",
            Self::Lz4 => "lz4",
            Self::None => "none",
        }
    }
}

impl std::str::FromStr for RecordCompression {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        [Self::Zstd, Self::Lz4, Self::None].into_iter().find(|one| one.word() == text).ok_or(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_compression_round_trips() {
        for compression in [RecordCompression::Zstd, RecordCompression::Lz4, RecordCompression::None] {
            assert_eq!(compression.word().parse(), Ok(compression));
        }
        assert_eq!("gzip".parse::<RecordCompression>(), Err(()));
    }
}
