//! A file in the order of its times.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BinaryHeap},
    fs::File,
    io::{BufReader, Seek as _, SeekFrom},
    path::{Path, PathBuf},
    sync::Arc,
};

use super::{Channel, Item, Reader, chunk, frames};
use crate::{
    error::{BagError, DamageList},
    merge::{LOSSES_MAX, MERGED, MERGED_LOSSES},
};

/// Maximum bytes of chunks that overlap in time and so are in memory together.
const OVERLAP_MAX: u64 = 1 << 30;

/// A message that stays valid.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OwnedMessage {
    /// Its channel.
    pub channel: Arc<Channel>,
    /// The lower half of the source's sequence number.
    pub sequence: u32,
    /// When it was handed over, in nanoseconds of the file's wall clock.
    pub log_ns: u64,
    /// When it was sent, in nanoseconds of the file's wall clock.
    pub publish_ns: u64,
    /// The bytes.
    pub data: Vec<u8>,
}

/// A chunk, and the time of its first message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Span {
    first_ns: u64,
    at: u64,
}

/// Reads a file in the order of its times. It reads the file twice: first for its channels and the times of its chunks,
/// then chunk by chunk. Only chunks that overlap in time are in memory together.
#[derive(Debug)]
pub struct Ordered {
    path: PathBuf,
    file: BufReader<File>,
    channels: BTreeMap<u16, Arc<Channel>>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    missing_end: Option<String>,
    damage: Vec<String>,
    /// The chunks that are not loaded, the earliest last.
    waiting: Vec<Span>,
    /// Loaded chunks by their place, with their messages that are left.
    loaded: BTreeMap<u64, Loaded>,
    /// The next message of each loaded chunk.
    next: BinaryHeap<Reverse<(u64, u64)>>,
}

#[derive(Debug)]
struct Loaded {
    records: Vec<u8>,
    /// Times and places of its messages, the earliest last.
    messages: Vec<(u64, usize)>,
}

