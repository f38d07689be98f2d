//! The reader of recordings, and of other MCAP files.
//!
//! Files can be hostile. Nothing is reserved by a length that the file states: memory grows with the bytes that are
//! there, up to [`RECORD_MAX`] for a record, [`CHUNK_MAX`] for a chunk, and 64 MiB for all channels and schemas.

mod chunk;
mod describe;
mod frames;
mod ordered;
#[cfg(test)]
mod tests;

use std::{
    collections::BTreeMap,
    fs::File,
    io::{BufReader, Read},
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use crate::error::BagError;
use frames::{Body, Frame, Frames};

pub use describe::{Header, Role};
pub use frames::{CHUNK_MAX, RECORD_MAX};
pub use ordered::{Ordered, OwnedMessage};

/// A description of messages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MessageSchema {
    /// The name of the type.
    pub name: String,
    /// The language of the description, such as `protobuf`.
    pub encoding: String,
    /// The description.
    pub data: Vec<u8>,
}

/// A channel of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channel {
    /// Its number in the file.
    pub id: u16,
    /// Its topic.
    pub topic: String,
    /// The encoding of its messages, such as `msgpack`.
    pub encoding: String,
    /// The description of its messages, if there is one.
    pub schema: Option<Arc<MessageSchema>>,
    /// The metadata; the keys of recordings begin with `sinew.`.
    pub metadata: BTreeMap<String, String>,
}

/// A message, valid until the next one is read.
#[derive(Clone, Debug)]
pub struct Message<'r> {
    /// Its channel.
    pub channel: Arc<Channel>,
    /// The lower half of the source's sequence number.
    pub sequence: u32,
    /// When it was handed over, in nanoseconds of the file's wall clock.
    pub log_ns: u64,
    /// When it was sent, in nanoseconds of the file's wall clock.
    pub publish_ns: u64,
    /// The bytes.
    pub data: &'r [u8],
}

/// A message, or a metadata record.
#[derive(Clone, Debug)]
pub enum Item<'r> {
    /// A message.
    Message(Message<'r>),
    /// A metadata record: its name and its content.
    Metadata(String, BTreeMap<String, String>),
}

/// How a file ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum End {
    /// It is not read to its end yet.
    #[default]
    Open,
    /// With its summary.
    Finished {
        /// The messages in the file, as its summary states.
        messages: Option<u64>,
    },
    /// In the middle: its recorder was killed, or the disk was full.
    Unfinished {
        /// Bytes up to the last whole record.
        at: u64,
    },
}

/// Reads a file from its beginning to its end, in the order in which it was written.
///
/// # Examples
///
/// ```no_run
/// use sinew_bag::read::{Item, Reader};
///
/// let mut reader = Reader::open("walk.mcap")?;
/// while let Some(item) = reader.next_item()? {
///     if let Item::Message(message) = item {
///         println!("{} {} {} bytes", message.log_ns, message.channel.topic, message.data.len());
///     }
/// }
/// # Ok::<(), sinew_bag::BagError>(())
/// ```
#[derive(Debug)]
pub struct Reader<R> {
    path: PathBuf,
    frames: Frames<R>,
    /// The records of the current chunk, and the place of the next one.
    chunk: Vec<u8>,
    chunk_at: usize,
    /// Where the current chunk is in the file.
    chunk_start: Option<u64>,
    schemas: BTreeMap<u16, Arc<MessageSchema>>,
    channels: BTreeMap<u16, Arc<Channel>>,
    /// Bytes of the schemas and channels.
    declared: u64,
    /// Whether the data is over and the summary has begun.
    is_summary: bool,
    messages: Option<u64>,
    end: End,
    /// The time of the first message, and the latest time of any, in nanoseconds of the file's wall clock.
    times: Option<(u64, u64)>,
}

impl Reader<BufReader<File>> {
    /// Opens a file.
    ///
    /// # Errors
    /// It cannot be read, or is no MCAP file.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, BagError> {
        let path = path.as_ref();
        let file = File::open(path).map_err(|cause| BagError::read(path, cause))?;
        Self::new(BufReader::new(file), path)
    }
}

