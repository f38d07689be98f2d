//! A file of a recording.
//!
//! MCAP is written to memory, and a whole chunk at a time goes to the file. So a full disk leaves no half a chunk.

use std::{
    collections::BTreeMap,
    fmt, fs,
    fs::{File, OpenOptions},
    io::{self, Write},
    os::unix::fs::OpenOptionsExt as _,
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
};

use mcap::{McapError, WriteOptions, records::MessageHeader, write::NoSeek};

use super::{channel::Channel, records::Fixed};
use crate::terms::{Compression, Options, Origin};

/// The name of the metadata record of each part.
pub(crate) const METADATA: &str = "sinew";
/// The version of topics, metadata and fields.
pub(crate) const FORMAT: &str = "1";

/// The bytes that are not in the file yet.
#[derive(Clone, Debug, Default)]
struct Pending(Arc<Mutex<Vec<u8>>>);

impl Pending {
    fn with<T>(&self, act: impl FnOnce(&mut Vec<u8>) -> T) -> T {
        act(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Write for Pending {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.with(|pending| pending.extend_from_slice(bytes));
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A file that is being written.
pub(super) struct Part {
    pub(super) path: PathBuf,
    pub(super) number: u32,
    pub(super) began_ns: u64,
    /// Bytes in the file.
    pub(super) saved: u64,
    /// Bytes in the current chunk, before compression.
    pub(super) chunk_bytes: u64,
    chunks: u64,
    /// Bytes of channels and schemas, which the summary repeats.
    described: u64,
    file: File,
    pending: Pending,
    mcap: mcap::Writer<NoSeek<Pending>>,
    /// The channels that every recording has, by their topics.
    fixed: BTreeMap<&'static str, u16>,
    /// The node that records, in the metadata of each channel: a merged file has those of several incarnations.
    recorder: BTreeMap<String, String>,
}

impl fmt::Debug for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { path, number, saved, chunk_bytes, .. } = self;
        write!(
            f,
            "Part({}, number {number}, {saved} bytes saved, {chunk_bytes} in its chunk)",
            path.display()
        )
    }
}

/// Returns a path for a part: that of the recording, with a number before the ending.
pub(super) fn path(recording: &Path, number: u32) -> PathBuf {
    if number == 0 {
        return recording.to_owned();
    }
    let stem = recording.file_stem().unwrap_or_default().to_string_lossy();
    let ending = recording.extension().map_or_else(|| "mcap".into(), |ending| ending.to_string_lossy());
    recording.with_file_name(format!("{stem}.{number}.{ending}"))
}

/// Returns the bytes that are free on the disk of a recording; `None` if it does not say.
pub(super) fn free_bytes(recording: &Path) -> Option<u64> {
    let folder = recording.parent().filter(|folder| !folder.as_os_str().is_empty());
    let disk = rustix::fs::statvfs(folder.unwrap_or_else(|| Path::new("."))).ok()?;
    Some(disk.f_bavail.saturating_mul(disk.f_frsize))
}

impl Part {
    pub(super) fn create(
        path: PathBuf,
        number: u32,
        options: &Options,
        origin: &Origin,
        began_ns: u64,
    ) -> Result<Self, crate::BagError> {
        let mut open = OpenOptions::new();
        if options.replace {
            open.create(true).truncate(true);
        } else {
            open.create_new(true);
        }
        let file = open.write(true).mode(0o600).open(&path);
        let file = file.map_err(|cause| crate::BagError::write(&path, cause))?;
        let pending = Pending::default();
        let compression = match options.compression {
            Compression::None => None,
            Compression::Lz4 => Some(mcap::Compression::Lz4),
            Compression::Zstd => Some(mcap::Compression::Zstd),
        };
        let writer = WriteOptions::new()
            .compression(compression)
            .compression_threads(0)
            .library(concat!("sinew-bag/", env!("CARGO_PKG_VERSION")))
            .chunk_size(None)
            .disable_seeking(true)
            .create(NoSeek::new(pending.clone()));
        let written = writer.and_then(|mut mcap| {
            mcap.write_metadata(&metadata(origin, number, options))?;
            Ok(mcap)
        });
        let mcap = written.map_err(|error| crate::BagError::write(&path, cause(error)))?;
        let (fixed, saved) = (BTreeMap::new(), 0);
        Ok(Self {
            path,
            number,
            began_ns,
            saved,
            chunk_bytes: 0,
            chunks: 0,
            described: 0,
            file,
            pending,
            mcap,
            fixed,
            recorder: [
                ("sinew.node", origin.address.clone()),
                ("sinew.incarnation", origin.incarnation.to_string()),
            ]
            .map(|(key, value)| (key.to_owned(), value))
            .into(),
        })
    }

    /// Writes a payload and its companion.
    pub(super) fn message(
        &mut self,
        channel: &mut Channel,
        header: MessageHeader,
        [payload, companion]: [&[u8]; 2],
    ) -> io::Result<()> {
        let ids = self.place(channel)?;
        for (channel_id, data) in ids.into_iter().zip([payload, companion]) {
            self.write(MessageHeader { channel_id, ..header }, data)?;
        }
        Ok(())
    }

    /// Returns the numbers of both channels in this file.
    fn place(&mut self, channel: &mut Channel) -> io::Result<[u16; 2]> {
        if let Some((part, ids)) = channel.placed
            && part == self.number
        {
            return Ok(ids);
        }
        let Channel { topic, metadata, companion, .. } = channel;
        let [own, beside] = [&*metadata, &companion.metadata].map(|own| with(own, &self.recorder));
        let raw = self.mcap.add_channel(0, topic, "msgpack", &own).map_err(cause)?;
        let (name, encoding, data) = companion.schema();
        let schema = self.mcap.add_schema(&name, encoding, &data).map_err(cause)?;
        self.described +=
            (2 * topic.len() + text(&own) + text(&beside) + name.len() + data.len() + 150) as u64;
        let beside = self.mcap.add_channel(schema, &companion.topic, companion.encoding(), &beside);
        let ids = [raw, beside.map_err(cause)?];
        channel.placed = Some((self.number, ids));
        Ok(ids)
    }

    /// Writes to one of the channels that every recording has.
    pub(super) fn record(&mut self, of: &Fixed, log_time: u64, data: &[u8]) -> io::Result<()> {
        let channel_id = match self.fixed.get(of.topic) {
            Some(id) => *id,
            None => {
                let schema = self.mcap.add_schema(of.schema, "jsonschema", of.json_schema.as_bytes());
                let schema = schema.map_err(cause)?;
                let id = self.mcap.add_channel(schema, of.topic, "json", &self.recorder).map_err(cause)?;
                let own = of.topic.len() + of.schema.len() + of.json_schema.len();
                self.described += (own + text(&self.recorder) + 100) as u64;
                self.fixed.insert(of.topic, id);
                id
            }
        };
        self.write(MessageHeader { channel_id, sequence: 0, log_time, publish_time: log_time }, data)
    }

    fn write(&mut self, header: MessageHeader, data: &[u8]) -> io::Result<()> {
        self.chunk_bytes += data.len() as u64 + 31;
        self.mcap.write_to_known_channel(&header, data).map_err(cause)
    }

    /// Ends the current chunk and writes it to the file.
    pub(super) fn save(&mut self) -> io::Result<()> {
        self.mcap.flush().map_err(cause)?;
        self.chunks += u64::from(self.chunk_bytes > 0);
        self.chunk_bytes = 0;
        self.write_out()
    }

    /// Ends the file.
    pub(super) fn finish(&mut self) -> io::Result<()> {
        // The last chunk first: if there is room for it alone, it is kept.
        self.save()?;
        self.mcap.finish().map_err(cause)?;
        self.write_out()?;
        self.file.sync_all()
    }

    fn write_out(&mut self) -> io::Result<()> {
        let (file, saved) = (&mut self.file, &mut self.saved);
        self.pending.with(|pending| {
            let written = file.write_all(pending);
            if written.is_ok() {
                *saved += pending.len() as u64;
            } else {
                // Half a chunk would be taken for damage. If this fails, too, a reader still stops before it.
                let _ = file.set_len(*saved);
            }
            pending.clear();
            written
        })
    }

    /// Returns an upper bound for the bytes of the summary.
    pub(super) fn summary_bytes(&self, channels: usize) -> u64 {
        let index = 120 + 10 * 2 * (channels as u64 + 8);
        self.described + (self.chunks + 2) * index + 1_024
    }

    /// Removes the file: nothing of use is in it.
    pub(super) fn discard(self) {
        // A device or a pipe is left alone. A file that cannot be removed stays, without content.
        if fs::symlink_metadata(&self.path).is_ok_and(|found| found.is_file()) {
            let _ = fs::remove_file(&self.path);
        }
    }
}

fn with(own: &BTreeMap<String, String>, more: &BTreeMap<String, String>) -> BTreeMap<String, String> {
    own.iter().chain(more).map(|(key, value)| (key.clone(), value.clone())).collect()
}

/// Returns the bytes of metadata in the file.
fn text(all: &BTreeMap<String, String>) -> usize {
    all.iter().map(|(key, value)| key.len() + value.len() + 8).sum()
}

/// Returns the cause of a failed write.
pub(crate) fn cause(error: McapError) -> io::Error {
    if let McapError::Io(error) = error { error } else { io::Error::other(error) }
}

fn metadata(origin: &Origin, number: u32, options: &Options) -> mcap::records::Metadata {
    let Origin { node, address, incarnation, version, wall_offset_ns, began_ns } = origin;
    let all = [
        ("format", FORMAT.to_owned()),
        ("node", node.clone()),
        ("address", address.clone()),
        ("incarnation", incarnation.to_string()),
        ("version", version.clone()),
        ("wall_offset_ns", wall_offset_ns.to_string()),
        ("began_ns", began_ns.to_string()),
        ("part", number.to_string()),
        ("raw_only", options.raw_only.to_string()),
    ];
    let metadata = all.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
    mcap::records::Metadata { name: METADATA.to_owned(), metadata }
}