impl Ordered {
    /// Opens a file and reads it once.
    ///
    /// # Errors
    /// It cannot be read, or is no MCAP file.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, BagError> {
        let path = path.as_ref();
        let mut reader = Reader::open(path)?;
        let (mut spans, mut metadata, mut damage) =
            (BTreeMap::<u64, u64>::new(), BTreeMap::new(), DamageList::default());
        let mut outside = 0_u64;
        loop {
            let item = match reader.next_item() {
                Ok(Some(item)) => item,
                Ok(None) => break,
                Err(error @ BagError::Damaged { .. }) => {
                    damage.add(&error);
                    continue;
                }
                Err(error) => return Err(error),
            };
            match item {
                Item::Metadata(name, fields) => {
                    metadata.insert(name, fields);
                }
                Item::Message(message) => {
                    let log_ns = message.log_ns;
                    let Some(at) = reader.chunk_position() else {
                        outside += 1;
                        continue;
                    };
                    let first = spans.entry(at).or_insert(log_ns);
                    *first = log_ns.min(*first);
                }
            }
        }
        let mut damage = damage.into_lines(path);
        // Messages that the former files lack are missing here, too.
        let losses =
            metadata.get(MERGED).and_then(|fields: &BTreeMap<String, String>| fields.get(MERGED_LOSSES));
        let losses = losses.map_or("", String::as_str).lines().take(LOSSES_MAX);
        damage.extend(losses.map(|loss| {
            format!("{}: one of the files that it was made of was not whole: {loss}", path.display())
        }));
        if outside > 0 {
            damage.push(format!("{}: {outside} messages outside of chunks are left out", path.display()));
        }
        let mut waiting: Vec<_> = spans.into_iter().map(|(at, first_ns)| Span { first_ns, at }).collect();
        waiting.sort_by_key(|span| Reverse(*span));
        let file = File::open(path).map_err(|cause| BagError::read(path, cause))?;
        Ok(Self {
            path: path.to_owned(),
            file: BufReader::new(file),
            channels: reader.channels().clone(),
            metadata,
            missing_end: reader.missing_end(),
            damage,
            waiting,
            loaded: BTreeMap::new(),
            next: BinaryHeap::new(),
        })
    }

    /// Returns all channels.
    #[must_use]
    pub const fn channels(&self) -> &BTreeMap<u16, Arc<Channel>> {
        &self.channels
    }

    /// Returns a metadata record.
    #[must_use]
    pub fn metadata(&self, name: &str) -> Option<&BTreeMap<String, String>> {
        self.metadata.get(name)
    }

    /// Returns the loss at the end of an unfinished file, as [`Reader::missing_end`] does.
    #[must_use]
    pub fn missing_end(&self) -> Option<&str> {
        self.missing_end.as_deref()
    }

    /// Returns the damage that was found, and skipped: the first 1,000 records, and the number of the others. A merged
    /// file also has the losses of the files that it was made of.
    #[must_use]
    pub fn damage(&self) -> &[String] {
        &self.damage
    }

    /// Reads the next message; `None` at the end.
    ///
    /// # Errors
    /// The file cannot be read any more, or too many chunks overlap in time.
    pub fn next_message(&mut self) -> Result<Option<OwnedMessage>, BagError> {
        loop {
            self.load_due()?;
            let Some(Reverse((_, at))) = self.next.pop() else { return Ok(None) };
            let Some(loaded) = self.loaded.get_mut(&at) else { continue };
            let found = loaded.messages.pop();
            let message = found.and_then(|(_, place)| owned(&loaded.records[place..], &self.channels));
            match loaded.messages.last() {
                Some((log_ns, _)) => self.next.push(Reverse((*log_ns, at))),
                None => {
                    self.loaded.remove(&at);
                }
            }
            // One of an unknown channel was found to be damaged when the file was read first.
            if message.is_some() {
                return Ok(message);
            }
        }
    }

    /// Loads the chunks that begin before the next message.
    fn load_due(&mut self) -> Result<(), BagError> {
        loop {
            let earliest = self.next.peek().map(|Reverse((log_ns, _))| *log_ns);
            match self.waiting.last() {
                Some(span) if earliest.is_none_or(|earliest| span.first_ns <= earliest) => {
                    let at = span.at;
                    self.waiting.pop();
                    self.load(at)?;
                }
                Some(_) | None => return Ok(()),
            }
        }
    }

    /// Loads the chunk at this place of the file.
    fn load(&mut self, at: u64) -> Result<(), BagError> {
        self.file.seek(SeekFrom::Start(at)).map_err(|cause| BagError::read(&self.path, cause))?;
        let mut records = Vec::new();
        // It was read before, so a fault here means that the file has changed, or that it was skipped then, too.
        let body = frames::at(&mut self.file, &self.path)?;
        let is_read = body.is_some_and(|body| chunk::records(&body, &mut records).is_ok());
        if !is_read {
            return Ok(());
        }
        let held: u64 = self.loaded.values().map(|loaded| loaded.records.len() as u64).sum();
        if held + records.len() as u64 > OVERLAP_MAX {
            let name = self.path.display();
            let text = format!(
                "{name}: more than {OVERLAP_MAX} bytes of it overlap in time; read it in the order of the file"
            );
            return Err(BagError::Unfit(text));
        }
        let (mut messages, mut place) = (Vec::new(), 0);
        while let Some((opcode, body)) = frames::split(&records[place..]) {
            if let Some(log_ns) = frames::log_time(opcode, body) {
                messages.push((log_ns, place));
            }
            place += frames::HEAD + body.len();
        }
        // The earliest last, and of the same time the first one last.
        messages.sort_unstable_by_key(|found| Reverse(*found));
        if let Some((log_ns, _)) = messages.last() {
            self.next.push(Reverse((*log_ns, at)));
            self.loaded.insert(at, Loaded { records, messages });
        }
        Ok(())
    }
}

fn owned(records: &[u8], channels: &BTreeMap<u16, Arc<Channel>>) -> Option<OwnedMessage> {
    let (_, body) = frames::split(records)?;
    let found = super::Found::read(body, 0, channels, true)?;
    let super::Found { channel, sequence, log_ns, publish_ns, span, .. } = found;
    Some(OwnedMessage { channel, sequence, log_ns, publish_ns, data: body[span.0..span.1].to_vec() })
}