impl<R: Read> Reader<R> {
    /// Reads from `source`. Errors name `path`.
    ///
    /// # Errors
    /// It cannot be read, or is no MCAP file.
    pub fn new(source: R, path: &Path) -> Result<Self, BagError> {
        let frames = Frames::new(source, path)?;
        Ok(Self {
            path: path.to_owned(),
            frames,
            chunk: Vec::new(),
            chunk_at: 0,
            chunk_start: None,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            declared: 0,
            is_summary: false,
            messages: None,
            end: End::Open,
            times: None,
        })
    }

    /// Returns the path.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns how the file ended.
    #[must_use]
    pub const fn end(&self) -> End {
        self.end
    }

    /// Returns the loss at the end of an unfinished file, as a line: from which byte and which time on messages may be
    /// missing. `None` before the end, and for a finished file.
    #[must_use]
    pub fn missing_end(&self) -> Option<String> {
        let End::Unfinished { at } = self.end else { return None };
        let last_ns = self.times.map_or(0, |(_, last_ns)| last_ns);
        Some(format!(
            "{}: unfinished: the file ends at byte {at}, without its summary; messages after {} of it may be missing",
            self.path.display(),
            self.offset(last_ns, last_ns)
        ))
    }

    /// Returns the time from the first message of the file, as text. That is the one at `first_ns` if none was read
    /// yet.
    fn offset(&self, at_ns: u64, first_ns: u64) -> String {
        let first_ns = self.times.map_or(first_ns, |(first_ns, _)| first_ns);
        let offset = Duration::from_nanos(at_ns.saturating_sub(first_ns));
        // As the times of a replay are written.
        format!("{}.{:09}s", offset.as_secs(), offset.subsec_nanos())
    }

    /// Returns the channels that were read so far.
    #[must_use]
    pub const fn channels(&self) -> &BTreeMap<u16, Arc<Channel>> {
        &self.channels
    }

    /// Returns the bytes that were read.
    #[must_use]
    pub const fn position(&self) -> u64 {
        self.frames.position()
    }

    /// Returns where the chunk of the last message begins, in bytes; `None` if it is in no chunk.
    #[must_use]
    pub const fn chunk_position(&self) -> Option<u64> {
        self.chunk_start
    }

    /// Reads the next message or metadata record; `None` at the end.
    ///
    /// # Errors
    /// The file cannot be read, or a record is damaged. The next call continues behind it.
    pub fn next_item(&mut self) -> Result<Option<Item<'_>>, BagError> {
        loop {
            if self.chunk_at < self.chunk.len() {
                // The borrow checker needs the place of the message, not the message.
                if let Some(found) = self.chunk_record()? {
                    self.note_time(found.log_ns);
                    return Ok(Some(Item::Message(self.message(&found))));
                }
                continue;
            }
            let Some(frame) = self.frames.next()? else {
                if self.end == End::Open {
                    self.end = End::Unfinished { at: self.frames.whole() };
                }
                return Ok(None);
            };
            match self.file_record(frame)? {
                Some(Whole::Metadata(name, fields)) => return Ok(Some(Item::Metadata(name, fields))),
                Some(Whole::Message(found)) => {
                    self.note_time(found.log_ns);
                    return Ok(Some(Item::Message(self.message(&found))));
                }
                Some(Whole::End) => return Ok(None),
                None => {}
            }
        }
    }

    fn note_time(&mut self, log_ns: u64) {
        let (_, last_ns) = self.times.get_or_insert((log_ns, log_ns));
        *last_ns = log_ns.max(*last_ns);
    }

    fn message(&self, found: &Found) -> Message<'_> {
        let Found { channel, sequence, log_ns, publish_ns, span, is_in_chunk } = found;
        let data = if *is_in_chunk { &self.chunk[..] } else { self.frames.body() };
        Message {
            channel: Arc::clone(channel),
            sequence: *sequence,
            log_ns: *log_ns,
            publish_ns: *publish_ns,
            data: &data[span.0..span.1],
        }
    }

    /// Reads a record between chunks.
    fn file_record(&mut self, frame: Frame) -> Result<Option<Whole>, BagError> {
        let damaged = |fault: &str| self.frames.damaged(fault);
        match frame.opcode {
            frames::FOOTER => {
                self.end = End::Finished { messages: self.messages };
                return Ok(Some(Whole::End));
            }
            frames::DATA_END => self.is_summary = true,
            frames::STATISTICS => self.messages = Body(self.frames.body()).u64(),
            frames::METADATA if !self.is_summary => {
                let mut body = Body(self.frames.body());
                let (name, fields) = (body.text(), body.map());
                let (Some(name), Some(fields)) = (name, fields) else {
                    return Err(damaged("a metadata record is damaged"));
                };
                return Ok(Some(Whole::Metadata(name, fields)));
            }
            frames::CHUNK if !self.is_summary => {
                self.chunk_start = Some(frame.at);
                self.chunk_at = 0;
                if let Err(fault) = chunk::records(self.frames.body(), &mut self.chunk) {
                    self.chunk.clear();
                    return Err(self.frames.damaged(&self.damaged_chunk(&fault)));
                }
            }
            frames::SCHEMA | frames::CHANNEL if !self.is_summary => {
                let (channels, schemas, declared) =
                    (&mut self.channels, &mut self.schemas, &mut self.declared);
                let body = Body(self.frames.body());
                if frames::declare(frame.opcode, body, channels, schemas, declared).is_none() {
                    return Err(self.frames.damaged(frames::DECLARED_FAULT));
                }
            }
            frames::MESSAGE if !self.is_summary => {
                self.chunk_start = None;
                let found = Found::read(self.frames.body(), 0, &self.channels, false);
                return found
                    .map(|found| Some(Whole::Message(found)))
                    .ok_or_else(|| damaged("a message is damaged"));
            }
            _ => {}
        }
        Ok(None)
    }

    /// Returns the fault of a chunk, with the times that it states for its messages.
    fn damaged_chunk(&self, fault: &str) -> String {
        let times = chunk::times(self.frames.body()).map_or_else(String::new, |(first_ns, last_ns)| {
            let [first, last] = [first_ns, last_ns].map(|at_ns| self.offset(at_ns, first_ns));
            format!("; its messages, from {first} to {last} of the file, are missing")
        });
        format!("a chunk is damaged: {fault}{times}")
    }

    /// Reads a record of the current chunk.
    fn chunk_record(&mut self) -> Result<Option<Found>, BagError> {
        let rest = &self.chunk[self.chunk_at..];
        let split = frames::split(rest);
        let Some((opcode, body)) = split else {
            self.chunk_at = self.chunk.len();
            return Err(self.frames.damaged("a record in a chunk is cut off"));
        };
        let start = self.chunk_at + frames::HEAD;
        self.chunk_at = start + body.len();
        let read = match opcode {
            frames::MESSAGE => Found::read(body, start, &self.channels, true).map(Some),
            frames::SCHEMA | frames::CHANNEL => {
                let (channels, schemas, declared) =
                    (&mut self.channels, &mut self.schemas, &mut self.declared);
                let read = frames::declare(opcode, Body(body), channels, schemas, declared);
                return read.map(|()| None).ok_or_else(|| self.frames.damaged(frames::DECLARED_FAULT));
            }
            _ => Some(None),
        };
        read.ok_or_else(|| self.frames.damaged("a record in a chunk is damaged"))
    }
}

/// A record that stands outside of chunks.
enum Whole {
    Metadata(String, BTreeMap<String, String>),
    Message(Found),
    End,
}

/// A message, and the place of its bytes.
struct Found {
    channel: Arc<Channel>,
    sequence: u32,
    log_ns: u64,
    publish_ns: u64,
    span: (usize, usize),
    is_in_chunk: bool,
}

impl Found {
    fn read(
        body: &[u8],
        start: usize,
        channels: &BTreeMap<u16, Arc<Channel>>,
        is_in_chunk: bool,
    ) -> Option<Self> {
        let mut fields = Body(body);
        let channel = Arc::clone(channels.get(&fields.u16()?)?);
        let (sequence, log_ns, publish_ns) = (fields.u32()?, fields.u64()?, fields.u64()?);
        let end = start + body.len();
        Some(Self { channel, sequence, log_ns, publish_ns, span: (end - fields.0.len(), end), is_in_chunk })
    }
}
